"""``PressedGel``: the gel of one pad under bodies and other gels.

In all environments at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import warp as wp

from raytac.errors import InputError
from raytac.gel.pyramid import ElasticSurround
from raytac.gel.surface import PadGrid
from raytac.physics.rigid.shape_arrays import ShapeArrays
from raytac.physics.rigid.underside_kernels import Before, Nodes, join_rows, lower, place
from raytac.shapes.part import Part
from raytac.warp_runtime import HostArrays, Recorded


@dataclass(frozen=True)
class Pressed:
    """Gel of n pads, pad frame [m], as copies."""

    height: np.ndarray
    """Surface (n, Ny, Nx), float32, at rest where nothing touches, and where ``lost``."""
    contact: np.ndarray
    """True where a body touches, (n, Ny, Nx)."""
    centre: np.ndarray
    """Overlap-weighted centre (x, y) of the contact (n, 2), NaN without."""
    lost: np.ndarray
    """True where the gel would lie below its bonded face, (n,)."""
    depth: np.ndarray
    """Greatest overlap of each body with the resting gel (n, bodies + gels), −inf without."""
    behind: np.ndarray
    """True where a body is beyond the bonded face on some line (n, bodies + gels)."""


class PressedGel:
    """Undersides of bodies on the nodes of a pad, and the surface under them.

    Undersides reach up to the resting gel.

    Another gel is a body too, which takes its share of the overlap (see ``GelPairs``). ``launch`` works without the host, so that it can
    be recorded; ``of`` copies from and to NumPy around it. Poses that are not finite show nothing, nor do bodies below the bonded face.

    Attributes:
        poses: ``pad_from_body`` of bodies and then gels (B, bodies + gels), matrices 4 × 4 of float64, which ``launch`` reads, and with it
        sound: environments that have not broken down, (B,), bool.
        surround: overlap, surface and contact.
        depth, beyond: as ``depth`` and ``behind`` of ``Pressed``, on the device.
    """

    def __init__(
        self,
        grid: PadGrid,
        thickness: float,
        bodies: Sequence[Sequence[Part]],
        *,
        gels: Sequence[tuple[Sequence[Part], float]] = (),
        num_envs: int,
        device: str = "cpu",
    ) -> None:
        """Make the arrays.

        Args:
            grid: nodes of the pad; ``thickness`` of its gel [m].
            bodies: by their parts, body frame.
            gels: other gels by their parts, pad frame, and the share of the overlap by which each presses this one in; 0 for none.
        """
        self.surround = ElasticSurround(grid, thickness=thickness, num_envs=num_envs, device=device)
        self.device, self._count = self.surround.device, len(bodies) + len(gels)
        everything = [*bodies, *(parts for parts, _ in gels)]
        self._shapes = ShapeArrays(everything, self.device)
        nodes: Any = Nodes()
        # A gel that another one passes on paper still yields its own share.
        share = [*(1.0 for _ in bodies), *(share for _, share in gels)]
        bond = [*(-thickness for _ in bodies), *(-np.inf for _ in gels)]
        lines = {"x": grid.x, "y": grid.y, "rest": grid.rest, "share": share, "bond": bond}
        for name, values in lines.items():
            setattr(nodes, name, wp.array(np.asarray(values, float), dtype=wp.float64, device=self.device))
        nodes.highest = float(grid.rest.max())
        self._nodes, (ny, _) = nodes, grid.shape
        self.poses, self.sound = self._zeros(num_envs, self._count, dtype=wp.mat44d), self._zeros(num_envs, dtype=wp.bool)
        self.depth, self.beyond = (self._zeros(num_envs, self._count, dtype=dtype) for dtype in (wp.float64, wp.int32))
        before: Any = Before()
        for name, dtype in (("rotation", wp.mat33d), ("at", wp.vec3d), ("bottom", wp.float64), ("window", wp.vec4i)):
            setattr(before, name, self._zeros(num_envs, sum(map(len, everything)), dtype=dtype))
        self._before, self._written = before, self._zeros(num_envs, ny, dtype=wp.vec2i)
        self._depths, self._behind = (self._zeros(num_envs, ny, self._count, dtype=dtype) for dtype in (wp.float64, wp.int32))

    def of(self, pad_from_body: np.ndarray, sound: np.ndarray) -> Pressed:
        """Surfaces at poses (n, bodies + gels, 4, 4); at rest where ``sound`` (n,) is False.

        Raises InputError for arrays of another shape, or of more environments than there is memory for.
        """
        count, most = len(pad_from_body), len(self.sound)
        if pad_from_body.shape != (count, self._count, 4, 4) or count > most:
            rule = f"must have shape (n, {self._count}, 4, 4), n at most {most}"
            raise InputError("pad_from_body", value=pad_from_body.shape, rule=rule)
        if np.shape(sound) != (count,):
            raise InputError("sound", value=np.shape(sound), rule=f"must have shape ({count},), one for each pad")
        inputs, results, launch = self._host
        poses, active = inputs.values
        poses[:count], active[:count], active[count:] = pad_from_body, sound, False
        inputs.write()
        launch()
        depth, beyond = (values[:count].copy() for values in results.read())
        return Pressed(*self.surround.results(count), depth, beyond != 0)

    @cached_property
    def _host(self) -> tuple[HostArrays, HostArrays, Recorded]:
        """Arrays that ``launch`` reads, results for each body, and ``launch`` recorded."""
        recorded = Recorded(self.launch, device=self.device)
        return HostArrays(self.poses, self.sound), HostArrays(self.depth, self.beyond), recorded

    def launch(self) -> None:
        """Launch the kernels; nothing waits for the device."""
        (count, lines), surround, by_row = self._written.shape, self.surround, (self._written, self._depths, self._behind)
        surround.clear()
        if self._count:
            self._launch(place, (count, self._count), [self.poses, self.sound, self._shapes.struct, self._nodes, self._before])
            self._launch(lower, (count, lines), [self._shapes.struct, self._nodes, self._before, surround.overlap, *by_row])
        self._launch(join_rows, (count,), [*by_row, surround.window, surround.deepest, self.depth, self.beyond])
        surround.launch()

    def _zeros(self, *shape: int, dtype: Any) -> wp.array:
        return wp.zeros(shape, dtype=dtype, device=self.device)

    def _launch(self, kernel: Any, dim: tuple[int, ...], inputs: list[Any]) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, device=self.device)
