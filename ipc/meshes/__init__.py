"""Tetrahedral and triangle meshes."""

from ipc.meshes.mesh import (
    Cut,
    TetMesh,
    TriMesh,
    box_mesh,
    box_surface,
    domed_pad,
    graded,
    grid_blocks,
    icosphere,
    surface_of,
    surface_topology,
    tet_volumes,
)
from ipc.meshes.patches import patch_blocks
from ipc.meshes.tetwild import tetrahedralize

__all__ = [
    "Cut",
    "TetMesh",
    "TriMesh",
    "box_mesh",
    "box_surface",
    "domed_pad",
    "graded",
    "grid_blocks",
    "icosphere",
    "patch_blocks",
    "surface_of",
    "surface_topology",
    "tet_volumes",
    "tetrahedralize",
]
