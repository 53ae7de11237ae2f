"""Shards on Ray, one worker a device.

The process that started the run writes all files, so that workers need no disk in common. A worker that dies loses what it was
rendering; Ray starts it again, and the shard is rendered once more. Results come back through Ray's object store and are written here
alone, so that no press is lost and none is there twice.
"""

from __future__ import annotations

import os
import threading
import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

from raytac.checks import check_whole
from raytac.dataset.renderer import RenderJob, ShardRenderer, ShardResult
from raytac.errors import BackendError, RaytacError

_ATTEMPTS = 3
"""Starts of a shard before it is given up, since it kills every worker."""
_LONGEST_START = 60.0
"""Time in which a worker that died must be back [s]."""


class _Worker:
    """Renders shards in a Ray actor."""

    def __init__(self, job: RenderJob) -> None:
        if threading.current_thread() is not threading.main_thread():
            raise BackendError("Mitsuba must be loaded on a worker's main thread, and Ray runs this actor on another")
        self._renderer = ShardRenderer(job)

    def prepare(self, shard: int) -> str:
        """Build the renderer; returns an error's text, empty if all is well."""
        try:
            self._renderer.prepare(shard)
        except RaytacError as error:
            return str(error)
        return ""

    def render(self, shard: int) -> ShardResult | str:
        """The shard, or an error's text: errors with keywords do not travel between processes."""
        try:
            return replace(self._renderer.render(shard), worker=f"{os.uname().nodename}:{os.getpid()}")
        except RaytacError as error:
            return str(error)


def render_on_ray(
    job: RenderJob, shards: Sequence[int], *, workers: int | None = None, address: str | None = None
) -> Iterator[ShardResult]:
    """Render shards on a Ray cluster, or on a local Ray; they come as they are done.

    Args:
        job: what to render. With ``device="auto"`` a worker has a GPU if the cluster has any, else the CPU.
        workers: how many; None is one a GPU, or one a node where there is none.
        address: of the cluster, ``"auto"`` for one on this machine; None starts a local Ray, unless this process has one or
            ``RAY_ADDRESS`` names one.

    Raises:
        BackendError: Ray is not installed, the cluster has fewer GPUs than workers, a worker cannot render, or a shard killed its
            worker ``_ATTEMPTS`` times; the other shards are given first.
    """
    try:
        import ray
    except ImportError as error:
        raise BackendError(f"engine='ray' needs Ray ({error}): `pip install 'raytac[ray]'`") from error
    if workers is not None:
        workers = check_whole("workers", workers)
    ours = not ray.is_initialized()
    if ours:
        _start(ray, workers, address)
    try:
        yield from _render(ray, job, list(shards), workers)
    finally:
        if ours:
            ray.shutdown()


def _start(ray: Any, workers: int | None, address: str | None) -> None:
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # Ray would report its use over the network
    os.environ.setdefault("RAY_TQDM_PATCH_PRINT", "0")  # Ray would replace print() in the caller's process, for good
    options: dict[str, Any] = {"include_dashboard": False, "log_to_driver": False, "configure_logging": False}
    if address is not None or "RAY_ADDRESS" in os.environ:
        options = {"address": address, "log_to_driver": False, "configure_logging": False}
    else:
        options["num_cpus"] = max(os.cpu_count() or 1, workers or 1)
    try:
        ray.init(**options)
    except Exception as error:  # of many kinds, Exception itself among them
        ray.shutdown()
        raise BackendError(f"Ray does not start, or cannot be reached ({type(error).__name__}: {error})") from error


def _render(ray: Any, job: RenderJob, waiting: list[int], workers: int | None) -> Iterator[ShardResult]:
    gpus = int(ray.cluster_resources().get("GPU", 0)) if job.device != "cpu" else 0
    if job.device == "cuda" and not gpus:
        raise BackendError("device='cuda': the Ray cluster has no GPU")
    count = workers or gpus or sum(node["Alive"] for node in ray.nodes())
    if gpus and count > gpus:
        raise BackendError(f"workers = {count}: one worker a device, and the Ray cluster has {gpus} GPUs")
    count = min(count, max(len(waiting), 1))
    settings = {"num_cpus": 1, "num_gpus": 1 if gpus else 0, "max_restarts": -1, "max_task_retries": 0}
    Worker = ray.remote(**settings)(_Worker)
    # By value: what Ray starts again must not depend on an object's life.
    local_job = replace(job, device=job.device if gpus else "cpu")
    actors = [Worker.options(scheduling_strategy="SPREAD").remote(local_job) for _ in range(count)]
    # One before the others: it may bake a table, which those on its machine then find.
    for some in (actors[:1], actors[1:]) if waiting else ():
        try:
            errors = ray.get([actor.prepare.remote(waiting[0]) for actor in some])
        except ray.exceptions.RayActorError as error:
            raise BackendError(f"a worker died before its first shard ({error})") from error
        for error in filter(None, errors):
            raise BackendError(f"a worker cannot render: {error}")
    waiting.reverse()
    begun: dict[int, int] = {}
    running: dict[Any, tuple[Any, int | None]] = {}
    """Shard that each worker renders, or None while one that died comes back."""

    def give(actor: Any) -> None:
        if waiting:
            shard = waiting.pop()
            begun[shard] = begun.get(shard, 0) + 1
            running[actor.render.remote(shard)] = actor, shard

    coming: dict[int, tuple[int, float]] = {}
    """Shard with which each worker prepares that died, and when it did [s of the clock]."""

    def bring_back(actor: Any, shard: int, since: float) -> None:
        # Until Ray has started it again every call would fail at once; one that is retried waits for that,
        # not for ever: a worker may die each time that it prepares. A death takes two retries, its own and that of the restart.
        coming[id(actor)] = shard, since
        running[actor.prepare.options(max_task_retries=2 * _ATTEMPTS).remote(shard)] = actor, None

    for actor in actors:
        give(actor)
    lost: list[int] = []
    while running and (
        waiting or any(shard is not None for _, shard in running.values())
    ):  # nobody waits for a worker without work
        (done,), _ = ray.wait(list(running))
        actor, shard = running.pop(done)
        try:
            result = ray.get(done)
        except ray.exceptions.RayActorError as error:
            if shard is None:
                last, since = coming[id(actor)]
                # A machine that is busy takes longer to start it again than Ray retries.
                if isinstance(error, ray.exceptions.ActorUnavailableError) and time.monotonic() - since < _LONGEST_START:
                    time.sleep(1.0)
                    bring_back(actor, last, since)
                    continue
                if not running:
                    text = f"no worker is left ({error}); run again to go on with the shards that are missing"
                    raise BackendError(text) from error
                text = f"a worker died each time it came back: the others go on without it ({error})"
                warnings.warn(text, RuntimeWarning, stacklevel=2)
                continue
            again = begun[shard] < _ATTEMPTS
            (waiting if again else lost).append(shard)
            if again:
                warnings.warn(f"the worker of shard {shard} died: the shard is rendered again", RuntimeWarning, stacklevel=2)
            bring_back(actor, shard, time.monotonic())
            continue
        if shard is None:
            if result:
                raise BackendError(f"a worker that came back cannot render: {result}")
            give(actor)
            continue
        if isinstance(result, str):
            raise BackendError(f"shard {shard} cannot be rendered: {result}")
        give(actor)
        yield result
    if lost:
        text = f"their workers died {_ATTEMPTS} times each; all others are done, run again to try these once more"
        raise BackendError(f"shards {lost}: {text}")
