"""Slip with memory: what a contact keeps of its shear, and the shear that the physics knows."""

from __future__ import annotations

import math

import numpy as np
import pytest

from raytac.gel.surface import GelSurface, PadGrid
from raytac.markers.config import Fots, FotsPublished, Superposition
from raytac.markers.contacts import TWIST_SLIP, ContactCells, ContactTracker
from raytac.physics.rigid.shear import ContactShear
from tests.markers.pads import pose, pressed

DEEP, SLIP = 5e-4, 500.0


def at(grid: PadGrid, x: float, twist: float = 0.0) -> GelSurface:
    return pressed(grid, [(x, 0.0, DEEP)], poses=[pose(x, 0.0, 0.0, twist)])


def sheared(grid: PadGrid, places: np.ndarray, slip: float | None) -> np.ndarray:
    tracker, cells = ContactTracker(1, slip=slip), ContactCells.over(grid)
    surfaces = [at(grid, x) for x in places.tolist()]
    return np.array([tracker.update(surface, cells.sample(surface)).shear[0, 0, 0] for surface in surfaces])


def limit(grid: PadGrid) -> float:
    surface = at(grid, 0.0)
    contact = ContactTracker(1).update(surface, ContactCells.over(grid).sample(surface))
    xx, xy, yy = contact.ellipse[0, 0]
    return SLIP * contact.depth[0, 0] * (xx * yy - xy * xy) ** 0.25


def test_a_reversal_after_sliding_flips_the_shear_after_the_limit_is_unloaded(grid: PadGrid) -> None:
    most = limit(grid)
    out, back = np.linspace(0.0, 5.0, 11) * most, (5.0 - np.linspace(0.25, 4.0, 16)) * most
    shear = sheared(grid, np.concatenate([out, back]), SLIP) / most
    assert shear[10] == pytest.approx(1.0, abs=0.1)
    travel = np.linspace(0.25, 4.0, 16)
    np.testing.assert_allclose(shear[11:], np.maximum(1.0 - travel, -1.0), atol=0.15)
    assert sheared(grid, np.concatenate([out, back]), None)[-1] > 0.0


def test_what_sticks_is_the_history_without_slip(grid: PadGrid) -> None:
    places = np.linspace(0.0, 0.8, 5) * limit(grid)
    np.testing.assert_array_equal(sheared(grid, places, SLIP), sheared(grid, places, None))


def test_twist_slips_and_returns(grid: PadGrid) -> None:
    tracker, cells = ContactTracker(1, slip=SLIP), ContactCells.over(grid)
    surfaces = [at(grid, 0.0, twist) for twist in (0.0, 0.5, 1.0, 0.9)]
    contacts = [tracker.update(surface, cells.sample(surface)) for surface in surfaces]
    most = TWIST_SLIP * SLIP * contacts[0].depth[0, 0]
    assert contacts[2].twist[0, 0] == pytest.approx(most, rel=1e-3)
    assert contacts[3].twist[0, 0] == pytest.approx(most - 0.1, rel=1e-3)


def known(*stretch: tuple[float, float], centre: tuple[float, float] = (3e-4, 0.0), spin: float = 0.02) -> ContactShear:
    n = len(stretch)
    return ContactShear(np.array(stretch), np.full(n, spin), np.ones(n), np.tile([*centre, -1e-4], (n, 1)))


def test_the_shear_of_the_physics_needs_no_earlier_surface(grid: PadGrid) -> None:
    cells, every, last = ContactCells.over(grid), ContactTracker(1), ContactTracker(1)
    for x in (0.0, 1e-4, 2e-4):
        every.update(at(grid, x), cells.sample(at(grid, x)), None, known((0.5 * x, 0.0), centre=(x, 0.0)))
    end = at(grid, 3e-4)
    tables = [tracker.update(end, cells.sample(end), None, known((-4e-5, 1e-5))).table for tracker in (every, last)]
    np.testing.assert_array_equal(*tables)
    np.testing.assert_allclose(tables[0][0, 0, 3:6], (-4e-5, 1e-5, 0.02))


@pytest.mark.parametrize("spoil", ["far", "none", "nan"])
def test_a_contact_without_a_shear_keeps_its_history(spoil: str, grid: PadGrid) -> None:
    cells, tracker = ContactCells.over(grid), ContactTracker(1)
    tracker.update(at(grid, 0.0), cells.sample(at(grid, 0.0)))
    shear = {
        "far": known((1.0, 1.0), centre=(8e-3, 6e-3)),
        "none": ContactShear(np.zeros((1, 2)), np.zeros(1), np.zeros(1), np.zeros((1, 3))),
        "nan": known((math.nan, math.nan)),
    }[spoil]
    contacts = tracker.update(at(grid, 3e-4), cells.sample(at(grid, 3e-4)), None, shear)
    assert contacts.shear[0, 0] == pytest.approx((3e-4, 0.0), abs=2e-6)


def test_which_models_follow() -> None:
    assert Fots.follows_shear and Superposition.follows_shear and not FotsPublished.follows_shear
