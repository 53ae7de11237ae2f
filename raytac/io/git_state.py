"""Which commit of raytac is running, where it runs from a checkout."""

from __future__ import annotations

import subprocess
import sys
from functools import cache
from pathlib import Path

__all__ = ["git_state"]


@cache
def git_state() -> dict[str, str | int]:
    """``git.commit``, and ``git.changed``: how many tracked files of the package differ from it. Empty for an installed package."""
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
