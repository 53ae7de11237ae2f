"""Paths of the fits of the case's light: a fit takes about as long as all the rest of a small image."""

from __future__ import annotations

import sys
from typing import Any

MEASURED = (
    "calibrate/",
    "optics/test_fast_against_reference.py",
    "optics/test_glow.py",
    "optics/test_layers.py",
    "regression/",
    "report/test_real.py",
)
"""Folders and files of ``tests`` that measure images: these fit with all paths, the others with ``FEW``."""
FEW = 1 << 15
_full: list[int] = []
"""The library's own number, once it is known."""


def limit(*, few: bool) -> None:
    """Let fits of the test that begins now take ``FEW`` paths, or all, once the renderer is imported."""
    module: Any = sys.modules.get("raytac.optics.trace.interreflection")
    if module is None:
        return
    if not _full:
        _full.append(module.SAMPLES)
    module.SAMPLES = FEW if few else _full[0]
