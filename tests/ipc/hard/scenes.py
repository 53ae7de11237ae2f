"""The hard cases: what is thrown, dropped, pressed and twisted, and what each must come to."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

import ipc
from ipc.bodies import rotation_matrix
from tests.ipc.hard.run import D_HAT, FINE, MAX_NEWTON, G, Setup, Worst, carries, mass, run, world_of
from tests.ipc.hard.shapes import (
    SIZE,
    about,
    as_surface,
    bar,
    crack,
    cube,
    dented_ball,
    fork,
    hole,
    moved,
    notched_block,
    pyramid,
    sheet,
    wedge,
)

SOFT = ipc.Material(2e4, 0.4)
"""As soft for its size as a metre of 1 MPa: its own weight compresses a cube by 1 %."""


def drop(mesh: ipc.TetMesh, surface: ipc.TriMesh, setup: Setup, **settings: Any) -> ipc.World:
    """A soft body over an obstacle at rest."""
    return world_of([ipc.SoftBody("soft", mesh, SOFT), ipc.KinematicBody("obstacle", surface)], setup, **settings)


def sharp(mesh: ipc.TetMesh, surface: ipc.TriMesh, setup: Setup) -> Worst:
    """A sharp body is thrown at a sharp one, at 1 m/s."""
    world = drop(moved(mesh, (0, 0, 1e-3)), surface, setup)
    world.set_velocity("soft", (0.0, 0.0, -1.0))
    return run(world, 30)


def nested(mesh: ipc.TetMesh, surface: ipc.TriMesh, setup: Setup) -> Worst:
    """A sharp body falls into what has its shape, and lies there."""
    worst = run(drop(moved(mesh, (0, 0, 3e-3)), surface, setup), 60)
    return carries(worst, "obstacle", G * mass(mesh))


def sliding(mesh: ipc.TetMesh, setup: Setup, steps: int = 16) -> Worst:
    """A body slides 5 cm down a slope that is cut into triangles."""
    angle = 0.5
    start = moved(mesh, (-0.025, 0, 2e-4))
    world = drop(start, sheet(10), setup, gravity=(G * math.sin(angle), 0.0, -G * math.cos(angle)))
    ways: list[float] = []
    worst = run(world, steps, lambda k: ways.append(float(world.positions("soft")[0, :, 0].mean())))
    ways.append(float(world.positions("soft")[0, :, 0].mean()))
    worst.expect(ways[-1] - ways[0] > 0.02, f"slid {ways[-1] - ways[0]:.3g} m only")
    if mesh is CUBE:
        dt, half = world.settings.dt, steps // 2
        speeds = np.diff(ways) / dt
        rate = (speeds[-1] - speeds[half]) / ((steps - 1 - half) * dt)
        expected = G * (math.sin(angle) - 0.1 * math.cos(angle))
        worst.expect(abs(rate / expected - 1) < 0.05, f"slid at {rate:.3g} m/s², not {expected:.3g}: it was caught")
    return worst


CUBE = cube()


def cliff(setup: Setup) -> Worst:
    """A cube whose middle is beyond an edge: it tips over."""
    worst = run(drop(moved(CUBE, (0.012, 0, 1e-3)), as_surface(moved(CUBE, (0, 0, -SIZE))), setup), 25)
    assert worst.world is not None
    return worst.expect(worst.world.positions("soft")[0, :, 2].min() < -SIZE / 4, "the cube did not tip over the edge")


def parallel_edges(setup: Setup) -> Worst:
    """The edge of a wedge on that of another, parallel to rounding, nearly so and exactly."""
    total = Worst()
    for angle in (0.0, 1e-12, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4):
        upper = moved(wedge(False), (0.3 * SIZE, 0.0, 2e-4), about((0, 0, 1), angle))
        total.include(run(drop(upper, as_surface(wedge(True)), setup), 12), f"at {angle} rad")
    return total


def nearly_parallel_edges(setup: Setup) -> Worst:
    """Wedges of some metres, sharp edge on sharp edge at 5 m/s, 1e-6 and 5e-6 rad apart, with a d̂ of 10 µm.

    The edges cross where no vertex is near, and the mollifier leaves next to nothing of their barrier.
    """
    total = Worst()
    for angle, soft, dt in ((1e-6, False, 0.01), (1e-6, True, 0.025), (5e-6, False, 0.01), (5e-6, True, 0.01)):
        mesh = moved(wedge(False, 2.0, 1.0, 3.0), (0.3, 0.0, 1e-3), about((0, 0, 1), angle))
        body = ipc.SoftBody("upper", mesh, ipc.Material(1e6, 0.4)) if soft else ipc.AffineBody("upper", as_surface(mesh))
        bodies = [body, ipc.KinematicBody("lower", as_surface(wedge(True, 2.0, 1.0, 3.0)))]
        world = world_of(bodies, setup, dt=dt, d_hat=1e-5, friction=0.0, velocity_tolerance=FINE)
        world.set_velocity("upper", (0.0, 0.0, -5.0))
        worst = run(world, 5)
        x = world.positions("upper")[0]
        low = x[(x[:, 2] < 0) & (np.abs(x[:, 0]) < 1)]  # what has come down beside the lower edge lies outside of the lower walls
        worst.expect((np.abs(low[:, 1]) > -low[:, 2] / 6).all(), "it is inside the lower wedge")
        total.include(worst, f"at {angle} rad, {'soft' if soft else 'affine'}")
    return total


def jammed_edges(setup: Setup) -> Worst:
    """A wedge driven into another by a spring that a barrier of 100 Pa cannot hold, parallel and nearly so.

    Gaps go down to the least that a step may leave, 1e-13 of the largest coordinate, and there they must stay; no such step may say that
    it converged. What is pushed aside by exactly parallel edges may come to rest above that.
    """
    total = Worst()
    for angle in (0.0, 1e-7, 1e-4):
        mesh = moved(wedge(False, 2.0, 1.0, 3.0), (0.3, 0.0, 1e-3), about((0, 0, 1), angle))
        bodies = [
            ipc.AffineBody("upper", as_surface(mesh), drive=1e5),
            ipc.KinematicBody("lower", as_surface(wedge(True, 2.0, 1.0, 3.0))),
        ]
        world = world_of(bodies, setup, d_hat=1e-5, kappa=100.0, friction=0.0, gravity=(0, 0, 0), max_newton=100, halvings=0)
        for depth in (0.1, 0.2, 0.3, 0.4):
            world.set_target("upper", (0, 0, -depth))
            worst = run(world, 1, driven=True, jams=True)
            least = 1e-13 * float(np.abs(world.positions("upper")).max())
            at_rest = angle == 0.0 and world.contacts().gap.min() > 1.2 * least
            worst.expect(worst.unconverged or at_rest, "a step that cannot end said that it converged")
            total.include(worst, f"at {angle} rad, {depth} m")
    return total


def wedge_out_of_crack(setup: Setup) -> Worst:
    """An affine wedge of 3 m in a crack of its length and more, pulled sideways up the crack's wall and over its rim at 1 m/s: after the
    wedge-in-crack scenes of the test data of PolyFEM, with d̂ = 1 mm."""
    block = notched_block(4.0, 1.0)
    body = ipc.AffineBody("wedge", as_surface(wedge(False, 2.0, 1.0, 3.0)), pose=ipc.Pose((0.0, 0.0, 1e-4)), drive=100.0)
    world = world_of([body, ipc.KinematicBody("block", block)], setup, d_hat=1e-3, friction=0.0, max_newton=100)
    worst = run(world, 200, lambda k: world.set_target("wedge", (0.0, 0.01 * (k + 1), 1e-4)), driven=True)
    x = world.positions("wedge")[0]
    return worst.expect(x[:, 1].mean() > 1.5, f"it came {x[:, 1].mean():.3g} m to the side only")


def slotted_tetrahedron(setup: Setup) -> Worst:
    """A soft tetrahedron of a metre falls into a slot that is half a micrometre wider, with a d̂ of 1 µm: after the tet-corner scene of the
    test data of PolyFEM and IPC."""
    side, slack = 1.0 - 5e-7, 2.5e-7
    corner = side * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]) + (slack, slack, 0.6)
    bodies: list[ipc.Body] = [ipc.SoftBody("soft", ipc.TetMesh(corner, np.array([[0, 1, 2, 3]])), ipc.Material(1e5, 0.4))]
    box = ipc.box_surface((1.0, 1.0, 1.0))
    for name, middle in (("left", (-0.5, 0.5, 0.0)), ("back", (0.5, -0.5, 0.0)), ("right", (1.5, 0.5, 0.0))):
        bodies.append(ipc.KinematicBody(name, ipc.TriMesh(np.array(middle) - box.vertices, box.faces[:, ::-1])))
    bodies.append(ipc.HalfSpace("floor", ipc.Pose((0, 0, -0.5))))
    world = world_of(bodies, setup, dt=0.025, d_hat=1e-6, friction=0.0, max_newton=100, velocity_tolerance=FINE)
    worst = run(world, 10)
    low = world.positions("soft")[0]
    low = low[low[:, 2] < 0.5]
    worst.expect(len(low), "it did not fall into the slot")
    return worst.expect((low[:, :2] > 0).all() and (low[:, 0] < 1).all(), "what is in the slot is wider than the slot")


def two_cubes(
    setup: Setup,
    lower: ipc.Material,
    upper: ipc.Material,
    size: float = SIZE,
    offset: float = 0.0,
    steps: int = 30,
    rests: bool = True,
    **settings: Any,
) -> Worst:
    """A cube on a cube on a plane; where it ``rests``, the plane carries both."""
    meshes = moved(CUBE, (0, 0, 2e-4)), moved(cube(size), (offset, 0, SIZE + 4e-4))
    bodies: list[ipc.Body] = [ipc.SoftBody(n, m, k) for n, m, k in zip(("lower", "upper"), meshes, (lower, upper), strict=True)]
    world = world_of([*bodies, ipc.HalfSpace("floor")], setup, friction=0.3, **settings)
    worst = run(world, steps)
    if rests:
        weight = G * sum(mass(m, k.density) for m, k in zip(meshes, (lower, upper), strict=True))
        carries(worst, "floor", weight)
    return worst


def mass_ratio(setup: Setup) -> Worst:
    """80 kg on 8 g: the small cube must hold it, 2 % shorter."""
    stiff = ipc.Material(1e8, 0.4), ipc.Material(1e8, 0.4, 1e4)
    worst = two_cubes(setup, *stiff, size=10 * SIZE, steps=40)
    assert worst.world is not None
    z = worst.world.positions("lower")[0, :, 2]
    shorter, expected = 1 - (z.max() - z.min()) / SIZE, 80 * G / SIZE**2 / 1e8
    return worst.expect(0.5 < shorter / expected < 1.2, f"shortened by {shorter:.3g} where stress over E is {expected:.3g}")


def crush(setup: Setup) -> Worst:
    """The same weight on a cube that cannot hold it: a stress of twice Young's modulus."""
    worst = two_cubes(setup, ipc.Material(1e6, 0.4), ipc.Material(1e6, 0.4, 1e4), size=10 * SIZE, steps=60, rests=False)
    assert worst.world is not None
    z = worst.world.positions("lower")[0, :, 2]
    return worst.expect(z.max() - z.min() < 0.5 * SIZE, "was not crushed")


def step_size(setup: Setup, dt: float, steps: int) -> Worst:
    """A cube falls with a corner first on a bonded slab, at any time step."""
    turn = about((1, -1, 0), math.atan(2**0.5))
    corner = moved(moved(cube(0.5 * SIZE, 2), (0, 0, -0.25 * SIZE)), (0, 0, 0), turn)
    falling = moved(corner, (0.1e-3, 0.2e-3, 1e-3 - corner.vertices[:, 2].min()))
    slab = moved(bar(2 * SIZE, 0.5 * SIZE, 2 * SIZE, (6, 6, 2)), (0, 0, -0.25 * SIZE))
    base = ipc.vertices_in_box(slab, (-1, -1, -0.5 * SIZE), (1, 1, -0.5 * SIZE))
    bodies: list[ipc.Body] = [ipc.SoftBody("falling", falling, SOFT), ipc.SoftBody("slab", slab, SOFT, bonded=base)]
    worst = run(world_of(bodies, setup, dt=dt, friction=0.3), steps)
    # Backward Euler damps the rest of the fall away where the step is long: then it lies still.
    return carries(worst, "slab", G * (mass(falling) + mass(slab))) if dt >= 0.1 else worst


def fast_impact(setup: Setup) -> Worst:
    """A soft cube at 50 m/s meets a slab of a centimetre: in one step it would fly half a metre."""
    slab = moved(bar(3 * SIZE, 0.5 * SIZE, 3 * SIZE, (6, 6, 2)), (0, 0, -0.25 * SIZE))
    base = ipc.vertices_in_box(slab, (-1, -1, -0.5 * SIZE), (1, 1, -0.5 * SIZE))
    material = ipc.Material(1e5, 0.4)
    bodies: list[ipc.Body] = [
        ipc.SoftBody("bullet", moved(cube(0.5 * SIZE, 2), (0, 0, 0.02)), material),
        ipc.SoftBody("slab", slab, material, bonded=base),
    ]
    world = world_of(bodies, setup)
    world.set_velocity("bullet", (0.0, 0.0, -50.0))
    lowest = [math.inf]

    def note(_: int) -> None:
        lowest[0] = min(lowest[0], float(world.positions("bullet")[0, :, 2].min()))

    worst = run(world, 12, note)
    note(0)
    return worst.expect(lowest[0] > -0.5 * SIZE, f"went through: {lowest[0]:.3g} m")


def squeeze(setup: Setup) -> Worst:
    """A soft cube between two plates, down to half its height and back: it must come back to its shape."""
    mesh = cube(cells=3)
    plate, gap = ipc.box_surface((0.06, 0.06, 0.004)), 2e-4
    bodies: list[ipc.Body] = [
        ipc.SoftBody("soft", mesh, ipc.Material(1e5, 0.4)),
        ipc.KinematicBody("low", plate, ipc.Pose((0, 0, -0.002 - gap))),
        ipc.KinematicBody("high", plate, ipc.Pose((0, 0, SIZE + 0.002 + gap))),
    ]
    world = world_of(bodies, setup, gravity=(0, 0, 0), friction=0.5)
    heights: list[float] = []

    def move(k: int) -> None:
        shift = max(min(k + 1, 24 - k), 0) / 12
        world.set_target("high", (0, 0, SIZE + 0.002 + gap - 0.5 * SIZE * shift))
        heights.append(float(np.ptp(world.positions("soft")[0, :, 2])))

    worst = run(world, 40, move, driven=True)
    worst.expect(min(heights) < 0.53 * SIZE, f"was squeezed to {min(heights) / SIZE:.3g} of its height only")
    now = world.positions("soft")[0]
    edges = [np.linalg.norm(x[mesh.tets][:, 1:] - x[mesh.tets][:, :1], axis=-1) for x in (now, mesh.vertices)]
    error = float(np.abs(edges[0] / edges[1] - 1).max())
    return worst.expect(error < 0.01, f"did not recover its shape: {error:.3g}")


def folded(setup: Setup) -> Worst:
    """A slotted block pressed until its two arms meet: self-contact."""
    mesh = fork()
    bonded = ipc.vertices_in_box(mesh, (-1, -1, 0), (1, 1, 0))
    jaw = ipc.box_surface((0.004, 0.02, 0.006))
    bodies: list[ipc.Body] = [
        ipc.SoftBody("fork", mesh, ipc.Material(1e5, 0.4), bonded=bonded, self_contact=True),
        ipc.KinematicBody("left", jaw, ipc.Pose((-0.0125, 0, 0.017))),
        ipc.KinematicBody("right", jaw, ipc.Pose((0.0125, 0, 0.017))),
    ]
    world = world_of(bodies, setup, dt=0.02, gravity=(0, 0, 0), friction=0.2)

    def move(k: int) -> None:
        shift = 0.0036 * (k + 1) / 15
        world.set_target("left", (-0.0125 + shift, 0, 0.017))
        world.set_target("right", (0.0125 - shift, 0, 0.017))

    worst = run(world, 15, move, driven=True)
    return worst.expect(("fork", "fork") in world.contacts().bodies, "the arms never met")


def blocked(setup: Setup) -> Worst:
    """A ball driven through the pad into the bonded base: it stops, and the report says how much remained."""
    mesh = ipc.domed_pad((12e-3, 12e-3), 3e-3, (math.inf, math.inf), (4, 4, 2))
    pad = ipc.SoftBody("pad", mesh, ipc.Material(1e5, 0.45), bonded=ipc.vertices_in_box(mesh, (-1, -1, -3e-3), (1, 1, -3e-3)))
    ball = ipc.KinematicBody("ball", ipc.icosphere(3e-3, 2), ipc.Pose((0, 0, 3.1e-3 + D_HAT)))
    world = world_of([pad, ball], setup, gravity=(0, 0, 0))
    worst = run(world, 16, lambda k: world.set_target("ball", (0, 0, max(-3e-3, 3.1e-3 - 0.5e-3 * (k + 1)))), driven=True)
    lowest = float(world.positions("ball")[0, :, 2].min())
    worst.expect(0 < worst.blocked <= 1, "was not blocked")
    return worst.expect(-3e-3 < lowest < -2e-3, f"stopped at {lowest:.3g} m, where the base is at -0.003 m")


def twisted(setup: Setup, mesh: ipc.TetMesh, turns: float, length: float) -> Worst:
    """Both ends of a bar or mat turned against each other, a 16th of a turn a step, a 32nd where the mesh is fine."""
    ends = [np.flatnonzero(np.isclose(mesh.vertices[:, 0], side * length / 2)) for side in (-1, 1)]
    material = ipc.Material(1e5, 0.4, mass_damping=20.0)
    body = ipc.SoftBody("twisted", mesh, material, bonded=ends[0], grips={"far": ends[1]}, self_contact=True)
    world = world_of([body], setup, dt=0.02, gravity=(0, 0, 0), velocity_tolerance=1e-3)
    steps = round((32 if setup.large else 16) * turns)

    def half_turn(k: int, side: float) -> np.ndarray:
        return about((1, 0, 0), side * math.pi * turns * (k + 1) / steps)

    def turn(k: int) -> None:
        for name, side in (("twisted", -1.0), ("twisted.far", 1.0)):
            world.set_target(name, rotation=half_turn(k, side))

    worst = run(world, steps, turn, driven=True)
    x = world.positions("twisted")[0]
    for ids, side in zip(ends, (-1.0, 1.0), strict=True):
        off = np.abs(x[ids] - mesh.vertices[ids] @ rotation_matrix(half_turn(steps - 1, side)).T).max()
        worst.expect(off < 1e-12, f"a gripped end is off by {off:.3g} m")
    worst.expect(("twisted", "twisted") in world.contacts().bodies, "it never touched itself")
    return worst.expect(worst.blocked == 0, f"a share of {worst.blocked:.3g} of a turn was not followed")


def beam_twist(setup: Setup) -> Worst:
    """A beam of 4 × 4 × 20 mm."""
    cells, turns = ((20, 3, 3), 4) if setup.large else ((10, 2, 2), 3)
    return twisted(setup, bar(4e-3, 4e-3, 20e-3, cells), turns, 20e-3)


def mat_twist(setup: Setup) -> Worst:
    """A mat of 20 × 20 × 1 mm, which rolls itself up."""
    cells, turns = ((16, 16, 1), 3) if setup.large else ((10, 10, 1), 2)
    return twisted(setup, bar(20e-3, 1e-3, 20e-3, cells), turns, 20e-3)


def random_presses(setup: Setup, count: int, seed: int = 0) -> Worst:
    """Presses, shears and twists of convex and concave objects, anywhere on a coarse pad, many at once."""
    rng = np.random.default_rng(seed)
    mesh = ipc.domed_pad((12e-3, 12e-3), 4e-3, (math.inf, math.inf), (5, 5, 2))
    pad = ipc.SoftBody("pad", mesh, ipc.Material(1e5, 0.45), bonded=ipc.vertices_in_box(mesh, (-1, -1, -4e-3), (1, 1, -4e-3)))
    shapes = {
        "ball": ipc.icosphere(3e-3, 2),
        "box": ipc.box_surface((4e-3, 3e-3, 2e-3)),
        "spike": as_surface(moved(pyramid(False, 5e-3), (0, 0, -2.5e-3))),
        "dent": dented_ball(3e-3),
    }
    worst = Worst()
    for name, shape in shapes.items():
        envs = count // len(shapes)
        if envs == 0:
            continue
        axis, angle = rng.standard_normal((envs, 3)), rng.uniform(0, math.pi, envs)
        axis /= np.linalg.norm(axis, axis=1, keepdims=True)
        turn = np.concatenate([np.cos(angle / 2)[:, None], np.sin(angle / 2)[:, None] * axis], axis=1)
        low = (rotation_matrix(turn) @ shape.vertices.T)[:, 2].min(axis=1)
        start = np.column_stack([rng.uniform(-3e-3, 3e-3, (envs, 2)), 0.15e-3 - low])
        tool = ipc.KinematicBody("tool", shape, ipc.Pose((0.0, 0.0, 0.02)))
        settings = ipc.Settings(dt=0.02, d_hat=1e-4, friction=0.5, max_newton=MAX_NEWTON, velocity_tolerance=1e-3)
        world = ipc.World([pad, tool], settings, num_envs=envs, device=setup.device)
        world.teleport("tool", start, turn)
        depth, side, twist = rng.uniform(0.2e-3, 1.5e-3, envs), rng.uniform(-1e-3, 1e-3, (envs, 2)), rng.uniform(-0.5, 0.5, envs)
        for k in range(1, 10):
            down, after = min(k / 5, 1.0), max(k - 5, 0) / 4
            half = 0.5 * after * twist
            w, x, y, z = turn.T
            c, s = np.cos(half), np.sin(half)
            turned = np.column_stack([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w])
            world.set_target("tool", start + np.column_stack([after * side, -depth * down]), turned)
            report = world.step()
            worst.add(world, report)
        worst.expect((report.pairs > 0).all(), f"{name}: {int((report.pairs == 0).sum())} of {envs} did not touch")
        print(
            f"  random_presses: {name} x {envs}, gap {worst.min_gap:.3g} m, det F {worst.min_det:.3g}, newton {worst.max_newton}"
        )
    return worst


CASES: dict[str, Callable[[Setup], Worst]] = {
    "spike_on_spike": lambda a: sharp(pyramid(False), as_surface(pyramid(True)), a),
    "wedge_on_wedge": lambda a: sharp(wedge(False), as_surface(moved(wedge(True), (0, 0, 0), about((0, 0, 1), math.pi / 2))), a),
    "spike_on_wedge": lambda a: sharp(pyramid(False), as_surface(wedge(True)), a),
    "parallel_edges": parallel_edges,
    "nearly_parallel_edges": nearly_parallel_edges,
    "jammed_edges": jammed_edges,
    "wedge_out_of_crack": wedge_out_of_crack,
    "slotted_tetrahedron": slotted_tetrahedron,
    "spike_in_hole": lambda a: nested(pyramid(False), hole(), a),
    "spike_in_crack": lambda a: nested(pyramid(False), crack(), a),
    "wedge_in_crack": lambda a: nested(wedge(False), crack(), a),
    "sliding_spike": lambda a: sliding(pyramid(False), a),
    "sliding_wedge": lambda a: sliding(wedge(False), a),
    "internal_edges": lambda a: sliding(CUBE, a),
    "cliff": cliff,
    "vertex_alignment": lambda a: two_cubes(a, SOFT, SOFT),
    "edge_alignment": lambda a: two_cubes(a, SOFT, SOFT, offset=SIZE, rests=False),
    "mass_ratio_1e4": mass_ratio,
    "crush": crush,
    "stiffness_ratio_1e4": lambda a: two_cubes(a, SOFT, ipc.Material(2e8, 0.4), kappa=1e6),
    "dt_1ms": lambda a: step_size(a, 1e-3, 60),
    "dt_10ms": lambda a: step_size(a, 1e-2, 30),
    "dt_100ms": lambda a: step_size(a, 0.1, 20),
    "dt_1s": lambda a: step_size(a, 1.0, 10),
    "fast_impact": fast_impact,
    "squeeze_and_release": squeeze,
    "self_contact": folded,
    "blocked_drive": blocked,
    "beam_twist": beam_twist,
    "mat_twist": mat_twist,
}
