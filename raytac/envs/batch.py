"""``TaskBatch``: B environments of one task without Gymnasium, from actions to rewards."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from raytac.checks import check_known, check_numbers, check_whole
from raytac.envs.action_control import ACTIONS, ActionControl
from raytac.envs.task_observation import body_from_tool, state_and_goal
from raytac.envs.task_outcome import task_outcome
from raytac.envs.task_rules import Task, TaskState
from raytac.errors import InputError
from raytac.gel.surface import COARSEST_PITCH, rounded_envs
from raytac.observe import ArraySpec, ObservationSettings, Randomization, TactileObserver, randomised_bodies
from raytac.physics.base import PhysicsConfig
from raytac.physics.registry import checked_physics, scene_physics
from raytac.robots.pose_errors import PoseErrors
from raytac.se3 import inverse, rotations
from raytac.specs.task import TaskScene
from raytac.specs.task_file import load_task
from raytac.world.environment_models import Variation
from raytac.world.world import TactileWorld
from raytac.world.world_state import WorldState

_PITCH = 0.4e-3
"""Spacing of the gel's nodes where no image needs a finer one [m]."""


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


class TaskBatch:
    """B environments of one task in one ``TactileWorld``.

    Observations are a flat dictionary of arrays (B, …): ``state``, ``goal``, perhaps ``body``, and ``<sensor>_<modality>`` of every sensor.

    Attributes:
        arrays: shape, type and bounds of every observation, of one environment.
        start_tool, start_body: poses (4, 4) of the tool and of the task's body in the scene.
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
            task: the task.
            num_envs: number of environments B.
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
        settings = task_settings(task.tactile if isinstance(tactile, str) and tactile == "task" else tactile)
        loaded = scene if isinstance(scene, TaskScene) else load_task(task.scene if scene is None else scene)
        self.randomization = Randomization() if randomization is None else randomization
        # Without touch the probe gives the force alone, so that the sensor needs no markers.
        probed = ObservationSettings(("wrench",)) if settings is None else settings
        config = scene_physics(checked_physics(physics), loaded)
        rigid = not config.is_simulated
        shared = self.randomization  # drawn once for all environments
        if rigid:
            shared = replace(shared, youngs_modulus=0.0, friction=0.0)
        probe = TactileObserver(loaded.robot.sensor, probed, num_envs=num_envs, randomization=shared, seed=seed)
        loaded = replace(loaded, robot=replace(loaded.robot, sensor=probe.sensor))
        if not rigid:
            loaded = randomised_bodies(loaded, self.randomization, seed)
        options: dict[str, Any] = {"outputs": (), "num_envs": num_envs, "seed": seed}
        if settings is not None:
            options = probe.sensor_options()
        options["pitch"] = task_pitch(probe) if pitch is None else pitch
        self.world = TactileWorld(loaded, physics=config, device=device, **options)
        self._variations = VariationSampler(
            loaded, self.world.sensor_names, self.randomization, rigid=rigid, num_envs=num_envs, seed=seed
        )
        self.observers: dict[str, TactileObserver] = {}
        if settings is not None:
            per_episode = replace(
                self.randomization, led_power=0.0, led_colour=0.0, reflectance=0.0, youngs_modulus=0.0, friction=0.0
            )
            for i, name in enumerate(self.world.sensor_names):
                self.observers[name] = TactileObserver(
                    probe.sensor, settings, num_envs=num_envs, randomization=per_episode, seed=_sensor_seed(seed, i)
                )
        self.control = ActionControl(self.world, task.motion, action)
        self.body_seen = task.body_seen if body_seen is None else body_seen
        self.arrays = self._arrays()
        state, now = self.world.state(), self.control.state()
        self._tool, self._opening = now.tool, now.opening
        self.start_tool, self.start_body = self._tool[0].copy(), state.world_from_body[task.body][0].copy()
        self._start_pads = {name: poses[0].copy() for name, poses in state.world_from_pad.items()}
        self._body = state.world_from_body[task.body]
        self._speed, self._body_speed = np.zeros((num_envs, 3)), np.zeros((num_envs, 6))
        self._errors = PoseErrors(num_envs, 2)
        self._turn = np.zeros((num_envs, 3))  # of the tool from the start
        self._goal = np.zeros((num_envs, 3))
        self._steps = np.zeros(num_envs, int)
        self._action = np.zeros((num_envs, self.control.size))
        self._begun = np.zeros(num_envs, bool)
        self.time_s = {"physics": 0.0, "observation": 0.0, "reward": 0.0}

    @property
    def control_timestep(self) -> float:
        """Duration of a step [s]."""
        return self.world.composed.control_timestep

    # --- state, for policies that are written by hand ---------------------------------------------------------------------------

    @property
    def tool(self) -> np.ndarray:
        """Poses (B, 4, 4) of the tool after the last step; a failed environment keeps its last."""
        return self._tool.copy()

    @property
    def body(self) -> np.ndarray:
        """Poses (B, 4, 4) of the task's body after the last step."""
        return self._body.copy()

    @property
    def body_speed(self) -> np.ndarray:
        """Mean velocity [m/s] and angular velocity [rad/s] of the body over the last step, (B, 6)."""
        return self._body_speed.copy()

    @property
    def goal(self) -> np.ndarray:
        """Goal positions (B, 3) [m]."""
        return self._goal.copy()

    @property
    def action(self) -> np.ndarray:
        """Last actions (B, k); 0 after a reset."""
        return self._action.copy()

    @property
    def target(self) -> np.ndarray:
        """Target poses (B, 4, 4) that the tool follows, with ``action="pose"``."""
        return self.control.target

    # --- episodes --------------------------------------------------------------------------------------------------------------

    def reseed(self, envs: Sequence[int], seeds: Sequence[int]) -> None:
        """Seed the streams of cameras, markers, bodies and mounts for the next ``reset``."""
        self._variations.reseed(envs, seeds)
        for i, (name, observer) in enumerate(self.observers.items()):
            sensor_seeds = [_sensor_seed(seed, i) for seed in seeds]
            observer.reseed(envs, sensor_seeds)
            if observer.settings.needs_markers:
                self.world.sensors[name].marker_tracker.reseed(envs, sensor_seeds)

    def reset(self, envs: Sequence[int], rngs: Sequence[np.random.Generator]) -> dict[str, np.ndarray]:
        """Begin episodes in ``envs``, each with its generator; returns all observations (B, …)."""
        envs = list(envs)
        u = np.array([rng.random(self.task.draws) for _, rng in zip(envs, rngs, strict=True)]).reshape(len(envs), self.task.draws)
        starts = self.task.starts(u, self.start_tool, self.start_body)
        bodies = dict(starts.bodies)
        variation = None if self._variations.is_none else self._variations.draw(envs)
        if variation is not None and self.task.stands_on is not None and self.task.stands_on in variation.mounting:
            # A body that stands on the pad keeps its pose relative to the pad, so it is shifted and tilted with the pad's mounting.
            nominal = self._start_pads[self.task.stands_on]
            shift = nominal @ variation.mounting[self.task.stands_on] @ inverse(nominal)
            bodies[self.task.body] = shift @ bodies[self.task.body]
        state = self.world.reset(envs, bodies=bodies, variation=variation)
        self._goal[envs] = starts.goal
        self._steps[envs], self._action[envs], self._begun[envs] = 0, 0.0, True
        self.control.reset(envs)
        for observer in self.observers.values():
            observer.reset(envs)
        now = self.control.state()
        self._opening = now.opening
        self._tool[envs], self._body[envs] = now.tool[envs], state.world_from_body[self.task.body][envs]
        self._speed[envs], self._body_speed[envs] = 0.0, 0.0
        self._turn = self._errors((self._tool, self.start_tool))[0, :, 3:]
        return self._observe(np.isin(np.arange(self.num_envs), envs), state)

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
            tool[failed], body[failed], joint_speed[failed] = self._tool[failed], self._body[failed], 0.0
            self._opening[failed] = opening[failed]
            wrench = {name: np.nan_to_num(values) for name, values in wrench.items()}
        dt = self.control_timestep
        moved, turned = self._errors((body, self._body), (tool, self.start_tool))
        self._speed, self._body_speed, self._turn = (tool[:, :3, 3] - self._tool[:, :3, 3]) / dt, moved / dt, turned[:, 3:]
        self._tool, self._body = tool, body
        last, self._action = self._action, actions
        self._steps += 1
        task_state = TaskState(
            tool=self._tool,
            speed=self._speed,
            body=self._body,
            body_speed=self._body_speed,
            goal=self._goal,
            wrench=wrench,
            opening=self._opening,
            joint_speed=joint_speed,
            action=actions,
            last_action=last,
        )
        judged = time.perf_counter()
        observation = self._observe(np.ones(self.num_envs, bool) if unseen is None else ~unseen, state)
        failed = self.world.failed  # includes failures that only the pad's surface shows
        self.time_s["observation"] += time.perf_counter() - judged
        judged = time.perf_counter()
        end = task_outcome(self.task, task_state, self._steps, self.max_episode_steps, failed)
        self.time_s["reward"] += time.perf_counter() - judged
        return StepResult(observation, end.reward, end.terminated, end.truncated, end.terms, end.success, failed)

    # --- observations ----------------------------------------------------------------------------------------------------------

    def _arrays(self) -> dict[str, ArraySpec]:
        sizes = {"state": 9 + len(self.control.opening_range) // 2 + self.control.size, "goal": 3}
        if self.body_seen:
            sizes["body"] = 15
        specs = {name: ArraySpec((n,), np.float32, -np.inf, np.inf) for name, n in sizes.items()}
        for name, observer in self.observers.items():
            specs |= {f"{name}_{modality}": spec for modality, spec in observer.arrays.items()}
        return specs

    def _observe(self, which: np.ndarray, state: WorldState) -> dict[str, np.ndarray]:
        """Observations of all environments; sensors are read in those of ``which`` (B,).

        The others keep their last reading. ``state``: present state of the world.
        """
        result = state_and_goal(self._tool, self.start_tool, self._turn, self._speed, self._opening, self._action, self._goal)
        if self.body_seen:
            result["body"] = body_from_tool(self._tool, self._body, self._body_speed)
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
        wrong = ~np.isfinite(values) | (np.abs(values) > 1.0 + 1e-6)
        if wrong.any():
            env, axis = (int(i) for i in np.argwhere(wrong)[0])
            rule = f"must be finite and in [-1, 1]; in environment {env}, component {axis} is not"
            raise InputError("actions", value=float(values[env, axis]), rule=rule)
        if not self._begun.all():
            env = int(np.flatnonzero(~self._begun)[0])
            raise InputError("environment", value=env, rule="must be reset before it is stepped")
        return np.minimum(np.maximum(values, -1.0), 1.0)


def _sensor_seed(seed: int, sensor: int) -> int:
    """Seed of an environment's sensor; never a neighbour's, whose seed is the next number."""
    return seed + (sensor << 64)


def task_pitch(observer: TactileObserver) -> float:
    """Pitch [m] as fine as images, if any, between the coarsest allowed and ``_PITCH``."""
    if "rgb" not in observer.settings.modalities:
        return _PITCH
    return max(COARSEST_PITCH, min(_PITCH, *observer.sensor.camera.pitch_at(observer.layout.rendered)))


def task_settings(tactile: ObservationSettings | Sequence[str] | str | None) -> ObservationSettings | None:
    if tactile is None or isinstance(tactile, ObservationSettings):
        return tactile
    return ObservationSettings((tactile,) if isinstance(tactile, str) else tuple(tactile))


class VariationSampler:
    """Seeded variations of B environments, one stream each: draws do not depend on B."""

    def __init__(
        self,
        scene: TaskScene,
        sensors: Sequence[str],
        randomization: Randomization,
        *,
        rigid: bool,
        num_envs: int = 1,
        seed: int = 0,
    ) -> None:
        """Seed the streams; draw nothing yet.

        Args:
            scene: scene whose bodies vary.
            sensors: names of the sensors whose mounting varies.
            randomization: half widths; ``body_mass``, ``body_friction``, ``youngs_modulus``, ``friction``, ``pad_shift`` and ``pad_turn``
                of it are used.
            rigid: pads are rigid. Soft pads and the bodies among them are the same in all environments, so that only their mounting is
                drawn.
            num_envs: number of environments B.
            seed: environment b begins with seed + b.
        """
        self._randomization, self._sensors = randomization, tuple(sensors)
        self._bodies_differ, self._gels_differ = rigid and randomization.changes_bodies, rigid and randomization.changes_gel
        self._masses = [body.name for body in scene.bodies if body.dynamics == "free"]
        self._frictions = [body.name for body in scene.bodies]
        self.is_none = not (self._bodies_differ or self._gels_differ or randomization.changes_mounting)
        """True if nothing varies."""
        self._streams = [_stream(seed + b) for b in range(num_envs)]

    def reseed(self, envs: Sequence[int], seeds: Sequence[int]) -> None:
        """Seed the streams of environments."""
        for b, seed in zip(envs, seeds, strict=True):
            self._streams[b] = _stream(seed)

    def draw(self, envs: Sequence[int]) -> Variation:
        """Draw a variation of the environments named, one row each."""
        r = self._randomization
        # The number and order of draws does not depend on the widths, so that a width of 0 changes nothing else.
        count = len(self._masses) + len(self._frictions) + 8 * len(self._sensors)
        u = np.array([self._streams[b].uniform(-1.0, 1.0, count) for b in envs]).reshape(len(envs), count)
        mass, friction, mounting = np.split(u, np.cumsum([len(self._masses), len(self._frictions)]), axis=1)
        poses = np.repeat(np.eye(4)[None], len(envs) * len(self._sensors), axis=0).reshape(len(envs), -1, 4, 4)
        mounting, gel = np.split(mounting.reshape(len(envs), -1, 8), [6], axis=2)
        poses[..., :3, 3] = r.pad_shift * mounting[..., :3]
        poses[..., :3, :3] = rotations(r.pad_turn * mounting[..., 3:])
        factors: dict[str, dict[str, np.ndarray]] = {}
        if self._bodies_differ:
            factors["mass"] = {name: 1.0 + r.body_mass * mass[:, i] for i, name in enumerate(self._masses)}
            factors["friction"] = {name: 1.0 + r.body_friction * friction[:, i] for i, name in enumerate(self._frictions)}
        if self._gels_differ:
            factors["gel_stiffness"] = {name: 1.0 + r.youngs_modulus * gel[:, i, 0] for i, name in enumerate(self._sensors)}
            factors["gel_friction"] = {name: 1.0 + r.friction * gel[:, i, 1] for i, name in enumerate(self._sensors)}
        if r.changes_mounting:
            factors["mounting"] = {name: poses[:, i] for i, name in enumerate(self._sensors)}
        return Variation(**factors)


def _stream(seed: int) -> np.random.Generator:
    return np.random.default_rng((seed, 0xB0D1))
