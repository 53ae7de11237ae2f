"""Exports hold what the data set does: HDF5 read back by h5py alone, Zarr by zarr alone."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from raytac.dataset import DatasetPlan, Episode, PressDataset, press_episodes, render_dataset, write_hdf5, write_zarr
from raytac.errors import InputError
from raytac.specs import SweepSpec, load_sensor

Opener = Callable[[Path], Any]
KINDS = {"hdf5": ("h5py", write_hdf5), "zarr": ("zarr", write_zarr)}


@pytest.fixture(scope="module")
def folder(sweep: SweepSpec, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Videos of two frames, of two sensors whose maps have the same shape."""
    two = replace(sweep, sensors=(sweep.sensors[0], load_sensor("gelsight_mini")), markers=None, marker_perturbation={})
    made = tmp_path_factory.mktemp("data") / "data"
    render_dataset(DatasetPlan(replace(two, frames_per_stage=1)), made, device="cpu", batch=4)
    return made


@pytest.fixture(params=sorted(KINDS))
def kind(request: pytest.FixtureRequest) -> tuple[Callable[..., Path], Opener]:
    """Writer of a format, and a reader that is not this project's."""
    package, write = KINDS[request.param]
    reader = pytest.importorskip(package)
    if package == "h5py":
        return write, lambda path: reader.File(path, "r")
    return write, lambda path: reader.open_group(path, mode="r")


def texts(array: Any) -> list[str]:
    return [value.decode() if isinstance(value, bytes) else str(value) for value in array[:]]


@pytest.mark.parametrize("compress", [True, False])
def test_presses_are_read_back(kind: tuple[Callable[..., Path], Opener], folder: Path, tmp_path: Path, compress: bool) -> None:
    write, opened = kind
    data = PressDataset(folder)
    root = opened(write(tmp_path / "presses", data, compress=compress))
    assert list(root.attrs["classes"]) == list(data.classes) == ["sphere", "edge"]
    text = root["description"][()]
    assert json.loads(text if isinstance(text, bytes | str) else str(text)) == data.description
    names = set(data[0])
    assert names > {"rgb", "height", "contact", "wrench", "travel", "object", "label"}
    assert set(root) == names | {"description", "grid_x", "grid_y"}
    for name in names - {"object"}:
        expected = np.stack([press[name] for press in data])  # type: ignore[attr-defined]
        assert root[name].dtype == expected.dtype
        np.testing.assert_array_equal(root[name][:], expected)
    assert texts(root["object"]) == data.manifest["object"].to_pylist()
    assert root["height"].attrs["unit"] == "m" and "deformed coat" in root["height"].attrs["meaning"]
    np.testing.assert_array_equal(root["grid_x"][:], data.shared(0)["grid_x"])
    assert root["rgb"].shape[:2] == (10, 3)


def test_chunks_follow_the_size_of_a_press(kind: tuple[Callable[..., Path], Opener], folder: Path, tmp_path: Path) -> None:
    write, opened = kind
    root = opened(write(tmp_path / "presses", PressDataset(folder, ("height", "press_depth"), sensor="gelsight_mini")))
    height = root["height"]
    assert height.chunks[1:] == height.shape[1:] and 1 <= height.chunks[0] <= height.shape[0]
    assert set(root) == {"height", "press_depth", "description", "grid_x", "grid_y"}
    assert height.shape[0] == 4 and root["press_depth"].chunks == (4,)


def half(sample: dict[str, Any]) -> dict[str, Any]:
    return {"label": sample["label"], "half": sample["height"] / 2.0}


def test_what_a_transform_makes_is_exported(kind: tuple[Callable[..., Path], Opener], folder: Path, tmp_path: Path) -> None:
    write, opened = kind
    plain = PressDataset(folder)
    root = opened(write(tmp_path / "presses", PressDataset(folder, transform=half)))
    assert set(root) == {"label", "half", "description"} and root["half"].attrs["unit"] == ""
    np.testing.assert_array_equal(root["half"][3], plain[3]["height"] / 2.0)


def test_episodes_are_read_back_one_group_each(kind: tuple[Callable[..., Path], Opener], folder: Path, tmp_path: Path) -> None:
    write, opened = kind
    data = PressDataset(folder)
    episodes = list(press_episodes(data, fps=20.0))
    root = opened(write(tmp_path / "episodes", iter(episodes)))["episodes"]
    assert sorted(root) == [f"{k:06d}" for k in range(10)]
    for k, episode in enumerate(episodes):
        group = root[f"{k:06d}"]
        assert set(group) == {*episode.arrays, "time"} and len(episode) == 3
        for name, values in episode.arrays.items():
            np.testing.assert_array_equal(group[name][:], values)
        np.testing.assert_allclose(group["time"][:], [0.0, 0.05, 0.1])
        facts = dict(group.attrs)
        assert facts["object"] == data[k]["object"] and facts["label"] == data[k]["label"] and facts["fps"] == 20.0
        assert facts["task"] == f"press the {data[k]['object']} into {facts['sensor']}" and facts["press"] == k


def test_what_cannot_be_exported_leaves_nothing(
    kind: tuple[Callable[..., Path], Opener], folder: Path, sweep: SweepSpec, tmp_path: Path
) -> None:
    write, _ = kind
    path = tmp_path / "file"
    small = replace(sweep.sensors[0], name="small", gelpad=replace(sweep.sensors[0].gelpad, size=(22e-3, 18e-3)))
    two = replace(sweep, sensors=(*sweep.sensors, small), outputs=("height",), count=6, randomization={})
    render_dataset(DatasetPlan(two), tmp_path / "two", device="cpu", batch=4)

    def stops() -> Iterator[Episode]:
        yield Episode({"x": np.zeros(3)}, 10.0)
        raise KeyboardInterrupt

    for data, message in (
        (PressDataset(tmp_path / "two"), "height of press 4 .*choose presses of one with sensor="),
        (PressDataset(folder, transform=tuple), "open it without its transform"),
        ([], "at least one episode"),
        ([{"x": np.zeros(3)}], "iterable of episodes"),
    ):
        with pytest.raises(InputError, match=message):
            write(path, data)
    with pytest.raises(KeyboardInterrupt):
        write(path, stops())
    assert not path.exists() and not list(tmp_path.glob(".*partial"))
    path.touch()
    with pytest.raises(InputError, match="must not exist"):
        write(path, [Episode({"x": np.zeros(3)}, 10.0)])
    with pytest.raises(InputError, match="folder that exists"):
        write(tmp_path / "no" / "file", [Episode({"x": np.zeros(3)}, 10.0)])
