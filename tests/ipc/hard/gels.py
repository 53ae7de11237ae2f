"""Gel pads and scales: rims, gel on gel, nearly incompressible gel, tear-off, d̂ from 1 µm to 1 mm, surfaces that begin 1 nm apart."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

import ipc
from tests.ipc.hard.run import D_HAT, G, Setup, Worst, carries, mass, run, solid, world_of
from tests.ipc.hard.shapes import SIZE, about, as_surface, cube, moved, pyramid, then

THICK = 4e-3
"""Thickness of the pads [m]."""


def pad(
    name: str, material: ipc.Material, cells: tuple[int, int, int] = (6, 6, 2), pose: ipc.Pose | None = None, blocks: bool = False
) -> ipc.SoftBody:
    """A flat pad of 12 × 12 × 4 mm, its outer surface at z = 0, bonded below."""
    mesh = ipc.domed_pad((12e-3, 12e-3), THICK, (math.inf, math.inf), cells)
    base = ipc.vertices_in_box(mesh, (-1, -1, -THICK), (1, 1, -THICK))
    volumes = ipc.grid_blocks(cells) if blocks else None
    return ipc.SoftBody(name, mesh, material, bonded=base, pose=pose or ipc.Pose(), volume_blocks=volumes)


def _recovered(world: ipc.World, gel: ipc.SoftBody) -> float:
    """Largest displacement of a pad's vertices [m]."""
    return float(np.abs(world.positions(gel.name, frame="body")[0] - gel.mesh.vertices).max())


def _friction_share(world: ipc.World) -> float | None:
    """Friction between the only two bodies over the sum of their normal forces; None where they do not press."""
    normal = float(world.contacts().force.sum())
    if normal < 1e-6:
        return None
    (forces,) = world.pressing().values()
    return float(np.linalg.norm(forces.wrench[0, :3] - forces.normal[0])) / normal


def pad_rim(setup: Setup, tool: ipc.TriMesh, at: tuple[float, float], driven: bool) -> Worst:
    """A tool pressed 0.8 mm into a pad at its rim, drawn out over the rim by 2 mm, and lifted: the pad takes its shape again."""
    gel = pad("pad", ipc.Material(1e5, 0.45))
    low = -float(tool.vertices[:, 2].min())
    start = np.array([*at, low + 2e-4])
    name, pose = "tool", ipc.Pose(tuple(start))
    body = ipc.AffineBody(name, tool, pose=pose, drive=1e4) if driven else ipc.KinematicBody(name, tool, pose)
    world = world_of([gel, body], setup, gravity=(0, 0, 0), friction=0.5, velocity_tolerance=1e-5)
    forces: list[float] = []

    def move(k: int) -> None:
        down, out, up = min((k + 1) / 10, 1.0), min(max((k - 9) / 10, 0.0), 1.0), min(max((k - 19) / 8, 0.0), 1.0)
        world.set_target(name, start + np.array([2e-3 * out, 0.5e-3 * out, -1e-3 * down + 3e-3 * up]))
        forces.append(float(world.wrench("pad").force[0, 2]))

    worst = run(world, 40, move, driven=True)
    worst.expect(min(forces) < -0.02, f"it was pressed with {-min(forces):.3g} N only")
    worst.expect(not world.contacts().bodies, "it still touches")
    return worst.expect(_recovered(world, gel) < 1e-5, f"the pad is off by {_recovered(world, gel):.3g} m")


def gel_on_gel(setup: Setup, cells: tuple[int, int, int], angle: float) -> Worst:
    """Two pads face to face, pressed by 0.3 mm and sheared by 3 mm: they act on each other alike, and slide at μ."""
    friction, material = 0.5, ipc.Material(1e5, 0.45)
    turn = then(about((1, 0, 0), math.pi), about((0, 0, 1), angle))
    bodies: list[ipc.Body] = [
        pad("low", material),
        pad("high", material, cells, ipc.Pose((0, 0, 2e-4), turn)),
    ]
    world = world_of(bodies, setup, gravity=(0, 0, 0), friction=friction, velocity_tolerance=1e-5)
    ratios: list[float] = []

    def move(k: int) -> None:
        ratios.append(_friction_share(world) or 0.0)
        down, side = min((k + 1) / 5, 1.0), max(k - 4, 0) / 25
        world.set_target("high", (3e-3 * side, 0.0, 2e-4 - 5e-4 * down))

    worst = run(world, 30, move, driven=True)
    low, high = (world.wrench(name).force[0] for name in ("low", "high"))
    worst.expect(np.linalg.norm(low + high) < 0.01 * np.linalg.norm(low), f"forces {low} and {high} N are not opposite")
    worst.expect(max(ratios) < 1.02 * friction, f"friction over normal forces comes to {max(ratios):.4g}, μ = {friction}")
    return worst.expect(ratios[-1] > 0.98 * friction, f"friction over normal forces is {ratios[-1]:.4g} in a full slide")


def needle(setup: Setup, poisson: float, blocks: bool) -> Worst:
    """A spike 1 mm into a nearly incompressible pad and out again: the pad's volume stays as it was to 1 %."""
    gel = pad("pad", ipc.Material(1e5, poisson), blocks=blocks)
    spike = as_surface(moved(pyramid(False, 5e-3), (0, 0, 0)))
    world = world_of([gel, ipc.KinematicBody("spike", spike, ipc.Pose((0.3e-3, 0.2e-3, 2e-4)))], setup, gravity=(0, 0, 0))
    volumes: list[float] = []
    x0 = gel.mesh.vertices[gel.mesh.tets]
    rest = np.linalg.det(x0[:, 1:] - x0[:, :1]).sum()

    def move(k: int) -> None:
        x = world.positions("pad")[0][gel.mesh.tets]
        volumes.append(float(np.linalg.det(x[:, 1:] - x[:, :1]).sum() / rest))
        world.set_target("spike", (0.3e-3, 0.2e-3, 2e-4 - 1.2e-3 * min((k + 1) / 10, (20 - k) / 10)))

    worst = run(world, 26, move, driven=True)
    worst.expect(max(abs(v - 1) for v in volumes) < 0.01, f"the volume came to {min(volumes):.4g} of itself")
    return worst.expect(_recovered(world, gel) < 2e-5, f"the pad is off by {_recovered(world, gel):.3g} m")


def squeezed(setup: Setup, poisson: float) -> Worst:
    """A cube of nearly incompressible gel between plates that it sticks to, to two thirds of its height: it keeps its volume to 1 %."""
    mesh = cube(cells=4)
    plate, gap = ipc.box_surface((0.06, 0.06, 0.004)), 2e-4
    bodies: list[ipc.Body] = [
        ipc.SoftBody("soft", mesh, ipc.Material(1e5, poisson), volume_blocks=ipc.grid_blocks((4, 4, 4)), self_contact=True),
        ipc.KinematicBody("low", plate, ipc.Pose((0, 0, -0.002 - gap))),
        ipc.KinematicBody("high", plate, ipc.Pose((0, 0, SIZE + 0.002 + gap))),
    ]
    world = world_of(bodies, setup, gravity=(0, 0, 0), friction=0.8)
    start = SIZE + 0.002 + gap
    worst = run(world, 15, lambda k: world.set_target("high", (0, 0, start - SIZE / 3 * (k + 1) / 15)), driven=True)
    x = world.positions("soft")[0]
    volume = float(np.linalg.det(x[mesh.tets][:, 1:] - x[mesh.tets][:, :1]).sum() / 6 / SIZE**3)
    worst.expect(np.ptp(x[:, 2]) < 0.7 * SIZE, f"its height is {np.ptp(x[:, 2]):.3g} m")
    return worst.expect(abs(volume - 1) < 0.01, f"its volume is {volume:.4g} of that before")


def tear_off(setup: Setup, driven: bool) -> Worst:
    """A ball pressed 0.5 mm into a pad at μ = 5, drawn aside by 1.5 mm and then up.

    It shears the gel by far more than μ = 1 could, never by more than μ N, and once it is off nothing pulls.
    """
    friction = 5.0
    gel = pad("pad", ipc.Material(1e5, 0.45))
    tool, start = ipc.icosphere(4e-3, 2), np.array([-0.5e-3, 0.2e-3, 4e-3 + 2e-4])
    pose = ipc.Pose(tuple(start))
    body = ipc.AffineBody("ball", tool, pose=pose, drive=1e4) if driven else ipc.KinematicBody("ball", tool, pose)
    world = world_of([gel, body], setup, gravity=(0, 0, 0), friction=friction, velocity_tolerance=1e-5)
    ratios: list[float] = []

    def move(k: int) -> None:
        ratios.append(_friction_share(world) or 0.0)
        down, side, up = min((k + 1) / 6, 1.0), min(max((k - 5) / 12, 0.0), 1.0), min(max((k - 17) / 10, 0.0), 1.0)
        world.set_target("ball", start + np.array([1.5e-3 * side, 0.0, -0.7e-3 * down + 3e-3 * up]))

    worst = run(world, 40, move, driven=True)
    worst.expect(max(ratios) > 1.2, f"friction over normal forces comes to {max(ratios):.3g} only")
    worst.expect(max(ratios) < 1.02 * friction, f"friction over normal forces comes to {max(ratios):.4g}, μ = {friction}")
    worst.expect(not world.contacts().bodies, "it is not off")
    return worst.expect(_recovered(world, gel) < 1e-5, f"the pad is off by {_recovered(world, gel):.3g} m")


def barrier_width(setup: Setup, d_hat: float, soft: bool) -> Worst:
    """A tilted cube falls on a slab of another mesh with that d̂: it comes to rest within d̂ of the slab, which carries it."""
    tilt = moved(moved(cube(0.5 * SIZE, 2 if soft else 1), (0, 0, -0.25 * SIZE)), (0, 0, 0), about((1, 2, 0), 0.15))
    mesh = moved(tilt, (0.1e-3, 0.2e-3, 2 * d_hat + 1e-4 - tilt.vertices[:, 2].min()))
    slab = moved(cube(2 * SIZE, 3), (0, 0, -2 * SIZE))
    base = ipc.vertices_in_box(slab, (-1, -1, -2 * SIZE), (1, 1, -2 * SIZE))
    material = ipc.Material(1e6, 0.4)
    bodies = [solid("falling", mesh, soft, 1e6), ipc.SoftBody("slab", slab, material, bonded=base)]
    world = world_of(bodies, setup, dt=0.02, d_hat=d_hat, friction=0.3, velocity_tolerance=1e-4 * d_hat / 0.02)
    worst = run(world, 60)
    gap = float(world.contacts().gap.max(initial=0.0))
    worst.expect(0 < gap < d_hat, f"its contacts are up to {gap:.3g} m wide")
    return carries(worst, "slab", G * (mass(mesh) + mass(slab)))


def start_gap(setup: Setup, kinds: tuple[bool, bool]) -> Worst:
    """Two cubes that begin 1 nm from each other and from a plate, d̂ being 0.1 mm: they leave, with the barrier's energy at most."""
    gap, plate = 1e-9, ipc.box_surface((0.06, 0.06, 0.004), (0, 0, -0.002))
    meshes = moved(cube(), (0, 0, gap)), moved(cube(0.7 * SIZE), (1e-3, 0.5e-3, SIZE + 2 * gap))
    bodies = [solid(n, m, soft, 1e5) for n, m, soft in zip(("lower", "upper"), meshes, kinds, strict=True)]
    world = world_of([*bodies, ipc.KinematicBody("plate", plate)], setup, friction=0.3, kappa=1e5)
    worst = run(world, 60)
    now = float(world.contacts().gap.min(initial=math.inf))
    worst.expect(now > 0.1 * D_HAT, f"the gap is {now:.3g} m in the end")
    return worst


BALL, BOX = ipc.icosphere(3e-3, 2), ipc.box_surface((5e-3, 4e-3, 3e-3))
KINDS = {"soft": (True, True), "affine": (False, False), "soft_on_affine": (False, True)}

CASES: dict[str, Callable[[Setup], Worst]] = {
    "pad_rim_ball": lambda a: pad_rim(a, BALL, (5.2e-3, 0.3e-3), False),
    "pad_rim_box": lambda a: pad_rim(a, BOX, (4.5e-3, 0.3e-3), False),
    "pad_rim_corner": lambda a: pad_rim(a, as_surface(moved(pyramid(False, 6e-3), (0, 0, 0))), (4.6e-3, 4.6e-3), False),
    "pad_rim_affine": lambda a: pad_rim(a, BALL, (5.2e-3, 0.3e-3), True),
    "gel_on_gel_alike": lambda a: gel_on_gel(a, (6, 6, 2), 0.0),
    "gel_on_gel_unlike": lambda a: gel_on_gel(a, (7, 5, 2), 0.3),
    "needle_nu_0495": lambda a: needle(a, 0.495, False),
    "needle_nu_0495_blocks": lambda a: needle(a, 0.495, True),
    "squeezed_nu_0495": lambda a: squeezed(a, 0.495),
    "squeezed_nu_0499": lambda a: squeezed(a, 0.499),
    "tear_off_mu_5": lambda a: tear_off(a, False),
    "tear_off_mu_5_affine": lambda a: tear_off(a, True),
    **{
        f"d_hat_{name}_{kind}": lambda a, d=d, soft=kind == "soft": barrier_width(a, d, soft)
        for name, d in (("1um", 1e-6), ("10um", 1e-5), ("1mm", 1e-3))
        for kind in ("soft", "affine")
    },
    **{f"start_gap_1nm_{name}": lambda a, kinds=kinds: start_gap(a, kinds) for name, kinds in KINDS.items()},
}
