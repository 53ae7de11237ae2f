"""Markers: how the dots on the coat move, by four models behind one interface; see docs/markers.md."""

from __future__ import annotations

from raytac.markers.perturbation import MarkerPerturbation
from raytac.markers.tracker import MARKER_MODELS, MarkerFrame, MarkerTracker

__all__ = ["MARKER_MODELS", "MarkerFrame", "MarkerPerturbation", "MarkerTracker"]
