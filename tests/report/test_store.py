"""Rows come back as they were kept, or not at all."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from raytac.report.compare.store import Row, RowStore, row_key


def test_a_row_comes_back_as_it_was_kept(tmp_path: Path) -> None:
    image = np.random.default_rng(0).integers(0, 256, (5, 7, 3), np.uint8)
    figures = {"ms": 1.25, "label": "fast", "spp": None, "at_noise": True, "frames": 3}
    store = RowStore(tmp_path / "rows", pytest.fail)
    store.write("sphere-fast", "k", Row(dict(figures), image))
    kept = store.read("sphere-fast", "k")
    assert kept is not None and kept.figures == figures
    np.testing.assert_array_equal(kept.image, image)
    assert store.read("sphere-fast", "other") is None and store.read("coin-fast", "k") is None


def test_a_row_with_any_byte_changed_is_told_and_not_used(tmp_path: Path) -> None:
    """Every byte of the picture and of its figures in turn: the damage is noticed, whatever it makes the readers raise."""
    told: list[str] = []
    store = RowStore(tmp_path, told.append)
    row = Row({"ms": 1.25}, np.random.default_rng(0).integers(0, 256, (4, 5, 3), np.uint8))
    store.write("a", "k", row)
    silent = 0
    for path in tmp_path.iterdir():
        whole = path.read_bytes()
        for place in range(len(whole)):
            path.write_bytes(whole[:place] + bytes([whole[place] ^ 0x24]) + whole[place + 1 :])
            told.clear()
            back = store.read("a", "k")
            assert (back is None) == bool(told)
            # What is no part of the contents, such as a checksum at the end of a PNG, may change unnoticed.
            assert back is None or (back.figures == row.figures and np.array_equal(back.image, row.image))
            silent += back is not None
        path.write_bytes(whole)
    assert silent < 60 and store.read("a", "k") is not None


def test_a_row_that_is_not_finite_is_never_kept(tmp_path: Path) -> None:
    with pytest.raises(ValueError):
        RowStore(tmp_path).write("a", "k", Row({"ms": float("nan")}, np.zeros((2, 2, 3), np.uint8)))
    assert RowStore(tmp_path, pytest.fail).read("a", "k") is None


def test_keys_depend_on_every_part_and_on_nothing_else() -> None:
    basis = {"seed": 0, "mode": ["fast", {"spp": 4}]}
    assert row_key(basis) == row_key({"mode": ["fast", {"spp": 4}], "seed": 0})
    assert len({row_key(basis), row_key(basis | {"seed": 1}), row_key(basis | {"mode": ["fast", {}]})}) == 3
