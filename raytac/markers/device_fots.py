"""FOTS markers of many pads without the host: contacts, history, displacements."""

from __future__ import annotations

from typing import Any

import warp as wp

from raytac.errors import InputError
from raytac.gel.surface import PadGrid
from raytac.markers.base import MarkersConfig
from raytac.markers.config import Fots
from raytac.markers.contact_history import ContactHistory
from raytac.markers.contact_kernels import choose_object, forget_object, pool
from raytac.markers.contacts import ContactCells
from raytac.markers.fots import constants_of
from raytac.markers.fots_kernels import Cells, Drag, displace, limit
from raytac.markers.pattern import MarkerPattern
from raytac.specs.sensor import SensorSpec
from raytac.warp_runtime import start_warp


class DeviceFots:
    """Displacements of markers by ``Fots`` or ``FotsPublished``, of B pads.

    Attributes:
        contacts: of the pads, with their history.
        displacement: along x and y [m], (B, M), vectors of float32; 0 of an untouched pad.
    """

    def __init__(
        self, sensor: SensorSpec, config: MarkersConfig, grid: PadGrid, *, num_envs: int, patches: int = 16, device: str = "cpu"
    ) -> None:
        """Make the arrays.

        Args:
            sensor: with markers and their motion.
            patches: most separate contacts of a pad.

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
        cells, rest = ContactCells.over(grid, config.contacts), MarkerPattern.of(sensor).rest[0]
        self.contacts = ContactHistory(
            cells,
            config.contacts.reach,
            config.slip(sensor),
            num_envs=num_envs,
            room=patches,
            follows_shear=config.follows_shear,
            device=device,
        )
        self.device = self.contacts.device
        size: Any = Cells()
        size.origin, size.pitch = wp.vec2f(cells.x[0], cells.y[0]), wp.vec2f(*cells.pitch)
        self._cells, self._constants = size, constants_of(config.motion(sensor))
        drag: Any = Drag
        self._xy = wp.array(rest[:, :2], dtype=wp.vec2f, device=self.device)
        self._pressed = wp.full(num_envs, value=-1, dtype=wp.int32, device=self.device)
        self._drags = wp.zeros((num_envs, patches), dtype=drag, device=self.device)
        self.displacement = wp.zeros((num_envs, len(rest)), dtype=wp.vec2f, device=self.device)

    def launch(
        self, height: wp.array, contact: wp.array, poses: wp.array, pad: int, depths: wp.array, sound: wp.array, shear: Any
    ) -> None:
        """Launch the kernels, once for every surface of the motion; nothing waits for the device.

        Args:
            height, contact: as of ``ElasticSurround``.
            poses: ``pad_from_body`` (B, pads, bodies + …); ``pad``: index of this one.
            depths: overlap of each body with the pad (B, bodies) [m]; the deepest is the object.
            sound: environments that have not broken down, (B,), bool; of the others it is kept which body was the object.
            shear: of the gels, the structure of a ``ShearState``.
        """
        own = self.contacts
        self._launch(pool, own.depth.shape, [height, contact, own.pad, own.depth])
        chosen = [self._pressed, own.pose, own.centre, own.stretch]
        self._launch(choose_object, len(self._pressed), [poses, pad, depths, sound, shear, *chosen])
        own.launch()
        self._launch(limit, self._drags.shape, [own.table, self._constants, self._drags])
        inputs = [self._xy, self._drags, own.box, own.depth, self._cells, self._constants, self.displacement]
        self._launch(displace, self.displacement.shape, inputs)

    def reset(self, mask: wp.array) -> None:
        """Forget the history of the environments of a mask (B,), bool, on the device."""
        self.contacts.reset(mask)
        self._launch(forget_object, len(self._pressed), [mask, self._pressed])

    def check(self) -> None:
        """Wait for the device. Raises ``InputError`` if a pad had more contacts than memory."""
        self.contacts.check()

    def _launch(self, kernel: Any, dim: Any, inputs: list[Any]) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, device=self.device)
