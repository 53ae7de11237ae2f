"""Episodes: recordings of a press or of a task, each one sample with time as its first axis."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from raytac.checks import check_number, check_whole
from raytac.dataset.loader import PressDataset
from raytac.errors import InputError

Fact = str | int | float
_ACTION, _ENDS = "action", ("reward", "terminated", "truncated", "success")
"""Names that ``record_episode`` gives to what is no observation."""


@dataclass(frozen=True)
class Episode:
    """T frames of one recording.

    Attributes:
        arrays: by name, (T, …) each: numbers, truth values, or 8-bit images (T, H, W, 3).
        fps: frames a second.
        task: sentence that says what is done.
        facts: numbers and texts of the whole recording, such as the name and the label of an object.
    """

    arrays: Mapping[str, np.ndarray]
    fps: float
    task: str = ""
    facts: Mapping[str, Fact] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_number("fps", self.fps, "(0, inf)", "Hz")
        if not self.arrays:
            raise InputError("arrays", value={}, rule="must hold at least one array")
        for name in (*self.arrays, *self.facts):
            if not isinstance(name, str) or not name or "/" in name:
                raise InputError("arrays, facts", value=name, rule="must have names without '/'")
        for name in set(self.arrays) & set(self.facts):
            raise InputError("facts", value=name, rule="must not have the name of an array")
        arrays = {name: np.asarray(values) for name, values in self.arrays.items()}
        length = next(iter(arrays.values())).shape[:1]
        for name, values in arrays.items():
            if values.dtype.kind not in "buif" or not length or values.shape[:1] != length or not values.size:
                rule = f"must be numbers, with time first and as many frames as the others, {length[0] if length else 0}"
                raise InputError(f"arrays[{name!r}]", value=f"{values.dtype} {values.shape}", rule=rule)
        for name, value in self.facts.items():
            if isinstance(value, bool) or not isinstance(value, str | int | float):
                raise InputError(f"facts[{name!r}]", value=value, rule="must be a text or a number")
        object.__setattr__(self, "arrays", arrays)

    def __len__(self) -> int:
        return len(next(iter(self.arrays.values())))

    @property
    def time(self) -> np.ndarray:
        """Time of every frame since the first [s], (T,)."""
        return np.arange(len(self)) / self.fps


def press_episodes(data: PressDataset, *, fps: float = 30.0) -> Iterator[Episode]:
    """Every press of a data set of videos as an episode.

    A press is slow and has no time of its own: ``fps`` says how fast it is shown. Arrays without a time axis are left out; the object, its
    label, the sensor, the depth and the number of the press are facts.

    Raises:
        InputError: a data set of peaks, or as ``Episode``.
    """
    if data.frames is None:
        rule = "has one frame a press: give its sweep frames_per_stage for videos"
        raise InputError("data set", value=data.folder, rule=rule)
    declared = data.description["arrays"]
    rows = data.manifest.select(["index", "object", "sensor", "press_depth"]).to_pylist()
    for i, row in enumerate(rows):
        sample = data[i]
        arrays = {name: value for name, value in sample.items() if name in declared and "T" in declared[name]["shape"]}
        facts = {"press": row["index"], "object": row["object"], "label": data.classes.index(row["object"])}
        facts |= {"sensor": row["sensor"], "press_depth": row["press_depth"]}
        yield Episode(arrays, fps, f"press the {row['object']} into {row['sensor']}", facts)


def record_episode(
    env: Any,
    policy: Callable[[Any], Any],
    *,
    seed: int | None = None,
    task: str = "",
    fps: float | None = None,
    max_steps: int = 1000,
) -> Episode:
    """Run one episode of a Gymnasium environment, and keep what it gives.

    Frame t holds the observation before step t, under its own names (those of nested dictionaries joined by dots, and ``observation``
    where it is one array), the ``action`` that follows it, and the ``reward``, ``terminated`` and ``truncated`` that come of it, with
    ``success`` where ``info`` has it.

    Args:
        env: with ``reset`` and ``step`` of Gymnasium, such as ``gymnasium.make("raytac/LiftCube-v0")`` or ``AddTactile``.
        policy: function from an observation to an action.
        seed: of ``reset``.
        fps: steps a second; None is ``env.metadata["render_fps"]``.
        max_steps: steps after which the recording stops, if the episode has not ended.

    Raises:
        InputError: no ``fps`` where the environment has none, an observation with one of the names above, or as ``Episode``.
    """
    check_whole("max_steps", max_steps)
    known = getattr(env, "metadata", {}).get("render_fps") if fps is None else fps
    if known is None:
        raise InputError("fps", value=None, rule="must be given: env.metadata has no render_fps")
    kept: list[dict[str, Any]] = []
    observation, _ = env.reset(seed=seed)
    for _ in range(max_steps):
        frame = {name: np.array(value) for name, value in _flat(observation)}
        for name in frame.keys() & {_ACTION, *_ENDS}:
            raise InputError("observation", value=name, rule=f"must not have a name of {(_ACTION, *_ENDS)}")
        action = policy(observation)
        observation, reward, terminated, truncated, info = env.step(action)
        frame |= {_ACTION: np.array(action), "reward": np.float32(reward)}
        frame |= {"terminated": np.bool_(terminated), "truncated": np.bool_(truncated)}
        if "success" in info:
            frame["success"] = np.bool_(info["success"])
        kept.append(frame)
        if terminated or truncated:
            break
    return Episode({name: np.stack([frame[name] for frame in kept]) for name in kept[0]}, float(known), task)


def _flat(observation: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    if not isinstance(observation, Mapping):
        yield prefix or "observation", observation
        return
    for name, value in observation.items():
        yield from _flat(value, f"{prefix}.{name}" if prefix else str(name))
