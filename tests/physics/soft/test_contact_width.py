"""Width of a contact in cells: closed forms, an independent distance transform, and what does not count."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from raytac.gel.coat_mesh import CoatMesh
from raytac.gel.surface import GelSurface, make_grid
from raytac.physics.soft.contact_width import NarrowContactWarning, _inscribed, cells_across, holds_force, warn_if_narrow
from raytac.physics.soft.mesh import PAD_LEVELS, pad_mesh
from raytac.specs import load_press, load_sensor
from raytac.specs.press import PADS, StageSpec

PAD = load_sensor("gelsight_mini").gelpad
GRID = make_grid(PAD, 0.05e-3)
X, Y = np.meshgrid(GRID.x, GRID.y)
WITHIN = 2 * 0.05e-3
"""Two nodes of the grid, as ``cells_across`` states."""


def coat(cell: float) -> CoatMesh:
    """Square cells; only the lines matter."""
    lines = cell * (np.arange(80) - 40.3)
    return CoatMesh(np.zeros((80 * 80, 3)), np.array([[0, 1, 80]], np.int32), lines, lines)


def touched(*masks: np.ndarray) -> GelSurface:
    contact = np.stack(masks)
    height = np.repeat(GRID.rest[None].astype(np.float32), len(masks), axis=0)
    return GelSurface(GRID, height, contact, np.zeros((len(masks), 2)))


def disc(radius: float, x: float = 0.0, y: float = 0.0) -> np.ndarray:
    return (X - x) ** 2 + (Y - y) ** 2 < radius**2


@pytest.mark.parametrize("width", [0.4e-3, 1.03e-3, 3e-3])
def test_discs_strips_and_rings_are_as_wide_as_they_are(width: float) -> None:
    cell = 0.5e-3
    masks = [disc(0.5 * width, 1.013e-3, -2.021e-3)]
    for angle in (0.0, 0.4, 0.5 * np.pi):
        masks.append((np.abs(np.cos(angle) * X + np.sin(angle) * Y - 1e-5) < 0.5 * width) & (np.hypot(X, Y) < 6e-3))
    masks.append(disc(3e-3 + width) & ~disc(3e-3))
    found = cells_across(touched(*masks), coat(cell)) * cell
    assert found == pytest.approx(width, abs=WITHIN)


@pytest.mark.parametrize("density", [0.5, 0.9, 0.99])
def test_distances_are_those_of_scipy(density: float) -> None:
    mask = np.random.default_rng(0).random((60, 70)) < density
    pitch = 0.11, 0.09
    expected = ndimage.distance_transform_edt(np.pad(mask, 1), sampling=pitch[::-1])[1:-1, 1:-1]  # type: ignore[index]
    assert np.abs(_inscribed(mask, pitch) - expected).max() < 1e-12


def test_the_narrow_patch_counts_if_it_is_not_a_speck() -> None:
    cell, wide = 0.5e-3, disc(2e-3, -3e-3)
    narrow = wide | disc(0.8e-3, 3e-3)
    speck = wide | disc(0.2e-3, 3e-3)
    two, one, none = cells_across(touched(narrow, speck, np.zeros_like(wide)), coat(cell))
    assert two * cell == pytest.approx(1.6e-3, abs=WITHIN)
    assert one * cell == pytest.approx(4e-3, abs=WITHIN)
    assert np.isnan(none)
    pins = np.any([disc(0.3e-3, x, y) for x in np.arange(-4, 5) * 1e-3 for y in np.arange(-3, 4) * 1e-3], axis=0)
    assert cells_across(touched(pins), coat(cell))[0] * cell == pytest.approx(0.6e-3, abs=WITHIN)


def test_cells_are_those_under_the_patch() -> None:
    """The pad's cells grow towards its edges, and each level's are finer than those before it."""
    levels = [pad_mesh(PAD, level).coat for level in PADS]
    middle, beside = disc(1.5e-3), disc(1.5e-3, 7e-3)
    found = np.array([cells_across(touched(middle, beside), mesh) for mesh in levels])
    assert (found[:, 0] > found[:, 1]).all() and (np.diff(found, axis=0) > 0.0).all()
    cell = max(np.diff(lines)[len(lines) // 2] for lines in (levels[0].lines_x, levels[0].lines_y))
    assert found[0, 0] == pytest.approx(3e-3 / cell, abs=WITHIN / cell)


def test_the_warning_names_level_width_rule_and_the_next_level() -> None:
    assert tuple(PAD_LEVELS) == PADS
    for level, way in (
        ("coarse", "level='medium'"),
        ("medium", "level='fine'"),
        ("fine", "mesh of your own"),
        ("own", "mesh of your own"),
    ):
        with pytest.warns(NarrowContactWarning, match=rf"level = '{level}': the contact is 2\.5 cells across.*at least 6.*{way}"):
            assert warn_if_narrow(np.array([2.5]), level, stacklevel=1)
    with pytest.warns(NarrowContactWarning, match="in environment 1 is 2.0"):
        assert warn_if_narrow(np.array([np.nan, 2.0, 4.0]), "coarse", stacklevel=1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not warn_if_narrow(np.array([6.0]), "coarse", stacklevel=1)
        assert not warn_if_narrow(np.array([np.nan]), "coarse", stacklevel=1)


def test_a_force_holds_through_what_follows() -> None:
    deep, loaded, turn = StageSpec("indent", depth=1e-4), StageSpec("indent", force=1.0), StageSpec("twist", twist=0.1)
    scene = replace(load_press("sphere"), trajectory=(deep, turn, loaded, turn, deep))
    assert [holds_force(scene, stage) for stage in range(5)] == [False, False, True, True, False]
