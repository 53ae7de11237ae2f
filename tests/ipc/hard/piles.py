"""What stands, hangs or falls by its own weight and by friction: card house, arch, chain, tower, dominoes, heap, steep slopes.

The card house and the chain are after Lan et al. 2022 and Ferguson et al. 2021, the arch after Li et al. 2020.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog

import ipc
from tests.ipc.hard.parts import ball, link, shifted, together, voussoirs
from tests.ipc.hard.run import D_HAT, FINE, G, Setup, Worst, mass, run, solid, world_of
from tests.ipc.hard.shapes import about, as_surface, bar, cube, moved, pyramid

Floats = NDArray[np.float64]

NEAR = 0.95 * D_HAT
"""Gap of surfaces that carry little [m]."""
KAPPA = 1e6
"""Barrier stiffness where affine bodies lie on each other [Pa]."""


def cards(soft: bool) -> tuple[list[ipc.Body], float]:
    """Seven cards of 20 × 12 × 1 mm: two pairs that lean against each other, one across, a pair on it; and their lean [rad]."""
    lean, across = math.radians(20), 16.5e-3
    cells = (1, 1, 4) if soft else (1, 1, 1)
    card = bar(12e-3, 20e-3, 1e-3, cells)

    def pair(name: str, x: float, floor: float) -> list[ipc.Body]:
        both: list[ipc.Body] = []
        for side in (-1, 1):
            leaning = moved(card, (0, 0, 0), about((0, 1, 0), -side * lean))
            v = leaning.vertices
            reach = (side * v[:, 0]).min()
            mesh = moved(leaning, (x + side * (NEAR / 2 - reach), 0, floor + NEAR - v[:, 2].min()))
            both.append(solid(f"{name}{'left' if side < 0 else 'right'}", mesh, soft, 1e7))
        return both

    bodies = [*pair("low_left_", -across / 2, 0.0), *pair("low_right_", across / 2, 0.0)]
    top = max(float(_vertices(b)[:, 2].max()) for b in bodies)
    bodies.append(solid("flat", moved(card, (0, 0, top + NEAR + 0.5e-3), about((0, 1, 0), math.pi / 2)), soft, 1e7))
    return [*bodies, *pair("high_", 0.0, top + NEAR + 1e-3)], lean


def _vertices(body: ipc.Body) -> Floats:
    """Vertices of a free body at its start [m]."""
    assert isinstance(body, ipc.SoftBody | ipc.AffineBody)
    return body.mesh.vertices if isinstance(body, ipc.SoftBody) else body.surface.vertices


def _sunk(world: ipc.World, bodies: list[ipc.Body]) -> float:
    """How far what was highest has come down [m]."""
    before = max(float(_vertices(b)[:, 2].max()) for b in bodies)
    return before - max(float(world.positions(b.name)[0, :, 2].max()) for b in bodies)


def _moved_most(world: ipc.World, bodies: list[ipc.Body]) -> float:
    """Largest displacement of a vertex since the start [m]."""
    return max(float(np.linalg.norm(world.positions(b.name)[0] - _vertices(b), axis=1).max()) for b in bodies)


def card_house(setup: Setup, soft: bool, stands: bool) -> Worst:
    """A house of seven cards. A card that leans by α needs μ > tan α / 2 below it if it carries nothing, and μ > tan α suffices."""
    bodies, lean = cards(soft)
    friction = 1.5 * math.tan(lean) if stands else 0.25 * math.tan(lean)
    world = world_of([*bodies, ipc.HalfSpace("floor")], setup, friction=friction, kappa=KAPPA, velocity_tolerance=FINE)
    worst = run(world, 100 if stands else 50)
    most, sunk = _moved_most(world, bodies), _sunk(world, bodies)
    if stands:
        return worst.expect(most < 0.3e-3, f"in 1 s a card moved by {most:.3g} m")
    return worst.expect(sunk > 10e-3, f"the house came down by {sunk:.3g} m only")


def least_friction(corners: list[Floats]) -> float:
    """Least μ with which half a round arch of blocks can be in equilibrium under its weight.

    Every joint carries normal forces at its two ends and a shear of at most μ times their sum; the least μ for which such forces exist,
    by bisection of linear programs (the safe theorem; Heyman 1966). Below it the arch cannot stand.

    Args:
        corners: inner and outer corner at the first joint, then at the second, of each block [m], (4, 2).
    """
    blocks = len(corners)
    size = max(float(np.abs(quad).max()) for quad in corners)
    corners = [
        quad * (blocks**0.5 / size) for quad in corners
    ]  # weights and arms of about one, as the solver's tolerances expect

    def balanced(friction: float) -> bool:
        unknowns = 3 * (blocks + 1)  # per joint: normal force at the inner and at the outer end, shear
        equations, right = np.zeros((3 * blocks, unknowns)), np.zeros(3 * blocks)
        for b, quad in enumerate(corners):
            x, y = quad[[0, 1, 3, 2]].T
            cross = x * np.roll(y, -1) - np.roll(x, -1) * y
            area = cross.sum() / 2
            centre = np.array([((v + np.roll(v, -1)) * cross).sum() for v in (x, y)]) / (6 * area)
            right[3 * b + 1] = abs(area)
            for joint, (inner, outer), side in ((b, quad[:2], 1.0), (b + 1, quad[2:], -1.0)):
                along = (outer - inner) / np.linalg.norm(outer - inner)
                normal = side * np.array([-along[1], along[0]])
                for column, direction, at in ((0, normal, inner), (1, normal, outer), (2, side * along, inner)):
                    arm = at - centre
                    entry = (*direction, arm[0] * direction[1] - arm[1] * direction[0])
                    equations[3 * b : 3 * b + 3, 3 * joint + column] = entry
        limits = np.zeros((2 * (blocks + 1), unknowns))
        for joint in range(blocks + 1):
            for row, sign in ((0, 1.0), (1, -1.0)):
                limits[2 * joint + row, 3 * joint : 3 * joint + 3] = (-friction, -friction, sign)
        bounds = [(0, None), (0, None), (None, None)] * (blocks + 1)
        return linprog(np.zeros(unknowns), limits, np.zeros(len(limits)), equations, right, bounds).success

    low, high = 0.0, 4.0
    for _ in range(20):
        middle = (low + high) / 2
        low, high = (low, middle) if balanced(middle) else (middle, high)
    return high


def profiles(blocks: list[ipc.TetMesh]) -> list[Floats]:
    """Corners (4, 2) [m] of voussoirs, seen along y, as :func:`least_friction` takes them."""
    quads = []
    for mesh in blocks:
        v = mesh.vertices[mesh.vertices[:, 1] < 0][:, [0, 2]]
        angle, radius = np.arctan2(v[:, 1], v[:, 0]), np.linalg.norm(v, axis=1)
        quads.append(v[np.lexsort((radius, angle.round(6)))])
    return quads


def arch(setup: Setup, soft: bool, stands: bool) -> Worst:
    """Seven voussoirs of half a round arch of 20 mm on the floor, without mortar, at 1.3 and 0.7 of the least μ of their geometry."""
    shape = (7, 20e-3, 7e-3, 10e-3)
    meshes, quads = voussoirs(*shape, NEAR), profiles(voussoirs(*shape, 0.0))
    friction = (1.3 if stands else 0.7) * least_friction(quads)
    bodies = [solid(f"block{k}", m, soft, 1e7) for k, m in enumerate(meshes)]
    world = world_of([*bodies, ipc.HalfSpace("floor")], setup, dt=0.005, friction=friction, kappa=KAPPA, velocity_tolerance=FINE)
    worst = run(world, 80)
    most, sunk = _moved_most(world, bodies), _sunk(world, bodies)
    if stands:
        return worst.expect(most < 0.2e-3, f"at μ = {friction:.3g} a block moved by {most:.3g} m in 0.4 s")
    return worst.expect(sunk > 5e-3, f"at μ = {friction:.3g} the crown came down by {sunk:.3g} m only")


def chain(setup: Setup, soft: bool) -> Worst:
    """Five links of which the first is fixed: each carries the weight of those below it."""
    radius, tube, count = 5e-3, 1e-3, 5
    mesh, bodies = link(radius, tube), []
    for k in range(count):
        turn = about((0, 0, 1), 0.5 * math.pi * (k % 2))
        placed = moved(mesh, (0, 0, -k * (2 * (radius - tube) - NEAR)), turn)
        bodies.append(ipc.KinematicBody("link0", as_surface(placed)) if k == 0 else solid(f"link{k}", placed, soft, 3e6, 8000.0))
    world = world_of(bodies, setup, friction=0.3, kappa=3e6)
    worst = run(world, 60)
    weight = 8000.0 / 1000.0 * G * mass(mesh)
    for k, (upper, lower) in enumerate((f"link{k}", f"link{k + 1}") for k in range(count - 1)):
        forces = world.pressing()
        tension = -forces[upper, lower].wrench[0, 2] if (upper, lower) in forces else forces[lower, upper].wrench[0, 2]
        below = (count - 1 - k) * weight
        worst.expect(abs(tension / below - 1) < 0.02, f"{upper} carries {tension:.4g} N of {below:.4g} N")
    return worst


def tower(setup: Setup, soft: bool) -> Worst:
    """Ten cubes on each other, vertex on vertex and edge on edge: each carries those above it."""
    size, count = 10e-3, 10
    meshes = [moved(cube(size), (0, 0, NEAR + k * (size + NEAR))) for k in range(count)]
    bodies = [solid(f"cube{k}", m, soft, 1e6) for k, m in enumerate(meshes)]
    world = world_of([*bodies, ipc.HalfSpace("floor")], setup, friction=0.3, kappa=KAPPA, velocity_tolerance=FINE)
    worst = run(world, 60)
    forces, weight = world.pressing(), G * mass(meshes[0])
    for k in range(count):
        below = "floor" if k == 0 else f"cube{k - 1}"
        pair = (f"cube{k}", below)
        carried = forces[pair].wrench[0, 2] if pair in forces else -forces[below, pair[0]].wrench[0, 2]
        worst.expect(
            abs(carried / ((count - k) * weight) - 1) < 0.02, f"{below} carries {carried:.4g} N of {(count - k) * weight:.4g} N"
        )
    return worst


def dominoes(setup: Setup, soft: bool) -> Worst:
    """Six slabs of 20 × 10 × 3 mm, of which the first starts beyond its balance: all of them fall, in their order."""
    slab, spacing, count = bar(10e-3, 20e-3, 3e-3, (1, 1, 2)), 9e-3, 6
    bodies = []
    for k in range(count):
        mesh = moved(slab, (0, 0, 0), about((0, 1, 0), 0.25 if k == 0 else 0.0))
        bodies.append(solid(f"slab{k}", moved(mesh, (k * spacing, 0, NEAR - mesh.vertices[:, 2].min())), soft, 1e7))
    world = world_of([*bodies, ipc.HalfSpace("floor")], setup, dt=0.005, friction=0.4, kappa=KAPPA, velocity_tolerance=FINE)
    fell: list[int] = []

    def lean(name: str) -> float:
        x = world.positions(name)[0] - world.positions(name)[0].mean(axis=0)
        return math.acos(min(1.0, abs(float(np.linalg.svd(x)[2][0, 2]))))

    def note(_: int) -> None:
        fell.extend(k for k in range(count) if k not in fell and lean(f"slab{k}") > 0.25)

    worst = run(world, 100, note)
    note(0)
    worst.expect(lean(f"slab{count - 1}") > 1.0, "the last one does not lie")
    return worst.expect(fell == list(range(count)), f"they fell in the order {fell}")


def heap(setup: Setup) -> Worst:
    """Thirty soft and affine cubes, balls and spikes fall into a box of 32 mm: it contains them all in the end, and carries them."""
    rng, side, wall = np.random.default_rng(3), 32e-3, 4e-3
    shapes = [cube(6e-3, 2), ball(3.5e-3, 2), moved(pyramid(False, 6e-3), (0, 0, -3e-3)), cube(5e-3)]
    bodies: list[ipc.Body] = []
    for k in range(30):
        axis = rng.standard_normal(3)
        mesh = shapes[k % len(shapes)]
        mesh = moved(mesh, tuple(-mesh.vertices.mean(axis=0)))
        mesh = moved(mesh, (0, 0, 0), about(tuple(axis), rng.uniform(0, math.pi)))
        place = 9.5e-3 * (np.array([k % 3, k // 3 % 3, k // 9]) - (1, 1, 0)) + (0, 0, 7e-3) + rng.uniform(-2e-4, 2e-4, 3)
        bodies.append(solid(f"body{k}", moved(mesh, tuple(place)), k % 8 < 4, 1e5, stiffness=1e6))
    half, high = (side + wall) / 2, 60e-3
    box = together(
        *(shifted(ipc.box_surface((wall, side + 2 * wall, high)), (s * half, 0, high / 2)) for s in (-1, 1)),
        *(shifted(ipc.box_surface((side + 2 * wall, wall, high)), (0, s * half, high / 2)) for s in (-1, 1)),
    )
    world = world_of([*bodies, ipc.KinematicBody("box", box), ipc.HalfSpace("floor")], setup, dt=0.005, friction=0.3, kappa=1e5)
    worst = run(world, 60)
    x = np.concatenate([world.positions(b.name)[0] for b in bodies])
    worst.expect((np.abs(x[:, :2]) < side / 2).all() and (x[:, 2] > 0).all(), "something is out of the box")
    motion = [world.rigid_motion(b.name) for b in bodies]
    speed = float(np.linalg.norm(sum(m.mass * m.velocity[0] for m in motion))) / sum(m.mass for m in motion)
    return worst.expect(speed < 0.02, f"the heap as a whole still moves, at {speed:.3g} m/s")


def steep(setup: Setup, soft: bool, holds: bool) -> Worst:
    """A slab of 20 × 20 × 2 mm on a slope of tan θ = 4.8 or 5.3 with μ = 5: it holds, or slides at g (sin θ − μ cos θ)."""
    slope, friction = math.atan(4.8 if holds else 5.3), 5.0
    slab = moved(bar(20e-3, 2e-3, 20e-3, (2, 2, 1)), (0, 0, 1e-3 + NEAR))
    body = solid("slab", slab, soft, 1e7)
    gravity = (G * math.sin(slope), 0.0, -G * math.cos(slope))
    world = world_of(
        [body, ipc.HalfSpace("floor")], setup, friction=friction, gravity=gravity, kappa=KAPPA, velocity_tolerance=FINE
    )
    speeds: list[float] = []
    worst = run(world, 40, lambda _: speeds.append(float(world.rigid_motion("slab").velocity[0, 0])))
    speeds.append(float(world.rigid_motion("slab").velocity[0, 0]))
    if holds:
        return worst.expect(abs(speeds[-1]) < 1e-6, f"creeps at {speeds[-1]:.3g} m/s")
    rate, expected = (speeds[-1] - speeds[20]) / (0.01 * (len(speeds) - 21)), G * (math.sin(slope) - friction * math.cos(slope))
    return worst.expect(abs(rate / expected - 1) < 0.02, f"slides at {rate:.4g} m/s², not {expected:.4g}")


def _both(name: str, case: Callable[[Setup, bool], Worst]) -> dict[str, Callable[[Setup], Worst]]:
    return {f"{name}_{kind}": lambda a, soft=kind == "soft": case(a, soft) for kind in ("soft", "affine")}


CASES: dict[str, Callable[[Setup], Worst]] = {
    **_both("card_house_stands", lambda a, soft: card_house(a, soft, True)),
    **_both("card_house_falls", lambda a, soft: card_house(a, soft, False)),
    **_both("arch_stands", lambda a, soft: arch(a, soft, True)),
    **_both("arch_falls", lambda a, soft: arch(a, soft, False)),
    **_both("chain", chain),
    **_both("tower", tower),
    **_both("dominoes", dominoes),
    **_both("steep_slope_holds", lambda a, soft: steep(a, soft, True)),
    **_both("steep_slope_slides", lambda a, soft: steep(a, soft, False)),
    "heap_of_30": heap,
}
