"""Surfaces of rigid pads among bodies, for the host."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from raytac.gel.contact_shear import ContactShear
from raytac.gel.surface import GelSurface, PadGrid
from raytac.gel.traction import foundation_traction
from raytac.physics.base import PadReading
from raytac.physics.rigid.pierced import BondedFaces
from raytac.physics.rigid.pressed_gel import PressedGel
from raytac.shapes.part import Part
from raytac.specs.sensor import GelpadSpec


class PadSurfaces:
    """Surfaces of all pads of B environments, and the body that each showed deepest last."""

    def __init__(
        self,
        gelpads: Mapping[str, GelpadSpec],
        bodies: Sequence[Sequence[Part]],
        num_envs: int,
        gels: Mapping[str, Sequence[tuple[Sequence[Part], float]]] | None = None,
    ) -> None:
        """Make no arrays yet.

        Args:
            gelpads: by the name of the sensor.
            bodies: parts of each, body frame.
            gels: other gels that press each sensor's, as of ``PressedGel``.
        """
        self._gelpads, self._bodies, self._gels = dict(gelpads), tuple(bodies), dict(gels or {})
        self._faces: dict[str, BondedFaces] = {}
        self._pressed = {name: np.full(num_envs, -1) for name in gelpads}
        """−1: none."""
        self._shown: dict[str, tuple[PadGrid, int, PressedGel]] = {}
        """Grid, most environments and gel of a sensor."""

    def reset(self, envs: Sequence[int] | np.ndarray) -> None:
        """Forget what environments showed."""
        for pressed in self._pressed.values():
            pressed[np.asarray(envs, int)] = -1

    def reading(
        self,
        name: str,
        grid: PadGrid,
        pad_from_body: np.ndarray,
        wrench: np.ndarray,
        failed: np.ndarray,
        rows: np.ndarray,
        *,
        shear: Callable[[np.ndarray], ContactShear] | None = None,
    ) -> PadReading:
        """Reading of one pad in n environments on the nodes of ``grid``.

        Args:
            pad_from_body: poses (n, bodies + gels, 4, 4).
            wrench: forces of all that touches (n, 6), as in a ``PadReading``.
            failed: environments that have failed already, (n,).
            rows: what the environments are called, (n,).
            shear: shear of the gel under the bodies (n,) that it shows deepest; None is not known.
        """
        count, bodies = len(pad_from_body), len(self._bodies)
        shown = self._gel(name, grid, count).of(pad_from_body, ~failed)
        lost, depth = shown.lost | failed, shown.depth[:, :bodies]
        if shown.behind.any():
            behind = np.flatnonzero(shown.behind.any(axis=1))
            pierced = self._face(name).pierced(pad_from_body[behind, None, :bodies])[:, 0] & shown.behind[behind, :bodies]
            depth[behind] = np.where(pierced, -np.inf, depth[behind])
            lost[behind] |= pierced.any(axis=1)
        pressed, poses = np.full(count, -1), np.full((count, 4, 4), np.nan)
        before = self._pressed[name][rows]
        if bodies:
            pressed = np.where(depth.max(axis=1) > 0.0, depth.argmax(axis=1), -1)
            # From one body to another is no motion of either.
            known = (pressed >= 0) & ((pressed == before) | (before < 0))
            poses[known] = pad_from_body[known, pressed[known]]
        self._pressed[name][rows] = np.where(failed, before, pressed)
        height, contact, centre = shown.height, shown.contact, shown.centre
        if lost.any():
            height[lost], contact[lost], centre[lost] = np.nan, False, np.nan
            wrench = np.where(lost[:, None], np.nan, wrench)
        sheared = None if shear is None else ContactShear.where(lost, shear(pressed))
        surface = GelSurface(grid, height, contact, centre, poses)
        force, torque = wrench[:, :3], wrench[:, 5]
        return PadReading(
            surface,
            wrench,
            lost,
            lambda surface: foundation_traction(surface, force, torque, about_origin=True),
            shear=sheared,
        )

    def _gel(self, name: str, grid: PadGrid, count: int) -> PressedGel:
        """Gel of a sensor with memory for ``count`` environments."""
        known = self._shown.get(name)
        if known is None or known[0] is not grid or known[1] < count:
            most, thickness = max(count, len(self._pressed[name])), self._gelpads[name].thickness
            gel = PressedGel(grid, thickness, self._bodies, gels=self._gels.get(name, ()), num_envs=most)
            known = self._shown[name] = grid, most, gel
        return known[2]

    def _face(self, name: str) -> BondedFaces:
        if name not in self._faces:
            self._faces[name] = BondedFaces.on_cpu([self._gelpads[name]], self._bodies)
        return self._faces[name]
