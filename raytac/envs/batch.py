"""``TaskBatch``: B environments of one task, without Gymnasium: actions in, observations, rewards and ends out."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from raytac.checks import check_known, check_numbers, check_whole
from raytac.envs.steering import ACTIONS, Steering
from raytac.envs.task import Situation, Task
from raytac.envs.variation import VariationDraws
from raytac.errors import InputError
from raytac.gel.surface import COARSEST_PITCH, rounded_envs
from raytac.observe import ArraySpec, ObservationSettings, Randomization, TactileObserver, randomised_bodies
from raytac.physics.base import PhysicsConfig
from raytac.physics.registry import checked_physics, scene_physics
from raytac.robots.pose import pose_error
from raytac.se3 import inverse
from raytac.specs.task import TaskScene
from raytac.specs.task_file import load_task
from raytac.world.world import TactileWorld

__all__ = ["Outcome", "TaskBatch"]

_LENGTH, _SPEED = 0.1, 1.0
"""What positions [m] and speeds [m/s, rad/s] in observations are divided by."""

_PITCH = 0.4e-3
"""Spacing of the gel's nodes where no image asks for less [m]."""


@dataclass(frozen=True)
class Outcome:
    """What a step of B environments came to."""

    observation: dict[str, np.ndarray]
    reward: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    terms: dict[str, np.ndarray]
    success: np.ndarray
    failed: np.ndarray
    """Environments whose physics broke down: truncated, their reward is 0, their observation the last that was sound."""


class TaskBatch:
    """B environments of one task in one ``TactileWorld``.

    Observations are a flat dictionary of arrays (B, …): ``state``, ``goal``, perhaps ``body``, and ``<sensor>_<modality>`` of every sensor.

    Attributes:
        arrays: shape, type and bounds of every observation, of one environment.
        time_s: seconds spent so far in ``physics``, ``observation`` and ``reward``.
    """

    def __init__(
        self,
        task: Task,
        *,
        num_envs: int = 1,
        physics: str | PhysicsConfig | None = None,
        tactile: ObservationSettings | Sequence[str] | str | None = "task",
        body_seen: bool | None = None,
        action: str = "pose",
        randomization: Randomization | None = None,
        max_episode_steps: int | None = None,
        device: str = "auto",
        seed: int = 0,
        scene: str | Path | TaskScene | None = None,
        pitch: float | None = None,
    ) -> None:
        """Compose the world; episodes begin with ``reset``.

        Args:
            task: what is played.
            num_envs: number of environments B.
            physics, device: as of ``TactileWorld``.
            tactile: what is observed of every sensor: settings, or modalities alone; "task" is as the task has it; None leaves touch out,
                and nothing of it is computed.
            body_seen: whether the body's pose and velocity are observed; None is as the task has it.
            action: one of ``ACTIONS``.
            randomization: of sensors, cameras, bodies and mounts; None is none.
            max_episode_steps: after which an episode is truncated; None is as the task has it.
            seed: of what is drawn once a world, and of streams that no ``reset`` has seeded.
            scene: another task scene with the same names in it: name, path or the scene itself.
            pitch: spacing of the grid that the gel's surface is computed on [m]; None is 0.4 mm, or that of the
                images if they are finer.

        Raises:
            InputError: a value out of its choices; as ``TactileWorld``.
        """
        check_known("action", action, ACTIONS)
        steps = task.max_episode_steps if max_episode_steps is None else max_episode_steps
        self.task, self.num_envs, self.max_episode_steps = task, num_envs, check_whole("max_episode_steps", steps)
        settings = _settings(task.tactile if isinstance(tactile, str) and tactile == "task" else tactile)
        loaded = scene if isinstance(scene, TaskScene) else load_task(task.scene if scene is None else scene)
        self.randomization = Randomization() if randomization is None else randomization
        # Without touch the sensor needs no markers: the force alone is asked of the probe.
        asked = ObservationSettings(("wrench",)) if settings is None else settings
        config = scene_physics(checked_physics(physics), loaded)
        rigid = not config.is_simulated
        shared = self.randomization  # what is drawn once for all environments
        if rigid:
            shared = replace(shared, youngs_modulus=0.0, friction=0.0)
        probe = TactileObserver(loaded.robot.sensor, asked, num_envs=num_envs, randomization=shared, seed=seed)
        loaded = replace(loaded, robot=replace(loaded.robot, sensor=probe.sensor))
        if not rigid:
            loaded = randomised_bodies(loaded, self.randomization, seed)
        options: dict[str, Any] = {"outputs": (), "num_envs": num_envs, "seed": seed, "sensor_options": {}}
        if settings is not None:
            options = probe.world_options()
        options["sensor_options"] = {**options["sensor_options"], "pitch": _pitch(probe) if pitch is None else pitch}
        self.world = TactileWorld(loaded, physics=config, device=device, **options)
        self._draws = VariationDraws(
            loaded, self.world.sensor_names, self.randomization, rigid=rigid, num_envs=num_envs, seed=seed
        )
        self.observers: dict[str, TactileObserver] = {}
        if settings is not None:
            quiet = replace(self.randomization, led_power=0.0, led_colour=0.0, reflectance=0.0, youngs_modulus=0.0, friction=0.0)
            for i, name in enumerate(self.world.sensor_names):
                self.observers[name] = TactileObserver(
                    probe.sensor, settings, num_envs=num_envs, randomization=quiet, seed=_own_seed(seed, i)
                )
        self.steering = Steering(self.world, task.motion, action)
        self.body_seen = task.body_seen if body_seen is None else body_seen
        self.arrays = self._arrays()
        state = self.world.state()
        self._tool = self.steering.tool()
        self._start_tool, self._start_body = self._tool[0].copy(), state.world_from_body[task.body][0].copy()
        self._start_pads = {name: poses[0].copy() for name, poses in state.world_from_pad.items()}
        self._body = state.world_from_body[task.body]
        self._speed, self._body_speed = np.zeros((num_envs, 3)), np.zeros((num_envs, 6))
        self._goal = np.zeros((num_envs, 3))
        self._steps = np.zeros(num_envs, int)
        self._action = np.zeros((num_envs, self.steering.size))
        self._begun = np.zeros(num_envs, bool)
        self.time_s = {"physics": 0.0, "observation": 0.0, "reward": 0.0}

    @property
    def control_timestep(self) -> float:
        """Duration of a step [s]."""
        return self.world.scene.control_timestep

    def reseed(self, envs: Sequence[int], seeds: Sequence[int]) -> None:
        """Start the streams of cameras, markers, bodies and mounts of environments anew; the next ``reset`` draws from them."""
        self._draws.reseed(envs, seeds)
        for i, (name, observer) in enumerate(self.observers.items()):
            own = [_own_seed(seed, i) for seed in seeds]
            observer.reseed(envs, own)
            if observer.settings.needs_markers:
                self.world.sensors[name].marker_tracker.reseed(envs, own)

    def reset(self, envs: Sequence[int], rngs: Sequence[np.random.Generator]) -> dict[str, np.ndarray]:
        """Begin episodes in environments, each with a generator of its own; observation (B, …) of all of them."""
        envs = list(envs)
        drawn = [self.task.start(rng, self._start_tool, self._start_body) for rng in rngs]
        names = {name for start in drawn for name in start.bodies}
        bodies = {name: np.stack([start.bodies[name] for start in drawn]) for name in names}
        variation = None if self._draws.is_none else self._draws.draw(envs)
        if variation is not None and self.task.stands_on is not None and self.task.stands_on in variation.mounting:
            # What stands on the pad starts to the pad as it would were that mounted as it is drawn: above a tilted one, tilted too.
            drawn_pad = self._start_pads[self.task.stands_on]
            askew = drawn_pad @ variation.mounting[self.task.stands_on] @ inverse(drawn_pad)
            bodies[self.task.body] = askew @ bodies[self.task.body]
        state = self.world.reset(envs, bodies=bodies, variation=variation)
        for b, start in zip(envs, drawn, strict=True):
            self._goal[b] = start.goal
        self._steps[envs], self._action[envs], self._begun[envs] = 0, 0.0, True
        self.steering.reset(envs)
        for observer in self.observers.values():
            observer.reset(envs)
        self._tool[envs], self._body[envs] = self.steering.tool()[envs], state.world_from_body[self.task.body][envs]
        self._speed[envs], self._body_speed[envs] = 0.0, 0.0
        return self._observe(np.isin(np.arange(self.num_envs), envs))

    def step(self, actions: np.ndarray, unseen: np.ndarray | None = None) -> Outcome:
        """One control step of every environment.

        ``unseen`` (B,): environments that are reset next, so that their sensors are not asked and draw no noise.

        Raises:
            InputError: actions of another shape, outside of [−1, 1] or not finite (the message names the environment), an environment
                that was never reset, or, with simulated pads and one environment, a motion too fast to be resolved near something (it has
                failed then; of several environments the one that moves so is in ``failed``, with a ``RuntimeWarning``).
        """
        actions = self._checked(actions)
        begin = time.perf_counter()
        state = self.world.step(self.steering.controller(actions))
        done = time.perf_counter()
        self.time_s["physics"] += done - begin
        failed = state.failed
        sound = ~failed[:, None]
        tool, body = self.steering.tool(), state.world_from_body[self.task.body]
        dt = self.control_timestep
        # What has failed stays as it was.
        tool, body = (np.where(sound[..., None], now, was) for now, was in ((tool, self._tool), (body, self._body)))
        self._speed, self._body_speed = (tool[:, :3, 3] - self._tool[:, :3, 3]) / dt, _twist(self._body, body, dt)
        self._tool, self._body = tool, body
        last, self._action = self._action, actions
        self._steps += 1
        now = Situation(
            self._tool, self._speed, self._body, self._body_speed, self._goal,
            {name: np.nan_to_num(w) for name, w in state.wrench.items()},
            np.where(sound, self.steering.joint_speed(), 0.0), actions, last,
        )  # fmt: skip
        judged = time.perf_counter()
        observation = self._observe(np.ones(self.num_envs, bool) if unseen is None else ~unseen)
        failed = self.world.failed  # also what only the surface shows
        self.time_s["observation"] += time.perf_counter() - judged
        judged = time.perf_counter()
        verdict = self.task.judge(now)
        terms = {name: np.where(failed, 0.0, np.asarray(term, float)) for name, term in verdict.terms.items()}
        reward = np.sum(list(terms.values()), axis=0)
        terminated = verdict.terminated & ~failed
        truncated = (failed | (self._steps >= self.max_episode_steps)) & ~terminated
        self.time_s["reward"] += time.perf_counter() - judged
        return Outcome(observation, reward, terminated, truncated, terms, verdict.success & ~failed, failed)

    # --- observations ----------------------------------------------------------------------------------------------------------

    def _arrays(self) -> dict[str, ArraySpec]:
        sizes = {"state": 9 + len(self.steering.opening_range) // 2 + self.steering.size, "goal": 3}
        if self.body_seen:
            sizes["body"] = 15
        found = {name: ArraySpec((n,), np.float32, -np.inf, np.inf) for name, n in sizes.items()}
        for name, observer in self.observers.items():
            found |= {f"{name}_{modality}": spec for modality, spec in observer.arrays.items()}
        return found

    def _observe(self, which: np.ndarray) -> dict[str, np.ndarray]:
        """Observations of all; the sensors of environments not in ``which`` (B,) are not asked and keep what they gave last."""
        tool, body, goal = self._tool, self._body, self._goal
        at, turn = tool[:, :3, 3], pose_error(tool, self._start_tool)[:, 3:]
        parts = [
            (at - self._start_tool[:3, 3]) / _LENGTH,
            turn,
            self._speed / _SPEED,
            self.steering.opening() / _LENGTH,
            self._action,
        ]
        found = {"state": np.concatenate(parts, axis=1), "goal": (goal - at) / _LENGTH}
        if self.body_seen:
            axes = np.swapaxes(body[:, :3, :2], 1, 2).reshape(-1, 6)
            found["body"] = np.concatenate([(body[:, :3, 3] - at) / _LENGTH, axes, self._body_speed / _SPEED], axis=1)
        found = {name: values.astype(np.float32) for name, values in found.items()}
        rows = None if which.all() else rounded_envs(np.flatnonzero(which).tolist(), self.num_envs)
        looked = any(observer.settings.needs_frames for observer in self.observers.values())
        frames = self.world.observe(envs=rows) if looked and which.any() else {}
        state = self.world.state() if self.observers and not looked else None
        for name, observer in self.observers.items():
            sensor = self.world.sensors[name] if observer.settings.difference else None
            if state is not None:
                seen = observer.observe_wrench(state.wrench[name], state.failed, which)
            else:
                seen = observer.observe(frames[name], sensor, rows) if frames else observer.last()
            found |= {f"{name}_{modality}": values for modality, values in seen.items()}
        return found

    def _checked(self, actions: np.ndarray) -> np.ndarray:
        values = check_numbers("actions", actions, (self.num_envs, self.steering.size))
        wrong = ~np.isfinite(values) | (np.abs(values) > 1.0 + 1e-6)
        if wrong.any():
            env, axis = (int(i) for i in np.argwhere(wrong)[0])
            rule = f"must be finite and in [-1, 1]; in environment {env}, component {axis} is not"
            raise InputError("actions", value=float(values[env, axis]), rule=rule)
        if not self._begun.all():
            env = int(np.flatnonzero(~self._begun)[0])
            raise InputError("environment", value=env, rule="must be reset before it is stepped")
        return np.clip(values, -1.0, 1.0)


def _own_seed(seed: int, sensor: int) -> int:
    """Of a sensor of an environment. Environments of a vector have seeds in sequence, so a sensor's must not be the next environment's."""
    return seed + (sensor << 64)


def _pitch(observer: TactileObserver) -> float:
    """As fine as the images, where there are any, between the sensor's own limit and ``_PITCH``."""
    if "rgb" not in observer.settings.modalities:
        return _PITCH
    return max(COARSEST_PITCH, min(_PITCH, *observer.sensor.camera.pitch_at(observer.layout.rendered)))


def _settings(tactile: ObservationSettings | Sequence[str] | str | None) -> ObservationSettings | None:
    if tactile is None or isinstance(tactile, ObservationSettings):
        return tactile
    return ObservationSettings((tactile,) if isinstance(tactile, str) else tuple(tactile))


def _twist(before: np.ndarray, after: np.ndarray, dt: float) -> np.ndarray:
    """Velocity and angular velocity (B, 6) between poses (B, 4, 4)."""
    return pose_error(after, before) / dt
