"""Watch a policy and count how often it succeeds: a film of the scene with what the sensors see beside it, and a success rate.

    python experiments/play.py experiments/policies/balance_pole_wrench.pt
    python experiments/play.py runs/train_gpu/PushCube/wrench/seed0/policy.pt
    python experiments/play.py scripted --task LiftCube --episodes 20
    python experiments/play.py experiments/policies/push_cube_markers.pt --physics ipc --episodes 4 --no-film

Writes ``film.gif`` (``film.mp4`` with ``--mp4``, where the program ffmpeg is installed), ``strip.png`` and ``metrics.json``. The film
needs MuJoCo's offscreen renderer (``MUJOCO_GL``, ``egl`` unless it is set); without, the rate is told all the same. Seeds are those of
evaluation: no training has seen them.
"""

from __future__ import annotations

import itertools
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import tyro

from experiments.running import recorded, run
from raytac.checks import check_known
from raytac.errors import BackendError, InputError
from raytac.io import CommonOptions, Metric
from raytac.observe import MODALITIES, ObservationSettings
from raytac.optics import OPTICS
from raytac.report import machine

if TYPE_CHECKING:
    from experiments.ppo_learner import Recipe
    from experiments.training import Evaluation
    from raytac.envs import FlatPolicy


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Play a policy; ``seed`` is that of the episode of the film, counted from the first held-out one."""

    policy: tyro.conf.Positional[str] = "scripted"
    """A file that ``train_ppo.py`` or ``train_gpu.py`` has written, or ``scripted``."""
    task: str = "LiftCube"
    """Task of the scripted policy; a file knows its own."""
    physics: str | None = None
    """Pads that it is played on: ``rigid`` or ``ipc``, those that it was trained on if not given. Soft ones take the CPU seconds a step."""
    episodes: int = 100
    """Episodes that are played for the success rate; 0: the film alone."""
    num_envs: int = 16
    """Most of them that run at a time."""
    film: bool = True
    """Draw an episode."""
    mp4: bool = False
    """Write the film as MP4 by ffmpeg instead of as GIF."""
    optics: str = "raytrace"
    """Optical model of the sensors' images in the film: ``raytrace`` (the sensor's own colours), ``taxim`` (nearly these, by a table
    that is baked at first use: minutes) or ``phong`` (quicker, in colours of its own). The policy is not given them; if it was trained with
    images, the film shows those."""


@dataclass(frozen=True)
class Film:
    """Pictures of an episode, one a step."""

    frames: list[np.ndarray]
    """8-bit pictures (H, W, 3): the scene, a third wider than it is high, then a column for each sensor."""
    step: float
    """Time from one picture to the next [s]."""
    sensors: tuple[str, ...]
    """Names of the sensors in the order of their columns."""


def main(args: Args) -> dict[str, Metric]:
    """Play a policy and write the film, the strip and the metrics."""
    os.environ.setdefault("MUJOCO_GL", "egl")  # MuJoCo reads it when it is imported, which is below
    if args.episodes < 0 or args.num_envs < 1:
        name, least = ("episodes", 0) if args.episodes < 0 else ("num_envs", 1)
        raise InputError(name, value=getattr(args, name), rule=f"must be {least} or more")
    OPTICS.config_class(args.optics)
    if args.physics is not None:
        from experiments.training import PHYSICS

        check_known("physics", args.physics, PHYSICS)
    if args.mp4 and shutil.which("ffmpeg") is None:
        raise InputError("mp4", value=True, rule="needs the program ffmpeg; without --mp4 the film is a GIF")
    flat = _flat(args)
    recipe = None if flat is not None else _recipe(args)
    task = flat.task if flat is not None else args.task if recipe is None else recipe.task
    out = Path("runs/play") / (
        f"{task}_{flat.touch}" if flat else f"{task}_scripted" if recipe is None else Path(args.policy).stem
    )
    device, files = "cpu" if args.device == "auto" else args.device, ("film.gif", "film.mp4", "strip.png")
    with recorded(args, "play", out=out, device=device, owned=files, packages=("gymnasium",)) as (folder, metrics):
        trained = "rigid" if flat is None and recipe is None else (flat or recipe).physics  # type: ignore[union-attr]
        metrics |= {"policy": args.policy, "task": task, "trained_on": trained, "physics": args.physics or trained, **machine()}
        if args.film:
            try:
                film = _film(args, recipe) if flat is None else _flat_film(args, flat)
            except BackendError as error:
                print(f"no film: {error}", file=sys.stderr)
            else:
                _write_film(film, folder / ("film.mp4" if args.mp4 else "film.gif"))
                _write_strip(film, folder / "strip.png")
        if args.episodes:
            _, result = rate(args)
            low, high = result.interval
            metrics |= {
                "episodes": result.episodes, "failed": result.failures, "success": result.successes / result.episodes, "success_low": low,
                "success_high": high, "return": result.mean_return, "length": result.mean_length,
            }  # fmt: skip
            print(
                f"{metrics['task']}: success {result.successes}/{result.episodes} (95 %: {low:.3f} to {high:.3f}), "
                f"return {result.mean_return:.1f}, length {result.mean_length:.0f}"
            )
    return metrics


def _flat(args: Args) -> FlatPolicy | None:
    """The policy, if ``train_gpu.py`` has written it."""
    if args.policy == "scripted":
        return None
    from raytac.envs import FlatPolicy

    return FlatPolicy(Path(args.policy)) if FlatPolicy.is_one(Path(args.policy)) else None


def rate(args: Args) -> tuple[str, Evaluation]:
    """Task of a policy, and its success on held-out seeds."""
    flat = _flat(args)
    if flat is not None:
        return flat.task, _flat_rate(args, flat)
    recipe = _recipe(args)
    return args.task if recipe is None else recipe.task, _rate(args, recipe)


def _flat_rate(args: Args, policy: FlatPolicy) -> Evaluation:
    """Over held-out seeds, those of ``_rate``."""
    from experiments.training import HELD_OUT, Evaluation

    many = policy.vector(_together(args), device=args.device, physics=args.physics or policy.physics)
    returns, lengths, successes, failures = [], [], 0, 0
    while len(returns) < args.episodes:
        many.reset(HELD_OUT + 2 * 10**6 + len(returns))
        seen, count = many.buffers, len(many.buffers["age"])
        running, earned, steps = np.arange(count) < args.episodes - len(returns), np.zeros(count), 0
        while running.any():
            seen["action"][:] = policy(seen["actor"])
            many.step()
            earned, steps = earned + seen["reward"] * running, steps + 1
            ended = running & ((seen["terminated"] + seen["truncated"]) > 0.0)
            returns += earned[ended].tolist()
            lengths += [steps] * int(ended.sum())
            successes += int(seen["success"][ended].sum())
            failures += int(seen["failed"][ended].sum())
            running &= ~ended
    return Evaluation(len(returns), successes, float(np.mean(returns)), float(np.mean(lengths)), failures)


def _flat_film(args: Args, policy: FlatPolicy) -> Film:
    """The episode of ``_film``; image and markers are shown, whatever the policy is given."""
    from experiments.training import HELD_OUT, KINDS

    felt = KINDS[policy.task].task.tactile if policy.touch == "task" else policy.tactile or ()
    every = tuple(name for name in MODALITIES if name in (*felt, "rgb", "markers"))
    shown = ObservationSettings(every, resolution=(160, 120), optics=args.optics)
    hidden = [name for name in every if name not in felt]
    one = policy.vector(
        1,
        hidden=hidden,
        tactile=shown,
        render_mode="rgb_array",
        pitch=0.4e-3,
        device=args.device,
        physics=args.physics or policy.physics,
    )
    one.reset(HELD_OUT + 2 * 10**6 + args.seed)
    frames, ended = [], False
    while not ended:
        frames.append(_picture(one.env.render()))
        one.buffers["action"][:] = policy(one.buffers["actor"])
        one.step()
        ended = bool(one.buffers["terminated"][0] or one.buffers["truncated"][0])
    return Film(frames, one.layout.control_timestep, tuple(one.env.batch.observers))


def _recipe(args: Args) -> Recipe | None:
    """That of the policy; None for a scripted one."""
    from raytac.envs import SCRIPTED

    if args.policy != "scripted":
        from experiments.ppo_learner import Checkpoint

        saved = Checkpoint.load(Path(args.policy)).recipe
        return replace(saved, processes=1, num_envs=_together(args), device="cpu" if args.device == "auto" else args.device)
    if args.task not in SCRIPTED:
        raise InputError("task", value=args.task, rule="must be a known task", choices=tuple(SCRIPTED))
    return None


def _together(args: Args) -> int:
    """How many environments play ``episodes`` in as few rounds as ``num_envs`` allow, all about equally often."""
    rounds = max(1, -(-args.episodes // args.num_envs))
    return max(1, -(-args.episodes // rounds))


def _rate(args: Args, recipe: Recipe | None) -> Evaluation:
    """Over held-out seeds."""
    from experiments.training import HELD_OUT, KINDS, Evaluation
    from raytac.envs import SCRIPTED

    if recipe is not None:
        from experiments.ppo_learner import Checkpoint, Learner, evaluate

        learner = Learner(recipe, physics=args.physics or recipe.physics)
        learner.restore(Checkpoint.load(Path(args.policy)))
        return evaluate(learner, args.episodes, first_seed=2 * 10**6)
    env, policy = KINDS[args.task](_together(args), tactile=None, physics=args.physics, device=args.device), SCRIPTED[args.task]
    returns, lengths, successes, failures = [], [], 0, 0
    while len(returns) < args.episodes:
        env.reset(seed=HELD_OUT + 2 * 10**6 + len(returns))
        running, earned, steps = np.arange(env.num_envs) < args.episodes - len(returns), np.zeros(env.num_envs), 0
        while running.any():
            _, reward, terminated, truncated, infos = env.step(np.clip(policy(env.batch), -1.0, 1.0))
            earned, steps = earned + reward * running, steps + 1
            ended = running & (terminated | truncated)
            returns += earned[ended].tolist()
            lengths += [steps] * int(ended.sum())
            successes += int(infos["success"][ended].sum())
            failures += int(infos["failed"][ended].sum())
            running &= ~ended
    return Evaluation(len(returns), successes, float(np.mean(returns)), float(np.mean(lengths)), failures)


def _film(args: Args, recipe: Recipe | None) -> Film:
    from experiments.training import HELD_OUT, KINDS
    from raytac.envs import SCRIPTED, TactileVectorEnv

    seed = HELD_OUT + 2 * 10**6 + args.seed
    if recipe is None:
        shown = ObservationSettings(("rgb", "markers"), resolution=(160, 120), optics=args.optics)
        env, policy = (
            KINDS[args.task](1, tactile=shown, render_mode="rgb_array", device=args.device, physics=args.physics),
            SCRIPTED[args.task],
        )
        env.reset(seed=seed)
        frames, ended = [], False
        while not ended:
            frames.append(_picture(env.render()))
            _, _, terminated, truncated, _ = env.step(np.clip(policy(env.batch), -1.0, 1.0))
            ended = bool(terminated[0] or truncated[0])
        return Film(frames, env.batch.control_timestep, tuple(env.batch.observers))
    from experiments.ppo_learner import Checkpoint, Learner, tactile_settings

    settings = tactile_settings(recipe.tactile, recipe.resolution)
    told = KINDS[recipe.task].task.tactile if settings == "task" else () if settings is None else settings.modalities  # type: ignore[union-attr]
    if "rgb" in told:
        learner = Learner(replace(recipe, num_envs=1), render_mode="rgb_array", physics=args.physics or recipe.physics)
    else:
        every = tuple(name for name in MODALITIES if name in (*told, "rgb", "markers"))
        shown = ObservationSettings(every, resolution=(160, 120), optics=args.optics)
        hidden = [name for name in every if name not in told]
        given = {"tactile": shown, "render_mode": "rgb_array", "pitch": 0.4e-3, "physics": args.physics or recipe.physics}
        learner = Learner(replace(recipe, num_envs=1), hidden=hidden, **given)
    learner.restore(Checkpoint.load(Path(args.policy)))
    learner.normaliser.training = False
    seen, vectors = learner.model.get_env(), learner.base.env  # type: ignore[union-attr]
    assert seen is not None and isinstance(vectors, TactileVectorEnv)
    seen.seed(seed)
    observation, frames, ended = seen.reset(), [], False
    while not ended:
        frames.append(_picture(vectors.render()))
        observation, _, done, _ = seen.step(learner.predict(observation))  # type: ignore[arg-type]
        ended = bool(done[0])
    return Film(frames, vectors.batch.control_timestep, tuple(vectors.batch.observers))


def _picture(pictures: tuple[np.ndarray, ...] | None) -> np.ndarray:
    assert pictures is not None
    return pictures[0]


def _write_film(film: Film, path: Path) -> None:
    """All frames as MP4, at the speed of life; every third as GIF, which can show no more."""
    from PIL import Image

    if path.suffix == ".gif":
        images = [Image.fromarray(frame).convert("P", palette=Image.Palette.ADAPTIVE, colors=96) for frame in film.frames[::3]]
        images[0].save(path, save_all=True, append_images=images[1:], duration=round(3e3 * film.step), loop=0)
        return
    height, width = (2 * (n // 2) for n in film.frames[0].shape[:2])  # the usual format of colours wants even numbers
    command = [
        "ffmpeg", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(1.0 / film.step),
        "-i", "-", "-pix_fmt", "yuv420p", "-y", str(path),
    ]  # fmt: skip
    raw = b"".join(np.ascontiguousarray(frame[:height, :width]).tobytes() for frame in film.frames)
    done = subprocess.run(command, input=raw, capture_output=True, check=False)
    if done.returncode:
        raise BackendError(f"ffmpeg could not write {path.name}: {done.stderr.decode(errors='replace').strip()}")


def moments(film: Film, count: int) -> np.ndarray:
    """Numbers of ``count`` frames, the first and the last among them, between which the scene changes alike; where nothing changes, time
    counts."""
    scene = 4 * film.frames[0].shape[0] // 3
    change = [np.abs(b[:, :scene].astype(int) - a[:, :scene]).mean() for a, b in itertools.pairwise(film.frames)]
    way = np.cumsum([0.0, *(np.array(change) + 1e-9)])
    found = np.searchsorted(way, np.linspace(0.0, way[-1], count))
    return np.append(found[:-1], len(film.frames) - 1)


def _write_strip(film: Film, path: Path, count: int = 4) -> None:
    """Moments of the episode, as much change in the scene from each to the next, two beside each other in the order in which one reads."""
    from matplotlib.figure import Figure

    height, width = film.frames[0].shape[:2]
    scene = 4 * height // 3
    gap, above, below = 0.12, 0.26, 0.24  # inches
    wide, high = width / 100, height / 100  # at 150 dots an inch: text is finer than pictures
    rows = -(-count // 2)
    size = 2 * wide + gap, rows * (above + high + below)
    figure = Figure(figsize=size)
    for k, i in enumerate(moments(film, count)):
        row, column = divmod(k, 2)
        left, bottom = column * (wide + gap), size[1] - row * (above + high + below) - above - high
        axes = figure.add_axes((left / size[0], bottom / size[1], wide / size[0], high / size[1]))
        axes.imshow(film.frames[i], interpolation="lanczos", extent=(0, width, height, 0))
        axes.set(xticks=[], yticks=[])
        axes.set_title(f"({'abcdefgh'[k]}) t = {film.step * i:.2f} s", loc="left", fontsize=11, pad=4)
        axes.text(scene / 2, height + 5, "scene", ha="center", va="top", fontsize=9)
        share = (width - scene) / max(1, len(film.sensors))
        for n, name in enumerate(film.sensors):
            middle = scene + (n + 0.5) * share
            axes.text(middle, height + 5, f"{name} (markers × 4)", ha="center", va="top", fontsize=9)
    figure.savefig(path, dpi=150)


if __name__ == "__main__":
    run(main, Args, __doc__)
