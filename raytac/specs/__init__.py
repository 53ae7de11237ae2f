"""Sensors, lights and press scenes as dataclasses in SI units; the only readers of TOML."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
