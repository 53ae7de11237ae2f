"""Presses on photographs of untouched sensors: a transform for training across sensors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from raytac.checks import check_seed
from raytac.errors import InputError
from raytac.optics.backgrounds import shown_on


class RandomBackground:
    """Transform that shows a sample's ``rgb`` on one of several photographs.

    The image becomes photograph · rgb / rest_rgb, near the same ratio of light, and ``rest_rgb`` the photograph, so that
    differences stay differences. A video keeps one photograph. ``raytac press --background`` shows one press so.

    .. code-block:: python

        photographs = [read_png(path) for path in Path("untouched").glob("*.png")]
        data = PressDataset("runs/dataset", ("index", "rgb", "rest_rgb", "label"), transform=RandomBackground(photographs))
    """

    def __init__(self, photographs: Sequence[np.ndarray], *, seed: int | None = None) -> None:
        """Check the photographs.

        Args:
            photographs: of sensors that nothing touches, (H, W, 3), uint8, of the size of the images.
            seed: a press has the same photograph every time, drawn by this and its ``index``; None draws at every call.

        Raises:
            InputError: no photograph, one that is no 8-bit image, or several sizes.
        """
        self._photographs = [np.asarray(photograph) for photograph in photographs]
        if not self._photographs:
            raise InputError("photographs", value=[], rule="must hold at least one image")
        shape = self._photographs[0].shape
        for k, one in enumerate(self._photographs):
            if one.dtype != np.uint8 or one.ndim != 3 or one.shape[2] != 3 or one.shape != shape:
                rule = "must be 8-bit images (H, W, 3) of one size"
                raise InputError(f"photographs[{k}]", value=f"{one.dtype} {one.shape}", rule=rule)
        self._seed = None if seed is None else check_seed("seed", seed)

    def __call__(self, sample: dict[str, Any]) -> dict[str, Any]:
        """The sample with other ``rgb`` and ``rest_rgb``.

        Raises ``InputError``: a sample without these (or without ``index``, with a seed), or photographs of another size.
        """
        needed = ("rgb", "rest_rgb", *(() if self._seed is None else ("index",)))
        for name in needed:
            if name not in sample:
                raise InputError("sample", value=tuple(sample), rule=f"must hold {name!r}: name it when the data set is opened")
        rgb, rest = sample["rgb"], sample["rest_rgb"]
        if rest.shape != self._photographs[0].shape:
            raise InputError(
                "photographs", value=self._photographs[0].shape, rule=f"must have the size of the images, {rest.shape}"
            )
        drawn = np.random.default_rng(None if self._seed is None else (self._seed, int(sample["index"])))
        photograph = self._photographs[drawn.integers(len(self._photographs))]
        return {**sample, "rgb": shown_on(photograph, rgb, rest), "rest_rgb": photograph.copy()}
