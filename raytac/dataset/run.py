"""Render a data set into a folder: the shards that are missing or damaged, on any engine."""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from raytac.checks import check_known, check_whole
from raytac.dataset.describe import FILE, describe, read_description, write_description
from raytac.dataset.manifest import FILE as MANIFEST
from raytac.dataset.manifest import check_pyarrow, write_manifest
from raytac.dataset.plan import DatasetPlan
from raytac.dataset.ray_cluster import render_on_ray
from raytac.dataset.renderer import RenderJob, ShardRenderer, ShardResult
from raytac.dataset.shard import FOLDER, ShardRecord, ShardStore, sha256_of
from raytac.errors import InputError
from raytac.io.folder import FolderLock
from raytac.io.progress import Progress

_SPARE = 1.05
"""The estimated size must fit this many times on the disk."""


@dataclass(frozen=True)
class RunReport:
    """Result of a run."""

    folder: Path
    rendered: int
    """Shards that this run rendered; the others were there."""
    presses: int
    """Presses in these."""
    failed: int
    """Presses of the whole data set that failed."""
    render_s: float
    """Time from the first shard's start to the last one's end [s], with what workers load first."""
    steady_presses_per_s: float | None
    """Presses a second after the first shard, when all is loaded; None for one shard."""
    device: str


@dataclass(frozen=True)
class Check:
    """Result of ``verify_dataset``."""

    shards: int
    wrong: dict[int, str]
    """Shards that are not whole, with what is wrong."""


def render_dataset(
    plan: DatasetPlan,
    folder: Path,
    *,
    engine: str = "local",
    device: str = "auto",
    batch: int = 16,
    workers: int | None = None,
    address: str | None = None,
    compress: bool = False,
    progress: bool = False,
    say: Callable[[str], object] = lambda text: None,
) -> RunReport:
    """Render the shards that ``folder`` lacks, and write manifest and description.

    Shards that are there are read and compared with their checksums; those that are whole stay. A run that is killed leaves whole
    shards only, and the same call goes on with the others. A plan that differs only in a greater number of presses adds to the folder;
    a last shard that was not full is rendered again. Until its first new shard is rendered, the folder stays as it is.

    Args:
        folder: of the data set; made if need be.
        engine: one of ``ENGINES``: ``local``, in this process, or ``ray``.
        device: ``auto``, ``cpu`` or ``cuda``.
        batch: presses that are computed at once.
        workers, address: of Ray, see ``render_on_ray``.
        compress: deflate the arrays; they then cannot be mapped into memory.
        progress: a bar of presses on standard error, if that is a terminal.
        say: called with one line at a time about what is done.

    Raises:
        InputError: a bad argument, a folder with another data set or in use by another run, or a disk without room enough.
        BackendError: pyarrow, Ray, a renderer or a solver is missing or does not work.
    """
    check_known("engine", engine, ENGINES)
    batch = check_whole("batch", batch)
    if engine == "local" and (workers is not None or address is not None):
        raise InputError("workers, address", value=(workers, address), rule="are settings of engine='ray'")
    check_pyarrow()
    folder = Path(folder)
    with FolderLock(folder):
        store = ShardStore(folder, plan.digest, compress=compress)
        store.shorter = _check_same(folder, plan)
        with _write_errors(folder):
            store.clear_partial()
        records = _whole(plan, store, progress, say)
        _check_room(folder, plan, records, say)
        missing = [shard for shard in range(plan.shards) if shard not in records]
        job = RenderJob(plan, device, batch)
        start, done, first = time.perf_counter(), 0, None
        if missing:
            on_ray = engine == "ray"
            results = render_on_ray(job, missing, workers=workers, address=address) if on_ray else render_here(job, missing)
            total = sum(len(record.rows) for record in records.values())
            with Progress(desc="render", total=plan.sweep.count, initial=total, unit="press", show=progress) as bar:
                for result in results:
                    with _write_errors(folder):
                        if first is None:
                            # Not before something is rendered: a refusal leaves nothing at which a corrected command would stop.
                            _begin(folder, plan, store, records)
                        records[result.shard] = store.write(result)
                    done += len(result.rows)
                    first = first or (time.perf_counter(), done)
                    bar.update(len(result.rows))
        took = time.perf_counter() - start
        whole = _ordered(records)
        with _write_errors(folder):
            write_description(folder, describe(plan, whole, write_manifest(folder, whole)))
    failed = sum(row["status"] == "failed" for record in whole for row in record.rows)
    steady = (done - first[1]) / (start + took - first[0]) if first is not None and done > first[1] else None
    return RunReport(folder, len(missing), done, failed, took, steady, str(whole[-1].made_by["device"]))


def verify_dataset(folder: Path, *, progress: bool = False) -> Check:
    """Compare every file of a data set with its checksum; needs no plan and changes nothing.

    Raises ``InputError``: no data set, or one whose manifest differs from its checksum.
    """
    description = read_description(folder)
    manifest = Path(folder) / MANIFEST
    if description["complete"] and (not manifest.is_file() or sha256_of(manifest) != description["manifest_sha256"]):
        raise InputError("data set", value=manifest, rule="is missing or differs from its checksum: render again to repair it")
    store = ShardStore(folder, description["plan_sha256"])
    wrong = {}
    for shard in Progress(range(description["shards"]), desc="verify", unit="shard", show=progress, leave=False):
        record = store.read(shard)
        if isinstance(record, str):
            wrong[shard] = record
    return Check(description["shards"], wrong)


def _whole(plan: DatasetPlan, store: ShardStore, progress: bool, say: Callable[[str], object]) -> dict[int, ShardRecord]:
    """Records of the shards that are there and whole."""
    records = {}
    for shard in Progress(store.present(), desc="check", unit="shard", show=progress, leave=False):
        record = store.read(shard)
        if isinstance(record, str):
            say(f"{record}: rendered again")
        elif len(record.rows) < plan.shard_presses(shard):  # the last one of fewer presses
            say(f"{shard:06d} has {len(record.rows)} of {plan.shard_presses(shard)} presses: rendered again")
        else:
            records[shard] = record
    return records


def _begin(folder: Path, plan: DatasetPlan, store: ShardStore, records: dict[int, ShardRecord]) -> None:
    """Describe a data set as not complete, before its first new shard is written.

    Whole shards of fewer presses become its own before that: a run that is killed in between goes on, as shards of either plan are read.
    """
    if store.shorter is not None:
        for record in records.values():
            store.stamp(record)
    write_description(folder, describe(plan, _ordered(records), None))


def _ordered(records: dict[int, ShardRecord]) -> list[ShardRecord]:
    return [records[shard] for shard in sorted(records)]


def _check_same(folder: Path, plan: DatasetPlan) -> str | None:
    """Refuse a folder with shards of another plan; a description alone is of an empty run.

    Returns the digest of the folder's plan if it differs only in fewer presses.
    """
    shards = folder / FOLDER
    if os.path.lexists(shards) and not shards.is_dir():
        raise InputError("out", value=shards, rule="must be a folder, or not exist")
    if not shards.is_dir() or not any(shards.iterdir()):
        return None
    if not (folder / FILE).is_file():
        raise InputError("out", value=folder, rule=f"holds shards without a {FILE}: choose another folder")
    description = read_description(folder)
    if description["plan_sha256"] == plan.digest:
        return None
    old, new = description["plan"], plan.description
    changed = [key for key in {**old, **new} if json.dumps(old.get(key)) != json.dumps(new.get(key))]
    if changed == ["count"] and type(old.get("count")) is int:
        if old["count"] < new["count"]:
            return description["plan_sha256"]
        there = ShardStore(folder, description["plan_sha256"]).presses()
        rule = f"is a data set of {old['count']} presses, {there} of them rendered, and cannot shrink to the {new['count']} asked for"
        rule += ": choose another folder, or remove it"
        raise InputError("out", value=folder, rule=rule)
    differs = ", ".join(changed) or "its version"
    rule = f"holds another data set, which differs in {differs}: choose another folder, or remove it"
    raise InputError("out", value=folder, rule=rule)


def _check_room(folder: Path, plan: DatasetPlan, records: dict[int, ShardRecord], say: Callable[[str], object]) -> None:
    """Compare the size of missing shards with the free disk, as if nothing were compressed."""
    need, free, missing = plan.total_bytes(without=records), shutil.disk_usage(folder).free, plan.shards - len(records)
    if records:
        say(f"{len(records)} of {plan.shards} shards are there and whole")
    if missing:
        say(f"{missing} of {plan.shards} shards to render: about {need / 1e9:.3g} GB, {free / 1e9:.3g} GB free")
    if need * _SPARE > free:
        rule = f"has {free / 1e9:.3g} GB free, and the data set takes about {need / 1e9:.3g} GB"
        raise InputError("out", value=folder, rule=rule)


@contextmanager
def _write_errors(folder: Path) -> Iterator[None]:
    """Say in a sentence that the folder cannot be written, as where the disk becomes full."""
    try:
        yield
    except OSError as error:
        rule = f"cannot be written ({error.strerror}): shards that are done stay, and the same command goes on with the others"
        raise InputError("out", value=folder, rule=rule) from error


ENGINES = ("local", "ray")
"""Names that ``engine=`` accepts."""


def render_here(job: RenderJob, shards: Sequence[int]) -> Iterator[ShardResult]:
    """Render shards one after the other in this process."""
    renderer = ShardRenderer(job)
    for shard in shards:
        yield renderer.render(shard)
