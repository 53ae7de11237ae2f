"""Sensors, lights and press scenes as data: dataclasses in SI units, and the only readers of TOML in the package."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
