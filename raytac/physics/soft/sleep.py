"""Sleep of a soft scene: environments in which nothing soft can be touched need no solve."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations, product

import numpy as np

import ipc
from raytac.physics.soft.bodies import SceneBody, ScenePad
from raytac.physics.soft.scene_state import Poses
from raytac.physics.soft.substeps import BoxMotion, Pair, Substeps, clear_of_each_other

_MARGIN = 2.0
"""Distance that pads must keep during a step, in units of d̂: contact begins at one."""


class Sleep:
    """Choice of the environments that sleep through a step.

    An environment sleeps if three things hold: its gels and bodies came to rest, to the tolerance of the solver; no pad comes near anything
    in the coming step, whatever its speed; and no driven body that moves comes near a free or soft one. Nothing else is remembered, so it
    wakes in the step in which one of them does not hold.
    """

    def __init__(
        self,
        pads: Mapping[str, ScenePad],
        bodies: Mapping[str, SceneBody],
        substeps: Substeps,
        world: ipc.World,
        tolerance: float,
    ) -> None:
        """``tolerance``: largest displacement of a node from its place at rest [m]."""
        self._substeps, self._world, self._tolerance = substeps, world, tolerance
        self._margin = _MARGIN * world.d_hat
        self._pad_pairs: list[Pair] = [*combinations(pads, 2), *product(pads, bodies)]
        self._body_pairs: list[Pair] = []
        for a, b in combinations(bodies.values(), 2):
            if a.is_soft or b.is_soft or not (a.is_driven and b.is_driven):
                self._body_pairs.append((b.name, a.name) if isinstance(a.solid, ipc.HalfSpace) else (a.name, b.name))

    def choose(self, now: Poses, goal: Poses) -> np.ndarray:
        """Environments (B,) that sleep while all that is driven goes from ``now`` to ``goal``."""
        asleep = self._world.distance_from_rest() <= self._tolerance
        if not asleep.any():
            return asleep
        motions = self._substeps.motions(now, goal, np.zeros(len(asleep)))
        for a, b in self._pad_pairs:
            asleep &= clear_of_each_other(motions[a], motions[b], self._margin)
        for a, b in self._body_pairs:
            still = _is_still(motions[a]) & _is_still(motions[b])
            asleep &= still | clear_of_each_other(motions[a], motions[b], self._margin)
        return asleep


def _is_still(motion: BoxMotion) -> np.ndarray:
    """Environments (B,) in which a box does not move."""
    return (motion.start == motion.end).all(axis=(1, 2))
