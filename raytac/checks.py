"""Checks of arguments: each returns the value in its own type, or raises ``InputError``."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from raytac.errors import InputError

__all__ = [
    "MOST_ENVIRONMENTS",
    "Interval",
    "check_kind",
    "check_known",
    "check_mapping",
    "check_methods",
    "check_names",
    "check_number",
    "check_numbers",
    "check_seed",
    "check_seeds",
    "check_truth",
    "check_whole",
    "is_number",
    "is_whole",
]

_T = TypeVar("_T")
MOST_ENVIRONMENTS = 2**24
"""Environments that one sensor, world or observer can have."""


@dataclass(frozen=True)
class Interval:
    """A range as in mathematics, ``[0, 1)``; a closed infinite end admits ``inf`` itself."""

    low: float
    high: float
    low_open: bool
    high_open: bool

    @classmethod
    def parse(cls, text: str) -> Interval:
        match = re.fullmatch(r"([\[(])\s*(\S+)\s*,\s*(\S+?)\s*([\])])", text)
        if match is None:
            raise ValueError(f"interval {text!r} is not of the form [low, high)")
        return cls(float(match[2]), float(match[3]), match[1] == "(", match[4] == ")")

    def __contains__(self, value: float) -> bool:
        above = value > self.low if self.low_open else value >= self.low
        below = value < self.high if self.high_open else value <= self.high
        return above and below  # False for NaN


def is_number(value: object) -> bool:
    """True for a real number of Python or NumPy; a truth value is none."""
    return isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)


def is_whole(value: object) -> bool:
    """True for a whole number of Python or NumPy; a truth value is none."""
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)


def check_known(name: str, value: object, choices: Sequence[str]) -> str:
    """``value``, one of ``choices``."""
    if not isinstance(value, str) or value not in choices:
        raise InputError(name, value=value, rule="must be a known name", choices=choices)
    return value


def check_names(name: str, values: object, choices: Sequence[str]) -> tuple[str, ...]:
    """One of ``choices`` or a sequence of them."""
    if not isinstance(values, (str, Sequence)) or isinstance(values, (bytes, bytearray)):
        raise InputError(name, value=values, rule="must be a known name, or a sequence of names", choices=choices)
    return tuple(check_known(name, value, choices) for value in ((values,) if isinstance(values, str) else values))


def check_truth(name: str, value: object) -> bool:
    """True or False."""
    if not isinstance(value, (bool, np.bool_)):
        raise InputError(name, value=value, rule="must be True or False")
    return bool(value)


def check_mapping(name: str, value: object) -> None:
    """Refuse what is no mapping of names to values."""
    if not isinstance(value, Mapping) or not all(isinstance(key, str) for key in value):
        raise InputError(name, value=value, rule="must be a mapping of names to values")


def check_whole(name: str, value: object, low: int = 1, high: int | None = None) -> int:
    """A whole number of at least ``low`` and at most ``high``."""
    if not is_whole(value) or value < low or (high is not None and value > high):  # type: ignore[operator]
        rule = f"must be a whole number >= {low}" if high is None else f"must be a whole number in [{low}, {high}]"
        raise InputError(name, value=value, rule=rule)
    return int(value)  # type: ignore[call-overload]


def check_number(name: str, value: object, interval: str, unit: str = "") -> float:
    """A real number in an interval such as ``(0, inf)``."""
    try:
        number = float(value) if is_number(value) else float("nan")  # type: ignore[arg-type]
    except OverflowError:  # an integer beyond all floats
        number = float("nan")
    if number not in Interval.parse(interval):
        raise InputError(name, value=value, rule=f"must be a number in {interval}{' ' + unit if unit else ''}")
    return number


def check_seed(name: str, value: object) -> int:
    """A whole number in [0, 2^32)."""
    if not is_whole(value) or not 0 <= value < 2**32:  # type: ignore[operator]
        raise InputError(name, value=value, rule="must be a whole number in [0, 2^32)")
    return int(value)  # type: ignore[call-overload]


def check_seeds(name: str, values: object, count: int) -> list[int]:
    """Whole numbers >= 0, one for each of ``count`` environments."""
    given = values.tolist() if isinstance(values, np.ndarray) else values
    if not isinstance(given, Sequence) or isinstance(given, (str, bytes)) or len(given) != count:
        rule = f"must be whole numbers >= 0, one for each of {count} environments"
        raise InputError(name, value=len(given) if isinstance(given, Sequence) else given, rule=rule)
    return [check_whole(f"{name}[{i}]", value, 0) for i, value in enumerate(given)]


def check_numbers(name: str, values: object, shape: tuple[int | None, ...], *, finite: bool = False) -> np.ndarray:
    """Real numbers as a float64 array of ``shape``; None in it is any length.

    Refused are complex numbers, dates, text, objects, truth values, lists that are no box of numbers, and masked entries.
    """
    try:
        array = np.asarray(values)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(name, value=values, rule=f"must be numbers of shape {_shown(shape)}") from error
    if array.dtype.kind not in "iuf":
        raise InputError(name, value=str(array.dtype), rule=f"must be real numbers of shape {_shown(shape)}")
    if array.ndim != len(shape) or any(n is not None and n != m for n, m in zip(shape, array.shape, strict=True)):
        if array.ndim == 0:
            raise InputError(name, value=array.item(), rule=f"must have shape {_shown(shape)}, and is one number")
        raise InputError(name, value=array.shape, rule=f"must have shape {_shown(shape)}")
    if np.ma.is_masked(values):
        raise InputError(name, value=array.shape, rule="must have no masked entries")
    array = array.astype(float)
    if finite and not np.isfinite(array).all():
        raise InputError(name, value=float(array[~np.isfinite(array)][0]), rule="must be finite everywhere")
    return array


def _shown(shape: tuple[int | None, ...]) -> str:
    return "(" + ", ".join("any" if n is None else str(n) for n in shape) + ("," if len(shape) == 1 else "") + ")"


def check_kind(name: str, value: object, kind: type[_T]) -> _T:
    """An instance of ``kind``."""
    if not isinstance(value, kind):
        raise InputError(name, value=value, rule=f"must be a {kind.__name__}, not {type(value).__name__}")
    return value


def check_methods(name: str, value: object, methods: Sequence[str], attributes: Sequence[str], what: str) -> None:
    """Refuse an object that is not ``what`` its methods and attributes make it."""
    missing = [m for m in methods if not callable(getattr(value, m, None))] + [a for a in attributes if not hasattr(value, a)]
    if missing or isinstance(value, type):
        rule = f"must be {what}" + (f", which has {', '.join((*attributes, *methods))}" if missing else ", not its class")
        raise InputError(name, value=value, rule=rule)
