"""The loader gives the presses that the shards hold, mapped or read, and goes through pickling as loaders with processes need."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from raytac.dataset import DatasetPlan, PressDataset, contact_sheet, render_dataset
from raytac.dataset.loader import open_shard
from raytac.dataset.shard import npz_bytes
from raytac.dataset.sheet import contact_figure
from raytac.errors import InputError
from raytac.specs import SweepSpec, load_sensor


@pytest.fixture(scope="module")
def folders(sweep: SweepSpec, tmp_path_factory: pytest.TempPathFactory) -> dict[bool, Path]:
    """A data set of two sensors, and the same compressed."""
    two = replace(
        sweep,
        sensors=(sweep.sensors[0], load_sensor("gelsight_mini")),
        outputs=("height", "contact", "wrench"),
        markers=None,
        randomization={},
        marker_perturbation={},
    )
    made = {}
    for compress in (False, True):
        made[compress] = tmp_path_factory.mktemp("data") / "data"
        render_dataset(DatasetPlan(two), made[compress], device="cpu", batch=4, compress=compress)
    return made


@pytest.mark.parametrize("compress", [False, True])
def test_presses_are_those_of_the_shards(folders: dict[bool, Path], compress: bool) -> None:
    data = PressDataset(folders[compress])
    assert len(data) == 10 and data.manifest["index"].to_pylist() == list(range(10))
    with np.load(folders[compress] / "shards/000001.npz") as shard:
        assert set(data[4]) == set(shard.files) - {"grid_x", "grid_y", "rest_height"}
        for i in range(4, 8):
            for name, values in data[i].items():
                np.testing.assert_array_equal(values, shard[name][i - 4])
        np.testing.assert_array_equal(data.shared(5)["rest_height"], shard["rest_height"])
    assert data[-1]["index"] == 9
    with pytest.raises(IndexError):
        data[10]


def test_names_columns_and_sensors_are_chosen(folders: dict[bool, Path]) -> None:
    data = PressDataset(folders[False], ("height", "press_depth", "force_z"), sensor="gelsight_mini")
    assert len(data) == 4 and set(data.manifest["sensor"].to_pylist()) == {"gelsight_mini"}
    press = data[0]
    assert list(press) == ["height", "press_depth", "force_z"]
    assert 0.3e-3 <= press["press_depth"] <= 0.9e-3 and press["force_z"] < 0.0
    press["height"][:] = 0  # a copy of one's own
    assert data[0]["height"].any()
    with pytest.raises(InputError, match=r"names = 'heigt'.*did you mean 'height'"):
        PressDataset(folders[False], ("heigt",))
    with pytest.raises(InputError, match="gelsight_mini_9x11"):
        PressDataset(folders[False], sensor="digit")


def test_a_copy_in_another_process_opens_its_own_files(folders: dict[bool, Path]) -> None:
    data = PressDataset(folders[False])
    before = data[3]
    copy = pickle.loads(pickle.dumps(data))
    assert len(pickle.dumps(data)) < 100_000
    np.testing.assert_array_equal(copy[3]["height"], before["height"])


def test_a_mapped_shard_is_what_numpy_reads(tmp_path: Path) -> None:
    arrays = {
        "a": np.arange(24, dtype=np.float32).reshape(2, 3, 4),
        "b": np.array([True, False]),
        "c": np.zeros((0, 5)),
        "d": np.float64(3.0).reshape(()),
    }
    (tmp_path / "x.npz").write_bytes(npz_bytes(arrays))
    found, mapped = open_shard(tmp_path / "x.npz")
    assert mapped and npz_bytes(arrays) == npz_bytes(arrays)
    with np.load(tmp_path / "x.npz", allow_pickle=False) as read:
        for name, values in arrays.items():
            np.testing.assert_array_equal(found[name], values)
            np.testing.assert_array_equal(read[name], values)
            assert found[name].dtype == values.dtype


def test_a_contact_sheet_says_what_each_press_is_and_how_deep_with_a_scale(folders: dict[bool, Path]) -> None:
    data = PressDataset(folders[False])
    figure = contact_figure(data, 5, columns=3)
    drawn = [axis for axis in figure.axes if axis.images]
    assert len(drawn) == 5
    (scale,) = [axis for axis in figure.axes if axis.get_ylabel() == "indentation [mm]"]
    dents = [1e3 * (data.shared(i)["rest_height"] - data[i]["height"]) for i in range(5)]
    for i, axis in enumerate(drawn):
        depth = data.manifest["press_depth"][i].as_py()
        assert axis.get_title() == f"{i}: {data.manifest['object'][i].as_py()}, {1e3 * depth:.2f} mm"
        (image,) = axis.images
        np.testing.assert_allclose(np.asarray(image.get_array()), dents[i], atol=1e-4)
        assert image.get_clim() == pytest.approx((0.0, max(dent.max() for dent in dents)), abs=1e-4)  # nothing is clipped
        (bar,) = axis.lines
        left, right = image.get_extent()[:2]
        assert np.ptp(bar.get_xdata()) == pytest.approx(5.0)  # of the pad's own millimetres
        assert right - left == pytest.approx(1e3 * np.ptp(data.shared(i)["grid_x"]))
        assert axis.texts[0].get_text() == "5 mm"
    assert scale.get_ylim()[1] == pytest.approx(drawn[0].images[0].get_clim()[1])
    sheet = contact_sheet(data, 5, columns=3)
    assert sheet.dtype == np.uint8 and sheet.ndim == 3 and len(np.unique(sheet.reshape(-1, 3), axis=0)) > 50
    with pytest.raises(InputError, match="columns = 0"):
        contact_sheet(data, columns=0)
