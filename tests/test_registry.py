"""Names of implementations: imported late, extended by one line, refused with all choices."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import pytest

from raytac.errors import InputError
from raytac.registry import Registry


def make_registry() -> Registry[Any]:
    return Registry("colour", {"plain": "fractions:Fraction", "absent": "no_such_module:Thing"})


def test_names_are_listed_without_an_import_and_imported_when_asked_for() -> None:
    registry = make_registry()
    assert registry.names == ("plain", "absent")
    assert registry.config_class("plain").__module__ == "fractions"
    with pytest.raises(ModuleNotFoundError):
        registry.config_class("absent")


def test_one_line_adds_a_name() -> None:
    registry = make_registry()

    @registry.register("striped")
    @dataclass(frozen=True)
    class Striped:
        width: float = 1.0

    assert registry.names[-1] == "striped"
    assert registry.config("striped", width=2.0) == Striped(2.0)
    own = Striped(3.0)
    assert registry.config(own) is own and registry.name_of(own) == "striped"
    with pytest.raises(InputError, match=r"colour.*'plain'|colour = 'plain'"):
        registry.register("plain")(Striped)


def test_unknown_names_and_options_are_refused_with_the_choices() -> None:
    registry = make_registry()
    registry.register("striped")(dataclass(frozen=True)(type("Striped", (), {"__annotations__": {"width": float}, "width": 1.0})))
    with pytest.raises(InputError, match=r"plain.*absent.*striped"):
        registry.config("dotted")
    with pytest.raises(InputError, match=r"height.*width"):
        registry.config("striped", height=1.0)
