"""PPO alone, without demonstrations or a teacher: rsl_rl's PPO over the environments.

The critic is asymmetric: in training it is given the body's pose and velocity and the wrenches of all sensors, whatever the policy is
given. The policy never is.
"""

# pyright: reportMissingImports=false
# (rsl_rl and PyTorch belong to the extra "rl", which the tests do without.)

from __future__ import annotations

import contextlib
import io
import logging
import time
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from rsl_rl.storage import RolloutStorage

from raytac.envs.rsl import RslVecEnv, RslWarpEnv
from raytac.errors import InputError
from raytac.io.atomic import write_atomic
from raytac.io.folder import FolderLock
from raytac.io.metrics import VERSIONED, Metric, read_metrics, versions, write_metrics
from raytac.io.options import parse_names, parse_seeds
from raytac.learn.evaluation import KINDS, Evaluation, Outcome, append_row, evaluate, keep_rows, segment_seed
from raytac.learn.settings import DEVIATION_MOST, ENTROPY, HISTORY, STEPS, PpoSettings
from raytac.report.measure import machine

_LOG = logging.getLogger("raytac")


class Training:
    """One training in a folder: environments, networks, PPO."""

    def __init__(self, args: PpoSettings, touch: str, seed: int, folder: Path, device: str = "auto") -> None:
        """Begin, or go on from the folder's checkpoint; InputError for one of other settings."""
        self.args, self.touch, self.seed, self.folder, self.device = args, touch, seed, folder, _device(device)
        self._start = time.perf_counter()
        self.settings = _settings(args, touch, seed)
        saved = _checkpoint(folder, self.settings, self.device)  # before any process is started
        self.steps, self.iteration = (0, 0) if saved is None else (saved["steps"], saved["iteration"])
        tactile: Any = {"none": None, "task": "task"}.get(touch, tuple(touch.split("+")))
        kind: Any = KINDS[args.task]
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
            "std_range": (args.deviation_floor, DEVIATION_MOST),
        }  # fmt: skip
        actor = MLPModel(observation, groups, "actor", self.env.num_actions, distribution_cfg=gaussian, **network)
        critic = MLPModel(observation, groups, "critic", 1, **network)
        storage = RolloutStorage("rl", args.num_envs, args.rollout, observation, [self.env.num_actions], self.device)
        self.ppo = PPO(
            actor, critic, storage,
            num_learning_epochs=args.epochs, num_mini_batches=args.minibatches, clip_param=args.clip, gamma=args.gamma,
            lam=args.gae_lambda, entropy_coef=self.settings["entropy"], learning_rate=args.learning_rate, schedule="adaptive",
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
        """Start all environments at random ages, so that they do not end together."""
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
                present = {
                    "reward": rewards.mean(), "ended": dones.sum(), "succeeded": (extras["success"] * dones).sum(),
                    "failed": extras["failed"].sum(), "succeeding": extras["success"].mean(), **extras["log"],
                }  # fmt: skip
                sums = {name: value + sums.get(name, 0.0) for name, value in present.items()}
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
        with torch.inference_mode():
            result = evaluate(_TrainingEpisodes(self.env, self.ppo.get_policy()), episodes, first_seed=first_seed)
        self._begin_episodes()
        low, high, played = *result.interval, result.episodes
        row = {
            "steps": self.steps, "wall_s": round(self.wall_s, 2), "episodes": played, "success": result.successes / played,
            "low": round(low, 4), "high": round(high, 4), "failed": result.failures, "return": round(result.mean_return, 2),
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
        """Seconds from the start with those before a resume: compilation and evaluations too."""
        return time.perf_counter() - self._start

    def close(self) -> None:
        """End the processes of the environments."""
        if self._writer is not None:
            self._writer.close()
        self.env.close()


class _TrainingEpisodes:
    """Environments of a training under its deterministic policy."""

    def __init__(self, env: RslVecEnv | RslWarpEnv, policy: Any) -> None:
        self._env, self._policy, self.num_envs = env, policy, env.num_envs

    def reset(self, seed: int) -> None:
        self._observation = self._env.reset(seed)

    def step(self) -> Outcome:
        self._observation, reward, done, extras = self._env.step(self._policy(self._observation))
        values = reward / self._env.reward_scale, done, extras["success"], extras["failed"]
        return Outcome(*torch.stack([value.double() for value in values]).cpu().numpy())


def train_policies(args: PpoSettings, out: Path, *, device: str = "auto") -> dict[str, Metric]:
    """Run the trainings of all ``touch`` and ``seeds``, one after the other.

    Each is in ``out/TOUCH/seedK/``: ``progress.csv`` (one row some iterations), ``evaluation.csv``, ``checkpoint.pt``, ``policy.pt`` and
    ``metrics.json``, and TensorBoard's events where it is installed. Called again it goes on from the checkpoints.

    Returns:
        What ``out/metrics.json`` holds. ``DEVICE.TASK.success`` is that of the worst seed of the first touch; ``DEVICE.TASK.minutes`` and
        ``DEVICE.train.env_steps_per_s`` (the median over iterations, each a rollout and an update) are those of the slowest.

    Raises:
        InputError: a folder with a training of other settings.
        KeyboardInterrupt: when ``metrics.json`` has what is done.
    """
    start = time.perf_counter()
    torch.set_num_threads(args.threads)
    touches, seeds = parse_names(args.touch, "touch"), parse_seeds(args.seeds)
    try:
        for touch in touches:
            for seed in seeds:
                _train(args, touch, seed, out / touch / f"seed{seed}", device)
    except KeyboardInterrupt:
        _gather(args, out, device, start)
        raise
    return _gather(args, out, device, start)


def _train(args: PpoSettings, touch: str, seed: int, folder: Path, device: str) -> None:
    """Run one training up to its steps, its target or the minutes; then evaluate it for good."""
    start, total = time.perf_counter(), STEPS[args.task] if args.steps is None else args.steps
    _checkpoint(folder, _settings(args, touch, seed), "cpu")  # of other settings it is refused, also where its training is done
    if _is_done(args, folder, total):
        _LOG.info("%s %s seed %s: done before, in %s", args.task, touch, seed, folder)
        return
    with FolderLock(folder), contextlib.closing(Training(args, touch, seed, folder, device)) as training:
        name, reached, best, speeds = f"{args.task} {touch} seed {seed}", False, 0.0, []
        due = training.steps + args.evaluate_every
        while training.steps < total and not reached:
            row = training.iterate()
            speeds.append(row["env_steps_per_s"])
            if training.iteration % 10 == 0:
                training.log(row)
                _LOG.info(
                    f"{name}: {row['steps']:.0f} steps, {row['wall_s']:.0f} s, reward {row['reward']:.3f}, success {row['success']:.2f} "
                    f"of {row['ended']:.0f}, deviation {row['deviation']:.2f}, {row['env_steps_per_s']:.0f} steps/s"
                )
            if due <= training.steps < total:
                due = training.steps + args.evaluate_every
                result = training.evaluate(min(args.episodes, args.num_envs))
                training.save()
                _LOG.info(f"{name}: {training.steps} steps, held out {result.successes}/{result.episodes}")
                best = max(best, result.successes / result.episodes)
                reached = args.target is not None and best >= args.target
            if args.minutes is not None and time.perf_counter() - start > 60.0 * args.minutes:
                break
        trained_s = training.wall_s
        result = training.evaluate(args.episodes, first_seed=10**6)
        training.save()
        low, high = result.interval
        metrics: dict[str, Metric] = {
            "env_steps": training.steps, "done": int(reached or training.steps >= total), "reached": best, "minutes": trained_s / 60.0,
            "episodes": result.episodes, "failed": result.failures,
            "success": result.successes / result.episodes, "success_low": low, "success_high": high, "return": result.mean_return,
            "length": result.mean_length, "env_steps_per_s": training.steps / trained_s, "processes": args.processes,
            "num_envs": args.num_envs, "worlds": args.worlds, **({"train_env_steps_per_s": float(np.median(speeds))} if speeds else {}),
        }  # fmt: skip
        write_metrics(
            folder / "metrics.json",
            {**metrics, "wall_s": time.perf_counter() - start} | {"device": training.device} | versions(("rsl_rl_lib", "torch")),
        )
        _LOG.info(f"{name}: success {result.successes}/{result.episodes} ({low:.2f} to {high:.2f}) after {training.steps} steps")


def _gather(args: PpoSettings, out: Path, device: str, start: float) -> dict[str, Metric]:
    """Write ``metrics.json`` of what is done so far."""
    touches = parse_names(args.touch, "touch")
    kind = "gpu" if _device(device) == "cuda" else "cpu"
    metrics: dict[str, Metric] = {"command": "train", "task": args.task, "device": kind, **machine()}
    for touch in touches:
        done = {k: out / touch / f"seed{k}" / "metrics.json" for k in parse_seeds(args.seeds)}
        rows = {k: read_metrics(path) for k, path in done.items() if path.exists()}
        for k, row in rows.items():
            key = f"{touch.replace('+', '_')}.seed{k}"
            metrics |= {f"{key}.{name}": value for name, value in row.items() if not name.startswith(("versions", "device"))}
        if touch == touches[0] and rows:
            metrics[f"{kind}.{args.task}.success"] = min(float(row["success"]) for row in rows.values())
            metrics[f"{kind}.{args.task}.minutes"] = max(float(row["minutes"]) for row in rows.values())
            speeds = [float(row["train_env_steps_per_s"]) for row in rows.values() if "train_env_steps_per_s" in row]
            if speeds:
                metrics[f"{kind}.train.env_steps_per_s"] = min(speeds)
    metrics |= {"wall_s": time.perf_counter() - start} | versions((*VERSIONED, "gymnasium", "rsl_rl_lib", "torch"))
    write_metrics(out / "metrics.json", metrics)
    return metrics


def _device(name: str) -> str:
    """``auto`` is CUDA if PyTorch has it."""
    return name if name != "auto" else "cuda" if torch.cuda.is_available() else "cpu"


def _checkpoint(folder: Path, settings: Mapping[str, Any], device: str) -> dict[str, Any] | None:
    """The folder's checkpoint; None without. Raises ``InputError`` for one of other settings."""
    path = folder / "checkpoint.pt"
    if not path.exists():
        return None
    try:
        saved = torch.load(path, map_location=device, weights_only=True)
        saved_settings, *_ = (saved[name] for name in ("settings", "steps", "iteration", "wall_s", "actor_state_dict"))
    except Exception as error:
        raise InputError("out", value=path, rule=f"must be a checkpoint of raytac train ({error})") from error
    saved_settings = {"physics": "rigid"} | saved_settings  # a checkpoint from before there was a choice
    if saved_settings != settings:
        other = {k: v for k, v in saved_settings.items() if v != settings.get(k)}
        raise InputError("out", value=folder, rule=f"holds a training of other settings, with {other}: name another folder")
    return saved


def _is_done(args: PpoSettings, folder: Path, total: int) -> bool:
    """True for a training at its end that was evaluated on as many episodes."""
    path = folder / "metrics.json"
    row = read_metrics(path) if path.exists() else {}
    # The last evaluation has other episodes, in which a training that ended at its target may be below it.
    reached = args.target is not None and max(float(row.get(name, 0.0)) for name in ("success", "reached")) >= args.target
    return bool(row.get("done")) and int(row["episodes"]) >= args.episodes and (reached or int(row["env_steps"]) >= total)


def _settings(args: PpoSettings, touch: str, seed: int) -> dict[str, Any]:
    """Settings that a checkpoint must agree in: all but where, how long and how evaluated."""
    free = ("seeds", "touch", "steps", "minutes", "target", "processes", "threads", "episodes", "evaluate_every")
    bound = {name: value for name, value in asdict(args).items() if name not in free}
    of_task = {"history": HISTORY.get(args.task, 1), "entropy": ENTROPY.get(args.task, 0.005)}
    chosen = {name: value if bound[name] is None else bound[name] for name, value in of_task.items()}
    return bound | {"touch": touch, "seed": seed} | chosen
