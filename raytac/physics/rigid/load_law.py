"""Force against depth for any indenter on the bonded gel layer; MuJoCo's contact obeys it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from raytac.errors import InputError
from raytac.gel.surface import PadGrid, rest_height
from raytac.physics.rigid.layer_response import layer_response, reduced_modulus
from raytac.physics.rigid.regions import region_lines
from raytac.shapes.part import Part
from raytac.shapes.underside import object_bounds, object_height
from raytac.specs.sensor import GelpadSpec

_TABLE = 512
_DEPTHS = np.linspace(0.0, 1.0, _TABLE) ** 2
"""Depths of the table over the pad's thickness."""
SMOOTH = 0.15
"""Share of a depth, up and down, over which the growth of the force gives the radius."""


HARD_FROM, HARD_RISE = 0.2, 20.0
"""Share of the gel's thickness below which its back is felt, and how fast.

A choice, no measurement. With 20 a press at a tenth of the thickness takes 21 times the force of the layer."""


def hard_back(depth: np.ndarray, limit: np.ndarray | float, thickness: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
    """Factor of the load law near the bonded face, and its derivative by depth [1/m].

    φ = 1 + 20 (0.2 / x − 1)² with x the share of the thickness that is left under the object's lowest point: 1 down to x = 0.2, without
    bound as x goes to 0, and once continuously differentiable. So is the work that it takes without bound, and nothing goes through.

    Args:
        depth: [m].
        limit: depth [m] at which the object's lowest point would be at the bonded face.
        thickness: of the gel [m].
    """
    left = np.maximum((np.asarray(limit) - depth) / thickness, 1e-6)
    above = np.maximum(HARD_FROM / left - 1.0, 0.0)
    return 1.0 + HARD_RISE * above**2, 2.0 * HARD_RISE * above * HARD_FROM / (left**2 * thickness)


def shear_stiffness(radius: np.ndarray, gelpad: GelpadSpec) -> np.ndarray:
    """Tangential force per displacement [N/m] of contacts of ``radius`` [m].

    8Ga/(2 − ν) of a half-space (Mindlin) plus GA/h of a sheared layer.
    """
    shear = shear_modulus(gelpad)
    return 8.0 * shear * radius / (2.0 - gelpad.poisson_ratio) + shear * np.pi * radius**2 / gelpad.thickness


TWIST_STIFFENING = 0.0957, 0.325, 0.28, 0.4
"""Constants of ``twist_stiffening``: by expansion, then to have 3π/32 x at large x."""


def twist_stiffening(ratio: np.ndarray) -> np.ndarray:
    """Twist stiffness of a bonded layer over a half-space's, by contact radius over thickness.

    A torsion dies out within a radius, so that a base hardly shows before it is that near: 1 + (2/3π) ∫ κ² (1 − tanh κ) dκ x³ for small
    x, and (3π/32) x for large ones, where the torque per angle is GJ/h. Between both a fraction, fitted to the integral equation of a
    disc that sticks to a layer (as of E. Reissner and H. F. Sagoci, J. Appl. Phys. 15, 1944, with the compliance tanh(kh)/(Gk)).
    """
    first, second, third, fourth = TWIST_STIFFENING
    return 1.0 + first * ratio**3 / (1.0 + ratio**2 * (second + third / (1.0 + fourth * ratio)))


def twist_stiffness(radius: np.ndarray, gelpad: GelpadSpec) -> np.ndarray:
    """Torque per angle [N m/rad] of a disc that sticks: 16Ga³/3 times ``twist_stiffening``."""
    return 16.0 / 3.0 * shear_modulus(gelpad) * radius**3 * twist_stiffening(radius / gelpad.thickness)


def shear_modulus(gelpad: GelpadSpec) -> float:
    return 0.5 * gelpad.youngs_modulus / (1.0 + gelpad.poisson_ratio)


class LoadLaw:
    """Normal force, contact radius and tangential stiffness against depth.

    They follow from the gap between object and resting gel.

    A contact that covers a region Ω of the gel has, at a depth δ, the force k(Ω) (δ − ⟨gap⟩): k the stiffness of the flat punch Ω, ⟨gap⟩
    the mean of the gap at first touch under that punch's pressure (Betti's theorem). The true Ω is that of the greatest force (Barber,
    J. Elasticity 4, 1974, 171), so a region that is a little off gives nearly the same. Here Ω is sought among the regions where the gap
    is below a level.

    Its stiffness follows from its area, its perimeter and its second moments (``regions``), for a punch in one piece or in many. The
    pressure over its mean is 1 + (12 m − 6)(ρ² − 1/2) + n P₂(x): m and n are ``moment`` and ``bend`` of ``LayerResponse``, ρ² is 1/2 in
    the mean and grows as the square of the distance from the region's centroid, over that of the ellipse of its moments, and x is the
    area of smaller gaps over the region's. On a round contact x is ρ². Under a face that tilts it is not, and ρ keeps its middle in
    place. In pieces, x takes the part of ρ² as far as the gap is neither a tilt nor a bowl over all of them: then each piece has its rim.

    So the law is that of the layer for flat punches, level or tilted, for paraboloids and for cones, and close to it for contacts of
    other shapes and in pieces. Near the bonded face the law grows without bound (``hard_back``). F is strictly increasing in δ and 0 at
    δ <= 0.
    """

    def __init__(
        self,
        gap: np.ndarray,
        x: np.ndarray,
        y: np.ndarray,
        gelpad: GelpadSpec,
        deepest: float = np.inf,
        cells: np.ndarray | None = None,
    ) -> None:
        """Law from the gap between the resting gel and the object at first touch.

        Args:
            gap: (Ny, Nx) [m], along z, >= 0, ``inf`` where there is no object.
            x, y: evenly spaced places (Nx,) and (Ny,) in the pad frame [m].
            deepest: greatest depth that there is gel for [m], at most the pad's thickness.
            cells: cells for which each place stands, (Ny, Nx); None: one each, half of one on the pad's edges.
        """
        self._gelpad = gelpad
        self.deepest = min(deepest, gelpad.thickness)
        """Greatest depth that a press may have [m]."""
        self.depth = gelpad.thickness * _DEPTHS
        """Depths of the table [m], 0 to the pad's thickness, denser at the start."""
        stiffness, offset, area = region_lines(gap, x, y, gelpad, cells=cells)

        def contact(depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            forces = stiffness * depth[:, None] - offset
            region = forces.argmax(axis=1)
            return np.take_along_axis(forces, region[:, None], axis=1)[:, 0], area[region]

        self.table = contact(self.depth)[0]
        """Normal force of the table, without the hard back [N]."""
        step = np.maximum(SMOOTH * self.depth, 1e-12)
        (less, narrower), (more, wider) = contact(self.depth - step), contact(self.depth + step)
        self.radius = _punch_radius((more - less) / (2.0 * step), gelpad)
        """Radius [m] of the disc whose force grows as fast, over ``SMOOTH`` of the depth."""
        self.area = 0.5 * (narrower + wider)
        """Area of contact [m²], over ``SMOOTH`` of the depth."""

    @property
    def greatest(self) -> float:
        """Greatest force of a press [N]: with a twentieth of the thickness left.

        There the hard back takes 181 times the layer's force.
        """
        return self.force(self.deepest - 0.05 * self.thickness)

    def force(self, depth: float) -> float:
        """Normal force [N] at ``depth`` [m]; 0 out of contact."""
        factor, _ = hard_back(np.asarray(depth), self.deepest, self.thickness)
        return float(np.interp(depth, self.depth, self.table) * factor)

    def depth_at(self, force: float) -> float:
        """Depth [m] at which the law reaches ``force`` [N]; InputError beyond ``greatest``."""
        if force > self.greatest:
            rule = f"would press deeper than the pad is there: at most {self.greatest:.4g} N, {self.deepest * 1e3:.4g} mm deep"
            raise InputError("force", value=force, rule=rule)
        low, high = self.hard_from, self.deepest
        if force <= self.force(low):
            return float(np.interp(force, self.table, self.depth))
        for _ in range(60):
            middle = 0.5 * (low + high)
            low, high = (low, middle) if self.force(middle) > force else (middle, high)
        return 0.5 * (low + high)

    @property
    def hard_from(self) -> float:
        """Depth [m] from which the gel's hard back is felt; 0 where there is less gel than that."""
        return max(self.deepest - HARD_FROM * self.thickness, 0.0)

    def stiffest(self, force: float) -> float:
        """Greatest incremental stiffness [N/m], of the hard back only up to ``force`` [N]."""
        stiffest = float((np.diff(self.table) / np.diff(self.depth)).max())
        depth = self.depth_at(min(force, self.greatest))
        if depth <= self.hard_from:
            return stiffest
        return max(stiffest, (self.force(depth) - self.force(depth - 1e-7)) * 1e7)

    @property
    def thickness(self) -> float:
        return self._gelpad.thickness

    def secant_stiffness(self, depth: float) -> float:
        """F / δ [N/m]; at δ <= 0 that of the first entry of the table."""
        if depth <= self.depth[1]:
            return float(self.table[1] / self.depth[1])
        return self.force(depth) / depth

    def contact_radius(self, depth: float) -> float:
        """Radius [m] of the disc that is as stiff at ``depth`` [m]; 0 out of contact."""
        return float(np.interp(depth, self.depth, self.radius)) if depth > 0.0 else 0.0

    def contact_area(self, depth: float) -> float:
        """Area of contact [m²] at ``depth`` [m]; 0 out of contact."""
        return float(np.interp(depth, self.depth, self.area)) if depth > 0.0 else 0.0

    def shear_stiffness(self, depth: float) -> float:
        """Tangential force per displacement [N/m] at ``depth`` [m], see ``shear_stiffness``."""
        return float(shear_stiffness(np.asarray(self.contact_radius(depth)), self._gelpad))

    def twist_stiffness(self, depth: float) -> float:
        """Torque per angle [N m/rad] at ``depth`` [m], see ``twist_stiffness``."""
        return float(twist_stiffness(np.asarray(self.contact_radius(depth)), self._gelpad))


def _punch_radius(stiffness: np.ndarray, gelpad: GelpadSpec) -> np.ndarray:
    """Radius [m] of the flat punch of a stiffness [N/m]."""
    layer = layer_response(gelpad)
    return np.interp(stiffness, 2.0 * reduced_modulus(gelpad) * layer.radius * layer.stiffening, layer.radius)


_ZOOMS, _FINE = 4, 17


class FirstTouch(NamedTuple):
    """First contact of an object with the pad."""

    z: float
    """Height of the object's origin [m], pad frame."""
    gap: np.ndarray
    """Gap of ``gap_at_touch`` at that height, (Ny, Nx) [m]."""
    deepest: float
    """Travel [m] from there to the bonded face: the thickness, less on the dome's flanks."""
    lever: float
    """Height of the object's origin over the gel that it touches [m]."""


def first_touch(parts: Sequence[Part], pose: np.ndarray, gelpad: GelpadSpec, grid: PadGrid) -> FirstTouch:
    """First touch of an object that comes down along −z.

    ``pose`` (4, 4): rotation and x, y of the object in the pad frame; its z is ignored. The touch is at the node of ``grid`` with
    the least distance between object and gel, refined by zooming in on it (a factor 8, four times), so that the result does not
    depend on the pitch beyond features that fall between nodes; the lowest point is refined likewise. Raises ``InputError`` if no part is
    above the pad.
    """
    if not parts:
        raise InputError("parts", value=(), rule="an object without parts cannot touch")
    above = pose.copy()
    above[2, 3] = 0.0

    def underside(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return object_height(parts, above[None], x, y)[0]

    def gap(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return underside(x, y) - rest_height(gelpad, x[None, :], y[:, None])

    gaps = gap(grid.x, grid.y)
    least, x, y = _least(gap, gaps, grid)
    if not np.isfinite(least):
        low, high = object_bounds(parts, above)
        span = f"x {low[0]:.4g}…{high[0]:.4g}, y {low[1]:.4g}…{high[1]:.4g} m"
        rule = f"no part of the object, which spans {span}, is above a node of the pad"
        raise InputError("position", value=tuple(above[:2, 3].tolist()), rule=rule)
    lowest, _, _ = _least(underside, gaps + grid.rest, grid)
    lever = -least - float(rest_height(gelpad, np.array(x), np.array(y)))
    return FirstTouch(-least, np.maximum(gaps - least, 0.0), gelpad.thickness + lowest - least, lever)


def too_deep(depth: float, deepest: float) -> InputError:
    """Error for a ``depth`` past the bonded face, which is at ``deepest`` [m].

    Both are below the first touch at the start.
    """
    rule = f"would press deeper than the pad is there: at most {deepest * 1e3:.5g} mm"
    if deepest <= 0.0:
        rule = "would press deeper than the pad is there: so turned, the object is past the bonded face at any depth"
    return InputError("depth [mm]", value=float(f"{depth * 1e3:.6g}"), rule=rule)


def gap_at_touch(parts: Sequence[Part], pose: np.ndarray, grid: PadGrid) -> np.ndarray:
    """Gap [m] along z between resting gel and object, (Ny, Nx), at a first-touch pose; >= 0."""
    return np.maximum(object_height(parts, pose[None], grid.x, grid.y)[0] - grid.rest, 0.0)


def _least(of: Callable[[np.ndarray, np.ndarray], np.ndarray], values: np.ndarray, grid: PadGrid) -> tuple[float, float, float]:
    """Least value of a function over the pad, and its x, y [m].

    Zooms in on the lowest of its node ``values``.
    """
    x, y, least = grid.x, grid.y, (np.inf, 0.0, 0.0)
    for zoom in range(_ZOOMS + 1):
        if zoom:
            values = of(x, y)
        j, i = np.unravel_index(np.argmin(values), values.shape)
        least = min(least, (float(values[j, i]), float(x[i]), float(y[j])), key=lambda one: one[0])
        if not np.isfinite(least[0]):
            break
        x, y = _around(x, int(i), grid.x), _around(y, int(j), grid.y)
    return least


def _around(nodes: np.ndarray, index: int, pad: np.ndarray) -> np.ndarray:
    """Finer nodes over the two cells beside one node, kept on the pad."""
    step = nodes[1] - nodes[0]
    return np.linspace(max(nodes[index] - step, pad[0]), min(nodes[index] + step, pad[-1]), _FINE)
