"""Errors of images of ball presses against their photographs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from raytac.calibrate.light_parameters import CHANNELS
from raytac.calibrate.photographs import FAR, Photographs
from raytac.errors import BackendError
from raytac.report.image_error import psnr, rmse, ssim_map
from raytac.specs import SensorSpec

OUTLIER = 2.0
"""A press whose contact error is so many times the median is an outlier."""
MOVED = 4.0 / 320
"""A press whose label is so far from the fitted circle, over the image's width, is one too."""
BOX_MARGIN = 15
"""Pixels that the box reaches beyond the labelled circle."""


def press_scores(sensor: SensorSpec, images: np.ndarray, shots: Photographs) -> list[dict[str, float]]:
    """Errors of ``images`` (N, H, W, 3) [levels] by press, at labelled circles.

    MAE and RMSE [levels] in the disc, MAE in the ring from one to two radii, also by channel, PSNR [dB] and SSIM in the box of the circle
    and ``BOX_MARGIN`` px, MAE over the frame. ``ring_even``: size of the ring's median error, the mean over channels; what a change of the
    whole ring's level would take away. SSIM is left out where scikit-image is not installed.
    """
    scores = []
    height, width = shots.background.shape[:2]
    for image, real, rho, (x, y, r) in zip(
        images.astype(float), shots.presses.astype(float), shots.distance(sensor), shots.circles, strict=True
    ):
        off = np.abs(image - real)
        ring = (rho >= 1) & (rho < 2)
        x_low, x_high = (int(np.clip(e, 0, width)) for e in (x - r - BOX_MARGIN, x + r + BOX_MARGIN + 1))
        top, bottom = (int(np.clip(e, 0, height)) for e in (y - r - BOX_MARGIN, y + r + BOX_MARGIN + 1))
        box = np.s_[top:bottom, x_low:x_high]
        score = {
            "contact_mae": float(off[rho < 1].mean()),
            "contact_rmse": float(np.sqrt((off[rho < 1] ** 2).mean())),
            "ring_mae": float(off[ring].mean()),
            **{f"ring_mae_{name}": float(off[ring, c].mean()) for c, name in enumerate(CHANNELS)},
            "ring_even": float(np.abs(np.median((image - real)[ring], axis=0)).mean()),
            "box_psnr": psnr(rmse(image[box], real[box])),
            "frame_mae": float(off.mean()),
        }
        try:
            ssim = ssim_map(np.clip(np.rint(image), 0, 255).astype(np.uint8), real.astype(np.uint8))
            score["box_ssim"] = float(np.nanmean(ssim[box]))
        except BackendError:
            pass
        scores.append(score)
    return scores


def summary(scores: list[dict[str, float]]) -> dict[str, float]:
    """Means over presses."""
    return {key: float(np.mean([score[key] for score in scores])) for key in scores[0]}


def press_rows(names: Mapping[str, Sequence[str]], scores: Mapping[str, Mapping[str, list[dict[str, float]]]]) -> list[str]:
    """Lines of a CSV file of every held-out press under every mode, at refined circles.

    ``names``: presses by kind of split, ``scores``: their errors by kind and mode, in that order. Two runs over the same presses are
    compared press by press: presses differ from each other by more than modes do.
    """
    lines = ["split,press,mode,contact_mae,ring_mae"]
    for kind, presses in names.items():
        for mode, of in scores[kind].items():
            for name, score in zip(presses, of, strict=True):
                lines.append(f"{kind},{name},{mode},{score['contact_mae']:.4f},{score['ring_mae']:.4f}")
    return lines


def outliers(names: Sequence[str], errors: np.ndarray, circles: np.ndarray, shots: Photographs) -> dict[str, str]:
    """Presses that do not agree with the others, by name, and why.

    ``errors`` (N,): contact errors of fitted presses; ``circles`` (N, 3) [px]: as fitted, against the labels of ``shots``.
    """
    reasons: dict[str, str] = {}
    limit = MOVED * shots.background.shape[1]
    for name, error, moved in zip(names, errors, np.abs(circles - shots.circles).max(1), strict=True):
        why = []
        if error > OUTLIER * np.median(errors):
            why.append(f"its error in the contact is more than {OUTLIER:g} times the median")
        if moved > limit:
            why.append(f"its circle is {moved:.1f} px from the fitted one, more than {limit:g}")
        if why:
            reasons[name] = " and ".join(why)
    return reasons


def noise_floor(sensor: SensorSpec, shots: Photographs) -> float:
    """Mean absolute difference [levels] of photographs from the background, beyond ``FAR``."""
    far = shots.distance(sensor) > FAR
    return float(np.abs(shots.presses - shots.background)[far].mean())
