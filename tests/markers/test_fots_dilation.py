"""FOTS' dilation against the sum over all samples."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from raytac.markers.fots import FotsKernel
from tests.markers.pads import MOTION

X, Y = (0.4e-3 * (np.arange(n) - 0.5 * (n - 1)) for n in (64, 53))
BOXES = np.array([[15, 48, 14, 39], [0, 5, 0, 7], [60, 64, 46, 53], [0, 0, 0, 0], [30, 31, 20, 21]], np.uint32)
MARKERS = np.stack(np.meshgrid(np.linspace(-9e-3, 9e-3, 6), np.linspace(-8e-3, 8e-3, 5)), axis=-1).reshape(-1, 2)
NO_CONTACT = np.zeros((len(BOXES), 1, 12))


def depths() -> np.ndarray:
    """Rough contacts that end abruptly at their boxes [m], (B, ny, nx), float32."""
    depth = np.zeros((len(BOXES), len(Y), len(X)), np.float32)
    for one, (c0, c1, r0, r1) in zip(depth, BOXES.tolist(), strict=True):
        one[r0:r1, c0:c1] = np.random.default_rng(c1).uniform(0, 6e-4, (r1 - r0, c1 - c0))
    return depth


def by_sum(gain: float, decay: float, depth: np.ndarray) -> np.ndarray:
    """The dilation (B, M, 2) [m] over all samples, in float64."""
    ex, ey = MARKERS[:, :1] - X, MARKERS[:, 1:] - Y
    gx, gy = np.exp(-decay * ex**2), np.exp(-decay * ey**2)
    sums = [
        np.einsum("mj,bji,mi->bm", along_y, depth.astype(float), along_x) for along_y, along_x in ((gy, ex * gx), (ey * gy, gx))
    ]
    return gain * (X[1] - X[0]) * (Y[1] - Y[0]) * np.stack(sums, axis=-1)


@pytest.mark.parametrize("decay", [1.8e4, 4e4, 0.9e5, 1e6])
def test_markers_move_as_by_all_samples(decay: float) -> None:
    depth = depths()
    unit = by_sum(1.0, decay, depth)
    gain = 200e-6 / np.abs(unit).max()
    motion = replace(MOTION, dilate_gain=gain, dilate_lambda=decay)
    moved = FotsKernel(X, Y, device="cpu").displacement(np.tile(MARKERS, (len(BOXES), 1, 1)), depth, BOXES, NO_CONTACT, motion)
    np.testing.assert_allclose(moved, gain * unit, rtol=0, atol=1e-9)


def test_a_pad_does_not_depend_on_its_neighbours_to_the_last_bit() -> None:
    depth, motion = depths(), replace(MOTION, dilate_gain=1e8, dilate_lambda=4e4)
    together = FotsKernel(X, Y, device="cpu").displacement(np.tile(MARKERS, (len(BOXES), 1, 1)), depth, BOXES, NO_CONTACT, motion)
    for b in range(len(BOXES)):
        some = slice(b, b + 1)
        alone = FotsKernel(X, Y, device="cpu").displacement(MARKERS[None], depth[some], BOXES[some], NO_CONTACT[some], motion)
        np.testing.assert_array_equal(alone[0], together[b])


def test_each_call_takes_its_own_motion() -> None:
    kernel, depth = FotsKernel(X, Y, device="cpu"), depths()
    markers = np.tile(MARKERS, (len(BOXES), 1, 1))
    weak, strong = (replace(MOTION, dilate_gain=gain, dilate_lambda=4e4) for gain in (1e8, 2e8))
    moved = [kernel.displacement(markers, depth, BOXES, NO_CONTACT, motion) for motion in (weak, strong, weak)]
    assert np.abs(moved[0]).max() > 1e-6
    np.testing.assert_allclose(moved[1], 2.0 * moved[0], rtol=1e-5)
    np.testing.assert_array_equal(moved[2], moved[0])
