"""Press scenes: an object, and the motion that presses it into the pad. SI units, pad frame."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from raytac.checks import is_number
from raytac.errors import SpecError
from raytac.specs.mesh import TriangleMesh
from raytac.specs.sensor import Vec3
from raytac.specs.shape_file import OBJECT_SCHEMA, check_params, check_quaternion
from raytac.specs.toml import Number, Schema, Text, check_fields

MOVES = ("object", "case")
"""Sides that a press can move; the other one stands still."""
PADS = ("coarse", "medium", "fine")
"""Mesh levels of the soft pad."""
DYNAMICS = ("kinematic", "affine", "soft")
"""Object on the soft pad: prescribed and rigid, free and near-rigid, prescribed and soft."""

SCENE_SCHEMA: Final[Schema] = {
    "moves": Text(choices=MOVES, default="object"),
    "physics": Text(default=None),
    "pad": Text(choices=PADS, default=None),
}
"""Keys at the top of a scene."""

POSE_SCHEMA: Final[Schema] = {
    "position_mm": Number("[-100, 100]", length=2, default=(0.0, 0.0)),
    "quaternion_wxyz": Number("[-1, 1]", length=4, default=(1.0, 0.0, 0.0, 0.0)),
    "mass_kg": Number("[0.0001, 100]", default=0.1),
    "dynamics": Text(choices=DYNAMICS, default="kinematic"),
    "youngs_modulus_kpa": Number("[1, 100000]", default=None),
    "poisson_ratio": Number("[0, 0.49]", default=None),
}
"""Keys of ``[object]`` that every kind but ``none`` has."""

OBJECT_KINDS: Final[dict[str, Schema]] = {**OBJECT_SCHEMA, "heights": {"pitch_mm": Number("(0, 10]")}, "triangles": {}}
"""Parameter keys by kind of object; ``heights`` and ``triangles`` are made in code only."""

_DURATION = {"duration_s": Number("(0, 60]", default=0.5)}
STAGE_SCHEMA: Final[dict[str, Schema]] = {
    "indent": {"depth_mm": Number("(0, 50]", default=None), "force_n": Number("(0, 200]", default=None), **_DURATION},
    "shear": {"shear_mm": Number("[-50, 50]", length=2), **_DURATION},
    "twist": {"twist_deg": Number("[-180, 180]"), **_DURATION},
    "tilt": {"tilt_deg": Number("[-60, 60]", length=2), **_DURATION},
    "release": {**_DURATION},
}
"""Kind of stage to its keys in ``[[trajectory]]``."""


@dataclass(frozen=True)
class ObjectSpec:
    """The indenter, a union of convex or concave parts rigidly joined.

    Most kinds are exact shapes: sphere, cylinder, edge, cone, torus and pins are computed from a few lengths, so that no facet
    shows in an image; a coin is an elevation map made in code; ``mesh`` reads triangles from a file, ``mjcf`` the geoms of a body;
    ``heights`` is an elevation map of the user's, ``triangles`` a mesh in memory.
    """

    kind: str
    """One of ``OBJECT_KINDS``."""
    params: dict[str, float | int | str]
    """Lengths [m] and counts, by the key of the TOML file without its unit.
    For ``mesh`` the absolute ``path`` and ``scale`` [m per file unit], for ``mjcf`` the absolute ``path`` and the name of the ``body``.
    Object frame of each kind: ``scenes/README.md``."""
    position: Vec3
    """Offset of the origin from first touch above the pad's centre, pad frame [m]; z is unused."""
    quaternion: tuple[float, float, float, float]
    """``pad_from_object`` rotation, wxyz, normalised."""
    mass: float
    """Mass on the drive [kg]; it affects the motion to a force, not the final state."""
    dynamics: str = "kinematic"
    """One of ``DYNAMICS``; the rigid pad takes every object as rigid and driven."""
    youngs_modulus: float = 1e6
    """Of a soft object [Pa]."""
    poisson_ratio: float = 0.4
    """Of a soft object."""
    heights: tuple[tuple[float, ...], ...] = field(default=(), repr=False)
    """Elevation [m] of a ``heights`` object: rows along y, columns along x; 0 is no object."""
    triangles: TriangleMesh | None = field(default=None, repr=False)
    """Surface of a ``triangles`` object."""

    def __post_init__(self) -> None:
        if not isinstance(self.kind, str) or self.kind not in OBJECT_KINDS:
            raise SpecError("must be a known kind of object", key="object.kind", value=self.kind, choices=tuple(OBJECT_KINDS))
        rows = self.heights if isinstance(self.heights, tuple) else None
        if rows is None or any(not isinstance(row, tuple) or len(row) != len(rows[0]) for row in rows):
            raise SpecError("must be a tuple of rows, each a tuple of as many numbers", key="object.heights", value=self.heights)
        if bool(rows) != (self.kind == "heights"):
            raise SpecError('must be given for the kind "heights", and for no other', key="object.heights", value=len(rows))
        if not all(is_number(value) and 0.0 <= value < math.inf for row in rows for value in row):
            raise SpecError("must be finite numbers >= 0 [m]", key="object.heights", value=f"{len(rows)} rows")
        if not (isinstance(self.triangles, TriangleMesh) if self.kind == "triangles" else self.triangles is None):
            rule = 'must be a TriangleMesh for the kind "triangles", and None for every other'
            raise SpecError(rule, key="object.triangles", value=type(self.triangles).__name__)
        if self.kind == "none":
            return
        check_params(self.kind, self.params, OBJECT_KINDS[self.kind], "object")
        if not isinstance(self.position, (tuple, list)) or len(self.position) != 3:
            raise SpecError("must be three numbers, of which the last is not used", key="object.position_mm", value=self.position)
        place = self.position[:2]  # as a file gives it
        own = {key: rule for key, rule in POSE_SCHEMA.items() if key != "quaternion_wxyz"}
        check_fields(vars(self) | {"position": place}, own, "object")
        check_quaternion(self.quaternion, "object.quaternion_wxyz")


@dataclass(frozen=True)
class StageSpec:
    """One stage of the trajectory; targets count from first touch at zero shear, twist and tilt."""

    kind: str
    """``indent shear twist tilt release``."""
    depth: float | None = None
    """Indentation depth at the end of an ``indent`` stage [m] (exclusive with ``force``)."""
    force: float | None = None
    """Normal force at the end of an ``indent`` stage [N] (exclusive with ``depth``)."""
    shear: tuple[float, float] = (0.0, 0.0)
    """Tangential displacement along x and y at the end of a ``shear`` stage [m]."""
    twist: float = 0.0
    """Rotation about +z at the end of a ``twist`` stage [rad]."""
    tilt: tuple[float, float] = (0.0, 0.0)
    """Rotation vector along x and y at the end of a ``tilt`` stage [rad].

    It is about the object's origin. A twist turns its axis too."""
    duration: float = 0.5
    """Time that the leg takes [s]."""

    def __post_init__(self) -> None:
        if not isinstance(self.kind, str) or self.kind not in STAGE_SCHEMA:
            raise SpecError("must be a known kind of stage", key="trajectory.kind", value=self.kind, choices=tuple(STAGE_SCHEMA))
        check_fields(vars(self), {key: rule for schema in STAGE_SCHEMA.values() for key, rule in schema.items()}, "trajectory")
        if self.kind == "indent" and (self.depth is None) == (self.force is None):
            rule = "an indent needs exactly one of depth_mm and force_n"
            raise SpecError(rule, key="trajectory", value=(self.depth, self.force))


@dataclass(frozen=True)
class PressScene:
    name: str
    object: ObjectSpec
    trajectory: tuple[StageSpec, ...]
    """Empty for an untouched pad."""
    moves: str = "object"
    """Side that moves, one of ``MOVES``; targets are of the object relative to the pad."""
    source: Path | None = None
    physics: str | None = None
    """Physics that the scene is meant for (checked when it is pressed); None: any."""
    pad: str | None = None
    """One of ``PADS``; None leaves it to whoever presses."""

    def __post_init__(self) -> None:
        if not isinstance(self.name, str):
            raise SpecError("must be a text", file=self.source, key="name", value=self.name)
        if not isinstance(self.object, ObjectSpec):
            raise SpecError("must be an ObjectSpec", file=self.source, key="object", value=self.object)
        if not isinstance(self.trajectory, tuple) or not all(isinstance(stage, StageSpec) for stage in self.trajectory):
            raise SpecError("must be a tuple of StageSpec", file=self.source, key="trajectory", value=self.trajectory)
        check_fields(vars(self), SCENE_SCHEMA, file=self.source)
        for index, stage in enumerate(self.trajectory if self.object.dynamics == "affine" else ()):
            if stage.kind not in ("indent", "release") or stage.depth is not None:
                rule = (
                    "a free body (affine) can only be laid on the pad by its weight, with indent to a force_n and release, "
                    f"not as trajectory[{index}] has it ({stage.kind})"
                )
                raise SpecError(rule, file=self.source, key="object.dynamics", value=self.object.dynamics)

    @property
    def peak_stage(self) -> int:
        """Index of the stage whose end is imaged: the last that is not a release; −1 for none."""
        kinds = [s.kind for s in self.trajectory]
        return max((i for i, k in enumerate(kinds) if k != "release"), default=-1)
