"""Contacts of resting pads and bodies, one row for each pair that touches or is near."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["LAW_POINTS", "PadContacts"]

LAW_POINTS = 33
"""Depths M at which the load law of a contact is tabulated."""


@dataclass(frozen=True)
class PadContacts:
    """n pairs of a pad and a body, pad frame, SI units, sorted by environment, pad and body.

    A row of a pose that is not finite has NaN in every field but the indices.
    """

    env: np.ndarray
    """(n,)."""
    pad: np.ndarray
    body: np.ndarray
    depth: np.ndarray
    """Greatest overlap of resting gel and body [m], (n,); a negative one is a gap, known up to the search distance."""
    centre: np.ndarray
    """Centroid of the overlap on the body's underside; of a gap, the place on the body where it is least [m], (n, 3)."""
    normal: np.ndarray
    """Unit normal of the resting gel there, (n, 3)."""
    clearance: np.ndarray
    """Height of the body's lowest point over the pad above the bonded face [m], (n,); <= 0 is through the gel."""
    deepest: np.ndarray
    """Depth up to which the law is tabulated [m], (n,)."""
    force: np.ndarray
    """Normal force of the load law [N] at depths ``deepest`` · (k / (M − 1))², (n, M), M = ``LAW_POINTS``."""
    radius: np.ndarray
    """Radius of the disc of the contact's area at these depths [m], (n, M)."""
