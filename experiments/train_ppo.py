"""Train policies by stable-baselines3's PPO: a task, with and without touch, over seeds; resumable, evaluated on seeds never trained on.

    python experiments/train_ppo.py --task PushCube --seeds 0,1,2 --tactile task,none --processes 4
    python experiments/train_ppo.py --task BalancePole --total-timesteps 300000 --side-by-side --most-s 540

The same command again goes on where it was, after Ctrl-C, a crash or ``--most-s``. Each pair of touch and seed is one training in
``<out>/<tactile>/seed<k>/``: ``progress.csv`` (one row a rollout), ``evaluation.csv`` (one a segment), ``checkpoint.pt`` (to resume)
and, where TensorBoard is installed, its events. ``<out>/`` gets ``metrics.json``, ``curves.png`` where Matplotlib is installed, and
``policy_<tactile>_seed<k>.pt`` of each training, which ``experiments/play.py`` plays.
"""

# pyright: reportMissingImports=false
# (stable-baselines3 and PyTorch belong to the extra "rl", which the tests do without.)

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import time
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from experiments.running import run
from raytac.checks import check_known
from raytac.errors import InputError, RaytacError
from raytac.io import VERSIONED, CommonOptions, Metric, parse_names, parse_seeds, versions, write_metrics
from raytac.physics import PHYSICS
from raytac.report import machine

TASKS = ("PushCube", "BalancePole", "LiftCube", "RollBall")
RECIPES: dict[str, dict[str, Any]] = {
    "PushCube": {"total_timesteps": 600_000},
    "BalancePole": {"total_timesteps": 600_000, "history": 3},
    "LiftCube": {"total_timesteps": 1_000_000},
    "RollBall": {"total_timesteps": 400_000, "history": 3},
}
"""Settings that differ from the defaults of ``Recipe``, by task."""
_TUNED = (
    "total_timesteps", "resolution", "imitation_steps", "n_steps", "learning_rate", "gamma", "log_std_init", "history", "segment",
    "n_epochs", "ent_coef", "batch_size",
)  # fmt: skip
"""Fields of ``Recipe`` that options may change."""


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Train a task; ``seed`` is not used, see ``seeds``."""

    task: str = "PushCube"
    """One of PushCube, BalancePole, LiftCube, RollBall."""
    physics: str = "rigid"
    """Pads: ``rigid``, or ``ipc`` for soft ones, each step of which takes the CPU seconds."""
    tactile: str = "task,none"
    """What is felt, joined by commas, each trained with the same seeds: ``task`` (as the environment has it), ``none``, or
    modalities joined by ``+``, as in ``markers+wrench``."""
    resolution: str | None = None
    """WIDTHxHEIGHT of images in pixels, where ``rgb`` is felt; at least 36x36, 48x36 if not given."""
    seeds: str = "0,1,2"
    """Seeds joined by commas; the same seed gives the same weights."""
    total_timesteps: int | None = None
    """Environment steps of each training; the task's own if not given."""
    num_envs: int = 16
    """Environments of each training."""
    processes: int = 1
    """Processes of each training that these are spread over: one core each."""
    side_by_side: bool = False
    """Run all trainings at once instead of one after the other."""
    evaluation: int = 16
    """Episodes evaluated after each segment."""
    final_evaluation: int = 100
    """Episodes of the last evaluation, on other held-out seeds."""
    most_s: float | None = None
    """Begin nothing that would not be done by so many seconds from the start (judged by the last segment); resume later."""
    imitation_steps: int | None = None
    """Environment steps at the beginning that imitate the scripted policy, which knows the state: minutes instead of hours."""
    n_steps: int | None = None
    learning_rate: float | None = None
    gamma: float | None = None
    log_std_init: float | None = None
    history: int | None = None
    segment: int | None = None
    n_epochs: int | None = None
    ent_coef: float | None = None
    batch_size: int | None = None
    """These nine: of ``experiments.ppo_learner.Recipe``; the task's own if not given."""


@dataclass(frozen=True)
class _Job:
    args: Args
    tactile: str
    seed: int
    start: float
    """Unix time [s]."""

    @property
    def name(self) -> str:
        return f"{self.tactile}_seed{self.seed}"

    @property
    def folder(self) -> Path:
        return _out(self.args) / self.tactile / f"seed{self.seed}"


def main(args: Args) -> dict[str, Metric]:
    """Run all trainings and write ``metrics.json``."""
    start = time.time()
    if args.task not in TASKS:
        raise InputError("task", value=args.task, rule="must be a known task", choices=TASKS)
    check_known("physics", args.physics, PHYSICS.names)
    kinds = parse_names(args.tactile, "tactile")
    seeds = parse_seeds(args.seeds)
    from experiments.ppo_learner import Recipe, tactile_settings

    for kind in kinds:  # so that a modality that cannot be observed is an error before any training
        tactile_settings(kind, Recipe.resolution if args.resolution is None else args.resolution)
    jobs = [_Job(args, kind, seed, start) for seed in seeds for kind in kinds]
    found: dict[str, Metric] = {"device": "cpu" if args.device == "auto" else args.device, **machine()}
    interrupted = False
    try:
        _side_by_side(jobs) if args.side_by_side else [_train(job) for job in jobs]
    except KeyboardInterrupt:
        interrupted = True
        print("interrupted: the same command goes on from the last checkpoints", file=sys.stderr)
    found |= _gathered(jobs)
    out = _out(args)
    found |= {"experiment": "train_ppo", "task": args.task, "wall_s": time.time() - start}
    found |= versions((*VERSIONED, "gymnasium", "stable_baselines3", "torch"))
    write_metrics(out / "metrics.json", found)
    try:
        from experiments.training_curves import draw_curves
    except ImportError:
        print("no curves.png: Matplotlib is not installed; experiments/training_curves.py draws it later")
    else:
        draw_curves(out, title=args.task)
    print(f"-> {out}")
    if interrupted:
        sys.exit(130)
    return found


def _out(args: Args) -> Path:
    return args.out or Path("runs/train_ppo") / (args.task if args.physics == "rigid" else f"{args.task}_{args.physics}")


def _train(job: _Job) -> None:
    """One training, up to its end or to the time that is given."""
    import torch

    from experiments.ppo_learner import Recipe, evaluate_learner
    from experiments.ppo_training import Training

    torch.set_num_threads(1)
    args = job.args
    given = {f.name: getattr(args, f.name) for f in fields(Recipe) if f.name in _TUNED and getattr(args, f.name) is not None}
    device = "cpu" if args.device == "auto" else args.device
    recipe = Recipe(
        args.task, job.tactile, job.seed, **{**RECIPES[args.task], **given},
        num_envs=args.num_envs, processes=args.processes, device=device, physics=args.physics,
    )  # fmt: skip
    training = Training(recipe, job.folder, evaluation=args.evaluation, say=lambda text: print(text, flush=True))
    last = 0.0
    try:
        while not training.is_done:
            if args.most_s is not None and time.time() + 1.1 * last - job.start > args.most_s - _final_s(args, last, recipe):
                break
            begin = time.time()
            training.run_segment()
            last = time.time() - begin
        result = evaluate_learner(training.learner, args.final_evaluation, first_seed=10**6)
        low, high = result.interval
        found: dict[str, Metric] = {
            "steps": training.steps, "training_wall_s": training.wall_s, "episodes": result.episodes, "failed": result.failures,
            "success": result.successes / result.episodes, "success_low": low, "success_high": high,
            "return": result.mean_return, "length": result.mean_length, "device": device, "wall_s": time.time() - job.start,
        }  # fmt: skip
        training.learner.checkpoint().save(_out(args) / f"policy_{job.name}.pt", resumable=False)
        write_metrics(job.folder / "metrics.json", found | versions(("stable_baselines3", "torch")))
        print(f"{args.task} {job.name}: success {result.successes}/{result.episodes} ({low:.2f} to {high:.2f})", flush=True)
    finally:
        training.close()


def _final_s(args: Args, last: float, recipe: Any) -> float:
    """About how long the last evaluation takes, by the pace of a segment [s]."""
    segment = recipe.segment * recipe.n_steps * recipe.num_envs + 200 * args.evaluation
    return last * 200 * args.final_evaluation / segment


def _side_by_side(jobs: list[_Job]) -> None:
    """Each in a process of its own; Ctrl-C reaches all of them, and each ends by itself."""
    from raytac.envs import one_thread

    context = multiprocessing.get_context("spawn")
    running = [context.Process(target=_child, args=(job,), name=job.name) for job in jobs]
    with one_thread():
        for process in running:
            process.start()
    try:
        for process in running:
            process.join()
    except KeyboardInterrupt:
        for process in running:
            if process.is_alive() and process.pid is not None:
                os.kill(process.pid, signal.SIGINT)
        for process in running:
            process.join()
        raise
    failed = [process.name for process in running if process.exitcode]
    if failed:
        raise InputError("trainings", value=failed, rule="ended with an error, which is printed above")


def _child(job: _Job) -> None:
    try:
        _train(job)
    except KeyboardInterrupt:
        sys.exit(0)
    except RaytacError as error:
        sys.exit(f"error: {job.name}: {error}")


def _gathered(jobs: list[_Job]) -> dict[str, Metric]:
    """``<tactile>.seed<k>.<key>`` of the trainings that have been evaluated to the end."""
    from raytac.io import read_metrics

    found: dict[str, Metric] = {}
    for job in jobs:
        if (job.folder / "metrics.json").exists():
            values = read_metrics(job.folder / "metrics.json")
            key = f"{job.tactile.replace('+', '_')}.seed{job.seed}"
            found |= {f"{key}.{name}": value for name, value in values.items() if not name.startswith(("versions", "device"))}
    return found


if __name__ == "__main__":
    run(main, Args, __doc__)
