"""The pad under a scene's object, rigid or simulated, and what its states tell: surface and forces."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from raytac.device import resolve_device
from raytac.errors import InputError
from raytac.gel.surface import GelSurface
from raytac.gel.traction import cell_areas
from raytac.physics.base import PadReading
from raytac.physics.soft.availability import check_solver
from raytac.physics.soft.contact_width import cells_across
from raytac.specs import PressScene, SensorSpec

if TYPE_CHECKING:
    from raytac.physics.base import ContactState
    from raytac.physics.rigid.pad import RigidPad
    from raytac.physics.soft.mesh import PadMesh
    from raytac.physics.soft.pad import SoftPad

__all__ = ["load_pad", "pad_forces", "reading_forces", "state_surface"]


def load_pad(
    spec: SensorSpec, press: PressScene, *, physics: str, level: str | PadMesh, device: str, **settings: Any
) -> RigidPad | SoftPad:
    """The pad with the scene's object before it.

    Args:
        spec: the sensor.
        press: the scene.
        physics: ``rigid`` or ``ipc``.
        level: how finely a simulated pad is cut, or a mesh of one's own.
        device: of the solver, which traces no rays and needs no OptiX.
        settings: ``pitch``, ``num_envs``, ``seed`` and what ``PressTargets`` takes, of both pads.

    Raises:
        BackendError: the solver cannot run here.
        RaytacError: as the pad's own constructor.
    """
    if physics == "ipc":
        check_solver("physics='ipc'")
        from raytac.physics.soft.pad import SoftPad

        return SoftPad(spec, press, pad=level, device=resolve_device(device, ray_tracing=False), **settings)
    from raytac.physics.rigid.pad import RigidPad

    return RigidPad(spec, press, **settings)


def state_surface(pad: RigidPad | SoftPad | None, state: ContactState) -> GelSurface:
    """Surface of a state.

    Raises:
        InputError: no state, none of this pad's scene, or there is no pad.
    """
    if not hasattr(state, "pad_from_object"):
        raise InputError(
            "state", value=type(state).__name__, rule="must be a GelSurface, or a state of the physics that load() returned"
        )
    if pad is None:
        raise InputError("state", value=type(state).__name__, rule="needs a scene: call load() first, or give a GelSurface")
    if state.scene is not None and state.scene != pad.scene:
        rule = f"belongs to the scene {state.scene.name!r}, and {pad.scene.name!r} was loaded since"
        raise InputError("state", value=type(state).__name__, rule=rule)
    return pad.surface(state)  # type: ignore[arg-type]


def pad_forces(
    pad: RigidPad | SoftPad, state: ContactState, surface: GelSurface, outputs: tuple[str, ...]
) -> dict[str, np.ndarray | Any]:
    """``wrench``, ``traction`` and, with either, ``contact_area`` and (of a simulated pad) ``contact_cells`` of a state, as far as
    ``outputs`` ask for them."""
    found: dict[str, Any] = {}
    if "wrench" in outputs:
        found["wrench"] = pad.wrench(state)  # type: ignore[arg-type]
    if "traction" in outputs:
        found["traction"] = pad.traction(state)  # type: ignore[arg-type]
    return found | (_contact_size(surface, state.failed) if found else {})


def reading_forces(reading: PadReading, outputs: tuple[str, ...]) -> dict[str, np.ndarray | Any]:
    """The same of what a world's pad reads."""
    found: dict[str, Any] = {}
    if "wrench" in outputs:
        found["wrench"] = reading.wrench
    if "traction" in outputs:
        found["traction"] = reading.traction()
    return found | (_contact_size(reading.surface, reading.failed) if found else {})


def _contact_size(surface: GelSurface, failed: np.ndarray) -> dict[str, np.ndarray]:
    """``contact_area`` and, of a simulated pad, ``contact_cells``."""
    area = cell_areas(surface.grid)
    found = {"contact_area": np.where(failed, np.nan, [float(area[one].sum()) for one in surface.contact])}
    if surface.coat is not None:
        found["contact_cells"] = np.where(failed, np.nan, cells_across(surface, surface.coat.mesh))
    return found
