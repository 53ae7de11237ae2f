"""An independent look at the states of a world: crossing surfaces by ipctk, and orientation of elements by rational arithmetic.

Nothing of the solver is asked but its positions.
"""

from __future__ import annotations

from fractions import Fraction

import ipctk
import numpy as np
from numpy.typing import NDArray

import ipc

Floats = NDArray[np.float64]

_DOUBT = 1e-13
"""A determinant below this share of its terms' sizes is computed again, exactly."""


def exact_determinant(corners: Floats) -> Fraction:
    """(b − a) × (c − a) · (d − a) of a tetrahedron's corners (4, 3), exactly."""
    points = [[Fraction(float(value)) for value in point] for point in corners]
    (a, b, c), (d, e, f), (g, h, i) = ([p - q for p, q in zip(point, points[0], strict=True)] for point in points[1:])
    return a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)


def least_det_f(now: Floats, rest: Floats, tets: NDArray[np.integer]) -> float:
    """Least det F of tetrahedra (T, 4) at vertices ``now`` against ``rest`` [m] (V, 3); its sign is exact."""
    edges = now[tets][:, 1:] - now[tets][:, :1]
    det, size = np.linalg.det(edges), np.prod(np.linalg.norm(edges, axis=-1), axis=-1)
    for k in np.flatnonzero(~(det > _DOUBT * size)):
        det[k] = float(exact_determinant(now[tets[k]]))
    return float((det / np.linalg.det(rest[tets][:, 1:] - rest[tets][:, :1])).min())


class Oracle:
    """Crossings and least det F of a world's present states.

    Surfaces are compared all with all, a body with itself too, but for obstacles among themselves: they may be built into each other.
    """

    def __init__(self, world: ipc.World) -> None:
        self._world = world
        solid = [b for b in world.bodies if not isinstance(b, ipc.HalfSpace)]
        moving = [b for b in solid if not isinstance(b, ipc.KinematicBody)]
        self._bodies = [*moving, *(b for b in solid if isinstance(b, ipc.KinematicBody))]
        self._soft = [b for b in moving if isinstance(b, ipc.SoftBody)]
        self._affine = [b for b in moving if isinstance(b, ipc.AffineBody)]
        self._half_spaces = [b for b in world.bodies if isinstance(b, ipc.HalfSpace)]
        faces, count, free = [], 0, 0
        for body in self._bodies:
            local = world.surface(body.name)
            faces.append(local[1] + count)
            count += len(local[0])
            free = free if isinstance(body, ipc.KinematicBody) else count
        all_faces = np.concatenate(faces).astype(np.int32)
        sides = np.sort(all_faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        x = np.asfortranarray(self._surfaces()[0])
        self._mesh = ipctk.CollisionMesh(
            x, np.asfortranarray(np.unique(sides, axis=0), np.int32), np.asfortranarray(all_faces, np.int32)
        )
        self._mesh.can_collide = ipctk.make_static_obstacle_filter(free)
        self._free = free

    def _surfaces(self) -> Floats:
        """World positions of surface vertices, moving bodies first, (B, V, 3)."""
        parts = []
        for body in self._bodies:
            x = self._world.positions(body.name)
            parts.append(x[:, self._world.surface(body.name)[0]] if isinstance(body, ipc.SoftBody) else x)
        return np.concatenate(parts, axis=1)

    def crossed(self) -> int:
        """Number of environments in which surfaces cross, or a vertex is below a half-space."""
        x = self._surfaces()
        below = np.zeros(len(x), bool)
        for body in self._half_spaces:
            rotation, position = self._world.frame(body.name)
            height = np.einsum("bnk,bk->bn", x[:, : self._free] - position[:, None], rotation[:, :, 2])
            below |= (height <= 0).any(axis=1)
        return sum(
            bool(under or ipctk.has_intersections(self._mesh, np.asfortranarray(state)))
            for under, state in zip(below, x, strict=True)
        )

    def barrier_energy(self) -> float:
        """Barrier energy of the first environment [J]: ipctk's for surfaces, A κ d̂ b(D)/D̂² for vertices over half-spaces."""
        world, x = self._world, np.asfortranarray(self._surfaces()[0])
        pairs = ipctk.NormalCollisions()
        pairs.use_area_weighting = True
        pairs.build(self._mesh, x, world.d_hat)
        energy = ipctk.BarrierPotential(world.d_hat, world.kappa, True)(pairs, self._mesh, x)
        area, top = np.asarray(self._mesh.vertex_areas)[: self._free], world.d_hat**2
        for body in self._half_spaces:
            rotation, position = world.frame(body.name)
            squared = np.minimum(((x[: self._free] - position[0]) @ rotation[0, :, 2]) ** 2, top)
            energy -= float(area @ ((squared - top) ** 2 * np.log(squared / top))) * world.kappa * world.d_hat / top**2
        return float(energy)

    def least_det(self) -> float:
        """Least det F over all environments; inf without soft or affine bodies."""
        least = np.inf
        for body in self._soft:
            for now in self._world.positions(body.name):
                least = min(least, least_det_f(now, body.mesh.vertices, body.mesh.tets))
        for body in self._affine:
            least = min(least, float(np.linalg.det(self._world.affine_pose(body.name)[0]).min()))
        return least
