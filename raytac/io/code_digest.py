"""Digest of the source code that a result depends on, and the commit that runs."""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import subprocess
import sys
from collections.abc import Iterable
from functools import cache, lru_cache
from pathlib import Path

WITHIN = ("raytac.gel", "raytac.optics", "raytac.shapes")
"""Packages whose code shapes a surface or an image; specifications enter keys by value."""


def module_sources(roots: Iterable[str]) -> dict[str, Path]:
    """Source files of ``roots`` and of all modules of ``WITHIN`` that they import.

    Imports inside functions count. Roots that do not exist are left out. Imports are read from the sources; nothing is run except the
    ``__init__`` of packages.
    """
    sources: dict[str, Path] = {}
    waiting = list(roots)
    while waiting:
        name = waiting.pop()
        if name in sources:
            continue
        source = _source(name)
        if source is None:
            continue
        sources[name] = source
        waiting += _imported(source.read_bytes())
    return sources


@lru_cache(maxsize=1024)
def _imported(source: bytes) -> tuple[str, ...]:
    """Modules of ``WITHIN`` that a source may import, and names that it imports from them."""
    names: list[str] = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
    return tuple(name for name in names if (name + ".").startswith(tuple(package + "." for package in WITHIN)))


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


@cache
def git_state() -> dict[str, str | int]:
    """``git.commit``, and how many tracked files of the package differ; empty if installed."""
    package = Path(str(sys.modules["raytac"].__file__)).parent
    try:
        if _git(package, "ls-files", "--error-unmatch", "__init__.py") is None:
            return {}  # the package lies in a checkout of something else, such as a project with its .venv
        commit, changed = _git(package, "rev-parse", "HEAD"), _git(package, "status", "--porcelain", "--untracked-files=no", ".")
    except (OSError, subprocess.TimeoutExpired):
        return {}
    if commit is None or changed is None:
        return {}
    return {"git.commit": commit, "git.changed": len(changed.splitlines())}


def _git(folder: Path, *command: str) -> str | None:
    done = subprocess.run(["git", "-C", str(folder), *command], capture_output=True, text=True, check=False, timeout=20)
    return done.stdout.strip() if done.returncode == 0 else None
