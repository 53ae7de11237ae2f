"""The network mode: the image at rest is the background, device and NumPy agree, files come back or are refused."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from raytac.errors import CalibrationError, InputError
from raytac.gel.surface import GelSurface
from raytac.optics import Mlp
from raytac.optics.image.mlp_weights import (
    FORMAT,
    INPUTS,
    LEVELS,
    VERSION,
    MlpWeights,
    forward,
    inputs,
    load_mlp,
    save_mlp,
    view_slope,
)
from raytac.optics.image.network_files import view_size
from raytac.sensor import TactileSensor
from tests.conftest import make_sensor_spec
from tests.optics.scenes import ball, grid_of, surface

RESOLUTION = (80, 60)


def network(seed: int = 0) -> MlpWeights:
    rng = np.random.default_rng(seed)
    sizes = (INPUTS, 8, 6, 3)
    matrices = tuple(rng.normal(0, 0.7, (b, a)) for a, b in itertools.pairwise(sizes))
    background = rng.uniform(60, 160, (60, 80, 3)).round().astype(np.float32)
    return MlpWeights(matrices, tuple(rng.normal(0, 0.1, b) for b in sizes[1:]), background)


def _told_by_touch() -> tuple[MlpWeights, MlpWeights]:
    """Two networks that differ where the object touches, and nowhere else."""
    weights = network(1)
    matrix = weights.matrices[0].copy()
    matrix[:, -1] += 1.0
    return weights, dataclasses.replace(weights, matrices=(matrix, *weights.matrices[1:]))


def test_at_rest_it_shows_the_background() -> None:
    weights, spec = network(), make_sensor_spec()
    mode = Mlp(weights=weights).build(spec, resolution=RESOLUTION, device="cpu")
    rgb = mode.render(GelSurface.at_rest(grid_of(spec))).rgb
    assert rgb is not None
    np.testing.assert_array_equal(rgb[0], weights.background.astype(np.uint8))


def test_a_pixels_colour_is_the_networks() -> None:
    """Against a plain matrix product, on the slopes of the displacement that the mode itself sees."""
    weights, spec = network(1), make_sensor_spec()
    grid = grid_of(spec)
    height, contact = ball(grid)
    pressed = surface(grid, height, contact=contact)
    mode = Mlp(weights=weights).build(spec, resolution=RESOLUTION, device="cpu")
    levels = mode.render_levels(pressed)[0]
    _, moved = mode.image_heights(pressed)
    # Nodes in contact through every pixel's centre: the ball's disc, where the coat is deepest.
    only = [
        Mlp(weights=one).build(spec, resolution=RESOLUTION, device="cpu").render_levels(pressed)[0] for one in _told_by_touch()
    ]
    touched = (np.abs(only[0] - only[1]).max(axis=-1) > 1).astype(float)
    assert 0.01 < touched.mean() < 0.5 and moved[0][touched > 0].min() > 0
    sy, sx = np.gradient(moved[0].astype(float))
    sy *= mode.pitch[0] / mode.pitch[1]
    width, height = RESOLUTION
    u, v = np.meshgrid((np.arange(width) + 0.5) * 2 / width - 1, (np.arange(height) + 0.5) * 2 / height - 1)

    def net(slope_x: np.ndarray, slope_y: np.ndarray, touched: np.ndarray) -> np.ndarray:
        x = np.stack(inputs(np, slope_x, slope_y, touched, u, v, view_slope(spec)), axis=-1)
        for k, (matrix, offset) in enumerate(zip(weights.matrices, weights.offsets, strict=True)):
            x = x @ matrix.T + offset
            x = np.maximum(x, 0) if k < 2 else x
        return x

    expected = weights.background + LEVELS * (net(sx, sy, touched) - net(0 * u, 0 * u, 0 * u))
    inner = np.s_[2:-2, 2:-2]
    assert np.abs(levels - weights.background)[inner].max() > 10, "the press must show"
    np.testing.assert_allclose(levels[inner], expected[inner], atol=0.05)
    own = np.stack(forward(np, weights, inputs(np, sx, sy, touched, u, v, view_slope(spec))), axis=-1)
    np.testing.assert_allclose(own, net(sx, sy, touched), atol=1e-9)


def test_files_come_back_or_are_refused(tmp_path: Path) -> None:
    weights = network(2)
    save_mlp(weights, tmp_path / "mlp.npz")
    again = load_mlp(tmp_path)
    for old, new in zip((*weights.matrices, *weights.offsets), (*again.matrices, *again.offsets), strict=True):
        np.testing.assert_allclose(new, old, rtol=1e-6)
    sensor = TactileSensor("gelsight_mini", optics=Mlp(weights=tmp_path), outputs=("rgb",), device="cpu")
    assert "mlp" in sensor.label
    with pytest.raises(CalibrationError, match="holds one"):
        load_mlp(tmp_path / "none.npz")
    spec = make_sensor_spec()
    own = dataclasses.replace(weights, provenance={"sensor": "mine"}, view=view_size(spec))
    save_mlp(own, tmp_path / "own.npz")
    again = load_mlp(tmp_path / "own.npz")
    assert (again.provenance, again.view) == (own.provenance, pytest.approx(own.view))
    Mlp(weights=tmp_path / "own.npz").build(spec, device="cpu")
    pitch = tuple(1.2 * p for p in spec.camera.pixel_pitch)
    other = dataclasses.replace(spec, camera=dataclasses.replace(spec.camera, pixel_pitch=pitch))
    with pytest.raises(InputError, match="fitted to the sensor 'mine'"):
        Mlp(weights=tmp_path / "own.npz").build(other, device="cpu")
    broken = dataclasses.replace(weights, matrices=(weights.matrices[0][:, :5], *weights.matrices[1:]))
    save_mlp(broken, tmp_path / "broken.npz")
    with pytest.raises(CalibrationError, match="matrix_0"):
        load_mlp(tmp_path / "broken.npz")
    with pytest.raises(InputError, match="must name a network"):
        Mlp().build(make_sensor_spec(), device="cpu")


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({"version": np.int64(VERSION + 1)}, f"'{VERSION + 1}'"),
        ({"version": np.zeros(3)}, "float64 (3,)"),
        ({"version": None}, "missing"),
        ({"format": "other net"}, "other net"),
        ({"format": None, "version": None}, "0, of before files said it"),
    ],
)
def test_files_of_another_version_are_refused_by_both_names(changes: dict[str, Any], found: str, tmp_path: Path) -> None:
    """And not by an array that happens to have another shape."""
    path = tmp_path / "mlp.npz"
    save_mlp(network(), path)
    with np.load(path) as arrays:
        content: dict[str, Any] = {name: arrays[name] for name in arrays.files} | changes
    np.savez(path, **{name: value for name, value in content.items() if value is not None})
    with pytest.raises(CalibrationError) as told:
        load_mlp(path)
    ours = FORMAT if changes.get("format") else str(VERSION)
    assert found in str(told.value) and f"must be {ours!r}" in str(told.value) and "raytac calibrate" in str(told.value)
