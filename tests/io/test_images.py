"""Pictures on disk: what is written is read back, by a path or its text."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from raytac.errors import InputError
from raytac.io import read_png, write_png, write_sheet


def test_a_picture_is_read_back_by_path_and_text(tmp_path: Path) -> None:
    image = np.random.default_rng(0).integers(256, size=(5, 7, 3)).astype(np.uint8)
    for path in (tmp_path / "path.png", str(tmp_path / "text.png")):
        write_png(path, image)
        np.testing.assert_array_equal(read_png(path), image)


def test_what_is_no_picture_is_refused_and_not_written(tmp_path: Path) -> None:
    for wrong in (np.zeros((5, 7, 3)), np.zeros((5, 7), np.uint8), np.zeros((5, 7, 4), np.uint8)):
        with pytest.raises(InputError, match="uint8"):
            write_png(tmp_path / "wrong.png", wrong)
    assert not list(tmp_path.iterdir())


def test_a_sheet_has_its_pictures_above_each_other(tmp_path: Path) -> None:
    images = [np.full((3, 4, 3), 10, np.uint8), np.full((2, 6, 3), 20, np.uint8)]
    paths = [tmp_path / f"{k}.png" for k in range(2)]
    for path, image in zip(paths, images, strict=True):
        write_png(path, image)
    write_sheet(paths, tmp_path / "sheet.png", gap=5)
    sheet = read_png(tmp_path / "sheet.png")
    assert sheet.shape == (3 + 5 + 2, 6, 3)
    np.testing.assert_array_equal(sheet[:3, :4], images[0])
    np.testing.assert_array_equal(sheet[8:], images[1])
    assert (sheet[:3, 4:] == 255).all() and (sheet[3:8] == 255).all()
