"""Variations of masses, friction, gels and mountings, drawn at every reset."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from array_api_compat import array_namespace

from raytac.envs.task_rules import Array
from raytac.observe import Randomization
from raytac.se3 import inverse, pose, rotations
from raytac.specs.task import TaskScene
from raytac.world.environment_models import Variation


class VariationRanges:
    """Variations from uniform random numbers; arrays of NumPy, or of PyTorch on any device.

    Attributes:
        count: random numbers that an environment needs. Neither it nor their order depends on the widths, so that a width of 0 changes
            nothing else.
        is_none: True if nothing varies.
    """

    def __init__(self, scene: TaskScene, sensors: Sequence[str], randomization: Randomization, *, rigid: bool) -> None:
        """Name what varies.

        Args:
            sensors: names of the sensors whose gels and mountings vary.
            randomization: half widths; ``body_mass``, ``body_friction``, ``youngs_modulus``, ``friction``, ``pad_shift`` and ``pad_turn``
                of it are used.
            rigid: pads are rigid. Soft pads and the bodies among them are the same in all environments, so that only their mounting is
                drawn.
        """
        self._randomization, self._sensors = randomization, tuple(sensors)
        self._bodies_differ, self._gels_differ = rigid and randomization.changes_bodies, rigid and randomization.changes_gel
        self._masses = [body.name for body in scene.bodies if body.dynamics == "free"]
        self._frictions = [body.name for body in scene.bodies]
        self.is_none = not (self._bodies_differ or self._gels_differ or randomization.changes_mounting)
        self.count = len(self._masses) + len(self._frictions) + 8 * len(self._sensors)

    def of(self, u: Array) -> Variation:
        """Variations of n environments from numbers ``u`` (n, ``count``) in [−1, 1)."""
        r, masses, frictions = self._randomization, len(self._masses), len(self._frictions)
        mass, friction, own = u[:, :masses], u[:, masses : masses + frictions], u[:, masses + frictions :]
        own = array_namespace(u).reshape(own, (u.shape[0], len(self._sensors), 8))  # of every sensor: shift, turn, gel
        factors: dict[str, dict[str, Array]] = {}
        if self._bodies_differ:
            factors["mass"] = {name: 1.0 + r.body_mass * mass[:, i] for i, name in enumerate(self._masses)}
            factors["friction"] = {name: 1.0 + r.body_friction * friction[:, i] for i, name in enumerate(self._frictions)}
        if self._gels_differ:
            factors["gel_stiffness"] = {name: 1.0 + r.youngs_modulus * own[:, i, 6] for i, name in enumerate(self._sensors)}
            factors["gel_friction"] = {name: 1.0 + r.friction * own[:, i, 7] for i, name in enumerate(self._sensors)}
        if r.changes_mounting:
            poses = pose(rotations(r.pad_turn * own[..., 3:6]), r.pad_shift * own[..., :3])
            factors["mounting"] = {name: poses[:, i] for i, name in enumerate(self._sensors)}
        return Variation(**factors)


class VariationSampler:
    """Seeded variations of B environments, one stream each: draws do not depend on B."""

    def __init__(self, ranges: VariationRanges, *, num_envs: int = 1, seed: int = 0) -> None:
        """Seed the streams, that of environment b with ``seed`` + b; draw nothing yet."""
        self.ranges = ranges
        self._streams = [_stream(seed + b) for b in range(num_envs)]

    def reseed(self, envs: Sequence[int], seeds: Sequence[int]) -> None:
        """Seed the streams of environments."""
        for b, seed in zip(envs, seeds, strict=True):
            self._streams[b] = _stream(seed)

    def draw(self, envs: Sequence[int]) -> Variation:
        """Draw a variation of the environments named, one row each."""
        count = self.ranges.count
        return self.ranges.of(np.array([self._streams[b].uniform(-1.0, 1.0, count) for b in envs]).reshape(len(envs), count))


def on_mounted_pad(body: str, bodies: Mapping[str, Array], pad: Array, mounting: Array) -> dict[str, Array]:
    """Starts of bodies where ``body`` is shifted and tilted with the pad that it stands on.

    Args:
        bodies: name to ``world_from_body`` (n, 4, 4).
        pad: pose (4, 4) of the pad as designed.
        mounting: ``nominal_from_pad`` (n, 4, 4).
    """
    # As many inverses as mountings: a single element would be copied to the device.
    pads = array_namespace(mounting).broadcast_to(pad, mounting.shape)
    return {**bodies, body: pads @ mounting @ inverse(pads) @ bodies[body]}


def _stream(seed: int) -> np.random.Generator:
    return np.random.default_rng((seed, 0xB0D1))
