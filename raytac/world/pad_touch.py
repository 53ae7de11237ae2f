"""``PadTouch``: surface and markers of one pad in all environments, without the host."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import warp as wp

from raytac.gel.surface import PadGrid
from raytac.markers.base import MarkersConfig
from raytac.markers.device_fots import DeviceFots
from raytac.physics.rigid.gel_contact import GelContact
from raytac.physics.rigid.pressed_gel import PressedGel
from raytac.shapes.part import Part
from raytac.specs.sensor import SensorSpec
from raytac.world.start_kernels import lose_marked


class PadTouch:
    """Heights and markers of ``PadSurfaces`` and ``MarkerTracker``, on the CPU or on CUDA.

    Attributes:
        gel: of the pad.
        height, contact: as of ``ElasticSurround``.
        fots: markers; None without.
    """

    def __init__(
        self,
        spec: SensorSpec,
        grid: PadGrid,
        bodies: Sequence[Sequence[Part]],
        markers: MarkersConfig | None,
        *,
        gels: Sequence[tuple[Sequence[Part], float]] = (),
        pad: int,
        num_envs: int,
        patches: int = 16,
        device: str = "cpu",
    ) -> None:
        """Make the arrays.

        Args:
            spec: of the sensor; ``grid``: nodes of its pad.
            bodies: parts of every body, body frame.
            gels: other gels that press this one, as of ``PressedGel``.
            pad: index among the pads of the world.
            patches: most separate contacts of the pad, for its markers.

        Raises ``InputError`` as ``DeviceFots``.
        """
        self._pad, self._bodies, self._poses = pad, len(bodies), len(bodies) + len(gels)
        self.gel = PressedGel(grid, spec.gelpad.thickness, bodies, gels=gels, num_envs=num_envs, device=device)
        self.fots = (
            None if markers is None else DeviceFots(spec, markers, grid, num_envs=num_envs, patches=patches, device=device)
        )
        self.height, self.contact = self.gel.surround.height, self.gel.surround.contact

    def launch(self, contact: GelContact, active: wp.array) -> None:
        """Launch the kernels for the poses of ``contact.motion``.

        ``active`` (B,), bool: environments that have not broken down; one whose gel would lie below its bonded face is no longer.
        """
        gel, poses = self.gel, contact.motion.pose
        wp.copy(gel.poses, poses[:, self._pad, : self._poses])
        wp.copy(gel.sound, active)
        gel.launch()
        wp.launch(lose_marked, dim=len(active), inputs=[gel.surround.lost, active], device=gel.device)
        if self.fots is not None:
            depth: Any = gel.depth[:, : self._bodies]
            self.fots.launch(self.height, self.contact, poses, self._pad, depth, active, contact.shear.struct)

    def reset(self, mask: wp.array) -> None:
        """Forget the past of the pads of a mask (B,), bool, on the device."""
        if self.fots is not None:
            self.fots.reset(mask)

    def check(self) -> None:
        """Wait for the device. Raises ``InputError`` if contacts were lost for want of memory."""
        if self.fots is not None:
            self.fots.check()
