"""``WarpBatch``: B environments of one task on MuJoCo Warp, all on one device."""

# pyright: reportMissingImports=false
# (PyTorch belongs to the extra "rl", which the tests do without.)

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
import warp as wp

from raytac.checks import check_whole
from raytac.envs.action_targets import ToolTargets
from raytac.envs.batch import task_settings
from raytac.envs.task_observation import body_from_tool, state_and_goal
from raytac.envs.task_outcome import task_outcome
from raytac.envs.task_rules import Starts, Task, TaskState
from raytac.envs.warp_touch import WarpTouch
from raytac.errors import InputError
from raytac.observe import ObservationSettings
from raytac.robots.pose_errors import PoseErrors
from raytac.specs.task import TaskScene
from raytac.specs.task_file import load_task
from raytac.world.warp_world import WarpWorld


@dataclass(frozen=True)
class WarpStep:
    """Result of a step of B environments; tensors (B,) or (B, …).

    Where an episode has ended, the observation is the next one's first.
    """

    observation: dict[str, torch.Tensor]
    reward: torch.Tensor
    terminated: torch.Tensor
    truncated: torch.Tensor
    terms: dict[str, torch.Tensor]
    """Terms of the reward by name."""
    success: torch.Tensor
    failed: torch.Tensor
    """Environments whose physics broke down: truncated, with reward 0."""


class WarpBatch:
    """B environments of one task, whose episodes begin again in the step in which they end.

    .. code-block:: python

        batch = WarpBatch(PushCube(), num_envs=4096, device="cuda")
        observation = batch.reset()
        step = batch.step(policy(observation))

    Rewards, ends, starts, targets and observations are those of ``TaskBatch``. Starts are drawn from one generator of the device. Nothing
    in a step waits for the device, but for images, which another library renders.

    Attributes:
        world: the worlds.
        task, num_envs, max_episode_steps, body_seen: as of ``TaskBatch``.
        device: of all tensors.
        size: of an action.
        steps: since the start of each episode, (B,), int64; writing to them ends episodes as much earlier.
        start_tool, start_body: poses (4, 4) of the tool and of the task's body in the scene.
        body_observation: pose and velocity of the body (B, 15) as they are observed if ``body_seen``; for a critic they always are.
    """

    def __init__(
        self,
        task: Task,
        *,
        num_envs: int = 1,
        tactile: ObservationSettings | Sequence[str] | str | None = "task",
        body_seen: bool | None = None,
        max_episode_steps: int | None = None,
        device: str = "auto",
        seed: int = 0,
        scene: str | Path | TaskScene | None = None,
        pitch: float | None = None,
        launches: int | None = None,
        contacts: int | None = None,
        rows: int | None = None,
        patches: int = 8,
    ) -> None:
        """Make the worlds; ``reset`` begins the episodes.

        Args:
            task, num_envs, tactile, body_seen, max_episode_steps, seed, scene, pitch: as of ``TaskBatch``.
            device, launches, contacts, rows: as of ``WarpWorld``.
            patches: most separate contacts of a pad, for its markers; more are an error of ``check``.

        Raises:
            InputError: a value out of its choices; as ``WarpWorld`` and ``WarpTouch``.
        """
        length = task.max_episode_steps if max_episode_steps is None else max_episode_steps
        self.task, self.num_envs, self.max_episode_steps = task, num_envs, check_whole("max_episode_steps", length)
        settings = task_settings(task.tactile if isinstance(tactile, str) and tactile == "task" else tactile)
        loaded = scene if isinstance(scene, TaskScene) else load_task(task.scene if scene is None else scene)
        frequency = task.motion.frequency
        self.world = world = WarpWorld(
            loaded, num_envs=num_envs, device=device, frequency=frequency, launches=launches, contacts=contacts, rows=rows
        )
        self.touch = None if settings is None else WarpTouch(world, settings, pitch=pitch, patches=patches, seed=seed)
        self.device = torch.device(wp.device_to_torch(world.engine.device))
        self.body_seen = task.body_seen if body_seen is None else body_seen
        self._names = [mounted.name for mounted in world.composed.sensors]
        self._state = {name: wp.to_torch(array) for name, array in world.state.items()}
        self._wrenches, self._active = wp.to_torch(world.contact.wrenches), wp.to_torch(world.engine.active)
        self._body_at = list(world.composed.bodies).index(task.body)
        self.start_tool, self.start_body = self._state["tool"][0].clone(), self._body_now()[0].clone()
        opening = world.composed.opening
        self._control = ToolTargets(
            task.motion, self._state["tool"], 0.0 if opening is None else float(world.composed.ctrl[opening])
        )
        self.size = len(task.motion.axes)
        self._generator = torch.Generator(self.device)
        self._generator.manual_seed(seed)
        self._errors = PoseErrors(num_envs, 2, device=str(world.engine.device))
        zeros = partial(torch.zeros, dtype=torch.float64, device=self.device)
        self.steps = torch.zeros(num_envs, dtype=torch.int64, device=self.device)
        self._goal, self._action = zeros(num_envs, 3), zeros(num_envs, self.size)
        self._tool, self._body = self._state["tool"].clone(), self._body_now().clone()
        self._speed, self._body_speed, self._turn = zeros(num_envs, 3), zeros(num_envs, 6), zeros(num_envs, 3)
        # What graphs read and write stays where it is.
        self._ended = torch.ones(num_envs, dtype=torch.bool, device=self.device)
        self._tool_target, self._tool_twist = wp.to_torch(world.tool_target), wp.to_torch(world.tool_twist)
        self._tool_target.copy_(self._tool)
        self._opening = None if world.opening is None else wp.to_torch(world.opening)
        starts = self._draw()
        self._placed = {name: poses.clone() for name, poses in starts.bodies.items()}
        ended = wp.from_torch(self._ended, dtype=wp.bool)
        placed = {name: wp.from_torch(poses) for name, poses in self._placed.items()}
        self._begin_graph = self._captured(lambda: self._launch_begin(ended, placed))
        self._step_graph = self._captured(self._launch_step)
        self._begun = False

    @property
    def control_timestep(self) -> float:
        """Duration of a step [s]."""
        return self.world.composed.control_timestep

    @property
    def wrench(self) -> dict[str, torch.Tensor]:
        """Wrench (B, 6) on every sensor in the last step, pad frame [N, N m], until the next."""
        return {name: self._wrenches[:, k] for k, name in enumerate(self._names)}

    def reset(self, seed: int | None = None) -> dict[str, torch.Tensor]:
        """Begin all episodes; ``seed`` makes these and later starts repeatable."""
        if seed is not None:
            self._generator.manual_seed(seed)
        self._ended.fill_(True)
        with self._stream():
            self._begin()
            self._begun = True
            return self._observe()

    def step(self, actions: torch.Tensor) -> WarpStep:
        """One control step; ``actions`` (B, size) are cut to [−1, 1], and NaN is 0.

        Raises:
            InputError: actions of another shape, or no ``reset`` before.
        """
        if tuple(actions.shape) != (self.num_envs, self.size):
            raise InputError("actions", value=tuple(actions.shape), rule=f"must have shape {(self.num_envs, self.size)}")
        if not self._begun:
            raise InputError("reset", value="not called", rule="must be called before the first step")
        actions = torch.nan_to_num(actions.detach().to(self.device, torch.float64)).clamp(-1.0, 1.0)
        with self._stream():
            self._aim(actions)
            self._step_graph()
            dt, tool, body = self.control_timestep, self._state["tool"], self._body_now()
            moved, turned = self._errors((body, self._body), (tool, self.start_tool))
            self._speed, self._body_speed, self._turn = (tool[:, :3, 3] - self._tool[:, :3, 3]) / dt, moved / dt, turned[:, 3:]
            self._tool, self._body = tool.clone(), body.clone()
            last, self._action = self._action, actions
            self.steps += 1
            state = TaskState(
                tool=self._tool,
                speed=self._speed,
                body=self._body,
                body_speed=self._body_speed,
                goal=self._goal,
                wrench=self.wrench,
                opening=self._gap(),
                joint_speed=self._state["speed"],
                action=actions,
                last_action=last,
            )
            failed = ~self._active
            end = task_outcome(self.task, state, self.steps, self.max_episode_steps, failed)
            torch.logical_or(end.terminated, end.truncated, out=self._ended)
            self._begin()
            return WarpStep(self._observe(), end.reward, end.terminated, end.truncated, end.terms, end.success, failed)

    def check(self) -> None:
        """Wait for the device. Raises ``InputError`` if contacts were lost for want of memory."""
        self.world.check()
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

    def _begin(self) -> None:
        """Begin episodes where one has ended, by a mask: whether one has, the host does not know."""
        starts, ended = self._draw(), self._ended
        for name, poses in starts.bodies.items():
            self._placed[name].copy_(poses)
        self._begin_graph()
        tool, body = self._state["tool"], self._body_now()
        begun = ended[:, None]
        self._goal = torch.where(begun, starts.goal, self._goal)
        self._tool, self._body = (
            torch.where(begun[..., None], now, old) for now, old in ((tool, self._tool), (body, self._body))
        )
        self._speed, self._body_speed, self._action = (
            torch.where(begun, 0.0, old) for old in (self._speed, self._body_speed, self._action)
        )
        turn = self._errors((self._tool, self.start_tool))[0, :, 3:]
        self._turn = torch.where(begun, turn, self._turn)
        self.steps.masked_fill_(ended, 0)
        self._control.begin(ended, tool)

    def _draw(self) -> Starts:
        u = torch.rand(self.num_envs, self.task.draws, generator=self._generator, dtype=torch.float64, device=self.device)
        return self.task.starts(u, self.start_tool, self.start_body)

    def _observe(self) -> dict[str, torch.Tensor]:
        """Observations of all environments, float32 and images of 8 bit."""
        result = state_and_goal(self._tool, self.start_tool, self._turn, self._speed, self._gap(), self._action, self._goal)
        self.body_observation = body_from_tool(self._tool, self._body, self._body_speed)
        if self.body_seen:
            result["body"] = self.body_observation
        if self.touch is not None:
            result |= self.touch.observe()
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
        self.world.reset(envs=ended, bodies=placed)
        if self.touch is not None:
            self.touch.forget(ended)
            self.touch.launch()

    def _captured(self, launch: Callable[[], None]) -> Callable[[], None]:
        """Kernels as one graph on CUDA, which runs in PyTorch's stream; it runs once before."""
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
