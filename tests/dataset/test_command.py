"""``raytac dataset``: what it is given goes before the sweep's file; it resumes and verifies."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import numpy as np
import pytest

from raytac.cli import main
from raytac.dataset import PressDataset
from raytac.io.images import read_png
from raytac.io.metrics import read_metrics
from tests.dataset.conftest import interrupted_at

SWEEP = """
objects = ["sphere"]
count = 100
optics = "phong"
pitch_mm = 0.4
[press]
depth_mm = [0.2, 0.8]
"""


def test_render_resume_and_verify(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "small.toml").write_text(SWEEP)
    asked = ["dataset", str(tmp_path / "small.toml"), "--out", str(tmp_path / "data"), "--device", "cpu"]
    small = ["--count", "3", "--shard-size", "2", "--seed", "9", "--outputs", "height", "--batch", "2", "--sheet", "3"]
    assert main([*asked, *small]) == 0
    data = PressDataset(tmp_path / "data")
    assert len(data) == 3 and set(data[0]) == {"index", "height", "pad_from_object", "object", "label"}
    assert data.description["plan"]["seed"] == 9
    assert read_png(tmp_path / "data/sheet.png").shape[2] == 3
    metrics = read_metrics(tmp_path / "data/metrics.json")
    assert metrics["presses"] == 3 and metrics["rendered.shards"] == 2 and isinstance(metrics["presses_per_s"], float)
    (tmp_path / "data/shards/000001.npz").unlink()
    capsys.readouterr()
    assert main([*asked, "--verify"]) == 2
    said = capsys.readouterr()
    assert "shard 1: 000001.npz is missing" in said.out and "1 of 2 shards" in said.err
    assert main([*asked, *small]) == 0
    assert "raytac: 1 of 2 shards are there and whole" in capsys.readouterr().err
    assert read_metrics(tmp_path / "data/metrics.json")["rendered.shards"] == 1
    assert main([*asked, "--verify"]) == 0
    assert "2 shards are whole" in capsys.readouterr().out


def test_an_interrupted_run_says_what_it_leaves(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "small.toml").write_text(SWEEP)
    asked = ["dataset", str(tmp_path / "small.toml"), "--out", str(tmp_path / "data"), "--device", "cpu"]
    small = ["--count", "3", "--shard-size", "2", "--outputs", "height"]
    with interrupted_at(1):
        assert main([*asked, *small]) == 130
    assert "raytac: interrupted; shards that are finished are kept in" in capsys.readouterr().err
    assert main([*asked, *small]) == 0
    assert "raytac: 1 of 2 shards are there and whole" in capsys.readouterr().err


@pytest.mark.parametrize(("kind", "name"), [("hdf5", "presses.h5"), ("zarr", "presses.zarr"), ("lerobot", "lerobot")])
def test_exports_lie_beside_the_shards(kind: str, name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "small.toml").write_text(SWEEP.replace("pitch_mm", "frames_per_stage = 2\npitch_mm"))
    out = tmp_path / "data"
    asked = [
        "dataset",
        str(tmp_path / "small.toml"),
        "--out",
        str(out),
        "--device",
        "cpu",
        "--outputs",
        "height,wrench",
        "--count",
        "2",
    ]
    assert main([*asked, "--export", kind, *(["--fps", "5"] if kind == "lerobot" else [])]) == 0
    assert str(out / name) in capsys.readouterr().out
    height = PressDataset(out)[1]["height"]
    if kind == "lerobot":
        import pyarrow.parquet as pq

        table = pq.read_table(out / name / "data/chunk-000/file-000.parquet").to_pydict()
        assert table["episode_index"][-1] == 1 and table["timestamp"][1] == pytest.approx(0.2)
        np.testing.assert_allclose(table["observation.height"][-1], height[-1])
    elif kind == "hdf5":
        import h5py

        with h5py.File(out / name) as file:
            np.testing.assert_array_equal(np.asarray(file["height"])[1], height)
    else:
        import zarr

        np.testing.assert_array_equal(zarr.open_array(str(out / name), path="height")[1], height)
    assert main([*asked, "--export", kind]) == 2  # it is there already
    assert "nothing is replaced" in capsys.readouterr().err


def test_what_cannot_be_exported_is_refused_before_rendering(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "small.toml").write_text(SWEEP)
    asked = ["dataset", str(tmp_path / "small.toml"), "--out", str(tmp_path / "data"), "--device", "cpu", "--count", "2"]
    for options, text in (
        (["--export", "lerobot"], "give it frames_per_stage"),
        (["--export", "csv"], "did you mean|choose from"),
        (["--export", "lerobot", "--fps", "0"], "fps = 0"),
        (["--export", "hdf5", "--fps", "5"], "fps = 5.* belongs to --export lerobot"),
        (["--fps", "5"], "fps = 5.* belongs to --export lerobot"),
    ):
        assert main([*asked, *options]) == 2
        assert re.search(text, capsys.readouterr().err)
    known = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *rest: None if name == "zarr" else known(name, *rest))
    assert main([*asked, "--export", "zarr"]) == 2
    assert "pip install 'raytac[export]'" in capsys.readouterr().err
    assert not (tmp_path / "data").exists()


def test_a_sweep_is_asked_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["dataset", "--out", str(tmp_path / "data")]) == 2
    assert "sweep: must be given" in (said := capsys.readouterr().err) and "demo" in said
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--count", "0"], "count = 0"),
        (["--seed", "-1"], "seed = -1"),
        (["--sheet", "-3"], "sheet = -3"),
        (["--sheet", "3", "--outputs", "wrench"], "sheet = 3"),
        (["--resolution", "32"], "resolution = '32'"),
        (["--optics", "x"], "optics = 'x'"),
    ],
)
def test_bad_options_are_told(options: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "small.toml").write_text(SWEEP)
    assert main(["dataset", str(tmp_path / "small.toml"), "--out", str(tmp_path / "data"), *options]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "data").exists()
