"""How many environment steps a second does physics alone make on MuJoCo Warp? PushCube, with the pads pressed on the cubes.

    python experiments/bench_gpu.py --worlds 4096 --steps 200 --device cuda --out runs/bench_gpu

Each arm presses its pad onto the cube and drags it along a circle: every world follows the same joint targets by springs in its joints,
with its cube up to 4 mm and 0.2 rad from where the scene has it. An environment step is a control step of 20 ms with ``--substeps`` steps
of MuJoCo, and ``--divided`` more by which a world divides them; on CUDA all of it is one graph. ``pressed`` says in how many of the steps
that are timed a world's pad carried at least 0.1 N, and ``split`` what the parts of a step take.
"""

# pyright: reportInvalidTypeForm=false, reportGeneralTypeIssues=false, reportAssignmentType=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import warp as wp

from experiments.running import recorded, run
from raytac.device import resolve_device
from raytac.errors import InputError
from raytac.io import CommonOptions, Metric
from raytac.report import machine
from raytac.robots import DifferentialIk
from raytac.specs import TaskScene, load_task
from raytac.world import WarpWorld

PRESS, CIRCLE = 20, 150
"""Control steps in which the pad is pressed on, and of one turn."""
DEPTH, RADIUS = 2.9e-3, 0.015
"""Path down from 2 mm above the cube, and radius of the circle [m]."""
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
    """``targets.npy`` of another run, joints (steps, 7), so that no inverse kinematics is needed."""


@wp.kernel
def next_targets(
    table: wp.array2d(dtype=wp.float64),
    press: wp.int32,
    timestep: wp.float64,
    counter: wp.array(dtype=wp.int32),
    # outputs
    target: wp.array2d(dtype=wp.float64),
    speed: wp.array2d(dtype=wp.float64),
):
    """Targets of this control step, from a table (steps + 1, n): those after ``press`` again and again."""
    i, k = wp.tid()
    row = counter[0] + 0
    if row >= press:
        row = press + (row - press) % (table.shape[0] - 1 - press)
    target[i, k] = table[row, k]
    speed[i, k] = (table[row + 1, k] - table[row, k]) / timestep


@wp.kernel
def count_pressed(
    wrenches: wp.array2d(dtype=wp.spatial_vectord),
    least: wp.float64,
    counts: wp.array(dtype=wp.int32),
    counter: wp.array(dtype=wp.int32),
):
    """Add up pads that are pressed, and the control steps."""
    i = wp.tid()
    if -wrenches[i, 0][2] >= least:
        wp.atomic_add(counts, 0, 1)
    if i == 0:
        counter[0] = counter[0] + 1


def main(args: Args) -> dict[str, Metric]:
    """Run it and write ``metrics.json``."""
    for name, least in (("worlds", 1), ("steps", 1), ("substeps", 1), ("divided", 0)):
        if getattr(args, name) < least:
            raise InputError(name, value=getattr(args, name), rule=f"must be {least} or more")
    device, owned = resolve_device(args.device, ray_tracing=False), ("metrics.json", "targets.npy")
    with recorded(args, "bench_gpu", device=device, owned=owned, packages=("mujoco-warp", "warp-lang")) as (folder, metrics):
        metrics |= {"worlds": args.worlds, "steps": args.steps, "substeps": args.substeps, "divided": args.divided, **machine()}
        found = timed(args, folder)
        where = "gpu" if device == "cuda" else "cpu"
        metrics |= {f"{where}.push.physics.{key}": value for key, value in found.items()}
        for key, value in found.items():
            print(f"{key}: {value:.6g}")
    return metrics


def timed(args: Args, folder: Path) -> dict[str, Metric]:
    """Keys of the benchmark; ``folder`` gets the targets."""
    begin = time.perf_counter()
    bench = Bench(args, None if args.targets is None else np.load(args.targets))
    np.save(folder / "targets.npy", bench.table.numpy())
    engine = bench.world.engine
    where = engine.device
    step = engine.capture(bench.control_step)
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
    bench.world.check()
    pressed, memory = int(bench.counts.numpy()[0]), (where.total_memory - where.free_memory) / 1e9 if where.is_cuda else 0.0
    peaks = engine.peaks.numpy().tolist()
    return {
        "env_steps_per_s": args.worlds * args.steps / wall,
        "ms_per_step": 1e3 * wall / args.steps,
        "pressed": pressed / (args.worlds * args.steps),
        "lost": int((~engine.active.numpy()).sum()),
        "finite": int(np.isfinite(engine.data.qpos.numpy()).all()),
        "contacts_per_world": peaks[0] / args.worlds,
        "pairs_per_world": peaks[1] / args.worlds,
        "most_rows": peaks[2],
        "memory_gb": memory,
        "prepared_s": prepared,
        **{f"split.{name}_ms": value for name, value in bench.split(args.steps // 10 + 1).items()},
    }


def scene_of(args: Args) -> TaskScene:
    """The scene with steps of MuJoCo as long as is asked."""
    scene = load_task("push_cube")
    return replace(scene, timestep=scene.control_timestep / args.substeps)


def joint_table(world: WarpWorld) -> np.ndarray:
    """Joints (steps + 1, n) with which the pad is pressed on and goes round."""
    composed, arm = world.composed, world.composed.arm
    assert arm is not None
    ik, qpos = DifferentialIk(arm), composed.start.copy()
    start = world.engine.read_poses()[0][0, 0]
    result = []
    for step in range(PRESS + CIRCLE + 1):
        found = ik.reach(qpos, pose_at(start, step), position_tolerance=1e-6, rotation_tolerance=1e-6)
        if not found.reached:
            raise InputError("pose_at", value=step, rule="must be within the arm's reach")
        qpos[arm.qpos] = found.joints
        result.append(found.joints)
    return np.array(result)


def pose_at(start: np.ndarray, step: int) -> np.ndarray:
    """Pose (4, 4) of the pad at the start of a control step."""
    pose = start.copy()
    pose[2, 3] -= DEPTH * min(step / PRESS, 1.0)
    angle = 2.0 * np.pi * max(step - PRESS, 0) / CIRCLE
    pose[:2, 3] += RADIUS * np.array([np.sin(angle), 1.0 - np.cos(angle)])
    return pose


class Bench:
    """Worlds whose arms follow the table, and what happens in a control step."""

    def __init__(self, args: Args, table: np.ndarray | None = None) -> None:
        launches, count = args.substeps + args.divided, args.worlds
        self.world = WarpWorld(
            scene_of(args), num_envs=count, device=args.device, launches=launches, contacts=args.contacts, rows=args.rows
        )
        composed = self.world.composed
        rng, qpos = np.random.default_rng(args.seed), np.repeat(composed.start[None], count, axis=0)
        first = composed.bodies["cube"].qpos
        turn = 0.5 * rng.uniform(-0.2, 0.2, count)
        qpos[:, first : first + 2] += rng.uniform(-4e-3, 4e-3, (count, 2))
        qpos[:, first + 3], qpos[:, first + 6] = np.cos(turn), np.sin(turn)
        self.world.reset(qpos)
        self.world.engine.update_poses()
        self.substeps, self.timestep = args.substeps, composed.control_timestep
        with wp.ScopedDevice(self.world.engine.device):
            self.table = wp.array(joint_table(self.world) if table is None else table, dtype=wp.float64)
            self.counts, self.counter = wp.zeros(1, dtype=wp.int32), wp.zeros(1, dtype=wp.int32)

    def control_step(self) -> None:
        """One control step of all worlds."""
        world, device = self.world, self.world.engine.device
        tables = [self.table, PRESS, self.timestep, self.counter, world.target, world.target_speed]
        wp.launch(next_targets, dim=world.target.shape, inputs=tables, device=device)
        world.launch()
        pressed = [world.contact.wrenches, LEAST_FORCE, self.counts, self.counter]
        wp.launch(count_pressed, dim=world.engine.num_envs, inputs=pressed, device=device)

    def split(self, steps: int) -> dict[str, float]:
        """Milliseconds of a control step's parts without divided steps, each waited for, so that they add up to more than a step."""
        engine, contact = self.world.engine, self.world.contact

        def find() -> None:
            engine.choose()
            engine.read_frames()
            contact.begin()

        parts: dict[str, Callable[[], None]] = {
            "begin_step": engine.begin_step,
            "drive": self.world.drive,
            "free_acceleration": engine.free_acceleration,
            "find_contacts": find,
            "search": contact.search.launch,  # once more: it is in ``find_contacts``
            "put_contacts": engine.put_contacts,
            "end_step": engine.end_step,
            "read_rows": engine.read_rows,
            "shear": contact.end,
        }
        graphs = {name: engine.capture(part) for name, part in parts.items()}
        spent = dict.fromkeys(parts, 0.0)
        for _ in range(steps * self.substeps):
            for name, part in graphs.items():
                wp.synchronize_device(engine.device)
                begin = time.perf_counter()
                part()
                wp.synchronize_device(engine.device)
                spent[name] += time.perf_counter() - begin
        return {name: 1e3 * value / steps for name, value in spent.items()}


if __name__ == "__main__":
    run(main, Args, __doc__)
