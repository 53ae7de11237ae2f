"""Shear of the gel under contacts: elastic stretch with partial slip, and its memory.

A contact of normal load N carries a tangential force by shearing first. Cattaneo and Mindlin's contact of two spheres obeys

    T = μN (1 − (1 − u/u₀)^(3/2)),   u₀ = 3 μN / (2 k)

with u the tangential displacement and k the stiffness without slip; its outer annulus slips, the disc of radius c = a (1 − T/μN)^(1/3)
sticks. Here elements in parallel give that curve (W. D. Iwan, A distributed-element model for hysteresis, J. Appl. Mech. 33, 1966): each
has its share of the stiffness and slips at its own displacement. They remember: unloading and reversal follow Masing's rule, as Mindlin
and Deresiewicz' contact does (J. Appl. Mech. 20, 1953). Spin about the normal takes part by one ellipsoid with both displacements.
``ShearState`` keeps the elements, ``shear_kernels`` moves them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

MOST_RINGS = 16
"""Rings of a contact at most, all of one shear stiffness but the outermost. It has at least three eighths as many."""


@dataclass(frozen=True)
class ContactShear:
    """Shear of one contact of each of B pads with the body that is deepest in it, pad frame; zeros out of contact."""

    stretch: np.ndarray
    """Mean elastic displacement of the gel's skin along the pad's x and y [m], (B, 2)."""
    spin: np.ndarray
    """Mean elastic rotation about the normal [rad], (B,)."""
    stuck: np.ndarray
    """Radius of the disc that sticks over the contact's, (B,): 0 slips as a whole."""
    centre: np.ndarray
    """Centre of the contact [m], (B, 3)."""

    def of(self, rows: np.ndarray) -> ContactShear:
        """The same of the environments named."""
        return ContactShear(**{name: values[rows] for name, values in vars(self).items()})

    @staticmethod
    def where(failed: np.ndarray, shear: ContactShear) -> ContactShear:
        """``shear`` with NaN for environments that ``failed`` (B,)."""
        return ContactShear(
            **{name: np.where(np.reshape(failed, (-1,) + (1,) * (v.ndim - 1)), np.nan, v) for name, v in vars(shear).items()}
        )
