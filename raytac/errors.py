"""Errors that raytac raises on purpose, with the bad value, the rule and the choices."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator
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
    "short_repr",
]

_LONGEST_MESSAGE = 2000
"""Characters of a message; the middle of a longer one is left out."""
_LONGEST_PATH = 400
"""Characters of a path in a message; of a longer one the end is shown."""
_DEEPEST = 8
"""Nested containers that a message shows."""
_MOST_CHOICES = 60
"""Choices that a message lists."""
_LONGEST_WORD = 100
"""Characters of a word that is compared with the choices, and of a choice in a message."""


class RaytacError(Exception):
    """Base of every error that raytac raises on purpose; its message is one bounded text."""

    def __str__(self) -> str:
        text = super().__str__()
        if len(text) <= _LONGEST_MESSAGE:
            return text
        half = _LONGEST_MESSAGE // 2
        return f"{text[:half]} … {text[-half:]}"


class AssetError(RaytacError, FileNotFoundError):
    """The data folders ``scenes/`` or ``lights/`` cannot be found."""


class BackendError(RaytacError, RuntimeError):
    """A renderer, solver or device is missing or does not work; the message says how to fix it."""


class InputError(RaytacError, ValueError):
    """A public function was given a value that it cannot use.

    ``InputError("optics", value="raytrce", rule="must be a known optical mode", choices=("raytrace",))`` reads
    ``optics = 'raytrce': must be a known optical mode; did you mean 'raytrace'? choose from: raytrace``. Without ``value`` it reads
    ``NAME: RULE``: an argument that is missing.
    """

    def __init__(self, name: str, *, value: object = ..., rule: str, choices: Iterable[object] = ()) -> None:
        self.name = name
        self.value = value
        self.rule = rule
        self.choices = tuple(choices)
        what = name if value is ... else f"{name} = {short_repr(value)}"
        super().__init__(f"{what}: {rule}{_choices_text(value, self.choices)}")

    def __reduce__(self) -> tuple[Any, ...]:
        """Rebuild it from its parts, so that it is complete when it comes from another process."""
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
        """``hint_for``: word to match among ``choices`` (default: a ``value`` that is a string)."""
        self.file = Path(file) if file is not None else None
        self.key = key
        self.value = value
        self.rule = rule
        self.choices = tuple(choices)
        where = f"{short_repr(self.file)}: " if self.file is not None else ""
        named = key if len(key) <= _LONGEST_PATH else key[: _LONGEST_PATH - 1] + "…"
        what = f"{named} = {short_repr(value)}: " if named and value is not None else f"{named}: " if named else ""
        super().__init__(f"{where}{what}{rule}{_choices_text(hint_for or value, self.choices)}")


class CalibrationError(SpecError):
    """A calibration folder with a file that is missing, damaged, or of a wrong kind or shape."""


class MeshError(SpecError):
    """A mesh file cannot be used: missing, unreadable, empty, not finite or not watertight."""


def short_repr(value: object, limit: int = 80) -> str:
    """``repr`` cut to ``limit`` characters, for any value.

    A path is plain text, and whole up to ``_LONGEST_PATH`` characters. Integers too long to be printed, deep and long containers,
    and objects whose ``repr`` fails are abbreviated.
    """
    if isinstance(value, Path):
        text = str(value)
        return text if len(text) <= _LONGEST_PATH else "…" + text[-_LONGEST_PATH:]
    text = ""
    for piece in _pieces(value, limit, _DEEPEST):
        text += piece
        if len(text) > limit:
            return text[: limit - 1] + "…"
    return text


def _pieces(value: object, limit: int, levels: int) -> Iterator[str]:
    """``repr`` of ``value`` piece by piece, by at most ``levels`` nested calls."""
    if isinstance(value, (list, tuple, dict)) and type(value).__repr__ in (list.__repr__, tuple.__repr__, dict.__repr__):
        first, last = {list: "[]", tuple: "()", dict: "{}"}[next(t for t in (list, tuple, dict) if isinstance(value, t))]
        yield first
        if value and not levels:
            yield "…"
        for i, item in enumerate(value if levels else ()):
            yield ", " if i else ""
            yield from _pieces(item, limit, levels - 1)
            if isinstance(value, dict):
                yield ": "
                yield from _pieces(value[item], limit, levels - 1)
        yield ",)" if isinstance(value, tuple) and len(value) == 1 else last
    elif isinstance(value, (str, bytes, bytearray)):
        yield repr(value[:limit] if len(value) > limit else value)
    elif isinstance(value, int) and value.bit_length() > 10_000:  # beyond 4300 digits Python itself refuses
        yield f"an integer of about {int(value.bit_length() * 0.30103) + 1} digits"
    else:
        try:
            yield repr(value)
        except Exception as error:  # whatever a foreign object's repr raises must not hide the message
            yield f"<{type(value).__name__} whose repr raises {type(error).__name__}>"


def _choices_text(value: object, choices: tuple[object, ...]) -> str:
    if not choices:
        return ""
    names = [
        name if len(name) <= _LONGEST_WORD else name[: _LONGEST_WORD - 1] + "…" for name in map(str, choices[:_MOST_CHOICES])
    ]
    close = difflib.get_close_matches(value, names, n=1) if isinstance(value, str) and len(value) <= _LONGEST_WORD else []
    hint = f"; did you mean {close[0]!r}?" if close else ";"
    more = f" and {len(choices) - len(names)} more" if len(choices) > len(names) else ""
    return f"{hint} choose from: {', '.join(names)}{more}"
