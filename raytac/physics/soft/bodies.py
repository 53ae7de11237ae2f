"""Bodies of the contact solver: bonded pads, and driven, free and soft bodies."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike

import ipc
from raytac.errors import InputError
from raytac.io.cache import cache_folder
from raytac.physics.soft.mesh import PadMesh
from raytac.physics.soft.settings import DEFAULT_CORRECTION, Correction
from raytac.physics.soft.skin import SoftSkin
from raytac.se3 import rigid_poses
from raytac.shapes.facets import SAG
from raytac.shapes.part import Part
from raytac.shapes.triangulate import enclosed_volume, object_surface
from raytac.specs.mesh_crossing import find_crossings
from raytac.specs.press import DYNAMICS, ObjectSpec
from raytac.specs.sensor import GelpadSpec, SensorSpec

PAD, OBJECT = "pad", "object"
"""Names of the two bodies of a press."""
BODY_KINDS = ("kinematic", "affine", "soft", "half_space")
"""Kinds that ``scene_body`` makes."""
_DRIVEN_SHARE = 0.2
"""Share of a soft object's height, from its top, that is driven."""
_OWN_VOLUME = 0.25
"""λ'/μ of a soft object's tetrahedra in their blocks, as of ``PadLevel.own_volume``."""


@dataclass(frozen=True)
class SceneBody:
    """One body of a ``SoftScene`` that is not a pad."""

    solid: ipc.KinematicBody | ipc.AffineBody | ipc.SoftBody | ipc.HalfSpace
    parts: tuple[Part, ...] = ()
    """Exact shape of a rigid one, body frame, which a pad in contact is shown to touch."""
    friction: float | None = None
    """μ against pads and bodies; None: each pad's own against pads."""
    skin: SoftSkin | None = None
    """Smooth surface of a soft one, shown in contact; None: the faces of its tetrahedra."""

    @property
    def name(self) -> str:
        return self.solid.name

    @property
    def is_soft(self) -> bool:
        return isinstance(self.solid, ipc.SoftBody)

    @property
    def is_driven(self) -> bool:
        """True if its frame has prescribed poses, False if it moves freely."""
        if isinstance(self.solid, ipc.SoftBody):
            return len(self.solid.bonded) > 0
        return not isinstance(self.solid, ipc.AffineBody)


def pad_body(mesh: PadMesh, gelpad: GelpadSpec, name: str = PAD) -> ipc.SoftBody:
    """The gel of a pad: stable neo-Hookean, fixed where bonded, with self-contact."""
    material = ipc.Material(young=gelpad.youngs_modulus, poisson=gelpad.poisson_ratio, density=gelpad.density)
    blocks = {} if mesh.volume_blocks is None else {"volume_blocks": mesh.volume_blocks, "own_volume": mesh.own_volume}
    return ipc.SoftBody(name, mesh.tets, material, bonded=mesh.bonded, self_contact=True, **blocks)


def scene_body(
    name: str,
    parts: Sequence[Part],
    kind: str,
    *,
    density: float = 1000.0,
    youngs_modulus: float = 1e6,
    poisson_ratio: float = 0.45,
    cell: float = 2e-3,
    bonded: Callable[[np.ndarray], np.ndarray] | None = None,
    friction: float | None = None,
    sag: float = SAG,
) -> SceneBody:
    """A body from its parts, body frame.

    Args:
        parts: shape. ``half_space`` takes none (the solid is z <= 0 of its frame) or one ``plane``.
        kind: ``kinematic``: rigid, with prescribed poses. ``affine``: near-rigid and free. ``soft``: neo-Hookean, free, or driven where
            ``bonded``. ``half_space``: a table or wall.
        density: of an affine or soft body [kg/m³].
        youngs_modulus, poisson_ratio: of a soft body [Pa], [-].
        cell: edge length of a soft body's tetrahedra [m]. A box becomes a grid of mirrored cells; all else is meshed by pytetwild.
        bonded: of a soft body: mask (n,) of the vertices (n, 3) [m] that are fixed to the body's frame; None: it is free.
        sag: greatest distance of facets inside a curved part [m].

    Raises:
        InputError: an unknown kind, a surface that it cannot be made from or that crosses itself, or ``bonded`` that names no vertex.
    """
    if kind not in BODY_KINDS:
        raise InputError("kind", value=kind, rule=f"of body {name!r} must be a known kind of body", choices=BODY_KINDS)
    parts = tuple(parts)
    if friction is not None and not 0.0 <= friction < np.inf:
        raise InputError("friction", value=friction, rule=f"of body {name!r} must be finite and >= 0")
    try:
        if kind == "half_space":
            is_plane = [part.kind == "plane" and np.array_equal(part.object_from_part, np.eye(4)) for part in parts]
            if is_plane not in ([], [True]):
                rule = f"of half-space {name!r} must be one plane in the body's own axes"
                raise InputError("parts", value=[part.kind for part in parts], rule=rule)
            return SceneBody(ipc.HalfSpace(name), parts or (Part("plane"),), friction)
        if kind == "soft":
            material = ipc.Material(young=youngs_modulus, poisson=poisson_ratio, density=density)
            solid = _soft(name, parts, material, cell, bonded)
            return SceneBody(solid, (), friction, SoftSkin(parts, solid.mesh))
        surface = _checked_surface(name, parts, sag)
        if kind == "affine":
            return SceneBody(ipc.AffineBody(name, surface, ipc.Stiff(density=density)), parts, friction)
        return SceneBody(ipc.KinematicBody(name, surface), parts, friction)
    except ipc.IpcError as error:
        raise InputError("kind", value=kind, rule=f"cannot be made from the shape of {name!r}: {error}") from error


def _soft(
    name: str, parts: tuple[Part, ...], material: ipc.Material, cell: float, is_bonded: Callable[[np.ndarray], np.ndarray] | None
) -> ipc.SoftBody:
    if not 0.0 < cell < np.inf:
        raise InputError("cell", value=cell, rule=f"of soft body {name!r} must be a length > 0 [m]")
    if len(parts) == 1 and parts[0].kind == "box":
        lines = [np.linspace(-half, half, 2 * max(round(half / cell), 1) + 1) for half in parts[0].size]
        cut = ipc.box_mesh(*lines, cut="mirrored")
        pose = parts[0].object_from_part
        tets = ipc.TetMesh(cut.vertices @ pose[:3, :3].T + pose[:3, 3], cut.tets)
    else:
        tets = ipc.tetrahedralize(_checked_surface(name, parts, 0.05 * cell), cell, cache_folder("tets"))
    bonded = np.zeros(0, np.int64)
    if is_bonded is not None:
        bonded = np.flatnonzero(is_bonded(tets.vertices))
        if not 0 < len(bonded) < len(tets.vertices):
            rule = f"holds {len(bonded)} of the {len(tets.vertices)} vertices of {name!r}: it must hold some and leave some"
            raise InputError("bonded", value=is_bonded, rule=rule)
    return ipc.SoftBody(name, tets, material, bonded=bonded)


def object_body(
    parts: Sequence[Part],
    spec: ObjectSpec,
    rotations: np.ndarray,
    *,
    weight: float = 0.0,
    edge_length: float = 1e-3,
    lowest: float = 0.0,
    tilt: float = 0.0,
    sag: float = SAG,
) -> SceneBody:
    """The object of a press scene as a body of the solver, in the object's frame.

    ``kinematic``: a driven rigid surface, without the triangles that no press brings near the pad. ``affine``: free and near-rigid,
    with a ``weight``; its surface must be closed. ``soft``: neo-Hookean, tetrahedra of about ``edge_length`` in volume blocks, driven by
    the fifth of its height that is farthest from the pad.

    Args:
        parts, spec: shape; kind of body, and a soft one's material.
        rotations: ``pad_from_object`` of every environment, (B, 3, 3). One body serves all, so a rigid one keeps the triangles that any
            of them brings near the pad, and a soft one must be tilted the same in all.
        weight, edge_length: of an affine body [N]; of a soft body's tetrahedra [m].
        sag: greatest distance of facets inside a curved part [m].
        lowest: height above the object's lowest point [m] beyond which a kinematic body's triangles are left out; 0 keeps all.
        tilt: greatest angle about a horizontal axis through the origin [rad], at which the same must hold.

    Raises:
        InputError: an unknown kind of body, or a surface that it cannot be made from or that crosses itself.
    """
    surface = _checked_surface(OBJECT, parts, sag)
    if spec.dynamics == "kinematic":
        if lowest > 0.0:
            # A point that is left out lies higher than the lowest one, d away, by more than 2 r sin α >= d sin α: at a slope e > α.
            # A tilt by α takes at most d (sin e − sin(e − α)) of that, which grows to d sin α as e falls to α.
            lowest += 2.0 * math.sin(tilt) * float(np.linalg.norm(surface.vertices, axis=1).max())
            heights = (surface.vertices @ row for row in rotations[:, 2])
            near = np.any([height[surface.faces].min(axis=1) - height.min() <= lowest for height in heights], axis=0)
            used, faces = np.unique(surface.faces[near], return_inverse=True)
            surface = ipc.TriMesh(surface.vertices[used], faces.reshape(-1, 3))
        return SceneBody(ipc.KinematicBody(OBJECT, surface), tuple(parts))
    try:
        if spec.dynamics == "affine":
            volume = enclosed_volume(surface)
            if not volume > 0.0:
                raise InputError("object.dynamics", value="affine", rule="needs a closed surface with its faces outwards")
            return SceneBody(ipc.AffineBody(OBJECT, surface, ipc.Stiff(density=weight / (9.81 * volume))), tuple(parts))
        if spec.dynamics == "soft":
            tets = ipc.tetrahedralize(surface, edge_length, cache_folder("tets"))
            if not np.allclose(rotations[:, 2], rotations[0, 2], atol=1e-9):
                rule = "held at its top, so a soft object must be tilted the same in all environments"
                raise InputError("rotations", value=rotations[:, 2].tolist(), rule=rule)
            height = tets.vertices @ rotations[0, 2]
            driven = np.flatnonzero(height >= height.max() - _DRIVEN_SHARE * np.ptp(height))
            material = ipc.Material(young=spec.youngs_modulus, poisson=spec.poisson_ratio)
            # Without blocks a ball of 430 kPa is a sixth to a third too stiff in contact.
            solid = ipc.SoftBody(
                OBJECT, tets, material, bonded=driven, volume_blocks=ipc.patch_blocks(tets), own_volume=_OWN_VOLUME
            )
            return SceneBody(solid, skin=SoftSkin(parts, tets))
    except ipc.IpcError as error:
        raise InputError("object.dynamics", value=spec.dynamics, rule=f"cannot be made from this object: {error}") from error
    raise InputError("object.dynamics", value=spec.dynamics, rule="must be a known kind of body", choices=DYNAMICS)


def _checked_surface(name: str, parts: Sequence[Part], sag: float) -> ipc.TriMesh:
    """``object_surface`` of a body; a mesh that crosses itself is refused.

    Tests of penetration fail on it. Overlapping parts are common in models of robots, and only their outer walls touch anything,
    so they only cause a warning.
    """
    for part in parts:
        if part.kind == "mesh":
            assert part.vertices is not None and part.faces is not None
            crossings = find_crossings(part.vertices, part.faces)
            if crossings:
                rule = f"a mesh must not cross itself with physics='ipc': {crossings.text(1e-3, 'mm')}"
                raise InputError(name, value=f"a mesh of {len(part.faces)} triangles", rule=rule)
    surface = object_surface(parts, sag)
    if len(parts) > 1 and not any(part.joined for part in parts):
        crossings = find_crossings(surface.vertices, surface.faces)
        if crossings:
            text = f"the parts of {name!r} overlap: {crossings.text(1e-3, 'mm')}; tests of whether a pad passes through it see them too"
            warnings.warn(text, stacklevel=3)
    return surface


@dataclass(frozen=True)
class ScenePad:
    """One pad of a ``SoftScene``, whose case has prescribed poses."""

    name: str
    sensor: SensorSpec
    mesh: PadMesh
    pitch: float = 0.1e-3
    """Spacing of the grid that its surface is read on [m]."""
    correction: Correction | None = DEFAULT_CORRECTION
    """Correction of the surface that is read; None: the spline through the solver's vertices."""


class SceneRegistry:
    """Pads and bodies of a scene with B environments, by name."""

    def __init__(self, pads: Sequence[ScenePad], bodies: Sequence[SceneBody], num_envs: int) -> None:
        """Register them; raises ``InputError`` where there is no pad, or a name repeats."""
        names = [thing.name for thing in (*pads, *bodies)]
        if not pads:
            raise InputError("pads", value=(), rule="must hold one pad or more")
        if len(set(names)) < len(names):
            raise InputError("names", value=names, rule="must be unique among pads and bodies")
        self.pads, self.bodies = {pad.name: pad for pad in pads}, {body.name: body for body in bodies}
        self.num_envs = num_envs

    def pad(self, name: str) -> ScenePad:
        if name not in self.pads:
            raise InputError("pad", value=name, rule="must be the name of a pad of this scene", choices=self.pads)
        return self.pads[name]

    def body(self, name: str) -> SceneBody:
        if name not in self.bodies:
            raise InputError("name", value=name, rule="must be the name of a body of this scene", choices=self.bodies)
        return self.bodies[name]

    def named(self, poses: Mapping[str, ArrayLike], free: bool = False) -> dict[str, np.ndarray]:
        """Poses (B, 4, 4) of some bodies by name; those of free bodies are refused unless ``free``."""
        for name in poses:
            if not (self.body(name).is_driven or free):
                driven = [n for n, body in self.bodies.items() if body.is_driven]
                raise InputError("driven", value=name, rule="moves freely and takes no pose", choices=driven)
        return {name: rigid_poses(name, pose, self.num_envs) for name, pose in poses.items()}

    def starts(self, poses: Mapping[str, ArrayLike]) -> dict[str, np.ndarray]:
        """Poses (B, 4, 4) of all bodies by name."""
        for name in poses:
            self.body(name)
        for name in self.bodies:
            if name not in poses:
                raise InputError("world_from_body", value=list(poses), rule=f"must say where {name!r} starts")
        return {name: rigid_poses(name, poses[name], self.num_envs) for name in self.bodies}

    def driven(self, poses: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Copies of the poses of those bodies that are driven."""
        return {name: poses[name].copy() for name, body in self.bodies.items() if body.is_driven}

    def friction(self) -> dict[tuple[str, str], float]:
        """μ by pair of names: a body's own, else the pad's, on a pad; the larger between bodies."""
        mu = {}
        for pad in self.pads.values():
            gel = pad.sensor.gelpad.friction
            mu |= {(pad.name, o.name): max(gel, o.sensor.gelpad.friction) for o in self.pads.values() if o.name > pad.name}
            mu |= {(pad.name, body.name): gel if body.friction is None else body.friction for body in self.bodies.values()}
        for one, two in combinations(self.bodies.values(), 2):
            mu[one.name, two.name] = max(one.friction or 0.0, two.friction or 0.0)
        return mu
