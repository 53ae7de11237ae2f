"""Paths of the fits of the case's light: a fit takes about as long as all the rest of a small image."""

from __future__ import annotations

import importlib.abc
import importlib.machinery
import sys
from types import ModuleType
from typing import Any

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


class FewPaths(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Sets the number of paths when the module is imported, so that a script that renders nothing imports no renderer."""

    def find_spec(self, fullname: str, path: Any, target: ModuleType | None = None) -> importlib.machinery.ModuleSpec | None:
        spec = importlib.machinery.PathFinder.find_spec(fullname, path) if fullname == _MODULE else None
        if spec is not None and spec.loader is not None:
            self._loader, spec.loader = spec.loader, self
        return spec

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> ModuleType | None:
        return self._loader.create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        self._loader.exec_module(module)
        module.__dict__["SAMPLES"] = FEW
