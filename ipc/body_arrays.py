"""State of bodies as arrays of the world's device, which other libraries share by DLPack."""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportGeneralTypeIssues=false, reportInvalidTypeForm=false

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import warp as wp

from ipc.arrays import VecArray2d
from ipc.bodies.layout import Layout
from ipc.solver.potential import Potential

wp.set_module_options({"enable_backward": False})


@wp.kernel
def reactions(gradient: VecArray2d, force: VecArray2d):
    """Forces, which are minus the gradient of the contact energy."""
    env, v = wp.tid()
    force[env, v] = -gradient[env, v]


@dataclass(frozen=True)
class BodyArrays:
    """One body in B environments, as Warp arrays of the world's device; steps overwrite them.

    Nothing is copied. Every array has ``__dlpack__``, so that ``torch.from_dlpack`` and others share its memory; there the components of a
    vector or matrix are further axes. To write into them is to change the world behind the solver's back.

    Attributes:
        vertices: surface vertices, world frame [m], (B, n) of ``vec3d``; none of a half-space.
        forces: contact and friction force on each of them at the end of the last step, world frame [N], (B, n) of ``vec3d``.
        nodes: unknowns: a soft body's mesh vertices or an affine body's corners, in the frame below [m], (B, m) of ``vec3d``.
        velocities: of the nodes, world frame [m/s], (B, m) of ``vec3d``.
        rotation, position: world rotation and origin [m] of the frame: of a driven body, else the identity, (B,) of ``mat33d``, ``vec3d``.
    """

    vertices: wp.array
    forces: wp.array
    nodes: wp.array
    velocities: wp.array
    rotation: wp.array
    position: wp.array


@dataclass(frozen=True)
class ContactArrays:
    """Contact pairs of B environments as arrays of the world's device; see ``BodyArrays``.

    Only the first ``min(count, C)`` of an environment are contacts; the others are of earlier steps.

    Attributes:
        count: pairs of each environment, (B,), int32.
        pair: number of the pair's bodies in ``layout.pairs``, (B, C), int32.
        vertices: up to four world vertex numbers, −1 unused, (B, C) of ``vec4i``.
        weights: as of ``ContactPairs``, (B, C) of ``vec4d``.
        normal: unit vector from the second body to the first, world frame, (B, C) of ``vec3d``.
        gap, force: distance [m] and size of the normal force [N], (B, C), float64.
    """

    count: wp.array
    pair: wp.array
    vertices: wp.array
    weights: wp.array
    normal: wp.array
    gap: wp.array
    force: wp.array


class WorldArrays:
    """Views of a potential's arrays by body."""

    def __init__(self, layout: Layout, potential: Potential) -> None:
        self._layout, self._potential = layout, potential
        self._forces: Any = None

    def body(self, index: int) -> BodyArrays:
        """One body."""
        layout, s = self._layout, self._potential
        if self._forces is None:
            self._forces = wp.zeros_like(s.vert_gradient)
            self.update()
        verts, nodes = (slice(*start[index : index + 2].tolist()) for start in (layout.vert_start, layout.node_start))
        parts = (_part(s.x, verts), _part(self._forces, verts), _part(s.y, nodes), _part(s.v, nodes))
        return BodyArrays(*parts, s.R[:, index], s.t[:, index])

    def contacts(self) -> ContactArrays:
        """All contact pairs."""
        c = self._potential.collision.contacts
        return ContactArrays(c.count, c.pair, c.verts, c.coef, c.normal, c.gap, c.force)

    def update(self) -> None:
        """Write the present forces, if somebody reads them."""
        if self._forces is not None:
            s = self._potential
            wp.launch(reactions, dim=self._forces.shape, inputs=[s.vert_gradient, self._forces], device=self._forces.device)


def _part(array: wp.array, part: slice) -> Any:
    """Columns of an array (B, n), also none of them, which Warp's own slices refuse."""
    if part.start == part.stop:
        return wp.empty((array.shape[0], 0), dtype=array.dtype, device=array.device)
    return array[:, part]
