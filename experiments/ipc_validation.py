"""Does the contact solver meet closed forms? Sphere and flat punch on a half-space and on a bonded layer, a pressed block, a cantilever.

    python experiments/ipc_validation.py --out runs/ipc_validation              # three meshes each, some minutes on two cores
    python experiments/ipc_validation.py --parts hertz --cells 4,6 --out runs/x # quicker

Writes metrics.json and force_depth.png. ``docs/measurements/contact-solver.md`` says what the figures mean.
"""

from __future__ import annotations

import itertools
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
import tyro

import ipc
from raytac.errors import RaytacError
from raytac.io import VERSIONED, CommonOptions, Metric, result_folder, versions, write_metrics
from tests.ipc.oracles.closed_forms import BondedLayer, Elastic, hertz_force, punch_force
from tests.ipc.oracles.meshes import ball_tool, equal_area, even_block, flat_tool, rim_block
from tests.ipc.oracles.presses import (
    CONTACT,
    DEPTH,
    REACH,
    SOLID,
    SPHERE,
    Pressed,
    cantilever_error,
    growth,
    hertz_error,
    press,
    press_punch,
    press_sphere,
    punch_error,
    richardson,
)

matplotlib.use("Agg")
import matplotlib.pyplot as plt

PARTS = ("hertz", "punch", "layer", "causes", "block", "cantilever")


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Compare the contact solver with closed forms."""

    parts: str = ",".join(PARTS)
    """Names joined by commas."""
    cells: str = "4,6,9"
    """Cells to the contact radius of each mesh, joined by commas: rising, each the same multiple of the one before."""


def convergence(
    name: str, cells: Sequence[int], one: Callable[[int], Pressed], error: Callable[[Pressed], float]
) -> dict[str, Metric]:
    """Press on each mesh; errors, order and the error that is left when the cells go to zero."""
    metrics: dict[str, Metric] = {}
    errors = []
    for n in cells:
        pressed = one(n)
        errors.append(error(pressed))
        print(
            f"{name}: {n} cells to the radius, {pressed.vertices} vertices: {errors[-1]:+.2%} ({pressed.seconds:.0f} s)",
            flush=True,
        )
        metrics |= {f"{name}.{n}.error": errors[-1], f"{name}.{n}.vertices": pressed.vertices}
    if len(cells) == 3:
        order, limit = richardson(errors, cells[1] / cells[0])
        print(f"{name}: order {order:.2f}, limit {limit:+.2%}", flush=True)
        metrics |= {f"{name}.order": order, f"{name}.limit_error": limit}
    return metrics


PAD = 4e-3
"""Thickness of the pad of the ``layer`` part [m]."""
PAD_SOLID = Elastic(1e5, 0.45)
PAD_CONTACT = 1.5e-3
PAD_SPHERE = 50 * PAD_CONTACT


def press_pad(cells: int, tool: str, cut: ipc.Cut, device: str) -> tuple[Pressed, float]:
    """A flat pad of 20 × 20 × 4 mm of cubic cells, ``cells`` to its thickness, bonded below; and the oracle's force at that depth."""
    mesh = ipc.domed_pad((5 * PAD, 5 * PAD), PAD, (np.inf, np.inf), (5 * cells, 5 * cells, cells), cut=cut)
    bonded = ipc.vertices_in_box(mesh, (-1, -1, -PAD), (1, 1, -PAD))
    layer = BondedLayer(PAD_SOLID, PAD)
    rings = 2 * round(cells * PAD_CONTACT / PAD) + 6
    surface = ball_tool(1.5 * PAD_CONTACT, rings, PAD_SPHERE) if tool == "ball" else flat_tool(PAD_CONTACT, max(4, rings // 2))
    depth = layer.sphere(PAD_SPHERE, PAD_CONTACT)[0]
    pressed = press(mesh, bonded, surface, depth, solid=PAD_SOLID, far_force=None, device=device)
    if tool == "ball":
        return pressed, layer.sphere_force(PAD_SPHERE, pressed.depth)
    return pressed, float(layer.punch_force(PAD_CONTACT, pressed.depth))


def pads(device: str) -> dict[str, Metric]:
    """The pad of a sensor against the bonded layer's own solution."""
    metrics: dict[str, Metric] = {}
    cuts: tuple[ipc.Cut, ...] = ("mirrored", "alike")
    for tool, cut, cells in itertools.product(("ball", "punch"), cuts, (4, 8, 12)):
        pressed, exact = press_pad(cells, tool, cut, device)
        error = pressed.force / exact - 1
        print(
            f"layer, {tool}: {cells} layers {cut}, {pressed.vertices} vertices: {error:+.2%} ({pressed.seconds:.0f} s)",
            flush=True,
        )
        metrics |= {f"layer.{tool}.{cut}.{cells}.error": error, f"layer.{tool}.{cells}.vertices": pressed.vertices}
    return metrics


def causes(device: str) -> dict[str, Metric]:
    """One change at a time, at four cells to the radius: where an error of the force comes from."""
    from tests.ipc.oracles.nodal_press import nodal_press

    n = 4
    errors: dict[str, float] = {}

    def note(name: str, value: float) -> None:
        errors[name] = value
        print(f"causes: {name}: {value:+.2%}", flush=True)

    for name, options in {
        "hertz": {},
        "hertz.rigid_at_8": {"far_force": None},
        "hertz.rigid_at_40": {"far_force": None, "reach": 40.0},
        "hertz.far_field_at_16": {"reach": 16.0},
        "hertz.d_hat_half": {"d_hat": 0.005 * CONTACT},
        "hertz.d_hat_double": {"d_hat": 0.02 * CONTACT},
        "hertz.kappa_1": {"kappa": 1.0},
        "hertz.kappa_100": {"kappa": 100.0},
    }.items():
        note(name, hertz_error(press_sphere(n, device=device, **options)))
    mesh, bonded = even_block(CONTACT, n, growth(n), REACH * CONTACT)
    guess = float(hertz_force(SOLID, SPHERE, DEPTH))
    for name, inscribed in (("hertz.tool_as_coarse", False), ("hertz.tool_as_coarse_inscribed", True)):
        tool = ball_tool(1.6 * CONTACT, round(1.6 * n), SPHERE, inscribed)
        note(name, hertz_error(press(mesh, bonded, tool, DEPTH, far_force=guess, device=device)))
    r2, top = (mesh.vertices[:, :2] ** 2).sum(axis=1), np.isclose(mesh.vertices[:, 2], 0)
    limit = np.where(top & (r2 < (2 * CONTACT) ** 2), r2 / (2 * SPHERE) - DEPTH, np.inf)
    note("hertz.no_barrier", nodal_press(mesh, bonded, SOLID, limit) / guess - 1)

    for name, options in {
        "punch": {},
        "punch.rigid_at_40": {"far_force": None, "reach": 40.0},
        "punch.kappa_1": {"kappa": 1.0},
        "punch.d_hat_double": {"d_hat": 0.02 * CONTACT},
    }.items():
        note(name, punch_error(press_punch(n, device=device, **options)))
    around = round(2 * np.pi * n)
    rim, bonded_rim = rim_block(CONTACT, n, growth(n), REACH * CONTACT)
    under = np.isclose(rim.vertices[:, 2], 0) & (np.hypot(*rim.vertices[:, :2].T) < 1.001 * CONTACT * equal_area(around))
    exact = float(punch_force(SOLID, CONTACT, DEPTH))
    note("punch.no_barrier", nodal_press(rim, bonded_rim, SOLID, np.where(under, -DEPTH, np.inf)) / exact - 1)
    # A rim between the rings of an even mesh: the force is that of a wider punch.
    for quarters in (-2, -1, 0, 1, 2):
        radius = CONTACT * (1 + quarters / (4 * n))
        pressed = press(mesh, bonded, flat_tool(radius, n), DEPTH, far_force=exact, device=device)
        where = f"{abs(quarters)}_quarters_{'inside' if quarters < 0 else 'outside'}" if quarters else "on_a_ring"
        note(f"punch.even_mesh_rim_{where}", pressed.force / float(punch_force(SOLID, radius, pressed.depth)) - 1)
    return {f"causes.{name}": value for name, value in errors.items()}


def block_pressure(device: str) -> dict[str, Metric]:
    """Two blocks of different meshes pressed together (ν = 0, so the exact pressure is uniform): spread of the stress inside."""
    seven, six, four = (np.linspace(0, 10e-3, n) for n in (7, 6, 4))
    lower, upper = (ipc.box_mesh(line, line, four) for line in (seven, six))
    material = ipc.Material(SOLID.young, 0.0)
    pose = ipc.Pose((0, 0, 10.1e-3))
    bodies = [
        ipc.SoftBody("lower", lower, material, bonded=ipc.vertices_in_box(lower, (-1, -1, 0), (1, 1, 0))),
        ipc.SoftBody("upper", upper, material, bonded=ipc.vertices_in_box(upper, (-1, -1, 10e-3), (1, 1, 10e-3)), pose=pose),
    ]
    settings = ipc.Settings(dt=1e3, d_hat=0.1e-3, kappa=SOLID.young, velocity_tolerance=1e-12, linear_tolerance=1e-6)
    world = ipc.World(bodies, settings, device=device)
    for k in range(1, 11):
        world.set_target("upper", (0.0, 0.0, 10.1e-3 - k * 0.1e-3))
        world.step()
    pressure = abs(float(world.wrench("lower").force[0, 2])) / 1e-4
    mu, lam = material.coefficients()
    stress = []
    for body, (name, mesh) in enumerate((("lower", lower), ("upper", upper))):
        grads = world.layout.grads[world.layout.tet_start[body] : world.layout.tet_start[body + 1]]
        F = np.einsum("tai,taj->tij", world.positions(name)[0][mesh.tets], grads)
        J = np.linalg.det(F)
        P = mu * F + ((lam * (J - 1) - mu) * J)[:, None, None] * np.linalg.inv(F).transpose(0, 2, 1)
        rest = mesh.vertices[mesh.tets].mean(axis=1)
        middle = (np.abs(rest[:, 2] - 5e-3) < 2e-3) & (np.abs(rest[:, :2] - 5e-3) < 3.4e-3).all(axis=1)
        stress.append(P[middle, 2, 2])
    spread = float(np.abs(-np.concatenate(stress) - pressure).max() / pressure)
    print(f"block: pressure {pressure:.1f} Pa, spread {spread:.2%}", flush=True)
    return {"block.pressure_pa": pressure, "block.stress_spread": spread}


def cantilever(device: str) -> dict[str, Metric]:
    """Sag against cells across the height, each mesh twice as fine."""
    cells = (2, 4, 8, 16)
    errors = [cantilever_error(n, device) for n in cells]
    orders = np.log2(np.abs(np.array(errors[:-1]) / errors[1:]))
    print(f"cantilever: errors {errors} with {cells} cells across, orders {orders}", flush=True)
    metrics: dict[str, Metric] = {f"cantilever.{n}.error": e for n, e in zip(cells, errors, strict=True)}
    return metrics | {"cantilever.order": float(orders[-1])}


def curves(device: str, cells: int = 6) -> tuple[plt.Figure, dict[str, Metric]]:  # type: ignore[name-defined]
    """Force against depth on the middle mesh, beside the closed forms."""
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    metrics: dict[str, Metric] = {}
    line = np.linspace(0, 1.05 * DEPTH, 100)
    for axis, name, exact in (
        (axes[0], "Sphere", lambda depth: hertz_force(SOLID, SPHERE, depth)),
        (axes[1], "Flat punch", lambda depth: punch_force(SOLID, CONTACT, depth)),
    ):
        points = []
        for share in (0.25, 0.5, 0.75, 1.0):
            depth = share * DEPTH
            if name == "Sphere":
                mesh, bonded = even_block(CONTACT, cells, growth(cells), REACH * CONTACT)
                tool = ball_tool(1.6 * CONTACT, round(3.2 * cells), SPHERE)
            else:
                (mesh, bonded), tool = rim_block(CONTACT, cells, growth(cells), REACH * CONTACT), flat_tool(CONTACT, cells)
            points.append(press(mesh, bonded, tool, depth, far_force=float(exact(depth)), device=device))
            metrics[f"curve.{name.split()[-1].lower()}.{share}.error"] = points[-1].error(lambda d, f=exact: float(f(d)))
        axis.plot(line * 1e6, exact(line) * 1e3, "k-", lw=1, label="closed form")
        depths, forces = np.array([(p.depth, p.force) for p in points]).T
        axis.plot(depths * 1e6, forces * 1e3, "o", color="tab:blue", label=f"ipc, {points[0].vertices} vertices")
        axis.set(xlabel="depth, stand-off included [µm]", ylabel="force [mN]", title=name)
        axis.legend(frameon=False)
    return figure, metrics


def main(args: Args) -> None:
    begin = time.perf_counter()
    parts, cells = args.parts.split(","), [int(n) for n in args.cells.split(",")]
    unknown = set(parts) - set(PARTS)
    if unknown:
        raise SystemExit(f"--parts {args.parts}: choose from {', '.join(PARTS)}")
    metrics: dict[str, Metric] = {"young_pa": SOLID.young, "poisson": SOLID.poisson, "contact_radius_m": CONTACT}
    figure: plt.Figure | None = None  # type: ignore[name-defined]
    if "hertz" in parts:
        metrics |= convergence("hertz", cells, lambda n: press_sphere(n, device=args.device), hertz_error)
    if "punch" in parts:
        metrics |= convergence("punch", cells, lambda n: press_punch(n, device=args.device), punch_error)
    if "hertz" in parts and "punch" in parts:
        figure, more = curves(args.device)
        metrics |= more
    for name, part in (("layer", pads), ("causes", causes), ("block", block_pressure), ("cantilever", cantilever)):
        if name in parts:
            metrics |= part(args.device)
    common = {"experiment": "ipc_validation", "device": args.device, "seed": args.seed, **versions((*VERSIONED, "warp-lang"))}
    with result_folder(args.out or Path("runs/ipc_validation"), ("metrics.json", "force_depth.png")) as folder:
        if figure is not None:
            figure.savefig(folder / "force_depth.png", dpi=120)
        write_metrics(folder / "metrics.json", {**common, **metrics, "wall_s": time.perf_counter() - begin})


if __name__ == "__main__":
    try:
        main(tyro.cli(Args))
    except RaytacError as error:
        sys.exit(f"error: {error}")
