"""Bodies of a world, their materials, and the flat arrays that they are laid out in."""

from ipc.bodies.body import (
    AffineBody,
    Body,
    HalfSpace,
    KinematicBody,
    Pose,
    SoftBody,
    rotation_matrix,
    vertices_in_box,
    vertices_near,
)
from ipc.bodies.layout import Layout, build_layout
from ipc.bodies.material import Material, Stiff

__all__ = [
    "AffineBody",
    "Body",
    "HalfSpace",
    "KinematicBody",
    "Layout",
    "Material",
    "Pose",
    "SoftBody",
    "Stiff",
    "build_layout",
    "rotation_matrix",
    "vertices_in_box",
    "vertices_near",
]
