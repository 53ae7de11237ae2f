"""Choice of the engine that moves the bodies of a world, and the settings of MuJoCo Warp."""

from __future__ import annotations

from dataclasses import dataclass

from raytac.checks import check_known
from raytac.errors import InputError

ENGINES = ("mujoco", "mujoco_warp")
"""Names that ``TactileWorld(engine=…)`` accepts."""


@dataclass(frozen=True)
class WarpEngine:
    """Settings of MuJoCo Warp."""

    contacts: int | None = None
    """Memory for contacts, an environment; None is a guess.

    Too little is an error that names the number to set."""
    rows: int | None = None
    """Memory for constraint rows, an environment; None is a guess."""
    launches: int | None = None
    """Steps of MuJoCo in a control step, those of the scene or more; None is the scene's.

    With more, a world divides a step in which something moves fast near a pad."""


def checked_engine(engine: str | WarpEngine) -> WarpEngine | None:
    """Settings of MuJoCo Warp; None is C MuJoCo. Raises ``InputError`` for an unknown name."""
    if isinstance(engine, WarpEngine):
        return engine
    if not isinstance(engine, str):
        raise InputError("engine", value=type(engine).__name__, rule="must be a name or a WarpEngine", choices=ENGINES)
    check_known("engine", engine, ENGINES)
    return WarpEngine() if engine == "mujoco_warp" else None
