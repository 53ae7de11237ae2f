"""How fast is the soft pad, and how far off? Time of press steps with their image, height and force of each level, imprint depth, forces.

    python experiments/bench_soft.py --out runs/bench_soft                         # a few minutes on two cores
    python experiments/bench_soft.py --levels coarse,medium,fine --refined --out runs/bench_soft

A ball (3.155 mm, the scene "sphere") is pressed 0.8 mm into the GelSight Mini's pad in eight steps of 0.1 mm.

- ``soft.<level>.steps_per_s``: solver step, reading and ``fast`` image at the sensor's resolution; median of the steps in contact, over
  ``--presses`` presses, the first not counted (it compiles). ``…best_steps_per_s``: the fastest press, for a machine that others use too.
- ``soft.<level>.height_um``, ``…around_um``: root mean square of the height against the refined solution where that touches (nearly 0 by
  construction: every level is laid on the same object there), and within 3 mm of the axis where it does not; ``--refined`` computes it
  (29,000 vertices; minutes), else the last level asked for stands in.
- ``soft.<level>.imprint_error``: deepest imprint against the commanded depth. ``…force_n``: what the depth takes, beside ``law.force_n`` of
  the bonded layer (Dimitriadis et al. 2002), which is an approximation itself.
- ``force.driven_error``, ``force.weight_error``: force on the case (bonded vertices) when 1 N is asked for; force on the coat under a free
  object of 0.3 N.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import tyro

from experiments.running import recorded, run
from raytac.errors import InputError
from raytac.io import CommonOptions, Metric, parse_names
from raytac.physics import Ipc, PadLevel, SoftPad, pad_mesh
from raytac.sensor import TactileSensor
from raytac.specs import PADS, PressScene, SensorSpec, StageSpec, load_press, load_sensor

DEPTH, STEPS = 0.8e-3, 8
REFINED = PadLevel(0.45e-3, 10, 5.0, 3.0, 1e-5)
"""Cells of 0.2 mm in the middle, 10 layers."""
AROUND = 3e-3


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Measure the soft pad."""

    levels: Annotated[str, tyro.conf.arg(metavar="{" + ",".join(PADS) + "}")] = "coarse,medium"
    """Levels to measure, joined by commas."""
    presses: int = 1
    """Presses that are timed, after one that is not."""
    refined: bool = False
    """Compute the refined solution."""
    sensor: str = "gelsight_mini"
    """Name of a shipped sensor, or path of a sensor file."""

    def run(self) -> None:
        levels = parse_names(self.levels, "levels")
        for level in levels:
            if level not in PADS:
                raise InputError("levels", value=level, rule="must be a known level", choices=PADS)
        with recorded(self, "bench_soft", owned=("metrics.json",), packages=("warp-lang",)) as (_, metrics):
            metrics |= measured(load_sensor(self.sensor), levels, self.refined, self.presses, self.device, self.seed)
        for key, value in metrics.items():
            if not key.startswith("versions"):
                print(f"{key} = {value:.5g}" if isinstance(value, float) else f"{key} = {value}")


def ball(*stages: StageSpec, dynamics: str = "kinematic") -> PressScene:
    scene = load_press("sphere")
    return replace(scene, trajectory=stages, object=replace(scene.object, dynamics=dynamics))


def measured(spec: SensorSpec, levels: tuple[str, ...], refined: bool, presses: int, device: str, seed: int) -> dict[str, Metric]:
    metrics: dict[str, Metric] = {}
    heights, touched = {}, {}
    scene = ball(StageSpec("indent", depth=DEPTH))
    for level in [*levels, *(["refined"] if refined else [])]:
        pad = pad_mesh(spec.gelpad, REFINED) if level == "refined" else level
        sensor = TactileSensor(spec, physics=Ipc(pad), device=device, seed=seed)
        metrics["device"] = sensor.device_used
        sensor.rest()
        loaded = sensor.load(scene)
        assert isinstance(loaded, SoftPad)
        seconds: list[list[float]] = []
        for _ in range(1 + (0 if level == "refined" else presses)):
            states = loaded.run(STEPS)
            next(states)
            seconds.append([])
            while True:
                began = time.perf_counter()
                state = next(states, None)
                if state is None:
                    break
                frame = sensor.update(state)
                seconds[-1].append(time.perf_counter() - began)
        timed = [float(np.median(press[1:])) for press in seconds[1:] or seconds]
        surface = frame.surface
        heights[level], touched[level] = surface.height[0].astype(float), surface.contact[0]
        print(f"{level}: {sum(map(len, seconds))} steps in {sum(map(sum, seconds)):.1f} s", flush=True)
        metrics |= {
            f"soft.{level}.vertices": len(loaded.mesh.tets.vertices),
            f"soft.{level}.steps_per_s": 1.0 / float(np.median(timed)),
            f"soft.{level}.best_steps_per_s": 1.0 / min(timed),
            f"soft.{level}.imprint_error": float(surface.indentation.max()) / DEPTH - 1.0,
            f"soft.{level}.force_n": -float(frame.force[0, 2]),
            f"soft.{level}.contact_area_mm2": 1e6
            * float(surface.contact[0].sum())
            * surface.grid.pitch[0]
            * surface.grid.pitch[1],
        }
        grid = surface.grid
    truth = "refined" if refined else levels[-1]
    near = np.hypot(grid.x[None, :], grid.y[:, None]) < AROUND
    for level in levels:
        if level == truth:
            continue
        off = 1e6 * (heights[level] - heights[truth])
        metrics[f"soft.{level}.height_um"] = float(np.sqrt((off[touched[truth]] ** 2).mean()))
        metrics[f"soft.{level}.around_um"] = float(np.sqrt((off[near & ~touched[truth]] ** 2).mean()))
    metrics["height.against"] = truth
    return metrics | forces(spec) | {"law.force_n": layer_law(spec)}


def forces(spec: SensorSpec) -> dict[str, Metric]:
    """Relative errors of the force on the case, coarse pad."""
    found: dict[str, Metric] = {}
    for key, force, dynamics in (("driven", 1.0, "kinematic"), ("weight", 0.3, "affine")):
        pad = SoftPad(spec, ball(StageSpec("indent", force=force), dynamics=dynamics), pitch=0.2e-3)
        borne = pad.peak(pad.run()).normal_force[0]
        assert pad.solver is not None
        if dynamics == "kinematic":  # under gravity the case bears the gel's own weight too
            borne = -pad.solver.world.wrench("pad").force[0, 2]
        found[f"force.{key}_error"] = float(borne) / force - 1.0
    return found


def layer_law(spec: SensorSpec) -> float:
    from raytac.physics import RigidPad

    pad = RigidPad(spec, ball(StageSpec("indent", depth=DEPTH)), pitch=0.05e-3)
    return float(pad.peak(pad.run()).normal_force[0])


if __name__ == "__main__":
    run(Args.run, Args)
