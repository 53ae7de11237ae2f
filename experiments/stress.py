"""Does any press break a pad? Random presses on the rigid and on the soft pad: exceptions, and unsound results that do not say so.

    python experiments/stress.py --out runs/stress                          # 300 rigid presses, 100 simulated ones on the coarse pad
    python experiments/stress.py --physics ipc --ipc 20 --seed 1 --out runs/stress_ipc
    python experiments/stress.py --physics ipc --ipc 60 --deepest 0.6 --out runs/stress_shallow

Every press is drawn by the seed and its own number: a shipped object as it is or scaled by 0.5 to 1.5, on the GelSight Mini or the domed
pad, anywhere on it and turned at random, to a depth or a force, then perhaps sheared and twisted, by moving the object or the case. Each
has its line of output and is recorded in ``rigid.json`` or ``ipc.json`` when it is done; an interrupted run goes on after its last press.

``metrics.json``: ``stress.<physics>.`` ``presses``, ``exceptions`` (any error but a refusal), ``refused`` (an ``InputError`` or
``SpecError`` that says why the pad cannot hold the press), ``failed`` (marked as failed), ``shallow`` and ``failed_shallow`` (presses to
at most 0.6 of the thickness, and how many of them failed). Of the rigid pad ``below_bond`` (surface below the gel's bonded face, not
marked) and ``unbalanced`` (traction and force differ by more than 0.1 %, not marked). Of the soft pad ``unmarked``: states that are
not finite, in which surfaces cross, or whose last step of the solver did not converge, and that are not marked as failed; each cause by
itself too, ``nonfinite``, ``penetrating``, ``unconverged``; and ``unconverged_steps`` of all presses.
"""

from __future__ import annotations

import time
import traceback
import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from experiments.running import resumed, run, store
from raytac.device import resolve_device
from raytac.errors import InputError, SpecError
from raytac.frame import TactileFrame
from raytac.gel import cell_areas
from raytac.io import CommonOptions, FolderLock, Metric, parse_names, versions, write_metrics
from raytac.physics import Ipc, SoftPad
from raytac.report import machine
from raytac.sensor import TactileSensor
from raytac.specs import PADS, ObjectSpec, PressScene, StageSpec, load_press, load_sensor, validate_press

SENSORS = ("gelsight_mini", "gelsight_dome")
OBJECTS = ("sphere", "cylinder", "edge", "cone", "torus", "pins", "coin", "mesh", "soft_ball")
"""Shipped scenes whose objects are pressed; a soft one on the soft pad alone."""
SHALLOW = 0.6
"""Share of the thickness that a pad should hold anywhere."""
PHYSICS = ("rigid", "ipc")
DEEP = {"rigid": 0.5, "ipc": 0.2}
"""Share of the presses that go deeper."""
BALANCE = 1e-3
Row = dict[str, object]


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Random presses on both pads."""

    physics: str = ",".join(PHYSICS)
    """Which pads, joined by commas."""
    rigid: int = 300
    """Presses on the rigid pad."""
    ipc: int = 100
    """Presses on the soft pad."""
    pad: str = PADS[0]
    """How finely the soft pad is cut."""
    deepest: float = 0.999
    """Depth of the deepest press as a share of the pad's thickness; beyond 0.6 go one in two rigid presses and one in five others."""


def main(args: Args) -> dict[str, Metric]:
    """Press what is missing and write ``metrics.json``."""
    start = time.perf_counter()
    names = parse_names(args.physics, "physics", PHYSICS)
    counts = {"rigid": args.rigid, "ipc": args.ipc}
    for name in names:
        if counts[name] < 1:
            raise InputError(name, value=counts[name], rule="must be 1 or more")
    if not 0.0 < args.deepest < 1.0:
        raise InputError("deepest", value=args.deepest, rule="must be greater than 0 and less than 1")
    if args.pad not in PADS:
        raise InputError("pad", value=args.pad, rule="must be a known level", choices=PADS)
    device = resolve_device(args.device, ray_tracing=False)
    out = args.out or Path("runs/stress")
    settings = {"seed": args.seed, "deepest": args.deepest, "pad": args.pad, "device": device}
    with FolderLock(out):
        kept = {name: resumed(out / f"{name}.json", settings) for name in names}
        metrics: dict[str, Metric] = {"experiment": "stress", "device": device, "seed": args.seed, "pad": args.pad, **machine()}
        for name in names:
            rows = kept[name][: counts[name]]
            sensors = {sensor: make_sensor(sensor, name, args, device) for sensor in SENSORS}
            for number in range(len(rows), counts[name]):
                rows.append(pressed(name, number, args, sensors))
                store(out / f"{name}.json", settings, rows)
                print(f"{name} {number + 1} of {counts[name]}: {line(rows[-1])}", flush=True)
            metrics |= {f"stress.{name}.{key}": value for key, value in summary(name, rows).items()}
        write_metrics(out / "metrics.json", metrics | {"wall_s": time.perf_counter() - start, **versions()})
    for key, value in metrics.items():
        if key.startswith("stress."):
            print(f"{key} = {value}")
    print(f"written: {out}")
    return metrics


def make_sensor(name: str, physics: str, args: Args, device: str) -> TactileSensor:
    """A sensor without images."""
    outputs = ("height", "wrench", "traction")
    return TactileSensor(name, physics=Ipc(args.pad) if physics == "ipc" else physics, outputs=outputs, device=device)


def random_press(physics: str, seed: int, number: int, deepest: float) -> tuple[str, str, PressScene]:
    """Names of the sensor and of the object of a press, and its scene: the object somewhere on the pad, turned and scaled."""
    rng = np.random.default_rng((seed, number, PHYSICS.index(physics)))
    sensor = str(rng.choice(SENSORS, p=(0.75, 0.25)))
    name = str(rng.choice(OBJECTS if physics == "ipc" else OBJECTS[:-1]))
    gelpad, thing = load_sensor(sensor).gelpad, load_press(name).object
    if rng.random() < 0.5:
        thing = scaled(thing, float(rng.uniform(0.5, 1.5)))
    if rng.random() < 0.7:
        turn = rng.normal(size=4)
        thing = replace(thing, quaternion=tuple((turn / np.linalg.norm(turn)).tolist()))
    half = 0.5 * np.asarray(gelpad.size)
    place = rng.uniform(-0.98, 0.98, 2) * half
    deep = rng.random() < DEEP[physics] and deepest > SHALLOW
    share = float(rng.uniform(SHALLOW, deepest) if deep else rng.uniform(0.02, min(SHALLOW, deepest)))
    stages = [StageSpec("indent", depth=share * gelpad.thickness)]
    if rng.random() < 0.15:
        stages = [StageSpec("indent", force=float(10.0 ** rng.uniform(-2.0, 1.3)))]
    if rng.random() < 0.4:
        end = np.clip(place + rng.uniform(-1e-3, 1e-3, 2), -0.98 * half, 0.98 * half)
        stages.append(StageSpec("shear", shear=(float(end[0] - place[0]), float(end[1] - place[1]))))
    if rng.random() < 0.3:
        stages.append(StageSpec("twist", twist=float(np.radians(rng.uniform(-60.0, 60.0)))))
    moves = "case" if rng.random() < 0.2 else "object"
    thing = replace(thing, position=(float(place[0]), float(place[1]), 0.0))
    return sensor, name, PressScene(name, thing, tuple(stages), moves)


def scaled(thing: ObjectSpec, factor: float) -> ObjectSpec:
    """The object with all its lengths times ``factor``; counts and paths stay."""
    params = {key: value * factor if isinstance(value, float) else value for key, value in thing.params.items()}
    return replace(thing, params=params)


def pressed(physics: str, number: int, args: Args, sensors: dict[str, TactileSensor]) -> Row:
    """One press and what is wrong with it."""
    begin = time.perf_counter()
    name, what, scene = random_press(physics, args.seed, number, args.deepest)
    sensor = sensors[name]
    row: Row = {"number": number, "sensor": name, "object": what, "stages": [stage.kind for stage in scene.trajectory]}
    depth = scene.trajectory[0].depth
    row["share"] = None if depth is None else depth / sensor.spec.gelpad.thickness
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            validate_press(sensor.spec, scene)
            pad = sensor.load(scene)
            frame = sensor.update(pad.peak(pad.run()))
        row |= rigid_faults(sensor, frame) if physics == "rigid" else soft_faults(pad, frame)  # type: ignore[arg-type]
    except (InputError, SpecError) as error:
        row["refused"] = str(error)
    except Exception as error:  # whatever it is, it is what this looks for
        row["exception"] = f"{type(error).__name__}: {error}"
        row["traceback"] = traceback.format_exc()
    return row | {"seconds": time.perf_counter() - begin}


def rigid_faults(sensor: TactileSensor, frame: TactileFrame) -> Row:
    """What is wrong with a press on the rigid pad."""
    if frame.failed[0]:
        return {"failed": True}
    thickness = sensor.spec.gelpad.thickness
    force = np.einsum("yxi,yx->i", frame.traction[0].astype(float), cell_areas(frame.surface.grid))
    off = float(np.abs(force - frame.wrench[0, :3]).max())
    return {
        "failed": False,
        "below_bond": float(frame.surface.height[0].min()) < -thickness * (1.0 + 1e-6),  # heights are float32
        "unbalanced": not off <= BALANCE * float(np.linalg.norm(frame.wrench[0, :3])) + 1e-6,
        "nonfinite": not is_finite(frame),
    }


def soft_faults(pad: SoftPad, frame: TactileFrame) -> Row:
    """What is wrong with a press on the soft pad."""
    assert pad.solver is not None
    row: Row = {"failed": bool(frame.failed[0]), "unconverged_steps": int(frame.unconverged[0])}
    if row["failed"]:
        return row
    crossing = pad.solver.world.overlap()
    row |= {"penetrating": crossing is not None} | ({} if crossing is None else {"overlap": crossing})
    return row | {"nonfinite": not is_finite(frame), "unconverged": not bool(pad.solver.converged[0])}


def is_finite(frame: TactileFrame) -> bool:
    """Whether every number of the frame is."""
    return all(np.isfinite(values).all() for values in (frame.surface.height, frame.wrench, frame.traction))


def summary(physics: str, rows: list[Row]) -> dict[str, Metric]:
    """Counters of one physics."""

    def count(key: str, among: list[Row] = rows) -> int:
        return sum(bool(row.get(key)) for row in among)

    shallow = [row for row in rows if isinstance(row["share"], float) and row["share"] <= SHALLOW]
    metrics: dict[str, Metric] = {"presses": len(rows), "exceptions": count("exception"), "refused": count("refused")}
    metrics |= {"failed": count("failed"), "shallow": len(shallow), "failed_shallow": count("failed", shallow)}
    if physics == "rigid":
        return metrics | {key: count(key) for key in ("below_bond", "unbalanced", "nonfinite")}
    causes = ("nonfinite", "penetrating", "unconverged")
    metrics["unmarked"] = sum(any(row.get(key) for key in causes) for row in rows)
    steps = [row.get("unconverged_steps", 0) for row in rows]
    return metrics | {key: count(key) for key in causes} | {"unconverged_steps": sum(n for n in steps if isinstance(n, int))}


def line(row: Row) -> str:
    """A press in one line."""
    share = "to a force" if row["share"] is None else f"to {row['share']:.2f} of the thickness"
    faults = [key for key in ("failed", "below_bond", "unbalanced", "nonfinite", "penetrating", "unconverged") if row.get(key)]
    reasons = [str(row[key]).splitlines()[0] for key in ("refused", "exception") if key in row]
    return f"{row['object']} on {row['sensor']} {share}, {row['seconds']:.1f} s: {', '.join(faults + reasons) or 'sound'}"


if __name__ == "__main__":
    run(main, Args)
