"""How many environment steps a second does physics alone make on MuJoCo Warp? PushCube, with the pads pressed on the cubes.

    python experiments/bench_gpu.py --worlds 4096 --steps 200 --device cuda --out runs/bench_gpu

Each arm presses its pad onto the cube and drags it along a circle: joint targets are recorded in one environment of C MuJoCo, and every
world follows them by springs in its joints, with its cube up to 4 mm and 0.2 rad from where that of the record started. An environment step
is a control step of 20 ms with ``--substeps`` steps of MuJoCo, and ``--divided`` more by which a world divides them; on CUDA all of it is
one graph. ``pressed`` says in how many of the steps that are timed a world's pad carried at least 0.1 N, and ``split`` what parts of it
take.
"""

# pyright: reportInvalidTypeForm=false, reportGeneralTypeIssues=false, reportAssignmentType=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from experiments.running import recorded, run
from raytac.device import resolve_device
from raytac.errors import InputError
from raytac.io import CommonOptions, Metric
from raytac.report import machine
from raytac.robots.arm_kernels import Springs, joint_springs
from raytac.robots.ik import PoseServo
from raytac.robots.impedance import JointImpedance
from raytac.robots.joint_springs import JointSprings
from raytac.robots.panda import MAX_VELOCITY
from raytac.specs import TaskScene, load_task
from raytac.world.compose import compose
from raytac.world.engine.mjwarp import MujocoWarp
from raytac.world.environment_models import EnvironmentModels
from raytac.world.gel_pairs import GelPairs
from raytac.world.pad_contact import PadIndices, gel_contact
from raytac.world.world import TactileWorld
from raytac.world.world_model import WorldModel
from raytac.world.world_state import BatchController

PRESS, CIRCLE = 20, 150
"""Control steps in which the pad is pressed on, and of one turn."""
DEPTH, RADIUS = 2.9e-3, 0.015
"""Path down from 2 mm above the cube, and radius of the circle [m]."""
FREQUENCY = 30.0
"""Of the springs in the joints [rad/s]."""
_OWNED = "metrics.json", "targets.npz"
LEAST_FORCE = 0.1
"""Of a pad that is pressed [N]."""


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Control steps of worlds in one state of MuJoCo Warp."""

    worlds: int = 512
    """Number of environments."""
    steps: int = 200
    """Control steps that are timed, after those in which the pads are pressed on."""
    substeps: int = 2
    """Steps of MuJoCo in a control step."""
    divided: int = 1
    """Further steps for worlds in which something moves fast near a pad."""
    contacts: int | None = None
    """Memory for contacts of each environment; None is a guess."""
    rows: int | None = None
    """Memory for constraint rows of each environment; None is a guess."""
    targets: Path | None = None
    """``targets.npz`` of another run, so that C MuJoCo need not run before."""


@wp.kernel
def next_targets(
    joints: wp.array2d(dtype=wp.float64),
    speeds: wp.array2d(dtype=wp.float64),
    press: wp.int32,
    counter: wp.array(dtype=wp.int32),
    time: wp.array(dtype=wp.float64),
    # outputs
    springs: Springs,
):
    """Targets of this control step, from tables (steps, n): those after ``press`` again and again."""
    i, k = wp.tid()
    row = counter[0] + 0
    if row >= press:
        row = press + (row - press) % (joints.shape[0] - press)
    springs.target[i, k] = joints[row, k]
    springs.target_speed[i, k] = speeds[row, k]
    springs.start[i] = time[i]


@wp.kernel
def count_pressed(wrenches: wp.array2d(dtype=wp.spatial_vectord), least: wp.float64, counts: wp.array(dtype=wp.int32)):
    """Add up pads that are pressed."""
    i = wp.tid()
    if -wrenches[i, 0][2] >= least:
        wp.atomic_add(counts, 0, 1)


@wp.kernel
def count_step(counter: wp.array(dtype=wp.int32)):
    counter[0] = counter[0] + 1


def main(args: Args) -> dict[str, Metric]:
    """Run it and write ``metrics.json``."""
    for name, least in (("worlds", 1), ("steps", 1), ("substeps", 1), ("divided", 0)):
        if getattr(args, name) < least:
            raise InputError(name, value=getattr(args, name), rule=f"must be {least} or more")
    device = resolve_device(args.device, ray_tracing=False)
    with recorded(args, "bench_gpu", device=device, owned=_OWNED, packages=("mujoco-warp", "warp-lang")) as (folder, metrics):
        metrics |= {"worlds": args.worlds, "steps": args.steps, "substeps": args.substeps, "divided": args.divided, **machine()}
        found = timed(args, device, folder)
        where = "gpu" if device == "cuda" else "cpu"
        metrics |= {f"{where}.push.physics.{key}": value for key, value in found.items()}
        for key, value in found.items():
            print(f"{key}: {value:.6g}")
    return metrics


def timed(args: Args, device: str, folder: Path) -> dict[str, Metric]:
    """Keys of the benchmark; ``folder`` gets the targets."""
    scene = scene_of(args)
    if args.targets is None:
        joints, speeds = record(TactileWorld(scene, outputs=()))
    else:
        stored = np.load(args.targets)
        joints, speeds = stored["joints"], stored["speeds"]
    np.savez(folder / "targets.npz", joints=joints, speeds=speeds)
    begin, where = time.perf_counter(), wp.get_device(device)
    free = where.free_memory if where.is_cuda else 0
    bench = Worlds(compose(scene, "rigid"), args, device, joints, speeds)
    step = bench.engine.capture(bench.control_step)
    for _ in range(PRESS + CIRCLE // 5):
        step()
    wp.synchronize_device(where)
    prepared = time.perf_counter() - begin
    bench.counts.zero_()
    begin = time.perf_counter()
    for _ in range(args.steps):
        step()
    wp.synchronize_device(where)
    wall = time.perf_counter() - begin
    bench.engine.check_overflow()
    pressed = int(bench.counts.numpy()[0])
    memory = (free - where.free_memory) / 1e9 if where.is_cuda else 0.0
    split = bench.split(args.steps // 10 + 1)
    lost = int((~bench.engine.active.numpy()).sum())
    finite = bool(np.isfinite(bench.engine.data.qpos.numpy()).all())
    peaks = bench.engine.peaks.numpy().tolist()
    return {
        "env_steps_per_s": args.worlds * args.steps / wall,
        "ms_per_step": 1e3 * wall / args.steps,
        "pressed": pressed / (args.worlds * args.steps),
        "lost": lost,
        "finite": int(finite),
        "contacts_per_world": peaks[0] / args.worlds,
        "pairs_per_world": peaks[1] / args.worlds,
        "most_rows": peaks[2],
        "memory_gb": memory,
        "prepared_s": prepared,
        **{f"split.{name}_ms": value for name, value in split.items()},
    }


def scene_of(args: Args) -> TaskScene:
    """The scene with steps of MuJoCo as long as is asked."""
    scene = load_task("push_cube")
    return replace(scene, timestep=scene.control_timestep / args.substeps)


def record(world: TactileWorld) -> tuple[np.ndarray, np.ndarray]:
    """Joint targets (steps, n) and their speeds with which the pad is pressed on and goes round."""
    arm, dt = world.arm, world.control_timestep
    assert arm is not None
    servo = PoseServo(arm, max_velocity=np.array(MAX_VELOCITY), posture=world.composed.start[arm.qpos])
    springs = JointImpedance(arm, frequency=FREQUENCY).springs(world.data)
    start = arm.world_from_site(world.data[0])
    follow = Follow(springs)
    joints, speeds = [], []
    for k in range(PRESS + CIRCLE):
        before, after = (pose_at(start, m) for m in (k, k + 1))
        twist = np.concatenate([(after - before)[None, :3, 3] / dt, np.zeros((1, 3))], axis=1)
        target, speed = servo.targets(world.data, before[None], twist, dt)
        joints.append(target[0].copy())
        speeds.append(speed[0].copy())
        springs.aim(target, speed, np.array([data.time for data in world.data]))
        world.step(follow)
    if world.failed.any():
        raise InputError("record", value="failed", rule="must run through in C MuJoCo")
    return np.array(joints), np.array(speeds)


class Follow(BatchController):
    """Springs in the joints of all environments."""

    def __init__(self, springs: JointSprings) -> None:
        self._springs = springs

    def drive(self, datas: Sequence[Any], envs: Sequence[int] | np.ndarray) -> None:
        self._springs.drive(envs)


def pose_at(start: np.ndarray, step: int) -> np.ndarray:
    """Pose (4, 4) of the pad at the start of a control step."""
    pose = start.copy()
    pose[2, 3] -= DEPTH * min(step / PRESS, 1.0)
    angle = 2.0 * np.pi * max(step - PRESS, 0) / CIRCLE
    pose[:2, 3] += RADIUS * np.array([np.sin(angle), 1.0 - np.cos(angle)])
    return pose


class Worlds:
    """Worlds on MuJoCo Warp, and what happens in a control step."""

    def __init__(self, composed: WorldModel, args: Args, device: str, joints: np.ndarray, speeds: np.ndarray) -> None:
        arm, count = composed.arm, args.worlds
        assert arm is not None and arm.motors is not None
        pads = PadIndices.of(composed)
        pairs = GelPairs([spec.gelpad for spec in composed.sensor_specs], pads.carriers, count, device=device).pairs
        models = EnvironmentModels(composed, count)
        self.contact = gel_contact(composed, models, pairs, num_envs=count, device=device)
        self.engine = MujocoWarp(self.contact, pads, models, contacts=args.contacts, rows=args.rows)
        rng, qpos = np.random.default_rng(args.seed), np.repeat(composed.start[None], count, axis=0)
        first = composed.bodies["cube"].qpos
        turn = 0.5 * rng.uniform(-0.2, 0.2, count)
        qpos[:, first : first + 2] += rng.uniform(-4e-3, 4e-3, (count, 2))
        qpos[:, first + 3], qpos[:, first + 6] = np.cos(turn), np.sin(turn)
        start = [qpos, np.repeat(composed.ctrl[None], count, axis=0)]
        self.engine.reset(self.engine.active, *(wp.array(values, dtype=wp.float32, device=device) for values in start))
        self.substeps, self.launches = args.substeps, args.substeps + args.divided
        array = partial(wp.array, device=device)
        n = len(arm)
        known = {name: one for name, one in arm.numbers().items() if name in ("time", "joints", "speed", "bias", "mass")}
        self.reader = self.engine.reader(known)
        self.springs: Any = Springs()
        for name in known:
            setattr(self.springs, name, self.reader.arrays[name])
        for name in ("target", "target_speed", "torque"):
            setattr(self.springs, name, wp.zeros((count, n), dtype=wp.float64, device=device))
        self.springs.start = wp.zeros(count, dtype=wp.float64, device=device)
        self.springs.stiffness, self.springs.damping = FREQUENCY**2, 2.0 * FREQUENCY
        self.motors = array(arm.motors.astype(np.int32), dtype=wp.int32)
        self.joints, self.speeds = array(joints, dtype=wp.float64), array(speeds, dtype=wp.float64)
        self.counts, self.counter = wp.zeros(1, dtype=wp.int32, device=device), wp.zeros(1, dtype=wp.int32, device=device)

    def drive(self) -> None:
        """Torques of the springs in the joints."""
        self.reader.read()
        wp.launch(joint_springs, dim=self.springs.torque.shape, inputs=[self.springs], device=self.engine.device)
        self.engine.write_controls(self.motors, self.springs.torque)

    def control_step(self) -> None:
        """One control step of all worlds."""
        engine, contact, device = self.engine, self.contact, self.engine.device
        count = engine.num_envs
        self.reader.read()
        tables = [self.joints, self.speeds, PRESS, self.counter, self.springs.time]
        wp.launch(next_targets, dim=self.springs.target.shape, inputs=[*tables, self.springs], device=device)
        engine.advance(self.drive, scene_steps=self.substeps, launches=self.launches)
        pressed = [contact.wrenches, LEAST_FORCE, self.counts]
        wp.launch(count_pressed, dim=count, inputs=pressed, device=device)
        wp.launch(count_step, dim=1, inputs=[self.counter], device=device)

    def split(self, steps: int) -> dict[str, float]:
        """Milliseconds of a control step's parts, each waited for, so that they add up to more than a step."""
        engine, contact = self.engine, self.contact

        def find() -> None:
            engine.choose()
            engine.read_frames()
            contact.begin()

        parts: dict[str, Callable[[], None]] = {
            "begin_step": engine.begin_step,
            "drive": self.drive,
            "free_acceleration": engine.free_acceleration,
            "find_contacts": find,
            "put_contacts": engine.put_contacts,
            "end_step": engine.end_step,
            "read_rows": engine.read_rows,
            "shear": contact.end,
        }
        recorded_parts = {name: engine.capture(part) for name, part in parts.items()}
        spent = dict.fromkeys(parts, 0.0)
        for _ in range(steps * self.substeps):
            for name, part in recorded_parts.items():
                wp.synchronize_device(engine.device)
                begin = time.perf_counter()
                part()
                wp.synchronize_device(engine.device)
                spent[name] += time.perf_counter() - begin
        return {name: 1e3 * value / steps for name, value in spent.items()}


if __name__ == "__main__":
    run(main, Args, __doc__)
