"""Scene of a task with the sensors that a batch reads, and their observers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from raytac.checks import check_kind
from raytac.envs.task_rules import Task
from raytac.gel.surface import COARSEST_PITCH
from raytac.observe import ObservationSettings, Randomization, TactileObserver, randomised_bodies
from raytac.physics.base import PhysicsConfig
from raytac.physics.registry import scene_physics
from raytac.specs.task import TaskScene
from raytac.specs.task_file import load_task

NODE_PITCH = 0.4e-3
"""Spacing of the gel's nodes where no image needs a finer one [m]."""


@dataclass(frozen=True)
class TaskSensors:
    """Scene of a task and the observation of its sensors."""

    scene: TaskScene
    """With the sensor, and among soft pads the bodies, that were drawn for the world."""
    physics: PhysicsConfig
    settings: ObservationSettings | None
    """Of every sensor; None: none is read."""
    randomization: Randomization
    probe: TactileObserver
    """Of one sensor, before the world is there."""
    seed: int

    @classmethod
    def of(
        cls,
        task: Task,
        tactile: ObservationSettings | Sequence[str] | str | None,
        *,
        physics: PhysicsConfig | None,
        scene: str | Path | TaskScene | None,
        randomization: Randomization | None,
        num_envs: int,
        seed: int,
    ) -> TaskSensors:
        """Load the scene and draw what all environments share; arguments as of ``TaskBatch``."""
        settings = _settings(task.tactile if isinstance(tactile, str) and tactile == "task" else tactile)
        drawn = Randomization() if randomization is None else check_kind("randomization", randomization, Randomization)
        loaded = scene if isinstance(scene, TaskScene) else load_task(task.scene if scene is None else scene)
        config = scene_physics(physics, loaded)
        shared = drawn if config.is_simulated else replace(drawn, youngs_modulus=0.0, friction=0.0)
        # Without touch the probe gives the force alone, so that the sensor needs no markers.
        probed = ObservationSettings(("wrench",)) if settings is None else settings
        probe = TactileObserver(loaded.robot.sensor, probed, num_envs=num_envs, randomization=shared, seed=seed)
        loaded = replace(loaded, robot=replace(loaded.robot, sensor=probe.sensor))
        if config.is_simulated:
            loaded = randomised_bodies(loaded, drawn, seed)
        return cls(loaded, config, settings, drawn, probe, seed)

    @property
    def pitch(self) -> float:
        """Pitch [m] as fine as images, if any, between the coarsest allowed and 0.4 mm."""
        if "rgb" not in self.probe.settings.modalities:
            return NODE_PITCH
        return max(COARSEST_PITCH, min(NODE_PITCH, *self.probe.sensor.camera.pitch_at(self.probe.layout.rendered)))

    def observers(self, names: Sequence[str]) -> dict[str, TactileObserver]:
        """Observer of every sensor by name, with randomised cameras; none without touch."""
        if self.settings is None:
            return {}
        episode = replace(self.randomization, led_power=0.0, led_colour=0.0, reflectance=0.0, youngs_modulus=0.0, friction=0.0)
        options = {"num_envs": self.probe.num_envs, "randomization": episode}
        return {
            name: TactileObserver(self.probe.sensor, self.settings, **options, seed=sensor_seed(self.seed, i))
            for i, name in enumerate(names)
        }


def sensor_seed(seed: int, sensor: int) -> int:
    """Seed of an environment's sensor; never a neighbour's, whose seed is the next number."""
    return seed + (sensor << 64)


def _settings(tactile: ObservationSettings | Sequence[str] | str | None) -> ObservationSettings | None:
    if tactile is None or isinstance(tactile, ObservationSettings):
        return tactile
    return ObservationSettings((tactile,) if isinstance(tactile, str) else tuple(tactile))
