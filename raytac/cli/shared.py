"""Options and replies of several commands."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from raytac.errors import InputError
from raytac.io.options import CommonOptions
from raytac.physics.base import PhysicsConfig
from raytac.physics.registry import PHYSICS, scene_physics
from raytac.specs import PressScene, TaskScene
from raytac.warp_messages import has_compiled_kernels, quiet_warp


def named(names: Iterable[str]) -> object:
    """Names as the help shows the values of an option: ``{rigid,ipc}``."""
    return tyro.conf.arg(metavar="{" + ",".join(names) + "}")


def print_paths(paths: Iterable[Path]) -> int:
    """Print the files written, one a line; returns the exit code of success."""
    for path in paths:
        print(path)
    return 0


@contextmanager
def kept_if_interrupted(kept: str) -> Iterator[None]:
    """Let ``main`` print what Ctrl-C in the block leaves, and that the same command goes on."""
    try:
        yield
    except KeyboardInterrupt as stop:
        stop.add_note(f"{kept}; the same command goes on from there")
        raise


def chosen_physics(physics: str | None, level: str | None, scene: PressScene | TaskScene) -> PhysicsConfig:
    """Physics that ``--physics`` and ``--level`` name.

    With a level alone ``ipc``, with neither as the scene says, else ``rigid``.

    Raises ``InputError``: an unknown name, or a level of a physics that has none. SpecError: an unknown name in the scene.
    """
    if physics is None and level is None:
        return scene_physics(None, scene)
    return scene_physics(PHYSICS.config(physics or "ipc", **({} if level is None else {"level": level})), scene)


@dataclass(frozen=True, kw_only=True)
class SolverOptions(CommonOptions):
    """Options of a command that computes contacts."""

    verbose: bool = False
    """Let Warp, in which contacts are computed, list devices and the kernels that it loads."""

    def prepare_warp(self, *, soft: bool = False) -> None:
        """Call before contacts are first computed; ``soft``: pads are soft ones."""
        quiet_warp(not self.verbose)
        if not self.verbose and not has_compiled_kernels(solver=soft):
            logging.getLogger("raytac").info("compiling kernels: up to a minute, once on a machine")


@dataclass(frozen=True, kw_only=True)
class ShadowOptions:
    """Options of a command that renders: shadows, whatever the sensor file says."""

    shadows: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Cast shadows, of a sensor whose file says otherwise too."""
    no_shadows: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Cast none; as the sensor file says ([optics] shadows) if neither is given."""

    def chosen_shadows(self) -> dict[str, bool]:
        """``{"shadows": …}``; empty if the sensor decides. Raises ``InputError`` for both flags."""
        if self.shadows and self.no_shadows:
            raise InputError("shadows, no_shadows", value=(True, True), rule="contradict each other: give one")
        return {"shadows": self.shadows} if self.shadows or self.no_shadows else {}
