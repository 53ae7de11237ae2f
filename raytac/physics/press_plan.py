"""What every pad needs to know of a press before it starts: parts, a trajectory that can be, poses, and which state is imaged."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TypeVar

import numpy as np

from raytac.checks import check_numbers
from raytac.errors import InputError, MeshError, SpecError
from raytac.gel.part import Part
from raytac.physics.contact_state import ContactState
from raytac.physics.objects import object_parts
from raytac.specs.press import PressScene
from raytac.specs.sensor import GelpadSpec

__all__ = ["CLEARANCE", "MOST_STEPS", "about_z", "check_trajectory", "peak_state", "per_environment", "scene_parts"]

CLEARANCE = 1e-3
"""Height above first touch [m] at which an object waits before the press and after a release."""
MOST_STEPS = 1_000_000
"""States that a stage can be asked for."""
_State = TypeVar("_State", bound=ContactState)


def scene_parts(scene: PressScene) -> tuple[Part, ...]:
    """Parts of the scene's object; raises ``SpecError`` with the scene's file and key."""
    try:
        return object_parts(scene.object)
    except MeshError:  # names its own file
        raise
    except SpecError as error:
        raise SpecError(error.rule, file=scene.source, key=error.key, value=error.value, choices=error.choices) from error


def check_trajectory(scene: PressScene, gelpad: GelpadSpec, parts: Sequence[Part], depths: np.ndarray | None) -> None:
    """Refuse stages that no pad of this thickness can follow.

    Raises:
        SpecError: names the scene's file and key.
        InputError: ``depths`` [m] deeper than the pad.
    """
    thickness = gelpad.thickness
    within = f"must be > 0 and less than the pad's thickness, {thickness * 1e3:.4g} mm"
    if scene.trajectory and not parts:
        rule = "a scene without object must have no trajectory"
        raise SpecError(rule, file=scene.source, key="object.kind", value=scene.object.kind)
    for index, stage in enumerate(scene.trajectory):
        key = f"trajectory[{index}]"
        if stage.depth is not None and not 0.0 < stage.depth < thickness:
            raise SpecError(within, file=scene.source, key=f"{key}.depth_mm", value=stage.depth * 1e3)
    if depths is not None:
        bad = depths[np.isfinite(depths) & ~((depths > 0.0) & (depths < thickness))]
        if len(bad):
            raise InputError("depths [mm]", value=float(bad[0]) * 1e3, rule=within)


def peak_state(scene: PressScene, states: Iterable[_State]) -> _State:
    """First of ``states`` at the end of the scene's peak stage (the start, if it has none); later ones are not computed."""
    for state in states:
        if state.stage == scene.peak_stage and state.fraction == 1.0:
            return state
    raise InputError("states", value=scene.peak_stage, rule="hold no state at the end of the scene's peak stage")


def per_environment(name: str, values: np.ndarray | None, shape: tuple[int, ...]) -> np.ndarray:
    """``values`` as an array, zeros for None; raises ``InputError`` for another shape, or what is no number."""
    return np.zeros(shape) if values is None else check_numbers(name, values, shape)


def about_z(angle: float) -> np.ndarray:
    """Rotation by ``angle`` [rad] about z, (3, 3)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
