"""The loader gives the presses that the shards hold, mapped or read, and goes through pickling as loaders with processes need."""

from __future__ import annotations

import hashlib
import json
import pickle
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from raytac.dataset import DatasetPlan, PressDataset, contact_sheet, render_dataset, verify_dataset
from raytac.dataset.sheet import contact_figure
from raytac.errors import InputError
from raytac.io.arrays import npz_bytes
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
        assert set(data[4]) - {"object", "label"} == set(shard.files) - {"grid_x", "grid_y", "rest_height"}
        for i in range(4, 8):
            for name, values in data[i].items():
                if name in ("object", "label"):
                    continue
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


def test_the_object_and_its_label_come_with_every_press(folders: dict[bool, Path]) -> None:
    data = PressDataset(folders[False])
    assert data.classes == ("sphere", "edge")
    objects = data.manifest["object"].to_pylist()
    assert set(objects) == set(data.classes)
    for press, name in zip(data, objects, strict=True):  # type: ignore[call-overload]
        assert press["object"] == name and data.classes[press["label"]] == name
        assert press["label"].dtype == np.int64 and press["label"].shape == ()
    one = PressDataset(folders[False], ("label", "sensor", "rest_height"), sensor="gelsight_mini")
    assert one.classes == data.classes and one[0]["sensor"] == "gelsight_mini"
    np.testing.assert_array_equal(one[0]["rest_height"], one.shared(0)["rest_height"])


def test_a_transform_has_the_last_word(folders: dict[bool, Path]) -> None:
    names = ("height", "rest_height", "label")
    data = PressDataset(folders[False], names, transform=indentation)
    made: Any = data[2]
    dent, label = made
    plain = PressDataset(folders[False], names)[2]
    np.testing.assert_array_equal(dent, plain["rest_height"] - plain["height"])
    assert label == plain["label"] and dent.max() > 0.2e-3
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(data))[2][0], dent)
    with pytest.raises(InputError, match="must be a function of a sample"):
        PressDataset(folders[False], transform="indentation")  # type: ignore[arg-type]


def indentation(sample: dict[str, Any]) -> tuple[np.ndarray, int]:
    return sample["rest_height"] - sample["height"], int(sample["label"])


def test_an_object_that_the_plan_does_not_have_is_refused(folder: Path) -> None:
    rewrite_manifest(folder, column("object", value="teapot"))
    with pytest.raises(InputError, match="'teapot': is not an object of the plan"):
        PressDataset(folder)
    assert len(PressDataset(folder, ("height",))) == 10
    rewrite_description(folder, plan={"objects": ["sphere"]})
    with pytest.raises(InputError, match=r"dataset\.json: must have the objects"):
        PressDataset(folder)


def test_a_copy_in_another_process_opens_its_own_files(folders: dict[bool, Path]) -> None:
    data = PressDataset(folders[False])
    before = data[3]
    copy = pickle.loads(pickle.dumps(data))
    assert len(pickle.dumps(data)) < 100_000
    np.testing.assert_array_equal(copy[3]["height"], before["height"])


@pytest.fixture
def folder(folders: dict[bool, Path], tmp_path: Path) -> Path:
    """A copy that may be harmed."""
    return shutil.copytree(folders[False], tmp_path / "data")


def rewrite_manifest(folder: Path, change: Callable[[pa.Table], pa.Table], *, sign: bool = True) -> None:
    """Change the manifest; with ``sign`` its checksum too, as one who means harm would."""
    path = folder / "manifest.parquet"
    pq.write_table(change(pq.read_table(path)), path)
    if sign:
        rewrite_description(folder, manifest_sha256=hashlib.sha256(path.read_bytes()).hexdigest())


def rewrite_description(folder: Path, **changed: Any) -> None:
    path = folder / "dataset.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changed))


def column(name: str, values: list[Any] | None = None, value: Any = None) -> Callable[[pa.Table], pa.Table]:
    def change(table: pa.Table) -> pa.Table:
        place, kind = table.schema.get_field_index(name), table.schema.field(name).type
        return table.set_column(place, name, pa.array(values or [value] * len(table), kind))

    return change


def test_a_damaged_shard_or_manifest_is_told_and_can_be_read_all_the_same(folder: Path) -> None:
    good = PressDataset(folder)[0]
    path = folder / "shards/000000.npz"
    whole = bytearray(path.read_bytes())
    place = whole.index(good["height"].tobytes()) + 400
    whole[place] ^= 0x01
    path.write_bytes(whole)
    data = PressDataset(folder)
    for _ in range(2):
        with pytest.raises(InputError, match=r"000000\.npz: differs from its checksum"):
            data[0]
        with pytest.raises(InputError, match=r"000000\.npz: differs from its checksum"):
            data.shared(0)
    data[4]  # another shard
    read = PressDataset(folder, verify=False)[0]
    assert (read["height"] != good["height"]).sum() == 1
    with pytest.raises(InputError, match="checksum"):
        pickle.loads(pickle.dumps(data))[0]
    rewrite_manifest(folder, column("force_z", value=0.0), sign=False)
    with pytest.raises(InputError, match=r"manifest\.parquet: differs from its checksum"):
        PressDataset(folder)
    assert len(PressDataset(folder, verify=False)) == 10


@pytest.mark.parametrize("verify", [True, False])
@pytest.mark.parametrize("data", [b"", b"PAR1", b"PAR1" * 50, bytes(range(256))])
def test_a_manifest_that_is_none_is_told(folder: Path, data: bytes, verify: bool) -> None:
    (folder / "manifest.parquet").write_bytes(data)
    with pytest.raises(InputError, match=r"manifest\.parquet"):
        PressDataset(folder, verify=verify)


def test_a_manifest_with_any_bit_flipped_is_told_or_read_within_the_shards(folder: Path) -> None:
    path = folder / "manifest.parquet"
    whole, rng = path.read_bytes(), np.random.default_rng(0)
    for _ in range(60):
        harmed = bytearray(whole)
        harmed[rng.integers(len(whole))] ^= 1 << rng.integers(8)
        path.write_bytes(harmed)
        with pytest.raises(InputError, match="checksum"):
            PressDataset(folder)


PATHS = [
    "/etc/passwd",
    "../outside.npz",
    "shards/../../outside.npz",
    "shards/000000.npz/",
    "",
    "shards/link.npz",
    "shards\\000000.npz",
    "\0",
]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        *((column("shard", value=path), "names a shard that is not in") for path in PATHS),
        (column("shard", value=None), "no empty 'shard'"),
        (column("shard", value="shards/000000.npz"), "must be of one sensor and one checksum"),
        (column("row", value=-1), "rows 0, 1"),
        (column("row", [-1, 1, 2, 3, 0, 1, 2, 3, 0, 1]), "rows 0, 1"),
        (column("row", [0, 1, 2, 10**6, 0, 1, 2, 3, 0, 1]), "rows 0, 1"),
        (column("row", [0, 1, 2, 2, 0, 1, 2, 3, 0, 1]), "rows 0, 1"),
        (column("sensor", value="other"), "is not a sensor of"),
        (lambda table: table.drop_columns(["status"]), "one column 'status'"),
        (lambda table: table.drop_columns(["row"]), "one column 'row'"),
        (lambda table: table.drop_columns(["press_depth"]), "one column 'press_depth'"),
        (lambda table: table.append_column("row", table["row"]), "Multiple matches|one column 'row'"),
        (lambda table: table.set_column(4, "row", table["row"].cast("string")), "one column 'row' of type int32"),
    ],
)
def test_a_manifest_that_leads_elsewhere_is_refused(folder: Path, change: Callable[[pa.Table], pa.Table], message: str) -> None:
    (folder.parent / "outside.npz").write_bytes((folder / "shards/000000.npz").read_bytes())
    rewrite_manifest(folder, change)
    for verify in (True, False):
        with pytest.raises(InputError, match=message):
            PressDataset(folder, verify=verify)


def test_a_link_out_of_the_folder_is_not_followed(folder: Path) -> None:
    outside = folder.parent / "outside.npz"
    (folder / "shards/000000.npz").rename(outside)
    (folder / "shards/000000.npz").symlink_to(outside)
    with pytest.raises(InputError, match="link to a file outside"):
        PressDataset(folder)[0]
    (folder / "shards").rename(folder.parent / "elsewhere")
    (folder / "shards").symlink_to(folder.parent / "elsewhere")
    with pytest.raises(InputError, match="link to a file outside"):
        PressDataset(folder)[4]


def test_a_shard_may_only_hold_what_the_description_declares(folder: Path) -> None:
    """Also where every checksum was made to agree."""
    path = folder / "shards/000000.npz"
    with np.load(path) as kept:
        arrays = dict(kept)
    secret = np.array([id(arrays)] * 4)
    for changed in (
        {"contact": secret},
        {"height": arrays["height"].astype(np.float64)},
        {"height": arrays["height"][:, :-1]},
        {"wrench": arrays["wrench"][:3]},
        {"grid_x": arrays["grid_x"][:-1]},
        {"more": secret},
    ):
        path.write_bytes(npz_bytes(arrays | changed))
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        rewrite_manifest(folder, lambda table: table)
        table = pq.read_table(folder / "manifest.parquet")
        sums = [
            digest if name.endswith("000000.npz") else old
            for name, old in zip(table["shard"].to_pylist(), table["shard_sha256"].to_pylist(), strict=True)
        ]
        rewrite_manifest(folder, column("shard_sha256", sums))
        for verify in (True, False):
            with pytest.raises(InputError, match=r"000000\.npz"):
                PressDataset(folder, verify=verify)[0]


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[]",
        "null",
        "5",
        "[" * 100_000,
        '{"format_version": 99}',
        '{"format_version": 1}',
        '{"format_version": [1]}',
        "\xff\xfe",
    ],
)
def test_a_description_that_is_none_is_told(folder: Path, text: str) -> None:
    (folder / "dataset.json").write_text(text, encoding="latin-1")
    with pytest.raises(InputError, match="data set"):
        PressDataset(folder)
    with pytest.raises(InputError, match="data set"):
        verify_dataset(folder)


@pytest.mark.parametrize(
    "changed",
    [
        {"arrays": []},
        {"arrays": {"height": {"dtype": "|O", "shape": ["N"]}}},
        {"arrays": {"height": {"dtype": ["float32"], "shape": ["N"]}}},
        {"arrays": {"height": {"dtype": "float32", "shape": "N"}}},
        {"arrays": {"height": {"dtype": "float32", "shape": [-1]}}},
        {"arrays": {"height": 5}},
        {"arrays_of_a_shard": {"grid_x": {"dtype": "float64"}}},
        {"sensors": {"gelsight_mini": {}}},
        {"sensors": {"gelsight_mini": 5}},
        {"sensors": None},
        {"shards": "3"},
        {"shards": True},
        {"manifest_sha256": None},
    ],
)
def test_a_description_of_another_kind_is_told(folder: Path, changed: dict[str, Any]) -> None:
    rewrite_description(folder, **changed)
    with pytest.raises(InputError, match=r"dataset\.json: must (have|declare)"):
        PressDataset(folder)


def test_a_data_set_that_is_not_complete_is_told(folder: Path) -> None:
    rewrite_description(folder, complete=False)
    with pytest.raises(InputError, match="is not complete"):
        PressDataset(folder)
    assert len(PressDataset(folder, verify=False)) == 10


@pytest.mark.parametrize("i", [1.5, "x", None, slice(0, 2), np.zeros(2)])
def test_a_press_is_asked_for_by_a_whole_number(folders: dict[bool, Path], i: Any) -> None:
    data = PressDataset(folders[False])
    for read in (data.__getitem__, data.shared):
        with pytest.raises(InputError, match="must be a whole number"):
            read(i)
    assert data[np.int64(3)]["index"] == 3 == data[-7]["index"]


@pytest.mark.parametrize("i", [10, -11, 10**30])
def test_a_press_that_is_not_there_is_told(folders: dict[bool, Path], i: int) -> None:
    data = PressDataset(folders[False])
    for read in (data.__getitem__, data.shared):
        with pytest.raises(IndexError):
            read(i)
    assert [press["index"] for press in PressDataset(folders[False], ("index",))] == list(range(10))  # type: ignore[attr-defined]


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
    with pytest.raises(InputError, match="count = '5'"):
        contact_sheet(data, "5")  # type: ignore[arg-type]


def test_a_card_for_notebooks_shows_the_first_presses(folders: dict[bool, Path]) -> None:
    data = PressDataset(folders[False], ("height", "press_depth"))
    assert repr(data) == f"PressDataset({str(folders[False])!r}, {len(data)} presses; height, press_depth)"
    page = PressDataset(folders[False])._repr_html_()
    assert (
        page.count("data:image/png;base64,") == min(len(PressDataset(folders[False])), 6) and "without those that failed" in page
    )
