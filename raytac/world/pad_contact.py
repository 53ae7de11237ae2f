"""Contact of a world's pads: their names in MuJoCo's model, and ``GelContact``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from raytac.physics.rigid.gel_contact import Bodies, GelContact
from raytac.physics.rigid.search import PadSearch
from raytac.world.environment_models import EnvironmentModels
from raytac.world.hard_contacts import HARD_MARGIN, is_hard
from raytac.world.world_model import WorldModel

_CASE_TRAVEL = 0.8 * HARD_MARGIN
"""Greatest travel of a body beside a case in a step [m]; below the margin of contacts."""


@dataclass(frozen=True)
class PadIndices:
    """Indices into MuJoCo's model of pads and of what they touch."""

    sites: np.ndarray
    """At the pads' frames, (pads,)."""
    carriers: np.ndarray
    """Bodies that carry the pads, (pads,)."""
    bodies: np.ndarray
    """That pads touch, (bodies,)."""
    geoms: np.ndarray
    """One of each body that pads touch, then of the gels, (bodies + pads,)."""
    hard: np.ndarray
    """True for geoms with the law of ``hard_contacts``, (ngeom,)."""

    @classmethod
    def of(cls, composed: WorldModel) -> PadIndices:
        """Those of a world's model."""
        model, sensors = composed.model, composed.sensors
        geoms = [body.geoms[0] for body in composed.touched] + [int(model.geom(mounted.gel).id) for mounted in sensors]
        return cls(
            np.array([model.site(mounted.site).id for mounted in sensors], int),
            np.array([model.body(mounted.body).id for mounted in sensors], int),
            np.array([body.index for body in composed.touched], int),
            np.array(geoms, int),
            # A given model keeps the contacts that it has.
            is_hard(model) if composed.scene is not None else np.zeros(model.ngeom, bool),
        )


def gel_contact(
    composed: WorldModel,
    models: EnvironmentModels,
    pairs: Sequence[tuple[int, int, PadSearch]],
    *,
    num_envs: int,
    device: str = "cpu",
) -> GelContact:
    """Contacts of B environments with a world's gels; ``pairs``: gels that may touch."""
    model, at = composed.model, PadIndices.of(composed)
    cases = [int(model.geom(mounted.case).id) for mounted in composed.sensors]
    touched = Bodies(
        [body.parts for body in composed.touched],
        at.bodies,
        at.carriers,
        model.body_ipos[np.concatenate([at.bodies, at.carriers])],
        model.geom_pos[cases],
        model.geom_size[cases],
    )
    return GelContact(
        tuple(spec.gelpad for spec in composed.sensor_specs),
        touched,
        pairs,
        {
            "inverse_weight": models.inverse_weight,
            "gel_stiffness": models.gel_stiffness,
            "gel_friction": models.gel_friction,
            "body_friction": models.friction_on_gel,
        },
        num_envs=num_envs,
        timestep=composed.timestep,
        case_travel=_CASE_TRAVEL,
        device=device,
    )


def last_dofs(model: mujoco.MjModel, bodies: np.ndarray) -> np.ndarray:
    """Last degree of freedom that moves each of the bodies (n,); −1 of one that stands still."""
    result = []
    for body in bodies.tolist():
        while body and not model.body_dofnum[body]:
            body = int(model.body_parentid[body])
        result.append(int(model.body_dofadr[body] + model.body_dofnum[body]) - 1 if body else -1)
    return np.array(result, int)
