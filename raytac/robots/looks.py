"""Visual meshes of the Franka Panda, where a package that has them is installed.

docs/guide/robots.md says which, and under what licence.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import logging
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Final

import mujoco
import numpy as np

_LINKS: Final = tuple(f"link{i}" for i in range(8))
_HAND: Final = "hand/hand"
_PARTS: Final = {
    "link0": ("column", "plate"),
    "link1": ("ring",),
    "link2": ("shell", "cap", "cap_back"),
    "link3": ("shell", "ring"),
    "link4": ("shell", "cap", "cap_back"),
    "link5": ("upper", "lower", "shell", "wrist", "ring"),  # no geom has the plain name
    "link6": ("shell", "cap"),
    "link7": ("block", "flange"),
    "hand/palm": ("shell",),
}
_SHAPES: Final = (_PARTS.keys() - {"link5"}) | {f"{name}_{part}" for name, parts in _PARTS.items() for part in parts}
"""Names of the geoms of scenes/robots/panda.xml and of the palm, which meshes replace."""
_SIGN: Final = "link7_block"
"""Geom by whose name our Panda is recognised, behind a prefix of ``MjSpec.attach``."""
_WHITE: Final = (0.93, 0.93, 0.92, 1.0)
_SUITE = "models", "assets"
_KITCHEN = "envs", "assets", "kitchen_franka", "franka_assets", "meshes", "visual"
_LOG = logging.getLogger("raytac")


@dataclass(frozen=True)
class VisualMesh:
    """Mesh of a link or of the hand, in the frame of its body [m]."""

    body: str
    """Name of the body in our model, without a prefix."""
    file: Path
    rgba: tuple[float, float, float, float]

    def surface(self) -> tuple[np.ndarray, np.ndarray]:
        """Vertices (V, 3) [m], each there once, and faces (F, 3)."""
        spec = mujoco.MjSpec()
        self.add_to(spec, "mesh")
        model, turn = spec.compile(), np.zeros(9)
        vertices, index = np.unique(model.mesh_vert, axis=0, return_inverse=True)
        mujoco.mju_quat2Mat(turn, model.mesh_quat[0])  # MuJoCo turns a mesh to its principal axes
        return vertices @ turn.reshape(3, 3).T + model.mesh_pos[0], index.reshape(-1)[model.mesh_face]

    def add_to(self, spec: mujoco.MjSpec, name: str) -> None:
        """Add the mesh to a spec, where nothing uses it yet."""
        mesh = spec.add_mesh(name=name, file=str(self.file))
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # also of one that is not closed


@dataclass(frozen=True)
class Looks:
    """Meshes in place of the shapes of a Panda; empty without a Panda of ours or its meshes."""

    meshes: tuple[tuple[int, VisualMesh], ...] = ()
    """Body of the model that carries the mesh, whose frame is the mesh's, and the mesh."""
    hidden: tuple[int, ...] = ()
    """Geoms of the model that the meshes stand for."""


def robot_looks(model: mujoco.MjModel) -> Looks:
    """Meshes for every Panda of ours in a model.

    Where no package has them, one line in the log says how to get them.
    """
    names = [model.geom(geom).name for geom in range(model.ngeom)]
    prefixes = [name.removesuffix(_SIGN) for name in names if name.endswith(_SIGN)]
    if not prefixes:
        return Looks()
    shown, hidden = [], []
    for prefix in prefixes:
        for mesh in panda_meshes():
            body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, prefix + mesh.body)
            if body < 0:  # an arm without a hand
                continue
            shown.append((body, mesh))
            hidden += [geom for geom in np.flatnonzero(model.geom_bodyid == body) if names[geom].removeprefix(prefix) in _SHAPES]
    return Looks(tuple(shown), tuple(sorted({int(geom) for geom in hidden})))


@lru_cache(maxsize=1)
def panda_meshes() -> tuple[VisualMesh, ...]:
    """Meshes of robosuite, which have colours, else those of gymnasium-robotics, else none.

    Nothing of these packages is run. Both hold the meshes of franka_ros (Apache-2.0). A package that is installed and whose meshes
    cannot be read, e.g. another version of it, is passed over, and a warning says why.
    """
    for package in SOURCES:
        try:
            meshes = _meshes_of(package)
        except Exception as error:  # files of another project, and drawing needs none of them
            reason = " ".join(str(error).split())
            _LOG.warning("no visual meshes from %s %s: %s: %s", package, _version(package), type(error).__name__, reason)
            continue
        if meshes:
            return meshes
    _LOG.info(
        "the Panda is drawn as its collision shapes; its visual meshes come with pip install 'raytac[films]', "
        "in colour with pip install --no-deps robosuite==1.5.2"
    )
    return ()


def _meshes_of(package: str) -> tuple[VisualMesh, ...]:
    """Meshes of every link and of the hand; none without the package.

    Raises errors of many types for files that cannot be read.
    """
    meshes = tuple(SOURCES[package]())
    if not meshes:
        return ()
    missing = {*_LINKS, _HAND} - {mesh.body for mesh in meshes}
    if missing:
        raise LookupError(f"no mesh of {', '.join(sorted(missing))}")
    spec = mujoco.MjSpec()
    for number, mesh in enumerate(meshes):
        mesh.add_to(spec, str(number))
    spec.compile()  # reads every file
    return meshes


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "of unknown version"


def _folder(package: str, *parts: str) -> Path | None:
    """Folder in an installed package, which is not imported."""
    spec = importlib.util.find_spec(package)
    places = [] if spec is None else list(spec.submodule_search_locations or ())
    return Path(places[0]).joinpath(*parts) if places else None


def _of_robosuite() -> Iterator[VisualMesh]:
    folder = _folder("robosuite", *_SUITE)
    if folder is None:
        return
    robot = folder / "robots" / "panda" / "robot.xml"
    spec = mujoco.MjSpec.from_file(str(robot))
    for link in _LINKS:
        body = spec.body(link)
        if body is None:
            raise LookupError(f"no body {link} in {robot}")
        for geom in body.geoms:
            if geom.type == mujoco.mjtGeom.mjGEOM_MESH and geom.contype == geom.conaffinity == 0:
                material = spec.material(geom.material)
                rgba = geom.rgba if material is None else material.rgba
                red, green, blue, alpha = (float(value) for value in rgba)
                file = robot.parent / spec.meshdir / spec.mesh(geom.meshname).file
                yield VisualMesh(link, file, (red, green, blue, alpha))
    yield VisualMesh(_HAND, folder / "grippers" / "meshes" / "panda_gripper" / "hand_vis.stl", _WHITE)


def _of_gymnasium_robotics() -> Iterator[VisualMesh]:
    folder = _folder("gymnasium_robotics", *_KITCHEN)
    if folder is not None:
        for body in (*_LINKS, _HAND):
            yield VisualMesh(body, folder / f"{body.removeprefix('hand/')}.stl", _WHITE)


SOURCES: Final = {"robosuite": _of_robosuite, "gymnasium_robotics": _of_gymnasium_robotics}
"""Readers by package, in the order in which they are asked."""
