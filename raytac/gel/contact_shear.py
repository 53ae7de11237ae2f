"""``ContactShear``: how the gel is sheared under a contact."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class ContactShear:
    """Shear of B pads' contacts with the deepest body, pad frame; zeros out of contact."""

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
        if not failed.any():
            return shear
        return ContactShear(
            **{name: np.where(np.reshape(failed, (-1,) + (1,) * (v.ndim - 1)), np.nan, v) for name, v in vars(shear).items()}
        )
