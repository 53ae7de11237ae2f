"""Can two sensors lift what they grasp, and hold it for two seconds: a cube, a ball, a soft cube; where friction allows it and where not?

    python experiments/lift.py --out runs/lift

Two sensors are the fingers of a Panda. They close until both press with the force asked for, the arm lifts, and the grasp is held. Slip is
how far the object has moved against the pads, from its place between them when the lift began. A case is OBJECT or OBJECT:MU, with MU the
friction coefficient between object and gel where it is not the gel's own.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from experiments.grasp_control import GraspController, smooth
from experiments.running import recorded, run
from experiments.side_view import draw_strip, film, snapshot
from raytac.errors import InputError, RaytacError
from raytac.io import CommonOptions
from raytac.physics import Ipc
from raytac.specs import TaskScene, load_task
from raytac.world import TactileWorld, WorldState

OBJECT = "object"
SLIPPED = 1e-3
"""An object that moved further against the pads than this [m] is not held."""


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Grasp, lift and hold with two sensors."""

    cases: tuple[str, ...] = ("cube", "sphere", "soft", "cube:0.05", "sphere:0.05")
    """Objects to lift, of cube, sphere and soft (scenes/tasks/lift_*.toml), each with a friction coefficient after a colon if wanted."""
    physics: tuple[str, ...] = ("rigid", "ipc")
    """Pads to do it with; the soft object needs ipc and is left out with rigid."""
    pad: str = "coarse"
    """How finely soft pads are cut."""
    force: float = 4.0
    """That each pad is to press with [N]."""
    height_mm: float = 10.0
    """That the object is lifted by [mm]."""
    hold_s: float = 2.0
    """Time to hold it [s]."""
    gap_mm: float = 1.0
    """Between each pad and the object at the start [mm]."""
    quick: bool = False
    """A small gripper instead of the arm and a tenth of the time: enough to see that all works."""


@dataclass(frozen=True)
class Times:
    """When what begins [s]."""

    lift: float
    hold: float
    end: float


@dataclass
class Record:
    """What one run leaves, by control step; world frame."""

    time: list[float]
    place: list[np.ndarray]
    """Object's middle against the middle between both pads [m]."""
    height: list[float]
    normal: list[np.ndarray]
    """Normal force of both pads [N]."""
    borne: list[float]
    """Upward force of both pads on the object [N]."""
    gap: list[float]
    det: list[float]
    newton: list[int]
    seconds: list[float]


def main(args: Args) -> None:
    if args.quick:
        args = replace(args, height_mm=0.5, gap_mm=0.2)
    runs = [
        (case, physics)
        for case in args.cases
        for physics in args.physics
        if not (physics == "rigid" and kind_of(case)[0] == "soft")
    ]
    with recorded(args, "lift") as (folder, metrics):
        metrics |= {"force_n": args.force, "height_mm": args.height_mm}
        worst: list[dict[str, float]] = []
        for case, physics in runs:
            world, times = make_world(args, case, physics), times_of(args)
            record, pictures = lift(world, args, times)
            found = summary(world, record, times)
            name = f"{case.replace(':', '_mu').replace('.', 'p')}.{physics}"
            metrics |= {f"lift.{name}.{key}": value for key, value in found.items()}
            plot(record, times, folder / f"{name}.png")
            draw_strip(pictures, folder / f"{name}_strip.png")
            film(pictures, folder / f"{name}.gif")
            if ":" not in case and physics == "ipc":
                worst.append(found)
            print(
                f"{name}: held {found['held_s']:.2f} s, slip {found['slip_mm']:.3f} mm ({found['hold_slip_mm']:.4f} mm while held), "
                f"weight seen {found['weight_seen']:.4f} (worst {found['weight_seen_worst']:.4f}), {found['steps_per_s']:.1f} steps/s"
            )
        if worst:
            metrics["lift.slip_mm"] = max(found["slip_mm"] for found in worst)
            metrics["lift.held_s"] = min(found["held_s"] for found in worst)


def kind_of(case: str) -> tuple[str, float | None]:
    """Object and friction coefficient of a case; raises ``InputError``."""
    kind, colon, mu = case.partition(":")
    if kind not in ("cube", "sphere", "soft"):
        raise InputError("cases", value=case, rule="must be OBJECT or OBJECT:MU", choices=("cube", "sphere", "soft"))
    try:
        return kind, float(mu) if colon else None
    except ValueError as error:
        raise InputError("cases", value=case, rule="must have a number after the colon") from error


def times_of(args: Args) -> Times:
    lift = 0.06 if args.quick else 0.6
    hold = lift + (0.06 if args.quick else 0.5)
    return Times(lift, hold, hold + (0.08 if args.quick else args.hold_s))


def make_world(args: Args, case: str, physics: str) -> TactileWorld:
    kind, mu = kind_of(case)
    scene = load_task(f"lift_{kind}")
    bodies = tuple(replace(body, friction=mu) if body.name == OBJECT and mu is not None else body for body in scene.bodies)
    robot = replace(scene.robot, opening=_width(scene) + 2e-3 * args.gap_mm)
    if args.quick:
        middle = scene.body(OBJECT).position
        robot = replace(
            robot, model="floating_gripper", joints=None, position=(*middle[:2], 0.0145), quaternion=(0.0, 1.0, 0.0, 0.0)
        )
    return TactileWorld(
        replace(scene, bodies=bodies, robot=robot),
        physics=Ipc(args.pad) if physics == "ipc" else physics,
        outputs=("wrench",),
        device=args.device,
        seed=args.seed,
    )


def _width(scene: TaskScene) -> float:
    """Of the object between the pads [m]."""
    params = scene.body(OBJECT).params
    return 2.0 * float(params["radius"]) if "radius" in params else float(params["width"])


def lift(world: TactileWorld, args: Args, times: Times) -> tuple[Record, list]:
    """Close, lift, hold; a record of every control step and some pictures from the side."""

    def path(t: float) -> np.ndarray:
        return np.array([0.0, 0.0, 1e-3 * args.height_mm * smooth((t - times.lift) / (times.hold - times.lift))])

    state = world.reset()
    grasp = GraspController(world, path, force=args.force)
    grasp.is_closing = True
    dt = world.control_timestep
    record, pictures = Record([], [], [], [], [], [], [], [], []), []
    steps = round(times.end / dt)
    for step in range(steps):
        began = time.perf_counter()
        grasp.update(state)
        state = world.step(grasp)
        note(record, world, state, time.perf_counter() - began)
        if state.failed[0]:
            raise RaytacError(f"the physics broke down at {state.time[0]:.3f} s")
        if step % max(steps // (5 if args.quick else 24), 1) == 0 or step == steps - 1:
            pictures.append(snapshot(world, [*world.sensor_names, OBJECT], f"{state.time[0]:.2f} s"))
    return record, pictures


def note(record: Record, world: TactileWorld, state: WorldState, seconds: float) -> None:
    pads = [state.world_from_pad[name][0] for name in world.sensor_names]
    wrench = [state.wrench[name][0] for name in world.sensor_names]
    middle = 0.5 * sum(pad[:3, 3] for pad in pads)
    at = world.mesh(OBJECT)[0][0].mean(axis=0)
    record.time.append(float(state.time[0]))
    record.place.append(at - middle)
    record.height.append(float(at[2]))
    record.normal.append(np.array([-w[2] for w in wrench]))
    record.borne.append(-float(sum(pad[2, :3] @ w[:3] for pad, w in zip(pads, wrench, strict=True))))
    record.gap.append(float(state.report["min_gap"][0]) if "min_gap" in state.report else np.inf)
    record.det.append(float(state.report["min_det"][0]) if "min_det" in state.report else 1.0)
    record.newton.append(int(state.report["newton"][0]) if "newton" in state.report else 0)
    record.seconds.append(seconds)


def summary(world: TactileWorld, record: Record, times: Times) -> dict[str, float]:
    """What counts. The weight that is seen is taken over the second half of the hold: its mean, and its worst, the furthest from 1."""
    t, place = np.array(record.time), np.array(record.place)
    before, held = np.searchsorted(t, times.lift - 1e-9), np.searchsorted(t, times.hold - 1e-9)
    away = np.linalg.norm(place - place[before], axis=1)
    lost = np.flatnonzero((away > SLIPPED) & (t > times.lift))
    last = t[lost[0]] if len(lost) else t[-1]
    late = t >= 0.5 * (times.hold + times.end)
    weight = mass_of(world) * -world.model.opt.gravity[2]
    seen = np.array(record.borne)[late] / weight
    found = {
        "slip_mm": 1e3 * float(away[-1]),
        "hold_slip_mm": 1e3 * float(np.linalg.norm(place[-1] - place[held])),
        "held_s": max(float(last - times.hold), 0.0),
        "lifted_mm": 1e3 * (record.height[-1] - record.height[before]),
        "weight_n": weight,
        "weight_seen": float(np.mean(seen)),
        "weight_seen_worst": float(seen[np.argmax(np.abs(seen - 1.0))]),
        "normal_force_n": float(np.mean(np.array(record.normal)[late])),
        "steps": len(t),
        "steps_per_s": 1.0 / float(np.median(record.seconds)),
    }
    if world.physics.is_simulated:
        found |= {
            "min_gap_m": float(np.min(record.gap)),
            "min_det_f": float(np.min(record.det)),
            "newton_max": max(record.newton),
        }
    return found


def mass_of(world: TactileWorld) -> float:
    """Of the object [kg], as its physics has it."""
    body = world.composed.bodies.get(OBJECT)
    if body is not None and body.mocap < 0:
        return float(world.model.body_mass[body.index])
    assert world.soft is not None
    return world.soft.world.rigid_motion(OBJECT).mass


def plot(record: Record, times: Times, path: Path) -> None:
    from matplotlib.figure import Figure

    t, place = np.array(record.time), 1e3 * (np.array(record.place) - record.place[0])
    figure = Figure(figsize=(8, 7), layout="constrained")
    rows = figure.subplots(4, 1, sharex=True)
    rows[0].plot(t, 1e3 * np.array(record.height))
    rows[0].set_ylabel("height of the\nobject [mm]")
    for k, axis in enumerate("xyz"):
        rows[1].plot(t, place[:, k], label=axis)
    rows[1].legend(ncols=3)
    rows[1].set_ylabel("against the\npads [mm]")
    rows[2].plot(t, np.array(record.normal), label=["left", "right"])
    rows[2].legend(ncols=2)
    rows[2].set_ylabel("normal force [N]")
    rows[3].plot(t, record.borne)
    rows[3].set_ylabel("upward force of\nboth pads [N]")
    rows[3].set_xlabel("time [s]")
    for row in rows:
        for moment in (times.lift, times.hold):
            row.axvline(moment, color="0.8", lw=0.8)
    figure.savefig(path, dpi=120)


if __name__ == "__main__":
    run(main, Args)
