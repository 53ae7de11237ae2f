"""Incremental potential contact for soft gel pads; never imports ``raytac``.

Bodies go into a :class:`World`, ``World.step`` returns a :class:`StepReport`, and positions, forces and contacts come out as NumPy
arrays whose first axis is the environment. SI units; see ``ipc/README.md``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ipc.bodies import (
    AffineBody,
    Body,
    HalfSpace,
    KinematicBody,
    Material,
    Pose,
    SoftBody,
    Stiff,
    rotation_matrix,
    vertices_in_box,
    vertices_near,
)
from ipc.errors import IpcError, OverlapError, SolverError
from ipc.meshes import (
    Cut,
    TetMesh,
    TriMesh,
    box_mesh,
    box_surface,
    domed_pad,
    graded,
    grid_blocks,
    icosphere,
    patch_blocks,
    surface_of,
    tetrahedralize,
)
from ipc.report import ContactPairs, PairForces, PatchMotion, RigidMotion, StepReport, Wrench
from ipc.settings import Settings

if TYPE_CHECKING:
    from ipc.body_arrays import BodyArrays, ContactArrays
    from ipc.state import State
    from ipc.warp_start import start_warp, use_writable_cache
    from ipc.world import World

__all__ = [
    "RAYTAC_IPC_MARKER",
    "AffineBody",
    "Body",
    "BodyArrays",
    "ContactArrays",
    "ContactPairs",
    "Cut",
    "HalfSpace",
    "IpcError",
    "KinematicBody",
    "Material",
    "OverlapError",
    "PairForces",
    "PatchMotion",
    "Pose",
    "RigidMotion",
    "Settings",
    "SoftBody",
    "SolverError",
    "State",
    "StepReport",
    "Stiff",
    "TetMesh",
    "TriMesh",
    "World",
    "Wrench",
    "__version__",
    "box_mesh",
    "box_surface",
    "domed_pad",
    "graded",
    "grid_blocks",
    "icosphere",
    "patch_blocks",
    "rotation_matrix",
    "start_warp",
    "surface_of",
    "tetrahedralize",
    "use_writable_cache",
    "vertices_in_box",
    "vertices_near",
]

RAYTAC_IPC_MARKER = "raytac-ipc"
"""Mark by which ``raytac`` tells this package from others named ``ipc``."""

__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    """Import the solver, and with it Warp, only when it is asked for."""
    if name in ("BodyArrays", "ContactArrays"):
        from ipc import body_arrays

        return getattr(body_arrays, name)
    if name in ("World", "State"):
        from ipc import world

        return getattr(world, name)
    if name in ("start_warp", "use_writable_cache"):
        from ipc import warp_start

        return getattr(warp_start, name)
    raise AttributeError(f"module 'ipc' has no attribute {name!r}")
