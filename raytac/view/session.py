"""The ``Session`` protocol, which the viewer shows, and the plain data that goes through it.

A session holds the physics and knows nothing of browsers; the page draws what a session hands out and knows nothing of physics. Lengths
are in metres in the session's world frame unless a field says otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from raytac.errors import InputError
from raytac.se3 import rotations

Colour = tuple[int, int, int]
"""8-bit sRGB."""


@dataclass(frozen=True)
class Quantity:
    """A number on every vertex of a coat that its colour can show."""

    label: str
    """For people, with the shown unit."""
    factor: float
    """Shown value of one SI unit."""
    least: float
    """Smallest full scale of the legend, in the shown unit; it hides the noise at rest."""


QUANTITIES = {
    "indentation": Quantity("indentation [mm]", 1e3, 0.1),
    "pressure": Quantity("normal traction [kPa]", 1e-3, 1.0),
    "shear": Quantity("shear traction [kPa]", 1e-3, 1.0),
}
"""Quantities that can colour a coat; a session may offer fewer."""


@dataclass(frozen=True)
class Control:
    """A number that a slider sets; all its values are in the unit of the label."""

    name: str
    label: str
    """For people, with the unit."""
    low: float
    high: float
    step: float
    hint: str = ""
    """A sentence that the page shows on hovering."""
    instead_of: str = ""
    """Control that this one replaces when it is moved, as force does depth; empty is none."""


def check_targets(controls: Sequence[Control], targets: Mapping[str, float]) -> None:
    """Raise ``InputError`` for a target of no control, or beyond its control's ends."""
    known = {control.name: control for control in controls}
    for name, value in targets.items():
        if name not in known:
            raise InputError("control", value=name, rule="must be one of the scene's", choices=known)
        control = known[name]
        if not control.low <= value <= control.high:
            raise InputError(control.label, value=value, rule=f"must be within {control.low:g} and {control.high:g}")


def reaching(controls: Sequence[Control], places: Mapping[str, float]) -> tuple[Control, ...]:
    """The controls, with ends moved out to a round number where ``places`` are beyond them."""
    moved = []
    for control in controls:
        place = places.get(control.name, control.low)
        if place > control.high + 0.5 * control.step:
            control = replace(control, high=round_up(place))
        elif place < control.low - 0.5 * control.step:
            control = replace(control, low=-round_up(-place))
        moved.append(control)
    return tuple(moved)


def round_up(value: float) -> float:
    """The next of 1, 2, 5 times a power of ten, within rounding; ``value`` is above 0."""
    power = 10.0 ** math.floor(math.log10(value))
    return next(step * power for step in (1.0, 2.0, 5.0, 10.0) if value <= step * power * (1.0 + 1e-9))


@dataclass(frozen=True)
class Handle:
    """Arrows and rings in the 3-D view that move controls in millimetres and degrees.

    Turns are about the world's x, then y, then z, as roll, pitch and yaw.
    """

    along: tuple[str, str, str] = ("", "", "")
    """Control of a displacement along x, y, z; empty is none, a minus before it is against."""
    about: tuple[str, str, str] = ("", "", "")
    """Control that a turn about x, y, z moves; empty is none."""

    def targets(
        self, begun: HandlePlace, pose: np.ndarray, controls: Sequence[Control], moved: Collection[str] = ()
    ) -> dict[str, float]:
        """Values of the controls for a pose (4, 4), within their ends.

        Args:
            begun: place of the handle before it was moved.
            moved: controls that the same hand has moved before; of the others, those that stay are left out.
        """
        angles = [begun.values.get(name, 0.0) for name in self.about]
        turn = pose[:3, :3] @ begun.pose[:3, :3].T @ turned_by(np.radians(angles))
        turned = np.degrees(turn_angles(turn))
        distances = 1e3 * (pose[:3, 3] - begun.pose[:3, 3])
        wanted = {name: float(angle) for name, angle in zip(self.about, turned, strict=True) if name}
        for name, distance in zip(self.along, distances, strict=True):
            bare = name.removeprefix("-")
            if bare:
                wanted[bare] = begun.values[bare] + float(-distance if name.startswith("-") else distance)
        known = {control.name: control for control in controls}
        off = {name: abs(value - begun.values[name]) / known[name].step for name, value in wanted.items()}
        ends = {name: min(max(value, known[name].low), known[name].high) for name, value in wanted.items()}
        return {name: value for name, value in ends.items() if name in moved or off[name] > 0.5}


@dataclass(frozen=True)
class HandlePlace:
    """Pose of a handle, and the values of its controls that belong to it."""

    pose: np.ndarray
    """Shape (4, 4), world frame [m]."""
    values: Mapping[str, float]
    """In the controls' units; may lie beyond their ends, as of an object above the pad."""


def turned_by(angles: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) by three angles [rad] about x, then y, then z of the world."""
    about_x, about_y, about_z = rotations(np.diag(angles))
    return about_z @ about_y @ about_x


def turn_angles(rotation: np.ndarray) -> np.ndarray:
    """Angles (3,) [rad] of which ``turned_by`` makes a rotation, the second within ±90°."""
    pitch = np.arcsin(np.clip(-rotation[2, 0], -1.0, 1.0))
    return np.array([np.arctan2(rotation[2, 1], rotation[2, 2]), pitch, np.arctan2(rotation[1, 0], rotation[0, 0])])


@dataclass(frozen=True)
class Solid:
    """A triangle mesh, made once; ``Snapshot.poses`` or ``reshaped`` places or deforms it."""

    name: str
    """Unique among solids; slashes make a tree."""
    vertices: np.ndarray
    """Shape (V, 3) [m], in the frame that its pose places."""
    faces: np.ndarray
    """Shape (F, 3), counter-clockwise from outside."""
    colour: Colour
    opacity: float = 1.0
    hides_pads: bool = False
    """True if it covers the pads; the page can make such solids see-through."""


@dataclass(frozen=True)
class Lines:
    """Line segments, placed as a solid is."""

    name: str
    segments: np.ndarray
    """Shape (N, 2, 3) [m]."""
    colour: Colour
    width: float = 1.5
    """On the screen [px]."""


@dataclass(frozen=True)
class Pad:
    """A gel pad whose coat is coloured by what it feels."""

    name: str
    """The sensor's; unique among pads."""
    faces: np.ndarray
    """Triangles of the coat, shape (F, 3), counter-clockwise seen from the object."""
    quantities: tuple[str, ...] = ("indentation",)
    """Keys of ``QUANTITIES`` that ``PadView.values`` will hold."""


@dataclass(frozen=True)
class PadView:
    """One pad and its sensor at one instant."""

    world_from_pad: np.ndarray
    """Shape (4, 4)."""
    vertices: np.ndarray
    """Coat, pad frame [m], shape (V, 3)."""
    values: Mapping[str, np.ndarray]
    """SI value of each quantity at the vertices, shape (V,)."""
    rgb: np.ndarray | None = None
    """Tactile image, shape (H, W, 3), uint8; None if the session makes none."""
    rest_rgb: np.ndarray | None = None
    """Tactile image of the untouched pad, (H, W, 3), uint8."""
    height: np.ndarray | None = None
    """z of the coat that each pixel sees, pad frame [m], (H, W)."""
    normals: np.ndarray | None = None
    """Unit normal of the coat that each pixel sees, pad frame, n_z < 0, (H, W, 3)."""
    markers_px: tuple[np.ndarray, np.ndarray] | None = None
    """Markers at rest and displacement, pixels of ``rgb``, (M, 2); NaN where not seen."""
    wrench: np.ndarray | None = None
    """Force [N] and torque about the pad frame's origin [N m] on the pad, pad frame, shape (6,)."""


@dataclass(frozen=True)
class Snapshot:
    """Everything that the page draws of one instant."""

    pads: Mapping[str, PadView]
    poses: Mapping[str, np.ndarray] = field(default_factory=dict)
    """``world_from_solid`` (4, 4) by name of solid or lines; others stay where they are."""
    reshaped: Mapping[str, np.ndarray] = field(default_factory=dict)
    """New vertices (V, 3) [m] of solids that deform."""
    controls: Mapping[str, float] = field(default_factory=dict)
    """Value of each control: the target where one drives, else the present value."""
    facts: Mapping[str, str] = field(default_factory=dict)
    """Lines of the read-out, by label."""
    warning: str = ""
    """Warning about this state; empty if there is none."""
    time_ms: Mapping[str, float] = field(default_factory=dict)
    """Wall time of what was computed [ms]."""
    time: float | None = None
    """Simulated time [s]; None of what is quasi-static."""
    handle: HandlePlace | None = None
    """Place of the session's handle; None hides it."""
    hidden: tuple[str, ...] = ()
    """Names of solids that are not there now."""


@dataclass(frozen=True)
class CameraPlace:
    """Start of the eye of the 3-D view, world frame [m]; z is up."""

    position: tuple[float, float, float]
    look_at: tuple[float, float, float]


class Session(Protocol):
    """Something to play, step, drive and draw; one thread alone calls it, one call at a time."""

    title: str
    """One line: scene, sensor, physics and optics."""
    units_per_metre: float
    """Scale of the 3-D view, so that what matters is about 1 unit large."""
    camera: CameraPlace
    controls: tuple[Control, ...]
    """Their ends may move while the scene moves, their names not."""
    is_driven_at_rest: bool
    """True if a moved control moves a paused scene too: for what is quasi-static."""
    solids: tuple[Solid, ...]
    lines: tuple[Lines, ...]
    pads: tuple[Pad, ...]
    handle: Handle | None
    """Arrows and rings that move controls; None without any."""

    def reset(self) -> None:
        """Back to the start; all controls let go."""
        ...

    def resume(self) -> None:
        """Go on with the scene's own motion; from its start if it ended or controls took over."""
        ...

    def drive(self, targets: Mapping[str, float]) -> None:
        """Set where ``advance`` takes the controls. Raises ``RaytacError`` for what cannot be."""
        ...

    def advance(self) -> bool:
        """Compute the next state; False if there was none left to compute.

        Raises ``RaytacError``: the physics broke down, or cannot go on; the session stays usable after ``reset``.
        """
        ...

    def snapshot(self) -> Snapshot:
        """The state now, with images; only this computes images."""
        ...


@dataclass(frozen=True)
class SessionMenu:
    """Drop-downs of the page, and the session that a choice makes."""

    options: Mapping[str, tuple[str, ...]]
    """Choices of each drop-down, by its label."""
    chosen: Mapping[str, str]
    """Choices that the first session shows."""
    make: Callable[[Mapping[str, str]], Session]
    """Session of one choice for each label; raises ``RaytacError`` for what cannot work."""
