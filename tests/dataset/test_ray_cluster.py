"""Two workers on a local Ray, one of which is killed: no press is lost, none is there twice, and all are what one process renders."""

from __future__ import annotations

import builtins
import os
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from raytac.dataset import DatasetPlan, PressDataset, Presses, RenderJob, ShardResult, ray_cluster, render_dataset, verify_dataset
from raytac.dataset.ray_cluster import render_on_ray
from raytac.dataset.shard import ShardRecord, ShardStore
from raytac.errors import BackendError, InputError
from raytac.specs import SweepSpec

ray = pytest.importorskip("ray", reason="Ray is not installed")


@pytest.fixture(scope="module")
def local_ray():
    """One Ray for all tests here: to start it takes seconds. With the settings of the engine's own start."""
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    os.environ["RAY_TQDM_PATCH_PRINT"] = "0"
    for attempt in range(4):  # it gives itself 30 s to start, which a busy machine may not keep
        try:
            ray.init(num_cpus=2, num_gpus=0, include_dashboard=False, log_to_driver=False, configure_logging=False)
            break
        except Exception:
            ray.shutdown()
            if attempt == 3:
                raise
    yield
    ray.shutdown()


# A worker that renders no images needs no renderer and starts in a moment.
WITHOUT_IMAGES: dict[str, Any] = {
    "outputs": ("height", "wrench"),
    "markers": None,
    "marker_perturbation": {},
    "randomization": {},
}


@pytest.mark.usefixtures("local_ray")
@pytest.mark.parametrize("changes", [WITHOUT_IMAGES, pytest.param({}, marks=pytest.mark.slow)], ids=["heights", "images"])
def test_a_killed_worker_loses_and_doubles_no_press(
    sweep: SweepSpec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changes: dict[str, Any]
) -> None:
    plan = DatasetPlan(replace(sweep, count=24, **changes))
    render_dataset(plan, tmp_path / "local", device="cpu", batch=4)
    workers: list[str] = []
    write = ShardStore.write

    def killing(store: ShardStore, result: ShardResult) -> ShardRecord:
        if not workers:
            os.kill(int(result.worker.split(":")[1]), signal.SIGKILL)  # it was given its next shard before this one came
        workers.append(result.worker)
        return write(store, result)

    monkeypatch.setattr(ShardStore, "write", killing)
    with pytest.warns(RuntimeWarning, match="rendered again"):
        report = render_dataset(plan, tmp_path / "ray", engine="ray", device="cpu", batch=4, workers=2)
    assert builtins.print.__module__ == "builtins"
    assert report.presses == 24 and len(workers) == plan.shards and len(set(workers)) >= 2
    assert not any(worker.endswith(f":{os.getpid()}") for worker in workers)
    assert verify_dataset(tmp_path / "ray").wrong == {}
    names = [
        sorted(path.relative_to(tmp_path / engine) for path in (tmp_path / engine).rglob("*")) for engine in ("local", "ray")
    ]
    assert names[0] == names[1] and sum(name.suffix == ".npz" for name in names[0]) == plan.shards
    for name in names[0]:
        if (tmp_path / "local" / name).is_file():
            assert (tmp_path / "local" / name).read_bytes() == (tmp_path / "ray" / name).read_bytes(), name
    assert PressDataset(tmp_path / "ray").manifest["index"].to_pylist() == list(range(24))


@pytest.mark.slow
@pytest.mark.usefixtures("local_ray")
@pytest.mark.filterwarnings("ignore:the worker of shard")
def test_a_shard_that_kills_every_worker_is_named_after_all_others(sweep: SweepSpec) -> None:
    class Killer(DatasetPlan):
        def presses(self, shard: int) -> Presses:
            if shard == 1:
                os._exit(1)
            return super().presses(shard)

    results = render_on_ray(RenderJob(Killer(replace(sweep, count=16)), "cpu", batch=4), range(4), workers=2)
    found: list[int] = []
    with pytest.raises(BackendError, match=r"shards \[1\]: their workers died 3 times"):
        found.extend(result.shard for result in results)
    assert sorted(found) == [0, 2, 3]


@pytest.mark.slow
@pytest.mark.usefixtures("local_ray")
@pytest.mark.filterwarnings("ignore:the worker of shard")
def test_a_worker_that_dies_each_time_it_comes_back_is_given_up(
    sweep: SweepSpec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ray_cluster, "_LONGEST_START", 5.0)
    deaths = tmp_path / "deaths"

    def die() -> None:
        with deaths.open("a", encoding="utf-8") as file:
            file.write("x")
        os._exit(1)

    class Killer(DatasetPlan):
        def presses(self, shard: int) -> Presses:
            die()
            return super().presses(shard)

        def variant(self, shard: int) -> tuple[int, int]:
            if deaths.exists():
                die()
            return super().variant(shard)

    with pytest.raises(BackendError, match="no worker is left"):
        list(render_on_ray(RenderJob(Killer(replace(sweep, count=8)), "cpu", batch=4), range(2), workers=1))
    # One as it rendered, the others as it prepared; Ray counts restarts as retries too, and a busy machine is waited for.
    assert 3 <= len(deaths.read_text("utf-8")) <= 12


@pytest.mark.usefixtures("local_ray")
def test_what_cannot_be_rendered_is_said_before_a_shard_begins(sweep: SweepSpec) -> None:
    plan = DatasetPlan(sweep)
    with pytest.raises(BackendError, match="no GPU"):
        next(render_on_ray(RenderJob(plan, "cuda"), [0]))
    with pytest.raises(InputError, match="workers = 0"):
        next(render_on_ray(RenderJob(plan, "cpu"), [0], workers=0))
