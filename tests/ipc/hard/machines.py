"""What is driven through, onto, into and around something: rollers, nozzle, beds of points and knives, compactor, threads, gears, pegs.

Rollers, squeeze-out, points, knives and compactor are after Li et al. 2020; threads, gears and the wrecking ball after Ferguson et al.
2021 and Lan et al. 2022.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

import ipc
from tests.ipc.hard.parts import ball, bolt, channel, cylinder, gear, knives, nut, points, ring, shifted, together
from tests.ipc.hard.run import D_HAT, FINE, G, Setup, Worst, carries, mass, run, solid, world_of
from tests.ipc.hard.scenes import twisted
from tests.ipc.hard.shapes import about, as_surface, bar, cube, moved, then

ALONG_Y = about((1, 0, 0), -0.5 * math.pi)
"""Turns the z axis onto the y axis."""


def rollers(setup: Setup, friction: float) -> Worst:
    """A soft block of 10 mm on two rollers of radius 12 mm, 6 mm apart, that turn towards each other.

    They draw it in if μ is above the tangent of the angle at which they meet it, β = 34°, and turn below it if μ is far less.
    """
    radius, gap, speed = 12e-3, 6e-3, 4.0
    middle = radius + gap / 2
    height = math.sqrt((radius + D_HAT) ** 2 - (middle - 5e-3) ** 2)
    block = moved(bar(8e-3, 14e-3, 10e-3, (3, 2, 4)), (0, 0, height + 7e-3 + 2e-4))
    bodies: list[ipc.Body] = [
        ipc.SoftBody("block", block, ipc.Material(3e4, 0.4), self_contact=True),
        *(
            ipc.KinematicBody(n, cylinder(radius, 12e-3, 24), ipc.Pose((s * middle, 0, 0), tuple(ALONG_Y)))
            for n, s in (("left", -1), ("right", 1))
        ),
    ]
    world = world_of(bodies, setup, friction=friction)

    def turn(k: int) -> None:
        for name, side in (("left", 1), ("right", -1)):
            world.set_target(name, rotation=then(ALONG_Y, about((0, 1, 0), side * speed * 0.01 * (k + 1))))

    worst = run(world, 66, turn, driven=True)
    x = world.positions("block")[0]
    if friction > 0.5:
        return worst.expect(x[:, 2].max() < 0, f"it was not drawn through: its top is at {x[:, 2].max():.3g} m")
    return worst.expect(x[:, 2].max() > height, f"it was drawn in: its top is at {x[:, 2].max():.3g} m")


def soft_rollers(setup: Setup) -> Worst:
    """A stiff, affine bar of 5 mm between two rollers with soft coats, 4 mm apart: it moves on as their surfaces do."""
    radius, core, speed = 8e-3, 5e-3, 2.0
    coat = ring(core, lambda phi: radius + 0 * phi, 8e-3, 24)
    inner = np.flatnonzero(np.isclose(np.hypot(coat.vertices[:, 0], coat.vertices[:, 1]), core))
    middle = radius + 2.4e-3
    bodies: list[ipc.Body] = [
        solid("bar", moved(bar(6e-3, 4.6e-3, 40e-3, (6, 1, 1)), (13e-3, 0, 0)), False),
        *(
            ipc.SoftBody(
                n, coat, ipc.Material(2e5, 0.4), bonded=inner, pose=ipc.Pose((0, 0, s * (middle + 1e-3)), tuple(ALONG_Y))
            )
            for n, s in (("low", -1), ("high", 1))
        ),
    ]
    world = world_of(bodies, setup, friction=0.8, gravity=(0, 0, 0))
    places: list[float] = []

    def turn(k: int) -> None:
        close = min(k + 1, 10) / 10 * 1.5e-3
        for name, side in (("low", -1), ("high", 1)):
            angle = side * speed * 0.01 * max(0, k - 9)
            world.set_target(name, (0, 0, side * (middle + 1e-3 - close)), then(ALONG_Y, about((0, 1, 0), angle)))
        places.append(float(world.positions("bar")[0, :, 0].mean()))

    worst = run(world, 70, turn, driven=True)
    moved_by, expected = places[-1] - places[20], speed * 0.01 * 49 * radius
    return worst.expect(
        0.8 < abs(moved_by) / expected < 1.05, f"the bar moved by {moved_by:.3g} m, the rollers by {expected:.3g} m"
    )


def squeeze_out(setup: Setup) -> Worst:
    """A plunger presses a soft block of 10 mm through a square nozzle of 6 mm: what is out has its volume again, to 5 %."""
    block = moved(bar(10e-3, 12e-3, 10e-3, (4, 4, 5)), (0, 0, 6e-3 + 3e-4))
    tube = channel([(5.2e-3, 20e-3), (5.2e-3, 0.0), (3e-3, -5e-3), (3e-3, -8e-3)])
    bodies: list[ipc.Body] = [
        ipc.SoftBody("block", block, ipc.Material(5e4, 0.45), self_contact=True),
        ipc.KinematicBody("tube", tube),
        ipc.KinematicBody("plunger", ipc.box_surface((9.8e-3, 9.8e-3, 4e-3)), ipc.Pose((0, 0, 14.6e-3))),
    ]
    world = world_of(bodies, setup, friction=0.05)
    steps = 60
    worst = run(world, steps, lambda k: world.set_target("plunger", (0, 0, 14.6e-3 - 12e-3 * (k + 1) / steps)), driven=True)
    x = world.positions("block")[0]
    out = block.tets[(x[block.tets][..., 2] < -9e-3).all(axis=1)]
    now, rest = (float(np.linalg.det(v[out][:, 1:] - v[out][:, :1]).sum()) for v in (x, block.vertices))
    worst.expect(x[:, 2].min() < -12e-3, f"it came to {x[:, 2].min():.3g} m only")
    return worst.expect(
        len(out) > 0 and abs(now / rest - 1) < 0.05, f"what is out has {now / max(rest, 1e-300):.3g} of its volume"
    )


def falls_on(setup: Setup, bed: ipc.TriMesh, soft: bool, mesh: ipc.TetMesh | None = None, young: float = 5e4) -> Worst:
    """A ball of 12 mm, or a mat, falls by a millimetre onto what is sharp; it carries the weight in the end.

    A ball may stand on an edge until rounding tips it: the steps suffice for it to come to rest again.
    """
    mesh = mesh or moved(ball(6e-3), (0.3e-3, 0.2e-3, 7e-3))
    bodies = [solid("ball", mesh, soft, young), ipc.KinematicBody("bed", bed)]
    worst = run(world_of(bodies, setup, friction=0.5, kappa=1e6, velocity_tolerance=FINE), 130)
    return carries(worst, "bed", G * mass(mesh))


def compactor(setup: Setup, kinds: str) -> Worst:
    """Cubes and balls in a box whose four walls and lid close in: soft ones are pressed together, hard ones stop the walls."""
    bodies: list[ipc.Body] = []
    for k in range(8):
        mesh = ball(4e-3, 3) if k % 2 else cube(6e-3, 2)
        mesh = moved(moved(mesh, tuple(-mesh.vertices.mean(axis=0))), (0, 0, 0), about((1, 2, 3), 0.4 * k))
        place = 10e-3 * (np.array([k % 2, k // 2 % 2, k // 4]) - 0.5)
        soft = kinds == "soft" or (kinds == "mixed" and k not in (0, 7))
        if soft:
            bodies.append(ipc.SoftBody(f"body{k}", moved(mesh, tuple(place)), ipc.Material(5e4, 0.4), self_contact=True))
        else:
            bodies.append(solid(f"body{k}", moved(mesh, tuple(place)), False))
    start, end = 11.5e-3, {"soft": 6.6e-3, "mixed": 7.2e-3, "affine": 5e-3}[kinds]
    walls = []
    for axis in range(3):
        for side in (-1, 1):
            size = np.full(3, 40e-3)
            size[axis] = 4e-3
            normal = side * np.eye(3)[axis]
            walls.append((f"wall{axis}{side:+d}", normal))
            bodies.append(ipc.KinematicBody(walls[-1][0], ipc.box_surface(tuple(size)), ipc.Pose(tuple((start + 2e-3) * normal))))
    once = {"halvings": 0} if kinds == "affine" else {}  # what jams is asked for once
    world = world_of(bodies, setup, gravity=(0, 0, 0), friction=0.3, kappa=1e5, velocity_tolerance=1e-5, **once)
    steps = 30

    def close(k: int) -> None:
        for name, normal in walls:
            world.set_target(name, (start + (end - start) * (k + 1) / steps + 2e-3) * normal)

    worst = run(world, steps, close, driven=True, jams=kinds == "affine")
    x = np.concatenate([world.positions(f"body{k}")[0] for k in range(8)])
    half = {name: float(world.frame(name)[1][0] @ normal) - 2e-3 for name, normal in walls}
    worst.expect(all((x @ normal < half[name]).all() for name, normal in walls), "something is outside of the walls")
    if kinds == "affine":
        return worst.expect(worst.blocked > 0, "nothing stopped the walls")
    return worst.expect(worst.blocked == 0, f"the walls did not make {worst.blocked:.3g} of a step")


def nut_and_bolt(setup: Setup, soft: bool) -> Worst:
    """A nut between two rails on a bolt that turns once: it advances by the pitch, but for the play of the threads."""
    radius, depth, pitch, play = 4e-3, 0.5e-3, 3e-3, 0.2e-3
    piece = nut(radius + play, depth, pitch, 3e-3, 14e-3)
    rails = together(*(shifted(ipc.box_surface((30e-3, 3e-3, 30e-3)), (0, s * (7e-3 + 0.15e-3 + 1.5e-3), 0)) for s in (-1, 1)))
    bodies = [
        solid("nut", piece, soft, 1e7),
        ipc.KinematicBody("bolt", as_surface(bolt(radius, depth, pitch, 12e-3))),
        ipc.KinematicBody("rails", rails),
    ]
    world = world_of(bodies, setup, gravity=(0, 0, 0), friction=0.0, kappa=1e6)
    steps = 64

    def turn(k: int) -> None:
        world.set_target("bolt", rotation=about((0, 0, 1), 2 * math.pi * (k + 1) / steps))

    worst = run(world, steps, turn, driven=True)
    came = float(world.rigid_motion("nut").centre[0, 2])
    slack = 2 * play / (2 * math.pi * depth / pitch)
    return worst.expect(abs(came + pitch) < slack, f"the nut advanced by {-came:.4g} m, the pitch being {pitch:.4g} m")


def gears(setup: Setup, soft: bool) -> Worst:
    """A wheel of eight teeth turns one of twelve, loose on its axle, by two thirds of its own angle, but for the play of the teeth."""
    teeth, depth, play = (8, 12), 0.6e-3, 0.1e-3
    radii = [1e-3 * n for n in teeth]
    apart = sum(radii) + play
    second = moved(gear(teeth[1], radii[1], depth, 4e-3, 4e-3, math.pi / teeth[1] + math.pi), (apart, 0, 0))
    bodies = [
        solid("second", second, soft, 1e7),
        ipc.KinematicBody("first", as_surface(gear(teeth[0], radii[0], depth, 3e-3, 5e-3))),
        ipc.KinematicBody("axle", cylinder(4e-3 - 0.15e-3, 8e-3, 24), ipc.Pose((apart, 0, 0))),
    ]
    world = world_of(bodies, setup, gravity=(0, 0, 0), friction=0.05, kappa=1e6)
    steps, whole = 50, 1.5
    worst = run(
        world, steps, lambda k: world.set_target("first", rotation=about((0, 0, 1), whole * (k + 1) / steps)), driven=True
    )
    rest, now = second.vertices if soft else as_surface(second).vertices, world.positions("second")[0]
    first, last = (x[:, 0] + 1j * x[:, 1] for x in (rest - rest.mean(axis=0), now - now.mean(axis=0)))
    angle = float(np.angle(np.sum(last * np.conj(first))))
    expected = -whole * teeth[0] / teeth[1]
    slack = 2 * play / depth / teeth[1]
    return worst.expect(abs(angle - expected) < slack, f"the second wheel turned by {angle:.4g} rad, not {expected:.4g}")


def peg(setup: Setup, soft: bool) -> Worst:
    """A square peg of 8 mm, tilted and off by 0.3 mm, falls through a funnel into a hole that is 0.05 mm wider: it comes to its bottom."""
    hole = 4.025e-3
    walls = channel([(5.5e-3, 3e-3), (hole, 0.0), (hole, -8e-3)])
    peg_mesh = moved(bar(8e-3, 10e-3, 8e-3, (1, 1, 2)), (0.3e-3, 0.2e-3, 6.5e-3), about((1, 2, 0), 0.02))
    bodies = [
        solid("peg", peg_mesh, soft, 1e7, 5000.0),
        ipc.KinematicBody("hole", walls),
        ipc.HalfSpace("bottom", ipc.Pose((0, 0, -8e-3))),
    ]
    world = world_of(bodies, setup, d_hat=2e-5, friction=0.0, kappa=1e6, velocity_tolerance=FINE)
    worst = run(world, 60)
    low = float(world.positions("peg")[0, :, 2].min())
    worst.expect(low < -7.9e-3, f"it came to {low:.3g} m only")
    return carries(worst, "bottom", 5 * G * mass(peg_mesh))


def wrecking_ball(setup: Setup) -> Worst:
    """An affine ball at 2 m/s into a wall of nine bricks: it goes through, and they lie about."""
    bodies: list[ipc.Body] = []
    for row in range(3):
        for column in range(3):
            brick = bar(9.6e-3, 6e-3, 5e-3, (1, 1, 1))
            place = (0, 10e-3 * (column - 1 + 0.5 * (row % 2)), 3e-3 + 0.5 * D_HAT + row * (6e-3 + 0.95 * D_HAT))
            bodies.append(solid(f"brick{3 * row + column}", moved(brick, place), False))
    shot = solid("shot", moved(ball(5e-3, 3), (-9e-3, 1e-3, 9e-3)), False, density=5000.0)
    world = world_of([*bodies, shot, ipc.HalfSpace("floor")], setup, dt=0.005, friction=0.4, kappa=1e6, velocity_tolerance=1e-5)
    world.set_velocity("shot", (2.0, 0.0, 0.0))
    worst = run(world, 40)
    hit = sum(float(world.positions(b.name)[0, :, 0].mean()) > 5e-3 for b in bodies)
    return worst.expect(hit >= 3, f"{hit} of 9 bricks were moved")


def many_turns(setup: Setup) -> Worst:
    """A mat of 40 × 8 × 0.6 mm twisted by ten whole turns."""
    mesh = bar(8e-3, 0.6e-3, 40e-3, (20, 4, 1))
    return twisted(setup, mesh, 10, 40e-3)


def _both(name: str, case: Callable[[Setup, bool], Worst]) -> dict[str, Callable[[Setup], Worst]]:
    return {f"{name}_{kind}": lambda a, soft=kind == "soft": case(a, soft) for kind in ("soft", "affine")}


MAT = moved(bar(20e-3, 0.6e-3, 20e-3, (10, 10, 1)), (0, 0, 1.3e-3))

CASES: dict[str, Callable[[Setup], Worst]] = {
    "rollers_draw_in": lambda a: rollers(a, 1.0),
    "rollers_slip": lambda a: rollers(a, 0.1),
    "rollers_coated": soft_rollers,
    "squeeze_out": squeeze_out,
    **_both("ball_on_points", lambda a, soft: falls_on(a, points(5, 3e-3, 6e-3), soft)),
    **_both("ball_on_knives", lambda a, soft: falls_on(a, knives(5, 3e-3, 16e-3, 6e-3), soft)),
    "mat_on_knives": lambda a: falls_on(a, knives(4, 5e-3, 30e-3, 6e-3), True, MAT, 5e3),
    "mat_on_points": lambda a: falls_on(a, points(5, 4e-3, 6e-3), True, MAT, 5e3),
    "trash_compactor_soft": lambda a: compactor(a, "soft"),
    "trash_compactor_mixed": lambda a: compactor(a, "mixed"),
    "trash_compactor_affine": lambda a: compactor(a, "affine"),
    **_both("nut_and_bolt", nut_and_bolt),
    **_both("gears", gears),
    **_both("peg_in_hole", peg),
    "wrecking_ball": wrecking_ball,
    "mat_twist_10_turns": many_turns,
}
