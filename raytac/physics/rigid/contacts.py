"""Contacts of bodies with resting pads, a row for each env, pad and body; load-law tables."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from raytac.physics.rigid.load_law import hard_back

LAW_POINTS = 33
"""Entries M of a load law's table."""


@dataclass(frozen=True)
class PadContacts:
    """Bodies on or near resting pads: n rows by environment, pad and body; pad frame, SI."""

    env: np.ndarray
    """Environment, (n,)."""
    pad: np.ndarray
    """Pad, (n,)."""
    body: np.ndarray
    """Body, (n,)."""
    depth: np.ndarray
    """Greatest overlap δ of resting gel and body [m], (n,); negative is a gap."""
    centre: np.ndarray
    """Centroid of the overlap on the body's underside, or the least gap's place [m], (n, 3)."""
    normal: np.ndarray
    """Unit normal of the resting gel there, (n, 3)."""
    clearance: np.ndarray
    """Height of the body's lowest point over the bonded face [m], (n,); <= 0: through the gel."""
    spread: np.ndarray
    """Second moments of the overlap over its volume ∫ u dA [m], (n, 3); 0 of a gap.

    ∫ (x − c)² dA, ∫ (x − c)(y − d) dA and ∫ (y − d)² dA: by how much the centroid (c, d) moves when the body tilts about it, per radian."""
    deepest: np.ndarray
    """Depth up to which the law is tabulated [m], (n,)."""
    force: np.ndarray
    """Normal force [N], (n, M), without the hard back, at depths deepest · (k / (M − 1))²."""
    radius: np.ndarray
    """Radius of the disc that is as stiff at the same depths [m], (n, M)."""

    def __len__(self) -> int:
        return len(self.env)


class LoadTables:
    """Load laws of n contacts with the gel's hard back, once continuously differentiable.

    Between entries force and radius are cubic Hermite splines over the root of the depth, in which a table is evenly spaced. Beyond the
    last entry the law goes on straight.
    """

    def __init__(self, contacts: PadContacts, thickness: np.ndarray, factor: np.ndarray | float = 1.0) -> None:
        """``thickness`` (n,) of the gel [m]; ``factor`` (n,) of its modulus and so of the force."""
        self._deepest, self._thickness = contacts.deepest, thickness
        self._limit = contacts.depth + contacts.clearance
        force = contacts.force * np.reshape(factor, (-1, 1))
        slope, rise = np.zeros_like(force), np.diff(force)
        # Bounded, so that a spline of rising entries rises everywhere (F. N. Fritsch, R. E. Carlson, SIAM J. Numer. Anal. 17, 1980).
        slope[:, 1:-1] = np.minimum(0.5 * (rise[:, 1:] + rise[:, :-1]), 3.0 * np.minimum(rise[:, 1:], rise[:, :-1]))
        slope[:, -1] = np.clip(2.0 * rise[:, -1] - slope[:, -2], 0.0, 3.0 * rise[:, -1])
        self._force, self._slope, self._radius = force, slope, contacts.radius
        self._rows = np.arange(len(force))

    def force(self, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Force [N] and stiffness [N/m] at depths (n,) [m]; at <= 0: 0, and that of first touch."""
        last = self._force.shape[1] - 1
        # Below a thousandth of an entry only the stiffness of the first touch counts.
        deep = np.maximum(depth, self._deepest * (0.3 / last) ** 2)
        at = np.sqrt(deep / self._deepest) * last
        k = np.minimum(at.astype(int), last - 1)
        t = np.minimum(at - k, 1.0)
        rows = self._rows
        f0, f1, s0, s1 = self._force[rows, k], self._force[rows, k + 1], self._slope[rows, k], self._slope[rows, k + 1]
        rise = f1 - f0
        force = f0 + t * (s0 + t * (3.0 * rise - 2.0 * s0 - s1 + t * (s0 + s1 - 2.0 * rise)))
        per_entry = s0 + t * (2.0 * (3.0 * rise - 2.0 * s0 - s1) + 3.0 * t * (s0 + s1 - 2.0 * rise))
        stiffness = per_entry * (0.5 * last) / np.sqrt(np.minimum(deep, self._deepest) * self._deepest)
        force += stiffness * np.maximum(deep - self._deepest, 0.0)
        # Down to no depth at all along the chord.
        force = np.where(deep > depth, force * np.maximum(depth, 0.0) / deep, force)
        factor, growth = hard_back(depth, self._limit, self._thickness)
        return force * factor, stiffness * factor + force * growth

    def radius(self, depth: np.ndarray) -> np.ndarray:
        """Contact radii (n,) [m] at depths (n,) [m]; 0 out of contact."""
        last = self._radius.shape[1] - 1
        at = np.sqrt(np.clip(depth / self._deepest, 0.0, 1.0)) * last
        k = np.minimum(at.astype(int), last - 1)
        low, high = self._radius[self._rows, k], self._radius[self._rows, k + 1]
        return np.where(depth > 0.0, low + (at - k) * (high - low), 0.0)
