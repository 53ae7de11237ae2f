"""Nodes that stand for a contact's samples in FOTS' dilation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from raytac.markers.fots import FotsKernel
from raytac.markers.sources import SourceLine, anterpolated, coarsening
from raytac.specs import load_sensor
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


def test_a_wide_gaussian_needs_few_nodes_and_a_narrow_one_all() -> None:
    motion = load_sensor("gelsight_mini_9x11").marker_motion
    assert motion is not None
    assert coarsening(X, motion.dilate_lambda) == 3
    line = SourceLine.of(X, motion.dilate_lambda)
    assert line.count == 22 - 1 + 8
    assert coarsening(X, 1e6) == 1
    assert SourceLine.of(X, 1e6).weights is None


def test_a_pad_does_not_depend_on_its_neighbours_to_the_last_bit() -> None:
    depth, x, y = depths(), SourceLine.of(X, 1.8e4), SourceLine.of(Y, 1.8e4)
    together = np.zeros((len(BOXES), y.count, x.count), np.float32)
    edges = anterpolated(depth, BOXES, x, y, together)
    for b in range(len(BOXES)):
        alone = np.zeros((1, y.count, x.count), np.float32)
        np.testing.assert_array_equal(anterpolated(depth[b : b + 1], BOXES[b : b + 1], x, y, alone)[0], edges[b])
        c0, c1, r0, r1 = edges[b].tolist()
        np.testing.assert_array_equal(alone[0, r0:r1, c0:c1], together[b, r0:r1, c0:c1])
        assert not np.delete(together[b], np.s_[c0:c1], axis=1).any() and not np.delete(together[b], np.s_[r0:r1], axis=0).any()
