"""How far is a ball from its goals when a Panda rolls it under one sensor, with a rigid and with a soft pad, and how fast is that?

    python experiments/ball_rolling.py --out runs/ball_rolling

The arm is moved by differential inverse kinematics and feels where the ball is: the contact's centre and the force are all that steers.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from experiments.rolling_control import PHASES, RollingController, Strokes
from experiments.running import recorded, run
from raytac.errors import RaytacError
from raytac.frame import TactileFrame
from raytac.io import CommonOptions, Metric, parse_resolution
from raytac.optics import Taxim
from raytac.world import TactileWorld


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Roll a ball through goals with one sensor."""

    physics: tuple[str, ...] = ("rigid", "ipc")
    """Pads to do it with, of rigid and ipc."""
    scene: str = "ball_rolling"
    """Task scene with one arm, one sensor and a body named ball."""
    goals_mm: tuple[tuple[float, float], ...] = ((10.0, 0.0), (10.0, 10.0), (-8.0, 10.0), (0.0, 0.0))
    """Places that the ball is rolled to, from where it starts [mm], world x and y."""
    optics: str | None = None
    """How images are made; if not given, by the table without shadows with the rigid pad, by fast ray tracing with the simulated one."""
    resolution: str = "320x240"
    """Of the tactile image [px]."""
    steps: int = 3000
    """Most control steps."""
    picture_every: float = 0.1
    """Time between two pictures of the film [s]."""
    quick: bool = False
    """One short stroke and small images by Phong's model: enough to see that all works."""


@dataclass
class Record:
    """What one run leaves, by control step."""

    time: list[float]
    phase: list[int]
    ball: list[np.ndarray]
    pad: list[np.ndarray]
    wrench: list[np.ndarray]
    markers: list[float]
    """Longest displacement of a marker [m]."""
    pictures: list[np.ndarray]
    pictured: list[int]
    """Control step of each picture."""
    seconds: list[float]
    """Wall time of a control step with image and markers."""
    part: list[tuple[float, float, float]]
    """Of it, control, physics and sensor."""
    resolved: list[tuple[float, float]]
    """Least gap [m] and least det F of a soft pad."""


def main(args: Args) -> None:
    for name in args.physics:
        if name not in OPTICS:
            raise RaytacError(f"--physics {name}: must be one of {', '.join(OPTICS)}")
    if args.quick:
        args = replace(args, goals_mm=((2.0, 1.0),), optics="phong", resolution="64x48", steps=150)
    with recorded(args, "ball_rolling") as (folder, metrics):
        for name in args.physics:
            world = make_world(args, name)
            controller, record = roll(world, args)
            metrics["device"] = world.sensors[world.sensor_names[0]].device_used
            found = summary(world, controller, record, args)
            metrics |= {f"ball_rolling.{name}.{key}": value for key, value in found.items()}
            draw(record, world, args, folder / f"{name}.png")
            film(record, args, folder / f"{name}.gif")
            strip(record, world, folder / f"{name}_strip.png")
            print(
                f"{name}: {found['goals_reached']} of {len(args.goals_mm)} goals, {found['goal_error_mm']:.2f} mm from the last, "
                f"{found['steps_per_s']:.1f} steps/s"
            )


OPTICS = {"rigid": "taxim", "ipc": "raytrace"}
"""How the image is made: by the table with the rigid pad, by fast ray tracing with the simulated one."""
STROKES = {"rigid": Strokes(), "ipc": Strokes(roll_speed=0.015, press_speed=0.005, lift_speed=0.02, travel_speed=0.05)}
"""The soft pad is solved in one go where it moves by 0.1 mm or less against the ball in 10 ms."""
PITCH = 1e-4
"""Spacing of the nodes of the gel's surface [m]: a ball needs no finer ones."""
MARKERS = {"rigid": "fots", "ipc": "surface"}


def make_world(args: Args, physics: str) -> TactileWorld:
    name = OPTICS[physics] if args.optics is None else args.optics
    optics = Taxim(shadows=False) if name == "taxim" else name
    return TactileWorld(
        args.scene,
        physics=physics,
        outputs=("rgb", "wrench"),
        optics=optics,
        markers=MARKERS[physics],
        resolution=parse_resolution(args.resolution),
        device=args.device,
        seed=args.seed,
        pitch=PITCH,
    )


def roll(world: TactileWorld, args: Args) -> tuple[RollingController, Record]:
    """Step the world until the last goal is reached or ``args.steps`` are over; an image and markers are made in every step."""
    (name,) = world.sensor_names
    state = world.reset()
    goals = state.world_from_body["ball"][0, :2, 3] + 1e-3 * np.asarray(args.goals_mm)
    controller = RollingController(world, 0, goals, STROKES[world.physics.label.partition("-")[0]])
    record = Record([], [], [], [], [], [], [], [], [], [], [])
    frame = world.observe()[name]  # kernels are compiled here
    next_picture = 0.0
    for _ in range(args.steps):
        began = time.perf_counter()
        force = max(-float(state.wrench[name][0, 2]), 0.0)
        controller.update(state.world_from_pad[name][0], frame.surface.contact_centre[0], force)
        steered = time.perf_counter()
        state = world.step(controller)
        stepped = time.perf_counter()
        frame = world.observe()[name]
        done = time.perf_counter()
        record.seconds.append(done - began)
        record.part.append((steered - began, stepped - steered, done - stepped))
        record.time.append(float(state.time[0]))
        record.phase.append(PHASES.index(controller.phase))
        record.ball.append(state.world_from_body["ball"][0, :3, 3])
        record.pad.append(state.world_from_pad[name][0])
        record.wrench.append(state.wrench[name][0])
        record.markers.append(float(np.nanmax(np.linalg.norm(frame.markers.displacement[0], axis=-1))))
        if "min_gap" in state.report:
            record.resolved.append((float(state.report["min_gap"][0]), float(state.report["min_det"][0])))
        if record.time[-1] >= next_picture:
            record.pictures.append(picture(frame))
            record.pictured.append(len(record.time) - 1)
            next_picture += args.picture_every
        if state.failed[0]:
            raise RaytacError(f"the physics broke down at {state.time[0]:.3f} s")
        if controller.done:
            break
    return controller, record


LEAST_WIDTH = 320
"""Pictures are enlarged by a whole factor to at least this width [px]."""
ARROW_SCALE = 10.0
"""Length of a drawn line over the marker's displacement."""


def picture(frame: TactileFrame) -> np.ndarray:
    """The image, enlarged, with the markers' displacements over it, ``ARROW_SCALE`` times as long; (H, W, 3) uint8."""
    from PIL import Image, ImageDraw

    height, width = frame.rgb.shape[1:3]
    factor = -(-LEAST_WIDTH // width)
    image = Image.fromarray(frame.rgb[0]).resize((factor * width, factor * height), Image.Resampling.BILINEAR)
    pen = ImageDraw.Draw(image)
    for at, by in zip(factor * frame.markers.rest_px[0], factor * frame.markers.displacement_px[0], strict=True):
        if np.isfinite(by).all() and np.hypot(*by) > 0.05 * factor:
            pen.line([*at, *(at + ARROW_SCALE * by)], fill=(255, 255, 0), width=2)
    return np.asarray(image)


def summary(world: TactileWorld, controller: RollingController, record: Record, args: Args) -> dict[str, Metric]:
    """What counts, from the true place of the ball."""
    ball, pad = np.array(record.ball), np.array(record.pad)
    wrench, phase = np.array(record.wrench), np.array(record.phase)
    assert world.scene is not None
    start = np.array(world.scene.body("ball").position[:2])
    off = ball[:, :2] - pad[:, :2, 3]
    rolling = phase == PHASES.index("roll")
    found: dict[str, Metric] = {
        "goals_reached": controller.goal,
        "goals": len(args.goals_mm),
        "goal_error_mm": 1e3 * float(np.linalg.norm(ball[-1, :2] - start - 1e-3 * np.array(args.goals_mm[-1]))),
        "strokes": controller.strokes_done,
        "simulated_s": record.time[-1],
        "steps_per_s": 1.0 / float(np.median(record.seconds)),
        "steps_per_s_mean": len(record.seconds) / float(np.sum(record.seconds)),
        "control_ms": 1e3 * float(np.median([p[0] for p in record.part])),
        "physics_ms": 1e3 * float(np.median([p[1] for p in record.part])),
        "sensor_ms": 1e3 * float(np.median([p[2] for p in record.part])),
        "force_max_n": float(-wrench[:, 2].min()),
        "marker_max_mm": 1e3 * float(np.max(record.markers)),
    }
    if rolling.any():
        found["ball_off_pad_centre_max_mm"] = 1e3 * float(np.linalg.norm(off[rolling], axis=1).max())
        steps = np.flatnonzero(rolling[1:] & rolling[:-1])
        way = np.linalg.norm(np.diff(ball[:, :2], axis=0)[steps], axis=1).sum()
        pad_way = np.linalg.norm(np.diff(pad[:, :2, 3], axis=0)[steps], axis=1).sum()
        found["ball_over_pad_way"] = float(way / pad_way)
    if record.resolved:
        gap, det = np.array(record.resolved).T
        found |= {"min_gap_m": float(np.nanmin(gap)), "min_det_f": float(np.nanmin(det))}
    return found


def draw(record: Record, world: TactileWorld, args: Args, path: Path) -> None:
    """Way of ball and pad over the table, and force and markers over time."""
    from matplotlib.figure import Figure

    ball, pad, wrench = np.array(record.ball), np.array(record.pad), np.array(record.wrench)
    assert world.scene is not None
    start = np.array(world.scene.body("ball").position[:2])
    figure = Figure(figsize=(10, 4.5), layout="constrained")
    grid = figure.add_gridspec(3, 2)
    above = figure.add_subplot(grid[:, 0])
    above.plot(*(1e3 * (pad[:, :2, 3] - start)).T, color="0.75", lw=0.8, label="pad's middle")
    above.plot(*(1e3 * (ball[:, :2] - start)).T, color="C0", label="ball")
    above.plot(*np.array(args.goals_mm).T, "x", color="C3", ms=9, label="goals")
    above.set(xlabel="x [mm]", ylabel="y [mm]", aspect="equal", title=f"{world.physics.label} pad, from above")
    above.legend(loc="best", fontsize="small")
    rows = (
        ("force on\nthe pad [N]", (wrench[:, :3], ("x", "y", "z"))),
        ("torque on\nthe pad [N mm]", (1e3 * wrench[:, 3:], ("x", "y", "z"))),
        ("longest marker\ndisplacement [mm]", (1e3 * np.array(record.markers)[:, None], ("",))),
    )
    first = None
    for row, (label, (values, names)) in enumerate(rows):
        axes = figure.add_subplot(grid[row, 1], sharex=first)
        first = first or axes
        for column, name in zip(values.T, names, strict=True):
            axes.plot(record.time, column, lw=0.9, label=name or None)
        axes.set_ylabel(label, fontsize="small")
        axes.tick_params(labelbottom=row == len(rows) - 1)
    assert first is not None
    first.legend(
        title="pad frame", ncols=4, fontsize="small", title_fontsize="small", loc="lower right", bbox_to_anchor=(1.0, 1.0)
    )
    figure.axes[-1].set_xlabel("time [s]")
    figure.savefig(path, dpi=120)


def film(record: Record, args: Args, path: Path) -> None:
    """All pictures as an animation, at the speed of life."""
    from PIL import Image

    if record.pictures:
        images = [Image.fromarray(p) for p in record.pictures]
        images[0].save(path, save_all=True, append_images=images[1:], duration=round(1e3 * args.picture_every), loop=0)


def strip(record: Record, world: TactileWorld, path: Path, count: int = 8) -> None:
    """Pictures in which the ball is felt, as far apart as can be, with a scale, the time, the phase and the force."""
    from matplotlib.figure import Figure

    touching = [k for k, step in enumerate(record.pictured) if record.wrench[step][2] < 0.0] or list(range(len(record.pictures)))
    if not touching:
        return
    chosen = [touching[i] for i in np.unique(np.linspace(0, len(touching) - 1, count).round().astype(int))]
    columns = min(4, len(chosen))
    rows = -(-len(chosen) // columns)
    camera = world.sensors[world.sensor_names[0]].spec.camera
    sides = [np.array([0.0, pixels]) - middle for pixels, middle in zip(camera.resolution, camera.principal_point, strict=True)]
    (left, right), (top, bottom) = (
        1e3 * (pitch * side + origin) for pitch, side, origin in zip(camera.pixel_pitch, sides, camera.position[:2], strict=True)
    )
    figure = Figure(figsize=(3.4 * columns + 0.3, 2.7 * rows + 0.5), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    for place in axes.ravel()[len(chosen) :]:
        place.set_axis_off()
    for n, (place, k) in enumerate(zip(axes.ravel(), chosen, strict=False)):
        step = record.pictured[k]
        place.imshow(record.pictures[k], extent=(left, right, bottom, top))
        place.set_title(
            f"{record.time[step]:.2f} s, {PHASES[record.phase[step]]}, $F_z$ = {record.wrench[step][2]:.2f} N", fontsize=10
        )
        place.set_xlabel("x [mm]" if n + columns >= len(chosen) else "")
        place.set_ylabel("y [mm]" if n % columns == 0 else "")
    figure.suptitle(f"{world.physics.label} pad: tactile image, displacements of the markers × {ARROW_SCALE:g}", fontsize=11)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    run(main, Args)
