"""Errors that raytac raises on purpose: each names the bad value, the rule it breaks and the choices there are."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

__all__ = [
    "AssetError",
    "BackendError",
    "CalibrationError",
    "InputError",
    "MeshError",
    "OverlapError",
    "RaytacError",
    "SpecError",
]


class RaytacError(Exception):
    """Base of every error that raytac raises on purpose."""


class AssetError(RaytacError, FileNotFoundError):
    """The data folders ``scenes/`` or ``lights/`` cannot be found."""


class BackendError(RaytacError, RuntimeError):
    """A renderer, solver or device that the job needs is missing or does not work here; the message says how to mend it."""


class InputError(RaytacError, ValueError):
    """A public function was given a value that it cannot use.

    ``InputError("optics", value="raytrce", rule="must be a known optical mode", choices=("raytrace",))`` reads
    ``optics = 'raytrce': must be a known optical mode; did you mean 'raytrace'? choose from: raytrace``.
    """

    def __init__(self, name: str, *, value: object, rule: str, choices: Iterable[object] = ()) -> None:
        self.name = name
        self.value = value
        self.rule = rule
        self.choices = tuple(choices)
        super().__init__(f"{name} = {short_repr(value)}: {rule}{_choices_text(value, self.choices)}")

    def __reduce__(self) -> tuple[Any, ...]:
        """Made anew from its parts, so that it comes whole from another process."""
        return partial(type(self), value=self.value, rule=self.rule, choices=self.choices), (self.name,)


class OverlapError(RaytacError, ValueError):
    """Bodies of a simulation overlap where they are to be put; the message names the surfaces."""


class SpecError(RaytacError, ValueError):
    """A sensor, light or press file breaks a rule.

    The message reads ``FILE: KEY = VALUE: RULE`` and, where there are some, a close match and the choices. The same parts are
    attributes: ``file`` (path or None for a spec made in code), ``key`` (dotted, e.g. ``camera.pixel_pitch_mm`` or
    ``leds[2].axis``; empty for the file as a whole), ``value``, ``rule`` and ``choices``.
    """

    def __init__(
        self,
        rule: str,
        *,
        file: Path | str | None = None,
        key: str = "",
        value: object = None,
        choices: Iterable[object] = (),
        hint_for: str | None = None,
    ) -> None:
        """``hint_for`` is the word to find a close match for among ``choices`` (default: ``value`` when it is a string)."""
        self.file = Path(file) if file is not None else None
        self.key = key
        self.value = value
        self.rule = rule
        self.choices = tuple(choices)
        where = f"{self.file}: " if self.file is not None else ""
        what = f"{key} = {short_repr(value)}: " if key and value is not None else f"{key}: " if key else ""
        super().__init__(f"{where}{what}{rule}{_choices_text(hint_for or value, self.choices)}")


class CalibrationError(SpecError):
    """A calibration folder cannot be used: a file is missing, damaged, or holds something of the wrong kind, shape or range."""


class MeshError(SpecError):
    """A mesh file cannot be used: missing, unreadable, empty, not finite or not watertight."""


def short_repr(value: object, limit: int = 80) -> str:
    """``repr`` cut to ``limit`` characters; a path as plain text and whole, since its end names the file."""
    if isinstance(value, Path):
        return str(value)
    text = repr(value)
    return text if len(text) <= limit else text[: limit - 1] + "…"


def _choices_text(value: object, choices: tuple[object, ...]) -> str:
    if not choices:
        return ""
    names = [str(c) for c in choices]
    close = difflib.get_close_matches(value, names, n=1) if isinstance(value, str) else []
    hint = f"; did you mean {close[0]!r}?" if close else ";"
    return f"{hint} choose from: {', '.join(names)}"
