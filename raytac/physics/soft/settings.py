"""Settings of soft pads: surface correction, substeps, scene solver, press control."""

from __future__ import annotations

from dataclasses import dataclass, fields

from raytac.checks import check_number, check_truth, check_whole
from raytac.errors import InputError


@dataclass(frozen=True)
class _Settings:
    """Switches, and numbers greater than 0, whole where the default is."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(field.default, bool):
                check_truth(field.name, value)
            elif isinstance(field.default, int):
                check_whole(field.name, value)
            elif isinstance(field.default, float):
                check_number(field.name, value, "(0, inf)")


@dataclass(frozen=True)
class Correction(_Settings):
    """Correction of a soft pad's surface below the size of its mesh's cells, in three stages.

    Each stage exchanges the mesh's linear response for that of the gel layer (defect correction, see ``NormalCorrection``). All need the
    pressure on the fine grid, so that is solved for if any stage is on. The plain finite-element surface of ``None`` is the spline through
    the coat's vertices.
    """

    normal: bool = True
    """Correct the height in and around the contact (``NormalCorrection``)."""
    tangential: bool = True
    """Correct how far pressure spreads the skin sideways (``TangentialCorrection``)."""
    friction: bool = True
    """Correct how far the skin follows a sheared or twisted object (``FrictionCorrection``)."""
    pitch: float = 0.05e-3
    """Least spacing of the fine grid [m]; the surface's own grid if above 0.9 times this."""
    gap_tolerance: float = 1e-6
    """Deepest overlap and widest gap under pressure of a solved contact [m]."""
    normal_iterations: int = 40
    """Most steps of the search for the pressure; the best of them counts."""
    unsolved: float = 5e-6
    """Residual above which an ``UnsolvedContactWarning`` is given [m]."""
    closed_gap: float = 20e-6
    """Scale [m] below which gaps under pressure are closed: waves leave some beside a sharp rim."""
    open_gap: float = 5e-3
    """Gap that stands for "no object" [m]: wider than any press closes."""
    clear_gap: float = 0.4e-3
    """Gap without pressure that keeps a node clear [m]: more than gel rises beside a contact."""
    least_load: float = 1e-4
    """Share of the greatest load, or pressure, below which a vertex, or node, does not touch."""
    tangential_pitch: float = 0.2e-3
    """Spacing of the grid of sideways motion [m]: shorter waves hardly move the skin."""
    motion_tolerance: float = 0.5e-6
    """Difference below which two sideways motions are equal [m]."""
    stick_tolerance: float = 2e-6
    """Slip of nodes that should stick which is accepted [m]."""
    sliding_share: float = 0.05
    """Share of sticking nodes below which the whole contact slides."""
    full_blend: float = 0.3
    """Share of motion that the layer does not explain, up to which friction is corrected fully."""
    no_blend: float = 0.5
    """The same above which friction is not corrected at all; linear between."""
    small_motion: float = 20e-6
    """Motion [m] below which that share says little: a press just off the centre (a guess)."""
    slip_iterations: int = 6
    """Most updates of the object's motion and of the slip limit."""
    traction_iterations: int = 10
    """Projected-gradient steps in each of them."""
    force_iterations: int = 200
    """Most conjugate-gradient steps for the forces that hold the mesh."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.normal or self.tangential or self.friction):
            raise InputError("correction", value=self, rule="must have a stage that is on; None shows the plain surface")
        if not self.full_blend < self.no_blend:
            raise InputError("no_blend", value=self.no_blend, rule=f"must be greater than full_blend, {self.full_blend}")


DEFAULT_CORRECTION = Correction()


@dataclass(frozen=True)
class SubstepLimits(_Settings):
    """Limits on the relative motion of near bodies in a substep, and on the number of these."""

    step: float = 1e-4
    """Longest relative displacement [m]."""
    turn: float = 0.035
    """Largest relative rotation [rad]: 0.1 mm at 3 mm from the axis."""
    most: int = 64
    """Most substeps of one step, a power of two: 6.4 mm or 128° near another body."""
    reach: float = 4.0
    """Distance below which bodies are near, in units of d̂."""
    clear: float = 1e-3
    """Distance along a face normal [m] at both ends of a motion that rules out a contact."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.most & (self.most - 1):
            raise InputError("most", value=self.most, rule="must be a power of two")


@dataclass(frozen=True)
class SceneSettings(_Settings):
    """Accuracy of a soft scene, whose steps have a physical duration."""

    slip: float = 5e-7
    """Elastic slip ε of a contact [m].

    Under a share r of the friction limit it gives way by ε (1 − √(1 − r)), and keeps it.
    """
    tolerance: float = 2e-8
    """A step is solved when no vertex would move further [m]; small against ``slip``."""
    linear_tolerance: float = 1e-6
    """Relative residual of the linear solve: a grasped body must follow far below ``slip``."""
    forcing: float = 1e-2
    """The same of the other linear solves, as long as the step is large."""
    substeps: SubstepLimits = SubstepLimits(step=2e-4, turn=0.07, most=32)
    """Division of steps near contact."""


@dataclass(frozen=True)
class PressControl(_Settings):
    """Accuracy and search of a quasi-static press, whose time only orders its steps."""

    time_step: float = 0.01
    """Duration of a solver step [s]; without influence where inertia is negligible."""
    tolerance: float = 5e-7
    """A step is solved when no vertex would move further [m]."""
    slip: float = 1e-6
    """Elastic slip of a contact that sticks [m]."""
    blocked: float = 1e-3
    """Share of a step's motion that may be refused before a contact counts as jammed."""
    stiffer: float = 4.0
    """Factor on the barrier's stiffness where a contact jams, such as a cone's tip on one facet.

    A barrier's pressure is bounded while surfaces keep apart, and few small facets carry the force."""
    stiffenings: int = 4
    """Most such increases in one step."""
    friction_tolerance: float = 1e-3
    """Share by which normal forces that bound friction may be off in a solved step.

    A search for a force needs it to be small.
    """
    depth_tolerance: float = 1e-6
    """A depth is reached within this [m]."""
    depth_steps: int = 12
    """Most steps of the search for a depth."""
    force_tolerance: float = 5e-4
    """A normal force is reached within this share."""
    force_steps: int = 120
    """Most steps of the search for a force; a free object takes up to four times as many."""
    refinements: int = 4
    """Most repetitions of a correction: of friction, a step that did not converge."""
    stiffness_change: float = 0.01
    """Least relative change of force that gives the contact's stiffness; less may be friction."""
    growth: float = 8.0
    """Factor on the present normal force up to which the contact's stiffness is extrapolated."""
    least_force: float = 1e-6
    """Force below which there is none [N]."""
    release_stretch: float = 3.0
    """Steps of a release may be so many times as long."""
    rest_speed: float = 2e-5
    """Speed below which a free object lies still [m/s]."""
    substeps: SubstepLimits = SubstepLimits()
    """Only ``step`` and ``turn`` apply: a press is moved in steps of that size from the start."""


DEFAULT_CONTROL = PressControl()
DEFAULT_ACCURACY = SceneSettings()
