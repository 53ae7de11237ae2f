"""Numbers of the states of MuJoCo Warp, read together on the device."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from raytac.robots.states import Numbers
from raytac.world.engine import mjwarp_kernels as kernels


class NumberReader:
    """Numbers of B environments in float64, read together.

    Attributes:
        arrays: Warp arrays (B, …) by name; they are overwritten by the next ``read``.
    """

    def __init__(self, data: Any, members: Mapping[str, Numbers], num_envs: int, device: Any) -> None:
        """Look up where ``members`` lie in MuJoCo Warp's ``data``; nothing is read yet."""
        names = sorted({name for one in members.values() for name in one.name if name})
        self._sources = [getattr(data, name) for name in names]  # they are read by their addresses
        member, index, start, stride, size = [], [], [], [], 0
        shapes: dict[str, tuple[int, tuple[int, ...]]] = {}
        for key, one in members.items():
            width = len(one.index)
            member += [names.index(name) if name else -1 for name in one.name]
            index += one.index
            start += range(size, size + width)
            stride += [width] * width
            shapes[key] = size, (num_envs, *one.shape)
            size += num_envs * width
        self._shapes = shapes
        self._flat = wp.zeros(size, dtype=wp.float64, device=device)
        first = int(self._flat.ptr or 0)
        self.arrays: dict[str, wp.array] = {
            key: wp.array(ptr=first + 8 * at, shape=shape, dtype=wp.float64, device=device) for key, (at, shape) in shapes.items()
        }
        entries: Any = kernels.Entries()
        entries.arrays = wp.array([array.ptr for array in self._sources], dtype=wp.uint64, device=device)
        # MuJoCo Warp's vectors and matrices are float32 one after the other.
        widths = [array.strides[0] // 4 for array in self._sources]
        for name, column in (("width", widths), ("member", member), ("index", index), ("start", start), ("stride", stride)):
            setattr(entries, name, wp.array(column, dtype=wp.int32, device=device))
        entries.values = self._flat
        self._launch = partial(wp.launch, kernels.read_numbers, dim=(num_envs, len(index)), inputs=[entries], device=device)

    def host(self) -> dict[str, np.ndarray]:
        """NumPy arrays by name of what was read last, of one copy; it waits for the device."""
        flat = np.array(self._flat.numpy())
        return {key: flat[at : at + int(np.prod(shape))].reshape(shape) for key, (at, shape) in self._shapes.items()}

    def read(self) -> None:
        """Copy all numbers to ``arrays``."""
        self._launch()
