"""``TaskBatch``: B environments of one task without Gymnasium, from actions to rewards."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypedDict

import numpy as np

from raytac.checks import check_known, check_numbers, check_whole
from raytac.device import resolve_device
from raytac.envs.action_control import ACTIONS, ActionControl
from raytac.envs.task_observation import observation_arrays
from raytac.envs.task_progress import TaskProgress
from raytac.envs.task_rules import Task
from raytac.envs.task_sensors import TaskSensors, sensor_seed
from raytac.envs.variations import VariationRanges, VariationSampler, on_mounted_pad
from raytac.errors import InputError
from raytac.gel.surface import rounded_envs
from raytac.observe import ObservationSettings, Randomization
from raytac.optics.base import OPTICAL_OUTPUTS
from raytac.physics.base import PhysicsConfig
from raytac.physics.registry import checked_physics
from raytac.robots.pose_errors import PoseErrors
from raytac.specs.task import TaskScene
from raytac.world.world import TactileWorld
from raytac.world.world_state import WorldState


@dataclass(frozen=True)
class StepResult:
    """Result of a step of B environments; every array has the shape (B,) or (B, …)."""

    observation: dict[str, np.ndarray]
    reward: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    terms: dict[str, np.ndarray]
    """Terms of the reward by name."""
    success: np.ndarray
    failed: np.ndarray
    """Environments whose physics broke down: truncated, reward 0, last sound observation."""


class TaskOptions(TypedDict, total=False):
    """Keyword arguments of ``TaskBatch`` but ``num_envs``, which environments take too."""

    physics: str | PhysicsConfig | None
    tactile: ObservationSettings | Sequence[str] | str | None
    body_seen: bool | None
    action: str
    randomization: Randomization | None
    max_episode_steps: int | None
    device: str
    seed: int
    scene: str | Path | TaskScene | None
    pitch: float | None


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
        """Compose the world; ``reset`` begins the episodes.

        Args:
            physics, device: as of ``TactileWorld``.
            tactile: observation of every sensor: settings, or modalities alone; "task" takes those of the task; with None no sensor is
                read and nothing of it is computed.
            body_seen: observe the body's pose and velocity; None takes the task's default.
            action: one of ``ACTIONS``.
            randomization: of sensors, cameras, bodies and mounts; None is none.
            max_episode_steps: length at which an episode is truncated; None takes the task's.
            seed: of what is drawn once for the world, and of random streams that no ``reseed`` has set.
            scene: another task scene with the same names in it: name, path or the scene itself.
            pitch: spacing of the grid of the gel's surface [m]; None is 0.4 mm, or that of the images if they are finer.

        Raises:
            InputError: a value out of its choices; as ``TactileWorld``.
        """
        check_known("action", action, ACTIONS)
        steps = task.max_episode_steps if max_episode_steps is None else max_episode_steps
        self.task, self.num_envs, self.max_episode_steps = task, num_envs, check_whole("max_episode_steps", steps)
        given = {"physics": checked_physics(physics), "scene": scene, "randomization": randomization}
        sensors = TaskSensors.of(task, tactile, **given, num_envs=num_envs, seed=seed)
        self.randomization = sensors.randomization
        options: dict[str, Any] = {"outputs": (), "num_envs": num_envs, "seed": seed}
        if sensors.settings is not None:
            options = sensors.probe.sensor_options()
        options["pitch"] = sensors.pitch if pitch is None else pitch
        self.world = TactileWorld(sensors.scene, physics=sensors.physics, device=device, **options)
        if set(options["outputs"]) & set(OPTICAL_OUTPUTS) and resolve_device(device) == "cpu":
            from raytac.optics.runtime import share_cores

            share_cores()
        names, rigid = self.world.sensor_names, not sensors.physics.is_simulated
        ranges = VariationRanges(sensors.scene, names, sensors.randomization, rigid=rigid)
        self._variations = VariationSampler(ranges, num_envs=num_envs, seed=seed)
        self.observers = sensors.observers(names)
        self.control = ActionControl(self.world, task.motion, action)
        self.body_seen = task.body_seen if body_seen is None else body_seen
        size = self.control.size
        has_grip = bool(self.control.opening_range)
        self.arrays = observation_arrays(size, has_grip=has_grip, body_seen=self.body_seen, observers=self.observers)
        state, now = self.world.state(), self.control.state()
        self._opening = now.opening
        self._start_pads = {name: poses[0].copy() for name, poses in state.world_from_pad.items()}
        body, steps, errors = state.world_from_body[task.body], np.zeros(num_envs, int), PoseErrors(num_envs, 2)
        self._progress = TaskProgress(task, now.tool, body, steps, actions=size, duration=self.control_timestep, errors=errors)
        self._begun = np.zeros(num_envs, bool)
        self.time_s = {"physics": 0.0, "observation": 0.0, "reward": 0.0}

    @property
    def control_timestep(self) -> float:
        """Duration of a step [s]."""
        return self.world.composed.control_timestep

    # --- state, for policies that are written by hand ---------------------------------------------------------------------------

    @property
    def start_tool(self) -> np.ndarray:
        """Pose (4, 4) of the tool in the scene."""
        return self._progress.start_tool

    @property
    def start_body(self) -> np.ndarray:
        """Pose (4, 4) of the task's body in the scene."""
        return self._progress.start_body

    @property
    def tool(self) -> np.ndarray:
        """Poses (B, 4, 4) of the tool after the last step; a failed environment keeps its last."""
        return self._progress.tool.copy()

    @property
    def body(self) -> np.ndarray:
        """Poses (B, 4, 4) of the task's body after the last step."""
        return self._progress.body.copy()

    @property
    def body_speed(self) -> np.ndarray:
        """Mean velocity [m/s] and angular velocity [rad/s] of the body over the last step, (B, 6)."""
        return self._progress.body_speed.copy()

    @property
    def goal(self) -> np.ndarray:
        """Goal positions (B, 3) [m]."""
        return self._progress.goal.copy()

    @property
    def action(self) -> np.ndarray:
        """Last actions (B, k); 0 after a reset."""
        return self._progress.action.copy()

    @property
    def target(self) -> np.ndarray:
        """Target poses (B, 4, 4) that the tool follows, with ``action="pose"``."""
        return self.control.target

    # --- episodes --------------------------------------------------------------------------------------------------------------

    def reseed(self, envs: Sequence[int], seeds: Sequence[int]) -> None:
        """Seed the streams of cameras, grain, markers, bodies and mounts for the next ``reset``."""
        self._variations.reseed(envs, seeds)
        for i, (name, observer) in enumerate(self.observers.items()):
            sensor_seeds = [sensor_seed(seed, i) for seed in seeds]
            observer.reseed(envs, sensor_seeds)
            if observer.settings.needs_markers:
                self.world.sensors[name].marker_tracker.reseed(envs, sensor_seeds)
            if observer.settings.noise:
                self.world.sensors[name].reseed_noise(envs, sensor_seeds)

    def reset(self, envs: Sequence[int], rngs: Sequence[np.random.Generator]) -> dict[str, np.ndarray]:
        """Begin episodes in ``envs``, each with its generator; returns all observations (B, …)."""
        envs = list(envs)
        u = np.array([rng.random(self.task.draws) for _, rng in zip(envs, rngs, strict=True)]).reshape(len(envs), self.task.draws)
        starts = self.task.starts(u, self.start_tool, self.start_body)
        bodies, pad = dict(starts.bodies), self.task.stands_on
        variation = None if self._variations.ranges.is_none else self._variations.draw(envs)
        if variation is not None and pad is not None and pad in variation.mounting:
            bodies = on_mounted_pad(self.task.body, bodies, self._start_pads[pad], variation.mounting[pad])
        state = self.world.reset(envs, bodies=bodies, variation=variation)
        self._begun[envs] = True
        self.control.reset(envs)
        for observer in self.observers.values():
            observer.reset(envs)
        now, goal, mask = self.control.state(), self._progress.goal.copy(), np.isin(np.arange(self.num_envs), envs)
        self._opening, goal[envs] = now.opening, starts.goal
        self._progress.begin(mask, now.tool, state.world_from_body[self.task.body], goal)
        return self._observe(mask, state)

    def step(self, actions: np.ndarray, unseen: np.ndarray | None = None) -> StepResult:
        """One control step of every environment.

        ``unseen`` (B,): environments that are reset next: their sensors are not read and draw no noise.

        Raises:
            InputError: actions of another shape, outside of [−1, 1] or not finite (the message names the environment); an environment
                that was never reset; with soft pads and one environment, a motion too fast to be resolved near a contact. Of several
                environments the one that moves so fast is marked in ``failed``, with a ``RuntimeWarning``.
        """
        actions = self._checked(actions)
        start = time.perf_counter()
        state = self.world.step(self.control.controller(actions))
        done = time.perf_counter()
        self.time_s["physics"] += done - start
        failed = state.failed
        now, body, wrench = self.control.state(), state.world_from_body[self.task.body], state.wrench
        tool, joint_speed, opening, self._opening = now.tool, now.speed, self._opening, now.opening
        if failed.any():
            # An environment that failed keeps its last poses and opening.
            tool[failed], body[failed], joint_speed[failed] = self.tool[failed], self.body[failed], 0.0
            self._opening[failed] = opening[failed]
            wrench = {name: np.nan_to_num(values) for name, values in wrench.items()}
        self._progress.advance(tool, body, actions)
        judged = time.perf_counter()
        observation = self._observe(np.ones(self.num_envs, bool) if unseen is None else ~unseen, state)
        failed = self.world.failed  # includes failures that only the pad's surface shows
        self.time_s["observation"] += time.perf_counter() - judged
        judged = time.perf_counter()
        end = self._progress.outcome(wrench, self._opening, joint_speed, failed, self.max_episode_steps)
        self.time_s["reward"] += time.perf_counter() - judged
        return StepResult(observation, end.reward, end.terminated, end.truncated, end.terms, end.success, failed)

    # --- observations ----------------------------------------------------------------------------------------------------------

    def _observe(self, which: np.ndarray, state: WorldState) -> dict[str, np.ndarray]:
        """Observations of all environments; sensors are read in those of ``which`` (B,).

        The others keep their last reading. ``state``: present state of the world.
        """
        result = self._progress.observation(self._opening)
        if self.body_seen:
            result["body"] = self._progress.body_observation()
        rows = None if which.all() else rounded_envs(np.flatnonzero(which).tolist(), self.num_envs)
        needs_frames = any(observer.settings.needs_frames for observer in self.observers.values())
        frames = self.world.observe(envs=rows) if needs_frames and which.any() else {}
        for name, observer in self.observers.items():
            sensor = self.world.sensors[name] if observer.settings.difference else None
            if not needs_frames:
                values = observer.observe_wrench(state.wrench[name], state.failed, which)
            else:
                values = observer.observe(frames[name], sensor, rows) if frames else observer.last()
            result |= {f"{name}_{modality}": array for modality, array in values.items()}
        return result

    def _checked(self, actions: np.ndarray) -> np.ndarray:
        values = check_numbers("actions", actions, (self.num_envs, self.control.size))
        right = np.abs(values) <= 1.0 + 1e-6  # not of NaN
        if not right.all():
            env, axis = (int(i) for i in np.argwhere(~right)[0])
            rule = f"must be finite and in [-1, 1]; in environment {env}, component {axis} is not"
            raise InputError("actions", value=float(values[env, axis]), rule=rule)
        if not self._begun.all():
            env = int(np.flatnonzero(~self._begun)[0])
            raise InputError("environment", value=env, rule="must be reset before it is stepped")
        return np.minimum(np.maximum(values, -1.0), 1.0)
