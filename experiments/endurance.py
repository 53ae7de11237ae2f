"""Does anything wear in ten thousand control steps of picking up, holding and letting go with two soft pads?

    python experiments/endurance.py --out runs/endurance                    # all of it; goes on where an earlier run stopped
    python experiments/endurance.py --out runs/endurance --most-s 540       # as much as fits into nine minutes

Two pads on a floating gripper take a cube from a table, lift it, hold it, put it down and let go, again and again. Every step must keep
surfaces apart and tetrahedra upright, converge, and leave the gel's back where the case is; every cycle must lift the cube by at least half
the height asked for; memory must not grow. After every cycle the state and the record are written, so that the run can be cut at any time.

That the bond holds is true by construction: bonded vertices are no unknowns, so their distance from the case says only that nobody moves
them. What the bond bears is computed another way than what touches the gel, so that both agree at rest is a check.
"""

from __future__ import annotations

import json
import os
import time
from dataclasses import dataclass, fields, replace
from pathlib import Path

import mujoco
import numpy as np

import ipc
from experiments.grasp_control import GraspController, smooth
from experiments.running import run
from raytac.device import resolve_device
from raytac.errors import RaytacError
from raytac.io import CommonOptions, FolderLock, Metric, npz_bytes, versions, write_atomic, write_metrics
from raytac.physics import Ipc, Poses, SceneState
from raytac.specs import load_task
from raytac.world import TactileWorld

OBJECT = "object"
STATE = mujoco.mjtState.mjSTATE_INTEGRATION
"""What of MuJoCo's state the next step depends on."""


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Pick, hold and release until the steps are done."""

    steps: int = 10_000
    """Control steps in all."""
    most_s: float = 0.0
    """Stop after the first cycle that ends later than this [s]; 0: only when the steps are done."""
    pad: str = "coarse"
    """How finely pads are cut."""
    force: float = 4.0
    """That each pad is to press with [N]."""
    height_mm: float = 5.0
    """That the object is lifted by [mm]."""
    gap_mm: float = 2.0
    """Between each open pad and the object [mm]."""
    close_steps: int = 30
    lift_steps: int = 40
    hold_steps: int = 50
    lower_steps: int = 40
    open_steps: int = 40
    """Of one cycle."""
    coupling: str = "two_way"


ROW = (
    "min_gap_m",
    "min_det_f",
    "unconverged",
    "newton_mean",
    "bond_m",
    "bond_share",
    "frame_m",
    "lifted_m",
    "x_m",
    "y_m",
    "speed_s",
    "memory_mb",
    "sitting",
)
"""Of each cycle: least gap and det F; steps without convergence; mean Newton iterations; greatest distance of a bonded vertex from its
place in the case (0 by construction: bonded vertices are no unknowns); greatest difference, at the end of the hold, between the
force on the bond less the gel's weight and the force of what touches the gel, as a share of the latter; greatest distance of the case from
MuJoCo's frame; how far the object was lifted, from the end of closing to the end of the hold; where it lay in the end, from the scene's
start; seconds a step; resident memory; which process ran it, counted from 0."""
PLOTTED = {
    "min_gap_m": ("smallest gap between\nsurfaces [µm]", 1e6),
    "min_det_f": ("smallest volume ratio\nof a tetrahedron", 1.0),
    "newton_mean": ("Newton iterations\na step, mean", 1.0),
    "lifted_m": ("height lifted [mm]", 1e3),
    "drift": ("drift of the object\nsince the first cycle [µm]", 1e6),
    "memory_mb": ("memory [MB]", 1.0),
}


def main(args: Args) -> None:
    out = args.out if args.out is not None else Path("runs") / "endurance"
    with FolderLock(out):
        endure(args, out)


def endure(args: Args, out: Path) -> None:
    """Go on from the state in ``out``, if there is one, until the steps are done."""
    began = time.perf_counter()
    world = make_world(args)
    cycle = args.close_steps + args.lift_steps + args.hold_steps + args.lower_steps + args.open_steps
    rows, done, spent = resume(out, world, args)
    assert world.scene is not None
    first = np.array(world.scene.body(OBJECT).position)
    sitting = round(rows[-1][ROW.index("sitting")]) + 1 if rows else 0
    while done < args.steps:
        rows.append([*one_cycle(world, args, first), sitting])
        done += cycle
        last = dict(zip(ROW, rows[-1], strict=True))
        if not all(np.isfinite(rows[-1])) or not (last["min_gap_m"] > 0.0 and last["min_det_f"] > 0.0):
            raise RaytacError(f"after {done} steps: {last}")
        if last["lifted_m"] < 0.5e-3 * args.height_mm:
            raise RaytacError(
                f"after {done} steps: the object was lifted by {1e3 * last['lifted_m']:.3g} mm of {args.height_mm:g} mm"
            )
        store(out, world, args, rows, done, spent + time.perf_counter() - began)
        print(f"{done}: " + ", ".join(f"{key} {value:.3g}" for key, value in zip(ROW, rows[-1], strict=True)), flush=True)
        if args.most_s and time.perf_counter() - began > args.most_s:
            break
    report(out, args, rows, done, spent + time.perf_counter() - began)


def make_world(args: Args) -> TactileWorld:
    scene = load_task("lift_cube")
    middle, width = scene.body(OBJECT).position, float(scene.body(OBJECT).params["width"])
    place = (middle[0], middle[1], 0.0145)
    robot = replace(
        scene.robot,
        model="floating_gripper",
        joints=None,
        opening=width + 2e-3 * args.gap_mm,
        position=place,
        quaternion=(0.0, 1.0, 0.0, 0.0),
    )
    return TactileWorld(
        replace(scene, robot=robot), physics=Ipc(args.pad), coupling=args.coupling, outputs=("wrench",), device=args.device
    )


def one_cycle(world: TactileWorld, args: Args, first: np.ndarray) -> list[float]:
    """Pick up, hold, put down, let go; the row of it."""
    assert world.soft is not None
    begin, dt = float(world.data[0].time), world.control_timestep
    ends = np.cumsum([args.close_steps, args.lift_steps, args.hold_steps, args.lower_steps, args.open_steps])
    up = (ends[0] * dt, ends[1] * dt, ends[2] * dt, ends[3] * dt)

    def path(t: float) -> np.ndarray:
        t -= begin
        share = smooth((t - up[0]) / (up[1] - up[0])) - smooth((t - up[2]) / (up[3] - up[2]))
        return np.array([0.0, 0.0, 1e-3 * args.height_mm * share, 0.0, 0.0, 0.0])

    grasp = GraspController(world, path, force=args.force)
    state, seen, newton, unconverged, lifted, share = world.state(), [], [], 0, 0.0, 0.0
    bonds = {name: (pad.mesh.bonded, pad.mesh.tets.vertices[pad.mesh.bonded]) for name, pad in world.soft.pads.items()}
    bond = frame = 0.0
    since = time.perf_counter()
    for step in range(int(ends[-1])):
        if step == int(ends[3]):
            grasp.force = 0.0
        grasp.is_closing = step < int(ends[3])
        grasp.update(state)
        state = world.step(grasp)
        if state.failed[0]:
            raise RaytacError(f"the physics broke down at {state.time[0]:.3f} s")
        seen.append((state.report["min_gap"][0], state.report["min_det"][0]))
        newton.append(int(state.report["newton"][0]))
        unconverged += int(not state.report["converged"][0])
        for name, (held, rest) in bonds.items():
            bond = max(bond, float(np.abs(world.soft.world.positions(name, frame="body")[0, held] - rest).max()))
            frame = max(frame, float(np.abs(world.soft.pose(name)[0] - state.world_from_pad[name][0]).max()))
        if step == int(ends[0]) - 1:
            lifted = -float(world.soft.pose(OBJECT)[0, 2, 3])
        if step == int(ends[2]) - 1:
            lifted += float(world.soft.pose(OBJECT)[0, 2, 3])
            share = max(bond_share(world, name) for name in world.soft.pads)
    seconds = (time.perf_counter() - since) / int(ends[-1])
    x, y = (world.soft.pose(OBJECT)[0, :2, 3] - first[:2]).tolist()
    gap, det = np.min(seen, axis=0)
    mean = float(np.mean(newton))
    return [float(gap), float(det), unconverged, mean, bond, share, frame, lifted, x, y, seconds, memory_mb()]


def bond_share(world: TactileWorld, pad: str) -> float:
    """Force on a pad's bond less the gel's weight, against the force of what touches the gel: difference, as a share of the latter."""
    assert world.soft is not None
    touched = world.soft.wrench(pad)[0, :3]
    weight = world.soft.world.rigid_motion(pad).mass * world.model.opt.gravity
    return float(np.linalg.norm(world.soft.bond_wrench(pad)[0, :3] - weight - touched) / np.linalg.norm(touched))


def memory_mb() -> float:
    """Resident memory of this process [MB]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def settings_of(args: Args) -> str:
    kept = {k: v for k, v in vars(args).items() if k not in ("out", "steps", "most_s", "device", "seed")}
    return json.dumps(kept | {"recorded": ROW}, sort_keys=True)


def store(out: Path, world: TactileWorld, args: Args, rows: list[list[float]], done: int, spent: float) -> None:
    """State and record, replaced in one move. Nothing touches a pad at the end of a cycle, so the coupling has no memory to keep."""
    assert world.soft is not None
    values = np.empty(mujoco.mj_stateSize(world.model, STATE))
    mujoco.mj_getState(world.model, world.data[0], values, STATE)
    soft = world.soft.save()
    arrays = {f"solver.{f.name}": getattr(soft.world, f.name) for f in fields(soft.world)}
    arrays |= {f"body.{name}": pose for name, pose in soft.poses.bodies.items()}
    record = {"rows": np.array(rows), "done": np.array(done), "spent": np.array(spent), "settings": np.array(settings_of(args))}
    write_atomic(out / "state.npz", npz_bytes({"mujoco": values, "pads": soft.poses.pads, **record, **arrays}))


def resume(out: Path, world: TactileWorld, args: Args) -> tuple[list[list[float]], int, float]:
    """Rows, steps and seconds of an earlier run whose state is taken over; nothing if there is none."""
    assert world.soft is not None
    path = out / "state.npz"
    if not path.exists():
        return [], 0, 0.0
    with np.load(path, allow_pickle=False) as file:
        if str(file["settings"]) != settings_of(args):
            raise RaytacError(f"{path} is of a run with other settings: {file['settings']}; choose another --out or delete it")
        mujoco.mj_setState(world.model, world.data[0], file["mujoco"], STATE)
        mujoco.mj_forward(world.model, world.data[0])
        solver = ipc.State(**{f.name: file[f"solver.{f.name}"] for f in fields(ipc.State)})
        bodies = {key.removeprefix("body."): file[key] for key in file.files if key.startswith("body.")}
        world.soft.restore(SceneState(solver, Poses(file["pads"], bodies)))
        rows, done, spent = file["rows"].tolist(), int(file["done"]), float(file["spent"])
    print(f"goes on after {done} steps")
    return rows, done, spent


def report(out: Path, args: Args, rows: list[list[float]], done: int, spent: float) -> None:
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    table = np.array(rows)
    column = {key: table[:, k] for k, key in enumerate(ROW)}
    displacement = table[:, [ROW.index("x_m"), ROW.index("y_m")]] - table[0, [ROW.index("x_m"), ROW.index("y_m")]]
    column["drift"] = np.linalg.norm(displacement, axis=1)
    sittings = [column["memory_mb"][column["sitting"] == k] for k in np.unique(column["sitting"])]
    growth = [float(memory[-1] - memory[0]) for memory in sittings]
    metrics: dict[str, Metric] = {
        "experiment": "endurance",
        "device": resolve_device(args.device, ray_tracing=False),
        "seed": args.seed,
        "wall_s": spent,
    }
    metrics |= {
        "endurance.steps": done,
        "endurance.cycles": len(rows),
        "endurance.min_gap_m": float(column["min_gap_m"].min()),
        "endurance.min_det_f": float(column["min_det_f"].min()),
        "endurance.unconverged_steps": int(column["unconverged"].sum()),
        "endurance.bond_m": float(column["bond_m"].max()),
        "endurance.bond_share": float(column["bond_share"].max()),
        "endurance.frame_m": float(column["frame_m"].max()),
        "endurance.lifted_least_mm": 1e3 * float(column["lifted_m"].min()),
        "endurance.drift_mm": 1e3 * float(column["drift"][-1]),
        "endurance.drift_x_mm": 1e3 * float(displacement[-1, 0]),
        "endurance.drift_y_mm": 1e3 * float(displacement[-1, 1]),
        "endurance.ms_per_step": 1e3 * float(np.median(column["speed_s"])),
        "endurance.memory_mb": float(column["memory_mb"][-1]),
        "endurance.memory_growth_mb": growth[-1],
        "endurance.memory_growth_most_mb": max(growth),
    }
    figure = Figure(figsize=(8, 10), layout="constrained")
    for axes, (key, (label, scale)) in zip(figure.subplots(len(PLOTTED), 1, sharex=True), PLOTTED.items(), strict=True):
        axes.plot(np.arange(1, len(rows) + 1), scale * column[key], marker="o", markersize=3)
        axes.set_ylabel(label, fontsize="small")
        axes.ticklabel_format(axis="y", useOffset=False)
    figure.axes[-1].xaxis.set_major_locator(MaxNLocator(integer=True))
    figure.axes[-1].set_xlabel("cycle of picking up, holding and letting go")
    figure.savefig(out / "endurance.png", dpi=110)
    write_metrics(out / "metrics.json", metrics | versions())
    print(
        f"{done} steps, {len(rows)} cycles: least gap {metrics['endurance.min_gap_m']:.2e} m, "
        f"least det F {metrics['endurance.min_det_f']:.3f}, "
        f"bond and contact differ by {metrics['endurance.bond_share']:.1e} of the force, "
        f"the object lies {1e3 * float(metrics['endurance.drift_mm']):.3g} µm from where it lay first, "
        f"memory grew by {growth[-1]:.1f} MB since the first cycle of this process"
    )


if __name__ == "__main__":
    run(main, Args)
