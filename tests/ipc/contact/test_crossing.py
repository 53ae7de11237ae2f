"""The exact test of edges and triangles against rational arithmetic, and what is said of surfaces that touch."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction

import numpy as np
import pytest

import ipc
from ipc.contact import overlap
from ipc.contact.overlap import APART, CROSSING, TOUCHING, meet, orientation
from tests.ipc.conftest import turns, unit_cell

Point = list[Fraction]


def rational(x: np.ndarray) -> list[Point]:
    return [[Fraction(float(c)) for c in point] for point in x]


def minus(a: Point, b: Point) -> Point:
    return [x - y for x, y in zip(a, b, strict=True)]


def dot(a: Point, b: Point) -> Fraction:
    return sum((x * y for x, y in zip(a, b, strict=True)), Fraction(0))


def cross(a: Point, b: Point) -> Point:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def segments_meet(p: Point, q: Point, a: Point, b: Point) -> bool:
    """Two segments of one plane: they meet where both contain a common point, an end of one or the crossing of the lines."""
    u, v, w = minus(q, p), minus(b, a), minus(a, p)
    n = cross(u, v)
    if any(n):
        s, t = dot(cross(w, v), n) / dot(n, n), dot(cross(w, u), n) / dot(n, n)
        return 0 <= s <= 1 and 0 <= t <= 1
    if any(cross(u, w)):
        return False
    ends = sorted((dot(minus(x, p), u), k) for x, k in ((p, 0), (q, 0), (a, 1), (b, 1)))
    return ends[0][1] != ends[1][1] or ends[1][0] == ends[2][0]


def expected_of(p: Point, q: Point, a: Point, b: Point, c: Point) -> int:
    """Relation of segment and triangle, by the point where the line goes through the plane."""
    n = cross(minus(b, a), minus(c, a))
    if not any(n):
        return APART
    hp, hq = dot(minus(p, a), n), dot(minus(q, a), n)

    def weights(x: Point) -> list[Fraction]:
        second, third = dot(cross(minus(x, a), minus(c, a)), n), dot(cross(minus(b, a), minus(x, a)), n)
        return [dot(n, n) - second - third, second, third]

    if hp == 0 and hq == 0:
        corner = any(min(weights(x)) >= 0 for x in (p, q))
        across = p != q and any(segments_meet(p, q, u, v) for u, v in ((a, b), (b, c), (c, a)))
        return TOUCHING if corner or across else APART
    if hp * hq > 0:
        return APART
    s = hp / (hp - hq)
    least = min(weights([x + s * y for x, y in zip(p, minus(q, p), strict=True)]))
    return APART if least < 0 else CROSSING if least > 0 and hp * hq < 0 else TOUCHING


def coarse(rng: np.random.Generator) -> np.ndarray:
    """Stencils on a grid of whole numbers, where edges lie in planes, end in corners and run along sides."""
    return rng.integers(-2, 3, (1500, 5, 3)).astype(float)


def nearly(rng: np.random.Generator) -> np.ndarray:
    """The same, turned and moved by a unit in the last place or so: what touched does so no more, and float64 cannot see it."""
    x = np.einsum("nij,nkj->nki", turns(rng, 1500), rng.integers(-2, 3, (1500, 5, 3))) + rng.standard_normal((1500, 1, 3))
    return x * (1 + 1e-16 * rng.integers(-2, 3, x.shape))


def slivers(rng: np.random.Generator) -> np.ndarray:
    """Triangles of heights 1e-16 to 1e-3 and edges that pass within as much of their sides."""
    n = 600
    height = 10 ** rng.uniform(-16, -3, n)
    along, far = rng.uniform(0, 1, (2, n))
    x = np.zeros((n, 5, 3))
    x[:, 3, 0], x[:, 4, 0], x[:, 4, 1] = 1.0, far, height
    x[:, 0, 0], x[:, 1, 0] = along, along
    x[:, 0, 1] = x[:, 1, 1] = height * rng.uniform(-0.5, 1.5, n)
    x[:, 0, 2], x[:, 1, 2] = -height, height * rng.uniform(-0.2, 1, n)
    return np.einsum("nij,nkj->nki", turns(rng, n), x)


@pytest.mark.parametrize("stencils", [coarse, nearly, slivers])
def test_meetings_are_those_of_rational_arithmetic(
    rng: np.random.Generator, stencils: Callable[[np.random.Generator], np.ndarray]
) -> None:
    x = stencils(rng)
    relation = meet(*(x[:, k] for k in range(5)))
    expected = [expected_of(*rational(s)) for s in x]
    assert relation.tolist() == expected
    kinds = {APART, TOUCHING, CROSSING} if stencils is coarse else {APART, CROSSING}
    assert kinds <= set(expected)


def test_orientation_is_exact_where_float64_has_nothing_left() -> None:
    """Points of a line and of a plane, one of them moved by the smallest amount there is."""
    a, b = np.array([0.1, 0.1, 0.1]), np.array([0.7, 0.7, 0.7])
    up = np.nextafter(0.4, 1)
    for third, sign in (([0.4, 0.4], 0), ([0.4, up], 1), ([up, 0.4], -1)):
        assert orientation(a[None, :2], b[None, :2], np.array([third]))[0] == sign
    for z, sign in ((0.4, 0), (np.nextafter(0.4, 0), -1), (up, 1)):
        points = [[0, 0, 0.4], [1e9, 0, 0.4], [0, 1e-9, 0.4], [3e5, 1e5, z]]
        assert orientation(*(np.array([x]) for x in points))[0] == sign
    tiny = np.array([[0, 0, 0], [1e-200, 0, 0], [0, 1e-200, 0], [0, 0, 1e-200]])
    assert orientation(*(x[None] for x in tiny))[0] == 1


def test_surfaces_that_touch_are_said_to_touch() -> None:
    """A gap of 0 is no depth of minus nothing; less than 0 has its depth."""

    def world(gap: float, floor: bool = False) -> ipc.World:
        upper = ipc.TetMesh(unit_cell(1).vertices + np.array([0.25, 0.25, 1.0 + gap - floor]), unit_cell(1).tets)
        other = ipc.HalfSpace("below") if floor else ipc.SoftBody("below", unit_cell(1), ipc.Material(1e5))
        return ipc.World([ipc.SoftBody("above", upper, ipc.Material(1e5)), other], device="cpu")

    for floor, depth in ((False, r"goes 0\.75 m through"), (True, r"lies 0\.001 m inside")):
        with pytest.raises(ipc.OverlapError, match=r"environment 0.* touches .*: start with the surfaces apart$"):
            world(0.0, floor)
        with pytest.raises(ipc.OverlapError, match=depth):
            world(-1e-3, floor)
        assert world(2.0**-50, floor).overlap() is None


def test_a_world_says_where_surfaces_cross() -> None:
    """The state as it is, also one that no step would have accepted."""
    ball = ipc.KinematicBody("ball", ipc.icosphere(0.3, 1), ipc.Pose((0.5, 0.5, 1.4)))
    world = ipc.World([ipc.SoftBody("cube", unit_cell(2), ipc.Material(1e5)), ball], num_envs=2, device="cpu")
    assert world.overlap() is None and world.overlap(1) is None
    x = world._potential.x.numpy()
    x[1, -1 - np.arange(len(ipc.icosphere(0.3, 1).vertices)), 2] -= 0.2
    world._potential.x.assign(x)
    assert world.overlap() is None
    assert "through triangle" in str(world.overlap(1))
    with pytest.raises(ipc.IpcError, match="environments are 0 to 1"):
        world.overlap(2)


@pytest.mark.parametrize("count", [(0, 0), (1, 300), (700, 500)])
def test_boxes_are_paired_as_by_comparing_all_with_all(count: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    low, high = [], []
    for n in count:
        low.append(np.vstack([rng.uniform(size=(n, 3)), np.full((1, 3), 0.5)]))
        high.append(low[-1] + rng.uniform(0.0, 0.2, size=low[-1].shape))
    high[1][-1] = low[1][-1]  # a point, which the last of the others touches with a corner
    i, j = overlap._box_pairs(low[0], high[0], low[1], high[1])
    meets = (low[0][:, None] <= high[1]).all(axis=-1) & (high[0][:, None] >= low[1]).all(axis=-1)
    np.testing.assert_array_equal(np.stack([i, j]), np.stack(np.nonzero(meets)))
    apart, _ = overlap._box_pairs(low[0] + 9.0, high[0] + 9.0, low[1], high[1])
    assert len(apart) == 0
