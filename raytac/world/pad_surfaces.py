"""Surfaces of rigid pads among bodies: the underside of what is near, and the elastic surround."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from raytac.gel.pierced import without_pierced
from raytac.gel.pyramid import ElasticSurround
from raytac.gel.surface import GelSurface, PadGrid
from raytac.gel.traction import foundation_traction
from raytac.physics.base import PadReading
from raytac.physics.rigid.shear import ContactShear
from raytac.shapes.part import Part
from raytac.shapes.underside import object_height, object_radius
from raytac.specs.sensor import GelpadSpec
from raytac.world.forbidden_overlap import BondedFace
from raytac.world.near_pads import half_spaces, near_pad


class PadSurfaces:
    """Surfaces of all pads of B environments, and the body that each showed deepest last."""

    def __init__(self, gelpads: Mapping[str, GelpadSpec], bodies: Sequence[Sequence[Part]], num_envs: int) -> None:
        """``gelpads`` by the name of the sensor, ``bodies`` as the parts of each in its frame."""
        self._gelpads, self._bodies = dict(gelpads), tuple(bodies)
        self._faces = {name: BondedFace(gelpad) for name, gelpad in gelpads.items()}
        self._radius = np.array([object_radius(parts) for parts in bodies])
        self._planes = half_spaces(bodies)
        self._pressed = {name: np.full(num_envs, -1) for name in gelpads}
        """−1: none."""
        self._shown: dict[str, tuple[PadGrid, ElasticSurround, float]] = {}

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
        press: Callable[[np.ndarray], object] | None = None,
        shear: Callable[[np.ndarray], ContactShear] | None = None,
    ) -> PadReading:
        """Reading of one pad in n environments on the nodes of ``grid``.

        Args:
            name: the sensor.
            grid: nodes of the surface.
            pad_from_body: poses (n, bodies, 4, 4).
            wrench: forces of all that touches (n, 6), as in a ``PadReading``.
            failed: environments that have failed already, (n,).
            rows: what the environments are called, (n,).
            press: lowers heights (n, Ny, Nx) to what else presses, in place; None is nothing.
            shear: shear of the gel under the bodies (n,) that it shows deepest; None is not known.
        """
        if name not in self._shown or self._shown[name][0] is not grid:
            self._shown[name] = grid, ElasticSurround(grid), float(grid.rest.max())
        count, gelpad, face = len(pad_from_body), self._gelpads[name], self._faces[name]
        height = np.full((count, *grid.shape), np.inf)
        poses = np.full((count, 4, 4), np.nan)
        deepest, pressed = np.zeros(count), np.full(count, -1)
        highest = self._shown[name][2]
        near = near_pad(gelpad, self._radius, self._planes, pad_from_body) & ~failed[:, None]
        for i in np.flatnonzero(near.any(axis=0)).tolist():
            rows_near = np.flatnonzero(near[:, i])
            under = object_height(self._bodies[i], pad_from_body[rows_near, i], grid.x, grid.y, below=highest)
            behind = under < -gelpad.thickness
            if behind.any():
                deep = np.flatnonzero(behind.any(axis=(1, 2)))
                deep = deep[face.pierced(self._bodies[i], pad_from_body[rows_near[deep], i], float(self._radius[i]))]
                under[behind] = np.inf
                under[deep] = np.nan
            depth = (grid.rest - under).max(axis=(1, 2))
            deeper = depth > deepest[rows_near]
            at = rows_near[deeper]
            deepest[at], pressed[at], poses[at] = depth[deeper], i, pad_from_body[at, i]
            if len(rows_near) == count:
                height = np.minimum(height, under, out=under)
            else:
                height[rows_near] = np.minimum(height[rows_near], under)
        if press is not None:
            press(height)
        height[failed] = np.nan
        # From one body to another is no motion of either.
        before = self._pressed[name][rows]
        poses[(pressed != before) & (before >= 0) & ~failed] = np.nan
        self._pressed[name][rows] = np.where(failed, before, pressed)
        surface = without_pierced(self._shown[name][1].surface(height, poses), gelpad)
        failed = np.isnan(surface.height[:, 0, 0])
        wrench = np.where(failed[:, None], np.nan, wrench)
        sheared = None if shear is None else ContactShear.where(failed, shear(pressed))
        return PadReading(surface, wrench, failed, lambda surface: _traction(surface, wrench), shear=sheared)


def _traction(surface: GelSurface, wrench: np.ndarray) -> np.ndarray:
    """Total forces of the pads distributed over their contacts (see ``foundation_traction``)."""
    x, y = np.nan_to_num(surface.contact_centre).T
    twist = wrench[:, 5] - (x * wrench[:, 1] - y * wrench[:, 0])
    return foundation_traction(surface, wrench[:, :3], twist)
