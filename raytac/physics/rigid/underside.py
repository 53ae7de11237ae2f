"""Undersides of all bodies over the pads of one sensor, all environments at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from raytac.errors import InputError
from raytac.gel.surface import PadGrid
from raytac.physics.rigid.shape_arrays import ShapeArrays
from raytac.physics.rigid.underside_kernels import Before, Nodes, join_rows, lower, place
from raytac.shapes.part import Part
from raytac.warp_runtime import start_warp


@dataclass(frozen=True)
class Underside:
    """Undersides over n pads, pad frame [m].

    On the CPU they are views, which may be changed and which the next call overwrites.
    """

    height: np.ndarray
    """Lowest z of all bodies (n, Ny, Nx) between resting gel and bonded face, else inf."""
    depth: np.ndarray
    """Greatest overlap of each body with the resting gel (n, bodies), −inf without."""
    behind: np.ndarray
    """True where a body is beyond the bonded face on some line (n, bodies), bool."""
    window: np.ndarray
    """Columns from, to and rows from, to (n, 4) of finite nodes of ``height``; 0 for none."""


class Undersides:
    """Heights of bodies on the nodes of a pad's surface, up to the resting gel.

    ``poses`` (B, bodies) of 4 × 4 matrices ``pad_from_body`` and ``sound`` (B,), 0 where nothing is to be computed, are Warp arrays on the
    device, and so are ``height``, ``window``, ``deepest`` and ``beyond``, the fields of ``Underside``. ``launch`` works on them without the
    host, so that it can be recorded in a CUDA graph; ``of`` copies from and to NumPy around it. Poses that are not finite show nothing.
    """

    def __init__(
        self, grid: PadGrid, thickness: float, bodies: Sequence[Sequence[Part]], *, num_envs: int, device: str = "cpu"
    ) -> None:
        """``grid`` of the pad; ``thickness`` of its gel [m]; bodies by their parts, body frame."""
        start_warp()
        self.device, self._grid, self._bodies = wp.get_device(device), grid, len(bodies)
        self._shapes = ShapeArrays(bodies, self.device)
        self._parts = sum(map(len, bodies))
        nodes: Any = Nodes()
        for name in ("x", "y", "rest"):
            setattr(nodes, name, wp.array(getattr(grid, name), dtype=wp.float64, device=self.device))
        nodes.highest, nodes.bond = float(grid.rest.max()), -thickness
        self._nodes = nodes
        self._allocate(num_envs)

    def of(self, pad_from_body: np.ndarray, sound: np.ndarray) -> Underside:
        """Undersides at poses (n, bodies, 4, 4); nothing where ``sound`` (n,) is False.

        Raises InputError for arrays of another shape.
        """
        count = len(pad_from_body)
        if pad_from_body.shape != (count, self._bodies, 4, 4):
            raise InputError("pad_from_body", value=pad_from_body.shape, rule=f"must have shape (n, {self._bodies}, 4, 4)")
        if np.shape(sound) != (count,):
            raise InputError("sound", value=np.shape(sound), rule=f"must have shape ({count},), one for each pad")
        if count > len(self.sound):
            self._allocate(count)
        if self._views is not None:
            self._views["poses"][:count], self._views["sound"][:count] = pad_from_body, sound
        elif count:
            self.poses[:count].assign(pad_from_body)
            self.sound[:count].assign(np.asarray(sound, np.int32))
        self.launch(count)
        height, depth, behind, window = (
            (self._views[name] if self._views is not None else getattr(self, name).numpy())[:count]
            for name in ("height", "deepest", "beyond", "window")
        )
        return Underside(height, depth, behind != 0, window)

    def launch(self, count: int | None = None) -> None:
        """Fill the outputs of the first ``count`` environments (None: all), without waiting."""
        count = len(self.sound) if count is None else count
        if count == 0:
            return
        self.height.fill_(float("inf"))
        for recorded, shape in zip(self._launches, ((self._bodies,), (self._grid.shape[0],), ()), strict=True):
            if 0 not in shape:
                if count != self._launched:
                    recorded.set_dim((count, *shape))
                recorded.launch()
        self._launched = count

    def _allocate(self, num_envs: int) -> None:
        (ny, nx), bodies = self._grid.shape, self._bodies

        def zeros(*shape: int, dtype: Any) -> wp.array:
            return wp.zeros((num_envs, *shape), dtype=dtype, device=self.device)

        self.poses, self.sound = zeros(bodies, dtype=wp.mat44d), zeros(dtype=wp.int32)
        self.height = zeros(ny, nx, dtype=wp.float64)
        self.window, self.deepest = zeros(dtype=wp.vec4i), zeros(bodies, dtype=wp.float64)
        self.beyond = zeros(bodies, dtype=wp.int32)
        before: Any = Before()
        for name, dtype in (("rotation", wp.mat33d), ("at", wp.vec3d), ("bottom", wp.float64), ("window", wp.vec4i)):
            setattr(before, name, zeros(self._parts, dtype=dtype))
        written = zeros(ny, dtype=wp.vec2i)
        depth, behind = zeros(ny, bodies, dtype=wp.float64), zeros(ny, bodies, dtype=wp.int32)
        shapes, nodes = self._shapes.struct, self._nodes
        kernels = (
            (place, (num_envs, max(bodies, 1)), [self.poses, self.sound, shapes, nodes, before]),
            (lower, (num_envs, ny), [shapes, nodes, before, self.height, written, depth, behind]),
            (join_rows, (num_envs,), [written, depth, behind, self.window, self.deepest, self.beyond]),
        )
        # Launches are recorded, so that repeating them costs a fifth.
        self._launched = num_envs
        self._launches: list[Any] = [
            wp.launch(kernel, dim=dim, inputs=inputs, device=self.device, record_cmd=True) for kernel, dim, inputs in kernels
        ]
        names = ("poses", "sound", "height", "window", "deepest", "beyond")
        self._views = {name: getattr(self, name).numpy() for name in names} if self.device.is_cpu else None
