"""Tetrahedral mesh of a gelpad, graded towards the contact face and the centre."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import ipc
from raytac.errors import InputError
from raytac.gel.coat_mesh import CoatMesh
from raytac.specs.sensor import GelpadSpec


@dataclass(frozen=True)
class PadLevel:
    """Resolution of a pad's mesh."""

    cell: float
    """Mean length of a cell along x and y [m]; each axis gets the nearest even number of cells."""
    layers: int
    spread: float
    """Length of the outermost cell over that of the innermost, along x and y."""
    layer_spread: float
    """Height of the lowest layer over that of the uppermost."""
    d_hat: float
    """Distance below which object and coat repel [m]."""
    block: tuple[int, int, int] | None = None
    """Cells along x, y and z that share their change of volume.

    None: each tetrahedron has its own.
    """
    own_volume: float = 0.25
    """Stiffness of a tetrahedron of a block against a change of its own volume, in μ.

    It steadies the solver.
    """


PAD_LEVELS = {
    "coarse": PadLevel(1.6e-3, 3, 6.0, 3.0, 5e-5, (2, 2, 1)),
    "medium": PadLevel(0.85e-3, 5, 2.5, 2.5, 3e-5, (2, 2, 1), 1.0),
    "fine": PadLevel(0.5e-3, 8, 2.5, 3.0, 1.5e-5),
}
"""Named levels; docs/measurements/soft-pad.md has the errors of each."""


@dataclass(frozen=True)
class PadMesh:
    """Mesh of a soft pad, pad frame."""

    tets: ipc.TetMesh
    coat: CoatMesh
    coat_vertices: np.ndarray
    """Vertex of ``tets`` under each vertex of ``coat``, shape (V,)."""
    bonded: np.ndarray
    """Numbers of the vertices of ``tets`` that are fixed to the case."""
    d_hat: float
    """Distance below which object and coat repel [m]."""
    volume_blocks: np.ndarray | None = None
    """Volume block of each tetrahedron, shape (T,), as of ``ipc.SoftBody``; None: no blocks."""
    own_volume: float = 0.25
    """As of ``ipc.SoftBody``; without blocks it has no effect."""

    def __post_init__(self) -> None:
        if len(self.bonded) == 0:
            raise InputError("bonded", value=[], rule="must name at least one vertex: a pad without one would be pushed away")
        if len(self.bonded) == len(self.tets.vertices):
            raise InputError("bonded", value=f"all {len(self.bonded)} vertices", rule="must leave vertices that can move")


def pad_mesh(gelpad: GelpadSpec, level: str | PadLevel | PadMesh) -> PadMesh:
    """Mesh of a gelpad, or the mesh itself: six tetrahedra a cell of a grid on the dome.

    Cells are mirror images of their neighbours (``ipc.box_mesh``). If all were divided alike, nearly incompressible gel would lock
    (docs/measurements/soft-pad.md has figures).

    Args:
        gelpad: size, thickness, dome, and the faces bonded to the case: the back, or the back and the sides.
        level: a name of ``PAD_LEVELS``, a level, or a mesh.

    Raises:
        InputError: an unknown level, or one that leaves less than two cells along an axis.
    """
    if isinstance(level, PadMesh):
        return level
    if isinstance(level, str):
        if level not in PAD_LEVELS:
            raise InputError("pad", value=level, rule="must be a known level", choices=PAD_LEVELS)
        level = PAD_LEVELS[level]
    x, y = (_lines(size, level) for size in gelpad.size)
    z = -ipc.graded(gelpad.thickness, level.layers, level.layer_spread ** (1.0 / max(level.layers - 1, 1)))[::-1]
    tets = ipc.box_mesh(x, y, z, cut="mirrored")
    vertices = tets.vertices.copy()
    vertices[:, 2] -= gelpad.sag(vertices[:, 0], vertices[:, 1]) * (1.0 + vertices[:, 2] / gelpad.thickness)
    per_layer = len(x) * len(y)
    coat_vertices = np.arange(len(vertices) - per_layer, len(vertices))
    at_back = np.arange(len(vertices)) < per_layer
    at_side = (np.abs(vertices[:, :2]) >= 0.5 * np.asarray(gelpad.size) * (1.0 - 1e-12)).any(axis=1)
    bonded = np.flatnonzero(at_back | at_side if gelpad.bonded == "back_and_sides" else at_back)
    coat = CoatMesh(vertices[coat_vertices], _coat_faces(tets.tets, coat_vertices[0], vertices), x, y)
    blocks = level.block and ipc.grid_blocks((len(x) - 1, len(y) - 1, level.layers), level.block)
    return PadMesh(ipc.TetMesh(vertices, tets.tets), coat, coat_vertices, bonded, level.d_hat, blocks, level.own_volume)


def _lines(size: float, level: PadLevel) -> np.ndarray:
    """Grid lines across the pad [m], symmetric, finest in the middle; an even number of cells."""
    half = round(0.5 * size / level.cell)
    if half < 1:
        raise InputError("pad", value=level, rule=f"must leave at least two cells over the pad's {size} m")
    ends = ipc.graded(0.5 * size, half, level.spread ** (1.0 / max(half - 1, 1)))
    return np.concatenate([-ends[:0:-1], ends])


def _coat_faces(tets: np.ndarray, first: int, vertices: np.ndarray) -> np.ndarray:
    """Triangles (F, 3) of the uppermost layer, in its own numbers, counter-clockwise from +z."""
    faces = tets[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]].reshape(-1, 3)
    faces = faces[(faces >= first).all(axis=1)]
    a, b, c = (vertices[faces[:, k], :2] for k in range(3))
    down = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0]) < 0.0
    faces[down] = faces[down][:, ::-1]
    return (faces - first).astype(np.int32)


_SHEAR_MARGIN = 1.2
"""The tangential bound is the tightest, and a coarse mesh is stiffer than the continuum."""


def pad_stiffness(gelpad: GelpadSpec, area: float) -> np.ndarray:
    """Upper bound (6, 6) of the stiffness of a rigid contact of ``area`` [m²], pad axes.

    About its centre: diagonal, [N/m], [N m/rad]; see ``pad_stiffness_terms``.
    """
    a = float(np.sqrt(area / np.pi))
    tangent, normal, rocking, twist = (pad_stiffness_terms(gelpad) * a ** np.array(STIFFNESS_POWERS)).sum(axis=1)
    return np.diag([tangent, tangent, normal, rocking, rocking, twist])


STIFFNESS_POWERS = ((1, 2), (1, 2), (3, 4), (3, 4))
"""Powers of the radius of contact in ``pad_stiffness_terms``, (4, 2)."""


def pad_stiffness_terms(gelpad: GelpadSpec) -> np.ndarray:
    """Bound of a contact's stiffness as two powers of its radius a = √(area/π).

    Coefficients (4, 2).

    Rows are tangential, normal, rocking and twisting motion; the powers of a are ``STIFFNESS_POWERS``. It is the sum of two limits of a
    rigid flat punch of the same area on a bonded layer of thickness t: one much narrower than the layer (half-space; K. L. Johnson,
    *Contact Mechanics*, 1985, for normal, tangential and twisting displacement; a rocking punch) and one much wider (all strain
    confined: modulus M = E (1 − ν) / ((1 + ν)(1 − 2ν)), shear modulus G over the height t).

    ======== ====================== ===============
    motion   narrow                 wide
    ======== ====================== ===============
    normal   2 a E / (1 − ν²)       M π a² / t
    tangent  8 a G / (2 − ν)        G π a² / t
    rocking  4/3 a³ E / (1 − ν²)    M π a⁴ / (4 t)
    twist    16/3 G a³              G π a⁴ / (2 t)
    ======== ====================== ===============
    """
    e, nu, t = gelpad.youngs_modulus, gelpad.poisson_ratio, gelpad.thickness
    shear, confined, plane = e / (2.0 * (1.0 + nu)), e * (1.0 - nu) / ((1.0 + nu) * (1.0 - 2.0 * nu)), e / (1.0 - nu**2)
    tangent = _SHEAR_MARGIN * 8.0 * shear / (2.0 - nu), _SHEAR_MARGIN * shear * np.pi / t
    normal = 2.0 * plane, confined * np.pi / t
    rocking = 4.0 / 3.0 * plane, confined * np.pi / (4.0 * t)
    twist = _SHEAR_MARGIN * 16.0 / 3.0 * shear, _SHEAR_MARGIN * shear * np.pi / (2.0 * t)
    return np.array([tangent, normal, rocking, twist])
