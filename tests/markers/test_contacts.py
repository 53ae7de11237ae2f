"""Contacts: pieces of the mask, and what the object did to each since first touch."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from raytac.errors import InputError
from raytac.gel.components import find_runs, join_runs
from raytac.gel.surface import GelSurface, PadGrid
from raytac.markers.contact_tracker import ContactTracker
from raytac.markers.contacts import ContactCells, Contacts
from tests.markers.pads import pose, pressed

DEEP = 5e-4


def follow(grid: PadGrid, *surfaces: GelSurface) -> Contacts:
    tracker, cells = ContactTracker(surfaces[0].batch), ContactCells.over(grid)
    return [tracker.update(surface, cells.sample(surface)) for surface in surfaces][-1]


@pytest.mark.parametrize("density", [0.02, 0.3, 0.5, 0.8, 1.0])
def test_components_are_those_of_scipy(density: float) -> None:
    mask = np.random.default_rng(0).random((3, 40, 50)) < density
    row, start, stop = find_runs(mask)
    number = join_runs(row, start, stop, 40)
    mine = np.zeros((120, 50), int)
    for k, (r, a, b) in enumerate(zip(row, start, stop, strict=True)):
        mine[r, a:b] = number[k] + 1
    eight = np.zeros((3, 3, 3), bool)
    eight[1] = True
    theirs, count = ndimage.label(mask, eight)  # type: ignore[misc]
    pairs = {(a, b) for a, b in zip(mine.ravel(), theirs.ravel(), strict=True)}
    assert len({p for p in pairs if p != (0, 0)}) == count == len(set(number))


def test_cells_hold_the_volume_of_the_indentation(grid: PadGrid) -> None:
    surface = pressed(grid, [(1e-3, -2e-3, DEEP)])
    cells = ContactCells.over(grid)
    dx, dy = grid.pitch
    volume = float((grid.rest - surface.height[0])[surface.contact[0]].sum()) * dx * dy
    assert cells.sample(surface).depth.sum() * cells.area == pytest.approx(volume, rel=1e-5)


def test_cells_reach_the_far_edges_of_the_pad(grid: PadGrid) -> None:
    corner = pressed(grid, [(float(grid.x[-1]), float(grid.y[-1]), DEEP)])
    samples = ContactCells.over(grid).sample(corner)
    assert samples.contact[0, -1, -1] and samples.depth[0, -1, -1] > 0


def test_centre_of_a_ball(grid: PadGrid) -> None:
    contacts = follow(grid, pressed(grid, [(1.03e-3, -2.41e-3, DEEP)]))
    assert contacts.active.tolist() == [[True]]
    assert contacts.centre[0, 0] == pytest.approx((1.03e-3, -2.41e-3), abs=1e-5)
    assert not contacts.shear.any() and not contacts.twist.any()


@pytest.mark.parametrize("radius", [0.5e-3, 2e-3, 5e-3])
def test_the_radius_counts_every_cell_that_a_disc_touches(radius: float, grid: PadGrid) -> None:
    """Over places at random, cells touched × their area is the area of the disc swept by a cell's nodes: π R² + 2 R (a + b) + a b."""
    cells, draw, radii = ContactCells.over(grid), np.random.default_rng(0), []
    for x, y in draw.uniform(-2e-3, 2e-3, (30, 2)):
        contact = (((grid.x - x) ** 2)[None, :] + ((grid.y - y) ** 2)[:, None] < radius**2)[None]
        height = (grid.rest - 1e-4 * contact).astype(np.float32)
        surface = GelSurface(grid, height, contact, np.array([[x, y]]), pose()[None])
        radii.append(ContactTracker(1).update(surface, cells.sample(surface)).radius[0, 0])
    a, b = ((count - 1) * pitch for count, pitch in zip(cells.nodes, grid.pitch, strict=True))
    swept = np.sqrt(radius**2 + (2.0 * radius * (a + b) + a * b) / np.pi)
    assert np.mean(radii) == pytest.approx(swept, abs=1e-5)
    assert 0.14e-3 < swept - radius < 0.17e-3  # the bias that it is, on this grid
    assert np.ptp(radii) < 0.15e-3


@pytest.mark.parametrize("angle_deg", [0.0, 35.0, 120.0])
def test_the_ellipse_of_an_elliptic_contact_is_its_own(angle_deg: float, grid: PadGrid) -> None:
    """Semi-axes 4 and 1.5 mm, anywhere, in any direction: the cells' ellipse, 0.15 mm wider all around; and what it is pressed in."""
    angle = np.deg2rad(angle_deg)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    x, y = np.meshgrid(grid.x - 1.1e-3, grid.y + 0.7e-3)
    own = np.stack([x, y], axis=-1) @ turn
    contact = ((own / (4e-3, 1.5e-3)) ** 2).sum(axis=-1) < 1
    height = (grid.rest - 1e-4 * contact).astype(np.float32)
    contacts = follow(grid, GelSurface(grid, height[None], contact[None], np.array([[1.1e-3, -0.7e-3]]), pose()[None]))
    xx, xy, yy = contacts.ellipse[0, 0]
    ellipse = np.array([[xx, xy], [xy, yy]])
    expected = turn @ np.diag(np.square((4.15e-3, 1.65e-3))) @ turn.T
    np.testing.assert_allclose(ellipse, expected, atol=0.05 * expected.max())
    assert np.sqrt(np.linalg.det(ellipse)) == pytest.approx(contacts.radius[0, 0] ** 2)
    volume = contact.sum() * 1e-4 * np.prod(grid.pitch)
    assert contacts.depth[0, 0] == pytest.approx(volume / (np.pi * contacts.radius[0, 0] ** 2), rel=1e-3)


def test_shear_and_twist_add_up_from_first_touch(grid: PadGrid) -> None:
    places = [(0.0, 0.0), (2e-4, 0.0), (2e-4, 3e-4)]
    twists = [0.3, 0.3, 0.5]
    surfaces = [
        pressed(grid, [(x, y, DEEP)], poses=[pose(x, y, -DEEP, twist)]) for (x, y), twist in zip(places, twists, strict=True)
    ]
    before = pressed(grid, [], poses=[pose(-5e-3, 0, 1e-3, -1.0)])
    contacts = follow(grid, before, *surfaces)
    # What it did before the touch counts for nothing.
    assert contacts.shear[0, 0] == pytest.approx((2e-4, 3e-4), abs=2e-6)
    assert contacts.twist[0, 0] == pytest.approx(0.2)


def test_an_object_turned_about_its_contact_does_not_shear(grid: PadGrid) -> None:
    place = (2e-3, 1e-3, DEEP)
    contacts = follow(grid, *(pressed(grid, [place], poses=[pose(2e-3, 1e-3, 0, t)]) for t in (0.0, 0.2, 0.4)))
    assert np.linalg.norm(contacts.shear) < 2e-6
    assert contacts.twist[0, 0] == pytest.approx(0.4)


def test_an_object_turned_about_another_point_shears_its_contact(grid: PadGrid) -> None:
    c, s = np.cos(0.3), np.sin(0.3)
    contacts = follow(
        grid,
        pressed(grid, [(2e-3, 0.0, DEEP)], poses=[pose()]),
        pressed(grid, [(2e-3 * c, 2e-3 * s, DEEP)], poses=[pose(twist=0.3)]),
    )
    assert contacts.shear[0, 0] == pytest.approx((2e-3 * (c - 1), 2e-3 * s), abs=3e-6)


def test_rolling_does_not_shear(grid: PadGrid) -> None:
    """A ball that rolls along x on the pressed gel: what stands still is its material at the contact's mean depth."""
    from tests.markers.pads import BALL

    still = follow(grid, pressed(grid, [(0.0, 0.0, DEEP)], poses=[pose(0.0, 0.0, BALL - DEEP)]))
    radius = BALL - DEEP + float(still.depth[0, 0])
    angles = np.linspace(0, 0.3, 31)
    surfaces = [pressed(grid, [(radius * a, 0.0, DEEP)], poses=[pose(radius * a, 0.0, BALL - DEEP, roll=a)]) for a in angles]
    contacts = follow(grid, *surfaces)
    assert contacts.centre[0, 0, 0] == pytest.approx(radius * 0.3, abs=1e-5)
    assert abs(contacts.shear[0, 0, 0]) < 0.01 * radius * 0.3


def test_release_forgets(grid: PadGrid) -> None:
    touching = [pressed(grid, [(x, 0.0, DEEP)], poses=[pose(x)]) for x in (0.0, 5e-4)]
    away = pressed(grid, [], poses=[pose(5e-4, 0, 1e-3)])
    again = pressed(grid, [(6e-4, 0.0, DEEP)], poses=[pose(6e-4)])
    assert follow(grid, *touching).shear[0, 0, 0] == pytest.approx(5e-4, abs=2e-6)
    assert not follow(grid, *touching, away, again).shear.any()


def test_reset_forgets_only_the_environments_named(grid: PadGrid) -> None:
    cells, tracker = ContactCells.over(grid), ContactTracker(2)

    def at(x: float) -> GelSurface:
        return pressed(grid, [(x, 0, DEEP)], [(x, 0, DEEP)], poses=[pose(x), pose(x)])

    tracker.update(at(0.0), cells.sample(at(0.0)))
    tracker.update(at(3e-4), cells.sample(at(3e-4)))
    tracker.reset([1])
    contacts = tracker.update(at(4e-4), cells.sample(at(4e-4)))
    assert contacts.shear[:, 0, 0] == pytest.approx((4e-4, 0.0), abs=2e-6)
    tracker.reset(np.array([True, False]))
    contacts = tracker.update(at(5e-4), cells.sample(at(5e-4)))
    assert contacts.shear[:, 0, 0] == pytest.approx((0.0, 1e-4), abs=2e-6)
    tracker.reset()
    assert not tracker.update(at(6e-4), cells.sample(at(6e-4))).shear.any()
    with pytest.raises(InputError, match="0 to 1"):
        tracker.reset([2])
    with pytest.raises(InputError, match=r"shape \(2,\)"):
        tracker.reset(np.ones(3, bool))


def test_two_contacts_each_with_its_own_history(grid: PadGrid) -> None:
    """A second foot comes down later: its history starts there."""
    one = pressed(grid, [(-4e-3, 0, DEEP)], poses=[pose()])
    both = pressed(grid, [(-4e-3, 2e-4, DEEP), (4e-3, 2e-4, DEEP)], poses=[pose(y=2e-4)])
    moved = pressed(grid, [(-4e-3, 5e-4, DEEP), (4e-3, 5e-4, DEEP)], poses=[pose(y=5e-4)])
    contacts = follow(grid, one, both, moved)
    order = np.argsort(contacts.centre[0, :, 0])
    assert contacts.active.sum() == 2
    assert contacts.shear[0, order, 1] == pytest.approx((5e-4, 3e-4), abs=2e-6)


def test_batch_is_single(grid: PadGrid) -> None:
    frames = [(0.0, 0.0), (1e-4, 2e-4), (4e-4, 2e-4)]
    envs = [
        [pressed(grid, [(x + dx, y, DEEP)], poses=[pose(x + dx, y)]) for x, y in frames] for dx in (0.0, 1e-3, -2.5e-3)
    ]  # fmt: skip
    envs[1] = [pressed(grid, [], poses=[pose(z=1e-3)])] * 3
    together = [
        GelSurface(
            grid,
            np.concatenate([env[k].height for env in envs]),
            np.concatenate([env[k].contact for env in envs]),
            np.concatenate([env[k].contact_centre for env in envs]),
            np.concatenate([np.asarray(env[k].pad_from_object) for env in envs]),
        )
        for k in range(3)
    ]
    batch = follow(grid, *together)
    for b, env in enumerate(envs):
        single = follow(grid, *env)
        for name in ("active", "centre", "shear", "twist", "radius"):
            np.testing.assert_allclose(getattr(batch, name)[b], getattr(single, name)[0], rtol=0, atol=1e-15)


def test_a_broken_environment_has_no_contact_and_harms_no_other(grid: PadGrid) -> None:
    surface = pressed(grid, [(0, 0, DEEP)], [(0, 0, DEEP)])
    height = surface.height.copy()
    height[0, :, len(grid.x) // 2] = np.nan
    contacts = follow(grid, replace(surface, height=height))
    assert contacts.active.tolist() == [[False], [True]]
