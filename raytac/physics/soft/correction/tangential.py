"""Correction of the sideways displacement of the coat's vertices."""

from __future__ import annotations

import numpy as np

from raytac.gel.interpolate import sampled
from raytac.gel.matmul import product, sandwich
from raytac.physics.bonded_layer import layer_compliance, layer_spread
from raytac.physics.soft.correction.friction import FrictionCorrection, PlaneMotion, plane_displacement, plane_waves
from raytac.physics.soft.correction.normal import NormalContact, NormalCorrection
from raytac.specs.sensor import GelpadSpec


class TangentialCorrection:
    """Corrects the skin's spread under pressure and its drag by friction, one pad at a time.

    Nearly incompressible gel moves sideways under pressure. A mesh whose cells are as wide as the contact pushes it out far too much.
    Let E be what the mesh does sideways under the normal forces of ``NormalContact``, and L the layer's own response to the pressure on the
    fine grid. Friction has let only a share θ of that spread happen, and the rest of the solver's displacement u (shear, twist) says
    nothing of it. So the skin's displacement becomes

        u − θ (E − L),   θ = ⟨u, E⟩ / ⟨E, E⟩ within [0, 1],

    with products over the vertices in contact, after their rigid motions were removed (u contains the object's shear and twist). Without
    friction, u is E but for large strain, and θ is 1, as where only one vertex touches. A contact that sticks from the first has
    θ = 0. The finer the mesh, the smaller is E − L. One θ holds for all of a pad's contact.

    The remainder in contact, u − θ E, is due to friction. How far the skin around follows it is corrected by ``FrictionCorrection``.
    """

    def __init__(self, normal: NormalCorrection, gelpad: GelpadSpec, compliance: np.ndarray, continued: np.ndarray) -> None:
        """Prepare the grid of sideways displacements.

        Args:
            compliance: displacements along x, y, z of the vertices over a force along z on each [m/N], (3, V, V).
            continued: the same over a force along x, y, z (first axis) if the pad's sides may not move outwards, (3, 3, V, V).
        """
        self._friction = FrictionCorrection(normal, gelpad, continued[:2, :2])
        self._normal, self._settings = normal, normal.settings
        self._mesh = compliance[:2].astype(np.float32)
        self._sides = (compliance[:2] - continued[2, :2]).astype(np.float32)
        pitch = self._settings.tangential_pitch
        self._x, self._y = (t[:: max(round(pitch / (t[1] - t[0])), 1)] for t in (normal.x, normal.y))
        series_x, series_y = normal.series_x, normal.series_y
        resolved = (s.wave_numbers * (t[1] - t[0]) <= np.pi for s, t in ((series_y, self._y), (series_x, self._x)))
        self._resolved = np.ix_(*resolved)
        k_y, k_x = (s.wave_numbers[np.ravel(k)] for s, k in zip((series_y, series_x), self._resolved, strict=True))
        k = np.hypot(k_x[None, :], k_y[:, None])
        ratio = layer_spread(k, gelpad) / layer_compliance(k, gelpad) / np.maximum(k, k_x[1])
        self._spread = np.stack([ratio * k_x, ratio * k_y[:, None]]).astype(np.float32)
        over_x, over_y = plane_waves(series_x, series_y, self._x, self._y)
        self._lines = tuple(np.asfortranarray(m[: len(k_x)]) for m in over_x), tuple(m[:, : len(k_y)] for m in over_y)

    def sideways(
        self, contact: NormalContact, displacement: np.ndarray, load: np.ndarray, friction: float | None = None
    ) -> np.ndarray:
        """Corrected displacement along x, y [m], (V, 2).

        Args:
            contact: solution of the normal stage.
            displacement: u of the solver's vertices [m], (V, 3).
            load: normal force on each [N], (V,).
            friction: μ; None or 0 leaves the effect of friction as the mesh has it.
        """
        rest, touching = self._normal.surface.mesh.rest, self._normal.touching(load)
        u = displacement[:, :2]
        mesh = product(self._mesh.reshape(-1, len(rest)), contact.mesh_forces[:, None]).reshape(2, -1).T
        θ = _share(mesh[touching], u[touching], rest[touching, :2])
        corrected = u.copy()
        if self._settings.tangential:
            corrected -= θ * (mesh - self._layer(contact, rest[:, 0] + u[:, 0], rest[:, 1] + u[:, 1]))
        if self._settings.friction and friction:
            corrected += self._friction.correct(contact, u - θ * mesh, touching, load, friction)
        return corrected

    def _layer(self, contact: NormalContact, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """L: sideways displacement of the layer under the fine grid's pressure [m], (V, 2)."""
        field = plane_displacement(self._spread * contact.waves[self._resolved], self._lines)
        force = sandwich(self._normal.force_y, contact.pressure, self._normal.force_x).reshape(-1, 1)
        sides = product(self._sides.reshape(-1, len(force)), force).reshape(2, -1)
        return (sampled(field, self._x, self._y, x, y) - sides).T


def _share(pattern: np.ndarray, displacement: np.ndarray, place: np.ndarray) -> float:
    """Share in [0, 1] of a ``pattern`` (T, 2) in a ``displacement``, besides rigid motions."""
    displacement = displacement - PlaneMotion.fit(displacement, place, np.ones(len(place))).at(place)
    arm = place - place.mean(axis=0)
    turn = np.stack([-arm[:, 1], arm[:, 0]], axis=1)
    turn /= max(float(np.linalg.norm(turn)), 1e-12)

    def without_rigid(field: np.ndarray) -> np.ndarray:
        field = field - field.mean(axis=0)
        return field - (field * turn).sum() * turn

    pattern, displacement = without_rigid(pattern), without_rigid(displacement)
    size = float((pattern**2).sum())
    return float(np.clip((pattern * displacement).sum() / size, 0.0, 1.0)) if size > 0.0 else 1.0
