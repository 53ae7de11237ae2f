"""Two soft pads grip a soft beam on a plate, twist it, and stretch it until it snaps back: does anything pass through or invert?

    python experiments/twist.py --out runs/twist

The least gap between surfaces and the least det F of any tetrahedron are kept over every state that the solver accepted, in every step.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from experiments.grasp_control import GraspController, smooth
from experiments.running import recorded, run
from experiments.side_view import draw_strip, film, snapshot
from raytac.errors import RaytacError
from raytac.io import CommonOptions, Metric
from raytac.physics import Ipc
from raytac.specs import load_task
from raytac.world import TactileWorld

BEAM = "beam"


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Twist and stretch a soft beam with two soft pads."""

    scene: str = "twist"
    """Task scene with two pads on a floating gripper and a soft body named beam."""
    pad: str = "coarse"
    """How finely the pads are cut."""
    force: float = 5.0
    """That each pad is to press with [N]."""
    twist_deg: float = 120.0
    """That the gripper turns about the beam."""
    stretch_mm: float = 50.0
    """That it then pulls [mm]; the beam must have slipped out by then to snap."""
    rest_s: float = 0.3
    """Time after the pull, in which the beam comes to rest [s]."""
    gap_mm: float = 1.0
    """Between each pad and the beam at the start [mm]."""
    quick: bool = False
    """A few degrees and a millimetre: enough to see that all works."""


@dataclass
class Record:
    """What one run leaves, by control step."""

    time: list[float]
    tip: list[np.ndarray]
    """Middle of the beam's upper end [m]."""
    turn: list[float]
    """Of the upper end about the vertical [rad]."""
    lift: list[float]
    """Of the gripper [m]."""
    yaw: list[float]
    wrench: list[np.ndarray]
    """Of both pads together on the beam: force [N] and torque about the beam's axis [N m], world frame (4,)."""
    normal: list[float]
    gap: list[float]
    det: list[float]
    converged: list[bool]
    newton: list[int]
    substeps: list[int]
    seconds: list[float]


def main(args: Args) -> None:
    if args.quick:
        args = replace(args, twist_deg=5.0, stretch_mm=0.5, rest_s=0.02, force=1.0, gap_mm=0.2)
    with recorded(args, "twist") as (folder, metrics):
        world = make_world(args)
        record, pictures, times = twist(world, args)
        found = summary(record, times)
        metrics |= {f"twist.{key}": value for key, value in found.items()}
        plot(record, times, folder / "twist.png")
        draw_strip(pictures, folder / "twist_strip.png")
        film(pictures, folder / "twist.gif")
    print(
        f"least gap {found['min_gap_m']:.2e} m, least det F {found['min_det_f']:.3f}, longest {found['longest_mm']:.1f} mm, "
        f"twisted by {found['twisted_deg']:.0f} degrees, {'snapped back' if found['snapped'] else 'still held'}"
    )


def make_world(args: Args) -> TactileWorld:
    scene = load_task(args.scene)
    opening = float(scene.body(BEAM).params["width"]) + 2e-3 * args.gap_mm
    scene = replace(scene, robot=replace(scene.robot, opening=opening))
    # One-way: the gripper is a positioner, and what moves it is known.
    return TactileWorld(scene, physics=Ipc(args.pad), coupling="one_way", outputs=("wrench",), device=args.device, seed=args.seed)


def twist(world: TactileWorld, args: Args) -> tuple[Record, list, tuple[float, ...]]:
    """Close, twist, stretch, wait."""
    close = 0.05 if args.quick else 0.35
    twisted = close + max(np.deg2rad(args.twist_deg) / 2.5, 0.05)
    stretched = twisted + max(args.stretch_mm / 60.0, 0.05)
    end = stretched + args.rest_s
    rise, turn = 1e-3 * args.stretch_mm, np.deg2rad(args.twist_deg)

    def path(t: float) -> np.ndarray:
        yaw = turn * smooth((t - close) / (twisted - close))
        return np.array([0.0, 0.0, rise * smooth((t - twisted) / (stretched - twisted)), yaw, 0.0, 0.0])

    state = world.reset()
    grasp = GraspController(world, path, force=args.force)
    grasp.is_closing = True
    record, pictures = Record([], [], [], [], [], [], [], [], [], [], [], [], []), []
    steps = round(end / world.control_timestep)
    ring = world.mesh(BEAM)[0][0]
    top = ring[:, 2] > ring[:, 2].max() - 1e-6
    rest = ring[top, :2] - ring[top, :2].mean(axis=0)
    for step in range(steps):
        began = time.perf_counter()
        grasp.update(state)
        if state.time[0] > twisted:
            grasp.is_closing = False  # the gap is kept from now on: what slips out shall not be followed
        state = world.step(grasp)
        if state.failed[0]:
            raise RaytacError(f"the physics broke down at {state.time[0]:.3f} s")
        upper = world.mesh(BEAM)[0][0][top]
        flat = upper[:, :2] - upper[:, :2].mean(axis=0)
        record.time.append(float(state.time[0]))
        record.tip.append(upper.mean(axis=0))
        record.turn.append(float(np.arctan2((rest[:, 0] * flat[:, 1] - rest[:, 1] * flat[:, 0]).sum(), (rest * flat).sum())))
        way = path(float(state.time[0]))
        record.lift.append(float(way[2]))
        record.yaw.append(float(way[3]))
        record.wrench.append(on_beam(world, state))
        record.normal.append(float(np.mean([-state.wrench[name][0, 2] for name in world.sensor_names])))
        for values, key in (
            (record.gap, "min_gap"),
            (record.det, "min_det"),
            (record.newton, "newton"),
            (record.substeps, "substeps"),
        ):
            values.append(state.report[key][0].item())
        record.converged.append(bool(state.report["converged"][0]))
        record.seconds.append(time.perf_counter() - began)
        if step % max(steps // (5 if args.quick else 30), 1) == 0 or step == steps - 1:
            pictures.append(snapshot(world, [*world.sensor_names, BEAM, "plate"], f"{state.time[0]:.2f} s"))
    return record, pictures, (close, twisted, stretched, end)


def on_beam(world: TactileWorld, state) -> np.ndarray:
    """Force [N] of both pads on the beam and torque about the vertical through its foot [N m], world frame, (4,)."""
    total = np.zeros(4)
    for name in world.sensor_names:
        pad, wrench = state.world_from_pad[name][0], state.wrench[name][0]
        force, torque = pad[:3, :3] @ wrench[:3], pad[:3, :3] @ wrench[3:]
        total -= np.append(force, torque[2] + np.cross(pad[:3, 3], force)[2])
    return total


def summary(record: Record, times: tuple[float, ...]) -> dict[str, Metric]:
    """What counts; gaps and determinants over all steps."""
    height = np.array(record.tip)[:, 2]
    longest = int(height.argmax())
    last = height[-1]
    return {
        "min_gap_m": float(np.min(record.gap)),
        "min_det_f": float(np.min(record.det)),
        "steps": len(record.time),
        "unconverged_steps": int(len(record.converged) - np.sum(record.converged)),
        "longest_mm": 1e3 * float(height[longest] - height[0]),
        "left_mm": 1e3 * float(last - height[0]),
        "twisted_deg": float(np.degrees(np.abs(record.turn).max())),
        "snapped": int(height[longest] - last > 0.5 * (height[longest] - height[0]) and longest < len(height) - 1),
        "pull_n": float(np.array(record.wrench)[:, 2].max()),
        "torque_nm": float(np.abs(np.array(record.wrench)[:, 3]).max()),
        "newton_max": int(max(record.newton)),
        "substeps_max": int(max(record.substeps)),
        "steps_per_s": 1.0 / float(np.median(record.seconds)),
    }


def plot(record: Record, times: tuple[float, ...], path: Path) -> None:
    from matplotlib.figure import Figure

    t = np.array(record.time)
    figure = Figure(figsize=(8, 8), layout="constrained")
    rows = figure.subplots(5, 1, sharex=True)
    rows[0].plot(t, 1e3 * (np.array(record.tip)[:, 2] - record.tip[0][2]), label="end of the beam")
    rows[0].plot(t, 1e3 * np.array(record.lift), "--", label="gripper")
    rows[0].set_ylabel("up [mm]")
    rows[1].plot(t, np.degrees(record.turn), label="end of the beam")
    rows[1].plot(t, np.degrees(record.yaw), "--", label="gripper")
    rows[1].set_ylabel("turned [deg]")
    rows[2].plot(t, np.array(record.wrench)[:, 2], label="pull")
    rows[2].plot(t, record.normal, label="normal force of a pad")
    rows[2].set_ylabel("force [N]")
    rows[3].plot(t, record.det)
    rows[3].set_ylabel("least det F")
    rows[4].semilogy(t, 1e6 * np.array(record.gap))
    rows[4].set_ylabel("least gap [µm]")
    rows[4].set_xlabel("time [s]")
    for row in rows:
        for moment in times[:-1]:
            row.axvline(moment, color="0.8", lw=0.8)
        if row.get_legend_handles_labels()[0]:
            row.legend(fontsize="small")
    figure.savefig(path, dpi=120)


if __name__ == "__main__":
    run(main, Args)
