"""The looks that hard cases are judged by: each is seen to notice what it is there for."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

import ipc
from tests.ipc.hard.oracle import Oracle, exact_determinant, least_det_f
from tests.ipc.hard.parts import voussoirs
from tests.ipc.hard.piles import least_friction, profiles
from tests.ipc.hard.run import Setup, mass, solid, world_of
from tests.ipc.hard.shapes import SIZE, cube, moved


def two(gap: float, soft: bool = True, **settings: object) -> ipc.World:
    """A cube over a cube over a half-space, ``gap`` apart, the upper one a little to the side."""
    meshes = moved(cube(), (0, 0, gap)), moved(cube(), (1e-3, 2e-3, SIZE + 2 * gap))
    bodies = [solid(name, mesh, soft) for name, mesh in zip(("lower", "upper"), meshes, strict=True)]
    return world_of([*bodies, ipc.HalfSpace("floor")], Setup(), **settings)


@pytest.mark.parametrize("shift", [(0, 0, -2e-3), (0.3 * SIZE, 0.3 * SIZE, -0.3 * SIZE)])
def test_surfaces_that_cross_are_seen(shift: tuple[float, float, float]) -> None:
    world = two(1e-3)
    oracle = Oracle(world)
    assert oracle.crossed() == 0
    state, upper = world.save(), slice(8, 16)
    state.y[0, upper] += shift
    world._potential.y.assign(state.y)  # restore() would refuse it
    world._potential.place_vertices(world._potential.y, world._potential.R, world._potential.t, world._potential.x)
    assert oracle.crossed() == 1


def test_a_vertex_below_a_half_space_is_seen() -> None:
    world = two(1e-3)
    oracle = Oracle(world)
    world._potential.y.assign(world.save().y - np.array([0.0, 0.0, 1.1e-3]))
    assert oracle.crossed() == 1


def test_the_sign_of_det_f_is_exact() -> None:
    """Four points in a plane that no coordinate plane is: one rounding up or down decides, and float64 does not see it."""
    rest = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    a = np.array([0.1, 0.7, 0.3])
    flat = np.array([a, a + 0.5, a + np.array([0.25, 0.125, 0.5]), a + np.array([0.75, 0.625, 1.0])])
    signs: list[float] = []
    for direction in (np.inf, -np.inf):
        now = flat.copy()
        now[3, 2] = np.nextafter(now[3, 2], direction)
        least, exact = least_det_f(now, rest, np.array([[0, 1, 2, 3]])), exact_determinant(now)
        assert isinstance(exact, Fraction) and least == float(exact) and abs(least) < 1e-15
        signs.append(np.sign(least))
    assert sorted(signs) == [-1.0, 1.0]
    assert least_det_f(2 * rest, rest, np.array([[0, 1, 2, 3]])) == pytest.approx(8.0, rel=1e-14)


@pytest.mark.parametrize("soft", [True, False])
def test_barrier_energy_is_that_of_the_first_report(soft: bool) -> None:
    """A step of a nanosecond moves nothing."""
    world = two(5e-5, soft, gravity=(0, 0, 0), dt=1e-9, kappa=1e5)
    assert Oracle(world).barrier_energy() == pytest.approx(float(world.step().barrier[0]), rel=1e-6)


def test_least_friction_of_two_blocks_is_their_closed_form() -> None:
    """Two halves lean on each other at the top of the crown and stand on the inner ends of their feet: μ = (r − c)/R, c their centroid."""
    inner, outer = 17e-3, 23e-3
    meshes = voussoirs(2, (inner + outer) / 2, outer - inner, 10e-3, 0.0)
    centre = (outer**3 - inner**3) / (3 * (outer**2 - inner**2))
    assert mass(meshes[0]) == pytest.approx(1000 * 0.01 * (outer**2 - inner**2) / 2, rel=1e-12)
    assert least_friction(profiles(meshes)) == pytest.approx((inner - centre) / outer, rel=1e-4)


def test_a_thin_arch_stands_with_no_friction() -> None:
    """Half a round arch needs a thickness of 0.1075 of its radius (Milankovitch 1907), whatever μ is."""
    for thickness, stands in ((0.10, False), (0.115, True)):
        arch = voussoirs(41, 1.0, thickness, 0.1, 0.0)
        assert (least_friction(profiles(arch)) < 1.0) == stands
