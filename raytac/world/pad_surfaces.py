"""Surfaces of rigid pads among bodies: undersides and the elastic surround."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from raytac.gel.contact_shear import ContactShear
from raytac.gel.pierced import without_pierced
from raytac.gel.pyramid import ElasticSurround
from raytac.gel.surface import GelSurface, PadGrid
from raytac.gel.traction import foundation_traction
from raytac.physics.base import PadReading
from raytac.physics.rigid.pierced import BondedFaces
from raytac.physics.rigid.underside import Undersides
from raytac.shapes.part import Part
from raytac.specs.sensor import GelpadSpec


@dataclass(frozen=True)
class _Shown:
    """Grid, elastic surround and search of one sensor."""

    grid: PadGrid
    surround: ElasticSurround
    undersides: Undersides


class PadSurfaces:
    """Surfaces of all pads of B environments, and the body that each showed deepest last."""

    def __init__(self, gelpads: Mapping[str, GelpadSpec], bodies: Sequence[Sequence[Part]], num_envs: int) -> None:
        """``gelpads`` by the name of the sensor, ``bodies`` as the parts of each in its frame."""
        self._gelpads, self._bodies = dict(gelpads), tuple(bodies)
        self._faces: dict[str, BondedFaces] = {}
        self._pressed = {name: np.full(num_envs, -1) for name in gelpads}
        """−1: none."""
        self._shown: dict[str, _Shown] = {}

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
            pad_from_body: poses (n, bodies, 4, 4).
            wrench: forces of all that touches (n, 6), as in a ``PadReading``.
            failed: environments that have failed already, (n,).
            rows: what the environments are called, (n,).
            press: lowers heights (n, Ny, Nx) to what else presses, in place; None is nothing.
            shear: shear of the gel under the bodies (n,) that it shows deepest; None is not known.
        """
        if name not in self._shown or self._shown[name].grid is not grid:
            num_envs = len(self._pressed[name])
            undersides = Undersides(grid, self._gelpads[name].thickness, self._bodies, num_envs=num_envs)
            self._shown[name] = _Shown(grid, ElasticSurround(grid), undersides)
        shown, count, gelpad = self._shown[name], len(pad_from_body), self._gelpads[name]
        under = shown.undersides.of(pad_from_body, ~failed)
        height, depth = under.height, under.depth
        behind = np.flatnonzero(under.behind.any(axis=1))
        if len(behind):
            if name not in self._faces:
                self._faces[name] = BondedFaces.on_cpu([self._gelpads[name]], self._bodies)
            pierced = self._faces[name].pierced(pad_from_body[behind, None])[:, 0] & under.behind[behind]
            for k, i in np.argwhere(pierced).tolist():
                height[behind[k]], depth[behind[k], i] = np.nan, -np.inf
        poses, pressed = np.full((count, 4, 4), np.nan), np.full(count, -1)
        if self._bodies:
            deepest = depth.argmax(axis=1)
            at = np.flatnonzero(depth[np.arange(count), deepest] > 0.0)
            pressed[at] = deepest[at]
            poses[at] = pad_from_body[at, pressed[at]]
        if press is not None:
            press(height)
        height[failed] = np.nan
        # From one body to another is no motion of either.
        before = self._pressed[name][rows]
        poses[(pressed != before) & (before >= 0) & ~failed] = np.nan
        self._pressed[name][rows] = np.where(failed, before, pressed)
        surface = without_pierced(shown.surround.surface(height, poses), gelpad)
        failed = np.isnan(surface.height[:, 0, 0])
        wrench = np.where(failed[:, None], np.nan, wrench)
        sheared = None if shear is None else ContactShear.where(failed, shear(pressed))
        return PadReading(surface, wrench, failed, lambda surface: _traction(surface, wrench), shear=sheared)


def _traction(surface: GelSurface, wrench: np.ndarray) -> np.ndarray:
    """Total forces of the pads distributed over their contacts (see ``foundation_traction``)."""
    x, y = np.nan_to_num(surface.contact_centre).T
    twist = wrench[:, 5] - (x * wrench[:, 1] - y * wrench[:, 0])
    return foundation_traction(surface, wrench[:, :3], twist)
