"""A data set that is killed, damaged or extended by mistake: only what is missing is rendered, and nothing is mixed."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pyarrow.parquet as pq
import pytest

from raytac.dataset import DatasetPlan, RunReport, ShardRenderer, ShardResult, render_dataset, verify_dataset
from raytac.errors import BackendError, InputError
from raytac.specs import SweepSpec
from tests.dataset.conftest import interrupted_at


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


def test_more_presses_are_added_to_a_data_set_and_fewer_are_refused(
    sweep: SweepSpec, folder: Path, whole: dict[str, bytes], tmp_path: Path
) -> None:
    """As if all had been rendered in one go; only the last shard, which was not full, is rendered again."""
    longer = DatasetPlan(replace(light(sweep), count=14))
    rendered(longer, tmp_path / "at_once")
    before = (folder / "shards/000001.npz").stat().st_mtime_ns
    told: list[str] = []
    report = rendered(longer, folder, told)
    assert report.rendered == 2 and report.presses == 6 and (folder / "shards/000001.npz").stat().st_mtime_ns == before
    assert contents(folder) == contents(tmp_path / "at_once")
    assert "000002 has 2 of 4 presses: rendered again" in told and verify_dataset(folder).wrong == {}
    with pytest.raises(
        InputError, match="14 presses, 14 of them rendered, and cannot shrink to the 10 asked for: choose another folder"
    ):
        rendered(DatasetPlan(light(sweep)), folder)
    assert contents(folder) == contents(tmp_path / "at_once")
    with pytest.raises(InputError, match="differs in count, seed: choose another folder"):
        rendered(DatasetPlan(replace(light(sweep), count=20, seed=6)), folder)


def test_an_addition_that_is_killed_goes_on(
    sweep: SweepSpec, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    longer = DatasetPlan(replace(light(sweep), count=14))
    rendered(longer, tmp_path / "at_once")
    with monkeypatch.context() as patch:
        patch.setattr("raytac.dataset.run.write_description", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            rendered(longer, folder)
    assert json.loads((folder / "dataset.json").read_text())["presses"] == 10
    with interrupted_at(3), pytest.raises(KeyboardInterrupt):
        rendered(longer, folder)
    said = json.loads((folder / "dataset.json").read_text())
    assert said["presses"] == 14 and not said["complete"] and set(verify_dataset(folder).wrong) == {3}
    with pytest.raises(
        InputError, match="is a data set of 14 presses, 12 of them rendered, and cannot shrink to the 10 asked for"
    ):
        rendered(DatasetPlan(light(sweep)), folder)
    assert rendered(longer, folder).rendered == 1 and contents(folder) == contents(tmp_path / "at_once")


@pytest.mark.parametrize("stop", [KeyboardInterrupt(), BackendError("there is no CUDA device")])
def test_an_addition_that_ends_before_its_first_new_shard_leaves_the_data_set_as_it_is(
    sweep: SweepSpec,
    plan: DatasetPlan,
    folder: Path,
    whole: dict[str, bytes],
    monkeypatch: pytest.MonkeyPatch,
    stop: BaseException,
) -> None:
    """Thus a count that was mistyped can be taken back."""

    def stopped(renderer: ShardRenderer, shard: int) -> ShardResult:
        raise stop

    with monkeypatch.context() as patch:
        patch.setattr(ShardRenderer, "render", stopped)
        with pytest.raises(type(stop)):
            rendered(DatasetPlan(replace(light(sweep), count=100_000)), folder)
    assert contents(folder) == whole and verify_dataset(folder).wrong == {}
    assert rendered(plan, folder).rendered == 0 and contents(folder) == whole


def test_a_disk_without_room_for_more_presses_leaves_the_data_set_as_it_is(
    sweep: SweepSpec, folder: Path, whole: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("raytac.dataset.run.shutil.disk_usage", lambda folder: SimpleNamespace(free=1000))
    with pytest.raises(InputError, match="GB free"):
        rendered(DatasetPlan(replace(light(sweep), count=14)), folder)
    assert contents(folder) == whole


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
        ({"batch": True}, "batch = True"),
        ({"engine": ["local"]}, "engine = "),
        ({"workers": 2}, "engine='ray'"),
    ):
        with pytest.raises(InputError, match=message):
            render_dataset(plan, tmp_path / "other", **options)  # type: ignore[arg-type]
    assert not (tmp_path / "other").exists()
    with pytest.raises(InputError, match=r"dataset\.json"):
        verify_dataset(tmp_path / "nowhere")


def test_a_count_beyond_any_disk_is_told_at_once_and_leaves_nothing(
    sweep: SweepSpec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a look at every one of its 250 million shards."""
    huge = DatasetPlan(replace(light(sweep), count=10**9))
    looked: list[int] = []
    monkeypatch.setattr(DatasetPlan, "shard_bytes", lambda plan, shard: looked.append(shard))
    monkeypatch.setattr("raytac.dataset.shard.ShardStore.read", lambda store, shard: looked.append(shard))
    monkeypatch.setattr("raytac.dataset.run.shutil.disk_usage", lambda folder: SimpleNamespace(free=10**12))
    with pytest.raises(InputError, match=r"1e\+03 GB free, and the data set takes about"):
        rendered(huge, tmp_path / "data")
    assert not looked and not (tmp_path / "data").exists()


def test_a_refusal_does_not_block_the_corrected_command(
    sweep: SweepSpec, plan: DatasetPlan, tmp_path: Path, whole: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(renderer: ShardRenderer, shard: int) -> ShardResult:
        raise BackendError("the renderer does not work here")

    out = tmp_path / "data"
    other = DatasetPlan(replace(light(sweep), seed=6))
    with monkeypatch.context() as patch:
        patch.setattr(ShardRenderer, "render", broken)
        with pytest.raises(BackendError):
            rendered(other, out)
    assert not out.exists()
    (out / "shards").mkdir(parents=True)  # as a run leaves it that ends between its description and its first shard
    (out / "dataset.json").write_text(json.dumps({"format_version": 1, "plan_sha256": other.digest, "plan": other.description}))
    rendered(plan, out)
    assert contents(out) == whole


def test_a_lock_that_is_a_link_is_not_followed(plan: DatasetPlan, tmp_path: Path) -> None:
    (tmp_path / "precious").write_text("mine")
    (tmp_path / "data").mkdir()
    (tmp_path / "data/.lock").symlink_to(tmp_path / "precious")
    with pytest.raises(InputError, match="and no link: it is the lock"):
        rendered(plan, tmp_path / "data")
    assert (tmp_path / "precious").read_text() == "mine"


def test_a_disk_that_fills_up_ends_in_a_sentence_and_can_be_gone_on_with(
    plan: DatasetPlan, tmp_path: Path, whole: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    fsync, calls = os.fsync, []

    def full(handle: int) -> None:
        calls.append(handle)
        if len(calls) > 10:  # README, description and the first shard with their folders take 8
            raise OSError(28, "No space left on device")
        fsync(handle)

    with monkeypatch.context() as patch:
        patch.setattr("raytac.io.atomic.os.fsync", full)
        with pytest.raises(InputError, match=r"No space left on device.*the same command goes on"):
            rendered(plan, tmp_path / "data")
    assert not [name for name in contents(tmp_path / "data") if name.endswith(".partial")]
    assert verify_dataset(tmp_path / "data").wrong == {1: "missing", 2: "missing"}
    assert rendered(plan, tmp_path / "data").rendered == 2 and contents(tmp_path / "data") == whole


@pytest.mark.parametrize("text", ["", "{", "[]", "[" * 100_000, '{"format_version": 1}', None])
def test_damage_to_the_description_is_told(plan: DatasetPlan, folder: Path, whole: dict[str, bytes], text: str | None) -> None:
    (folder / "dataset.json").unlink()
    if text is not None:
        (folder / "dataset.json").write_text(text)
    with pytest.raises(InputError, match=r"dataset\.json"):
        rendered(plan, folder)
    assert {name: data for name, data in contents(folder).items() if name != "dataset.json"} == {
        name: data for name, data in whole.items() if name != "dataset.json"
    }


def test_shards_that_agree_with_their_checksum_and_are_none_are_rendered_again(
    plan: DatasetPlan, folder: Path, whole: dict[str, bytes]
) -> None:
    def forged(**changed: Any) -> str:
        kept = json.loads(whole["shards/000001.json"]) | changed
        kept["rows_sha256"] = hashlib.sha256(json.dumps(kept["rows"], sort_keys=True).encode()).hexdigest()
        return json.dumps(kept)

    path = folder / "shards/000001.json"
    for text in ("", "[" * 100_000, "5", forged(rows=5), forged(rows=[{}]), forged(file="../x.npz"), forged(made_by={})):
        path.write_text(text)
        assert verify_dataset(folder).wrong[1].startswith("000001.json cannot be read")
    path.unlink()
    os.mkfifo(path)
    assert verify_dataset(folder).wrong == {1: "000001.json cannot be read (OSError)"}
    assert rendered(plan, folder).rendered == 1 and contents(folder) == whole


def test_shards_that_are_no_folder_are_told(plan: DatasetPlan, tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / "data/shards").write_text("")
    with pytest.raises(InputError, match=r"shards: must be a folder"):
        rendered(plan, tmp_path / "data")


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
        assert process.stdout is not None and any(line == "written 0\n" for line in process.stdout)
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
