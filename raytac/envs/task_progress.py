"""``TaskProgress``: episodes of B environments, from poses to reward, ends, observation.

Arrays of NumPy, or of PyTorch on any device.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from raytac.envs.task_observation import body_from_tool, state_and_goal
from raytac.envs.task_rules import Array, Task, TaskState, namespace_of
from raytac.robots.pose_errors import PoseErrors


@dataclass(frozen=True)
class TaskOutcome:
    """Outcome of a step; arrays (B,)."""

    reward: Array
    terminated: Array
    truncated: Array
    terms: dict[str, Array]
    """Terms of the reward by name."""
    success: Array


def task_outcome(task: Task, state: TaskState, steps: Array, max_episode_steps: int, failed: Array) -> TaskOutcome:
    """Outcome of a step; rewards have the type of the state's goals.

    Args:
        state: after the step.
        steps: since the start of each episode (B,); at ``max_episode_steps`` it is truncated.
        failed: environments (B,) whose physics broke down: truncated, with reward 0.
    """
    xp, result = namespace_of(state.goal), task.evaluate(state)
    nothing = xp.zeros_like(state.goal[:, 0])
    terms = {name: xp.where(failed, 0.0, nothing + term) for name, term in result.terms.items()}
    terminated = result.terminated & ~failed
    truncated = (failed | (steps >= max_episode_steps)) & ~terminated
    return TaskOutcome(sum(terms.values(), nothing), terminated, truncated, terms, result.success & ~failed)


class TaskProgress:
    """State of the episodes that physics does not hold.

    Attributes:
        start_tool, start_body: poses (4, 4) of the tool and of the task's body in the scene.
        tool, body: poses (B, 4, 4) after the last step or start.
        body_speed: mean velocity [m/s] and angular velocity [rad/s] of the body over the last step, (B, 6).
        goal: positions (B, 3) [m].
        action: last ones (B, k); 0 at the start of an episode.
        steps: since the start of each episode (B,); they are counted in place, and writing to them ends episodes as much earlier.
    """

    def __init__(
        self, task: Task, tool: Array, body: Array, steps: Array, *, actions: int, duration: float, errors: PoseErrors
    ) -> None:
        """Begin where the scene does.

        Args:
            tool, body: poses (B, 4, 4) in the scene, float64.
            steps: zeros (B,), whole numbers.
            actions: size k of an action.
            duration: of a step [s].
            errors: of 2 B poses.
        """
        xp = namespace_of(tool)
        self._task, self._duration, self._errors = task, duration, errors
        self.tool, self.body = (xp.asarray(poses, copy=True) for poses in (tool, body))
        self.start_tool, self.start_body = (xp.asarray(poses[0], copy=True) for poses in (tool, body))
        self.steps, zeros = steps, xp.zeros_like(tool[:, :3, 3])
        self._speed, self._turn, self.goal, self.body_speed = zeros, zeros, zeros, xp.concat([zeros, zeros], axis=1)
        self.action = self._last_action = xp.tile(zeros[:, :1], (1, actions))

    def begin(self, mask: Array, tool: Array, body: Array, goal: Array) -> None:
        """Begin episodes in the environments of a mask (B,), at poses and goals of all (B, …)."""
        xp, begun = namespace_of(tool), mask[:, None]
        self.tool, self.body = (xp.where(begun[..., None], now, old) for now, old in ((tool, self.tool), (body, self.body)))
        self.goal = xp.where(begun, goal, self.goal)
        self._speed, self.body_speed, self.action = (
            xp.where(begun, 0.0, old) for old in (self._speed, self.body_speed, self.action)
        )
        self._turn = xp.where(begun, self._errors((self.tool, self.start_tool))[0, :, 3:], self._turn)
        self.steps *= ~mask

    def advance(self, tool: Array, body: Array, action: Array) -> None:
        """Take the poses (B, 4, 4) after a step, not overwritten any more, and actions (B, k)."""
        dt = self._duration
        moved, turned = self._errors((body, self.body), (tool, self.start_tool))
        self._speed, self.body_speed, self._turn = (tool[:, :3, 3] - self.tool[:, :3, 3]) / dt, moved / dt, turned[:, 3:]
        self.tool, self.body = tool, body
        self._last_action, self.action = self.action, action
        self.steps += 1

    def outcome(
        self, wrench: Mapping[str, Array], opening: Array, joint_speed: Array, failed: Array, max_episode_steps: int
    ) -> TaskOutcome:
        """Outcome of the step that ``advance`` has taken over.

        Args:
            wrench: on every sensor (B, 6), pad frame.
            opening: gap between two pads (B, 1) [m]; (B, 0) without a gripper.
            joint_speed: (B, n) [rad/s].
        """
        state = TaskState(
            tool=self.tool,
            speed=self._speed,
            body=self.body,
            body_speed=self.body_speed,
            goal=self.goal,
            wrench=wrench,
            opening=opening,
            joint_speed=joint_speed,
            action=self.action,
            last_action=self._last_action,
        )
        return task_outcome(self._task, state, self.steps, max_episode_steps, failed)

    def observation(self, opening: Array) -> dict[str, Array]:
        """``state`` and ``goal``, float32."""
        return state_and_goal(self.tool, self.start_tool, self._turn, self._speed, opening, self.action, self.goal)

    def body_observation(self) -> Array:
        """``body`` (B, 15), float32."""
        return body_from_tool(self.tool, self.body, self.body_speed)
