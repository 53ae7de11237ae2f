"""Where the coat's vertices go sideways once the contact is found on the fine grid."""

from __future__ import annotations

import numpy as np

from raytac.gel.interpolate import sampled
from raytac.gel.matmul import product, sandwich
from raytac.physics.soft.correction.friction import Grip, RigidMotion
from raytac.physics.soft.correction.layer import layer_compliance, layer_spread
from raytac.physics.soft.correction.normal import FineContact, FineShape
from raytac.specs.sensor import GelpadSpec

__all__ = ["SkinMotion"]

_SPACING = 0.2e-3
"""Spacing of the places at which the layer's motion is computed [m]; shorter waves than twice that hardly move the skin sideways."""


class SkinMotion:
    """Takes the mesh's own way of spreading and of being dragged out of a coat's motion, one pad at a time.

    Nearly incompressible gel gives way sideways under pressure, and a mesh whose cells are as wide as the contact pushes it out far too
    much: E, what the mesh does sideways under the normal forces of ``FineContact``, is to be exchanged for L, the layer's own response to
    the pressure on the fine grid, as the height is. But what touches sticks: friction has let only a share θ of that spread happen,
    of which the rest of the solver's motion u, under shear and twist, says nothing. So the skin goes

        u − θ (E − L),   θ = ⟨u, E⟩ / ⟨E, E⟩ within [0, 1],

    the products over the vertices in contact, less their rigid motions (u has the object's shear and twist besides). Without friction u is
    E but for large strain, and θ is 1, as where only one vertex touches; what sticks from the first has θ = 0. The finer the mesh, the
    smaller is E − L. One θ holds for all of a pad's contact.

    What is left in contact, u − θ E, is friction's doing, and how far the skin around follows it is exchanged by ``Grip``.
    """

    def __init__(self, contact: FineContact, gelpad: GelpadSpec, compliance: np.ndarray, continued: np.ndarray) -> None:
        """``compliance`` [m/N], (3, V, V): displacements along x, y, z of the vertices over a force along z on each; ``continued``,
        (3, 3, V, V): over a force along x, y, z (first axis) if the sides of the pad may not move outwards."""
        self._grip = Grip(contact, gelpad, continued[:2, :2])
        self._contact = contact
        self._mesh = compliance[:2].astype(np.float32)
        self._sides = (compliance[:2] - continued[2, :2]).astype(np.float32)
        self._x, self._y = (t[:: max(round(_SPACING / (t[1] - t[0])), 1)] for t in (contact.x, contact.y))
        series_x, series_y = contact.series_x, contact.series_y
        self._some = np.ix_(*(s.wave_numbers * (t[1] - t[0]) <= np.pi for s, t in ((series_y, self._y), (series_x, self._x))))
        along_y, along_x = (s.wave_numbers[np.ravel(k)] for s, k in zip((series_y, series_x), self._some, strict=True))
        wave = np.hypot(along_x[None, :], along_y[:, None])
        share = layer_spread(wave, gelpad) / layer_compliance(wave, gelpad) / np.maximum(wave, along_x[1])
        columns, rows = len(along_x), len(along_y)
        self._spread_x, self._spread_y = (share * along_x).astype(np.float32), (share * along_y[:, None]).astype(np.float32)
        self._cos_x, self._sin_x = (f(self._x)[:, :columns].T.astype(np.float32) for f in (series_x.synthesis, series_x.sines))
        self._cos_y, self._sin_y = (f(self._y)[:, :rows].astype(np.float32) for f in (series_y.synthesis, series_y.sines))

    def sideways(self, shape: FineShape, moved: np.ndarray, load: np.ndarray, friction: float | None = None) -> np.ndarray:
        """Displacement along x, y [m], (V, 2), of vertices that went ``moved`` (V, 3) in the solver.

        ``load``: normal force on each [N], (V,); ``friction``: μ, None or 0 where what it does is to be left as the mesh has it.
        """
        rest, touching = self._contact.surface.mesh.rest, self._contact.touching(load)
        mesh = product(self._mesh.reshape(-1, len(rest)), shape.held[:, None]).reshape(2, -1).T
        layer = self._layer(shape, rest[:, 0] + moved[:, 0], rest[:, 1] + moved[:, 1])
        share = _share(mesh[touching], moved[touching, :2], rest[touching, :2])
        went = moved[:, :2] - share * (mesh - layer)
        if friction:
            went += self._grip.exchange(shape, moved[:, :2] - share * mesh, touching, load, friction)
        return went

    def _layer(self, shape: FineShape, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Motion of the layer, whose sides are the pad's, under the fine grid's pressure [m], (V, 2)."""
        waves = shape.waves[self._some]
        field = np.stack(
            [
                sandwich(self._cos_y, self._spread_x * waves, self._sin_x),
                sandwich(self._sin_y, self._spread_y * waves, self._cos_x),
            ]
        )
        force = sandwich(self._contact.force_y, shape.pressure, self._contact.force_x).reshape(-1, 1)
        sides = product(self._sides.reshape(-1, len(force)), force).reshape(2, -1)
        return (sampled(field, self._x, self._y, x, y) - sides).T


def _share(pattern: np.ndarray, moved: np.ndarray, place: np.ndarray) -> float:
    """How much of a ``pattern`` (T, 2) there is in what ``moved`` (T, 2), besides a rigid motion of the ``place`` (T, 2); in [0, 1]."""
    moved = moved - RigidMotion.of(moved, place, np.ones(len(place))).at(place)
    arm = place - place.mean(axis=0)
    turn = np.stack([-arm[:, 1], arm[:, 0]], axis=1)
    turn /= max(float(np.linalg.norm(turn)), 1e-12)

    def without_rigid(field: np.ndarray) -> np.ndarray:
        field = field - field.mean(axis=0)
        return field - (field * turn).sum() * turn

    pattern, moved = without_rigid(pattern), without_rigid(moved)
    size = float((pattern**2).sum())
    return float(np.clip((pattern * moved).sum() / size, 0.0, 1.0)) if size > 0.0 else 1.0
