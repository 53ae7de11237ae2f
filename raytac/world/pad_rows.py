"""Rows of MuJoCo's constraint for contacts of gels: normal spring, shear, spin and tilt of one step, written where MuJoCo keeps them.

MuJoCo minimises over accelerations a of constraint rows ½ Σ (a − a*)² / R within an elliptic friction cone: a row that is not cut by the
cone carries f = (a* − a) / R. With R = 1 / (G Δt) and a* = −v / Δt + f₀ / (G Δt) that is f = f₀ − G v₁, v₁ = v + Δt a the speed at the
end of the step. So every row is a given force and a viscous one at the end of the step:

| row | f₀ | G |
|---|---|---|
| normal | F(δ) | c K (``normal_spring``) |
| tangents | −k s, the shear's | k c, c >= Δt |
| spin | −k s, the shear's | as of the tangents on the lever of the cone |
| rolling | 0 | N m Δt, m the metacentric height |

The last row replaces what a single contact point lacks. A flat face that tilts moves the centre of pressure by its spread m per radian, so
the normal load turns it back with the stiffness N m, taken at the start of a step. That is stable with as much at its end, which the
viscous row gives. Of a ball m is 0, and its row is the friction of rolling.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import mujoco
import numpy as np

if TYPE_CHECKING:
    from raytac.world.environment_models import EnvironmentModels

ROWS = 6
"""Rows of a contact: normal, two tangents, spin, two of rolling."""
_NEXT, _AFTER = np.array([1, 2, 0]), np.array([2, 0, 1])
_LEAST = 1e-6
"""Least coefficient of friction, which MuJoCo wants positive."""


@dataclass(frozen=True)
class PadRows:
    """Rows of n contacts of one step."""

    position: np.ndarray
    """Place, world frame [m], (n, 3)."""
    frame: np.ndarray
    """Rows normal from gel to body, and two tangents, world frame, (n, 9)."""
    friction: np.ndarray
    """MuJoCo's coefficients: two tangents, spin [m], rolling about both tangents [m], (n, 5)."""
    force: np.ndarray
    """f₀ [N, N m], (n, 6)."""
    damping: np.ndarray
    """G [N s/m, N m s] of normal and tangents, (n, 2)."""
    step: np.ndarray
    """Δt [s], (n,)."""

    def regularisation(self) -> np.ndarray:
        """R, (n, 6): those of spin and rolling follow from the cone's levers."""
        friction = np.maximum(self.friction, _LEAST)
        result = np.empty((len(self.step), ROWS))
        result[:, 0] = 1.0 / (self.damping[:, 0] * self.step)
        result[:, 1:] = (1.0 / (self.damping[:, 1] * self.step))[:, None] * (friction[:, :1] / friction) ** 2
        return result


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross products (…, 3); NumPy's own takes several times as long for a few."""
    return a[..., _NEXT] * b[..., _AFTER] - a[..., _AFTER] * b[..., _NEXT]


def tangents(normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit tangents (n, 3) of a gel: along the pad's x as nearly as can be, and that turned by 90° about the normal (n, 3)."""
    first = -normal[:, :1] * normal
    first[:, 0] += 1.0
    first /= np.sqrt(np.vecdot(first, first))[:, None]
    return first, cross(normal, first)


def write_rows(
    models: Sequence[mujoco.MjModel] | EnvironmentModels,
    datas: Sequence[mujoco.MjData],
    rows: PadRows,
    envs: np.ndarray,
    geoms: np.ndarray,
    failed: np.ndarray,
) -> None:
    """Put contacts after MuJoCo's own, after ``mj_step1``; environments whose memory for contacts is full are marked in ``failed``.

    ``envs`` (n,): environments, sorted; ``geoms`` (n, 2): of gel and body.
    """
    inverse = rows.regularisation()
    for b, some in _runs(envs):
        model, data = models[b], datas[b]
        if not _write_contacts(model, data, rows, some, geoms[some]):
            failed[b] = True
            continue
        # The contacts come after MuJoCo's own collision, so what it has built on those is built again.
        mujoco.mj_makeConstraint(model, data)
        _write_constraint(data, inverse[some], rows.friction[some])
        mujoco.mj_island(model, data)
        mujoco.mj_projectConstraint(model, data)
        mujoco.mj_referenceConstraint(model, data)
        _write_reference(data, inverse[some], rows.force[some], float(rows.step[some.start]))


def read_rows(
    models: Sequence[mujoco.MjModel] | EnvironmentModels, datas: Sequence[mujoco.MjData], envs: np.ndarray, failed: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Forces [N, N m] of rows, and their velocities [m/s, rad/s] at the end of the step, each (n, 6), after ``mj_step2``; 0 if failed."""
    force, velocity = np.zeros((2, len(envs), ROWS))
    for b, some in _runs(envs):
        if not failed[b]:
            last, whole = slice(-ROWS * (some.stop - some.start), None), np.empty(datas[b].nefc)
            mujoco.mj_mulJacVec(models[b], datas[b], whole, datas[b].qvel)
            force[some], velocity[some] = (values[last].reshape(-1, ROWS) for values in (datas[b].efc_force, whole))
    return force, velocity


def _runs(envs: np.ndarray) -> Iterator[tuple[int, slice]]:
    """Environments of sorted rows, and the rows of each."""
    bounds = [*np.flatnonzero(np.diff(envs, prepend=-1)).tolist(), len(envs)]
    for start, stop in pairwise(bounds):
        yield int(envs[start]), slice(start, stop)


def _write_contacts(model: mujoco.MjModel, data: mujoco.MjData, rows: PadRows, chosen: slice, geoms: np.ndarray) -> bool:
    """Put the chosen contacts after MuJoCo's own; False if its memory is full. ``geoms`` (n, 2): of gel and body."""
    count, blank = chosen.stop - chosen.start, _blank()
    for _ in range(count):
        if mujoco.mj_addContact(model, data, blank) != 0:
            return False
    contact = data.contact
    contact.pos[-count:], contact.frame[-count:] = rows.position[chosen], rows.frame[chosen]
    contact.friction[-count:] = np.maximum(rows.friction[chosen], _LEAST)
    contact.geom[-count:] = geoms
    contact.geom1[-count:], contact.geom2[-count:] = geoms.T
    return True


def _write_constraint(data: mujoco.MjData, regularisation: np.ndarray, friction: np.ndarray) -> None:
    """Set R (n, 6) of the last n contacts, after ``mj_makeConstraint``."""
    count = len(regularisation)
    data.efc_R[-ROWS * count :] = regularisation.ravel()
    data.efc_D[-ROWS * count :] = 1.0 / regularisation.ravel()
    # The solver's cone is that of the dual one with the rows scaled by √R.
    data.contact.mu[-count:] = np.maximum(friction[:, 0], _LEAST) * np.sqrt(regularisation[:, 1] / regularisation[:, 0])


def _write_reference(data: mujoco.MjData, regularisation: np.ndarray, force: np.ndarray, step: float) -> None:
    """Set a* of the last n contacts, after ``mj_referenceConstraint``."""
    some = slice(-force.size, None)
    data.efc_aref[some] = (force * regularisation).ravel() - data.efc_vel[some] / step


def _blank() -> mujoco.MjContact:
    contact = mujoco.MjContact()
    contact.dist, contact.includemargin, contact.dim, contact.exclude = -1e-6, 0.0, ROWS, 0
    contact.solref[:], contact.solimp[:] = (0.02, 1.0), (0.9, 0.9, 1e-3, 0.5, 2.0)
    contact.solreffriction[:] = 0.0
    contact.flex[:] = contact.elem[:] = contact.vert[:] = -1
    return contact
