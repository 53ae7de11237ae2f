"""Fits of table, network and colour shading to photographs of ball presses.

Table and network are fitted to samples: slopes as the model's own front step sees them, beside the real colours. The imprints of the
balls are known from a fit of the lights.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from raytac.calibrate.imprint import KNOTS, press_surface
from raytac.calibrate.photographs import Photographs, decode, level_slope
from raytac.errors import InputError
from raytac.gel.surface import GelSurface, make_grid
from raytac.optics.image.config import Phong
from raytac.optics.image.mlp_weights import INPUTS, LEVELS, MlpWeights, inputs, view_slope
from raytac.optics.image.network_files import view_size
from raytac.optics.response import fit_log_gain
from raytac.optics.taxim.bake.fit import BinSums, two_sheets
from raytac.optics.taxim.bake.settings import PLAIN, BakeSettings
from raytac.optics.taxim.bake.shadow import bake_shadow
from raytac.optics.taxim.bake.views import Calibration
from raytac.optics.taxim.table import PolyTable, slope_bins
from raytac.optics.trace.config import RayTraced
from raytac.optics.trace.tracer import total
from raytac.specs import SensorSpec


@dataclass(frozen=True)
class TableSettings:
    """Settings of ``fit_table``."""

    n_bins: int = 60
    """Bins of magnitude and direction; 20 presses of a Mini do not fill upstream's 125."""
    neighbours: float = 1.0
    """Weight of a bin's eight neighbours over its own, high since photographs are few."""
    ridge: float = 1e-4
    """Ridge of the least squares, as in ``BakeSettings``."""


@dataclass(frozen=True)
class MlpSettings:
    """Settings of ``fit_mlp``: Adam with decoupled weight decay."""

    hidden: tuple[int, ...] = (32, 32, 32)
    """Widths of the hidden layers (FOTS)."""
    batch: int = 2048
    """Samples a step."""
    epochs: int = 40
    """Passes over all samples."""
    rate: float = 4e-3
    """First step size; it falls to 2 % by a cosine."""
    decay: float = 1e-4
    """Weight decay a step, over the step size."""
    flat: float = 0.04
    """Samples of pixels that did not move, over those that did (FOTS)."""
    samples: int = 60_000
    """Most samples that a fit uses."""


@dataclass(frozen=True)
class ShadingSettings:
    """Settings of ``with_shading``."""

    degree: int = 6
    """Degree of the polynomial: at 6 it has 28 coefficients a channel."""
    ridge: float = 1e-5
    """Ridge of the least squares: far below a level, except where a photograph is dark."""
    pitch: float = 0.12e-3
    """Spacing of the pad's nodes [m]; the pad is smooth."""


@dataclass(frozen=True)
class PressSamples:
    """One row a displaced pixel, K in all; each (K,) but for the last."""

    press: np.ndarray
    row: np.ndarray
    column: np.ndarray
    slope_x: np.ndarray
    """∂/∂x of the displacement."""
    slope_y: np.ndarray
    touched: np.ndarray
    """True where the ball touches."""
    difference: np.ndarray
    """Difference from the background [levels], (K, 3)."""


def press_samples(
    sensor: SensorSpec,
    shots: Photographs,
    circles: np.ndarray,
    slopes: np.ndarray,
    *,
    device: str = "auto",
    reach: float = KNOTS[-1],
    least: float = 5e-6,
    pitch: float = 0.06e-3,
) -> PressSamples:
    """Samples within ``reach`` radii of the ``circles`` (N, 3) [px] of ``shots``.

    Their imprints have the ``slopes`` of ``imprint``. ``least``: displacement [m] from which a pixel is a sample. ``pitch``: spacing of
    the pad's nodes [m], about a pixel's.
    """
    height, width = shots.background.shape[:2]
    background = np.zeros((height, width, 3), np.uint8)  # the front step needs none
    front = Phong(background=background).build(sensor, resolution=(width, height), device=device)
    grid = make_grid(sensor.gelpad, pitch)
    aspect = front.pitch[0] / front.pitch[1]
    distance = Photographs(shots.background, shots.presses, circles, shots.radius).distance(sensor)
    parts = []
    for k in range(len(circles)):
        _, moved = front.image_heights(press_surface(sensor, grid, circles[k : k + 1], shots.radius[k : k + 1], slopes))
        moved = moved[0].astype(float)
        inner = np.pad(moved[1:-1, 1:-1], 1, mode="edge")
        slope_x, slope_y = np.zeros_like(moved), np.zeros_like(moved)
        slope_x[1:-1, 1:-1] = 0.5 * (moved[1:-1, 2:] - moved[1:-1, :-2])
        slope_y[1:-1, 1:-1] = 0.5 * aspect * (moved[2:, 1:-1] - moved[:-2, 1:-1])
        row, column = np.nonzero((distance[k] < reach) & (inner > least / front.pitch[0]))
        keep = (row > 0) & (row < height - 1) & (column > 0) & (column < width - 1)
        row, column = row[keep], column[keep]
        change = shots.presses[k, row, column] - shots.background[row, column]
        touched = distance[k, row, column] < 1
        parts.append((np.full(len(row), k), row, column, slope_x[row, column], slope_y[row, column], touched, change))
    return PressSamples(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def fit_table(
    sensor: SensorSpec, background: np.ndarray, samples: PressSamples, settings: TableSettings = TableSettings()
) -> PolyTable:
    """Taxim table of ``samples`` over the real ``background`` (H, W, 3) [levels].

    Its sheets are those of ``two_sheets``. It has no shadows: photographs of balls say too little about them.
    """
    height, width = background.shape[:2]
    i, j = slope_bins(samples.slope_x, samples.slope_y, settings.n_bins)
    touched, around = (BinSums(settings.n_bins, (width, height)) for _ in range(2))
    for sums, own in ((touched, samples.touched), (around, ~samples.touched)):
        sums.add(i[own], j[own], samples.column[own], samples.row[own], samples.difference[own].astype(np.float32))
    _, sheets = two_sheets(touched, around, neighbours=settings.neighbours, ridge=settings.ridge)
    return PolyTable(
        **sheets,
        background=background.astype(np.float32),
        pixel_pitch=sensor.camera.pitch_at((width, height)),
        rest_image=np.clip(np.rint(background), 0, 255).astype(np.uint8),
        constants=PLAIN,
        provenance={"source": "real presses of balls", "sensor": sensor.name, "presses": str(len(np.unique(samples.press)))},
    )


def with_cast_shadows(
    table: PolyTable,
    lit: SensorSpec,
    *,
    device: str = "auto",
    seed: int = 0,
    settings: BakeSettings | None = None,
    tick: Callable[[int], None] | None = None,
) -> PolyTable:
    """``table`` with a shadow table of pins and balls.

    The ray tracer renders them under the fitted lights of ``lit``. The table's background is their flat field, so that both tables are
    differences in levels from one image by one response. ``tick`` is called with the number of images rendered so far.
    """
    height, width = table.background.shape[:2]
    field = np.clip(np.rint(table.background), 0, 255).astype(np.uint8)
    at, rendered = Calibration(lit, device=device, resolution=(width, height), seed=seed, flat_field=field), 0

    def count_rendered(count: int) -> None:
        nonlocal rendered
        rendered += count
        if tick is not None:
            tick(rendered)

    shadow = bake_shadow(at, settings=settings, seed=seed, tick=count_rendered)
    return dataclasses.replace(table, shadow=shadow, provenance=table.provenance | {"shadow": "cast by the fitted ray tracer"})


def fit_mlp(
    sensor: SensorSpec,
    background: np.ndarray,
    samples: PressSamples,
    *,
    seed: int = 0,
    settings: MlpSettings = MlpSettings(),
    tick: Callable[[int], None] | None = None,
) -> MlpWeights:
    """Network of ``samples`` over ``background`` (H, W, 3) [levels]; ``tick`` counts passes."""
    rng = np.random.default_rng(seed)
    height, width = background.shape[:2]
    chosen = rng.permutation(len(samples.row))[: settings.samples]
    flat = round(settings.flat * len(chosen))
    column = np.concatenate([samples.column[chosen], rng.integers(width, size=flat)])
    row = np.concatenate([samples.row[chosen], rng.integers(height, size=flat)])
    features = (samples.slope_x, samples.slope_y, samples.touched.astype(float))
    slope_x, slope_y, touched = (np.concatenate([f[chosen], np.zeros(flat)]) for f in features)
    target = (np.concatenate([samples.difference[chosen], np.zeros((flat, 3))]) / LEVELS).astype(np.float32)
    u, v = (column + 0.5) * (2 / width) - 1, (row + 0.5) * (2 / height) - 1
    x = np.stack(inputs(np, slope_x, slope_y, touched, u, v, view_slope(sensor)), axis=1).astype(np.float32)
    sizes = (INPUTS, *settings.hidden, 3)
    matrices: list[np.ndarray] = [rng.normal(0, np.sqrt(2 / a), (b, a)).astype(np.float32) for a, b in itertools.pairwise(sizes)]
    matrices[-1] *= 0.1
    values: list[np.ndarray] = matrices + [np.zeros(b, np.float32) for b in sizes[1:]]
    count, step = len(matrices), 0
    first, second = ([0 * w for w in values] for _ in range(2))
    steps = settings.epochs * -(-len(x) // settings.batch)
    for epoch in range(settings.epochs):
        order = rng.permutation(len(x))
        for at in range(0, len(x), settings.batch):
            rows = order[at : at + settings.batch]
            gradients = _gradients(values, count, x[rows], target[rows])
            step += 1
            rate = settings.rate * (0.02 + 0.98 * 0.5 * (1 + np.cos(np.pi * step / steps)))
            for k, gradient in enumerate(gradients):
                first[k] = 0.9 * first[k] + 0.1 * gradient
                second[k] = 0.999 * second[k] + 0.001 * gradient * gradient
                change = first[k] / (1 - 0.9**step) / (np.sqrt(second[k] / (1 - 0.999**step)) + 1e-8)
                decay = settings.decay * values[k] if k < count else 0
                values[k] = values[k] - np.float32(rate) * (change + decay)
        if tick is not None:
            tick(epoch + 1)
    provenance = {"source": "real presses of balls", "sensor": sensor.name, "seed": str(seed)}
    return MlpWeights(tuple(values[:count]), tuple(values[count:]), background.astype(np.float32), provenance, view_size(sensor))


def _gradients(values: list[np.ndarray], count: int, x: np.ndarray, target: np.ndarray) -> list[np.ndarray]:
    """Gradients of half the mean squared error by every matrix and offset."""
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


def with_shading(
    sensor: SensorSpec,
    background: np.ndarray,
    *,
    device: str = "auto",
    settings: ShadingSettings = ShadingSettings(),
    tracing: RayTraced | None = None,
) -> SensorSpec:
    """The sensor with the colour shading that gives ``background`` (H, W, 3) [levels] at rest.

    ``background`` covers the camera's whole image. Least squares of the logarithm of the quotient, weighted so that residuals are levels
    of the image to first order. ``tracing``: how rays are traced. Raises InputError: more than half of a channel of ``background`` is not
    brighter than the sensor's black level, or a pixel at rest is dark or negative after the colour matrix; BackendError: the ray tracer
    cannot run on ``device``.
    """
    height, width = background.shape[:2]
    bare = sensor.response.unshaded
    plain = dataclasses.replace(sensor, response=bare)
    tracer = (tracing or RayTraced()).build(plain, resolution=(width, height), outputs=("layers",), device=device)
    layers = tracer.render_layers(GelSurface.at_rest(make_grid(sensor.gelpad, settings.pitch)))
    rest = tracer.response.mixed(total(layers)[0]) * tracer.response.scale
    if not (rest > 0).all():
        rule = (
            "leave this many values of the image at rest dark or negative after the colour matrix, and no gain makes these bright"
        )
        raise InputError("lights", value=int((rest <= 0).sum()), rule=rule)
    gamma, black = bare.gamma, np.asarray(bare.black_level)
    light = decode(background, gamma, bare.curve)
    target = light - black
    lit = target > 0
    if (lit.mean((0, 1)) < 0.5).any():
        rule = "more than half of a channel must be brighter than the black level"
        raise InputError("background", value=lit.mean((0, 1)).round(2).tolist(), rule=rule)
    # d level / d log gain = d level / d light · target
    slope = np.where(lit, level_slope(light, gamma, bare.curve) * target, 0.0)
    gain = np.where(lit, target, rest) / rest
    red, green, blue = (fit_log_gain(gain[..., c], slope[..., c] ** 2, settings.degree, ridge=settings.ridge) for c in range(3))
    return dataclasses.replace(
        sensor, response=dataclasses.replace(bare, shading_red=red, shading_green=green, shading_blue=blue)
    )
