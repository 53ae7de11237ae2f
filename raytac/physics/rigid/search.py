"""Search for contacts of resting pads and rigid bodies, all at once, on CPU or CUDA."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from raytac.errors import InputError
from raytac.physics.rigid.contact_rows import LAST, Rows
from raytac.physics.rigid.contacts import LAW_POINTS, PadContacts
from raytac.physics.rigid.law_kernels import BINS, Sums
from raytac.physics.rigid.search_kernels import PITCHES, Work, find_near, measure
from raytac.physics.rigid.shape_arrays import PadArrays, ShapeArrays
from raytac.shapes.part import Part
from raytac.specs.sensor import GelpadSpec
from raytac.warp_runtime import LAUNCH, start_warp

_LANES = 128
"""Threads of a block on CUDA."""
_MEMORY = 512e6
"""Most memory that the nodes of all blocks take on CUDA [byte]."""


class PadSearch:
    """Contacts of the pads and bodies of a world.

    The overlap of a resting pad and a body's underside is measured on nodes in the pad's frame: on the first grid (spacing 0.8, 0.4,
    0.2 mm) of which it covers 150 nodes, else on the last; parabolas between the nodes refine its depth. Nodes at a body's edges stand for
    the area that it covers beside them, so that its force does not jump where they pass nodes. Bodies that are narrow as seen
    along z, convex ones than 20 cells of the last grid and others than two, are measured on finer ones, down to 0.05 mm. The gap of a
    body that does not touch is measured likewise.

    Warp arrays on the device are ``poses`` (environments, pads, bodies) of 4 × 4 matrices ``pad_from_body``, ``reach`` (environments,
    pads) [m], ``closing`` (environments, pads, bodies) [m] and ``rows``. Nodes with gaps up to ``reach`` are looked at; a gap from
    ``reach`` or ``closing`` on is no row. ``launch`` works on them without the host, so that it can be recorded in a CUDA graph;
    ``contacts`` copies from and to NumPy around it, with all gaps up to ``reach``.
    """

    def __init__(
        self,
        gelpads: Sequence[GelpadSpec],
        bodies: Sequence[Sequence[Part]],
        *,
        num_envs: int,
        ahead: float = np.inf,
        device: str = "cpu",
    ) -> None:
        """Make memory on the device.

        Args:
            gelpads: the pads.
            bodies: parts of each body, body frame.
            num_envs: number of environments.
            ahead: how far into the gel, beyond the present depth, laws are tabulated at most [m]; a law goes on straight from there.
            device: "cpu" or "cuda".
        """
        start_warp()
        self.device = wp.get_device(device)
        self._pads = PadArrays(gelpads, PITCHES, LAST, self.device)
        self._shapes = ShapeArrays(bodies, self.device)
        self._shape = len(gelpads), len(bodies)
        self._capacity = 0
        self._work = self._memory(num_envs)
        self._work.ahead = ahead
        self._allocate(num_envs)
        self.reserve(self.pairs if self.device.is_cuda else 1)

    @property
    def geometry(self) -> tuple[PadArrays, ShapeArrays]:
        """Pads and bodies on the device."""
        return self._pads, self._shapes

    def contacts(self, pad_from_body: np.ndarray, envs: np.ndarray, reach: np.ndarray | float) -> PadContacts:
        """Contacts and gaps of environments.

        Args:
            pad_from_body: poses (B', pads, bodies, 4, 4); one that is not finite gives a row of NaN.
            envs: what the environments are called in the result, (B',).
            reach: gaps up to it are reported [m], (B', pads) or one for all.

        Raises:
            InputError: arrays of another shape, or a reach that is negative or not finite.
        """
        poses, envs = np.asarray(pad_from_body, float), np.asarray(envs)
        if poses.ndim != 5 or poses.shape[1:] != (*self._shape, 4, 4):
            raise InputError(
                "pad_from_body", value=poses.shape, rule=f"must have shape (B, {self._shape[0]}, {self._shape[1]}, 4, 4)"
            )
        count = len(poses)
        if envs.shape != (count,):
            raise InputError("envs", value=envs.shape, rule=f"must have shape ({count},), one for each pose")
        reach = np.asarray(reach, float)
        if reach.ndim and reach.shape != (count, self._shape[0]):
            raise InputError("reach", value=reach.shape, rule=f"must be a number or have shape ({count}, {self._shape[0]})")
        if not (np.isfinite(reach).all() and (reach >= 0.0).all()):
            raise InputError("reach", value=reach.tolist(), rule="must be finite and >= 0 [m]")
        pairs = count * self._shape[0] * self._shape[1]
        if pairs == 0:
            return self._read(0, envs)
        if count > self.poses.shape[0]:
            self._allocate(count)
        self._fill(poses, reach)
        return self._read(self.run(count), envs)

    def run(self, count: int) -> int:
        """Fill ``rows`` from ``poses`` and ``reach`` of the first ``count`` environments.

        There is memory for as many rows as there are; more memory is another ``rows``. Returns their number, for which a device is waited
        for.
        """
        pairs = count * self._shape[0] * self._shape[1]
        if pairs == 0:
            return 0
        self._find_near(count)
        rows = self._number_rows(pairs)
        if rows > self._capacity:
            self.reserve(max(rows, 2 * self._capacity))
        if rows:
            self._measure(pairs)
        return rows

    def launch(self) -> None:
        """Fill ``rows`` from all environments' ``poses`` and ``reach``, without waiting.

        Rows follow the order of environments, pads and bodies; ``ends`` (pairs,) holds the number of rows up to each pair. Rows beyond
        those that ``reserve`` made are left out.
        """
        self._find_near(self.poses.shape[0])
        wp.utils.array_scan(self.near, self.ends, inclusive=True)
        self._measure(self.pairs)

    def reserve(self, rows: int) -> None:
        """Make memory for so many rows."""
        self._capacity = rows
        result: Any = Rows()
        for name, dtype in _ROWS.items():
            shape = (rows, LAW_POINTS) if name in ("force", "radius") else (rows,)
            setattr(result, name, wp.zeros(shape, dtype=dtype, device=self.device))
        self.rows = result
        # On a CPU these are views, and making one takes longer than copying a few rows.
        self._views = {name: getattr(result, name).numpy() for name in _ROWS} if self.device.is_cpu else None
        self._record()

    def _allocate(self, num_envs: int) -> None:
        pads, bodies = self._shape
        self.pairs = num_envs * pads * bodies
        self.poses = wp.zeros((num_envs, pads, bodies), dtype=wp.mat44d, device=self.device)
        self.reach = wp.zeros((num_envs, pads), dtype=wp.float64, device=self.device)
        self.closing = wp.full((num_envs, pads, bodies), np.inf, dtype=wp.float64, device=self.device)
        self.near = wp.zeros(self.pairs, dtype=wp.int32, device=self.device)
        self.ends = wp.zeros(self.pairs, dtype=wp.int32, device=self.device)
        if self._capacity:
            self._record()

    def _memory(self, num_envs: int) -> Any:
        """Memory of the blocks: one on a CPU, where Warp runs one thread after the other."""
        blocks = 1
        if self.device.is_cuda:
            most = int(_MEMORY / (16 * self._pads.most_nodes))
            blocks = max(min(num_envs * self._shape[0] * self._shape[1], 8 * self.device.sm_count, most), 1)
        self._blocks = blocks
        work: Any = Work()
        work.placed.count = wp.zeros(blocks, dtype=wp.int32, device=self.device)
        for name, dtype in _PLACED.items():
            setattr(work.placed, name, wp.zeros((blocks, self._shapes.most_parts), dtype=dtype, device=self.device))
        work.bins.sums = wp.zeros((blocks, BINS), dtype=Sums, device=self.device)
        work.bins.lines = wp.zeros((blocks, BINS + 1), dtype=wp.vec3d, device=self.device)
        work.gap = wp.zeros((blocks, self._pads.most_nodes), dtype=wp.float64, device=self.device)
        work.ends = wp.zeros((blocks, self._pads.most_around), dtype=wp.vec2f, device=self.device)
        return work

    def _record(self) -> None:
        """Launches are recorded, so that repeating them costs a fifth."""
        shapes, pads = self._shapes.struct, self._pads.struct
        self._near_launch: Any = wp.launch(
            find_near,
            dim=self.near.shape if 0 in self.poses.shape else self.poses.shape,
            inputs=[self.poses, self.reach, self.closing, shapes, pads],
            outputs=[self.near],
            device=self.device,
            record_cmd=True,
        )
        self._measure_launch: Any = wp.launch_tiled(
            measure,
            dim=[self._blocks],
            inputs=[
                self.poses, self.reach, self.closing, shapes, pads, self.near, self.ends, self._blocks, self.pairs, self._work, self.rows,
            ],
            device=self.device,
            block_dim=_LANES,
            record_cmd=True,
        )  # fmt: skip

    def _fill(self, poses: np.ndarray, reach: np.ndarray) -> None:
        count = len(poses)
        self.closing.fill_(np.inf)
        if self.device.is_cpu:
            self.poses.numpy()[:count] = poses
            self.reach.numpy()[:count] = reach
            return
        self.poses[:count].assign(poses)
        self.reach[:count].assign(np.broadcast_to(reach, (count, self._shape[0])))

    def _find_near(self, count: int) -> None:
        self._near_launch.set_dim((count, *self._shape))
        self._near_launch.launch()

    def _number_rows(self, pairs: int) -> int:
        if self.device.is_cpu:
            ends = self.ends.numpy()
            np.cumsum(self.near.numpy()[:pairs], out=ends[:pairs])
            return int(ends[pairs - 1])
        wp.utils.array_scan(self.near, self.ends, inclusive=True)
        return int(self.ends[pairs - 1 : pairs].numpy()[0])

    def _measure(self, pairs: int) -> None:
        self._measure_launch.set_param_by_name("pairs", pairs)
        with LAUNCH:
            self._measure_launch.launch()

    def _read(self, rows: int, envs: np.ndarray) -> PadContacts:
        """Those of the first rows that are contacts, copied."""
        views = self._views or {name: getattr(self.rows, name).numpy() for name in _ROWS}
        at = np.flatnonzero(views["valid"][:rows])
        fields = {name: views[name][at] for name in _FIELDS}
        return PadContacts(env=envs[views["env"][at]], **fields)


_ROWS = {
    "valid": wp.int32,
    "env": wp.int32,
    "pad": wp.int32,
    "body": wp.int32,
    "depth": wp.float64,
    "centre": wp.vec3d,
    "normal": wp.vec3d,
    "clearance": wp.float64,
    "spread": wp.vec3d,
    "deepest": wp.float64,
    "force": wp.float64,
    "radius": wp.float64,
}
_FIELDS = tuple(name for name in _ROWS if name not in ("valid", "env"))
_PLACED = {
    "part": wp.int32,
    "rotation": wp.mat33d,
    "at": wp.vec3d,
    "centre": wp.vec3d,
    "half": wp.vec3d,
    "radius": wp.float64,
    "bottom": wp.float64,
    "width": wp.float64,
    "blunt": wp.float64,
}
