"""``ContactHistory``: contacts of many pads and their history, on a device."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from raytac.errors import InputError
from raytac.markers.contact_kernels import Contact, Moments, Pad, detect, follow, forget
from raytac.markers.contacts import COLUMNS, ContactCells, ContactSamples
from raytac.warp_runtime import LAUNCH, start_warp

_NAN = wp.mat44d(*[np.nan] * 16)


class ContactHistory:
    """Contacts of B pads on the CPU or on CUDA.

    The arrays are inputs of ``launch`` up to ``stretch``, then results.

    Attributes:
        depth: mean indentation of each cell [m], (B, ny, nx), float32; negative where nothing touches.
        window: columns from, to and rows from, to of the cells that may be touched, (B,); all at first.
        envs: environment of each row, (B,).
        pose, centre, stretch: of each row, as of ``contact_kernels.follow``.
        box: as ``window``, of the cells that are touched.
        table: as of ``Contacts``, (B, ``room``, 12), float64.
        pad: constants of the grid, the cells and the law, for kernels.
        room: most contacts of a pad; what is more is left out.
    """

    def __init__(
        self,
        cells: ContactCells,
        reach: float,
        slip: float | None,
        *,
        num_envs: int,
        room: int = 8,
        follows_shear: bool = True,
        device: Any = "cpu",
    ) -> None:
        """Make the arrays; ``reach`` [m] as ``ContactSettings``, others as ``ContactTracker``."""
        start_warp()
        self.device, grid = wp.get_device(device), cells.grid
        self.pad: Any = Pad()
        self.pad.first, self.pad.pitch, self.pad.nodes = (
            wp.vec2d(cells.x[0], cells.y[0]),
            wp.vec2d(*cells.pitch),
            wp.vec2i(*cells.nodes),
        )
        self.pad.node_first, self.pad.node_pitch = wp.vec2d(*grid.origin), wp.vec2d(*grid.pitch)
        self.pad.rest = wp.array(grid.rest, dtype=wp.float64, device=self.device)
        self.pad.reach, self.pad.slip, self.pad.follows_shear = reach, -1.0 if slip is None else slip, int(follows_shear)
        ny, nx = self._size = len(cells.y), len(cells.x)
        self._num_envs = num_envs
        self.depth, self.window = self._zeros(ny, nx, dtype=wp.float32), self._zeros(dtype=wp.vec4i)
        self.window.fill_(wp.vec4i(0, nx, 0, ny))
        self.envs = wp.array(np.arange(num_envs), dtype=wp.int32, device=self.device)
        self.pose, self._pose_before = self._zeros(dtype=wp.mat44d), self._zeros(dtype=wp.mat44d)
        self._pose_before.fill_(_NAN)
        self.centre, self.stretch = self._zeros(dtype=wp.vec3d), self._zeros(dtype=wp.vec3d)
        self.box, self._parent = self._zeros(dtype=wp.vec4i), self._zeros(ny * nx, dtype=wp.int32)
        self._most = wp.zeros(1, dtype=wp.int32, device=self.device)
        self.room = 0
        self._make_room(room)
        names = ("depth", "window", "envs", "pose", "centre", "stretch")
        # On the CPU these are views.
        self._host = (
            {name: getattr(self, name).numpy() for name in names} | {"most": self._most.numpy()} if self.device.is_cpu else {}
        )

    def _make_room(self, room: int) -> None:
        before, former = getattr(self, "_before", None), self.room
        self.room = room
        self._moments, self._contacts = self._zeros(room, dtype=Moments), self._zeros(room, dtype=Contact)
        self._before = self._zeros(room, dtype=Contact)
        if before is not None:
            self._before.numpy()[:, :former] = before.numpy()
        self.table = self._zeros(room, COLUMNS, dtype=wp.float64)
        pieces = [self._parent, self._moments, self.box, self._contacts, self._most]
        kept = [self._contacts, self._before, self._pose_before, self.table]
        self._detect: Any
        self._follow: Any
        self._detect, self._follow = (
            wp.launch(kernel, dim=self._num_envs, inputs=inputs, device=self.device, record_cmd=True)
            for kernel, inputs in (
                (detect, [self.depth, self.window, self.pad, *pieces]),
                (follow, [self.envs, self.pose, self.centre, self.stretch, self.pad, *kept]),
            )
        )

    def launch(self) -> None:
        """Launch the kernels for all rows; nothing waits for the device."""
        self._detect.launch()
        self._follow.launch()

    def of(
        self,
        envs: np.ndarray,
        samples: ContactSamples,
        rows: np.ndarray,
        poses: np.ndarray | None,
        shear: tuple[np.ndarray, np.ndarray] | None,
    ) -> np.ndarray:
        """Table (n, K, 12) of the contacts of n environments on the CPU, with room for all.

        Args:
            envs: names (n,), each once.
            samples: of which ``rows`` (n,) are theirs.
            poses: ``pad_from_object`` (n, 4, 4); None where it is not known.
            shear: centres (n, 3) and stretches (n, 3) of the gel, as of ``contact_kernels.follow``; None where they are not known.
        """
        count, (r0, r1, c0, c1) = len(envs), samples.box
        own = self._host
        own["envs"][:count], own["window"][:count] = envs, (c0, c1, r0, r1)
        box = np.s_[:, r0:r1, c0:c1]
        own["depth"][:count][box] = np.where(samples.contact[rows][box], samples.depth[rows][box], np.float32(-1.0))
        own["pose"][:count] = np.nan if poses is None else poses
        own["centre"][:count], own["stretch"][:count] = (0.0, 0.0) if shear is None else shear
        with LAUNCH:
            for kernel in (self._detect, self._follow):
                kernel.set_dim(count)
            self._detect.launch()
            if (most := int(own["most"][0])) > self.room:
                self._make_room(1 << (most - 1).bit_length())
                return self.of(envs, samples, rows, poses, shear)
            self._follow.launch()
        table = self.table.numpy()[:count]
        return table[:, : max(int(table[..., 0].sum(axis=1).max(initial=1.0)), 1)].copy()

    def forget(self, envs: Sequence[int]) -> None:
        """Forget the history of environments, on the CPU."""
        mask = np.zeros(self._num_envs, bool)
        mask[envs] = True
        self.reset(wp.array(mask, dtype=wp.bool, device=self.device))

    def reset(self, mask: wp.array) -> None:
        """Forget the history of the environments of a mask (B,), bool, on the device."""
        wp.launch(forget, dim=self._num_envs, inputs=[mask, self._before, self._pose_before], device=self.device)

    def check(self) -> None:
        """Wait for the device. Raises ``InputError`` if a pad had more contacts than memory."""
        most = int(self._most.numpy()[0])
        if most > self.room:
            self._most.zero_()
            raise InputError("patches", value=self.room, rule=f"must be {most} or more: contacts of a pad were lost")

    def _zeros(self, *shape: int, dtype: Any) -> wp.array:
        return wp.zeros((self._num_envs, *shape), dtype=dtype, device=self.device)
