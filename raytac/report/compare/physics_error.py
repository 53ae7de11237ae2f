"""Error of the rigid pad against the soft pad on the same presses: height and image."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from raytac.errors import RaytacError
from raytac.gel.surface import GelSurface
from raytac.io.metrics import Metric
from raytac.physics import Ipc, Rigid
from raytac.report.image_error import mae, regions
from raytac.report.tracers import Tracers
from raytac.sensor import TactileSensor
from raytac.specs import load_press


@dataclass(frozen=True)
class PhysicsError:
    """Differences of one press on both pads: RMS of height [µm], MAE of ``fast`` [levels]."""

    scene: str
    resolution: str
    pad: str
    """Mesh level of the soft pad, against which the rigid one is measured."""
    contact_um: float
    """Height where either touches."""
    ring_um: float
    """Height in the ring around that, as wide as the images' shadow ring."""
    pad_um: float
    """Height of all that neither touches."""
    bulge_um: float
    """Greatest rise of the soft gel beside the press; that of the Gaussians never rises."""
    contact_levels: float
    ring_levels: float
    frame_levels: float
    rigid_s: float
    soft_s: float
    """Time of the whole press, without images [s]."""


def physics_errors(
    tracers: Tracers, scenes: Sequence[str | Path], size: tuple[int, int], pad: str, surfaces: dict[str, GelSurface]
) -> tuple[PhysicsError, ...]:
    """Press every scene into the soft pad and compare.

    Args:
        size: (width, height) of the images [px].
        pad: level of the soft pad.
        surfaces: the rigid pad's, by name of scene.

    Raises:
        RaytacError: a press did not settle on the soft pad.
        BackendError: the solver cannot run here.
    """
    tracer, errors = tracers.get(size), []
    settings = {"outputs": ("height",), "resolution": size, "device": "cpu", "seed": tracers.seed}
    for scene in scenes:
        press, seconds = load_press(scene), []
        for physics in (Rigid(), Ipc(level=pad)):
            start = time.perf_counter()
            sensor = TactileSensor(tracers.spec, physics=physics, **settings)
            frame = sensor.press(press, progress=True)
            seconds.append(time.perf_counter() - start)
        if frame.failed[0]:
            raise RaytacError(f"the press {press.name!r} did not settle on the {pad} pad")
        rigid, soft = surfaces[press.name], frame.surface
        touched = rigid.contact[0] | soft.contact[0]
        ring = regions(touched, soft.grid.pitch)["ring"]
        off = 1e6 * (rigid.height[0].astype(float) - soft.height[0])
        one, two = (tracer.render(surface).rgb for surface in (rigid, soft))
        assert one is not None and two is not None
        masks = [tracers.regions(size, surface) for surface in (rigid, soft)]
        contact, around = (masks[0][name] | masks[1][name] for name in ("contact", "ring"))
        around = around & ~contact
        errors.append(
            PhysicsError(
                press.name,
                f"{size[0]}x{size[1]}",
                pad,
                _rms(off[touched]),
                _rms(off[ring]),
                _rms(off[~touched]),
                -1e6 * float(soft.indentation.min()),
                mae(one[0][contact], two[0][contact]) if contact.any() else float("nan"),
                mae(one[0][around], two[0][around]) if around.any() else float("nan"),
                mae(one[0], two[0]),
                *seconds,
            )
        )
    return tuple(errors)


def physics_metrics(errors: Sequence[PhysicsError]) -> dict[str, Metric]:
    """``physics.<pad>.<resolution>.<figure>.<scene>`` of every finite figure."""
    names = [name for name in PhysicsError.__dataclass_fields__ if name not in ("scene", "resolution", "pad")]
    return {
        f"physics.{e.pad}.{e.resolution}.{name}.{e.scene}": asdict(e)[name]
        for e in errors
        for name in names
        if np.isfinite(asdict(e)[name])
    }


def _rms(off: np.ndarray) -> float:
    return float(np.sqrt(np.mean(off**2))) if len(off) else float("nan")
