"""Marker models by name."""

from __future__ import annotations

from raytac.errors import InputError
from raytac.markers.base import MarkersConfig
from raytac.registry import Registry

MARKERS: Registry[MarkersConfig] = Registry(
    "markers",
    {
        "fots": "raytac.markers.config:Fots",
        "fots_published": "raytac.markers.config:FotsPublished",
        "surface": "raytac.markers.config:SurfaceMarkers",
        "superposition": "raytac.markers.config:Superposition",
        "force_field": "raytac.markers.config:ForceField",
    },
)
"""Names that ``markers=`` accepts, each with the class of its configuration."""
register = MARKERS.register
"""Class decorator that names a user's configuration."""


def markers_config(markers: str | MarkersConfig) -> MarkersConfig:
    """Configuration of a name, or the configuration itself; ``InputError`` for anything else."""
    config = MARKERS.config(markers)
    if not isinstance(config, MarkersConfig):
        raise InputError("markers", value=markers, rule="must be a known name or a MarkersConfig", choices=MARKERS.names)
    return config


def models_without_coat() -> tuple[str, ...]:
    """Names of models for every physics, which are compared with surface tracking."""
    return tuple(name for name in MARKERS.names if not MARKERS.config_class(name).needs_coat)
