"""NumPy reference of the contact search, for its tests and its benchmark."""

from raytac.world.pad_overlap import PadOverlap

__all__ = ["PadOverlap"]
