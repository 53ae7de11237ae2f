"""Does the contact solver meet closed forms? Hertz's sphere, the flat punch and a pressed block, with the stand-off taken off.

    python experiments/ipc_validation.py --out runs/ipc_validation            # some minutes on two cores
    python experiments/ipc_validation.py --out runs/ipc_validation --refine 2 # finer meshes

Writes metrics.json and force_depth.png. ``ipc/README.md`` and ``docs/ipc.md`` say what the figures mean.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
import tyro

import ipc
from raytac.errors import RaytacError
from raytac.io.folder import result_folder
from raytac.io.metrics import VERSIONED, Metric, versions, write_metrics
from raytac.io.options import CommonOptions

matplotlib.use("Agg")
import matplotlib.pyplot as plt


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Compare the contact solver with closed forms."""

    refine: float = 1.0
    """Cells to the contact radius are 4 times this."""
    steps: int = 4
    """Depths on each curve."""
    parts: str = "hertz,punch,block"
    """Names joined by commas."""


YOUNG, POISSON = 1e5, 0.3
RADIUS = 20e-3
CONTACT = 1e-3
"""Radius of the contact circle that meshes are made for [m]."""
PLANE_STRAIN = YOUNG / (1 - POISSON**2)


def graded_side(cell: float, reach: float, growth: float = 1.35) -> np.ndarray:
    """Coordinates from 0 [m]: cells of ``cell`` over 1.3 contact radii, then growing until ``reach``."""
    line = list(np.arange(0.0, 1.3 * CONTACT + 1e-12, cell))
    while line[-1] < reach:
        cell *= growth
        line.append(line[-1] + cell)
    return np.array(line)


def half_space_block(refine: float) -> ipc.SoftBody:
    """A block of 40 contact radii to each side and down, fine under the contact, bonded on all sides but the top."""
    side = graded_side(CONTACT / (4 * refine), 40 * CONTACT)
    line = np.concatenate([-side[:0:-1], side])
    mesh = ipc.box_mesh(line, line, -side[::-1], mirrored=True)
    v, edge = mesh.vertices, side[-1]
    bonded = np.flatnonzero((np.abs(v[:, 0]) > edge - 1e-9) | (np.abs(v[:, 1]) > edge - 1e-9) | (v[:, 2] < -edge + 1e-9))
    return ipc.SoftBody("block", mesh, ipc.Material(YOUNG, POISSON), bonded=bonded)


def disc(radius: float, rings: int, height: float = 0.0) -> ipc.TriMesh:
    """A disc facing down, dished up to a sphere of radius ``height`` if that is positive [m]."""
    points, faces = [np.zeros((1, 2))], []
    for ring in range(1, rings + 1):
        angle = np.arange(6 * ring) * (2 * np.pi / (6 * ring))
        points.append(radius * ring / rings * np.stack([np.cos(angle), np.sin(angle)], axis=1))
        inner, outer = 1 + 3 * (ring - 1) * (ring - 2), 1 + 3 * ring * (ring - 1)
        count_in, count_out = max(1, 6 * (ring - 1)), 6 * ring
        for sector in range(6):
            for k in range(ring):
                a = outer + (sector * ring + k) % count_out
                b = outer + (sector * ring + k + 1) % count_out
                c = inner + (sector * (ring - 1) + k) % count_in if ring > 1 else 0
                faces.append((a, c, b))
                if k + 1 < ring:
                    d = inner + (sector * (ring - 1) + k + 1) % count_in
                    faces.append((b, c, d))
    flat = np.concatenate(points)
    z = height - np.sqrt(height**2 - (flat**2).sum(axis=1)) if height > 0 else np.zeros(len(flat))
    return ipc.TriMesh(np.column_stack([flat, z]), np.array(faces))


def press(tool: ipc.TriMesh, depths: np.ndarray, args: Args, d_hat: float) -> tuple[np.ndarray, np.ndarray, ipc.World]:
    """Forces [N] and effective depths [m]: the tool's depth plus the mean gap, weighed by the contact forces."""
    settings = ipc.Settings(dt=1e3, d_hat=d_hat, kappa=YOUNG, velocity_tolerance=1e-12, linear_tolerance=1e-4)
    body = ipc.KinematicBody("tool", tool, ipc.Pose((0.0, 0.0, 1.01 * d_hat)))
    world = ipc.World([half_space_block(args.refine), body], settings, device=args.device)
    forces, effective = [], []
    for depth in depths:
        world.set_target("tool", (0.0, 0.0, -depth))
        report = world.step()
        pairs = world.contacts()
        gap = float(pairs.force @ pairs.gap / pairs.force.sum())
        forces.append(float(world.wrench("tool").force[0, 2]))
        effective.append(depth + gap)
        print(
            f"  depth {depth * 1e6:6.1f} um  force {forces[-1]:.5f} N  gap {gap * 1e6:.2f} um  newton {report.newton[0]}  "
            f"pcg {report.linear[0]}  converged {report.converged[0]}"
        )
    return np.array(forces), np.array(effective), world


def block_pressure(device: str) -> dict[str, float]:
    """Two blocks of different meshes pressed together (ν = 0, so the exact pressure is uniform): spread of the contact stress."""
    seven, six, four = (np.linspace(0, 10e-3, n) for n in (7, 6, 4))
    lower, upper = ipc.box_mesh(seven, seven, four), ipc.box_mesh(six, six, four)
    d_hat = 0.1e-3
    material = ipc.Material(YOUNG, 0.0)
    bodies = [
        ipc.SoftBody("lower", lower, material, bonded=ipc.vertices_in_box(lower, (-1, -1, 0), (1, 1, 0))),
        ipc.SoftBody(
            "upper",
            upper,
            material,
            bonded=ipc.vertices_in_box(upper, (-1, -1, 10e-3), (1, 1, 10e-3)),
            pose=ipc.Pose((0, 0, 10.1e-3)),
        ),
    ]
    settings = ipc.Settings(dt=1e3, d_hat=d_hat, kappa=YOUNG, velocity_tolerance=1e-12, linear_tolerance=1e-6)
    world = ipc.World(bodies, settings, device=device)
    for k in range(1, 11):
        world.set_target("upper", (0.0, 0.0, 10.1e-3 - k * 0.1e-3))
        world.step()
    force = world.wrench("lower").force[0, 2]
    stress = []
    for name in ("lower", "upper"):
        body = world.layout.names.index(name)
        tets = slice(world.layout.tet_start[body], world.layout.tet_start[body + 1])
        x = world.positions(name)[0][world.layout.tets[tets] - world.layout.node_start[body]]
        F = np.einsum("tai,taj->tij", x, world.layout.grads[tets])
        rest = world.bodies[body].mesh.vertices[world.layout.tets[tets] - world.layout.node_start[body]].mean(axis=1)  # type: ignore
        mu, lam = material.coefficients()
        J = np.linalg.det(F)
        cof = J[:, None, None] * np.linalg.inv(F).transpose(0, 2, 1)
        P = mu * F + (lam * (J - 1) - mu)[:, None, None] * cof
        middle = (np.abs(rest[:, 2] - 5e-3) < 2e-3) & (np.abs(rest[:, :2] - 5e-3) < 3.4e-3).all(axis=1)
        stress.append(P[middle, 2, 2])
    values = np.concatenate(stress)
    mean = abs(force) / 1e-4
    return {"block.pressure_pa": mean, "block.stress_spread": float(np.abs(-values - mean).max() / mean)}


def main(args: Args) -> None:
    begin = time.perf_counter()
    parts = args.parts.split(",")
    unknown = set(parts) - {"hertz", "punch", "block"}
    if unknown:
        raise SystemExit(f"--parts {args.parts}: choose from hertz, punch, block")
    metrics: dict[str, Metric] = {"refine": args.refine, "young_pa": YOUNG, "poisson": POISSON}
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6))
    d_hat = 0.02 * CONTACT / args.refine
    shares = np.arange(1, args.steps + 1) / args.steps
    cases = {
        "hertz": (
            disc(2.0 * CONTACT, int(12 * args.refine), RADIUS),
            shares * CONTACT**2 / RADIUS,
            lambda depth: 4 / 3 * PLANE_STRAIN * np.sqrt(RADIUS) * depth**1.5,
        ),
        "punch": (
            disc(CONTACT, int(8 * args.refine)),
            shares * 0.05 * CONTACT,
            lambda depth: 2 * CONTACT * PLANE_STRAIN * depth,
        ),
    }
    for axis, (name, (tool, depths, exact)) in zip(axes, cases.items(), strict=True):
        if name not in parts:
            continue
        start = time.perf_counter()
        force, depth, world = press(tool, depths, args, d_hat)
        error = force / exact(depth) - 1
        print(f"{name}: error {error}")
        metrics[f"{name}.vertices"] = len(world.positions("block")[0])
        metrics[f"{name}.error"] = float(error[-1])
        metrics[f"{name}.max_error"] = float(np.abs(error).max())
        metrics[f"{name}.seconds"] = time.perf_counter() - start
        line = np.linspace(0, depth[-1] * 1.05, 100)
        axis.plot(line * 1e6, exact(line) * 1e3, "k-", lw=1, label="closed form")
        axis.plot(depth * 1e6, force * 1e3, "o", color="tab:blue", label=f"ipc, {metrics[f'{name}.vertices']} vertices")
        axis.set(
            xlabel="depth, stand-off included [µm]", ylabel="force [mN]", title={"hertz": "Sphere", "punch": "Flat punch"}[name]
        )
        axis.legend(frameon=False)
    if "block" in parts:
        metrics |= block_pressure(args.device)
        print(f"block: spread {metrics['block.stress_spread']:.3g}")
    figure.tight_layout()
    common = {"experiment": "ipc_validation", "device": args.device, "seed": args.seed, **versions((*VERSIONED, "warp-lang"))}
    with result_folder(args.out or Path("runs/ipc_validation"), ("metrics.json", "force_depth.png")) as folder:
        figure.savefig(folder / "force_depth.png", dpi=120)
        write_metrics(folder / "metrics.json", {**common, **metrics, "wall_s": time.perf_counter() - begin})


if __name__ == "__main__":
    try:
        main(tyro.cli(Args))
    except RaytacError as error:
        sys.exit(f"error: {error}")
