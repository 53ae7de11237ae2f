"""Poses, saved states and step reports of a soft scene."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

import ipc
from raytac.se3 import between


@dataclass(frozen=True)
class Poses:
    """Poses ``world_from_…`` of all that is driven."""

    pads: np.ndarray
    """(B, S, 4, 4)."""
    bodies: dict[str, np.ndarray]
    """(B, 4, 4) by name."""

    def copy(self) -> Poses:
        return Poses(self.pads.copy(), {name: pose.copy() for name, pose in self.bodies.items()})

    def towards(self, goal: Poses, share: np.ndarray) -> Poses:
        """Interpolation at shares (B,) of the motion to ``goal``."""
        pads = [between(self.pads[:, k], goal.pads[:, k], share) for k in range(self.pads.shape[1])]
        return Poses(np.stack(pads, axis=1), {name: between(self.bodies[name], p, share) for name, p in goal.bodies.items()})

    def longest(self, goal: Poses, b: int) -> float:
        """Longest displacement of any origin of environment ``b`` to ``goal`` [m]."""
        lengths = [np.linalg.norm((goal.pads - self.pads)[b, :, :3, 3], axis=-1).max()]
        lengths += [np.linalg.norm((goal.bodies[n] - p)[b, :3, 3]) for n, p in self.bodies.items()]
        return float(max(lengths))


@dataclass(frozen=True)
class SceneReport:
    """One step of B environments, all of its substeps together; every array has shape (B,).

    failed: a number was not finite; the environment stays as it was until it is reset. converged: every substep met its tolerance.
    unconverged: number of substeps that did not, in an environment that has not failed. last_converged: the last substep did.
    min_gap: least distance between surfaces [m], inf if none was near. min_det: least det F of any tetrahedron [-]. blocked: largest share
    of a substep's motion that was refused because it would crush an obstacle. newton: iterations, and linear: those of their conjugate
    gradients. elastic, barrier: energies at the end [J]. substeps: how often the solver was called, 0 where an environment is asleep.
    """

    failed: np.ndarray
    converged: np.ndarray
    unconverged: np.ndarray
    last_converged: np.ndarray
    min_gap: np.ndarray
    min_det: np.ndarray
    blocked: np.ndarray
    newton: np.ndarray
    linear: np.ndarray
    elastic: np.ndarray
    barrier: np.ndarray
    substeps: np.ndarray

    @classmethod
    def of_none(cls, failed: np.ndarray, elastic: np.ndarray, barrier: np.ndarray) -> SceneReport:
        """Report of no substep, after which the state has these energies (B,) [J]."""
        none = np.zeros(len(failed), int)
        return cls(
            failed=failed.copy(),
            converged=~failed,
            unconverged=none,
            last_converged=~failed,
            min_gap=none + np.inf,
            min_det=none + 1.0,
            blocked=none + 0.0,
            newton=none,
            linear=none,
            elastic=elastic,
            barrier=barrier,
            substeps=none,
        )

    def then(self, later: SceneReport) -> SceneReport:
        """This and a later part of the step as one."""
        return replace(
            later,
            failed=self.failed | later.failed,
            converged=self.converged & later.converged,
            last_converged=np.where(later.substeps > 0, later.last_converged, self.last_converged),
            unconverged=self.unconverged + later.unconverged,
            min_gap=np.minimum(self.min_gap, later.min_gap),
            min_det=np.minimum(self.min_det, later.min_det),
            blocked=np.maximum(self.blocked, later.blocked),
            newton=self.newton + later.newton,
            linear=self.linear + later.linear,
            substeps=self.substeps + later.substeps,
        )


@dataclass(frozen=True)
class SceneState:
    """Complete state of a scene, from ``SoftScene.save``."""

    world: ipc.State
    poses: Poses
