"""``PadTouch``: surface and markers of one pad in all environments, without the host."""

from __future__ import annotations

from collections.abc import Sequence

import warp as wp

from raytac.gel.device_surround import DeviceSurround
from raytac.gel.surface import PadGrid
from raytac.markers.base import MarkersConfig
from raytac.markers.device_fots import DeviceFots
from raytac.physics.rigid.gel_contact import GelContact
from raytac.physics.rigid.underside import Undersides
from raytac.shapes.part import Part
from raytac.specs.sensor import SensorSpec
from raytac.world.start_kernels import copy_mask, lose_marked


class PadTouch:
    """Heights and markers of ``PadSurfaces`` and ``MarkerTracker``, on the CPU or on CUDA.

    Another gel that presses is not shown.

    Attributes:
        height, contact: as of ``DeviceSurround``.
        fots: markers; None without.
    """

    def __init__(
        self,
        spec: SensorSpec,
        grid: PadGrid,
        bodies: Sequence[Sequence[Part]],
        markers: MarkersConfig | None,
        *,
        pad: int,
        num_envs: int,
        patches: int = 8,
        device: str = "cpu",
    ) -> None:
        """Make the arrays.

        Args:
            spec: of the sensor; ``grid``: nodes of its pad.
            bodies: parts of every body, body frame.
            pad: index among the pads of the world.
            patches: most separate contacts of the pad, for its markers.

        Raises ``InputError`` as ``DeviceFots``.
        """
        thickness = spec.gelpad.thickness
        self._pad, self._bodies = pad, len(bodies)
        self._undersides = Undersides(grid, thickness, bodies, num_envs=num_envs, device=device)
        self._surround = DeviceSurround(grid, thickness, num_envs=num_envs, device=device)
        self.fots = (
            None if markers is None else DeviceFots(spec, markers, grid, num_envs=num_envs, patches=patches, device=device)
        )
        self.height, self.contact = self._surround.height, self._surround.contact

    def launch(self, contact: GelContact, active: wp.array) -> None:
        """Launch the kernels for the poses of ``contact.motion``.

        ``active`` (B,), bool: environments that have not broken down; one whose gel would lie below its bonded face is no longer.
        """
        under, poses = self._undersides, contact.motion.pose
        wp.copy(under.poses, poses[:, self._pad, : self._bodies])
        wp.launch(copy_mask, dim=len(active), inputs=[active, under.sound], device=under.device)
        under.launch()
        self._surround.launch(under.height, under.deepest, active)
        wp.launch(lose_marked, dim=len(active), inputs=[self._surround.pierced, active], device=under.device)
        if self.fots is not None:
            self.fots.launch(self.height, self.contact, poses, self._pad, under.deepest, active, contact.shear.struct)

    def reset(self, mask: wp.array) -> None:
        """Forget the past of the pads of a mask (B,), bool, on the device."""
        if self.fots is not None:
            self.fots.reset(mask)

    def check(self) -> None:
        """Wait for the device. Raises ``InputError`` if contacts were lost for want of memory."""
        if self.fots is not None:
            self.fots.check()
