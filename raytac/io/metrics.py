"""``metrics.json`` of every command and experiment: dotted keys to numbers or strings."""

from __future__ import annotations

import importlib.metadata
import json
import math
import numbers
import platform
import re
import sys
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path

from raytac.errors import InputError
from raytac.io.atomic import write_atomic

Metric = int | float | str

REQUIRED = ("device", "wall_s")
"""Keys that every file has, besides at least one ``versions.*``."""

VERSIONED = ("raytac", "numpy", "mitsuba", "drjit", "mujoco", "OpenEXR", "trimesh", "matplotlib")
"""Distributions whose versions go into every file."""

_KEY = re.compile(r"[A-Za-z0-9_\-]+(\.[A-Za-z0-9_\-]+)*")


def versions(distributions: Iterable[str] = VERSIONED) -> dict[str, str]:
    """``versions.python`` and ``versions.<distribution>`` of what is installed."""
    result = {"versions.python": platform.python_version()}
    result |= {f"versions.{name}": version for name in distributions if (version := _version(name)) is not None}
    if "versions.raytac" not in result:  # a plain checkout that was never installed
        result["versions.raytac"] = sys.modules["raytac"].__version__
    return result


@cache
def _version(distribution: str) -> str | None:
    """Version of what is installed, looked up once a process; None if it is not."""
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None


def check_metrics(values: Mapping[str, object]) -> dict[str, Metric]:
    """The metrics as plain ints, floats and strings, in their order.

    Raises ``InputError``: a key that is not dotted words, a value that is not a finite number or a string, or a missing required key.
    """
    checked: dict[str, Metric] = {}
    for key, value in values.items():
        if not isinstance(key, str) or not _KEY.fullmatch(key):
            raise InputError("metrics key", value=key, rule="must be words of letters, digits, _ and - joined by dots")
        checked[key] = _plain(key, value)
    for key in REQUIRED:
        if key not in checked:
            raise InputError("metrics", value=sorted(checked), rule=f"must hold the key {key!r}")
    if not any(key.startswith("versions.") for key in checked):
        raise InputError("metrics", value=sorted(checked), rule="must hold at least one 'versions.*' key")
    return checked


def _plain(key: str, value: object) -> Metric:
    if isinstance(value, str):
        return value
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        raise InputError(f"metrics[{key!r}]", value=value, rule="must be a number or a string, not a list, table or truth value")
    if not math.isfinite(value):
        raise InputError(f"metrics[{key!r}]", value=value, rule="must be finite (leave the key out, or say in a string why)")
    return int(value) if isinstance(value, numbers.Integral) else float(value)


def write_metrics(path: Path, values: Mapping[str, object]) -> dict[str, Metric]:
    """Check, write as JSON and return ``values``. Raises as ``check_metrics``, before writing."""
    checked = check_metrics(values)
    text = json.dumps(checked, indent=1, ensure_ascii=False) + "\n"
    write_atomic(path, text.encode("utf-8", "backslashreplace"))  # a path's undecodable bytes become JSON's own escapes
    return checked


def read_metrics(path: Path) -> dict[str, Metric]:
    """Read and check a ``metrics.json``; ``InputError`` if it is not one flat object."""
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError("metrics file", value=path, rule=f"cannot be read ({error.strerror})") from error
    except (ValueError, RecursionError) as error:  # no JSON, no UTF-8, an integer too long, or nested too deep
        raise InputError("metrics file", value=path, rule=f"must be JSON ({str(error)[:200]})") from error
    if not isinstance(values, dict):
        raise InputError("metrics file", value=path, rule="must hold one JSON object")
    return check_metrics(values)
