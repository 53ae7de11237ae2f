"""Does the contact solver meet closed forms? Sphere and flat punch on a half-space and on a bonded layer, a pressed block, a cantilever.

    python experiments/ipc_validation.py --out runs/ipc_validation              # three meshes each, some minutes on two cores
    python experiments/ipc_validation.py --parts hertz --cells 4,6 --out runs/x # quicker

Writes metrics.json and force_depth.png. ``docs/ipc.md`` says what the figures mean.
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
from numpy.typing import NDArray

import ipc
from experiments.contact_meshes import ball_tool, equal_area, even_block, flat_tool, rim_block
from experiments.contact_oracles import BondedLayer, Elastic, boussinesq_displacement, hertz_force, punch_force
from raytac.errors import RaytacError
from raytac.io import VERSIONED, CommonOptions, Metric, result_folder, versions, write_metrics

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


SOLID = Elastic(1e5, 0.3)
CONTACT = 1e-3
"""Radius of the contact [m]."""
SPHERE = 50 * CONTACT
"""Of the ball [m]: strains of about 1 %, so that the closed forms of small strain apply."""
DEPTH = CONTACT**2 / SPHERE
REACH = 8.0
"""Radius and height of the block in contact radii."""


@dataclass(frozen=True)
class Pressed:
    """What a press came to: force [N], depth with the stand-off added [m], number of vertices, seconds."""

    force: float
    depth: float
    vertices: int
    seconds: float

    def error(self, exact: Callable[[float], float]) -> float:
        """Relative error of the force against ``exact`` of the depth."""
        return self.force / float(exact(self.depth)) - 1


def press(
    mesh: ipc.TetMesh,
    held: NDArray,
    tool: ipc.TriMesh,
    depth: float,
    *,
    solid: Elastic = SOLID,
    d_hat: float = 0.01 * CONTACT,
    kappa: float = 10.0,
    far_force: float | None = 0.0,
    device: str = "cpu",
) -> Pressed:
    """Press ``tool`` in to about ``depth``, at rest, without friction.

    Args:
        mesh: upper side at z = 0.
        held: bonded vertices.
        tool: its lowest point at z = 0.
        depth: [m], stand-off included.
        solid: the material.
        d_hat: [m].
        kappa: barrier stiffness as a multiple of Young's modulus.
        far_force: a first guess of the force [N]: held vertices carry the displacement that Boussinesq gives for the force, found again
            with the force that came out until that changes by less than 0.1 %. None keeps them at rest.
        device: Warp device.
    """
    begin = time.perf_counter()
    body = ipc.SoftBody("block", mesh, ipc.Material(solid.young, solid.poisson), bonded=held)
    settings = ipc.Settings(
        dt=1e3, d_hat=d_hat, kappa=kappa * solid.young, velocity_tolerance=1e-14, linear_tolerance=1e-4, max_newton=200
    )
    start = ipc.Pose((0.0, 0.0, 1.01 * d_hat))
    world = ipc.World([body, ipc.KinematicBody("tool", tool, start)], settings, device=device)
    force, found = (0.0 if far_force is None else far_force), np.inf
    while True:
        if far_force is not None:
            state = world.save()
            state.y[0, held] = mesh.vertices[held] + boussinesq_displacement(solid, force, mesh.vertices[held])
            world.restore(state)
        world.set_target("tool", (0.0, 0.0, d_hat - depth))
        report = world.step()
        if not report.converged[0]:
            raise ArithmeticError(f"the press did not converge: {report}")
        found = float(world.wrench("tool").force[0, 2])
        if far_force is None or abs(found - force) < 1e-3 * found:
            break
        force = found
    pairs = world.contacts()
    gap = float(pairs.force @ pairs.gap / pairs.force.sum())
    return Pressed(found, depth - d_hat + gap, len(mesh.vertices), time.perf_counter() - begin)


def growth(cells: float) -> float:
    """Growth of cells away from the contact that belongs to a resolution: finer meshes grow more slowly."""
    return 1.25 ** (4 / cells)


def press_sphere(cells: int, reach: float = REACH, **options: float | str | None) -> Pressed:
    """A ball on a half-space, ``cells`` to the contact radius."""
    mesh, held = even_block(CONTACT, cells, growth(cells), reach * CONTACT)
    tool = ball_tool(1.6 * CONTACT, round(3.2 * cells), SPHERE)
    guess = {"far_force": float(hertz_force(SOLID, SPHERE, DEPTH))} | options
    return press(mesh, held, tool, DEPTH, **guess)  # type: ignore[arg-type]


def press_punch(cells: int, reach: float = REACH, **options: float | str | None) -> Pressed:
    """A flat punch on a half-space, ``cells`` to its radius."""
    mesh, held = rim_block(CONTACT, cells, growth(cells), reach * CONTACT)
    guess = {"far_force": float(punch_force(SOLID, CONTACT, DEPTH))} | options
    return press(mesh, held, flat_tool(CONTACT, cells), DEPTH, **guess)  # type: ignore[arg-type]


def hertz_error(pressed: Pressed) -> float:
    """Relative error of a ball's force."""
    return pressed.error(lambda depth: float(hertz_force(SOLID, SPHERE, depth)))


def punch_error(pressed: Pressed) -> float:
    """Relative error of a punch's force."""
    return pressed.error(lambda depth: float(punch_force(SOLID, CONTACT, depth)))


def richardson(errors: Sequence[float], ratio: float) -> tuple[float, float]:
    """Order of convergence and the limit of three values whose meshes are each ``ratio`` times finer."""
    first, second, third = errors
    order = float(np.log((first - second) / (second - third)) / np.log(ratio))
    return order, third - (second - third) / (ratio**order - 1)


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
    held = ipc.vertices_in_box(mesh, (-1, -1, -PAD), (1, 1, -PAD))
    layer = BondedLayer(PAD_SOLID, PAD)
    rings = 2 * round(cells * PAD_CONTACT / PAD) + 6
    surface = ball_tool(1.5 * PAD_CONTACT, rings, PAD_SPHERE) if tool == "ball" else flat_tool(PAD_CONTACT, max(4, rings // 2))
    depth = layer.sphere(PAD_SPHERE, PAD_CONTACT)[0]
    pressed = press(mesh, held, surface, depth, solid=PAD_SOLID, far_force=None, device=device)
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
    from experiments.nodal_press import nodal_press

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
    mesh, held = even_block(CONTACT, n, growth(n), REACH * CONTACT)
    guess = float(hertz_force(SOLID, SPHERE, DEPTH))
    for name, inscribed in (("hertz.tool_as_coarse", False), ("hertz.tool_as_coarse_inscribed", True)):
        tool = ball_tool(1.6 * CONTACT, round(1.6 * n), SPHERE, inscribed)
        note(name, hertz_error(press(mesh, held, tool, DEPTH, far_force=guess, device=device)))
    r2, top = (mesh.vertices[:, :2] ** 2).sum(axis=1), np.isclose(mesh.vertices[:, 2], 0)
    limit = np.where(top & (r2 < (2 * CONTACT) ** 2), r2 / (2 * SPHERE) - DEPTH, np.inf)
    note("hertz.no_barrier", nodal_press(mesh, held, SOLID, limit) / guess - 1)

    for name, options in {
        "punch": {},
        "punch.rigid_at_40": {"far_force": None, "reach": 40.0},
        "punch.kappa_1": {"kappa": 1.0},
        "punch.d_hat_double": {"d_hat": 0.02 * CONTACT},
    }.items():
        note(name, punch_error(press_punch(n, device=device, **options)))
    around = round(2 * np.pi * n)
    rim, held_rim = rim_block(CONTACT, n, growth(n), REACH * CONTACT)
    under = np.isclose(rim.vertices[:, 2], 0) & (np.hypot(*rim.vertices[:, :2].T) < 1.001 * CONTACT * equal_area(around))
    exact = float(punch_force(SOLID, CONTACT, DEPTH))
    note("punch.no_barrier", nodal_press(rim, held_rim, SOLID, np.where(under, -DEPTH, np.inf)) / exact - 1)
    # A rim between the rings of an even mesh: the force is that of a wider punch.
    for quarters in (-2, -1, 0, 1, 2):
        radius = CONTACT * (1 + quarters / (4 * n))
        pressed = press(mesh, held, flat_tool(radius, n), DEPTH, far_force=exact, device=device)
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


def cantilever_error(cells: int, device: str = "cpu") -> float:
    """Relative error of the sag of a clamped beam of length 5 heights under its weight against Timoshenko's, ν = 0."""
    length, height, young, density, g = 0.1, 0.02, 1e6, 1000.0, 0.05
    x, y = np.linspace(0, length, 5 * cells + 1), np.linspace(0, height, cells + 1)
    mesh = ipc.box_mesh(x, y, y)
    clamped = ipc.vertices_in_box(mesh, (0, -1, -1), (0, 1, 1))
    beam = ipc.SoftBody("beam", mesh, ipc.Material(young, 0.0, density), bonded=clamped)
    settings = ipc.Settings(dt=1e3, gravity=(0, 0, -g), velocity_tolerance=1e-12, linear_tolerance=1e-8, max_linear=20000)
    world = ipc.World([beam], settings, device=device)
    if not world.step().converged[0]:
        raise ArithmeticError("the beam did not come to rest")
    end = np.isclose(mesh.vertices[:, 0], length)
    sag = (mesh.vertices[end, 2] - world.positions("beam")[0, end, 2]).mean()
    load, bending, shear = density * g * height**2, young * height**4 / 12, 5 / 6 * young / 2 * height**2
    return float(sag / (load * length**4 / (8 * bending) + load * length**2 / (2 * shear)) - 1)


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
                mesh, held = even_block(CONTACT, cells, growth(cells), REACH * CONTACT)
                tool = ball_tool(1.6 * CONTACT, round(3.2 * cells), SPHERE)
            else:
                (mesh, held), tool = rim_block(CONTACT, cells, growth(cells), REACH * CONTACT), flat_tool(CONTACT, cells)
            points.append(press(mesh, held, tool, depth, far_force=float(exact(depth)), device=device))
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
