"""``WarpBatch``: B environments of one task on MuJoCo Warp, all on one device."""

# pyright: reportMissingImports=false
# (PyTorch belongs to the extra "rl", which the tests do without.)

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch
import warp as wp

from raytac.checks import check_whole
from raytac.envs.action_targets import ToolTargets
from raytac.envs.task_observation import observation_arrays
from raytac.envs.task_progress import TaskProgress
from raytac.envs.task_rules import Starts, Task
from raytac.envs.task_sensors import TaskSensors
from raytac.envs.variations import VariationRanges, on_mounted_pad
from raytac.envs.warp_touch import WarpTouch
from raytac.errors import InputError
from raytac.observe import ObservationSettings, Randomization
from raytac.physics.registry import checked_physics
from raytac.robots.pose_errors import PoseErrors
from raytac.specs.task import TaskScene
from raytac.world.device_variation import DeviceVariation
from raytac.world.environment_models import Variation
from raytac.world.warp_world import WarpWorld


@dataclass(frozen=True)
class WarpStep:
    """Result of a step of B environments; tensors (B,) or (B, …)."""

    observation: dict[str, torch.Tensor]
    """The first one of an episode that has begun in this step."""
    reward: torch.Tensor
    terminated: torch.Tensor
    truncated: torch.Tensor
    terms: dict[str, torch.Tensor]
    """Terms of the reward by name."""
    success: torch.Tensor
    failed: torch.Tensor
    """Environments whose physics broke down: truncated, with reward 0."""
    final: dict[str, torch.Tensor] | None = None
    """Observation before episodes begin, if it was asked for."""


class WarpBatch:
    """B environments of one task.

    .. code-block:: python

        batch = WarpBatch(PushCube(), num_envs=4096, device="cuda")
        observation = batch.reset()
        step = batch.step(policy(observation))

    Rewards, ends, starts, variations, targets and observations are those of ``TaskBatch``. All is drawn from one generator of the device,
    for every environment in every step, so that no draw depends on which of them begin. Nothing in a step waits for the device, but for
    images, which another library renders.

    Attributes:
        world: the worlds.
        task, num_envs, max_episode_steps, body_seen, arrays: as of ``TaskBatch``.
        device: of all tensors.
        size: of an action.
        body_observation: pose and velocity of the body (B, 15) as they are observed if ``body_seen``; for a critic they always are.
    """

    def __init__(
        self,
        task: Task,
        *,
        num_envs: int = 1,
        tactile: ObservationSettings | Sequence[str] | str | None = "task",
        body_seen: bool | None = None,
        randomization: Randomization | None = None,
        max_episode_steps: int | None = None,
        device: str = "auto",
        seed: int = 0,
        scene: str | Path | TaskScene | None = None,
        pitch: float | None = None,
        launches: int | None = None,
        contacts: int | None = None,
        rows: int | None = None,
        patches: int = 16,
    ) -> None:
        """Make the worlds; ``reset`` begins the episodes.

        Args:
            task, num_envs, tactile, body_seen, randomization, max_episode_steps, seed, scene, pitch: as of ``TaskBatch``.
            device, launches, contacts, rows: as of ``WarpWorld``.
            patches: most separate contacts of a pad, for its markers; more are an error of ``check``.

        Raises:
            InputError: a value out of its choices; as ``WarpWorld`` and ``WarpTouch``.
        """
        length = task.max_episode_steps if max_episode_steps is None else max_episode_steps
        self.task, self.num_envs, self.max_episode_steps = task, num_envs, check_whole("max_episode_steps", length)
        sensors = TaskSensors.of(
            task,
            tactile,
            physics=checked_physics("rigid"),
            scene=scene,
            randomization=randomization,
            num_envs=num_envs,
            seed=seed,
        )
        loaded, frequency = sensors.scene, task.motion.frequency
        self.world = world = WarpWorld(
            loaded, num_envs=num_envs, device=device, frequency=frequency, launches=launches, contacts=contacts, rows=rows
        )
        self.device = torch.device(wp.device_to_torch(world.engine.device))
        self._generator = torch.Generator(self.device)
        self._generator.manual_seed(seed)
        self._names = [mounted.name for mounted in world.composed.sensors]
        observers, grid = sensors.observers(self._names), sensors.pitch if pitch is None else pitch
        self.touch = None
        if observers:
            self.touch = WarpTouch(world, observers, pitch=grid, patches=patches, generator=self._generator)
        self.body_seen = task.body_seen if body_seen is None else body_seen
        self._state = {name: wp.to_torch(array) for name, array in world.state.items()}
        self._wrenches, self._active = wp.to_torch(world.contact.wrenches), wp.to_torch(world.engine.active)
        self._body_at = list(world.composed.bodies).index(task.body)
        self._ranges = VariationRanges(loaded, self._names, sensors.randomization, rigid=True)
        self._variation = None if self._ranges.is_none else DeviceVariation(world.composed, world.engine, world.contact)
        self._start_pads = self._state["pads"][0].clone()
        opening = world.composed.opening
        self._control = ToolTargets(
            task.motion, self._state["tool"], 0.0 if opening is None else float(world.composed.ctrl[opening])
        )
        self.size = len(task.motion.axes)
        self.arrays = observation_arrays(
            self.size, has_grip=self._control.has_grip, body_seen=self.body_seen, observers=observers
        )
        self._errors = PoseErrors(num_envs, 2, device=str(world.engine.device))
        steps = torch.zeros(num_envs, dtype=torch.int64, device=self.device)
        now, duration = (self._state["tool"], self._body_now(), steps), self.control_timestep
        self._progress = TaskProgress(task, *now, actions=self.size, duration=duration, errors=self._errors)
        # Arrays that the recorded graphs read and write must stay in one place: they are filled and never replaced.
        self._ended = torch.ones(num_envs, dtype=torch.bool, device=self.device)
        self._tool_target, self._tool_twist = wp.to_torch(world.tool_target), wp.to_torch(world.tool_twist)
        self._tool_target.copy_(self._state["tool"])
        self._opening = None if world.opening is None else wp.to_torch(world.opening)
        self._placed = {name: poses.clone() for name, poses in self._draw().bodies.items()}
        self._varied: dict[tuple[str, str], torch.Tensor] = {}
        self._kinds: tuple[str, ...] = ()
        if self._variation is not None:
            drawn = self._draw_variation()
            self._kinds = tuple(name for name in self._variation.names if getattr(drawn, name))
            for kind in self._kinds:
                columns = wp.to_torch(self._variation.arrays[kind])
                self._varied |= {(kind, name): columns[:, k] for k, name in enumerate(self._variation.names[kind])}
            self._vary(drawn)
        ended = wp.from_torch(self._ended, dtype=wp.bool)
        placed = {name: wp.from_torch(poses) for name, poses in self._placed.items()}
        self._begin_graph = self._captured(lambda: self._launch_begin(ended, placed))
        self._step_graph = self._captured(self._launch_step)
        self._look_graph = (lambda: None) if self.touch is None else self._captured(self.touch.launch)
        self._begun = False

    @property
    def control_timestep(self) -> float:
        """Duration of a step [s]."""
        return self.world.composed.control_timestep

    @property
    def steps(self) -> torch.Tensor:
        """Steps since the start of each episode (B,); writing to them ends it as much earlier."""
        return self._progress.steps

    @property
    def start_tool(self) -> torch.Tensor:
        """Pose (4, 4) of the tool in the scene."""
        return self._progress.start_tool

    @property
    def start_body(self) -> torch.Tensor:
        """Pose (4, 4) of the task's body in the scene."""
        return self._progress.start_body

    @property
    def wrench(self) -> dict[str, torch.Tensor]:
        """Wrench (B, 6) on every sensor in the last step, pad frame [N, N m], until the next."""
        return {name: self._wrenches[:, k] for k, name in enumerate(self._names)}

    def reset(self, seed: int | None = None, mask: torch.Tensor | None = None) -> dict[str, torch.Tensor]:
        """Begin episodes and return the observation of all.

        Args:
            seed: makes all that is drawn from now on repeatable.
            mask: environments (B,), bool; None for all. The others keep their last observation of touch.

        Raises ``InputError`` for a mask of another shape or type, and for one that leaves out environments before all have begun once.
        """
        if mask is not None:
            self._check_mask("mask", mask)
            if not self._begun:
                raise InputError("mask", value="given", rule="must be None in the first reset")
        if seed is not None:
            self._generator.manual_seed(seed)
        with self._stream():
            self._begin(torch.ones_like(self._ended) if mask is None else mask.to(self.device))
            self._begun = True
            return self._observe(mask)

    def step(self, actions: torch.Tensor, begin: torch.Tensor | None = None, *, final: bool = False) -> WarpStep:
        """One control step; ``actions`` (B, size) are cut to [−1, 1], and NaN is 0.

        Args:
            actions: of all environments.
            begin: environments (B,), bool, that begin an episode in place of this step, with reward 0; the others go on, ended or not.
                None: episodes begin again in the step in which they end.
            final: observe also what the step led to, before episodes begin: surfaces, markers and images are computed twice.

        Raises:
            InputError: arrays of another shape, or no ``reset`` before.
        """
        if tuple(actions.shape) != (self.num_envs, self.size):
            raise InputError("actions", value=tuple(actions.shape), rule=f"must have shape {(self.num_envs, self.size)}")
        if not self._begun:
            raise InputError("reset", value="not called", rule="must be called before the first step")
        if begin is not None:
            self._check_mask("begin", begin)
        actions = torch.nan_to_num(actions.detach().to(self.device, torch.float64)).clamp(-1.0, 1.0)
        with self._stream():
            self._aim(actions)
            self._step_graph()
            self._progress.advance(self._state["tool"].clone(), self._body_now().clone(), actions)
            if final:
                self._look_graph()
            failed = ~self._active
            end = self._progress.outcome(self.wrench, self._gap(), self._state["speed"], failed, self.max_episode_steps)
            seen = self._observe(~failed) if final else None
            reward, terms = end.reward, end.terms
            terminated, truncated, success = end.terminated, end.truncated, end.success
            began: torch.Tensor = torch.logical_or(terminated, truncated)
            if begin is not None:
                began = begin.to(self.device)
                terms = {name: torch.where(began, 0.0, term) for name, term in terms.items()}
                reward = torch.where(began, 0.0, reward)
                terminated, truncated, success, failed = (one & ~began for one in (terminated, truncated, success, failed))
            self._begin(began)
            observation = self._observe(began if final else began | self._active)
            return WarpStep(observation, reward, terminated, truncated, terms, success, failed, seen)

    def _check_mask(self, name: str, mask: torch.Tensor) -> None:
        if tuple(mask.shape) != (self.num_envs,) or mask.dtype != torch.bool:
            rule = f"must be a mask of {self.num_envs} environments"
            raise InputError(name, value=(tuple(mask.shape), str(mask.dtype)), rule=rule)

    def check(self) -> None:
        """Wait for the device. Raises ``InputError`` if contacts were lost for want of memory."""
        self.world.engine.check_overflow()
        if self.touch is not None:
            self.touch.check()

    # --- parts of a step -------------------------------------------------------------------------------------------------------

    def _aim(self, actions: torch.Tensor) -> None:
        """Move the targets of the tools and of the openings."""
        before = self._control.pose
        self._control.move(actions, self._state["tool"][:, :3, 3])
        self._tool_target.copy_(before)
        self._tool_twist.copy_(self._errors((self._control.pose, before))[0] / self.control_timestep)
        if self._opening is not None:
            self._control.grip(actions)
            self._opening.copy_(self._control.gap[:, None])

    def _begin(self, mask: torch.Tensor) -> None:
        """Begin episodes by a mask (B,) of the device; the host does not know if there are any."""
        self._ended.copy_(mask)
        starts, ended = self._draw(), self._ended
        bodies, pad = starts.bodies, self.task.stands_on
        if self._variation is not None:
            drawn = self._draw_variation()
            self._vary(drawn)
            if pad is not None and pad in drawn.mounting:
                nominal = self._start_pads[self._names.index(pad)]
                bodies = on_mounted_pad(self.task.body, bodies, nominal, drawn.mounting[pad])
        for name, poses in bodies.items():
            self._placed[name].copy_(poses)
        self._begin_graph()
        tool = self._state["tool"]
        self._progress.begin(ended, tool, self._body_now(), starts.goal)
        self._control.begin(ended, tool)
        if self.touch is not None:
            self.touch.begin(ended)

    def _draw(self) -> Starts:
        """Starts of all environments."""
        u = torch.rand(self.num_envs, self.task.draws, generator=self._generator, dtype=torch.float64, device=self.device)
        return self.task.starts(u, self.start_tool, self.start_body)

    def _draw_variation(self) -> Variation:
        """Differences of all environments from the scene."""
        shape = self.num_envs, self._ranges.count
        u = torch.rand(shape, generator=self._generator, dtype=torch.float64, device=self.device)
        return self._ranges.of(2.0 * u - 1.0)

    def _vary(self, drawn: Variation) -> None:
        """Write the drawn variation into the arrays that the graph reads."""
        for (kind, name), column in self._varied.items():
            column.copy_(getattr(drawn, kind)[name])

    def _observe(self, mask: torch.Tensor | None = None) -> dict[str, torch.Tensor]:
        """Observations of all environments; touch of those of a mask (B,), None for all."""
        result, self.body_observation = self._progress.observation(self._gap()), self._progress.body_observation()
        if self.body_seen:
            result["body"] = self.body_observation
        if self.touch is not None:
            result |= self.touch.observe(mask)
        return result

    def _gap(self) -> torch.Tensor:
        """Gap between two pads (B, 1) [m]; (B, 0) without a gripper."""
        fingers = self._state["fingers"]
        return fingers.sum(1, keepdim=True) if self._control.has_grip else fingers[:, :0]

    def _body_now(self) -> torch.Tensor:
        return self._state["bodies"][:, self._body_at]

    def _launch_step(self) -> None:
        self.world.aim()
        self.world.launch()

    def _launch_begin(self, ended: wp.array, placed: dict[str, wp.array]) -> None:
        if self._variation is not None:
            self._variation.launch(ended, self._kinds)
        self.world.reset(envs=ended, bodies=placed)
        if self.touch is not None:
            self.touch.forget(ended)
            self.touch.launch()

    def _captured(self, launch: Callable[[], None]) -> Callable[[], None]:
        """Record kernels as one graph on CUDA, after they ran once; it runs in PyTorch's stream."""
        graph = self.world.engine.capture(launch)
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        return graph

    @contextmanager
    def _stream(self) -> Iterator[None]:
        """Launch kernels in PyTorch's stream, so that they follow each other without waiting."""
        if self.device.type != "cuda":
            yield
            return
        with wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(self.device))):
            yield
