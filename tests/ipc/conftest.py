"""Shared by the solver's tests: Warp started, and small worlds."""

from __future__ import annotations

import numpy as np
import pytest

import ipc
from ipc.bodies import rotation_matrix

ipc.start_warp()


def unit_cell(cells: int = 2, size: float = 1.0) -> ipc.TetMesh:
    """A cube of 6·cells³ tetrahedra with one corner at the origin."""
    line = np.linspace(0.0, size, cells + 1)
    return ipc.box_mesh(line, line, line)


def small_pad(cells: tuple[int, int, int] = (6, 6, 2), size: float = 12e-3, thickness: float = 4e-3) -> ipc.TetMesh:
    """A flat square pad with its outer surface at z = 0."""
    return ipc.domed_pad((size, size), thickness, (np.inf, np.inf), cells)


def bonded_pad(mesh: ipc.TetMesh, **changes: object) -> ipc.SoftBody:
    """``mesh`` with its base bonded."""
    base = mesh.vertices[:, 2].min()
    bonded = ipc.vertices_in_box(mesh, (-1, -1, base), (1, 1, base))
    values: dict = {"name": "pad", "mesh": mesh, "material": ipc.Material(1e5, 0.45), "bonded": bonded} | changes
    return ipc.SoftBody(**values)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


def turns(rng: np.random.Generator, count: int) -> np.ndarray:
    """Random rotation matrices, (count, 3, 3)."""
    q = rng.standard_normal((count, 4))
    return rotation_matrix(q / np.linalg.norm(q, axis=1, keepdims=True))
