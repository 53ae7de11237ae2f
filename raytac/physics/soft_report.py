"""What a soft scene's step says about itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["SceneReport"]


@dataclass(frozen=True)
class SceneReport:
    """One step of B environments, all of its parts together; every array has shape (B,).

    failed: a number was not finite; the environment stays as it was until it is reset. converged: every part met its tolerance.
    unconverged: how many parts of an environment that has not failed did not. last_converged: whether the last part did.
    min_gap: least distance between surfaces [m], inf if none was near. min_det: least det F of any tetrahedron [-]. blocked: largest share
    of a part's motion that was refused because it would crush what is in the way. newton: iterations. elastic, barrier: energies at the
    end [J]. substeps: parts of the step.
    """

    failed: np.ndarray
    converged: np.ndarray
    unconverged: np.ndarray
    last_converged: np.ndarray
    min_gap: np.ndarray
    min_det: np.ndarray
    blocked: np.ndarray
    newton: np.ndarray
    elastic: np.ndarray
    barrier: np.ndarray
    substeps: int

    def then(self, later: SceneReport) -> SceneReport:
        """Both parts of a step as one."""
        return SceneReport(
            self.failed | later.failed,
            self.converged & later.converged,
            self.unconverged + later.unconverged,
            later.last_converged,
            np.minimum(self.min_gap, later.min_gap),
            np.minimum(self.min_det, later.min_det),
            np.maximum(self.blocked, later.blocked),
            self.newton + later.newton,
            later.elastic,
            later.barrier,
            self.substeps + later.substeps,
        )
