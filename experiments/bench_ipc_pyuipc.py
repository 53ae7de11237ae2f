"""How long do the same press steps take in pyuipc (libuipc's Python package), and does it press as hard?

    python experiments/bench_ipc_pyuipc.py --out runs/bench_ipc_pyuipc                     # needs CUDA and pyuipc 0.0.29
    python experiments/bench_ipc_pyuipc.py --backend none --cases 300,300x3 --out runs/x   # builds the scenes, computes nothing

The scene of ``bench_ipc.py``: same mesh, sphere, drive, time step, d̂, μ and velocity tolerance; small-strain moduli are matched (a
cube is stretched first to see which energy pyuipc uses); its semi-implicit early stop is off; the first step is left out. What differs:

- the base is held by ``is_fixed`` (exact, as here), but the sphere is an affine body on a stiff spring (``SoftTransformConstraint``);
  the metrics tell how far it lags behind;
- the barrier is weighed by no area: ``--kappa`` is a stiffness by pair; its effect is the stand-off and shows in the force;
- friction is renewed once a step, of no memory, and creeps at ε_v; here it is renewed until it settles, with an elastic slip of ε_v dt;
- 128 environments are 128 pads in one scene, ``--spacing`` apart, that share one Newton loop and one linear system.

Each case runs in a process of its own, so that one that crashes costs no other, and all stop when ``--budget-s`` is used up.
"""

# pyuipc is installed by hand, beside a CUDA driver; it is no dependency.
# pyright: reportMissingImports=false

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from bench_ipc import CUT
from bench_ipc_scenes import (
    CELLS,
    D_HAT,
    DT,
    FRICTION,
    GAP,
    HOLD,
    MATERIAL,
    PRESS,
    RADIUS,
    ball_height,
    ball_surface,
    press_pad,
)

import ipc
from ipc.meshes import surface_of
from raytac.errors import InputError, RaytacError
from raytac.io import VERSIONED, CommonOptions, Metric, parse_names, result_folder, versions, write_metrics

ENERGIES = {
    # Ψ = μ/2 (I_C − 3) − μ (J − 1) + λ/2 (J − 1)², or what differs from it by a constant
    "plain": lambda mu, lam: (mu, lam + mu),
    # Smith et al. 2018, eq. 14: with −μ/2 ln(I_C + 1)
    "log": lambda mu, lam: (4 * mu / 3, lam + 5 * mu / 6),
}
"""Coefficients (μ, λ) of a stored energy from the Lamé constants, by energy."""


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Time pyuipc on the solver's press."""

    cases: str = "doctor,cube,1400,5300,128x1400,1024x300,300,1400-mas,5300-mas"
    """Joined by commas: doctor, cube, a size, ENVSxSIZE; -mas at the end takes the multilevel preconditioner for block-Jacobi."""
    backend: Literal["cuda", "none"] = "cuda"
    """pyuipc's backend; none computes nothing and shows that the scenes are made."""
    budget_s: float = 230.0
    """No case starts after this, and one that runs is stopped [s]."""
    velocity_tolerance: float = 1e-4
    """[m/s]."""
    friction_velocity: float = 1e-4
    """ε_v [m/s]; pyuipc's default is 0.01."""
    kappa: float = 1e9
    """Barrier stiffness of a pair of primitives, in pyuipc's units (its examples use 1e9 to 1e10)."""
    strength: float = 1e6
    """Stiffness of the sphere's spring, as a multiple of its mass over h²."""
    spacing: float = 0.04
    """Distance between pads of one scene [m]."""
    energy: Literal["auto", "plain", "log"] = "auto"
    """Stored energy that the moduli are matched for; auto: the one that the cube shows, plain without a cube."""
    only: str = ""
    """Run this one case in this process and print its metrics as JSON (for the script itself)."""


def scene_config(args: Args) -> dict[str, Any]:
    """pyuipc's settings for the press."""
    from uipc import Scene

    config: dict[str, Any] = Scene.default_config()
    config["dt"] = DT
    config["gravity"] = [[0.0], [0.0], [0.0]]
    config["contact"]["d_hat"] = D_HAT
    config["contact"]["eps_velocity"] = args.friction_velocity
    config["newton"]["velocity_tol"] = args.velocity_tolerance
    config["newton"]["semi_implicit"]["enable"] = 0
    config["sanity_check"]["enable"] = 0
    return config


def soft_mesh(vertices: np.ndarray, tets: np.ndarray, energy: str) -> Any:
    """A tetrahedral mesh with the material of the press."""
    from uipc import view
    from uipc.constitution import ElasticModuli, StableNeoHookean
    from uipc.geometry import label_surface, label_triangle_orient, tetmesh

    mesh = tetmesh(np.ascontiguousarray(vertices, np.float64), np.ascontiguousarray(tets, np.int32))
    label_surface(mesh)
    label_triangle_orient(mesh)
    moduli = ElasticModuli.youngs_poisson(MATERIAL.young, MATERIAL.poisson)
    StableNeoHookean().apply_to(mesh, moduli, mass_density=MATERIAL.density)
    for name, value in zip(("mu", "lambda"), ENERGIES[energy](*MATERIAL.lame()), strict=True):
        view(mesh.tetrahedra().find(name))[:] = value
    return mesh


def used_memory_mb() -> float | None:
    """Memory in use on the first GPU [MB]; None if nvidia-smi does not say."""
    try:
        out = subprocess.run(
            ["nvidia-smi", "--query-gpu=memory.used", "--format=csv,noheader,nounits"], capture_output=True, text=True, timeout=20
        )
        return float(out.stdout.split()[0])
    except (OSError, ValueError, IndexError, subprocess.SubprocessError):
        return None


def measure_cube(args: Args) -> dict[str, Metric]:
    """E and ν that a cube shows under a small uniaxial traction, for each guess of the energy.

    The traction's consistent nodal forces deform linear tetrahedra evenly, so stress over strain is exact up to the solver's tolerance
    and the strain itself (0.2 %).
    """
    from uipc import Engine, Scene, World, view
    from uipc.constitution import FiniteElementExternalForce

    side, strain = 10e-3, 2e-3
    line = np.linspace(0, side, 2)
    box = ipc.box_mesh(line, line, line)
    faces = surface_of(box.tets)
    force = np.zeros((8, 3))
    for height, sign in ((0.0, -1.0), (side, 1.0)):
        flat = faces[(np.abs(box.vertices[faces][:, :, 2] - height) < 1e-9).all(axis=1)]
        force[:, 2] += sign * strain * MATERIAL.young * side**2 / 6 * np.bincount(flat.ravel(), minlength=8)
    metrics: dict[str, Metric] = {}
    for energy in ENERGIES:
        config = scene_config(args)
        config["dt"] = 0.1
        config["contact"]["enable"] = 0
        config["newton"]["velocity_tol"] = 1e-8
        config["linear_system"]["tol_rate"] = 1e-8
        with tempfile.TemporaryDirectory() as work:
            engine = Engine(args.backend, work)
            world = World(engine)
            scene = Scene(config)
            mesh = soft_mesh(box.vertices, box.tets, energy)
            FiniteElementExternalForce().apply_to(mesh, np.zeros(3))

            def pull(geometry: Any) -> None:
                view(geometry.vertices().find("external_force"))[:] = force[:, :, None]

            pull(mesh)
            body = scene.objects().create("cube")
            slot, _ = body.geometries().create(mesh)
            scene.animator().insert(body, lambda info: pull(info.geo_slots()[0].geometry()))
            world.init(scene)
            for _ in range(60):
                world.advance()
            world.retrieve()
            x = np.array(slot.geometry().positions().view()).reshape(-1, 3)
        length = [x[box.vertices[:, k] > side / 2, k].mean() - x[box.vertices[:, k] < side / 2, k].mean() for k in range(3)]
        along, across = length[2] / side - 1, (length[0] + length[1]) / (2 * side) - 1
        print(f"  {energy}: strain along {along:.6f}, across {across:.6f} for a stress of {strain * MATERIAL.young:g} Pa")
        if along > 0:
            metrics[f"pyuipc.cube.{energy}.young_pa"] = strain * MATERIAL.young / along
            metrics[f"pyuipc.cube.{energy}.poisson"] = -across / along
    errors = {energy: metrics.get(f"pyuipc.cube.{energy}.young_pa") for energy in ENERGIES}
    known = {energy: abs(float(value) / MATERIAL.young - 1) for energy, value in errors.items() if value is not None}
    if known:
        metrics["pyuipc.cube.energy"] = min(known, key=lambda energy: known[energy])
        print(f"  matched: {metrics['pyuipc.cube.energy']} ({MATERIAL.young:g} Pa, {MATERIAL.poisson:g} were asked for)")
    return metrics


def measure_press(size: int, envs: int, preconditioner: str, args: Args) -> dict[str, Metric]:
    """The press of ``bench_ipc.py``, ``envs`` times side by side in one scene."""
    import uipc
    from uipc import Engine, Scene, World, builtin, view
    from uipc.constitution import AffineBodyConstitution, SoftTransformConstraint
    from uipc.geometry import label_surface, trimesh

    begin, memory = time.perf_counter(), used_memory_mb()
    mesh, base = press_pad(CELLS[size], CUT)
    ball = ball_surface()
    columns = int(np.ceil(np.sqrt(envs)))
    centre = np.zeros((envs, 3))
    centre[:, 0], centre[:, 1] = np.arange(envs) % columns, np.arange(envs) // columns
    centre = (centre - centre.mean(axis=0)) * args.spacing
    count = len(mesh.vertices)

    config = scene_config(args)
    config["linear_system"]["fem_preconditioner"] = preconditioner
    scene = Scene(config)
    tabular = scene.contact_tabular()
    tabular.default_model(FRICTION, args.kappa)
    soft, rigid = tabular.create("soft"), tabular.create("rigid")
    tabular.insert(soft, soft, 0.0, args.kappa, False)  # as in ipc: a pad does not touch itself
    tabular.insert(rigid, rigid, 0.0, args.kappa, False)
    tabular.insert(soft, rigid, FRICTION, args.kappa, True)

    vertices = (mesh.vertices[None] + centre[:, None]).reshape(-1, 3)
    tets = (mesh.tets[None] + count * np.arange(envs)[:, None, None]).reshape(-1, 4)
    energy = "plain" if args.energy == "auto" else args.energy
    pads = soft_mesh(vertices, tets, energy)
    soft.apply_to(pads)
    fixed = (base[None] + count * np.arange(envs)[:, None]).ravel()
    view(pads.vertices().find(builtin.is_fixed))[fixed] = 1
    pad_slot, _ = scene.objects().create("pads").geometries().create(pads)

    balls = trimesh(ball.vertices, ball.faces)
    label_surface(balls)
    AffineBodyConstitution().apply_to(balls, 1e8, mass_density=1000.0)
    SoftTransformConstraint().apply_to(balls, np.array([args.strength, args.strength]))
    rigid.apply_to(balls)
    balls.instances().resize(envs)
    # A resized collection may repeat a default, not what was applied to the first instance.
    view(balls.instances().find("strength_ratio"))[:] = args.strength
    transform = np.tile(np.eye(4), (envs, 1, 1))
    transform[:, :3, 3] = centre
    transform[:, 2, 3] = RADIUS + GAP
    view(balls.transforms())[:] = transform

    def aim(spheres: Any, height: float) -> None:
        transform[:, 2, 3] = height
        view(spheres.instances().find(builtin.is_constrained))[:] = 1
        view(spheres.instances().find(builtin.aim_transform))[:] = transform

    aim(balls, RADIUS + GAP)
    body = scene.objects().create("balls")
    ball_slot, _ = body.geometries().create(balls)
    target = RADIUS + GAP
    scene.animator().insert(body, lambda info: aim(info.geo_slots()[0].geometry(), target))
    with tempfile.TemporaryDirectory() as work:
        engine = Engine(args.backend, work)
        world = World(engine)
        world.init(scene)
        made = time.perf_counter() - begin
        seconds, fetch, stats = [], [], []
        for step in range(PRESS + HOLD):
            target = ball_height(step)
            start = time.perf_counter()
            world.advance()
            world.sync()
            middle = time.perf_counter()
            world.retrieve()
            seconds.append(middle - start)
            fetch.append(time.perf_counter() - middle)
            if not world.is_valid():
                raise RuntimeError(f"pyuipc gave up in step {step + 1}")
            stats.append(engine.frame_stats() or {})
            if step < 3 or step in (PRESS - 1, PRESS + HOLD - 1):
                print(f"  step {step + 1}: {1e3 * seconds[-1]:.1f} ms, statistics {json.dumps(stats[-1])[:1500]}", flush=True)
        after = used_memory_mb()
        x = np.array(pad_slot.geometry().positions().view()).reshape(envs, count, 3) - centre[:, None]
        height = np.array(view(ball_slot.geometry().transforms()))[:, 2, 3]
    lag = target - height
    mass = 1000.0 * abs(np.linalg.det(ball.vertices[ball.faces]).sum() / 6)
    pressed = np.array(seconds[1:PRESS])
    key = f"pyuipc.{size}" + (f"x{envs}" if envs > 1 else "") + ("" if preconditioner == "diag" else f".{preconditioner}")
    metrics: dict[str, Metric] = {
        f"{key}.version": str(getattr(uipc, "__version__", "unknown")),
        f"{key}.energy": energy,
        f"{key}.vertices": count,
        f"{key}.ms_per_step": 1e3 * float(np.median(pressed)),
        f"{key}.env_steps_per_s": float(envs / pressed.mean()),
        f"{key}.ms_per_hold_step": 1e3 * float(np.median(seconds[PRESS:])),
        f"{key}.ms_to_retrieve": 1e3 * float(np.median(fetch[1:])),
        f"{key}.first_step_s": seconds[0],
        f"{key}.world_s": made,
        f"{key}.force_n": float(np.mean(args.strength * mass * -lag / DT**2)),
        f"{key}.ball_lag_um": 1e6 * float(np.abs(lag).max()),
        f"{key}.bond_error_um": 1e6 * float(np.abs(x[:, base] - mesh.vertices[base]).max()),
        f"{key}.deepest_mm": 1e3
        * float(x[:, :, 2].min(axis=1).max() if args.backend == "none" else -x[0, -len(base) :, 2].min()),
    }
    newton = [n for n in (newton_iterations(s) for s in stats) if n is not None]
    if newton:
        metrics[f"{key}.newton_per_step"] = float(np.mean(newton[1:]))
        metrics[f"{key}.newton_most"] = int(max(newton[1:]))
    if memory is not None and after is not None:
        metrics[f"{key}.memory_mb_per_env"] = (after - memory) / envs
    return metrics


def newton_iterations(stats: dict[str, Any]) -> int | None:
    """The count of Newton iterations in pyuipc's statistics of a frame, whose layout is not documented; None if it is not found."""
    for name, value in stats.items():
        if "newton" in name.lower() and isinstance(value, (int, float)) and not isinstance(value, bool):
            return int(value)
        if isinstance(value, dict):
            found = newton_iterations({f"{name}.{k}" if "newton" in name.lower() else k: v for k, v in value.items()})
            if found is not None:
                return found
    return None


def doctor() -> dict[str, Metric]:
    """pyuipc's own look at driver, device and libraries."""
    command = [sys.executable, "-m", "uipc", "doctor", "--probe-cuda"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    print(done.stdout + done.stderr)
    return {"pyuipc.doctor_exit_status": done.returncode}


def parse_case(case: str) -> tuple[int, int, str] | str:
    """``"128x1400-mas"`` to (size, environments, preconditioner); doctor and cube stay names.

    Raises:
        InputError: neither.
    """
    if case in ("doctor", "cube"):
        return case
    what, _, preconditioner = case.partition("-")
    envs, cross, size = what.rpartition("x")
    good = size.isdecimal() and int(size) in CELLS and preconditioner in ("", "mas") and (envs.isdecimal() if cross else not envs)
    if not good or (cross and int(envs) < 1):
        sizes = ", ".join(map(str, CELLS))
        raise InputError("cases", value=case, rule=f"must be doctor, cube, or [ENVSx]SIZE[-mas] with SIZE one of {sizes}")
    return int(size), int(envs or 1), preconditioner or "diag"


def measure(case: str, args: Args) -> dict[str, Metric]:
    """One case, in this process."""
    parsed = parse_case(case)
    if parsed == "doctor":
        return doctor()
    from uipc import Logger

    Logger.set_level(Logger.Level.Warn)
    if isinstance(parsed, str):
        return measure_cube(args)
    return measure_press(*parsed, args)


def run_apart(case: str, args: Args, energy: str, seconds: float) -> dict[str, Metric]:
    """One case in a process of its own; what it prints is passed on."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "metrics.json"
        options = {
            "--backend": args.backend,
            "--velocity-tolerance": args.velocity_tolerance,
            "--friction-velocity": args.friction_velocity,
            "--kappa": args.kappa,
            "--strength": args.strength,
            "--spacing": args.spacing,
            "--energy": energy,
            "--only": case,
            "--out": out,
        }
        command = [sys.executable, __file__, *(str(word) for pair in options.items() for word in pair)]
        # The driver compiles PTX for cards that the wheel has no code for; the default cache may be too small for it.
        env = {"CUDA_CACHE_MAXSIZE": str(4 << 30), "PYTHONUNBUFFERED": "1", **os.environ}
        done = subprocess.run(command, env=env, timeout=seconds)
        if done.returncode:
            raise RuntimeError(f"the process of case {case} ended with status {done.returncode}")
        return json.loads(out.read_text())


def main(args: Args) -> int:
    begin = time.perf_counter()
    if args.only:
        assert args.out is not None
        try:
            args.out.write_text(json.dumps(measure(args.only, args)))
        except Exception as error:
            # pyuipc puts a trace of its native stack into the message.
            line = traceback.extract_tb(error.__traceback__)[-1].lineno
            print(f"  {type(error).__name__} at line {line}: {str(error)[:600]}", flush=True)
            return 1
        return 0
    cases = parse_names(args.cases, "cases")
    for case in cases:
        parse_case(case)
    metrics: dict[str, Metric] = {}
    energy = args.energy
    for case in cases:
        left = args.budget_s - (time.perf_counter() - begin)
        print(f"{case}: {left:.0f} s left", flush=True)
        if left < 5:
            metrics[f"pyuipc.skipped.{case}"] = "no time left"
            continue
        start = time.perf_counter()
        try:
            found = run_apart(case, args, energy, left)
        except Exception as error:  # whatever goes wrong in one case, the others count
            print(f"  failed: {error}", flush=True)
            metrics[f"pyuipc.failed.{case}"] = f"{type(error).__name__}: {error}"
            continue
        metrics |= found
        if args.energy == "auto" and "pyuipc.cube.energy" in found:
            energy = str(found["pyuipc.cube.energy"])
        for name, value in found.items():
            print(f"  {name} = {value}")
        print(f"  took {time.perf_counter() - start:.1f} s", flush=True)
    settings = {
        "pyuipc.backend": args.backend,
        "pyuipc.kappa": args.kappa,
        "pyuipc.velocity_tolerance": args.velocity_tolerance,
        "pyuipc.friction_velocity": args.friction_velocity,
    }
    common = {"experiment": "bench_ipc_pyuipc", "device": "cuda" if args.backend == "cuda" else "cpu", "seed": args.seed}
    with result_folder(args.out or Path("runs/bench_ipc_pyuipc"), ("metrics.json",)) as folder:
        write_metrics(
            folder / "metrics.json",
            {**common, **versions((*VERSIONED, "pyuipc")), **settings, **metrics, "wall_s": time.perf_counter() - begin},
        )
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main(tyro.cli(Args)))
    except RaytacError as error:
        sys.exit(f"error: {error}")
