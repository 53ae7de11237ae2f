"""What a press scene is: an object, and the motion that presses it into the pad. SI units, pad frame."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from raytac.specs.sensor import Vec3

__all__ = ["DYNAMICS", "MOVES", "PADS", "PHYSICS", "ObjectSpec", "PressScene", "StageSpec", "chosen_physics"]

MOVES = ("object", "case")
"""What a press can move; the other side stands still."""
PHYSICS = ("rigid", "ipc")
"""How a gel can deform: by geometry and Gaussians, or simulated."""
PADS = ("coarse", "medium", "fine")
"""How finely a simulated pad can be cut."""
DYNAMICS = ("kinematic", "affine", "soft")
"""What an object can be to a simulated pad: driven and rigid, free and near-rigid, or driven and soft."""


def chosen_physics(physics: str | None, pad: object, scene: str | None = None) -> str:
    """``rigid`` or ``ipc``: what is asked for, else ``ipc`` where a pad's fineness is, else as the scene says, else ``rigid``."""
    return physics or ("ipc" if pad is not None else scene or "rigid")


@dataclass(frozen=True)
class ObjectSpec:
    """The indenter, a union of convex or concave parts rigidly joined.

    Most kinds are exact shapes: sphere, cylinder, edge, cone, torus and pins are computed from a few lengths, so that no facet
    shows in an image; a coin is an elevation map made in code; ``mesh`` reads triangles from a file, ``mjcf`` the geoms of a body.
    """

    kind: str
    """``none sphere cylinder edge cone torus pins coin mesh mjcf``."""
    params: dict[str, float | int | str]
    """Lengths [m] and counts of the kind, by the key of its TOML file without the unit; for ``mesh`` the absolute ``path`` and
    ``scale`` [m per file unit], for ``mjcf`` the absolute ``path`` and the name of the ``body``. Object frame of each kind:
    ``scenes/README.md``."""
    position: Vec3
    """Offset of the object's origin from first touch above the pad centre, pad frame [m]; z is not used (contact sets it)."""
    quaternion: tuple[float, float, float, float]
    """``pad_from_object`` rotation, wxyz, normalised."""
    mass: float
    """Mass on the drive [kg]; matters only for the way to a force, not for where it settles."""
    dynamics: str = "kinematic"
    """One of ``DYNAMICS``; the rigid pad takes every object as rigid and driven."""
    youngs_modulus: float = 1e6
    """Of a soft object [Pa]."""
    poisson_ratio: float = 0.4
    """Of a soft object."""


@dataclass(frozen=True)
class StageSpec:
    """One leg of the trajectory; targets are absolute, measured from first touch at zero shear and twist."""

    kind: str
    """``indent shear twist release``."""
    depth: float | None = None
    """Indentation depth at the end of an ``indent`` stage [m] (exclusive with ``force``)."""
    force: float | None = None
    """Normal force at the end of an ``indent`` stage [N] (exclusive with ``depth``)."""
    shear: tuple[float, float] = (0.0, 0.0)
    """Tangential displacement along x and y at the end of a ``shear`` stage [m]."""
    twist: float = 0.0
    """Rotation about +z at the end of a ``twist`` stage [rad]."""
    duration: float = 0.5
    """Time that the leg takes [s]."""


@dataclass(frozen=True)
class PressScene:
    name: str
    object: ObjectSpec
    trajectory: tuple[StageSpec, ...]
    """Empty for an untouched pad."""
    moves: str = "object"
    """Which side the trajectory moves, one of ``MOVES``. Targets are the object's against the pad either way."""
    source: Path | None = None
    physics: str | None = None
    """One of ``PHYSICS`` that the scene is meant for; None leaves it to whoever presses."""
    pad: str | None = None
    """One of ``PADS``; None leaves it to whoever presses."""

    @property
    def peak_stage(self) -> int:
        """Index of the stage whose end is imaged: the last one that is not a release; −1 if there is none."""
        kinds = [s.kind for s in self.trajectory]
        return max((i for i, k in enumerate(kinds) if k != "release"), default=-1)
