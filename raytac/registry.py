"""Implementations of one axis by name: physics, optical modes or marker models."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from typing import Any, Generic, TypeVar

from raytac.errors import InputError

Config = TypeVar("Config")


class Registry(Generic[Config]):
    """Names of the implementations of one axis, and the frozen dataclass of each.

    Names that come with raytac are given as ``module:Class``, which is imported when it is first asked for, so that listing the names
    loads no renderer and no solver. :meth:`register` adds a name, and with it the implementation works wherever a name is accepted.
    """

    def __init__(self, argument: str, built_in: Mapping[str, str]) -> None:
        """``argument``: name of this axis in errors; ``built_in``: ``module:Class`` of each name."""
        self.argument = argument
        self._classes: dict[str, str | type[Config]] = dict(built_in)

    @property
    def names(self) -> tuple[str, ...]:
        """All names, those that come with raytac first."""
        return tuple(self._classes)

    def register(self, name: str) -> Callable[[type[Any]], type[Any]]:
        """Class decorator: make a configuration known by a name; ``InputError`` if taken."""

        def add(config: type[Any]) -> type[Any]:
            taken = self._classes.get(name)
            if taken is not None and (isinstance(taken, str) or taken.__qualname__ != config.__qualname__):
                raise InputError(self.argument, value=name, rule="is the name of another implementation; choose a new one")
            self._classes[name] = config
            return config

        return add

    def config_class(self, name: str) -> type[Config]:
        """Class that configures the implementation of a name; ``InputError`` lists the names."""
        if not isinstance(name, str) or name not in self._classes:
            raise InputError(self.argument, value=name, rule="must be a known name", choices=self.names)
        entry: Any = self._classes[name]
        if isinstance(entry, str):
            module, _, attribute = entry.partition(":")
            entry = self._classes[name] = getattr(importlib.import_module(module), attribute)
        return entry

    def config(self, choice: str | Config, **options: Any) -> Config:
        """Configuration of a name with ``options``, or itself; ``InputError`` for what it refuses."""
        if not isinstance(choice, str):
            return choice
        config = self.config_class(choice)
        known = tuple(getattr(config, "__dataclass_fields__", ()))
        for key, value in options.items():
            if key not in known:
                raise InputError(key, value=value, rule=f"is no option of {self.argument}={choice!r}", choices=known)
        return config(**options)

    def name_of(self, config: Config) -> str:
        """Name that the class of a configuration is registered by; the class's own otherwise."""
        for name in self.names:
            entry = self._classes[name]
            if isinstance(entry, str):
                module, _, attribute = entry.partition(":")
                if (type(config).__module__, type(config).__qualname__) == (module, attribute):
                    return name
            elif entry is type(config):
                return name
        return type(config).__name__
