"""A digest of the source code that a result depends on, so that a kept result is never taken for one of other code."""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import sys
from collections.abc import Iterable
from pathlib import Path

__all__ = ["code_digest", "module_sources"]

WITHIN = ("raytac.gel", "raytac.optics", "raytac.shapes")
"""Packages whose modules shape a surface or an image; what a specification says goes into keys by its values, not by its code."""


def module_sources(roots: Iterable[str]) -> dict[str, Path]:
    """Source files of ``roots`` and of all modules of the packages ``WITHIN`` that they import, also inside functions.

    Roots that do not exist are left out. Imports are read from the sources; nothing is run except the ``__init__`` of packages.
    """
    found: dict[str, Path] = {}
    waiting = list(roots)
    while waiting:
        name = waiting.pop()
        if name in found:
            continue
        source = _source(name)
        if source is None:
            continue
        found[name] = source
        for node in ast.walk(ast.parse(found[name].read_bytes())):
            imported: list[str] = []
            if isinstance(node, ast.Import):
                imported = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.module:
                imported = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
            waiting += [name for name in imported if (name + ".").startswith(tuple(package + "." for package in WITHIN))]
    return found


def _source(name: str) -> Path | None:
    """File of a module, of the running script too; None if there is none."""
    if name == "__main__":
        script = getattr(sys.modules[name], "__file__", None)
        return None if script is None else Path(script)
    try:
        spec = importlib.util.find_spec(name)
    except ModuleNotFoundError:
        return None
    return None if spec is None or spec.origin is None else Path(spec.origin)


def code_digest(*roots: str) -> str:
    """Hex digest of the names and contents of ``module_sources(roots)``."""
    digest = hashlib.sha256()
    for name, path in sorted(module_sources(roots).items()):
        digest.update(name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()
