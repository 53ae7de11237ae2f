"""A data set that is killed, damaged or extended by mistake: only what is missing is rendered, and nothing is mixed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pyarrow.parquet as pq
import pytest

from raytac.dataset import DatasetPlan, RunReport, render_dataset, verify_dataset
from raytac.errors import InputError
from raytac.specs import SweepSpec


def light(sweep: SweepSpec) -> SweepSpec:
    """Without images and markers: here it is about files."""
    return replace(sweep, outputs=("height", "wrench"), markers=None, randomization={}, marker_perturbation={})


def rendered(plan: DatasetPlan, folder: Path, told: list[str] | None = None, **options: object) -> RunReport:
    say = told.append if told is not None else lambda text: None
    return render_dataset(plan, folder, device="cpu", batch=4, say=say, **options)  # type: ignore[arg-type]


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def plan(sweep: SweepSpec) -> DatasetPlan:
    return DatasetPlan(light(sweep))


@pytest.fixture(scope="module")
def whole(plan: DatasetPlan, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Files of a data set that was rendered in one go."""
    folder = tmp_path_factory.mktemp("whole") / "data"
    rendered(plan, folder)
    return contents(folder)


@pytest.fixture
def folder(whole: dict[str, bytes], tmp_path: Path) -> Path:
    for name, data in whole.items():
        (tmp_path / "data" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "data" / name).write_bytes(data)
    return tmp_path / "data"


def test_the_manifest_has_every_press_with_units_and_where_it_is(plan: DatasetPlan, folder: Path) -> None:
    table = pq.read_table(folder / "manifest.parquet")
    assert table["index"].to_pylist() == list(range(10)) and set(table["status"].to_pylist()) == {"ok"}
    assert table["row"].to_pylist() == [0, 1, 2, 3, 0, 1, 2, 3, 0, 1]
    assert table.schema.field("force_z").metadata[b"unit"] == b"N" and table["force_z"].to_pylist()[0] < 0.0
    said = json.loads((folder / "dataset.json").read_text())
    assert said["complete"] and said["sound"] == 10 and said["plan_sha256"] == plan.digest
    assert "versions.raytac" in said["made_by"][0] and said["made_by"][0]["shards"] == 3
    assert all(str(Path.home()) not in data.decode(errors="replace") for data in contents(folder).values())
    assert "pad frame" in (folder / "README.md").read_text()
    assert verify_dataset(folder).wrong == {}


def test_only_what_is_missing_or_damaged_is_rendered_again(plan: DatasetPlan, folder: Path, whole: dict[str, bytes]) -> None:
    (folder / "shards/000000.npz").unlink()
    damaged = bytearray((folder / "shards/000001.npz").read_bytes())
    damaged[len(damaged) // 2] ^= 1
    (folder / "shards/000001.npz").write_bytes(damaged)
    (folder / "shards/.000002.npz.partial").write_bytes(b"half")
    wrong = verify_dataset(folder).wrong
    assert wrong == {0: "000000.npz is missing", 1: "000001.npz differs from its checksum"}
    before = (folder / "shards/000002.npz").stat().st_mtime_ns
    told: list[str] = []
    report = rendered(plan, folder, told)
    assert report.rendered == 2 and report.presses == 8 and (folder / "shards/000002.npz").stat().st_mtime_ns == before
    assert contents(folder) == whole
    assert any("000001.npz differs" in line for line in told) and any("1 of 3 shards are there" in line for line in told)
    rows = json.loads((folder / "shards/000002.json").read_text())
    rows["rows"][0]["force_z"] = 0.0
    (folder / "shards/000002.json").write_text(json.dumps(rows))
    assert verify_dataset(folder).wrong == {2: "000002.json differs from its checksum"}
    assert rendered(plan, folder).rendered == 1 and contents(folder) == whole
    assert rendered(plan, folder).rendered == 0 and contents(folder) == whole


def test_a_damaged_manifest_is_found_and_mended(plan: DatasetPlan, folder: Path, whole: dict[str, bytes]) -> None:
    (folder / "manifest.parquet").write_bytes(b"PAR1")
    with pytest.raises(InputError, match="differs from its checksum"):
        verify_dataset(folder)
    rendered(plan, folder)
    assert contents(folder) == whole


def test_another_sweep_does_not_mix_in(sweep: SweepSpec, folder: Path, whole: dict[str, bytes]) -> None:
    with pytest.raises(InputError, match=r"differs in seed: choose another folder"):
        rendered(DatasetPlan(replace(light(sweep), seed=6)), folder)
    assert contents(folder) == whole
    (folder / "dataset.json").unlink()
    with pytest.raises(InputError, match=r"shards without a dataset\.json"):
        rendered(DatasetPlan(light(sweep)), folder)


def test_a_full_disk_and_bad_arguments_are_told_before_anything_is_rendered(
    plan: DatasetPlan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("raytac.dataset.run.shutil.disk_usage", lambda folder: SimpleNamespace(free=100_000))
    with pytest.raises(InputError, match=r"0\.0001 GB free, and the data set takes about"):
        rendered(plan, tmp_path / "data")
    assert not (tmp_path / "data/shards").exists()
    for options, message in (
        ({"engine": "raay"}, r"engine = 'raay'.*local, ray"),
        ({"batch": 0}, "batch = 0"),
        ({"workers": 2}, "engine='ray'"),
    ):
        with pytest.raises(InputError, match=message):
            render_dataset(plan, tmp_path / "other", **options)  # type: ignore[arg-type]
    assert not (tmp_path / "other").exists()
    with pytest.raises(InputError, match=r"dataset\.json"):
        verify_dataset(tmp_path / "nowhere")


SLOW = """
import sys, time
from pathlib import Path
sys.path.insert(0, {root!r})
import raytac.dataset.run as run
from raytac.dataset import DatasetPlan
import pickle
plan = pickle.loads(Path({plan!r}).read_bytes())
write = run.ShardStore.write
def slow(store, result):
    record = write(store, result)
    print("written", result.shard, flush=True)
    time.sleep(60)
    return record
run.ShardStore.write = slow
run.render_dataset(plan, Path({out!r}), device="cpu", batch=4)
"""


def test_a_run_that_is_killed_goes_on_where_it_stopped(plan: DatasetPlan, tmp_path: Path, whole: dict[str, bytes]) -> None:
    import pickle

    out, kept = tmp_path / "data", tmp_path / "plan.pickle"
    kept.write_bytes(pickle.dumps(plan))
    code = SLOW.format(root=str(Path(__file__).parents[2]), plan=str(kept), out=str(out))
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None and process.stdout.readline() == "written 0\n"
        with pytest.raises(InputError, match="in use by another run"):
            rendered(plan, out)
    finally:
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
    assert not json.loads((out / "dataset.json").read_text())["complete"] and not (out / "manifest.parquet").exists()
    assert verify_dataset(out).wrong == {1: "missing", 2: "missing"}
    time.sleep(0.01)
    assert rendered(plan, out).rendered == 2
    assert contents(out) == whole
