"""Reward and ends of a step, of B environments; NumPy, or PyTorch on any device."""

from __future__ import annotations

from dataclasses import dataclass

from array_api_compat import array_namespace

from raytac.envs.task_rules import Array, Task, TaskState


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
        task: the task.
        state: after the step.
        steps: since the start of each episode (B,); at ``max_episode_steps`` it is truncated.
        failed: environments (B,) whose physics broke down: truncated, with reward 0.
    """
    xp, result = array_namespace(state.goal), task.evaluate(state)
    nothing = xp.zeros_like(state.goal[:, 0])
    terms = {name: xp.where(failed, 0.0, nothing + term) for name, term in result.terms.items()}
    terminated = result.terminated & ~failed
    truncated = (failed | (steps >= max_episode_steps)) & ~terminated
    return TaskOutcome(sum(terms.values(), nothing), terminated, truncated, terms, result.success & ~failed)
