"""Train a policy by PPO alone, without demonstrations or a teacher: rsl_rl's PPO over raytac's environments, the whole recipe in this file.

    python experiments/train_gpu.py --task PushCube --seeds 0,1,2 --touch wrench,none --processes 16
    python experiments/train_gpu.py --task RollBall --minutes 5 --device cpu
    python experiments/train_gpu.py --task PushCube --touch markers+wrench --worlds mujoco_warp --num-envs 4096 --device cuda

The critic is asymmetric: in training it is given the body's pose and velocity and the wrenches of all sensors, whatever the policy is
given. The policy never is. Each pair of touch and seed is one training in ``<out>/<touch>/seed<k>/``: ``progress.csv`` (one row some
iterations), ``evaluation.csv`` (held-out episodes of the deterministic policy), ``checkpoint.pt``, ``policy.pt`` and ``metrics.json``;
TensorBoard's events too, where it is installed. The same command again goes on from the checkpoint, after Ctrl-C, a crash or ``--minutes``.
``<out>/metrics.json`` has the trainings of all seeds: ``<device>.<task>.success`` is that of the worst, ``<device>.<task>.minutes`` and
``<device>.train.env_steps_per_s`` (the median over iterations, each a rollout and an update) are those of the slowest.

Worlds are stepped on the CPU, in ``--processes`` processes, or with ``--worlds mujoco_warp`` on ``--device``, where the networks are.
"""

# pyright: reportMissingImports=false
# (rsl_rl and PyTorch belong to the extra "rl", which the tests do without.)

from __future__ import annotations

import contextlib
import io
import multiprocessing
import sys
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

import raytac.envs
from experiments.running import run
from experiments.training import HELD_OUT, PHYSICS, Evaluation, append_row, keep_rows, parse_seeds, segment_seed
from raytac.checks import check_known, check_names, check_number, check_whole
from raytac.errors import InputError
from raytac.io import (
    VERSIONED,
    CommonOptions,
    FolderLock,
    Metric,
    parse_names,
    read_metrics,
    versions,
    write_atomic,
    write_metrics,
)
from raytac.observe import MODALITIES
from raytac.report import machine

if multiprocessing.parent_process() is None:  # processes of environments import this file too, and need none of these
    import torch
    from rsl_rl.algorithms import PPO
    from rsl_rl.models import MLPModel
    from rsl_rl.storage import RolloutStorage

    from raytac.envs import RslVecEnv, RslWarpEnv

WORLDS = ("mujoco", "mujoco_warp")
HISTORY = {"BalancePole": 3, "RollBall": 3}
"""Last observations that the policy is given, where it is more than one: what is known by touch alone shows in how it changes."""
STEPS = {
    "PushCube": 1_000_000, "BalancePole": 4_000_000, "LiftCube": 6_000_000, "RollBall": 2_000_000, "InsertPeg": 20_000_000,
    "OpenDrawer": 20_000_000,
}  # fmt: skip
"""Environment steps of a training by task; those of the last two are a guess."""


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Train a task by PPO alone; ``seed`` is not used, see ``seeds``."""

    task: str = "PushCube"
    """One of PushCube, BalancePole, LiftCube, RollBall, InsertPeg, OpenDrawer."""
    physics: str = "rigid"
    """Pads: ``rigid``, or with ``worlds="mujoco"`` ``ipc``, soft ones that ``device`` solves."""
    touch: str = "wrench"
    """What is felt, joined by commas, each trained with the same seeds: ``none``, ``task`` (as the environment has it), or modalities
    joined by ``+``, as in ``markers+wrench``. The first is that of the headline in ``metrics.json``."""
    seeds: str = "0"
    """Seeds joined by commas."""
    steps: int | None = None
    """Environment steps of each training; the task's own if not given."""
    minutes: float | None = None
    """End each training after so many minutes, those before a resume not counted, if it is not done; the same command goes on."""
    target: float | None = None
    """Success on held-out episodes at which a training is done before its steps are."""
    num_envs: int = 512
    """Environments of each training."""
    worlds: str = "mujoco"
    """``mujoco``: on the CPU; ``mujoco_warp``: all environments on ``device``, without processes."""
    launches: int | None = None
    """Steps of MuJoCo Warp in a control step, as many as the scene's if not given. Of more a world divides one where something is fast."""
    processes: int = 0
    """Processes that these are spread over, one core each; 0: this process."""
    threads: int = 1
    """Threads of the networks on the CPU."""
    history: int | None = None
    """Last observations that the policy is given; the task's own if not given."""
    episodes: int = 256
    """Held-out episodes of the last evaluation, and of those on the way as many as there are environments at most."""
    evaluate_every: int = 500_000
    """Environment steps between evaluations."""

    rollout: int = 24
    """Steps of each environment between two updates."""
    epochs: int = 5
    minibatches: int = 4
    learning_rate: float = 1e-3
    """At the start; it follows ``desired_kl``."""
    desired_kl: float = 0.01
    """Divergence of an update that the learning rate is raised or lowered for."""
    gamma: float = 0.98
    gae_lambda: float = 0.95
    clip: float = 0.2
    entropy: float = 0.005
    """Weight of the entropy."""
    deviation: float = 1.0
    """Initial standard deviation of an action, whose range is −1 to 1."""
    deviation_floor: float = 0.2
    """Least standard deviation: exploration does not die before the goal is seen."""
    hidden: int = 128
    """Width of the two layers of policy and critic."""

    def __post_init__(self) -> None:
        check_known("task", self.task, tuple(STEPS))
        for name in ("num_envs", "threads", "episodes", "evaluate_every", "rollout", "epochs", "minibatches", "hidden"):
            check_whole(name, getattr(self, name))
        check_whole("processes", self.processes, 0)
        check_known("worlds", self.worlds, WORLDS)
        check_known("physics", self.physics, PHYSICS if self.worlds == "mujoco" else ("rigid",))
        above, unit = dict.fromkeys(("learning_rate", "desired_kl", "clip", "deviation", "deviation_floor"), "(0, inf)"), "[0, 1]"
        for name, interval in {**above, "gamma": unit, "gae_lambda": unit, "entropy": "[0, inf)"}.items():
            check_number(name, getattr(self, name), interval)
        for name in ("history", "steps"):
            if getattr(self, name) is not None:
                check_whole(name, getattr(self, name))
        for touch in parse_names(self.touch, "touch"):
            if touch not in ("none", "task"):
                check_names("touch", touch.split("+"), MODALITIES)
        for name, interval in {"minutes": "(0, inf)", "target": "[0, 1]"}.items():
            if getattr(self, name) is not None:
                check_number(name, getattr(self, name), interval)


class Training:
    """One training in a folder: environments, networks, PPO."""

    def __init__(self, args: Args, touch: str, seed: int, folder: Path) -> None:
        """Begin, or go on from the folder's checkpoint. Raises ``InputError`` for a checkpoint of other settings."""
        self.args, self.touch, self.seed, self.folder = args, touch, seed, folder
        self._start = time.perf_counter()
        self.device = "cuda" if args.device == "auto" and torch.cuda.is_available() else args.device.replace("auto", "cpu")
        self.settings = _settings(args, touch, seed)
        saved = _checkpoint(folder, self.settings, self.device)  # before any process is started
        self.steps, self.iteration = (0, 0) if saved is None else (saved["steps"], saved["iteration"])
        tactile: Any = {"none": None, "task": "task"}.get(touch, tuple(touch.split("+")))
        kind: Any = getattr(raytac.envs, f"{args.task}VectorEnv")
        common: Any = {
            "num_envs": args.num_envs, "device": self.device, "seed": segment_seed(seed, 0), "history": self.settings["history"],
            "tactile": tactile,
        }  # fmt: skip
        if args.worlds == "mujoco":
            self.env: RslVecEnv | RslWarpEnv = RslVecEnv(kind, processes=args.processes, physics=args.physics, **common)
        else:
            self.env = RslWarpEnv(kind, launches=args.launches, **common)
        # As Isaac Lab's: a reward is a rate, so that its sum over an episode is of the size of 1 to 100.
        self.env.reward_scale = self.env.control_timestep
        torch.manual_seed(seed)
        observation, groups = self.env.reset(), {"actor": ["actor"], "critic": ["critic"]}
        network = {"hidden_dims": [args.hidden, args.hidden], "activation": "elu", "obs_normalization": True}
        gaussian = {
            "class_name": "GaussianDistribution", "init_std": args.deviation, "std_type": "log",
            "std_range": (args.deviation_floor, 2.0),
        }  # fmt: skip
        actor = MLPModel(observation, groups, "actor", self.env.num_actions, distribution_cfg=gaussian, **network)
        critic = MLPModel(observation, groups, "critic", 1, **network)
        storage = RolloutStorage("rl", args.num_envs, args.rollout, observation, [self.env.num_actions], self.device)
        self.ppo = PPO(
            actor, critic, storage,
            num_learning_epochs=args.epochs, num_mini_batches=args.minibatches, clip_param=args.clip, gamma=args.gamma,
            lam=args.gae_lambda, entropy_coef=args.entropy, learning_rate=args.learning_rate, schedule="adaptive",
            desired_kl=args.desired_kl, device=self.device,
        )  # fmt: skip
        self.ppo.train_mode()
        if saved is not None:
            self._start -= saved["wall_s"]
            self.ppo.load(saved, None, True)
            for name in ("progress.csv", "evaluation.csv"):
                keep_rows(folder / name, self.steps)
        self._writer: Any = None
        with contextlib.suppress(ImportError):  # not installed: the CSV files hold all that it would show
            from torch.utils.tensorboard import SummaryWriter

            self._writer = SummaryWriter(str(folder))
        self._begin_episodes()

    def _begin_episodes(self) -> None:
        """Start all environments at random ages, so that they do not end together; seeds follow from the run's and the iteration."""
        torch.manual_seed(segment_seed(self.seed, self.iteration))
        self.observation = self.env.reset(segment_seed(self.seed, self.iteration))
        ages = np.random.default_rng([self.seed, self.iteration]).integers(0, self.env.max_episode_length, self.env.num_envs)
        self.env.episode_length_buf = torch.from_numpy(ages)

    def iterate(self) -> dict[str, float]:
        """One rollout and one update; returns what to log."""
        start, count = time.perf_counter(), self.args.rollout
        sums: dict[str, torch.Tensor] = {}  # on the device: nothing waits within a rollout
        with torch.inference_mode():
            for _ in range(count):
                observation, rewards, dones, extras = self.env.step(self.ppo.act(self.observation))
                self.ppo.process_env_step(observation, rewards, dones, extras)
                self.observation = observation
                now = {
                    "reward": rewards.mean(), "ended": dones.sum(), "succeeded": (extras["success"] * dones).sum(),
                    "failed": extras["failed"].sum(), "succeeding": extras["success"].mean(), **extras["log"],
                }  # fmt: skip
                sums = {name: value + sums.get(name, 0.0) for name, value in now.items()}
            self.ppo.compute_returns(self.observation)
        totals = {name: float(value) for name, value in sums.items()}  # this waits
        ended, succeeded, failed = (totals[name] for name in ("ended", "succeeded", "failed"))
        collected = time.perf_counter()
        losses = self.ppo.update()
        done = time.perf_counter()
        self.steps, self.iteration = self.steps + count * self.env.num_envs, self.iteration + 1
        return {
            "steps": self.steps, "wall_s": round(self.wall_s, 2), "reward": totals["reward"] / count, "ended": ended,
            "success": succeeded / ended if ended else 0.0, "succeeding": totals["succeeding"] / count, "failed": failed,
            "deviation": float(self.ppo.get_policy().output_std.detach().mean()), "learning_rate": self.ppo.learning_rate,
            **{f"loss_{name}": value for name, value in losses.items()},
            "env_steps_per_s": count * self.env.num_envs / (done - start), "collect_s": collected - start, "update_s": done - collected,
            **{name.replace("/reward/", "term_"): value / count for name, value in totals.items() if name.startswith("/reward/")},
        }  # fmt: skip

    def log(self, row: Mapping[str, float]) -> None:
        """Append a row to ``progress.csv`` and to TensorBoard's events."""
        append_row(
            self.folder / "progress.csv",
            {name: float(f"{value:.5g}") if name != "steps" else value for name, value in row.items()},
        )
        if self._writer is not None:
            for name, value in row.items():
                self._writer.add_scalar(f"train/{name}", value, self.steps)

    def evaluate(self, episodes: int, first_seed: int = 0) -> Evaluation:
        """Play held-out episodes, then begin new ones of the training."""
        env, policy = self.env, self.ppo.get_policy()
        returns, lengths, successes, failures, played = [], [], 0, 0, 0
        with torch.inference_mode():
            while played < episodes:
                observation = env.reset(HELD_OUT + first_seed + played)
                running = torch.arange(env.num_envs, device=self.device) < episodes - played
                played, earned, step = played + int(running.sum()), torch.zeros(env.num_envs, device=self.device), 0
                while running.any():
                    observation, reward, done, extras = env.step(policy(observation))
                    earned, step, ended = earned + reward * running, step + 1, running & (done > 0)
                    returns += (earned[ended] / env.reward_scale).tolist()
                    lengths += [step] * int(ended.sum())
                    successes, failures = (
                        successes + int(extras["success"][ended].sum()),
                        failures + int(extras["failed"][ended].sum()),
                    )
                    running &= ~ended
        self._begin_episodes()
        result = Evaluation(played, successes, float(np.mean(returns)), float(np.mean(lengths)), failures)
        low, high = result.interval
        row = {
            "steps": self.steps, "wall_s": round(self.wall_s, 2), "episodes": played, "success": successes / played,
            "low": round(low, 4), "high": round(high, 4), "failed": failures, "return": round(result.mean_return, 2),
            "length": round(result.mean_length, 1),
        }  # fmt: skip
        append_row(self.folder / "evaluation.csv", row)
        return result

    def save(self) -> None:
        """Write ``checkpoint.pt`` to go on from, and ``policy.pt`` to play; never half."""
        progress = {"settings": self.settings, "steps": self.steps, "iteration": self.iteration, "wall_s": self.wall_s}
        for name, values in (
            ("checkpoint", self.ppo.save()),
            ("policy", {"actor_state_dict": {name: one.cpu() for name, one in self.ppo.get_policy().state_dict().items()}}),
        ):
            stream = io.BytesIO()
            torch.save({**progress, **values}, stream)
            write_atomic(self.folder / f"{name}.pt", stream.getvalue())

    @property
    def wall_s(self) -> float:
        """Seconds from the start, those before a resume too: worlds, compilation, rollouts, updates and evaluations."""
        return time.perf_counter() - self._start

    def close(self) -> None:
        """End the processes of the environments."""
        if self._writer is not None:
            self._writer.close()
        self.env.close()


def train(args: Args, touch: str, seed: int, folder: Path) -> None:
    """One training, up to its steps, its target or the minutes; then the last evaluation."""
    start, total = time.perf_counter(), STEPS[args.task] if args.steps is None else args.steps
    _checkpoint(folder, _settings(args, touch, seed), "cpu")
    if _is_done(args, folder, total):
        print(f"{args.task} {touch} seed {seed}: done before, in {folder}", flush=True)
        return
    with FolderLock(folder), contextlib.closing(Training(args, touch, seed, folder)) as training:
        name, reached, speeds = f"{args.task} {touch} seed {seed}", False, []
        due = training.steps + args.evaluate_every
        while training.steps < total and not reached:
            row = training.iterate()
            speeds.append(row["env_steps_per_s"])
            if training.iteration % 10 == 0:
                training.log(row)
                print(
                    f"{name}: {row['steps']:.0f} steps, {row['wall_s']:.0f} s, reward {row['reward']:.3f}, success {row['success']:.2f} "
                    f"of {row['ended']:.0f}, deviation {row['deviation']:.2f}, {row['env_steps_per_s']:.0f} steps/s",
                    flush=True,
                )
            if due <= training.steps < total:
                due = training.steps + args.evaluate_every
                result = training.evaluate(min(args.episodes, args.num_envs))
                training.save()
                print(f"{name}: {training.steps} steps, held out {result.successes}/{result.episodes}", flush=True)
                reached = args.target is not None and result.successes >= args.target * result.episodes
            if args.minutes is not None and time.perf_counter() - start > 60.0 * args.minutes:
                break
        trained_s = training.wall_s
        result = training.evaluate(args.episodes, first_seed=10**6)
        training.save()
        low, high = result.interval
        found: dict[str, Metric] = {
            "env_steps": training.steps, "done": int(reached or training.steps >= total), "minutes": trained_s / 60.0,
            "episodes": result.episodes, "failed": result.failures,
            "success": result.successes / result.episodes, "success_low": low, "success_high": high, "return": result.mean_return,
            "length": result.mean_length, "env_steps_per_s": training.steps / trained_s, "processes": args.processes,
            "num_envs": args.num_envs, "worlds": args.worlds, **({"train_env_steps_per_s": float(np.median(speeds))} if speeds else {}),
        }  # fmt: skip
        write_metrics(
            folder / "metrics.json",
            {**found, "wall_s": time.perf_counter() - start} | {"device": training.device} | versions(("rsl_rl_lib", "torch")),
        )
        print(
            f"{name}: success {result.successes}/{result.episodes} ({low:.2f} to {high:.2f}) after {training.steps} steps",
            flush=True,
        )


def main(args: Args) -> dict[str, Metric]:
    """Run all trainings, one after the other, and write ``metrics.json``."""
    start = time.perf_counter()
    torch.set_num_threads(args.threads)
    out = args.folder("train_gpu", args.task if args.physics == "rigid" else f"{args.task}_{args.physics}")
    touches = parse_names(args.touch, "touch")
    seeds = parse_seeds(args.seeds)
    interrupted = False
    try:
        for touch in touches:
            for seed in seeds:
                train(args, touch, seed, out / touch / f"seed{seed}")
    except KeyboardInterrupt:
        interrupted = True
        print("interrupted: the same command goes on from the last checkpoints", file=sys.stderr)
    device = "gpu" if args.device != "cpu" and torch.cuda.is_available() else "cpu"
    found: dict[str, Metric] = {"experiment": "train_gpu", "task": args.task, "device": device, **machine()}
    for touch in touches:
        done = {k: out / touch / f"seed{k}" / "metrics.json" for k in seeds}
        rows = {k: read_metrics(path) for k, path in done.items() if path.exists()}
        for k, row in rows.items():
            key = f"{touch.replace('+', '_')}.seed{k}"
            found |= {f"{key}.{name}": value for name, value in row.items() if not name.startswith(("versions", "device"))}
        if touch == touches[0] and rows:
            found[f"{device}.{args.task}.success"] = min(float(row["success"]) for row in rows.values())
            found[f"{device}.{args.task}.minutes"] = max(float(row["minutes"]) for row in rows.values())
            speeds = [float(row["train_env_steps_per_s"]) for row in rows.values() if "train_env_steps_per_s" in row]
            if speeds:
                found[f"{device}.train.env_steps_per_s"] = min(speeds)
    found |= {"wall_s": time.perf_counter() - start} | versions((*VERSIONED, "gymnasium", "rsl_rl_lib", "torch"))
    write_metrics(out / "metrics.json", found)
    print(f"written: {out}")
    if interrupted:
        sys.exit(130)
    return found


def _checkpoint(folder: Path, settings: Mapping[str, Any], device: str) -> dict[str, Any] | None:
    """The folder's checkpoint; None without. Raises ``InputError`` for one of other settings."""
    path = folder / "checkpoint.pt"
    if not path.exists():
        return None
    try:
        saved = torch.load(path, map_location=device, weights_only=True)
        kept, *_ = (saved[name] for name in ("settings", "steps", "iteration", "wall_s", "actor_state_dict"))
    except Exception as error:
        raise InputError("out", value=path, rule=f"must be a checkpoint of train_gpu ({error})") from error
    kept = {"physics": "rigid"} | kept  # a checkpoint from before there was a choice
    if kept != settings:
        other = {k: v for k, v in kept.items() if v != settings.get(k)}
        raise InputError("out", value=folder, rule=f"holds a training of other settings, with {other}: name another folder")
    return saved


def _is_done(args: Args, folder: Path, total: int) -> bool:
    """True for a training that has come to its end and was evaluated on as many episodes; one with more steps to do goes on."""
    path = folder / "metrics.json"
    row = read_metrics(path) if path.exists() else {}
    reached = args.target is not None and float(row.get("success", 0.0)) >= args.target
    return bool(row.get("done")) and int(row["episodes"]) >= args.episodes and (reached or int(row["env_steps"]) >= total)


def _settings(args: Args, touch: str, seed: int) -> dict[str, Any]:
    """What a checkpoint must agree in to be gone on from: all that is not about where and for how long."""
    free = (
        "out",
        "device",
        "seed",
        "seeds",
        "touch",
        "steps",
        "minutes",
        "target",
        "processes",
        "threads",
        "episodes",
        "evaluate_every",
    )
    kept = {name: value for name, value in asdict(args).items() if name not in free}
    return kept | {"touch": touch, "seed": seed, "history": HISTORY.get(args.task, 1) if args.history is None else args.history}


if __name__ == "__main__":
    run(main, Args, __doc__)
