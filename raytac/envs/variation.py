"""What is drawn for the bodies, the gels and the mounting of every environment, each time it begins anew."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from raytac.observe import Randomization
from raytac.se3 import rotations
from raytac.specs.task import TaskScene
from raytac.world.variation import Variation

__all__ = ["VariationDraws"]


class VariationDraws:
    """Seeded variations of B environments. Streams are one an environment: what one draws does not depend on how many there are."""

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
        """Draw nothing yet.

        Args:
            scene: whose bodies differ.
            sensors: names of those whose pads are mounted askew.
            randomization: half widths; ``body_mass``, ``body_friction``, ``youngs_modulus``, ``friction``, ``pad_shift`` and ``pad_turn``
                of it are used.
            rigid: whether pads are rigid; simulated ones and bodies among them are the same in all environments, so nothing of them is
                drawn but how they are mounted.
            num_envs: number of environments B.
            seed: environment b begins with seed + b.
        """
        self._randomization, self._sensors = randomization, tuple(sensors)
        self._bodies_differ, self._gels_differ = rigid and randomization.changes_bodies, rigid and randomization.changes_gel
        self._masses = [body.name for body in scene.bodies if body.dynamics == "free"]
        self._frictions = [body.name for body in scene.bodies]
        self.is_none = not (self._bodies_differ or self._gels_differ or randomization.changes_mounting)
        """Whether there is nothing to draw."""
        self._streams = [_stream(seed + b) for b in range(num_envs)]

    def reseed(self, envs: Sequence[int], seeds: Sequence[int]) -> None:
        """Start the streams of environments anew, each from a seed."""
        for b, seed in zip(envs, seeds, strict=True):
            self._streams[b] = _stream(seed)

    def draw(self, envs: Sequence[int]) -> Variation:
        """Of the environments named, one row each."""
        r = self._randomization
        # As many numbers in the same order whatever is asked, so that a width of 0 changes nothing else.
        count = len(self._masses) + len(self._frictions) + 8 * len(self._sensors)
        u = np.array([self._streams[b].uniform(-1.0, 1.0, count) for b in envs]).reshape(len(envs), count)
        mass, friction, mounting = np.split(u, np.cumsum([len(self._masses), len(self._frictions)]), axis=1)
        poses = np.repeat(np.eye(4)[None], len(envs) * len(self._sensors), axis=0).reshape(len(envs), -1, 4, 4)
        mounting, gel = np.split(mounting.reshape(len(envs), -1, 8), [6], axis=2)
        poses[..., :3, 3] = r.pad_shift * mounting[..., :3]
        poses[..., :3, :3] = rotations(r.pad_turn * mounting[..., 3:].reshape(-1, 3)).reshape(len(envs), -1, 3, 3)
        drawn: dict[str, dict[str, np.ndarray]] = {}
        if self._bodies_differ:
            drawn["mass"] = {name: 1.0 + r.body_mass * mass[:, i] for i, name in enumerate(self._masses)}
            drawn["friction"] = {name: 1.0 + r.body_friction * friction[:, i] for i, name in enumerate(self._frictions)}
        if self._gels_differ:
            drawn["gel_stiffness"] = {name: 1.0 + r.youngs_modulus * gel[:, i, 0] for i, name in enumerate(self._sensors)}
            drawn["gel_friction"] = {name: 1.0 + r.friction * gel[:, i, 1] for i, name in enumerate(self._sensors)}
        if r.changes_mounting:
            drawn["mounting"] = {name: poses[:, i] for i, name in enumerate(self._sensors)}
        return Variation(**drawn)


def _stream(seed: int) -> np.random.Generator:
    return np.random.default_rng((seed, 0xB0D1))
