"""Optical modes by name: ``OPTICS`` lists them, ``register`` adds one."""

from __future__ import annotations

from raytac.checks import check_methods
from raytac.optics.base import BuiltOptics, OpticalMode, OpticsConfig
from raytac.registry import Registry

OPTICS: Registry[OpticsConfig[OpticalMode]] = Registry(
    "optics",
    {
        "raytrace": "raytac.optics.trace.config:RayTraced",
        "taxim": "raytac.optics.taxim.config:Taxim",
        "phong": "raytac.optics.image.config:Phong",
        "mlp": "raytac.optics.image.config:Mlp",
        "unet": "raytac.optics.image.config:Unet",
    },
)
register = OPTICS.register


def chosen_optics(choice: str | OpticsConfig[OpticalMode] | OpticalMode) -> OpticsConfig[OpticalMode]:
    """Configuration of a name or a built mode, or itself; InputError for anything else."""
    config = OPTICS.config(choice)  # type: ignore[arg-type]
    if isinstance(config, OpticsConfig):
        return config
    what = f"one of {', '.join(OPTICS.names)}, a configuration such as RayTraced(), or an OpticalMode"
    check_methods("optics", config, ("render",), ("label", "device"), what)
    return BuiltOptics(config)
