"""Settings of a time step."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite
from typing import Literal

import numpy as np

from ipc.bodies.layout import Layout
from ipc.errors import IpcError

RIGID_STIFFNESS = 1e5
"""Least κ of a world without a soft body [Pa]."""


@dataclass(frozen=True)
class Settings:
    """Settings of a world; every one has a default that suits a gel pad of some millimetres.

    Attributes:
        dt: time step h [s].
        gravity: acceleration [m/s²], world frame.
        velocity_tolerance: Newton stops once no unknown would move faster than this [m/s]: ‖p‖_∞ ≤ velocity_tolerance · h.
        max_newton: Newton iterations a step; reaching it is reported.
        halvings: how often a step that has not converged is taken back and repeated in two halves; each half in turn. The report says so,
            and its iterations count. 0: the state so far is kept.
        d_hat: distance below which surfaces repel [m]; None: 0.1 of the shortest edge on the deformable surfaces.
        kappa: barrier stiffness κ [Pa]; None: :func:`barrier_stiffness` of the bodies.
        friction: default coefficient μ [-] of every pair of bodies (``World`` takes exceptions by name).
        friction_slip: ε [m]; the elastic slip at which a contact yields: friction grows smoothly from zero to its limit over this way,
            and is remembered. Contacts are softer to shear by 2μλ/ε in series, so ε is to be small against the motions of interest.
        friction_relags: number of times that a step may renew the normal forces and tangents that bound friction after its first solve;
            a step that still changes them then has not converged. 0: they are those at the start of the step, unchecked.
        friction_tolerance: a step renews them until they change by less than this fraction [-].
        linear_tolerance: relative residual ‖r‖/‖g‖ of the linear solve whose p is within ``velocity_tolerance`` and may be the last [-].
        forcing: the same of the other linear solves [-]; 0: that of ``linear_tolerance``, which is the least.
        max_linear: PCG iterations a solve.
        preconditioner: of PCG: ``"block_jacobi"``, ``"rest_inverse"`` (bonded bodies' rest matrix inverted once, contacts as a low-rank
            part; ``docs/concepts/preconditioners.md``), or ``"auto"``, whichever was measured to be faster on the device.
        max_line_search: halvings a line search; when none lowers the energy the step is not taken, and the report says so.
        armijo: share of the decrease that the slope promises which a step must achieve to be accepted [-].
        ccd_slack: share of a gap that a Newton step has to leave [-].
        motion_fraction: share of a gap that one advance of the driven bodies may use up [-].
        gap_floor: gap, as a share of d̂, that an advance of the driven bodies has to leave; the soft side is given time to yield first.
        max_advance_attempts: how often an advance of the driven bodies is shortened; the last but one stays in place.
        poor_advance: share of the remaining motion below which the unknowns get time to rest before the bodies advance again [-].
        blocked_advance: share of the motion of the driven bodies below which an advance after such a rest says that they are blocked [-].
        broad_phase: search for pairs that may touch: ``"lists"`` (all against all, of what reaches the other body), ``"bvh"``
            (bounding volume hierarchies), or ``"auto"`` (by the numbers of edges and of body pairs). The pairs are the same.
        graph: run a step as one recorded graph; on a CPU from a world's second step on, and with the preconditioner ``"block_jacobi"``.
            False launches kernel by kernel, with the same results; it is slower but fills the stages of ``World.timers``.
        deterministic: on CUDA, add contact forces and rows in a fixed order, one thread an environment: the same call gives the same
            bits, and an environment of a batch those of a world of its own. Slower; a CPU does it anyway. With ``"rest_inverse"`` asked
            for, a batch agrees with single worlds to the linear tolerance only.
    """

    dt: float = 0.01
    gravity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    velocity_tolerance: float = 1e-4
    max_newton: int = 100
    halvings: int = 2
    d_hat: float | None = None
    kappa: float | None = None
    friction: float = 0.0
    friction_slip: float = 1e-6
    friction_relags: int = 30
    friction_tolerance: float = 0.01
    linear_tolerance: float = 1e-2
    forcing: float = 0.0
    max_linear: int = 2000
    preconditioner: Literal["auto", "block_jacobi", "rest_inverse"] = "auto"
    max_line_search: int = 30
    armijo: float = 1e-4
    ccd_slack: float = 0.1
    motion_fraction: float = 0.8
    gap_floor: float = 0.01
    max_advance_attempts: int = 8
    poor_advance: float = 0.05
    blocked_advance: float = 1e-4
    broad_phase: Literal["auto", "lists", "bvh"] = "auto"
    graph: bool = True
    deterministic: bool = False

    def __post_init__(self) -> None:
        for name in ("dt", "velocity_tolerance", "friction_slip", "linear_tolerance", "friction_tolerance"):
            if not getattr(self, name) > 0:
                raise IpcError(f"{name} = {getattr(self, name)}: it must be positive")
        if len(self.gravity) != 3 or not all(isfinite(g) for g in self.gravity):
            raise IpcError(f"gravity = {self.gravity}: it must be three finite numbers")
        for name in ("max_newton", "max_linear", "max_line_search"):
            if getattr(self, name) < 1:
                raise IpcError(f"{name} = {getattr(self, name)}: at least one is needed")
        for name in ("d_hat", "kappa"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise IpcError(f"{name} = {value}: it must be positive, or None for the default")
        if not self.friction >= 0:
            raise IpcError(f"friction = {self.friction}: a coefficient cannot be negative")
        if not self.forcing >= 0:
            raise IpcError(f"forcing = {self.forcing}: a residual cannot be negative; 0 is that of linear_tolerance")
        for name in ("friction_relags", "halvings"):
            if getattr(self, name) < 0:
                raise IpcError(f"{name} = {getattr(self, name)}: it cannot be negative")
        if self.preconditioner not in ("auto", "block_jacobi", "rest_inverse"):
            raise IpcError(f"preconditioner = {self.preconditioner!r}: choose 'auto', 'block_jacobi' or 'rest_inverse'")
        if self.broad_phase not in ("auto", "lists", "bvh"):
            raise IpcError(f"broad_phase = {self.broad_phase!r}: choose 'auto', 'lists' or 'bvh'")
        if self.max_advance_attempts < 2:
            raise IpcError(f"max_advance_attempts = {self.max_advance_attempts}: at least two are needed")
        for name in ("armijo", "ccd_slack", "motion_fraction", "gap_floor", "poor_advance", "blocked_advance"):
            if not 0 < getattr(self, name) < 1:
                raise IpcError(f"{name} = {getattr(self, name)}: it must lie between 0 and 1")


def barrier_stiffness(layout: Layout, dt: float) -> float:
    """κ [Pa] for the bodies of a world and its time step.

    The largest of the Young's moduli of soft bodies (1e5 Pa without one) and of ρ V^(2/3) (1 + s)/h² of the affine bodies, s being the
    strength of a drive. That is the pressure on a face of the body that moves it, or pulls it from its drive, by its own size in a step,
    and so the order of the largest that a contact has to bear. A barrier is not made stiffer than the affine body itself.

    It depends on nothing that changes as the world moves, so that forces and energies are functions of the state alone: a press does not
    depend on what was pressed before.
    """
    inertia = np.minimum(layout.affine_inertia / dt**2, layout.affine_stiffness)
    return float(max(layout.max_young or RIGID_STIFFNESS, inertia.max(initial=0.0)))
