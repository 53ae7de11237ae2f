"""How fast is the soft pad, and how far off? Time of press steps with their image, height and force of each level, imprint depth, forces.

    python experiments/bench_soft.py --out runs/bench_soft                         # a few minutes on two cores
    python experiments/bench_soft.py --levels coarse,medium,fine --refined --out runs/bench_soft
    python experiments/bench_soft.py --levels coarse --against ../raytac_b682ef2    # steps in turn with another checkout's, on the CPU

A ball (3.155 mm, the scene "sphere") is pressed 0.8 mm into the GelSight Mini's pad in eight steps of 0.1 mm.

- ``soft.<level>.steps_per_s``: solver step, reading and ``fast`` image at the sensor's resolution; median of the steps in contact, over
  ``--presses`` presses, the first not counted (it compiles). ``…best_steps_per_s``: the fastest press, for a machine that others use too.
- ``soft.<level>.height_um``, ``…around_um``: root mean square of the height against the refined solution where that touches (nearly 0 by
  construction: every level is laid on the same object there), and within 3 mm of the axis where it does not; ``--refined`` computes it
  (29,000 vertices; minutes), else the last level asked for stands in.
- ``soft.<level>.imprint_error``: deepest imprint against the commanded depth. ``…force_n``: what the depth takes, beside ``law.force_n`` of
  the bonded layer (Dimitriadis et al. 2002), which is an approximation itself.
- ``soft.<level>.force_error.ball``, ``….cylinder``, ``….punch``: force at a depth over that of the fine level, less 1, and
  ``soft.fine.force_n.<tool>`` itself: a ball of 3.155 mm 0.8 mm deep, a lying cylinder of 4 mm by 10 mm 0.5 mm deep, and the flat end of
  one of 1.5 mm 0.3 mm deep, on the pad without its dome and without friction, at a place (0.13, 0.09) mm off the middle that is on no
  symmetry of a mesh. The stand-off is taken out: the tool is lower by the mean gap, weighted by force, than the depth. Beside them what
  they cost: ``soft.<level>.solver_ms`` (a step of 0.1 mm, ball; processor time, on CUDA wall time), ``….newton`` and ``….pcg`` a step, and
  ``….least_det_f`` over the three. ``….drag.newton``, ``.pcg`` a step and ``.unconverged`` steps of a flat face of 3 mm that is dragged
  0.6 mm deep over the domed pad, without friction. ``--forces`` leaves everything else out. ``--study`` adds ``soft.study.<name>.*`` of
  other gradings and volume blocks, and of the coarse and medium levels at four other places.
- ``force.driven_error``, ``force.weight_error``: force on the case (bonded vertices) when 1 N is asked for; force on the coat under a free
  object of 0.3 N.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

import ipc
from experiments.running import recorded, run
from experiments.turns import in_turn
from raytac.device import resolve_device
from raytac.errors import InputError
from raytac.io import CommonOptions, Metric, parse_names
from raytac.physics import PAD_LEVELS, Ipc, PadLevel, SoftPad, object_parts, pad_body, pad_mesh, scene_body
from raytac.sensor import TactileSensor
from raytac.specs import PADS, GelpadSpec, ObjectSpec, PressScene, SensorSpec, StageSpec, load_press, load_sensor

DEPTH, STEPS = 0.8e-3, 8
REFINED = PadLevel(0.45e-3, 10, 5.0, 3.0, 1e-5)
"""Cells of 0.2 mm in the middle, 10 layers."""
AROUND = 3e-3
TOOLS = {
    "ball": (ObjectSpec("sphere", {"radius": 3.155e-3}, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0.05), 0.8e-3),
    "cylinder": (
        ObjectSpec("cylinder", {"radius": 4e-3, "length": 10e-3}, (0.0, 0.0, 0.0), (0.5**0.5, 0.0, 0.5**0.5, 0.0), 0.05),
        0.5e-3,
    ),
    "punch": (ObjectSpec("cylinder", {"radius": 1.5e-3, "length": 5e-3}, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0.05), 0.3e-3),
}
"""Tools of the force errors and their depths [m]."""
OFF_CENTRE = 0.13e-3, 0.09e-3
STEP = 1e-4
COARSE, MEDIUM = PAD_LEVELS["coarse"], PAD_LEVELS["medium"]
STUDY = {
    "coarse_2.5_plain": replace(COARSE, spread=2.5, layer_spread=2.0, block=None),
    "coarse_6_plain": replace(COARSE, layer_spread=2.0, block=None),
    "coarse_2.5_blocks": replace(COARSE, spread=2.5, layer_spread=2.0),
    "coarse_4_blocks": replace(COARSE, spread=4.0, layer_spread=2.5),
    "coarse_6_blocks_0": replace(COARSE, own_volume=0.0),
    "coarse_6_blocks_0.5": replace(COARSE, own_volume=0.5),
    "coarse_6_blocks_1": replace(COARSE, own_volume=1.0),
    "medium_plain": replace(MEDIUM, block=None),
    "medium_blocks_0": replace(MEDIUM, own_volume=0.0),
    "medium_blocks_0.25": replace(MEDIUM, own_volume=0.25),
    "medium_blocks_2": replace(MEDIUM, own_volume=2.0),
    "medium_2_layers": replace(MEDIUM, block=(2, 2, 2)),
    "medium_4_blocks": replace(MEDIUM, spread=4.0),
}
"""Gradings, blocks and λ'/μ beside those of the levels."""
PLACES = (-0.31e-3, 0.22e-3), (0.6e-3, -0.4e-3), (2.1e-3, 1.3e-3), (4.13e-3, 3.09e-3)


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Measure the soft pad."""

    levels: Annotated[str, tyro.conf.arg(metavar="{" + ",".join(PADS) + "}")] = "coarse,medium"
    """Levels to measure, joined by commas."""
    presses: int = 1
    """Presses that are timed, after one that is not."""
    refined: bool = False
    """Compute the refined solution."""
    forces: bool = False
    """Measure the force errors of the levels against the fine one, and nothing else."""
    study: bool = False
    """Measure the same for other gradings and volume blocks than the levels have."""
    against: Path | None = None
    """Checkout of another commit: only steps with image in turn with its own, on the CPU, GelSight Mini (``turns.py``)."""
    sensor: str = "gelsight_mini"
    """Name of a shipped sensor, or path of a sensor file."""

    def run(self) -> None:
        levels = parse_names(self.levels, "levels")
        for level in levels:
            if level not in PADS:
                raise InputError("levels", value=level, rule="must be a known level", choices=PADS)
        with recorded(self, "bench_soft", owned=("metrics.json",), packages=("warp-lang",)) as (_, metrics):
            if self.against is not None:
                metrics |= in_turn(self.against, {f"soft.{level}": f"pad:{level}" for level in levels})
                return
            spec = load_sensor(self.sensor)
            device = resolve_device(self.device, ray_tracing=False)
            metrics |= force_errors(spec.gelpad, levels, device)
            if self.study:
                fine = {tool: float(metrics[f"soft.fine.force_n.{tool}"]) for tool in TOOLS}
                metrics |= studied(spec.gelpad, fine, device)
            if not self.forces:
                metrics |= measured(spec, levels, self.refined, self.presses, self.device, self.seed)
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
                np.asarray(frame.rgb)  # waits for it
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


def force_errors(gelpad: GelpadSpec, levels: tuple[str, ...], device: str) -> dict[str, Metric]:
    """Force of every tool on each level against the fine one, and the cost of it."""
    flat = replace(gelpad, dome_radius=(math.inf, math.inf))
    found: dict[str, Metric] = {}
    fine: dict[str, float] = {}
    for level in ["fine", *(level for level in levels if level != "fine")]:
        least = 1.0
        for tool in TOOLS:
            force, cost = pressed(flat, level, tool, device)
            least = min(least, cost.pop("least_det_f"))
            if level == "fine":
                fine[tool] = found[f"soft.fine.force_n.{tool}"] = force
            else:
                found[f"soft.{level}.force_error.{tool}"] = force / fine[tool] - 1.0
            if tool == "ball":
                found |= {f"soft.{level}.{name}": value for name, value in cost.items()}
        found[f"soft.{level}.least_det_f"] = least
        if level != "fine":
            found |= {f"soft.{level}.drag.{name}": value for name, value in dragged(gelpad, level, device).items()}
        print(f"{level}: pressed by {', '.join(TOOLS)}", flush=True)
    return found


def studied(gelpad: GelpadSpec, fine: dict[str, float], device: str) -> dict[str, Metric]:
    """Force errors and costs of ``STUDY``, and of the coarse and medium levels at ``PLACES``."""
    flat = replace(gelpad, dome_radius=(math.inf, math.inf))
    runs = [(name, level, OFF_CENTRE) for name, level in STUDY.items()]
    runs += [(f"coarse_at_{1e3 * x:.2f}_{1e3 * y:.2f}", COARSE, (x, y)) for x, y in PLACES]
    runs += [(f"medium_at_{1e3 * x:.2f}_{1e3 * y:.2f}", MEDIUM, (x, y)) for x, y in PLACES]
    runs += [(f"plain_at_{1e3 * x:.2f}_{1e3 * y:.2f}", STUDY["coarse_2.5_plain"], (x, y)) for x, y in PLACES]
    found: dict[str, Metric] = {}
    for name, level in STUDY.items():
        found |= {f"soft.study.{name}.drag.{key}": value for key, value in dragged(gelpad, level, device).items()}
    for name, level, place in runs:
        for tool in TOOLS:
            force, cost = pressed(flat, level, tool, device, place)
            found[f"soft.study.{name}.force_error.{tool}"] = force / fine[tool] - 1.0
            found |= {f"soft.study.{name}.{tool}.{key}": value for key, value in cost.items()}
        print(f"study: {name}", flush=True)
    return found


def pressed(
    gelpad: GelpadSpec, level: str | PadLevel, tool: str, device: str, place: tuple[float, float] = OFF_CENTRE
) -> tuple[float, dict[str, float]]:
    """Normal force of a tool [N] at its depth without the stand-off, and what its steps cost."""
    thing, depth = TOOLS[tool]
    world, start = under_tool(gelpad, level, thing, place, device)

    def step(height: float) -> ipc.StepReport:
        world.set_target("tool", (*place, height))
        report = world.step()
        if not report.converged[0]:
            raise ArithmeticError(f"{level}: the {tool} at {height} m did not converge")
        return report

    steps = math.ceil((depth + start) / STEP)
    step(start)  # compiles
    clock = time.process_time if device == "cpu" else time.perf_counter
    began = clock()
    reports = [step(start - (depth + start) * k / steps) for k in range(1, steps + 1)]
    seconds = clock() - began
    for _ in range(4):
        pairs = world.contacts()
        reports.append(step(float(pairs.gap @ pairs.force) / float(pairs.force.sum()) - depth))
    cost = {
        "solver_ms": 1e3 * seconds / steps,
        "newton": sum(float(r.newton[0]) for r in reports[:steps]) / steps,
        "pcg": sum(float(r.linear[0]) for r in reports[:steps]) / steps,
        "least_det_f": min(float(r.min_det[0]) for r in reports),
    }
    return float(world.wrench("tool").force[0, 2]), cost


def under_tool(
    gelpad: GelpadSpec, level: str | PadLevel, thing: ObjectSpec, place: tuple[float, float], device: str
) -> tuple[ipc.World, float]:
    """A pad without friction under a driven tool, and the height of the tool's lowest point [m]."""
    mesh = pad_mesh(gelpad, level)
    solid = scene_body("tool", object_parts(thing), "kinematic", sag=0.1 * mesh.d_hat).solid
    assert isinstance(solid, ipc.KinematicBody)
    surface = solid.surface
    vertices = surface.vertices @ ipc.rotation_matrix(thing.quaternion).T
    vertices[:, 2] -= vertices[:, 2].min()
    start = 1.2 * mesh.d_hat
    body = ipc.KinematicBody("tool", ipc.TriMesh(vertices, surface.faces), ipc.Pose((*place, start)))
    settings = ipc.Settings(d_hat=mesh.d_hat, velocity_tolerance=5e-5)
    return ipc.World([pad_body(mesh, gelpad), body], settings, device=device), start


def dragged(gelpad: GelpadSpec, level: str | PadLevel, device: str) -> dict[str, float]:
    """What six steps take in which a flat face of 3 mm, 0.6 mm deep, is dragged by 0.1 mm each, without friction."""
    face = ObjectSpec("cylinder", {"radius": 3e-3, "length": 4e-3}, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0.05)
    world, start = under_tool(gelpad, level, face, (0.0, 0.0), device)
    reports = []
    for k in range(1, 14):
        world.set_target("tool", (0.0, STEP * max(k - 7, 0), start - (6 * STEP + start) * min(k, 7) / 7))
        reports.append(world.step())
    return {
        "newton": sum(float(r.newton[0]) for r in reports[7:]) / 6,
        "pcg": sum(float(r.linear[0]) for r in reports[7:]) / 6,
        "unconverged": sum(int(not r.converged[0]) for r in reports),
    }


def layer_law(spec: SensorSpec) -> float:
    from raytac.physics import RigidPad

    pad = RigidPad(spec, ball(StageSpec("indent", depth=DEPTH)), pitch=0.05e-3)
    return float(pad.peak(pad.run()).normal_force[0])


if __name__ == "__main__":
    run(Args.run, Args)
