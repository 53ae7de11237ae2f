"""The cases that break contact solvers, made in code: sharp, aligned, fast, lopsided, blocked. A table of each one's worst figures.

    python experiments/hard_cases.py --out runs/hard_cases                 # all, with 1,000 random presses
    python experiments/hard_cases.py --cases spike_in_hole,cliff --out runs/hard_cases

A case passes if at every accepted state the least gap and the least det F are positive and all numbers are finite, and no step took
more Newton iterations than it may. The sharp ones follow Erleben 2018, "Methodology for Assessing Mesh-Based Contact Point Methods".
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import tyro

import ipc
from raytac.errors import RaytacError
from raytac.io.folder import result_folder
from raytac.io.metrics import VERSIONED, Metric, versions, write_metrics
from raytac.io.options import CommonOptions

SIZE = 0.02
"""Size of the bodies of the sharp cases [m]."""
D_HAT = 5e-4
MAX_NEWTON = 200


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Run the solver's hard cases and tabulate the worst figures of each."""

    cases: str = ""
    """Names joined by commas; empty for all."""
    presses: int = 1000
    """Number of random presses."""


@dataclass
class Worst:
    """Worst figures over the steps of a case."""

    min_gap: float = math.inf
    min_det: float = math.inf
    max_newton: int = 0
    unconverged: int = 0
    steps: int = 0
    blocked: float = 0.0
    finite: bool = True
    notes: list[str] = field(default_factory=list)

    def add(self, world: ipc.World, report: ipc.StepReport) -> None:
        """Take in one step."""
        self.min_gap = min(self.min_gap, float(report.min_gap.min()))
        self.min_det = min(self.min_det, float(report.min_det.min()))
        self.max_newton = max(self.max_newton, int(report.newton.max()))
        self.unconverged += int((~report.converged).sum())
        self.blocked = max(self.blocked, float(report.blocked.max()))
        self.steps += 1
        self.finite &= not report.failed.any()
        for body in world.bodies:
            if not isinstance(body, ipc.HalfSpace):
                self.finite &= bool(np.isfinite(world.positions(body.name)).all())

    def passed(self, most: int) -> bool:
        """Whether the case passed with at most ``most`` Newton iterations a step."""
        return self.finite and self.min_gap > 0 and self.min_det > 0 and self.max_newton <= most and not self.notes


def pyramid(up: bool, size: float = SIZE) -> ipc.TetMesh:
    """Two tetrahedra: a square base of ``size`` and a tip as far above or below it [m]; the tip is at the origin."""
    h = size / 2
    z = -size if up else size
    v = np.array([[-h, -h, z], [h, -h, z], [h, h, z], [-h, h, z], [0.0, 0.0, 0.0]])
    t = np.array([[0, 1, 2, 4], [0, 2, 3, 4]]) if up else np.array([[0, 2, 1, 4], [0, 3, 2, 4]])
    return ipc.TetMesh(v, t)


def wedge(up: bool, size: float = SIZE) -> ipc.TetMesh:
    """Three tetrahedra: a square base and, as far above or below it, an edge along x; the middle of the edge is at the origin."""
    h = size / 2
    z = -size if up else size
    v = np.array([[-h, -h, z], [h, -h, z], [h, h, z], [-h, h, z], [-h, 0.0, 0.0], [h, 0.0, 0.0]])
    t = np.array([[0, 1, 3, 4], [1, 2, 3, 5], [1, 3, 4, 5]])
    negative = np.linalg.det(v[t][:, 1:] - v[t][:, :1]) < 0
    t[negative] = t[negative][:, [0, 2, 1, 3]]
    return ipc.TetMesh(v, t)


def as_surface(mesh: ipc.TetMesh) -> ipc.TriMesh:
    """The boundary of tetrahedra."""
    from ipc.meshes import surface_of

    faces = surface_of(mesh.tets)
    used, local = np.unique(faces, return_inverse=True)
    return ipc.TriMesh(mesh.vertices[used], local.reshape(-1, 3))


def hole(size: float = 1.5 * SIZE) -> ipc.TriMesh:
    """An open funnel of four triangles whose lowest point is the origin."""
    h = size / 2
    v = np.array([[-h, -h, size], [h, -h, size], [h, h, size], [-h, h, size], [0.0, 0.0, 0.0]])
    return ipc.TriMesh(v, np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])[:, ::-1])


def crack(size: float = 1.5 * SIZE) -> ipc.TriMesh:
    """An open groove of two rectangles along x whose lowest line is z = 0."""
    h = size / 2
    v = np.array([[-h, -h, size], [h, -h, size], [h, h, size], [-h, h, size], [-h, 0.0, 0.0], [h, 0.0, 0.0]])
    return ipc.TriMesh(v, np.array([[0, 4, 1], [1, 4, 5], [2, 5, 3], [3, 5, 4]]))


def sheet(cells: int, size: float = 3 * SIZE) -> ipc.TriMesh:
    """A flat square of many triangles at z = 0: every inner edge could catch what slides over it."""
    line = np.linspace(-size / 2, size / 2, cells + 1)
    x, y = np.meshgrid(line, line)
    v = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    n = cells + 1
    i, j = np.meshgrid(np.arange(cells), np.arange(cells))
    a = (j * n + i).ravel()
    return ipc.TriMesh(v, np.concatenate([np.stack([a, a + 1, a + n + 1], 1), np.stack([a, a + n + 1, a + n], 1)]))


def cube(size: float = SIZE, cells: int = 1, lift: float = 0.0) -> ipc.TetMesh:
    """A cube about the z axis with its lower side at z = ``lift``."""
    line = np.linspace(-size / 2, size / 2, cells + 1)
    return ipc.box_mesh(line, line, line + size / 2 + lift)


def lifted(mesh: ipc.TetMesh, z: float, x: float = 0.0) -> ipc.TetMesh:
    """The same tetrahedra, moved [m]."""
    return ipc.TetMesh(mesh.vertices + np.array([x, 0.0, z]), mesh.tets)


SOFT = ipc.Material(1e6, 0.4)


def drop(
    mesh: ipc.TetMesh, obstacle: ipc.Body, args: Args, gravity: tuple[float, float, float] = (0, 0, -9.81), **settings: float
) -> ipc.World:
    """A soft body and what it falls on."""
    options: Any = {
        "dt": 0.025,
        "gravity": gravity,
        "d_hat": D_HAT,
        "max_newton": MAX_NEWTON,
        "friction": 0.1,
        "kappa": 1e5,
    }
    return ipc.World([ipc.SoftBody("soft", mesh, SOFT), obstacle], ipc.Settings(**(options | settings)), device=args.device)


def run(world: ipc.World, steps: int, each: Callable[[int], None] | None = None) -> Worst:
    """Step and keep the worst figures."""
    worst = Worst()
    for k in range(steps):
        if each is not None:
            each(k)
        worst.add(world, world.step())
    return worst


def kinematic(surface: ipc.TriMesh) -> ipc.KinematicBody:
    """An obstacle at rest."""
    return ipc.KinematicBody("obstacle", surface)


def two_cubes(args: Args, second: ipc.Material, size: float = SIZE, steps: int = 12, offset: float = 0.0) -> Worst:
    """A cube on a cube on a plane."""
    bodies = [
        ipc.SoftBody("lower", cube(lift=4e-4), SOFT),
        ipc.SoftBody("upper", lifted(cube(size, lift=4e-4), SIZE + 4e-4, offset), second),
        ipc.HalfSpace("floor"),
    ]
    settings = ipc.Settings(dt=0.01, gravity=(0, 0, -9.81), d_hat=D_HAT, kappa=1e5, friction=0.3, max_newton=MAX_NEWTON)
    return run(ipc.World(bodies, settings, device=args.device), steps)


def squeeze(args: Args) -> Worst:
    """A soft ball between two plates, down to half its height and back: it must come back to its shape."""
    mesh = cube(cells=3)
    rest = mesh.vertices.copy()
    bodies = [
        ipc.SoftBody("soft", mesh, ipc.Material(1e5, 0.4)),
        ipc.KinematicBody("low", ipc.box_surface((0.06, 0.06, 0.004)), ipc.Pose((0, 0, -0.002 - 6e-4))),
        ipc.KinematicBody("high", ipc.box_surface((0.06, 0.06, 0.004)), ipc.Pose((0, 0, SIZE + 0.002 + 6e-4))),
    ]
    settings = ipc.Settings(dt=0.01, d_hat=D_HAT, friction=0.5, max_newton=MAX_NEWTON)
    world = ipc.World(bodies, settings, device=args.device)

    def move(k: int) -> None:
        way = min(k + 1, 24 - k) if k < 24 else 0
        world.set_target("high", (0, 0, SIZE + 0.002 + 6e-4 - 0.5 * SIZE * max(way, 0) / 12))

    worst = run(world, 40, move)
    now = world.positions("soft")[0]
    edges = [np.linalg.norm(x[mesh.tets][:, 1:] - x[mesh.tets][:, :1], axis=-1) for x in (now, rest)]
    error = float(np.abs(edges[0] / edges[1] - 1).max())
    if error > 0.01:
        worst.notes.append(f"did not recover its shape: {error:.3g}")
    return worst


def folded(args: Args) -> Worst:
    """A slotted block pressed until its two arms meet: self-contact."""
    line = np.array([-0.01, -0.006, -0.002, 0.002, 0.006, 0.01])
    mesh = ipc.box_mesh(line, [-0.004, 0.004], np.linspace(0, 0.02, 6))
    middle = mesh.vertices[mesh.tets].mean(axis=1)
    keep = ~((np.abs(middle[:, 0]) < 0.002) & (middle[:, 2] > 0.004))
    used, tets = np.unique(mesh.tets[keep], return_inverse=True)
    mesh = ipc.TetMesh(mesh.vertices[used], tets.reshape(-1, 4))
    bonded = ipc.vertices_in_box(mesh, (-1, -1, 0), (1, 1, 0))
    bodies = [
        ipc.SoftBody("fork", mesh, ipc.Material(1e5, 0.4), bonded=bonded, self_contact=True),
        ipc.KinematicBody("left", ipc.box_surface((0.004, 0.02, 0.006)), ipc.Pose((-0.0125, 0, 0.017))),
        ipc.KinematicBody("right", ipc.box_surface((0.004, 0.02, 0.006)), ipc.Pose((0.0125, 0, 0.017))),
    ]
    settings = ipc.Settings(dt=0.02, d_hat=3e-4, friction=0.2, max_newton=MAX_NEWTON)
    world = ipc.World(bodies, settings, device=args.device)

    def move(k: int) -> None:
        way = 0.0036 * (k + 1) / 15
        world.set_target("left", (-0.0125 + way, 0, 0.017))
        world.set_target("right", (0.0125 - way, 0, 0.017))

    worst = run(world, 15, move)
    if ("fork", "fork") not in world.contacts().bodies:
        worst.notes.append("the arms never met")
    return worst


def blocked(args: Args) -> Worst:
    """A ball driven through the pad into the bonded base."""
    mesh = ipc.domed_pad((12e-3, 12e-3), 3e-3, (math.inf, math.inf), (4, 4, 2))
    pad = ipc.SoftBody("pad", mesh, ipc.Material(1e5, 0.45), bonded=ipc.vertices_in_box(mesh, (-1, -1, -3e-3), (1, 1, -3e-3)))
    ball = ipc.KinematicBody("ball", ipc.icosphere(3e-3, 2), ipc.Pose((0, 0, 3.1e-3)))
    world = ipc.World([pad, ball], ipc.Settings(d_hat=1e-4, max_newton=MAX_NEWTON), device=args.device)
    worst = run(world, 4, lambda k: world.set_target("ball", (0, 0, -3e-3)))
    if not 0 < worst.blocked <= 1:
        worst.notes.append("was not blocked")
    return worst


def random_presses(args: Args, count: int) -> Worst:
    """Presses, shears and twists of convex and concave objects, anywhere on a coarse pad, many at once."""
    rng = np.random.default_rng(args.seed)
    mesh = ipc.domed_pad((12e-3, 12e-3), 4e-3, (math.inf, math.inf), (5, 5, 2))
    pad = ipc.SoftBody("pad", mesh, ipc.Material(1e5, 0.45), bonded=ipc.vertices_in_box(mesh, (-1, -1, -4e-3), (1, 1, -4e-3)))
    ring = ipc.icosphere(3e-3, 1)
    dent = ring.vertices.copy()
    dent[:, 2] = np.where(dent[:, 2] < -1.5e-3, -3e-3 - dent[:, 2], dent[:, 2])  # a ball whose lower cap is turned inwards
    shapes = {
        "ball": ipc.icosphere(3e-3, 2),
        "box": ipc.box_surface((4e-3, 3e-3, 2e-3)),
        "spike": as_surface(lifted(pyramid(False, 5e-3), -2.5e-3)),
        "dent": ipc.TriMesh(dent, ring.faces),
    }
    worst = Worst()
    for name, shape in shapes.items():
        envs = count // len(shapes)
        if envs == 0:
            continue
        axis, angle = rng.standard_normal((envs, 3)), rng.uniform(0, math.pi, envs)
        axis /= np.linalg.norm(axis, axis=1, keepdims=True)
        turn = np.concatenate([np.cos(angle / 2)[:, None], np.sin(angle / 2)[:, None] * axis], axis=1)
        from ipc.layout import rotation_matrix

        low = (rotation_matrix(turn) @ shape.vertices.T)[:, 2].min(axis=1)
        start = np.column_stack([rng.uniform(-3e-3, 3e-3, (envs, 2)), 0.15e-3 - low])
        tool = ipc.KinematicBody("tool", shape, ipc.Pose((0.0, 0.0, 0.02)))
        settings = ipc.Settings(
            dt=0.02, d_hat=1e-4, friction=0.5, max_newton=MAX_NEWTON, friction_relags=1, velocity_tolerance=1e-3
        )
        world = ipc.World([pad, tool], settings, num_envs=envs, device=args.device)
        world.teleport("tool", start, turn)
        depth, side, twist = rng.uniform(0.2e-3, 1.5e-3, envs), rng.uniform(-1e-3, 1e-3, (envs, 2)), rng.uniform(-0.5, 0.5, envs)
        steps = 9
        for k in range(1, steps + 1):
            down, after = min(k / 5, 1.0), max(k - 5, 0) / 4
            half = 0.5 * after * twist
            w, x, y, z = turn.T
            c, s = np.cos(half), np.sin(half)
            turned = np.column_stack([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w])
            world.set_target("tool", start + np.column_stack([after * side, -depth * down]), turned)
            worst.add(world, world.step())
        print(
            f"  random_presses: {name} x {envs}, gap {worst.min_gap:.3g} m, det F {worst.min_det:.3g}, newton {worst.max_newton}"
        )
    return worst


G = 9.81
TILTED = (G * math.sin(0.5), 0.0, -G * math.cos(0.5))
CASES: dict[str, Callable[[Args], Worst]] = {
    "spike_on_spike": lambda a: run(drop(lifted(pyramid(False), 4e-4), kinematic(as_surface(pyramid(True))), a), 12),
    "wedge_on_wedge": lambda a: run(drop(lifted(wedge(False), 4e-4), kinematic(as_surface(wedge(True))), a), 12),
    "spike_on_wedge": lambda a: run(drop(lifted(pyramid(False), 4e-4), kinematic(as_surface(wedge(True))), a), 12),
    "spike_in_hole": lambda a: run(drop(lifted(pyramid(False), 3e-3), kinematic(hole()), a), 12),
    "spike_in_crack": lambda a: run(drop(lifted(pyramid(False), 3e-3), kinematic(crack()), a), 12),
    "wedge_in_crack": lambda a: run(drop(lifted(wedge(False), 3e-3), kinematic(crack()), a), 12),
    "sliding_spike": lambda a: run(drop(lifted(pyramid(False), 4e-4), kinematic(sheet(8)), a, TILTED), 12),
    "sliding_wedge": lambda a: run(drop(lifted(wedge(False), 4e-4), kinematic(sheet(8)), a, TILTED), 12),
    "internal_edges": lambda a: run(drop(cube(lift=4e-4), kinematic(sheet(7)), a, TILTED), 12),
    "cliff": lambda a: run(
        drop(lifted(cube(lift=4e-4), 0.0, 0.008), kinematic(ipc.box_surface((SIZE, SIZE, SIZE), (0, 0, -SIZE / 2))), a), 12
    ),
    "vertex_alignment": lambda a: two_cubes(a, SOFT),
    "edge_alignment": lambda a: two_cubes(a, SOFT, offset=SIZE),
    "mass_ratio_1e4": lambda a: two_cubes(a, ipc.Material(1e6, 0.4, 1e4), size=10 * SIZE),
    "stiffness_ratio_1e4": lambda a: two_cubes(a, ipc.Material(1e10, 0.4)),
    "dt_1ms": lambda a: run(drop(cube(cells=2, lift=1e-3), ipc.HalfSpace("floor"), a, dt=1e-3), 20),
    "dt_10ms": lambda a: run(drop(cube(cells=2, lift=1e-3), ipc.HalfSpace("floor"), a, dt=1e-2), 15),
    "dt_100ms": lambda a: run(drop(cube(cells=2, lift=1e-3), ipc.HalfSpace("floor"), a, dt=1e-1), 10),
    "dt_1s": lambda a: run(drop(cube(cells=2, lift=1e-3), ipc.HalfSpace("floor"), a, dt=1.0), 6),
    "squeeze_and_release": squeeze,
    "self_contact": folded,
    "blocked_drive": blocked,
}


def main(args: Args) -> int:
    start = time.perf_counter()
    names = [n for n in args.cases.split(",") if n] or [*CASES, "random_presses"]
    unknown = [n for n in names if n not in CASES and n != "random_presses"]
    if unknown:
        print(f"--cases {','.join(unknown)}: choose from {', '.join([*CASES, 'random_presses'])}", file=sys.stderr)
        return 2
    metrics: dict[str, Metric] = {}
    passed = 0
    print(f"{'case':22} {'min gap [m]':>12} {'min det F':>10} {'newton':>7} {'unconverged':>11}  verdict")
    for name in names:
        worst = random_presses(args, args.presses) if name == "random_presses" else CASES[name](args)
        good = worst.passed(MAX_NEWTON)
        passed += good
        print(
            f"{name:22} {worst.min_gap:12.3e} {worst.min_det:10.4f} {worst.max_newton:7d} {worst.unconverged:11d}  "
            f"{'pass' if good else 'FAIL'} {'; '.join(worst.notes)}"
        )
        if math.isfinite(worst.min_gap):
            metrics[f"{name}.min_gap_m"] = worst.min_gap
        metrics |= {
            f"{name}.min_det_f": worst.min_det,
            f"{name}.max_newton": worst.max_newton,
            f"{name}.unconverged": worst.unconverged,
        }
    metrics |= {"cases.passed": passed, "cases.total": len(names)}
    common = {"experiment": "hard_cases", "device": args.device, "seed": args.seed, **versions((*VERSIONED, "warp-lang"))}
    with result_folder(args.out or Path("runs/hard_cases"), ("metrics.json",)) as folder:
        write_metrics(folder / "metrics.json", {**common, **metrics, "wall_s": time.perf_counter() - start})
    return 0 if passed == len(names) else 1


if __name__ == "__main__":
    try:
        sys.exit(main(tyro.cli(Args)))
    except RaytacError as error:
        sys.exit(f"error: {error}")
