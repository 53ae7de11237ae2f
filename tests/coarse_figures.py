"""Figures of tests with few dots: encoding those of a page takes longer than drawing them, and no test looks at single dots."""

from __future__ import annotations

import sys
from functools import wraps
from typing import Any

MOST = 100.0
"""Most dots per inch of a figure that a test saves."""


def limit() -> None:
    """Save figures with at most ``MOST`` dots per inch, once Matplotlib is imported."""
    module: Any = sys.modules.get("matplotlib.figure")
    if module is None or hasattr(module.Figure.savefig, "__wrapped__"):
        return
    save = module.Figure.savefig

    @wraps(save)
    def coarse(figure: Any, *args: Any, dpi: Any = None, **options: Any) -> None:
        own = sys.modules["matplotlib"].rcParams["savefig.dpi"] if dpi is None else dpi
        save(figure, *args, dpi=min(MOST, figure.dpi if own == "figure" else own), **options)

    module.Figure.savefig = coarse
