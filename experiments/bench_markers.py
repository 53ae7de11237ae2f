"""How long do markers take? 99 dots on a pressed pad, by model and by number of environments.

    python experiments/bench_markers.py --out runs/bench_markers
    python experiments/bench_markers.py --device cuda --envs 1,64,1024 --models fots

A frame is everything from a surface to displacements in metres and pixels: sampling the contact, following the object since first touch,
the model, height and projection. The press is a ball of 4 mm radius, sheared and turned, on the pattern of 9 x 11; surfaces are given, as
are the coat's vertices of a medium pad: what physics costs comes on top. Medians; on a machine that others use, the least says more.
"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, replace

import numpy as np

from experiments.running import recorded, run
from raytac.errors import InputError
from raytac.gel import DeformedCoat, GelSurface
from raytac.io import CommonOptions
from raytac.markers import MARKERS, MarkerTracker
from raytac.physics import RigidPad, pad_mesh
from raytac.report import machine
from raytac.specs import MarkerMotionSpec, ObjectSpec, PressScene, PunchSpec, SensorSpec, StageSpec, load_sensor

NAMES = {"surface": "surface_markers"}
"""Model to the first word of its keys, where that differs."""


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Time a frame of markers."""

    sensor: str = "gelsight_mini_9x11"
    """Sensor with markers."""
    envs: str = "1,64"
    """Numbers of environments, joined by commas."""
    models: str = ",".join(MARKERS.names)
    """Models, joined by commas."""
    frames: int = 200
    """Frames of one environment that are timed, after a tenth as many to warm up; batches time fewer."""


def pressed(sensor: SensorSpec, envs: int) -> list[GelSurface]:
    """A ball pressed 0.8 mm deep, sheared 0.3 mm and turned 5 degrees: states along the way, each environment at its own place."""
    target = ObjectSpec("sphere", {"radius": 4e-3}, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0.1)
    stages = (StageSpec("indent", depth=0.8e-3), StageSpec("shear", shear=(0.3e-3, 0.0)), StageSpec("twist", twist=0.087))
    offsets = np.linspace(-3e-3, 3e-3, envs)[:, None] * (1.0, 0.5) if envs > 1 else None
    few = min(envs, 8)
    pad = RigidPad(
        sensor,
        PressScene("bench", target, stages),
        pitch=0.1e-3,
        num_envs=few,
        offsets=None if offsets is None else offsets[:: max(1, envs // 8)][:few],
    )
    coat = pad_mesh(sensor.gelpad, "medium").coat
    rng = np.random.default_rng(0)
    found = []
    for state in pad.run(steps_per_stage=2):
        surface = state.surface
        rows = np.arange(envs) % few
        positions = coat.rest[None] + 1e-4 * rng.standard_normal((envs, *coat.rest.shape))
        pose = np.asarray(surface.pad_from_object)[rows]
        found.append(
            GelSurface(
                surface.grid,
                surface.height[rows],
                surface.contact[rows],
                surface.contact_centre[rows],
                pose,
                coat=DeformedCoat(coat, positions),
            )
        )
    return found


def measure(model: str, sensor: SensorSpec, surfaces: list[GelSurface], args: Args) -> tuple[list[float], str]:
    """Times of frames per environment [ms], after warming up, and the device."""
    envs = surfaces[0].batch
    tracker = MarkerTracker(sensor, model, surfaces[0].grid, num_envs=envs, device=args.device)
    count = max(10, args.frames // envs)
    times = []
    for k in range(count + max(3, count // 10) + len(surfaces)):
        if k % 50 == 0:
            tracker.reset()
        # There and back along the press, always in contact but for the first.
        surface = surfaces[k] if k < len(surfaces) else surfaces[1 + k % (len(surfaces) - 1)]
        start = time.perf_counter()
        tracker.update(surface)
        times.append(1e3 * (time.perf_counter() - start) / envs)
    return times[-count:], tracker.model.device


def main(args: Args) -> None:
    texts, models = args.envs.split(","), args.models.split(",")
    if not all(text.strip().isdecimal() and int(text) for text in texts):
        raise InputError("envs", value=args.envs, rule="must be whole numbers >= 1, joined by commas")
    for model in models:
        if model not in MARKERS.names:
            raise InputError("models", value=model, rule="must be known marker models, joined by commas", choices=MARKERS.names)
    if args.frames < 1:
        raise InputError("frames", value=args.frames, rule="must be at least 1")
    sensor = load_sensor(args.sensor)
    if sensor.marker_motion is None:  # its constants do not change the time much; their order of magnitude does
        motion = MarkerMotionSpec(
            2.5e6, 1.6e4, 3.5e4, 1e-3, 9e4, 0.5, 0.2, 5.0, 1.0, "for timing", PunchSpec(0.7, 7e-3, 1.3e3, 2.5e6, 1.6e4)
        )
        sensor = replace(sensor, marker_motion=motion)
    with recorded(args, "bench_markers", device=args.device, owned=("metrics.json",), packages=("warp-lang",)) as (_, metrics):
        count = sensor.markers.rows * sensor.markers.columns
        metrics |= {"sensor": sensor.name, "markers": count, "cores": os.cpu_count() or 1, **machine()}
        for envs in map(int, texts):
            surfaces = pressed(sensor, envs)
            for model in models:
                times, device = measure(model, sensor, surfaces, args)
                key = NAMES.get(model, model) + (f".x{envs}" if envs > 1 else "")
                metrics |= {
                    f"{key}.ms_per_frame": float(np.median(times)),
                    f"{key}.ms_per_frame_least": float(np.min(times)),
                    f"{key}.device": device,
                }
                print(
                    f"{model:14} {envs:5d} environments  {np.median(times):8.3f} ms a frame  (least {np.min(times):.3f})  on {device}"
                )


if __name__ == "__main__":
    run(main, Args)
