"""Which presses a model is fitted to and which it is tested on."""

from __future__ import annotations

import numpy as np

from raytac.calibrate.presses import RealPresses
from raytac.errors import InputError

__all__ = ["Split", "by_half", "by_press", "shallow_to_deep"]

Split = tuple[np.ndarray, np.ndarray]
"""Indices of the presses to fit to and of those to test on."""


def by_press(count: int, folds: int) -> list[Split]:
    """``folds`` splits: fold k tests every ``folds``-th of ``count`` presses from the k-th, so that neighbours of a scan are apart.

    ``folds = count`` leaves one out.

    Raises:
        InputError: fewer than two folds, or more folds than presses.
    """
    if int(folds) != folds or not 2 <= folds <= count:
        raise InputError("folds", value=folds, rule=f"must be a whole number from 2 to the number of presses, {count}")
    index = np.arange(count)
    return [(index[index % folds != k], index[index % folds == k]) for k in range(folds)]


def by_half(presses: RealPresses) -> list[Split]:
    """Left half of the pad to the right one, and the reverse; a press belongs to the half that its circle's centre lies in.

    Raises:
        InputError: a half without a press.
    """
    left = _known(presses)[:, 0] < presses.resolution[0] / 2
    if left.all() or not left.any():
        raise InputError("presses", value=f"{len(presses)} presses", rule="must lie on both halves of the image")
    a, b = np.flatnonzero(left), np.flatnonzero(~left)
    return [(a, b), (b, a)]


def shallow_to_deep(presses: RealPresses, share: float = 0.5) -> Split:
    """The shallower ``share`` of the presses to the deeper ones; depth over the ball's radius grows with the circle over the ball.

    Raises:
        InputError: a share that leaves one side empty.
    """
    relative = _known(presses)[:, 2] / presses.ball_radius
    order, cut = np.argsort(relative, kind="stable"), round(share * len(presses))
    if not 0 < cut < len(presses):
        raise InputError("share", value=share, rule=f"must leave a press on either side of {len(presses)}")
    return np.sort(order[:cut]), np.sort(order[cut:])


def _known(presses: RealPresses) -> np.ndarray:
    unknown = int(np.isnan(presses.circles).any(axis=1).sum())
    if unknown:
        raise InputError("presses", value=f"{unknown} of {len(presses)} without a circle", rule="must all have a contact circle")
    return presses.circles
