"""Training of the network of ``optics="mlp"``: mean squared error by Adam, in NumPy; seconds on one core."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np

from raytac.calibrate.press_samples import PressSamples
from raytac.optics.image.mlp_weights import INPUTS, LEVELS, MlpWeights, inputs, view_size, view_slope
from raytac.specs.sensor import SensorSpec

__all__ = ["fit_mlp"]

HIDDEN = (32, 32, 32)
"""Widths of the hidden layers (FOTS)."""
BATCH, EPOCHS, RATE = 2048, 40, 4e-3
"""Samples a step, passes over all samples, first step size; it falls to 2 % by a cosine."""
DECAY = 1e-4
"""Pull of weights to 0 a step, over the step size."""
FLAT = 0.04
"""Samples of pixels that did not move, over those that did (FOTS)."""
MOST = 60_000
"""Most samples that a fit uses."""


def fit_mlp(
    sensor: SensorSpec,
    background: np.ndarray,
    samples: PressSamples,
    *,
    seed: int = 0,
    tick: Callable[[int], None] | None = None,
) -> MlpWeights:
    """The network of ``samples`` over the real ``background`` (H, W, 3) [levels]. The same seed gives the same network.

    ``tick`` is told every pass that is done.
    """
    rng = np.random.default_rng(seed)
    height, width = background.shape[:2]
    chosen = rng.permutation(len(samples.row))[:MOST]
    flat = round(FLAT * len(chosen))
    column = np.concatenate([samples.column[chosen], rng.integers(width, size=flat)])
    row = np.concatenate([samples.row[chosen], rng.integers(height, size=flat)])
    told = (samples.slope_x, samples.slope_y, samples.touched.astype(float))
    slope_x, slope_y, touched = (np.concatenate([s[chosen], np.zeros(flat)]) for s in told)
    target = np.concatenate([samples.difference[chosen], np.zeros((flat, 3))]) / LEVELS
    u, v = (column + 0.5) * (2 / width) - 1, (row + 0.5) * (2 / height) - 1
    x = np.stack(inputs(np, slope_x, slope_y, touched, u, v, view_slope(sensor)), axis=1).astype(np.float32)
    target = target.astype(np.float32)
    sizes = (INPUTS, *HIDDEN, 3)
    matrices: list[np.ndarray] = [rng.normal(0, np.sqrt(2 / a), (b, a)).astype(np.float32) for a, b in itertools.pairwise(sizes)]
    matrices[-1] *= 0.1
    values: list[np.ndarray] = matrices + [np.zeros(b, np.float32) for b in sizes[1:]]
    count, step = len(matrices), 0
    first: list[np.ndarray] = [0 * w for w in values]
    second: list[np.ndarray] = [0 * w for w in values]
    steps = EPOCHS * -(-len(x) // BATCH)
    for epoch in range(EPOCHS):
        order = rng.permutation(len(x))
        for at in range(0, len(x), BATCH):
            rows = order[at : at + BATCH]
            gradients = _gradients(values, count, x[rows], target[rows])
            step += 1
            rate = RATE * (0.02 + 0.98 * 0.5 * (1 + np.cos(np.pi * step / steps)))
            for k, gradient in enumerate(gradients):
                first[k] = 0.9 * first[k] + 0.1 * gradient
                second[k] = 0.999 * second[k] + 0.001 * gradient * gradient
                change = first[k] / (1 - 0.9**step) / (np.sqrt(second[k] / (1 - 0.999**step)) + 1e-8)
                decay = DECAY * values[k] if k < count else 0
                values[k] = values[k] - np.float32(rate) * (change + decay)
        if tick is not None:
            tick(epoch + 1)
    provenance = {"source": "real presses of balls", "sensor": sensor.name, "seed": str(seed)}
    return MlpWeights(tuple(values[:count]), tuple(values[count:]), background.astype(np.float32), provenance, view_size(sensor))


def _gradients(values: list[np.ndarray], count: int, x: np.ndarray, target: np.ndarray) -> list[np.ndarray]:
    """Of half the mean squared error by every matrix and offset."""
    layers = [x]
    for k in range(count):
        y = layers[-1] @ values[k].T + values[count + k]
        layers.append(np.maximum(y, 0) if k < count - 1 else y)
    error = (layers[-1] - target) / len(x)
    by_matrix, by_offset = [], []
    for k in range(count - 1, -1, -1):
        by_matrix.append(error.T @ layers[k])
        by_offset.append(error.sum(0))
        error = (error @ values[k]) * (layers[k] > 0)
    return by_matrix[::-1] + by_offset[::-1]
