"""FOTS markers of many pads without the host: contacts, history, displacements."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from raytac.errors import InputError
from raytac.gel.surface import PadGrid
from raytac.markers import contact_kernels, fots_kernels
from raytac.markers.base import MarkersConfig, marker_motion_of
from raytac.markers.config import Fots
from raytac.markers.contacts import ContactCells
from raytac.markers.pattern import MarkerPattern
from raytac.specs.sensor import SensorSpec
from raytac.warp_runtime import start_warp

_COLUMNS = 10
"""Of ``Contacts.table`` that the displacements need."""
_NAN = wp.mat44d(*[np.nan] * 16)


class DeviceFots:
    """Displacements of markers by ``Fots`` or ``FotsPublished``, of B pads.

    Attributes:
        displacement: along x and y [m], (B, M), vectors of float32; 0 of an untouched pad.
    """

    def __init__(
        self, sensor: SensorSpec, config: MarkersConfig, grid: PadGrid, *, num_envs: int, patches: int = 8, device: str = "cpu"
    ) -> None:
        """Make the arrays.

        Args:
            sensor: with markers and their motion.
            config: of the model.
            grid: nodes of the surfaces.
            num_envs: number of pads B.
            patches: most separate contacts of a pad.
            device: "cpu" or "cuda".

        Raises:
            InputError: another model, a perturbation, or a sensor without markers or their motion.
        """
        if not isinstance(config, Fots):
            raise InputError(
                "markers", value=type(config).__name__, rule="must be FOTS on the device", choices=("fots", "fots_published")
            )
        if config.perturbation is not None:
            raise InputError("perturbation", value=config.perturbation, rule="must be None on the device")
        start_warp()
        motion, cells, self.device = marker_motion_of(sensor), ContactCells.over(grid, config.contacts), wp.get_device(device)
        rest, slip = MarkerPattern.of(sensor).rest[0], config.slip(sensor)
        pad: Any = contact_kernels.Pad()
        pad.first, pad.pitch = wp.vec2d(cells.x[0], cells.y[0]), wp.vec2d(*cells.pitch)
        pad.nodes = wp.vec2i(*cells.nodes)
        pad.node_first, pad.node_pitch = wp.vec2d(*grid.origin), wp.vec2d(*grid.pitch)
        pad.rest = wp.array(grid.rest, dtype=wp.float64, device=self.device)
        pad.reach, pad.slip = config.contacts.reach, -1.0 if slip is None else slip
        pad.follows_shear = int(config.follows_shear)
        self._pad = pad
        size: Any = fots_kernels.Cells()
        size.origin, size.pitch = wp.vec2f(cells.x[0], cells.y[0]), wp.vec2f(*cells.pitch)
        self._cells, self._constants, self._room = size, _constants(motion, config), patches

        def zeros(*shape: int, dtype: Any) -> wp.array:
            return wp.zeros((num_envs, *shape), dtype=dtype, device=self.device)

        self._xy = wp.array(rest[:, :2], dtype=wp.vec2f, device=self.device)
        self._depth = zeros(len(cells.y), len(cells.x), dtype=wp.float32)
        self._parent, self._box = zeros(len(cells.y) * len(cells.x), dtype=wp.int32), zeros(dtype=wp.vec4i)
        self._moments = zeros(patches, dtype=contact_kernels.Moments)
        self._contacts, self._before = (zeros(patches, dtype=contact_kernels.Contact) for _ in range(2))
        self._pose, self._pressed = zeros(dtype=wp.mat44d), zeros(dtype=wp.int32)
        self._pose.fill_(_NAN)
        self._pressed.fill_(-1)
        self._table, self._drags = zeros(patches, _COLUMNS, dtype=wp.float32), zeros(patches, dtype=fots_kernels.Drag)
        self._most = wp.zeros(1, dtype=wp.int32, device=self.device)
        self.displacement = zeros(len(rest), dtype=wp.vec2f)

    def launch(
        self, height: wp.array, contact: wp.array, poses: wp.array, pad: int, depths: wp.array, sound: wp.array, shear: Any
    ) -> None:
        """Launch the kernels, once for every surface of the motion; nothing waits for the device.

        Args:
            height, contact: as of ``DeviceSurround``.
            poses: ``pad_from_body`` (B, pads, bodies + …); ``pad``: index of this one.
            depths: overlap of each body with the pad (B, bodies) [m]; the deepest is the object.
            sound: environments that have not broken down, (B,), bool; of the others it is kept which body was the object.
            shear: of the gels, the structure of a ``ShearState``.
        """
        pool = [height, contact, self._pad, self._depth]
        self._launch(contact_kernels.pool, self._depth.shape, pool)
        detect = [self._depth, self._pad, self._parent, self._moments, self._box, self._contacts, self._most]
        self._launch(contact_kernels.detect, len(self._box), detect)
        state = [self._before, self._pose, self._pressed, self._table]
        follow = [poses, pad, depths, sound, shear, self._pad, self._contacts, *state]
        self._launch(contact_kernels.follow, len(self._box), follow)
        self._launch(fots_kernels.limit, self._drags.shape, [self._table, self._constants, self._drags])
        inputs = [self._xy, self._drags, self._box, self._depth, self._cells, self._constants, self.displacement]
        self._launch(fots_kernels.displace, self.displacement.shape, inputs)

    def reset(self, mask: wp.array) -> None:
        """Forget the history of the environments of a mask (B,), bool, on the device."""
        self._launch(contact_kernels.forget, len(self._box), [mask, self._before, self._pose, self._pressed])

    def check(self) -> None:
        """Wait for the device. Raises ``InputError`` if a pad had more contacts than memory."""
        most = int(self._most.numpy()[0])
        if most > self._room:
            self._most.zero_()
            raise InputError("patches", value=self._room, rule=f"must be {most} or more: contacts of a pad were lost")

    def _launch(self, kernel: Any, dim: Any, inputs: list[Any]) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, device=self.device)


def _constants(motion: Any, config: Fots) -> Any:
    result: Any = fots_kernels.Constants()
    for name in ("dilate_gain", "dilate_lambda", "shear_lambda", "shear_max", "twist_lambda", "twist_max"):
        setattr(result, name, getattr(motion, name))
    punch = motion.punch if config.takes_punch else None
    result.is_punch = int(punch is not None)
    for name in ("anisotropy", "reach", "slip") if punch else ():
        setattr(result, name, getattr(punch, name))
    return result
