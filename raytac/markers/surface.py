"""Surface tracking: a marker moves with the triangle of the coat that it lies in.

As in Chen et al. (T-RO 2024) and TacIPC (Du et al., RA-L 2024): barycentric coordinates at rest, kept for ever.
"""

from __future__ import annotations

import numpy as np

from raytac.errors import InputError
from raytac.gel.coat_mesh import CoatMesh, bind_to_coat
from raytac.gel.surface import GelSurface
from raytac.markers.contacts import Contacts, ContactSamples


class CoatPoints:
    """Markers bound to a coat mesh; they are bound again when mesh or pattern change."""

    def __init__(self) -> None:
        self._bound: tuple[CoatMesh, np.ndarray, np.ndarray, np.ndarray] | None = None

    def interpolate(self, mesh: CoatMesh, rest: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Values of vertices (B, V, n) at the markers at ``rest`` (B, M, 3) [m], (B, M, n)."""
        pattern = rest[:1] if rest.strides[0] == 0 else rest
        if self._bound is None or self._bound[0] is not mesh or not np.array_equal(self._bound[1], pattern):
            self._bound = mesh, np.array(pattern), *bind_to_coat(mesh, pattern[..., :2])
        vertices, weights = self._bound[2:]
        env = np.arange(len(values))[:, None, None]
        return (weights[..., None] * values[env, vertices]).sum(axis=2)


class SurfaceModel:
    """Model of ``SurfaceMarkers``."""

    needs_contacts = False
    device = "cpu"

    def __init__(self) -> None:
        self._points = CoatPoints()

    def displacement(
        self, rest: np.ndarray, surface: GelSurface, samples: ContactSamples | None, contacts: Contacts | None
    ) -> np.ndarray:
        """Displacement along x, y and z [m], shape (B, M, 3), of markers at ``rest`` (B, M, 3).

        Raises ``InputError``: the surface has no coat mesh, or a marker lies off it.
        """
        if surface.coat is None:
            rule = "needs a soft pad (physics='ipc'): a rigid pad has heights only; choose another model, such as fots"
            raise InputError("markers", value="surface", rule=rule)
        mesh = surface.coat.mesh
        return self._points.interpolate(mesh, rest, surface.coat.positions - mesh.rest)
