"""Parts of the height-field code from geoms of MuJoCo, so that any object can be pressed in."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np

from raytac.errors import InputError
from raytac.physics.mjcf_size import check_mjcf_size
from raytac.se3 import rotation_of
from raytac.shapes.part import Part, hfield_part, mesh_part, primitive

GEOM_TYPES = ("plane", "hfield", "sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh", "sdf")
"""Every type that a geom of a compiled MuJoCo model can have."""


def body_parts(model: mujoco.MjModel, body: int | str, groups: Sequence[int] | None = None) -> tuple[Part, ...]:
    """Parts of all geoms of one body, body frame; ``object_height`` takes them.

    Bodies without joints between them are separate bodies in MuJoCo too; give each its own pose. A model often has a coarse geom
    for collisions beside a fine one to look at: ``groups`` keeps only the geoms of these MuJoCo groups (0 to 5), None keeps all.

    Raises ``InputError``: no such body, no geom of it left, or one that cannot be sensed (see ``geom_part``).
    """
    index = _index(model, mujoco.mjtObj.mjOBJ_BODY, model.nbody, "body", body)
    first = int(model.body_geomadr[index])
    geoms = range(first, first + int(model.body_geomnum[index]))
    kept = [g for g in geoms if groups is None or int(model.geom_group[g]) in groups]
    if not kept:
        there = sorted({int(model.geom_group[g]) for g in geoms})
        rule = f"has no geom in the groups {tuple(groups)}" if groups is not None and there else "has no geom"
        raise InputError("body", value=body, rule=rule, choices=there)
    return tuple(geom_part(model, g) for g in kept)


def geom_part(model: mujoco.MjModel, geom: int | str) -> Part:
    """One geom as a part, in the frame of the geom's body.

    Primitives stay exact shapes. A ``plane`` is the whole half-space, as in MuJoCo's collisions; its size is only for looking at. A
    ``mesh`` keeps its own triangles, where MuJoCo collides its convex hull; one that does not bound a solid is taken as a sheet. An
    ``hfield`` becomes the closed mesh that MuJoCo collides with. An ``sdf`` is sensed by the mesh that MuJoCo's compiler makes of
    it: exact where it was given by a mesh, else as fine as the plugin's ``octree`` cuts it.

    Raises ``InputError``: no such geom, or a type or size that has no part.
    """
    index = _index(model, mujoco.mjtObj.mjOBJ_GEOM, model.ngeom, "geom", geom)
    kind = mujoco.mjtGeom(int(model.geom_type[index])).name.removeprefix("mjGEOM_").lower()
    pose = _pose(model.geom_pos[index], model.geom_quat[index])
    if kind not in GEOM_TYPES:
        raise InputError(f"type of geom {geom!r}", value=kind, rule="cannot be sensed", choices=GEOM_TYPES)
    data = int(model.geom_dataid[index])
    if kind in ("mesh", "sdf"):
        if data < 0:
            raise InputError(f"geom {geom!r}", value=kind, rule="has no mesh in the model, so its surface is not known")
        return mesh_part(*_mesh(model, data), pose)
    if kind == "hfield":
        rows, columns, start = (int(a[data]) for a in (model.hfield_nrow, model.hfield_ncol, model.hfield_adr))
        elevation = model.hfield_data[start : start + rows * columns].reshape(rows, columns)
        return hfield_part(tuple(model.hfield_size[data].tolist()), elevation, pose)
    return primitive(kind, tuple(model.geom_size[index].tolist()), pose)


def load_mjcf(path: str | Path) -> mujoco.MjModel:
    """Compile an MJCF or URDF file.

    Raises:
        InputError: the file does not exist, asks for too much (see ``check_mjcf_size``), or MuJoCo refuses it; the message is MuJoCo's.
    """
    if not Path(path).is_file():
        raise InputError("MJCF file", value=path, rule="must exist")
    check_mjcf_size(path)
    try:
        return mujoco.MjModel.from_xml_path(str(path))
    except (ValueError, mujoco.FatalError) as error:
        raise InputError("MJCF file", value=path, rule=f"MuJoCo refuses it: {' '.join(str(error).split())[:500]}") from error


def _index(model: mujoco.MjModel, kind: mujoco.mjtObj, count: int, what: str, given: int | str) -> int:
    """Index of a body or geom by name or number."""
    if isinstance(given, str):
        index = mujoco.mj_name2id(model, kind, given)
        if index < 0:
            names = [mujoco.mj_id2name(model, kind, i) for i in range(count)]
            raise InputError(what, value=given, rule="is not in the model", choices=[name for name in names if name])
        return index
    if isinstance(given, bool) or not isinstance(given, int | np.integer) or not 0 <= given < count:
        raise InputError(what, value=given, rule=f"must be a name, or a number in [0, {count - 1}]")
    return int(given)


def _mesh(model: mujoco.MjModel, data: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) [m], which MuJoCo has centred, and faces (F, 3) of a mesh, geom's frame."""
    vertex, face = int(model.mesh_vertadr[data]), int(model.mesh_faceadr[data])
    vertices = model.mesh_vert[vertex : vertex + int(model.mesh_vertnum[data])]
    return vertices, model.mesh_face[face : face + int(model.mesh_facenum[data])]


def _pose(position: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_of(quaternion), position
    return pose
