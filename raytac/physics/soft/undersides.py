"""Undersides of objects over the nodes of a pad, in all environments at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from raytac.gel.surface import PadGrid
from raytac.physics.rigid.shape_arrays import ShapeArrays
from raytac.physics.rigid.underside_kernels import Before, Nodes, place
from raytac.physics.soft import underside_kernels as kernels
from raytac.shapes.part import Part


@dataclass(frozen=True)
class Touched:
    """N objects that B pads may touch, as arrays of the device; pad frame."""

    shapes: tuple[Sequence[Part], ...]
    """Parts of the rigid ones, which come first."""
    poses: wp.array
    """``pad_from_object`` of all, (B, N) of ``mat44d``."""
    touching: wp.array
    """Those that touch, (B, N), bool; others may lie behind the pad."""
    friction: wp.array
    """Coulomb's coefficient of each on the pad, (N,), float64; NaN where it is not known."""
    surfaces: tuple[tuple[wp.array, wp.array], ...]
    """Of soft ones vertices (B, n) of ``vec3d`` [m], and faces (F,) of ``vec3i``."""


class Undersides:
    """Lowest z of objects above each node of one grid.

    Attributes:
        under: [m], (B, Ny, Nx), float64, inf where there is none. Never −inf: shapes are bounded, but for half-spaces, which have an
            underside only where they look down.
    """

    def __init__(self, grid: PadGrid, below: float, num_envs: int, device: Any) -> None:
        """``below``: rigid parts wholly above this z [m] may be left out."""
        self._device, self._num_envs = device, num_envs
        nodes: Any = Nodes()
        for name, values in (("x", grid.x), ("y", grid.y), ("rest", grid.rest)):
            setattr(nodes, name, wp.array(np.asarray(values, float), dtype=wp.float64, device=device))
        nodes.highest = float(below)
        self._nodes = nodes
        self.under = wp.full((num_envs, *grid.shape), value=np.inf, dtype=wp.float64, device=device)
        self._known: dict[tuple[int, ...], tuple[tuple[Sequence[Part], ...], ShapeArrays, Any, wp.array, wp.array]] = {}

    def find(self, objects: Touched, sound: wp.array, lowered: wp.array) -> None:
        """Launch the undersides of what touches, lowered by (B,), float64 [m] (NaN: by nothing).

        ``sound``: 1 in environments (B,), int32, to be read.
        """
        count, rows, _ = self.under.shape
        if objects.shapes:
            _, shapes, before, poses, everywhere = self._arrays(objects.shapes)
            lower = [sound, objects.touching, 0, objects.poses, lowered, poses]
            self._launch(kernels.lower_poses, poses.shape, lower)
            self._launch(place, poses.shape, [poses, everywhere, shapes.struct, self._nodes, before])
            self._launch(kernels.underside_of_parts, (count, rows), [shapes.struct, self._nodes, before, self.under])
        else:
            self.under.fill_(np.inf)
        for k, (vertices, faces) in enumerate(objects.surfaces):
            surface = [len(objects.shapes) + k, vertices, faces, lowered, self._nodes, self.under]
            self._launch(kernels.underside_of_triangles, (count, len(faces)), [sound, objects.touching, *surface])

    def remove_behind(self, objects: Touched, rise: wp.array, clearance: wp.array) -> None:
        """Launch the removal of what is far below the smooth coat, at ``rise`` (B, Ny, Nx) [m].

        It is for pads that several objects touch; none where the ``clearance`` (B,) is not finite.
        """
        if objects.touching.shape[1] > 1:
            inputs = [objects.touching, clearance, self._nodes.rest, rise, self.under]
            self._launch(kernels.remove_behind, self.under.shape[:2], inputs)

    def _arrays(self, shapes: tuple[Sequence[Part], ...]) -> tuple[Any, ShapeArrays, Any, wp.array, wp.array]:
        """Arrays for rigid objects, made once for each choice of them."""
        key = tuple(map(id, shapes))
        if key not in self._known:
            arrays, count = ShapeArrays(shapes, self._device), self._num_envs
            before: Any = Before()
            for name, dtype in (("rotation", wp.mat33d), ("at", wp.vec3d), ("bottom", wp.float64), ("window", wp.vec4i)):
                setattr(before, name, wp.zeros((count, sum(map(len, shapes))), dtype=dtype, device=self._device))
            poses = wp.zeros((count, len(shapes)), dtype=wp.mat44d, device=self._device)
            everywhere = wp.full(count, value=True, dtype=wp.bool, device=self._device)
            self._known[key] = shapes, arrays, before, poses, everywhere
        # As many as any choice has: the kernel leaves out what presses by none.
        most = max(len(known[0]) for known in self._known.values())
        if self._nodes.share is None or self._nodes.share.shape[0] < most:
            self._nodes.share = wp.array(np.ones(most), dtype=wp.float64, device=self._device)
        return self._known[key]

    def _launch(self, kernel: Any, dim: Any, inputs: list[Any]) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, device=self._device)
