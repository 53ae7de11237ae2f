"""Paths of the fits of the case's light: a fit takes about as long as all the rest of a small image."""

from __future__ import annotations

import sys
from typing import Any

from tests.on_import import change_module

MEASURED = (
    "calibrate/",
    "optics/test_fast_against_reference.py",
    "optics/test_glow.py",
    "optics/test_layers.py",
    "regression/",
)
"""Folders and files of ``tests`` that measure images: these fit with all paths, the others with ``FEW``."""
FEW = 1 << 15
_MODULE = "raytac.optics.trace.interreflection"
_full: list[int] = []
"""The library's own number, once it is known."""


def limit(*, few: bool) -> None:
    """Let fits of the test that begins now take ``FEW`` paths, or all, once the renderer is imported."""
    module: Any = sys.modules.get(_MODULE)
    if module is None:
        return
    if not _full:
        _full.append(module.SAMPLES)
    module.SAMPLES = FEW if few else _full[0]


def always_few() -> None:
    """Let all fits of this process take ``FEW`` paths."""
    change_module(_MODULE, lambda module: setattr(module, "SAMPLES", FEW))
