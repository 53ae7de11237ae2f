"""Calibration folders: written and read back, upstream's read, and whatever is malformed, cut short or malicious refused."""

from __future__ import annotations

import importlib.util
import io
import json
import os
import pickle
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from raytac.errors import CalibrationError, InputError
from raytac.optics.taxim.folder import CALIBRATION_FILES, load_calibration, save_calibration
from raytac.optics.taxim.restricted_pickle import load_restricted
from raytac.optics.taxim.table import PolyTable, ShadowTable, TaximConstants, slope_bins

ARRAYS = ("gradients", "covered", "background", "rest_image", "gel_map")


def make_table(*, upstream: bool = False) -> PolyTable:
    rng = np.random.default_rng(1)
    n, shape = 8, (12, 16)
    lengths = rng.integers(0, 5, (3, 7, 4)).astype(np.int32)
    values = rng.uniform(-50, -10, (3, 7, 4, 5)).astype(np.float32)
    values[np.arange(5) >= lengths[..., None]] = 0
    shadow = ShadowTable(np.arange(7) * 0.9, values, lengths, direction_precision=0.9)
    if upstream:
        rest = rng.integers(0, 255, (*shape, 3)).astype(np.uint8)
        return PolyTable(rng.normal(size=(3, n, n, 6)), None, rest.astype(np.float32), (2e-5, 2e-5), shadow, "height", rest)
    return PolyTable(
        rng.normal(size=(3, n, n, 6)),
        rng.random((n, n)) > 0.5,
        rng.uniform(0, 255, (*shape, 3)).astype(np.float32),
        (2e-5, 3e-5),
        ShadowTable(np.arange(7) * 0.9, values, lengths, 0.0, 0.05e-3, 0, 0.9, 2.0, 0.2, 0.1, "drop"),
        gel_map=rng.uniform(0, 3, shape),
        surround=rng.normal(size=(3, n, n, 6)),
        one_sheet=rng.normal(size=(3, n, n, 6)),
        constants=TaximConstants(ring_dilations=3, shadow_sigma=1.5),
        provenance={"source": "test"},
    )


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    save_calibration(make_table(), tmp_path / "calibration")
    return tmp_path / "calibration"


def test_a_table_comes_back_as_it_was(folder: Path) -> None:
    table, back = make_table(), load_calibration(folder)
    assert sorted(path.name for path in folder.iterdir()) == sorted(CALIBRATION_FILES)
    for name in ("gradients", "covered", "background", "gel_map", "surround", "one_sheet"):
        np.testing.assert_array_equal(getattr(back, name), getattr(table, name))
    np.testing.assert_array_equal(back.rest_image, np.rint(table.background))  # type: ignore[arg-type]
    assert back.slopes_of == "displacement" and back.constants == table.constants and back.provenance == table.provenance
    np.testing.assert_allclose(back.pixel_pitch, table.pixel_pitch, rtol=1e-12)
    assert table.shadow is not None and back.shadow is not None
    for name in ("directions", "values", "lengths"):
        ours, theirs = getattr(table.shadow, name), getattr(back.shadow, name)
        np.testing.assert_array_equal(theirs, ours[..., : theirs.shape[-1]] if name == "values" else ours)
    for name in (
        "first_depth",
        "depth_precision",
        "depth_offset",
        "direction_precision",
        "step",
        "fan_angle",
        "fan_precision",
        "depth_of",
    ):
        assert getattr(back.shadow, name) == pytest.approx(getattr(table.shadow, name)), name


def test_the_files_are_upstreams(folder: Path) -> None:
    """Names, shapes and the order of the channels, as ``numpy`` alone reads them."""
    table = make_table()
    assert table.one_sheet is not None
    with np.load(folder / "polycalib.npz") as arrays:
        assert int(arrays["bins"]) == 8
        np.testing.assert_array_equal(arrays["grad_r"], table.one_sheet[2])  # upstream's r is blue
        np.testing.assert_array_equal(arrays["grad_b"], table.one_sheet[0])
    with np.load(folder / "dataPack.npz") as arrays:
        np.testing.assert_array_equal(arrays["f0"][..., 0], np.rint(table.background[..., 2]))
    with np.load(folder / "shadowTable.npz", allow_pickle=True) as arrays:
        lists = arrays["shadowTable"]
        assert table.shadow is not None and lists.shape == (3, 7, 4)
        assert lists[0, 3, 2] == table.shadow.values[2, 3, 2, : table.shadow.lengths[2, 3, 2]].tolist()
    assert {"pixmm", "num_bins", "h", "w"} <= set(json.loads((folder / "params.json").read_text())["sensor"])


def test_a_folder_without_raytacs_files_is_upstreams(folder: Path) -> None:
    (folder / "raytac.npz").unlink()
    params = json.loads((folder / "params.json").read_text())
    del params["raytac"]
    (folder / "params.json").write_text(json.dumps(params))
    table = load_calibration(folder)
    assert table.slopes_of == "height" and table.covered is None and "unknown" in table.provenance["coverage"]
    assert table.shadow is not None and table.shadow.depth_offset == 6 and table.shadow.depth_of == "origin"
    assert table.rest_image is not None
    # The mix with the blurred image, truncated.
    assert np.array_equal(table.background, np.floor(table.background)) and not np.array_equal(table.background, table.rest_image)


def test_the_first_release_has_no_params(folder: Path) -> None:
    for name in ("params.json", "raytac.npz", "gelmap.npy"):
        (folder / name).unlink()
    with pytest.raises(CalibrationError, match=r"params.json"):
        load_calibration(folder)
    with pytest.raises(InputError, match="pixel_pitch"):
        load_calibration(folder, pixel_pitch=0.0)
    assert load_calibration(folder, pixel_pitch=2.95e-5).pixel_pitch == pytest.approx((2.95e-5, 2.95e-5))


@pytest.mark.skipif(
    importlib.util.find_spec("taxim") is None, reason="the package taxim, which brings calibrations, is not installed"
)
@pytest.mark.parametrize(("name", "depths"), [("gelsight", 9), ("gelsight_mini", 24)])
def test_upstreams_calibrations_are_read(name: str, depths: int) -> None:
    spec = importlib.util.find_spec("taxim")
    assert spec is not None and spec.origin is not None
    table = load_calibration(Path(spec.origin).parent / "calib" / name)
    assert table.resolution == (640, 480) and table.n_bins == 125 and table.shadow is not None
    assert table.shadow.values.shape[:3] == (3, 63, depths) and table.shadow.values.min() < -40
    assert len(table.shadow.rays()[0]) == 5 and table.shadow.step == pytest.approx(1.25)
    assert table.constants == TaximConstants() and table.pixel_pitch == pytest.approx((2.95e-5, 2.95e-5))


# -------------------------------------------------------------------- refusals


def rewrite(path: Path, **changes: Any) -> None:
    with np.load(path, allow_pickle=True) as arrays:
        content: dict[str, Any] = {name: arrays[name] for name in arrays.files}
    content |= changes
    np.savez(path, **{name: value for name, value in content.items() if value is not None})


def edit_params(folder: Path, part: str, **changes: Any) -> None:
    params = json.loads((folder / "params.json").read_text())
    params[part] |= changes
    (folder / "params.json").write_text(json.dumps(params))


def lists_with(value: Any) -> np.ndarray:
    lists = np.empty((3, 7, 4), dtype=object)
    lists[...] = [[[[] for _ in range(4)] for _ in range(7)] for _ in range(3)]
    for place in np.ndindex(3, 7, 4):
        lists[place] = []
    lists[1, 2, 3] = value
    return lists


def future_zip(path: Path) -> None:
    """Let the archive's directory ask for a version of the format that nobody has."""
    whole = bytearray(path.read_bytes())
    whole[whole.rindex(b"PK\x01\x02") + 6] = 200
    path.write_bytes(whole)


BAD: list[tuple[str, Callable[[Path], Any], list[str]]] = [
    ("no polycalib", lambda f: (f / "polycalib.npz").unlink(), ["polycalib.npz"]),
    ("no pack", lambda f: (f / "dataPack.npz").unlink(), ["dataPack.npz"]),
    ("not a zip", lambda f: (f / "polycalib.npz").write_bytes(b"hello"), ["polycalib.npz"]),
    ("array missing", lambda f: rewrite(f / "polycalib.npz", grad_g=None), ["grad_g"]),
    ("bins", lambda f: rewrite(f / "polycalib.npz", bins=np.float64(8.5)), ["bins", "whole number"]),
    ("shape", lambda f: rewrite(f / "polycalib.npz", grad_b=np.zeros((8, 9, 6))), ["grad_b", "(8, 8, 6)", "(8, 9, 6)"]),
    ("NaN", lambda f: rewrite(f / "polycalib.npz", grad_b=np.full((8, 8, 6), np.nan)), ["grad_b", "finite"]),
    ("text", lambda f: rewrite(f / "polycalib.npz", grad_b=np.full((8, 8, 6), "a")), ["grad_b"]),
    ("float image", lambda f: rewrite(f / "dataPack.npz", f0=np.zeros((12, 16, 3))), ["f0", "uint8"]),
    ("gel map", lambda f: np.save(f / "gelmap.npy", np.zeros((3, 4))), ["gelmap.npy", "(12, 16)"]),
    ("pickled gel map", lambda f: np.save(f / "gelmap.npy", np.array([{}]), allow_pickle=True), ["gelmap.npy"]),
    ("directions", lambda f: rewrite(f / "shadowTable.npz", shadowDirections=np.zeros(6)), ["(3, 6, n_depth)", "(3, 7, 4)"]),
    ("list of text", lambda f: rewrite(f / "shadowTable.npz", shadowTable=lists_with(["a"])), ["shadowTable", "holds a str"]),
    ("no list", lambda f: rewrite(f / "shadowTable.npz", shadowTable=lists_with(3.0)), ["shadowTable[1, 2, 3]", "list"]),
    ("list of lists", lambda f: rewrite(f / "shadowTable.npz", shadowTable=lists_with([[1.0]])), ["shadowTable[1, 2, 3]"]),
    (
        "infinite list",
        lambda f: rewrite(f / "shadowTable.npz", shadowTable=lists_with([np.inf])),
        ["shadowTable[1, 2, 3]", "finite"],
    ),
    ("huge number", lambda f: rewrite(f / "shadowTable.npz", shadowTable=lists_with([10**400])), ["shadowTable", "64 bits"]),
    ("huge pitch", lambda f: edit_params(f, "sensor", pixmm=10**400), ["sensor.pixmm"]),
    ("strange zip", lambda f: future_zip(f / "raytac.npz"), ["raytac.npz", "zip file version"]),
    ("no JSON", lambda f: (f / "params.json").write_text("{"), ["params.json", "JSON"]),
    ("JSON list", lambda f: (f / "params.json").write_text("[]"), ["params.json", "sensor"]),
    ("other size", lambda f: edit_params(f, "sensor", w=17), ["sensor.w", "17", "16"]),
    ("pitch", lambda f: edit_params(f, "sensor", pixmm="wide"), ["sensor.pixmm", "wide"]),
    ("fan", lambda f: edit_params(f, "simulator", fan_precision=0), ["fan_precision"]),
    ("many rays", lambda f: edit_params(f, "simulator", fan_precision=1e-5), ["at most 64 rays"]),
    ("unknown setting", lambda f: edit_params(f, "raytac", slope_of="height"), ["raytac.slope_of"]),
    ("unknown surface", lambda f: edit_params(f, "raytac", slopes_of="depth"), ["slopes_of", "displacement"]),
    ("one of two sheets", lambda f: rewrite(f / "raytac.npz", surround=None), ["gradients", "'surround'"]),
    ("sheet", lambda f: rewrite(f / "raytac.npz", gradients=np.zeros((3, 8, 8, 5))), ["gradients", "(3, 8, 8, 6)"]),
    ("coverage", lambda f: rewrite(f / "raytac.npz", covered=np.zeros((8, 8))), ["covered", "bool"]),
]


@pytest.mark.parametrize(("spoil", "words"), [case[1:] for case in BAD], ids=[case[0] for case in BAD])
def test_malformed_folders_are_refused_with_file_and_rule(folder: Path, spoil: Callable[[Path], Any], words: list[str]) -> None:
    spoil(folder)
    with pytest.raises(CalibrationError) as error:
        load_calibration(folder)
    for word in words:
        assert word in str(error.value)
    assert error.value.file is not None


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(name=st.sampled_from(CALIBRATION_FILES), share=st.floats(0, 0.999))
def test_a_file_cut_short_anywhere_is_refused(folder: Path, name: str, share: float) -> None:
    path = folder / name
    whole = path.read_bytes()
    try:
        # The line break at the end of params.json is all that may go missing.
        path.write_bytes(whole[: min(int(share * len(whole)), len(whole) - 2)])
        with pytest.raises(CalibrationError, match=name):
            load_calibration(folder)
    finally:
        path.write_bytes(whole)


@settings(max_examples=120, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(name=st.sampled_from(CALIBRATION_FILES), place=st.floats(0, 1, exclude_max=True), value=st.integers(0, 255))
def test_a_changed_byte_gives_a_table_or_a_clear_refusal(folder: Path, name: str, place: float, value: int) -> None:
    path = folder / name
    whole = path.read_bytes()
    try:
        spoilt = bytearray(whole)
        spoilt[int(place * len(whole))] = value
        path.write_bytes(spoilt)
        try:
            load_calibration(folder)
        except CalibrationError as error:
            assert str(folder) in str(error)
    finally:
        path.write_bytes(whole)


class Touch:
    """A pickle of this makes a file when it is read by ``pickle``."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, (f"touch '{self.path}'",)


def test_a_malicious_pickle_is_refused_without_running(folder: Path, tmp_path: Path) -> None:
    touched = tmp_path / "touched"
    rewrite(folder / "shadowTable.npz", shadowTable=lists_with([Touch(touched)]))
    with pytest.raises(CalibrationError, match=r"shadowTable.npz.*only numbers, lists, tuples and NumPy arrays"):
        load_calibration(folder)
    assert not touched.exists()
    with np.load(folder / "shadowTable.npz", allow_pickle=True) as arrays:
        _ = arrays["shadowTable"]
    assert touched.exists(), "the pickle was harmless, so the test shows nothing"


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_numbers_lists_and_arrays_are_admitted(protocol: int) -> None:
    nested = [1, 2.5, (np.float64(3.5), np.int32(4)), np.arange(6.0).reshape(2, 3), np.asfortranarray(np.arange(6).reshape(2, 3))]
    back = load_restricted(pickle.dumps(nested, protocol))
    assert back[:3] == nested[:3]
    for k in (3, 4):
        np.testing.assert_array_equal(back[k], nested[k])
    big_endian = np.arange(3, dtype=">f4")
    np.testing.assert_array_equal(load_restricted(pickle.dumps(big_endian, protocol)), big_endian)


@pytest.mark.parametrize(
    "item", [{}, {1}, print, Path("a"), np.dtype("f8"), np.array(["a"]), np.ndarray, 1j, "text", b"bytes", None, 2**64], ids=repr
)
def test_anything_else_is_refused(item: object) -> None:
    with pytest.raises(pickle.UnpicklingError):
        load_restricted(pickle.dumps([item]))


def test_what_is_admitted_cannot_be_changed() -> None:
    # GLOBAL numpy dtype, then BUILD with a state: would set attributes of what the name stands for.
    with pytest.raises(pickle.UnpicklingError, match="changes what it names"):
        load_restricted(b"cnumpy\ndtype\n(I1\ntb.")
    with pytest.raises(pickle.UnpicklingError, match="instruction EMPTY_DICT"):
        load_restricted(b"cnumpy\ndtype\n}S'x'\nI1\nsb.")


@pytest.mark.parametrize(
    "program",
    [
        b"\x80\x02]r\xff\xff\xff\x3f.",  # LONG_BINPUT: the unpickler would make its memo 16 GB long
        b"]p99999999\n.",  # PUT: the same in text
        b"]p-1\n.",
    ],
)
def test_a_memo_larger_than_the_pickle_is_refused(program: bytes) -> None:
    with pytest.raises(pickle.UnpicklingError, match="notes an object at place"):
        load_restricted(program)


def test_lists_in_lists_cannot_grow_without_bound() -> None:
    """Each list holds the one before it twice: 40 of them, 2⁴⁰ items in 300 bytes."""
    program = b"\x80\x02]q\x00" + b"".join(b"]q%c(h%ch%ce" % (k + 1, k, k) for k in range(40)) + b"."
    assert len(program) < 400
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("raytac.optics.taxim.restricted_pickle._MOST_ITEMS", 10_000)
        with pytest.raises(pickle.UnpicklingError, match="more than 10000 items"):
            load_restricted(program)
        with pytest.raises(pickle.UnpicklingError, match="more than 10000 items"):
            load_restricted(pickle.dumps([np.zeros(10_000)]))
        assert load_restricted(pickle.dumps([np.zeros(9_000)]))[0].shape == (9_000,)


def test_persistent_objects_are_refused() -> None:
    with pytest.raises(pickle.UnpicklingError, match="PERSID"):
        load_restricted(b"Pname\n.")


@pytest.mark.parametrize(
    ("bins", "message"), [(8, "grad_b: must be at most 68608 bytes"), (4096, r"bins = '4096': .*\[2, 1024\]")]
)
def test_an_npz_that_unpacks_to_too_much_is_refused_before_it_is_unpacked(
    folder: Path, bins: int, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Eight bins are 3 kB; the archive claims the 805 MB of 4,096."""
    header = io.BytesIO()
    np.save(header, np.int64(bins))
    with zipfile.ZipFile(folder / "polycalib.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("bins.npy", header.getvalue())
        for name in ("grad_r", "grad_g", "grad_b"):
            archive.writestr(f"{name}.npy", bytes(10**6))
    read = zipfile.ZipFile.read
    monkeypatch.setattr(
        zipfile.ZipFile,
        "read",
        lambda self, name: read(self, name) if name == "bins.npy" else pytest.fail(f"{name} was unpacked"),
    )
    with pytest.raises(CalibrationError, match=message):
        load_calibration(folder)


def test_saving_replaces_an_older_table_as_a_whole(folder: Path) -> None:
    table = make_table(upstream=True)
    save_calibration(
        PolyTable(table.gradients, None, table.background, table.pixel_pitch, None, "height", table.rest_image), folder
    )
    back = load_calibration(folder)
    assert back.shadow is None and back.covered is None
    shutil.rmtree(folder)
    with pytest.raises(CalibrationError, match="must be a folder"):
        load_calibration(folder)


# -------------------------------------------------------------------- tables


def test_bins_of_slopes() -> None:
    assert [int(v) for v in slope_bins(np.array(0.0), np.array(0.0), 125)] == [0, 62]
    i, j = slope_bins(np.array([1.0, 0.0, -1.0, 0.0]), np.array([0.0, 1.0, 0.0, -1.0]), 125)
    assert i.tolist() == [62] * 4
    assert j.tolist() == [62, 93, 124, 31]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("gradients", np.zeros((3, 4, 5, 6))),
        ("gradients", np.full((3, 4, 4, 6), np.inf)),
        ("covered", np.zeros((4, 4))),
        ("background", np.zeros((2, 2, 3))),
        ("pixel_pitch", (1e-5, 0.0)),
        ("slopes_of", "depth"),
        ("gel_map", np.zeros((3, 3))),
    ],
)
def test_a_table_of_the_wrong_form_is_refused(name: str, value: Any) -> None:
    good = {"gradients": np.zeros((3, 4, 4, 6)), "covered": None, "background": np.zeros((8, 8, 3)), "pixel_pitch": (1e-5, 1e-5)}
    PolyTable(**good)
    with pytest.raises(InputError, match=name):
        PolyTable(**{**good, name: value})
