"""Sums over whole bodies and pairs of them.

What a robot's simulator needs to know of a step, in one small array of the device.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from ipc.arrays import filled
from ipc.blocks import THREADS
from ipc.bodies.body import AffineBody, Body, rotation_matrix
from ipc.bodies.layout import Layout
from ipc.contact import friction
from ipc.solver.potential import Potential
from ipc.sum_kernels import BodySums, PairSums, SumLayout, sum_bodies, sum_pairs

Floats = NDArray[np.float64]
_SHAPES: dict[str, tuple[int, ...]] = {
    **{"force": (3,), "torque": (3,), "area": (), "low": (3,), "high": (3,), "rotation": (3, 3), "position": (3,)},
    **{"centre": (3,), "velocity": (3,), "spin": (3,), "inertia": (3, 3)},
}
_PAIR_SHAPES: dict[str, tuple[int, ...]] = {"pair_normal": (3,), "pair_place": (3,), "pair_force": (3,), "pair_torque": (3,)}


class StepSums:
    """Sums of the present state by body (B, bodies, …) and by pair of bodies (B, P, …).

    World frame.

    ``arrays`` are Warp arrays of the device by name, float64, one after the other in one memory; ``launch`` writes them. ``host`` has the
    same in NumPy, of one copy, made at the first look after ``expire``.

    ============ ====================================================================================================================
    force        contact and friction forces on a body [N]; none of a half-space
    torque       theirs about ``position`` [N m]
    area         of the surface vertices that bear a force [m²]
    low, high    corners of the box around all nodes of a body, in its frame [m]; infinite without nodes
    rotation     of the frame that carries a body; the nearest rotation of a free affine one, the identity of a free soft one
    position     of that frame's origin [m]
    centre       of mass [m]; this and the next three are of bodies with nodes, 0 for others
    velocity     of the centre [m/s]
    spin         angular velocity with the same angular momentum [rad/s]
    inertia      about the centre [kg m²]
    pair_normal  sum of the normal forces on a pair's first body by the second [N]
    pair_place   their mean point of action [m]; NaN where the two do not touch
    pair_force   all forces on the first body, friction included [N]
    pair_torque  theirs about ``pair_place`` [N m]
    ============ ====================================================================================================================

    Attributes:
        mass: of each body with nodes [kg], 0 of others (bodies,).
        copies: number of copies to the host so far.
    """

    def __init__(self, layout: Layout, bodies: tuple[Body, ...], potential: Potential) -> None:
        """Make the arrays; the bodies are those of the layout."""
        self._potential, device, batch = potential, potential.device, potential.batch
        self._layout: Any = _sum_layout(layout, bodies, device)
        shapes = {name: (batch, len(bodies), *shape) for name, shape in _SHAPES.items()}
        shapes |= {name: (batch, len(layout.pairs), *shape) for name, shape in _PAIR_SHAPES.items()}
        sizes = {name: int(np.prod(shape)) for name, shape in shapes.items()}
        self._flat = wp.zeros(max(sum(sizes.values()), 1), dtype=wp.float64, device=device)
        self.arrays: dict[str, Any] = {}
        self._parts: dict[str, tuple[slice, tuple[int, ...]]] = {}
        self._bodies: Any = BodySums()
        self._pairs: Any = PairSums()
        first, at = int(self._flat.ptr or 0), 0
        for name, shape in shapes.items():
            place, end = first + 8 * at, at + sizes[name]
            self._parts[name], at = (slice(at, end), shape), end
            self.arrays[name] = wp.array(ptr=place, shape=shape, dtype=wp.float64, device=device)
            kind = {2: wp.float64, 3: wp.vec3d, 4: wp.mat33d}[len(shape)]
            target = self._pairs if name.startswith("pair_") else self._bodies
            setattr(target, name.removeprefix("pair_"), wp.array(ptr=place, shape=shape[:2], dtype=kind, device=device))
        self.mass = np.where(
            np.diff(layout.node_start) > 0, np.add.reduceat(np.append(_shares(layout), 0.0), layout.node_start[:-1]), 0.0
        )
        self.copies = 0
        self._host: dict[str, Any] = {}
        self._fresh = False

    def expire(self) -> None:
        """Say that the state has changed."""
        self._host, self._fresh = {}, False

    def launch(self) -> None:
        """Write ``arrays``, unless they are of the present state."""
        if self._fresh:
            return
        s, layout, threads = self._potential, self._layout, THREADS if self._potential.device.is_cuda else 1
        dim, inputs = (*self._bodies.force.shape, threads), [layout, s.x, s.y, s.v, s.R, s.t, s.vert_gradient, threads]
        wp.launch(sum_bodies, dim, inputs, [self._bodies], device=s.device, block_dim=THREADS)
        lagged = s.collision.lagged if s.collision.friction else _no_friction(s)
        dim = (*self._pairs.normal.shape, threads)
        inputs = [layout, s.x, s.x_start, s.collision.contacts, lagged, s.settings.friction_slip, threads]
        if dim[1]:
            wp.launch(sum_pairs, dim, inputs, [self._pairs], device=s.device, block_dim=THREADS)
        self._fresh = True

    @property
    def host(self) -> dict[str, Floats]:
        """All sums in NumPy by name; read-only, and copied once a state."""
        if not self._host:
            self.launch()
            flat = np.array(self._flat.numpy())
            flat.flags.writeable = False
            self.copies += 1
            self._host = {name: flat[part].reshape(shape) for name, (part, shape) in self._parts.items()}
        return self._host


def _shares(layout: Layout) -> Floats:
    """Mass of each node [kg], (N,)."""
    rows = np.repeat(np.arange(len(layout.node_rest)), np.diff(layout.row_start))
    return np.bincount(rows, weights=layout.mass, minlength=len(layout.node_rest)).astype(np.float64)


def _sum_layout(layout: Layout, bodies: tuple[Body, ...], device: wp.Device) -> Any:
    affine, corner, gradient = np.full(len(bodies), -1), [], []
    for k, body in enumerate(bodies):
        if isinstance(body, AffineBody):
            affine[k] = len(corner)
            place = layout.node_rest[layout.node_start[k]] - np.asarray(body.pose.position)
            corner.append(rotation_matrix(body.pose.rotation).T @ place)
            gradient.append(layout.grads[layout.tet_start[k]])
    names = ("node_start", "vert_start", "vert_body", "vert_area", "row_start", "col", "mass")
    result: Any = filled(SumLayout, device, {name: getattr(layout, name) for name in names})
    result.framed = wp.array(layout.framed[: len(bodies)].astype(np.int32), dtype=wp.int32, device=device)
    result.affine = wp.array(affine, dtype=wp.int32, device=device)
    result.first_body = wp.array(np.ascontiguousarray(layout.pairs[:, 0]), dtype=wp.int32, device=device)
    result.share = wp.array(_shares(layout), dtype=wp.float64, device=device)
    result.corner = wp.array(np.reshape(corner, (-1, 3)), dtype=wp.vec3d, device=device)
    result.gradient = wp.array(np.reshape(gradient, (-1, 4, 3)), dtype=wp.vec3d, device=device)
    return result


def _no_friction(potential: Potential) -> Any:
    """Friction pairs of a world without friction: none."""
    lagged: Any = friction.Lagged()
    lagged.count = wp.zeros(potential.batch, dtype=wp.int32, device=potential.device)
    lagged.limit = wp.zeros((potential.batch, 1), dtype=wp.float64, device=potential.device)
    return lagged
