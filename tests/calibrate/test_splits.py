"""Splits: every press is tested once, nothing is fitted and tested at the same time."""

from __future__ import annotations

import numpy as np
import pytest

from raytac.calibrate.presses import RealPresses, by_half, by_press, shallow_to_deep
from raytac.errors import InputError


def presses(circles: list[list[float]], radii: list[float] | None = None) -> RealPresses:
    n = len(circles)
    image = np.zeros((100, 200, 3), np.uint8)
    balls = np.array(radii if radii is not None else [3e-3] * n)
    return RealPresses(image, np.stack([image] * n), balls, np.array(circles), tuple(map(str, range(n))))


@pytest.mark.parametrize(("count", "folds"), [(30, 5), (7, 3), (4, 4)])
def test_folds_test_every_press_once(count: int, folds: int) -> None:
    splits = by_press(count, folds)
    assert len(splits) == folds
    np.testing.assert_array_equal(np.sort(np.concatenate([test for _, test in splits])), np.arange(count))
    for fit, test in splits:
        assert not set(fit) & set(test) and len(fit) + len(test) == count


def test_halves_are_told_by_the_centre() -> None:
    (left, right), (back, forth) = by_half(presses([[99, 50, 20], [101, 50, 20], [150, 50, 20]]))
    assert left.tolist() == [0] and right.tolist() == [1, 2]
    assert back.tolist() == [1, 2] and forth.tolist() == [0]


def test_depth_is_the_circle_over_the_ball() -> None:
    shallow, deep = shallow_to_deep(presses([[50, 50, 20], [50, 50, 10], [50, 50, 24], [50, 50, 30]], [2e-3, 2e-3, 6e-3, 2e-3]))
    assert shallow.tolist() == [1, 2] and deep.tolist() == [0, 3]


def test_what_cannot_be_split_is_refused() -> None:
    with pytest.raises(InputError, match="from 2 to the number of presses, 3"):
        by_press(3, 4)
    with pytest.raises(InputError, match="both halves"):
        by_half(presses([[50, 50, 20], [60, 50, 20]]))
    with pytest.raises(InputError, match="1 of 2 without a circle"):
        by_half(presses([[50, 50, 20], [np.nan, 50, 20]]))
    with pytest.raises(InputError, match="either side"):
        shallow_to_deep(presses([[50, 50, 20], [60, 50, 20]]), share=0.0)
