"""A policy watched: a film of scene and sensors, and how often it succeeds."""

from __future__ import annotations

import itertools
import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from raytac.checks import check_known, check_seed, check_whole
from raytac.device import resolve_device
from raytac.errors import BackendError
from raytac.io.atomic import write_atomic
from raytac.io.films import check_mp4, gif_bytes, mp4_bytes
from raytac.io.folder import result_folder
from raytac.io.metrics import VERSIONED, Metric, versions, write_metrics
from raytac.learn.evaluation import HELD_OUT, Evaluation, Player, evaluate
from raytac.optics.base import OpticsConfig
from raytac.optics.registry import chosen_optics
from raytac.physics.registry import PHYSICS
from raytac.report.measure import machine

FIRST_SEED = 2 * 10**6
"""Of the episodes played, counted from ``HELD_OUT``; a training evaluates on lower ones."""
_GIF_EVERY = 3
"""Steps of a task from one picture of a GIF to the next."""


@dataclass(frozen=True)
class Film:
    """Pictures of an episode, one a step."""

    frames: list[np.ndarray]
    """8-bit pictures (H, W, 3): the scene (4:3), then a column for each sensor."""
    step: float
    """Time from one picture to the next [s]."""
    sensors: tuple[str, ...]
    """Names of the sensors in the order of their columns."""


def gif_pictures(frames: Sequence[np.ndarray]) -> Sequence[np.ndarray]:
    """Pictures of a GIF: the last one and every third before it."""
    return frames[(len(frames) - 1) % _GIF_EVERY :: _GIF_EVERY]


def success_rate(
    player: Player, episodes: int, *, num_envs: int = 16, physics: str | None = None, device: str = "auto"
) -> Evaluation:
    """Success in ``episodes`` held-out episodes, at most ``num_envs`` at a time.

    Args:
        physics: pads it is played on; those that it was trained on if None.
    """
    check_whole("episodes", episodes)
    rounds = -(-episodes // check_whole("num_envs", num_envs))
    together = -(-episodes // rounds)  # as few rounds as possible, in all of which about as many run
    played = player.episodes(together, physics=physics or player.physics, device=device)
    return evaluate(played, episodes, first_seed=FIRST_SEED)


def film_episode(
    player: Player, *, seed: int = 0, optics: OpticsConfig | str = "raytrace", physics: str | None = None, device: str = "auto"
) -> Film:
    """Film of the held-out episode number ``seed``.

    Raises ``BackendError``: MuJoCo cannot draw here; set ``MUJOCO_GL`` before it is imported.
    """
    played = player.episodes(1, physics=physics or player.physics, device=device, shown=optics)
    played.reset(HELD_OUT + FIRST_SEED + seed)
    frames, has_ended = [], False
    while not has_ended:
        frames.append(played.picture())
        has_ended = bool(played.step().ended[0])
    return Film(frames, played.control_timestep, played.sensors)


def play_policy(
    player: Player,
    out: Path,
    *,
    episodes: int = 100,
    num_envs: int = 16,
    physics: str | None = None,
    film: bool = True,
    mp4: bool = False,
    optics: OpticsConfig | str = "raytrace",
    device: str = "auto",
    seed: int = 0,
) -> dict[str, Metric]:
    """Write the film ``film.gif``, four moments of it, ``strip.png``, and ``metrics.json``.

    Where MuJoCo cannot draw, the film is left out with a warning.

    Args:
        episodes: held-out episodes that are played for the success rate; 0 is the film alone.
        num_envs, physics, device: as of ``success_rate``.
        mp4: ``film.mp4`` in place of the GIF.
        optics, seed: as of ``film_episode``.

    Raises:
        InputError: an unknown option, before anything is written.
        BackendError: MP4 without the package that writes it.
    """
    start, log = time.perf_counter(), logging.getLogger("raytac")
    check_whole("episodes", episodes, 0)
    check_whole("num_envs", num_envs)
    check_seed("seed", seed)
    chosen_optics(optics)
    if physics is not None:
        check_known("physics", physics, PHYSICS.names)
    if mp4 and film:
        check_mp4()
    on: dict[str, str] = {"physics": physics or player.physics, "device": device}
    metrics: dict[str, Metric] = {
        "command": "play", "policy": player.name, "task": player.task, "trained_on": player.physics, "seed": seed,
        "device": resolve_device(device, ray_tracing=False), "physics": on["physics"], **machine(),
    }  # fmt: skip
    with result_folder(out, ("film.gif", "film.mp4", "strip.png", "metrics.json")) as folder:
        if film:
            try:
                made = film_episode(player, seed=seed, optics=optics, **on)
            except BackendError as error:
                log.warning("no film: %s", error)
            else:
                pictures = made.frames if mp4 else gif_pictures(made.frames)
                rate = 1.0 / made.step if mp4 else 1.0 / (_GIF_EVERY * made.step)
                write_atomic(folder / ("film.mp4" if mp4 else "film.gif"), (mp4_bytes if mp4 else gif_bytes)(pictures, rate))
                write_strip(made, folder / "strip.png")
        if episodes:
            result = success_rate(player, episodes, num_envs=num_envs, **on)
            low, high = result.interval
            metrics |= {
                "episodes": result.episodes, "successes": result.successes, "failed": result.failures,
                "success": result.successes / result.episodes, "success_low": low, "success_high": high,
                "return": result.mean_return, "length": result.mean_length,
            }  # fmt: skip
        metrics |= versions((*VERSIONED, "gymnasium"))
        metrics["wall_s"] = time.perf_counter() - start
        write_metrics(folder / "metrics.json", metrics)
    return metrics


def moments(film: Film, count: int) -> np.ndarray:
    """Numbers of ``count`` frames, first and last among them, between which as much changes.

    Only the scene counts; where nothing changes in it, time does.
    """
    scene = 4 * film.frames[0].shape[0] // 3
    change = [np.abs(b[:, :scene].astype(int) - a[:, :scene]).mean() for a, b in itertools.pairwise(film.frames)]
    total = np.cumsum([0.0, *(np.array(change) + 1e-9)])
    at = np.searchsorted(total, np.linspace(0.0, total[-1], count))
    return np.append(at[:-1], len(film.frames) - 1)


def write_strip(film: Film, path: Path, count: int = 4) -> None:
    """Write moments of the episode as a figure, two a row in the order of reading."""
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
        x, y = column * (wide + gap), size[1] - row * (above + high + below) - above - high
        axes = figure.add_axes((x / size[0], y / size[1], wide / size[0], high / size[1]))
        axes.imshow(film.frames[i], interpolation="lanczos", extent=(0, width, height, 0))
        axes.set(xticks=[], yticks=[])
        axes.set_title(f"({'abcdefgh'[k]}) t = {film.step * i:.2f} s", loc="left", fontsize=11, pad=4)
        axes.text(scene / 2, height + 5, "scene", ha="center", va="top", fontsize=9)
        share = (width - scene) / max(1, len(film.sensors))
        for n, name in enumerate(film.sensors):
            middle = scene + (n + 0.5) * share
            axes.text(middle, height + 5, f"{name} (markers × 4)", ha="center", va="top", fontsize=9)
    figure.savefig(path, dpi=150)
