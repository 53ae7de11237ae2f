"""A small validating reader: a schema in, a dict of SI values or one precise error out.

A schema maps a TOML key to a field. The key carries its unit as a suffix (``thickness_mm``); the value comes out in SI under
the bare name (``thickness``), so that a section can be handed to its dataclass as keyword arguments. Ranges are written in the
unit of the file, because that is what an error must show.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar, Final

from raytac.checks import Interval, is_number, is_whole
from raytac.errors import SpecError

REQUIRED: Final = object()
"""Default of a field that a file must give."""
ANY: Final = -1
"""Length of a list of one value or more."""
_LARGEST: Final = 2**22
"""Longest file that is read [byte]; the parser takes minutes for a hundred megabytes."""

_UNITS: Final[dict[str, tuple[float, float, str]]] = {
    "m_per_unit": (1.0, 1.0, "m per file unit"),
    "per_mm": (1e3, 1.0, "1/mm"),
    "per_mm2": (1e6, 1.0, "1/mm²"),
    "per_mm3": (1e9, 1.0, "1/mm³"),
    "per_m2": (1.0, 1.0, "1/m²"),
    "w_per_sr": (1.0, 1.0, "W/sr"),
    "kg_m3": (1.0, 1.0, "kg/m³"),
    "m_s2": (1.0, 1.0, "m/s²"),
    "wxyz": (1.0, 1.0, ""),
    "kpa": (1000.0, 1.0, "kPa"),
    "deg": (math.pi, 180.0, "°"),
    "mm": (1.0, 1000.0, "mm"),
    "um": (1.0, 1e6, "µm"),
    "px": (1.0, 1.0, "px"),
    "kg": (1.0, 1.0, "kg"),
    "n": (1.0, 1.0, "N"),
    "s": (1.0, 1.0, "s"),
}
"""Suffix: (numerator, denominator of the factor to SI, text). Longer suffixes stand first.
Dividing by 1000 rounds once; multiplying by 0.001, itself rounded, makes 36 mm 0.036000000000000004 m."""


@dataclass(frozen=True)
class Unit:
    """Unit of a key: ``si = value * numerator / denominator``, and its name in messages."""

    numerator: float = 1.0
    denominator: float = 1.0
    text: str = ""

    def to_si(self, value: float) -> float:
        return value * self.numerator / self.denominator

    def shown(self, value: Any) -> Any:
        """A number or some in SI as a file writes them, to six digits; anything else as it is."""
        if isinstance(value, (tuple, list)):
            return [self.shown(item) for item in value]
        if not is_number(value) or self == Unit():
            return value
        try:
            return float(f"{float(value) * self.denominator / self.numerator:.6g}")
        except OverflowError:  # an integer beyond all floats
            return value


in_mm = Unit(*_UNITS["mm"]).shown
"""A length or several [m] as a file writes them [mm]."""


@lru_cache(maxsize=1024)
def split_unit(key: str) -> tuple[str, Unit]:
    """``"thickness_mm"`` to ``("thickness", millimetres)``; a key without unit stays as it is."""
    for suffix, parts in _UNITS.items():
        if key.endswith("_" + suffix):
            return key[: -len(suffix) - 1], Unit(*parts)
    return key, Unit()


class _Refused(Exception):
    """Why a field does not take a value: the rule, and the choices if there are some."""

    def __init__(self, rule: str, choices: Sequence[str] = ()) -> None:
        super().__init__(rule)
        self.rule = rule
        self.choices = tuple(choices)


class _Field:
    """One field of a table: one value, or a list of ``length`` values (``ANY``: one or more)."""

    length: int = 0
    default: Any = REQUIRED
    choices: tuple[str, ...] = ()

    def rule(self, unit: Unit) -> str:
        """The rule that the values of a file obey, in words."""
        raise NotImplementedError

    def _one(self, value: object, unit: Unit) -> Any:
        """One value of a file, checked and in SI."""
        raise NotImplementedError

    def refused(self, unit: Unit, choices: Sequence[str] = ()) -> _Refused:
        return _Refused(self.rule(unit), choices)

    def parse(self, value: object, unit: Unit) -> Any:
        """The value of a file, checked and in SI; a list becomes a tuple."""
        if not self.length:
            return self._one(value, unit)
        if not isinstance(value, list) or not value or self.length not in (ANY, len(value)):
            raise self.refused(unit, self.choices)
        return tuple(self._one(item, unit) for item in value)

    def check(self, value: object, unit: Unit) -> None:
        """Refuse a value in SI that no file could give."""
        self.parse(list(value) if isinstance(value, tuple) else value, unit)


@dataclass(frozen=True)
class Number(_Field):
    """A real number, or ``length`` of them (``ANY``: one or more), in ``interval``.

    ``interval`` is in the unit of the file. ``word`` is accepted in place of the number.
    """

    interval: str
    length: int = 0
    default: Any = REQUIRED
    word: str = ""
    _range: Interval = field(init=False, repr=False)
    _noun: ClassVar = "number"

    def __post_init__(self) -> None:
        object.__setattr__(self, "_range", Interval.parse(self.interval))

    def rule(self, unit: Unit) -> str:
        many = "a list of" if self.length == ANY else self.length
        what = f"{many} {self._noun}s, each" if self.length else f"a {self._noun}"
        word = f', or "{self.word}"' if self.word else ""
        return f"must be {what} in {self.interval}{' ' + unit.text if unit.text else ''}{word}"

    def parse(self, value: object, unit: Unit) -> float | str | tuple[float, ...]:
        return self.word if self.word and value == self.word else super().parse(value, unit)

    def _one(self, value: object, unit: Unit) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.refused(unit)
        try:
            number = float(value)
        except OverflowError:
            raise self.refused(unit) from None
        si = unit.to_si(number)
        if number not in self._range or si not in _in_si(self._range, unit):  # a tiny length may become 0 m
            raise self.refused(unit)
        return si

    def check(self, value: Any, unit: Unit) -> None:
        if self.word and isinstance(value, str) and value == self.word:
            return
        items: Any = (value,)
        if self.length:
            if not isinstance(value, (tuple, list)) or (len(value) != self.length and not (self.length == ANY and value)):
                raise self.refused(unit)
            items = value
        interval = _in_si(self._range, unit)
        if not all(self._is_kind(item) and item in interval for item in items):
            raise self.refused(unit)

    def _is_kind(self, value: object) -> bool:
        return is_number(value)


class Integer(Number):
    """A whole number, or ``length`` of them, in ``interval``."""

    _noun = "whole number"

    def _one(self, value: object, unit: Unit) -> int:
        if isinstance(value, bool) or not isinstance(value, int) or value not in self._range:
            raise self.refused(unit)
        return value

    def _is_kind(self, value: object) -> bool:
        return is_whole(value)


@dataclass(frozen=True)
class Text(_Field):
    """A non-empty string: one of ``choices``, or one that ``pattern`` matches as a whole.

    ``described`` says the pattern in words. With ``length`` = ``ANY``, a list of one or more of them, none twice.
    """

    choices: tuple[str, ...] = ()
    pattern: str = r"(?s).+"
    described: str = "a non-empty string"
    default: Any = REQUIRED
    length: int = 0

    def rule(self, unit: Unit) -> str:
        if self.length:
            return f"must be a list{' of known names' if self.choices else f', each {self.described}'}, none twice"
        return "must be a known name" if self.choices else f"must be {self.described}"

    def parse(self, value: object, unit: Unit) -> str | tuple[str, ...]:
        words = super().parse(value, unit)
        if self.length and len(set(words)) != len(words):
            raise self.refused(unit, self.choices)
        return words

    def _one(self, value: object, unit: Unit) -> str:
        if not isinstance(value, str) or (self.choices and value not in self.choices):
            raise self.refused(unit, self.choices)
        if not re.fullmatch(self.pattern, value) or "\0" in value:
            raise self.refused(unit)
        return value


@dataclass(frozen=True)
class Flag(_Field):
    """``true`` or ``false``."""

    default: Any = REQUIRED

    def rule(self, unit: Unit) -> str:
        return "must be true or false"

    def _one(self, value: object, unit: Unit) -> bool:
        if not isinstance(value, bool):
            raise self.refused(unit)
        return value


@lru_cache(maxsize=1024)
def _in_si(interval: Interval, unit: Unit) -> Interval:
    """The same range in SI. Conversion is monotone: what is in one range is in the other."""
    return Interval(unit.to_si(interval.low), unit.to_si(interval.high), interval.low_open, interval.high_open)


Schema = Mapping[str, Number | Text | Flag]


def check_fields(values: Mapping[str, Any], schema: Schema, prefix: str = "", file: Path | None = None) -> None:
    """Check values in SI, by name, against the schema of their table in a file.

    ``vars`` gives those of a dataclass. Thus a specification that was made or changed in code obeys the rules of one from a file. The
    default of a field needs no check.

    Raises ``SpecError``: a value of the wrong type or out of its range; the message gives the key and the value as a file would write them.
    """
    for key, spec in schema.items():
        name, unit = split_unit(key)
        value = values.get(name)
        if (value is None or (isinstance(value, tuple) and not value)) and spec.default == value:
            continue
        try:
            spec.check(value, unit)
        except _Refused as refused:
            dotted = f"{prefix}.{key}" if prefix else key
            shown = "None" if value is None else unit.shown(value)
            raise SpecError(refused.rule, file=file, key=dotted, value=shown, choices=refused.choices) from None


@dataclass(frozen=True)
class Table:
    """One table of a TOML file, with the file and the dotted prefix that its errors name."""

    data: Mapping[str, Any]
    file: Path
    prefix: str = ""

    def error(self, rule: str, key: str = "", value: object = None, choices: Sequence[str] = ()) -> SpecError:
        """An error about ``key`` of this table (about the whole table if empty)."""
        return SpecError(rule, file=self.file, key=self._dotted(key), value=value, choices=choices)

    def read_one(self, key: str, spec: Number | Text | Flag) -> Any:
        """One field in SI. Raises ``SpecError``: missing key, wrong type, value out of range."""
        _, unit = split_unit(key)
        if key not in self.data:
            if spec.default is REQUIRED:
                raise self.error(f"missing key: {spec.rule(unit)}", key)
            return spec.default
        try:
            return spec.parse(self.data[key], unit)
        except _Refused as refused:
            raise self.error(refused.rule, key, self.data[key], refused.choices) from None

    def read(self, schema: Schema, *, sections: Sequence[str] = ()) -> dict[str, Any]:
        """Fields of ``schema`` in SI, by name without unit; ``sections``: sub-tables read elsewhere.

        Raises:
            SpecError: an unknown key (checked first, so that a misspelt key is called that and not missing), a missing key, a
                wrong type, or a value out of its range.
        """
        known = (*schema, *sections)
        for key in self.data:
            if key not in known:
                raise SpecError("unknown key", file=self.file, key=self._dotted(key), choices=known, hint_for=key)
        return {split_unit(key)[0]: self.read_one(key, spec) for key, spec in schema.items()}

    def section(self, name: str) -> Table:
        """The sub-table ``[name]``; a missing one or another type is an error."""
        if name not in self.data:
            raise self.error(f"missing table [{name}]", name)
        value = self.data[name]
        if not isinstance(value, dict):
            raise self.error(f"must be a table [{name}]", name, value)
        return Table(value, self.file, self._dotted(name))

    def sections(self, name: str) -> tuple[Table, ...]:
        """The array of tables ``[[name]]``, empty if absent; errors say ``name[0]``, ``name[1]``…"""
        value = self.data.get(name, [])
        if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
            raise self.error(f"must be an array of tables [[{name}]]", name, value)
        return tuple(Table(item, self.file, f"{self._dotted(name)}[{i}]") for i, item in enumerate(value))

    def _dotted(self, key: str) -> str:
        return ".".join(part for part in (self.prefix, key) if part)


def read_toml(path: Path) -> Table:
    """The top table of a file. Raises ``SpecError``: missing, unreadable, too long, or no TOML."""
    try:
        with path.open("rb") as stream:
            text = stream.read(_LARGEST + 1)
        if len(text) > _LARGEST:
            raise SpecError(f"the file must be at most {_LARGEST} bytes long", file=path)
        data = tomllib.loads(text.decode())
    except FileNotFoundError:
        raise SpecError("the file does not exist", file=path) from None
    except OSError as error:
        raise SpecError(f"the file cannot be read ({error.strerror})", file=path) from error
    except RecursionError as error:
        raise SpecError("the file is not valid TOML (its values are nested too deep)", file=path) from error
    except ValueError as error:  # tomllib's, of the encoding, and Python's of an integer or a date that it does not make
        raise SpecError(f"the file is not valid TOML ({str(error)[:200]})", file=path) from error
    return Table(data, path)
