"""Presses on other photographs: what is untouched is the photograph, what is touched changes by the same ratio of light."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest

from raytac.dataset import RandomBackground
from raytac.errors import InputError

SHAPE = (12, 16, 3)


def image(seed: int, low: int = 40, high: int = 160) -> np.ndarray:
    return np.random.default_rng(seed).integers(low, high, SHAPE, np.uint8)


PHOTOGRAPHS = [image(k) for k in range(3)]


def sample(index: int = 0) -> dict[str, Any]:
    rest = image(10)
    rgb = rest.copy()
    rgb[3:8, 4:9] = np.clip(rest[3:8, 4:9] * np.array([1.3, 0.6, 1.0]), 0, 255).astype(np.uint8)
    return {"index": np.array(index), "rgb": rgb, "rest_rgb": rest, "label": np.array(2)}


def test_untouched_pixels_are_the_photographs_and_touched_ones_change_by_the_same_ratio() -> None:
    own = sample()
    made = RandomBackground(PHOTOGRAPHS[:1])(own)
    touched = np.zeros(SHAPE[:2], bool)
    touched[3:8, 4:9] = True
    np.testing.assert_array_equal(made["rgb"][~touched], PHOTOGRAPHS[0][~touched])
    np.testing.assert_array_equal(made["rest_rgb"], PHOTOGRAPHS[0])
    for gamma in (1.0, 2.2):  # the same in linear light, whatever the camera's exponent
        light = {name: (np.asarray(values, float)[touched] / 255.0) ** gamma for name, values in own.items() if "rgb" in name}
        expected = 255.0 * ((PHOTOGRAPHS[0][touched] / 255.0) ** gamma * light["rgb"] / light["rest_rgb"]) ** (1.0 / gamma)
        np.testing.assert_allclose(made["rgb"][touched], np.minimum(expected, 255.0), atol=0.51)
    assert made["rgb"].dtype == np.uint8 and made["label"] == 2
    np.testing.assert_array_equal(own["rest_rgb"], image(10))  # nothing is changed in place


def test_a_seed_fixes_the_photograph_of_a_press() -> None:
    fixed = RandomBackground(PHOTOGRAPHS, seed=4)

    def chosen(transform: RandomBackground, index: int) -> int:
        rest = transform(sample(index))["rest_rgb"]
        return next(k for k, one in enumerate(PHOTOGRAPHS) if (one == rest).all())

    first = [chosen(fixed, index) for index in range(30)]
    assert first == [chosen(pickle.loads(pickle.dumps(fixed)), index) for index in range(30)] and set(first) == {0, 1, 2}
    assert {chosen(RandomBackground(PHOTOGRAPHS), 0) for _ in range(40)} == {0, 1, 2}
    assert len({chosen(fixed, 5) for _ in range(10)}) == 1


def test_a_video_keeps_one_photograph_and_the_dark_does_not_explode() -> None:
    own = sample()
    own["rgb"] = np.stack([own["rest_rgb"], own["rgb"]])
    made = RandomBackground(PHOTOGRAPHS)(own)
    np.testing.assert_array_equal(made["rgb"][0], made["rest_rgb"])
    assert made["rgb"].shape == (2, *SHAPE) and (made["rgb"][1] != made["rgb"][0]).any()
    dark = {"rgb": np.ones(SHAPE, np.uint8), "rest_rgb": np.zeros(SHAPE, np.uint8)}
    assert RandomBackground(PHOTOGRAPHS)(dark)["rgb"].max() <= 160 / 4 + 1


@pytest.mark.parametrize(
    ("photographs", "changed", "message"),
    [
        ([], {}, "at least one image"),
        ([image(0).astype(float)], {}, r"photographs\[0\]"),
        ([image(0), image(1)[:-1]], {}, r"photographs\[1\]"),
        ([image(0)[:-1]], {}, "must have the size of the images"),
        ([image(0)], {"rest_rgb": None}, "must hold 'rest_rgb'"),
        ([image(0)], {"index": None}, "must hold 'index'"),
    ],
)
def test_what_cannot_be_shown_is_refused(photographs: list[np.ndarray], changed: dict[str, Any], message: str) -> None:
    own = {name: value for name, value in sample().items() if changed.get(name, 0) is not None}
    with pytest.raises(InputError, match=message):
        RandomBackground(photographs, seed=1)(own)
