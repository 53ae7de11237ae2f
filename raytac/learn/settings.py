"""Settings of a training by PPO."""

from __future__ import annotations

from dataclasses import dataclass

from raytac.checks import check_known, check_names, check_number, check_whole
from raytac.errors import InputError
from raytac.io.options import parse_names, parse_seeds
from raytac.observe import MODALITIES
from raytac.physics.registry import PHYSICS

WORLDS = ("mujoco", "mujoco_warp")
HISTORY = {"BalancePole": 3, "RollBall": 3}
"""Last observations that the policy is given, where it is more than one.

What is known by touch alone shows in how it changes."""
ENTROPY = {"LiftCube": 0.002}
"""Weight of the entropy, where it is not 0.005.

A reward that comes late lets a larger one widen the actions instead."""
STEPS = {
    "PushCube": 1_000_000, "BalancePole": 4_000_000, "LiftCube": 6_000_000, "RollBall": 2_000_000, "InsertPeg": 20_000_000,
    "OpenDrawer": 20_000_000,
}  # fmt: skip
"""Environment steps of a training by task; those of the last two are a guess."""
DEVIATION_MOST = 2.0
"""Greatest standard deviation of an action: the range of actions itself."""


@dataclass(frozen=True, kw_only=True)
class PpoSettings:
    """Task, observation, environments and PPO of one or several trainings."""

    task: str = "PushCube"
    """One of PushCube, BalancePole, LiftCube, RollBall, InsertPeg, OpenDrawer."""
    physics: str = "rigid"
    """Pads: rigid, or ipc for soft ones, which need --worlds mujoco."""
    touch: str = "wrench"
    """Observed touch, joined by commas, each trained with the same seeds.

    none, task (as the environment has it), or modalities joined by +, as in markers+wrench. The first is that of the headline in
    metrics.json."""
    seeds: str = "0"
    """Seeds joined by commas, one training each."""
    steps: int | None = None
    """Environment steps of each training; the task's own if not given."""
    minutes: float | None = None
    """End each training after so many minutes, without those before a resume.

    The same command goes on."""
    target: float | None = None
    """Success on held-out episodes at which a training is done before its steps are."""
    num_envs: int = 512
    """Environments of each training."""
    worlds: str = "mujoco"
    """mujoco: on the CPU. mujoco_warp: all environments on the device, without processes."""
    launches: int | None = None
    """Steps of mujoco_warp in a control step, as many as the scene's if not given.

    Of more, a world divides one where something is fast."""
    processes: int = 0
    """Processes that the environments of mujoco are spread over, one core each; 0: this process."""
    threads: int = 1
    """Threads of the networks on the CPU."""
    history: int | None = None
    """Last observations that the policy is given; the task's own if not given."""
    episodes: int = 256
    """Held-out episodes of the last evaluation.

    Those in between have as many as there are environments at most."""
    evaluate_every: int = 500_000
    """Environment steps between evaluations."""

    rollout: int = 24
    """Steps of each environment between two updates."""
    epochs: int = 5
    """Passes over a rollout in an update."""
    minibatches: int = 4
    """Parts of a rollout in a pass."""
    learning_rate: float = 1e-3
    """At the start; it follows desired_kl."""
    desired_kl: float = 0.01
    """Divergence of an update that the learning rate is raised or lowered for."""
    gamma: float = 0.98
    """Discount of rewards."""
    gae_lambda: float = 0.95
    """Of generalised advantage estimation."""
    clip: float = 0.2
    """Bound of the ratio of probabilities."""
    entropy: float | None = None
    """Weight of the entropy; the task's own if not given."""
    deviation: float = 1.0
    """Initial standard deviation of an action, whose range is −1 to 1.

    From deviation_floor to 2."""
    deviation_floor: float = 0.2
    """Least standard deviation: exploration does not die before the goal is seen."""
    hidden: int = 128
    """Width of the two layers of policy and critic."""

    def __post_init__(self) -> None:
        check_known("task", self.task, tuple(STEPS))
        for name in ("num_envs", "threads", "episodes", "evaluate_every", "rollout", "epochs", "minibatches", "hidden"):
            check_whole(name, getattr(self, name))
        check_whole("processes", self.processes, 0)
        check_known("worlds", self.worlds, WORLDS)
        check_known("physics", self.physics, PHYSICS.names if self.worlds == "mujoco" else ("rigid",))
        if self.processes and self.worlds != "mujoco":
            raise InputError(
                "processes", value=self.processes, rule="must be 0 with worlds 'mujoco_warp', which run on the device"
            )
        if self.launches is not None and self.worlds != "mujoco_warp":
            raise InputError("launches", value=self.launches, rule="is a setting of worlds 'mujoco_warp'")
        parse_seeds(self.seeds)
        check_number("deviation_floor", self.deviation_floor, f"(0, {DEVIATION_MOST}]")
        check_number("deviation", self.deviation, f"[{self.deviation_floor}, {DEVIATION_MOST}]")
        above, unit = dict.fromkeys(("learning_rate", "desired_kl", "clip"), "(0, inf)"), "[0, 1]"
        for name, interval in {**above, "gamma": unit, "gae_lambda": unit}.items():
            check_number(name, getattr(self, name), interval)
        for name in ("history", "steps", "launches"):
            if getattr(self, name) is not None:
                check_whole(name, getattr(self, name))
        for touch in parse_names(self.touch, "touch"):
            if touch not in ("none", "task"):
                check_names("touch", touch.split("+"), MODALITIES)
        for name, interval in {"minutes": "(0, inf)", "target": "[0, 1]", "entropy": "[0, inf)"}.items():
            if getattr(self, name) is not None:
                check_number(name, getattr(self, name), interval)
