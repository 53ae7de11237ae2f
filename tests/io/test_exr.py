"""What is written to an EXR file is what is read back, and others can read it by name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from raytac.errors import InputError
from raytac.io.images import read_exr, vector_channels, write_exr

NAMES = ("R", "G", "B", "led_red.R", "led_red.G", "led_red.B", "N.X", "N.Y", "N.Z", "P.X", "P.Y", "P.Z", "Z")


@settings(max_examples=20, deadline=None)
@given(data=st.data(), height=st.integers(1, 9), width=st.integers(1, 9))
def test_round_trip_is_bit_exact(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject, height: int, width: int) -> None:
    values = st.floats(width=32, allow_nan=False)
    names = data.draw(st.lists(st.sampled_from(NAMES), min_size=1, unique=True))
    channels = {name: data.draw(arrays(np.float32, (height, width), elements=values)) for name in names}
    path = tmp_path_factory.mktemp("exr") / "frame.exr"
    write_exr(path, channels)
    read, _ = read_exr(path)
    assert set(read) == set(channels)
    for name, image in channels.items():
        assert read[name].dtype == np.float32
        assert read[name].tobytes() == image.tobytes(), name


def test_nan_survives(tmp_path: Path) -> None:
    write_exr(tmp_path / "a.exr", {"Z": np.array([[np.nan, 1.0]], np.float32)})
    image = read_exr(tmp_path / "a.exr")[0]["Z"]
    assert np.isnan(image[0, 0]) and image[0, 1] == 1.0


def test_header_text_survives(tmp_path: Path) -> None:
    header = {"sensor": "gelsight_mini", "mode": "rigid+raytrace-fast", "seed": "7", "unitsDepth": "m"}
    write_exr(tmp_path / "a.exr", {"Z": np.zeros((2, 3))}, header)
    assert read_exr(tmp_path / "a.exr")[1] == header


def test_other_programs_find_the_conventional_names(tmp_path: Path) -> None:
    import OpenEXR

    image = np.arange(24, dtype=np.float32).reshape(2, 4, 3)
    channels = vector_channels("", image, "RGB") | vector_channels("N", image) | vector_channels("led_red", image, "RGB")
    write_exr(tmp_path / "a.exr", channels, {"sensor": "s"})
    with OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True) as file:
        assert {"R", "G", "B", "N.X", "N.Y", "N.Z", "led_red.R", "led_red.G", "led_red.B"} == set(file.channels())
        assert file.header()["raytac:sensor"] == "s"
        np.testing.assert_array_equal(file.channels()["N.Y"].pixels, image[:, :, 1])


@pytest.mark.parametrize(
    ("channels", "header", "word"),
    [
        ({}, {}, "at least one"),
        ({"Z": np.zeros((2, 3)), "R": np.zeros((3, 2))}, {}, "shape"),
        ({"Z": np.zeros((2, 3, 3))}, {}, "shape"),
        ({"Z": np.zeros((2, 3))}, {"seed": 3}, "text"),
    ],
)
def test_bad_input_writes_nothing(tmp_path: Path, channels: dict, header: dict, word: str) -> None:
    with pytest.raises(InputError, match=word):
        write_exr(tmp_path / "a.exr", channels, header)
    assert not list(tmp_path.iterdir())


def test_missing_and_foreign_files_are_named(tmp_path: Path) -> None:
    """However long the folder's name is."""
    tmp_path = tmp_path / ("long_" * 20)
    tmp_path.mkdir()
    with pytest.raises(InputError, match=r"nothing\.exr.*must exist"):
        read_exr(tmp_path / "nothing.exr")
    (tmp_path / "text.exr").write_text("not an image")
    with pytest.raises(InputError, match=r"text\.exr.*readable"):
        read_exr(tmp_path / "text.exr")
