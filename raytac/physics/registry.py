"""Physics of the gel by name, and which one a scene is pressed with."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

from raytac.checks import check_methods
from raytac.errors import InputError, SpecError
from raytac.physics.base import PhysicsConfig
from raytac.registry import Registry
from raytac.specs.press import PADS

PHYSICS: Registry[PhysicsConfig] = Registry(
    "physics", {"rigid": "raytac.physics.configs:Rigid", "ipc": "raytac.physics.configs:Ipc"}
)
register = PHYSICS.register


def checked_physics(physics: str | PhysicsConfig | None) -> PhysicsConfig | None:
    """Configuration of a name, or itself; None stays None. ``InputError`` for all else."""
    if physics is None:
        return None
    config = PHYSICS.config(physics)
    check_methods(
        "physics", config, ("build",), ("label", "is_simulated"), f"one of {', '.join(PHYSICS.names)}, or a configuration"
    )
    return config


def rigid_physics(physics: str | PhysicsConfig | None) -> PhysicsConfig | None:
    """As ``checked_physics``, for loops that step no solver; ``InputError`` for soft pads."""
    config = checked_physics(physics)
    if config is not None and config.is_simulated:
        rule = "must be rigid where somebody else steps MuJoCo: soft pads are stepped with the world, by TactileWorld with a task scene"
        raise InputError("physics", value=physics, rule=rule, choices=("rigid",))
    return config


class _Scene(Protocol):
    """Physics named by a press, a task or a sweep."""

    @property
    def physics(self) -> str | None: ...

    @property
    def pad(self) -> str | None: ...

    @property
    def source(self) -> Path | None: ...


def scene_physics(physics: PhysicsConfig | None, scene: _Scene) -> PhysicsConfig:
    """Physics of a scene: as asked for, else as the scene names, else ``rigid``.

    A ``level`` that is not given is the scene's, else the coarsest.

    Raises ``SpecError``: the scene names a physics that is not known; names file, key and choices.
    """
    if physics is None:
        try:
            physics = PHYSICS.config(scene.physics or "rigid")
        except InputError as error:
            raise SpecError(error.rule, file=scene.source, key="physics", value=error.value, choices=error.choices) from error
    options: dict[str, Any] = {"level": scene.pad or PADS[0]}
    return replace(physics, **options) if getattr(physics, "level", "") is None else physics  # type: ignore[type-var]
