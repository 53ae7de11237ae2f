"""Figures of tests with few dots: encoding those of a page takes longer than drawing them, and no test looks at single dots."""

from __future__ import annotations

import sys
from functools import wraps
from pathlib import Path
from typing import Any

from tests.on_import import change_module

MOST = 100.0
"""Most dots per inch of a figure that a test saves."""
asked: dict[str, float] = {}
"""Dots per inch that a file of each name was last to be saved with, in this process."""


def limit() -> None:
    """Save figures with at most ``MOST`` dots per inch from now on."""
    change_module("matplotlib.figure", _limit)


def _limit(module: Any) -> None:
    save = module.Figure.savefig
    if hasattr(save, "__wrapped__"):
        return

    @wraps(save)
    def coarse(figure: Any, *args: Any, dpi: Any = None, **options: Any) -> None:
        own = sys.modules["matplotlib"].rcParams["savefig.dpi"] if dpi is None else dpi
        dots = figure.dpi if own == "figure" else own
        asked.update({Path(path).name: dots for path in args[:1] if isinstance(path, str | Path)})
        save(figure, *args, dpi=min(MOST, dots), **options)

    module.Figure.savefig = coarse
