"""Slip with memory: what a contact keeps of its shear, and the shear that the physics knows."""

from __future__ import annotations

import math

import numpy as np
import pytest

from raytac.gel.contact_shear import ContactShear
from raytac.gel.surface import GelSurface, PadGrid, make_grid
from raytac.markers.config import Fots, FotsPublished, Superposition
from raytac.markers.contact_tracker import ContactTracker
from raytac.markers.contacts import TWIST_SLIP, ContactCells
from raytac.markers.tracker import MarkerTracker
from raytac.specs import BodySpec, RobotSpec, TaskScene, load_sensor
from raytac.world.world import TactileWorld
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
    np.testing.assert_array_equal(tables[0], tables[1])
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


def test_batch_is_single(grid: PadGrid) -> None:
    cells, both, alone = ContactCells.over(grid), ContactTracker(2, slip=SLIP), ContactTracker(1, slip=SLIP)
    for x in (0.0, 1e-3, 7e-4):
        two = pressed(grid, [(-x, 0.0, DEEP)], [(x, 0.0, DEEP)], poses=[pose(-x), pose(x)])
        pair = both.update(two, cells.sample(two)).table
        one = alone.update(at(grid, x), cells.sample(at(grid, x))).table
    np.testing.assert_allclose(pair[1], one[0], rtol=0, atol=1e-15)  # sums over more cells round otherwise
    assert pair[0, 0, 3] == pytest.approx(-one[0, 0, 3], abs=2e-6)


@pytest.mark.renderer
def test_a_slide_one_way_moves_the_dots_as_without_memory(grid: PadGrid) -> None:
    """At a constant depth, with the fitted motion of a pad: the limit at every surface is the limit of the whole."""
    sensor = load_sensor("gelsight_mini_9x11")
    config = Fots()
    assert config.slip(sensor) is not None
    model, cells = config.build(sensor, grid, num_envs=1, device="cpu"), ContactCells.over(grid)
    trackers = [ContactTracker(1, slip=slip) for slip in (config.slip(sensor), None)]
    rest = MarkerTracker(sensor, config, make_grid(sensor.gelpad, 1e-4), device="cpu").pattern.rest
    rest = np.ascontiguousarray(np.broadcast_to(rest, (1, *rest.shape[-2:])))
    for x in (0.0, 1e-3, 2e-3, 3e-3):
        surface = at(grid, x)
        samples = cells.sample(surface)
        kept, whole = (model.displacement(rest, surface, samples, tracker.update(surface, samples)) for tracker in trackers)
    assert np.abs(whole).max() > 1e-4
    np.testing.assert_allclose(kept, whole, rtol=0, atol=1e-9)


@pytest.mark.renderer
def test_dots_in_a_world_do_not_depend_on_the_frames_observed() -> None:
    """A plate that gravity pulls along x, held by friction: observed at every step or at the last only."""
    pull = 9.81 * np.array([0.36, 0.0, -1.0]) / np.hypot(1.0, 0.36)
    plate = BodySpec("plate", "box", {"length": 0.012, "width": 0.012, "height": 0.003}, position=(0.0, 0.0, 0.00151), mass=0.05)
    robot = RobotSpec("fixed_sensor", sensor="gelsight_mini_9x11")
    scene = TaskScene("tilt", robot, (plate,), timestep=0.01, control_timestep=0.01, gravity=tuple(pull.tolist()))
    moved = []
    for every in (True, False):
        world = TactileWorld(scene, markers="fots", outputs=("wrench",), device="cpu")
        for step in range(20):
            world.step()
            if every or step == 19:
                frame = world.observe()["sensor"]
        assert frame.markers is not None
        moved.append(frame.markers.displacement)
    np.testing.assert_array_equal(moved[0], moved[1])
    assert moved[0][..., 0].mean() > 1e-6
