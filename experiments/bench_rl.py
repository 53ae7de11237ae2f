"""How many environment steps a second? Push cube, by what is observed; the time split into physics, observation and policy.

    python experiments/bench_rl.py --out runs/bench_rl
    python experiments/bench_rl.py --envs 16 --modes fots,table32 --steps 40
    git worktree add ../raytac_b682ef2 b682ef2; python experiments/bench_rl.py --against ../raytac_b682ef2 --out runs/bench_rl_against
    python experiments/bench_rl.py --envs 4096 --modes none,fots,table32 --device cuda --out runs/bench_rl_warp
    python experiments/bench_rl.py --envs 4096 --modes fots --device cuda --gpus 2 --out runs/bench_rl_two
    python experiments/bench_rl.py --frames --envs 512 --device cuda --out runs/bench_rl_cuda
    python experiments/bench_rl.py --physics ipc --envs 2 --steps 9 --out runs/bench_rl_soft
    python experiments/bench_rl.py --physics ipc --task RollBall --envs 2 --steps 9 --out runs/bench_rl_soft_roll

Modes: ``none`` (no touch), ``fots`` (9 x 11 marker displacements), ``touch`` (these and the wrench), ``table32`` (32 x 32 images of the
Taxim table), ``raytrace64`` (64 x 64 ray-traced images), ``raytrace320`` (320 x 240 of these). The policy is the multilayer perceptron
of stable-baselines3's PPO, 2 x 64, in NumPy, with random weights,
a tenth of whose first two actions is taken and whose third is replaced by what presses the pad onto the cube with about 1 N: a random
policy would hardly touch it, and contact is what costs. Medians over steps; ``pressed`` says in how many environments the pad was touched.

``--against CHECKOUT`` makes control steps with policy of this checkout and of another one in turn, each with its own scene, and compares
processor time, which other work on the machine changes less, and wall time (``turns.py``): ``push.<mode>.speedup_vs_<name>``, ``name``
being the commit, with the extremes of ``--rounds`` rounds, and ``.wall_speedup_vs_<name>``. With ``ball`` among the modes steps of
``experiments/ball_rolling.py`` with the rigid pad take turns too: ``ball_rolling.rigid.speedup_vs_<name>``.

With ``--device cuda`` worlds are those of MuJoCo Warp and all stays on the device, the policy in PyTorch too; keys begin with ``gpu.``
and times are the mean over steps, since nothing waits in between.

With ``--physics ipc`` pads are soft, of ``--task``, and nothing is observed if no mode is named. Keys are ``cpu.push.ipc.<key>`` (``gpu.``
where the solver runs on CUDA; ``roll`` for RollBall), with the mode before the last part if it is not ``none``. Besides the speed they say
what an environment takes in a control step on average: ``solves`` of the contact solver, its ``newton`` iterations and the ``linear``
iterations of their conjugate gradients; and ``asleep``, in which share of the steps it was not solved at all. The pad comes down, and then
holds about 1 N. ``approach.<key>`` is of the first third of as many steps more, until the pad is on the body.

``--frames`` leaves physics out: how many images of ``--size`` a second of ``--envs`` pads that are pressed, each differently? The gel's
heights are on the device when the clock starts; cut, difference to rest and hand-over to PyTorch (DLPack) are in the time, and the image
stays where it is. ``numpy_frames_per_s`` is what the same costs with arrays of the host. Modes: ``table`` and ``raytrace``.
"""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from experiments.push_policy import MODES, Pusher
from experiments.running import recorded, run
from experiments.turns import in_turn
from raytac.checks import check_known, check_whole
from raytac.device import resolve_device
from raytac.envs import PushCubeVectorEnv, RollBallVectorEnv
from raytac.errors import InputError, RaytacError
from raytac.gel import ElasticSurround, GelSurface
from raytac.io import CommonOptions, Metric, parse_names, parse_resolution, read_metrics, versions
from raytac.observe import ObservationSettings, TactileObserver, as_tensors
from raytac.physics import Ipc, SceneSettings
from raytac.report import machine
from raytac.sensor import TactileSensor
from raytac.shapes import object_height, primitive

TASKS = {"PushCube": ("push", PushCubeVectorEnv, 0.03), "RollBall": ("roll", RollBallVectorEnv, 0.3)}
"""Tasks with soft pads: the name in keys, the vector of environments, and the action along z for each newton too many.

A cube's face is so stiff against a pad that more of it would make the pad bounce instead of press."""
TIMED = ("fots", "table32", "raytrace64")
"""Modes that are timed if none is named."""
ENGINES = ("auto", "mujoco", "mujoco_warp")
BALL = "ball"
FRAMES = {"table": "taxim", "raytrace": "raytrace"}
"""Optical mode of each."""


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Time steps of vectors of environments."""

    envs: int = 16
    """Number of environments."""
    physics: str = "rigid"
    """Pads: rigid or ipc."""
    task: str = "PushCube"
    """PushCube or RollBall, the latter with soft pads only."""
    modes: str = ""
    """What is observed, joined by commas; fots, table32 and raytrace64, with ``--frames`` all, with ``--physics ipc`` none, if empty."""
    steps: int = 60
    """Steps, or calls with ``--frames``, that are timed, after a third as many to press the pad on or to record the kernels."""
    frames: bool = False
    """Images a second instead of environment steps."""
    size: str = "320x240"
    """Of these images."""
    sensor: str = "gelsight_mini"
    """That makes them."""
    tolerance: float | None = None
    """With soft pads: longest move of a vertex in a solved step [m]; that of ``SceneSettings`` if not given."""
    linear_tolerance: float | None = None
    """With soft pads: relative residual of the last linear solve of a step."""
    engine: str = "auto"
    """``mujoco``: worlds on the CPU, images on ``--device``; ``mujoco_warp``: all on ``--device``; ``auto``: the latter on CUDA."""
    launches: int | None = None
    """Steps of MuJoCo Warp in a control step, as many as the scene's if not given. Of more a world divides one where something is fast."""
    gpus: int = 1
    """GPUs of this machine with so many environments each, in a process of its own each, with the engine ``mujoco_warp``."""
    against: Path | None = None
    """Checkout of another commit to take turns with."""
    rounds: int = 3
    """Of turns, beside the first, which compiles and is not counted."""
    processes: int = 1
    """With ``--against``: processes of each checkout, which share the environments and step at the same time."""


def main(args: Args) -> dict[str, Metric]:
    """Run all and write ``metrics.json``."""
    check_known("physics", args.physics, ("rigid", "ipc"))
    check_known("task", args.task, tuple(TASKS) if args.physics == "ipc" else ("PushCube",))
    if args.physics == "ipc":
        return soft(args)
    known = tuple(FRAMES) if args.frames else tuple(MODES)
    if args.against is not None:
        return compare(args, parse_names(args.modes or ",".join((*TIMED, BALL)), "modes", (*MODES, BALL)))
    names = parse_names(args.modes or ",".join(FRAMES if args.frames else TIMED), "modes", known)
    device = resolve_device(args.device)
    check_known("engine", args.engine, ENGINES)
    check_whole("gpus", args.gpus)
    on_device = args.engine == "mujoco_warp" or (args.engine == "auto" and device == "cuda" and not args.frames)
    parse_resolution(args.size)
    with recorded(args, "bench_rl", device=device, owned=("metrics.json",), packages=("gymnasium",)) as (_, metrics):
        metrics |= {"envs": args.envs, "steps": args.steps, **machine()}
        for name in names:
            if args.frames:
                where = "gpu" if device == "cuda" else "cpu"
                metrics |= {f"{where}.{name}.{key}": value for key, value in frames(FRAMES[name], args).items()}
                print(f"{name}: {metrics[f'{where}.{name}.frames_per_s']:.0f} frames/s")
            else:
                where, run_mode = ("gpu." if device == "cuda" else "warp.", timed_on_device) if on_device else ("", timed)
                found = timed_on_gpus(name, args) if args.gpus > 1 else run_mode(MODES[name], args)
                metrics |= {f"{where}push.{name}.{key}": value for key, value in found.items()}
                print(f"{name}: {metrics[f'{where}push.{name}.env_steps_per_s']:.0f} environment steps/s", flush=True)
    return metrics


def soft(args: Args) -> dict[str, Metric]:
    """Run all modes with soft pads and write ``metrics.json``."""
    for name, given in (("frames", args.frames), ("against", args.against is not None), ("gpus", args.gpus > 1)):
        if given:
            raise InputError(name, value=getattr(args, name), rule="is for rigid pads, not for --physics ipc")
    check_known("engine", args.engine, ("auto", "mujoco"))
    names, device = parse_names(args.modes or "none", "modes", tuple(MODES)), resolve_device(args.device)
    with recorded(args, "bench_rl", device=device, owned=("metrics.json",), packages=("gymnasium",)) as (_, metrics):
        metrics |= {"envs": args.envs, "steps": args.steps, **machine()}
        for name in names:
            prefix = f"{'gpu' if device == 'cuda' else 'cpu'}.{TASKS[args.task][0]}.ipc"
            mode = prefix if name == "none" else f"{prefix}.{name}"
            metrics |= {f"{mode}.{key}": value for key, value in timed_soft(MODES[name], args).items()}
            print(f"{mode}: {metrics[f'{mode}.env_steps_per_s']:.2f} environment steps/s", flush=True)
    return metrics


def timed_soft(tactile: ObservationSettings | None, args: Args) -> dict[str, Metric]:
    """Keys of one mode with soft pads."""
    given = {name: getattr(args, name) for name in ("tolerance", "linear_tolerance") if getattr(args, name) is not None}
    physics = Ipc(accuracy=SceneSettings(**given))
    env = TASKS[args.task][1](args.envs, physics=physics, tactile=tactile, seed=args.seed, device=args.device)
    env.reset(seed=args.seed)
    rng, actions = np.random.default_rng(args.seed), env.single_action_space.shape[0]  # type: ignore[index]
    gain, rows = TASKS[args.task][2], []
    for _ in range(args.steps // 3 + args.steps):
        before = dict(env.batch.time_s)
        force = -env.batch.world.state().wrench["sensor"][:, 2]
        action = rng.uniform(-0.1, 0.1, (args.envs, actions))
        action[:, 2] = np.where(force > 0.0, np.clip(gain * (force - 1.0), -1.0, 1.0), -0.3)
        began = time.perf_counter()
        env.step(action)
        wall, state = time.perf_counter() - began, env.batch.world.state()
        counts = [float(np.mean(state.report[name])) for name in ("substeps", "newton", "linear")]
        asleep = float(np.mean(np.asarray(state.report["substeps"]) == 0))
        spent = [env.batch.time_s[name] - before[name] for name in ("physics", "observation")]
        rows.append((wall, *counts, asleep, float((force > 0.0).mean()), float(state.failed.mean()), *spent))

    def summary(values: np.ndarray) -> dict[str, Metric]:
        names = ("solves", "newton", "linear", "asleep", "in_contact", "failed")
        found: dict[str, Metric] = dict(zip(names, values[:, 1:7].mean(axis=0).tolist(), strict=True))
        times = dict(zip(("physics_ms", "observation_ms"), (1e3 * values[:, 7:].mean(axis=0)).tolist(), strict=True))
        return {"env_steps_per_s": args.envs * len(values) / float(values[:, 0].sum()), **found, **times}

    table = np.array(rows)
    approach, pressed = (summary(part) for part in np.split(table, [args.steps // 3]))
    return pressed | {f"approach.{key}": value for key, value in approach.items()}


def compare(args: Args, names: Sequence[str]) -> dict[str, Metric]:
    """Make steps of this checkout and of another one in turn and write the ratios of their times."""
    assert args.against is not None
    if args.frames:
        raise InputError("against", value=args.against, rule="is for environment steps, not for --frames")
    if args.device == "cuda":
        raise InputError("device", value=args.device, rule="must be the CPU with --against", choices=("auto", "cpu"))
    check_whole("rounds", args.rounds)
    processes = check_whole("processes", args.processes)
    if args.envs % processes:
        raise InputError("envs", value=args.envs, rule=f"must be a multiple of the {processes} processes that share them")
    if BALL in names and processes > 1:
        raise InputError(
            "modes", value=args.modes, rule="must not have ball with several processes: it is one world", choices=MODES
        )
    scenes = {f"push.{mode}": f"push:{mode}:{args.envs // processes}" for mode in names if mode != BALL}
    scenes |= {"ball_rolling.rigid": "ball:rigid"} if BALL in names else {}
    with recorded(args, "bench_rl", device="cpu", owned=("metrics.json",), packages=("gymnasium",)) as (_, metrics):
        metrics |= {"envs": args.envs, "processes": processes, "rounds": args.rounds, **machine()}
        metrics |= in_turn(args.against, scenes, args.rounds + 1, processes)
    return metrics


def timed(tactile: ObservationSettings | None, args: Args) -> dict[str, Metric]:
    """Keys of one mode."""
    env = PushCubeVectorEnv(args.envs, tactile=tactile, seed=args.seed, device=args.device)
    pusher = Pusher(env, args.seed)
    wall, share, pressed = [], [], []
    for step in range(args.steps // 3 + args.steps):
        begin, before = time.perf_counter(), dict(env.batch.time_s)
        action = pusher.action()
        acted = time.perf_counter()
        pusher.take(action)
        done = time.perf_counter()
        if step < args.steps // 3:
            continue
        spent = {name: value - before[name] for name, value in env.batch.time_s.items()}
        wall.append(done - begin)
        share.append((spent["physics"], spent["observation"], acted - begin))
        pressed.append((pusher.force > 0.0).mean())
    middle = np.median(np.array(share), axis=0)
    found = {f"{name}_ms": 1e3 * float(value) for name, value in zip(("physics", "observation", "policy"), middle, strict=True)}
    return {
        "env_steps_per_s": args.envs / float(np.median(wall)),
        "env_steps_per_s_best": args.envs / float(min(wall)),
        "pressed": float(np.mean(pressed)),
        **found,
    }


def timed_on_device(tactile: ObservationSettings | None, args: Args) -> dict[str, Metric]:
    """Keys of one mode on MuJoCo Warp: all is on the device, from the policy's networks to the next observation."""
    import torch  # pyright: ignore[reportMissingImports]  # gigabytes: the checks run without it

    from raytac.envs import PushCube, WarpBatch

    begin = time.perf_counter()
    batch = WarpBatch(PushCube(), num_envs=args.envs, tactile=tactile, seed=args.seed, device=args.device, launches=args.launches)
    observation = batch.reset(args.seed)
    rng, size = np.random.default_rng(0), sum(values[0].numel() for values in observation.values())
    weights = [
        torch.tensor(rng.normal(0.0, a**-0.5, (a, b)), dtype=torch.float32, device=batch.device)
        for a, b in itertools.pairwise((size, 64, 64, batch.size))
    ]
    pressed, failed = (torch.zeros((), dtype=torch.float64, device=batch.device) for _ in range(2))

    def step() -> None:
        """One step of all environments, with the policy of ``timed``; it presses with about 2 N."""
        nonlocal observation
        action = torch.cat([v.reshape(len(v), -1) / (255 if v.dtype == torch.uint8 else 1) for v in observation.values()], dim=1)
        for weight in weights:
            action = torch.tanh(action @ weight)
        force = -batch.wrench["sensor"][:, 2]
        action[:, :2] *= 0.1
        action[:, 2] = (0.3 * (force - 2.0)).clamp(-1.0, 1.0)
        result = batch.step(action)
        observation = result.observation
        pressed.add_((force > 0.0).double().mean())
        failed.add_(result.failed.sum())

    for _ in range(max(args.steps // 3, 30)):  # until the pads are down
        step()
    batch.check()
    prepared = time.perf_counter() - begin
    pressed.zero_()
    failed.zero_()
    begin = time.perf_counter()
    for _ in range(args.steps):
        step()
    batch.check()  # it waits for the device
    wall = time.perf_counter() - begin
    return {
        "env_steps_per_s": args.envs * args.steps / wall,
        "ms_per_step": 1e3 * wall / args.steps,
        "pressed": float(pressed) / args.steps,
        "failed": int(failed),
        "prepared_s": prepared,
    }


def timed_on_gpus(mode: str, args: Args) -> dict[str, Metric]:
    """Keys of one mode in a process for each GPU, at the same time: the sum of the steps a second, and the least and the most of them."""
    with tempfile.TemporaryDirectory() as out:
        sizes = ["--envs", str(args.envs), "--steps", str(args.steps), "--seed", str(args.seed), "--device", "cuda"]
        sizes += [] if args.launches is None else ["--launches", str(args.launches)]
        running = []
        for k in range(args.gpus):
            command = [sys.executable, __file__, "--modes", mode, *sizes, "--out", str(Path(out, str(k)))]
            own = {**os.environ, "CUDA_VISIBLE_DEVICES": str(k), "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
            running.append(subprocess.Popen(command, env=own, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True))
        for one in running:
            text = one.communicate()[0]
            if one.returncode:
                raise RaytacError(f"{mode} ended with {one.returncode}: {(text.strip() or 'no message').splitlines()[-1]}")
        rows = [read_metrics(Path(out, str(k), "metrics.json")) for k in range(args.gpus)]
    speeds = [float(row[f"gpu.push.{mode}.env_steps_per_s"]) for row in rows]
    pressed = min(float(row[f"gpu.push.{mode}.pressed"]) for row in rows)
    return {"env_steps_per_s": sum(speeds), "least": min(speeds), "most": max(speeds), "pressed": pressed, "gpus": args.gpus}


def frames(optics: str, args: Args) -> dict[str, Metric]:
    """Keys of one optical mode with ``--frames``."""
    from raytac.observe import DeviceImages

    settings = ObservationSettings(("rgb",), resolution=args.size, optics=optics, difference=True)
    observer = TactileObserver(args.sensor, settings, num_envs=args.envs, seed=args.seed)
    sensor = observer.make_sensor(device=args.device)
    images = DeviceImages(observer, sensor)
    surfaces = [pressed_pads(sensor, args.envs, args.seed + k) for k in range(3)]
    inputs = [images.upload(surface) for surface in surfaces]
    pytorch = versions(["torch"]).get("versions.torch", "not installed, so not handed over")
    hand_over = as_tensors if pytorch[0].isdigit() else dict
    spent: dict[str, list[float]] = {"": [], "numpy_": []}
    for step in range(args.steps // 3 + args.steps):
        begin = time.perf_counter()
        hand_over(images.observe(*inputs[step % 3]))
        done = time.perf_counter()
        if step >= args.steps // 3:
            spent[""].append(done - begin)
    for step in range(2 + max(args.steps // 8, 3)):
        begin = time.perf_counter()
        observer.observe(sensor.update(surfaces[step % 3]), sensor)
        if step >= 2:
            spent["numpy_"].append(time.perf_counter() - begin)
    found: dict[str, Metric] = {
        "pads": args.envs,
        "size": args.size,
        "pytorch": pytorch,
        "touched_share": touched_share(surfaces),
    }
    for name, times in spent.items():
        found[f"{name}frames_per_s"] = args.envs / float(np.median(times))
        found[f"{name}call_ms"] = 1e3 * float(np.median(times))
        found[f"{name}call_ms_p90"] = 1e3 * float(np.percentile(times, 90))
    return found


def pressed_pads(sensor: TactileSensor, count: int, seed: int) -> GelSurface:
    """Pads into which balls of 3 to 8 mm and boxes are pressed by 0.2 to 1 mm at random places; the gel as the rigid pad shows it."""
    rng, grid = np.random.default_rng(seed), sensor.grid
    gel, low = ElasticSurround(grid, thickness=sensor.spec.gelpad.thickness), float(grid.rest.min())
    height = np.full((count, *grid.shape), np.inf)
    for b in range(count):
        if b % 2:
            radius = rng.uniform(3e-3, 8e-3)
            part, reach = primitive("sphere", (radius,)), radius
        else:
            half = tuple(rng.uniform(1e-3, 4e-3, 3))
            part, reach = primitive("box", half), half[2]
        pose = np.eye(4)
        angle = rng.uniform(-np.pi, np.pi)
        pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        pose[:2, 3] = rng.uniform(-5e-3, 5e-3, 2)
        pose[2, 3] = reach - rng.uniform(2e-4, 1e-3) + 0.2 * low  # the dome falls away from its middle
        height[b] = object_height([part], pose[None], grid.x, grid.y)[0]
    return gel.surface(height)


def touched_share(surfaces: list[GelSurface]) -> float:
    """Share of the pads that are touched at all."""
    return float(np.mean([surface.contact.any(axis=(1, 2)).mean() for surface in surfaces]))


if __name__ == "__main__":
    run(main, Args, __doc__)
