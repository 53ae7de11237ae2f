"""The bodies of a soft press: the bonded pad, and an object that is driven, lies free, or is soft itself."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

import ipc
from raytac.errors import InputError
from raytac.gel.part import Part
from raytac.physics.part_surface import SAG, object_surface
from raytac.physics.soft_mesh import PadMesh
from raytac.specs.press import DYNAMICS, ObjectSpec
from raytac.specs.sensor import GelpadSpec

__all__ = ["OBJECT", "PAD", "object_body", "pad_body"]

PAD, OBJECT = "pad", "object"
"""Names of the two bodies."""
_HELD = 0.2
"""Share of a soft object's height, from its top, that the drive holds."""


def pad_body(mesh: PadMesh, gelpad: GelpadSpec) -> ipc.SoftBody:
    """The gel: stable neo-Hookean, held at the vertices that ``mesh`` names."""
    material = ipc.Material(young=gelpad.youngs_modulus, poisson=gelpad.poisson_ratio, density=gelpad.density)
    return ipc.SoftBody(PAD, mesh.tets, material, bonded=mesh.bonded)


def object_body(
    parts: Sequence[Part],
    spec: ObjectSpec,
    rotation: np.ndarray,
    *,
    weight: float = 0.0,
    edge_length: float = 1e-3,
    lowest: float = 0.0,
    sag: float = SAG,
) -> ipc.KinematicBody | ipc.AffineBody | ipc.SoftBody:
    """The object of a press scene as a body of the solver, in the object's frame.

    ``kinematic``: a rigid surface that is driven, without the triangles that no press brings near the pad. ``affine``: free and
    near-rigid, as heavy as ``weight`` under gravity; its surface must be closed. ``soft``: neo-Hookean, tetrahedra of about
    ``edge_length``, driven by the fifth of its height that is farthest from the pad.

    Args:
        parts: of the object.
        spec: says which kind of body, and a soft one's material.
        rotation: ``pad_from_object``, (3, 3): tells which side is down.
        weight: [N], of an affine body.
        edge_length: of a soft body's tetrahedra [m].
        sag: how far facets may lie inside a curved part [m].
        lowest: height above the object's lowest point [m] beyond which a kinematic body's triangles are left out; 0 keeps all.

    Raises:
        InputError: an unknown kind of body, or a surface that it cannot be made from.
    """
    surface = object_surface(parts, sag)
    height = surface.vertices @ rotation[2]
    if spec.dynamics == "kinematic":
        if lowest > 0.0:
            near = (height[surface.faces].min(axis=1) - height.min()) <= lowest
            used, faces = np.unique(surface.faces[near], return_inverse=True)
            surface = ipc.TriMesh(surface.vertices[used], faces.reshape(-1, 3))
        return ipc.KinematicBody(OBJECT, surface)
    try:
        if spec.dynamics == "affine":
            volume = _volume(surface)
            return ipc.AffineBody(OBJECT, surface, ipc.Stiff(density=weight / (9.81 * volume)))
        if spec.dynamics == "soft":
            tets = ipc.tetrahedralize(surface, edge_length)
            height = tets.vertices @ rotation[2]
            held = np.flatnonzero(height >= height.max() - _HELD * np.ptp(height))
            material = ipc.Material(young=spec.youngs_modulus, poisson=spec.poisson_ratio)
            return ipc.SoftBody(OBJECT, tets, material, bonded=held)
    except ipc.IpcError as error:
        raise InputError("object.dynamics", value=spec.dynamics, rule=f"cannot be made from this object: {error}") from error
    raise InputError("object.dynamics", value=spec.dynamics, rule="must be a known kind of body", choices=DYNAMICS)


def _volume(surface: ipc.TriMesh) -> float:
    """Volume [m³] that a closed surface bounds."""
    a, b, c = (surface.vertices[surface.faces[:, k]] for k in range(3))
    volume = float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)
    if not volume > 0.0:
        raise InputError("object.dynamics", value="affine", rule="needs a closed surface with its faces outwards")
    return volume
