"""Cases that break the contact of rigid pads: impacts, long rests, grasps at the limit of slip, edges, blades, pins, random grasps.

    python experiments/rigid_hard_cases.py --out runs/rigid_hard                       # the quick set
    python experiments/rigid_hard_cases.py --cases "drop_50g*,pin" --out runs/rigid_hard_some
    python experiments/rigid_hard_cases.py --full --out runs/rigid_hard_full           # all combinations, 10,000 grasps; resumes
    python experiments/rigid_hard_cases.py --full --cases "grasps*" --processes 16 --minutes 8 --out runs/grasps
    python experiments/rigid_hard_cases.py --full --part 1/2 --out runs/half      # every second case, for one of two machines
    python experiments/rigid_hard_cases.py --combine runs/grasps runs/half --out runs/rigid_hard_full

Every case makes three checks beside its own: no environment fails, no body passes the face that the gel is bonded to (its underside over
the pad, at every sub-step), and the friction of MuJoCo's contacts of the gel stays within 1 % of its cone. The others, with their bounds:

- drops of steel balls: kinetic and potential energy never exceed what the ball began with by more than 0.1 %; with steps of 2 and 1 ms
  the greatest depth, the greatest force (mean of a sub-step) and the energy that the ball keeps agree within 2 % (the last as a share of
  what it began with);
- rest and slope: 1 kg for 60 s creeps at most 10 µm after the first 5 s, weight within 1e-4, depth within 1 % of the press's;
- lifts: two pads hold 90 % of the load at which they slip for 10 s with 20 µm of creep after the first second, and drop 110 %;
- twists: the same of a torque about the normal;
- a thrown ball: its kinetic energy never exceeds what it began with and the work of the pads that close on it by more than 0.1 %;
- grips: the load is carried within 1e-4, at most 20 µm of creep, depth as in a press;
- reversals: a spring drags a block to and fro: friction is μN both ways within 2 %, and never gives energy back that was not stored.

Writes ``metrics.json`` (``rigid_hard.passed``, ``rigid_hard.total``, ``rigid_hard.max_penetration_of_bond_m``, names of cases that
fail in ``rigid_hard.failing``, grasps and their time by shape, and of every case its checks), ``table.txt`` and ``rigid_hard.png``;
``cases.json`` keeps the cases that are done. ``rigid_hard.missing`` counts those that were asked for and are not.
"""

from __future__ import annotations

import fnmatch
import re
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from experiments.rigid_hard_bench import (
    GEL,
    Bench,
    Check,
    G,
    Grasps,
    Outcome,
    contact_radius,
    normal_force,
    on_pad,
    press_depth,
    within_grip,
)
from experiments.running import record_of, resumed, run, store
from experiments.spreading import spread
from raytac.device import resolve_device
from raytac.errors import InputError, RaytacError
from raytac.io import CommonOptions, FolderLock, Metric, versions, write_metrics
from raytac.physics import object_parts
from raytac.report import machine
from raytac.se3 import pose_of
from raytac.shapes import object_bounds
from raytac.specs import BodySpec, load_press

STEEL = 7800.0
UPRIGHT = (0.7071067811865476, 0.7071067811865476, 0.0, 0.0)
"""A cylinder's axis along y."""
OBJECTS = ("sphere", "cylinder", "edge", "cone", "torus", "pins", "coin", "mesh")
"""Shipped objects of the random grasps."""
SLOW = ("grasps_coin_*", "grasps_mesh_*")
"""Cases that take longest, and so begin first where processes share the cases."""
PIECE = 128
"""Most grasps of one case: a long run is resumed, and divided among processes, by cases."""
THIN = 0.03035e-3
"""Pitch of a press of thin bodies [m], on whose nodes a blade of 1 mm has its area within 0.2 %: by 0.03 mm it is off by 1 %, by 0.1 mm
by a tenth."""
Row = dict[str, Any]
Lengths = dict[str, float | int | str]


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Run the hard cases of rigid pads and tabulate what they measured against its bounds."""

    cases: str = ""
    """Names or patterns joined by commas; all if empty."""
    full: bool = False
    """Every speed, step and friction coefficient, and 10,000 random grasps."""
    grasps: int = 0
    """Number of random grasps; 0: 48, with ``--full`` 10,000."""
    seconds: float = 1.0
    """Factor of every time that something is held; below 1 the bounds mean less."""
    part: str = "1/1"
    """Every n-th of these cases from the i-th on, as i/n."""
    processes: int = 1
    """Processes that share the cases, on one core each and without a GPU."""
    minutes: float = np.inf
    """Time after which processes break off; the same command goes on with what is missing. With one process there is no such end."""
    combine: tuple[Path, ...] = ()
    """Folders of runs with equal settings and different cases, to be put together in ``--out``; nothing is run."""


def main(args: Args) -> dict[str, Metric]:
    """Run what is missing, or put runs together, and write the results."""
    check(args)
    start, out = time.perf_counter(), args.out or Path("runs/rigid_hard")
    if args.combine:
        args, rows = combined(args)
        names = chosen(args)
        if (out / "cases.json").exists():
            raise InputError("out", value=out, rule="holds a run already: choose another folder for the combined one")
        with FolderLock(out):
            store(out / "cases.json", settings_of(args), list(rows.values()))
            return written(args, out, names, rows, start)
    names = chosen(args)
    with FolderLock(out):
        rows = {row["case"]: row for row in resumed(out / "cases.json", settings_of(args))}
        for count, row in enumerate(results(args, names, rows), 1):
            rows[row["case"]] = row
            store(out / "cases.json", settings_of(args), list(rows.values()))
            print(f"{count:4}/{len(names)} {line(row)}", flush=True)
        return written(args, out, names, rows, start)


def check(args: Args) -> None:
    """Refuse values that no run has."""
    if not 0.0 < args.seconds <= 1.0:
        raise InputError("seconds", value=args.seconds, rule="must be greater than 0 and at most 1")
    if args.grasps < 0:
        raise InputError("grasps", value=args.grasps, rule="must be 0 or more")
    if args.processes < 1:
        raise InputError("processes", value=args.processes, rule="must be 1 or more")
    if not args.minutes > 0.0:
        raise InputError("minutes", value=args.minutes, rule="must be greater than 0")
    if args.minutes < np.inf and args.processes == 1:
        raise InputError("minutes", value=args.minutes, rule="is for two processes or more: one is not broken off")
    part_of(args)


def part_of(args: Args) -> tuple[int, int]:
    """Number of the part from 1 on, and of parts."""
    match = re.fullmatch(r"([1-9][0-9]*)/([1-9][0-9]*)", args.part)
    if match is None or int(match[1]) > int(match[2]):
        raise InputError("part", value=args.part, rule="must be i/n with 1 <= i <= n")
    return int(match[1]), int(match[2])


def chosen(args: Args) -> list[str]:
    """Names of the cases of a run: those of the patterns and of the part, slow ones first where processes share them."""
    cases, (part, parts) = all_cases(args), part_of(args)
    patterns = [p.strip() for p in args.cases.split(",") if p.strip()] or ["*"]
    for pattern in patterns:
        if not fnmatch.filter(cases, pattern):
            raise InputError("cases", value=pattern, rule="must be the name or a pattern of cases", choices=tuple(cases))
    names = [name for name in cases if any(fnmatch.fnmatch(name, pattern) for pattern in patterns)][part - 1 :: parts]
    if args.processes > 1:
        names.sort(key=lambda name: not any(fnmatch.fnmatch(name, pattern) for pattern in SLOW))
    return names


def settings_of(args: Args) -> dict[str, Any]:
    """What the cases of a run depend on."""
    return {"full": args.full, "seed": args.seed, "grasps": args.grasps, "seconds": args.seconds}


def results(args: Args, names: Sequence[str], rows: dict[str, Row]) -> Iterator[Row]:
    """Rows of the cases: those that are there, then those that are measured."""
    cases, missing = all_cases(args), [name for name in names if name not in rows]
    if args.processes == 1:
        for name in names:
            yield rows[name] if name in rows else measured(name, cases[name])
        return
    yield from [rows[name] for name in names if name in rows]
    if missing:
        work, first = partial(measured_case, args), partial(grasps, "sphere", 1, args.seed, 0)
        yield from spread(work, missing, min(args.processes, len(missing)), first=first, seconds=60.0 * args.minutes)


def measured_case(args: Args, name: str) -> Row:
    """The row of one case, in a process that has none of the others."""
    return measured(name, all_cases(args)[name])


def combined(args: Args) -> tuple[Args, dict[str, Row]]:
    """Settings and rows of the runs in folders.

    Raises:
        InputError: a folder without a run, runs with different settings, or a case in two of them.
    """
    settings, rows, first = {}, {}, args.combine[0]
    for folder in args.combine:
        kept, some = record_of(folder / "cases.json", "combine")
        if folder is not first and kept != settings:
            raise InputError(
                "combine", value=folder, rule=f"holds a run with other settings than {first}: {kept}, not {settings}"
            )
        settings = kept
        for row in some:
            if row["case"] in rows:
                raise InputError("combine", value=folder, rule=f"holds case {row['case']}, which another folder holds too")
            rows[row["case"]] = row
    return replace(args, **settings), rows


def written(args: Args, out: Path, names: Sequence[str], rows: dict[str, Row], start: float) -> dict[str, Metric]:
    """Metrics of a run from its rows by name, written with table and picture."""
    done = [rows[name] for name in names if name in rows]
    agreements = agreement(done)
    for row in agreements:
        print(line(row), flush=True)
    done += agreements
    metrics = summary(done) | grasp_metrics(all_cases(args), rows, names)
    metrics["rigid_hard.missing"] = sum(name not in rows for name in names)
    (out / "table.txt").write_text(table(done), encoding="utf-8")
    from experiments.rigid_hard_figure import draw

    draw(done, out / "rigid_hard.png")
    common: dict[str, Metric] = {"experiment": "rigid_hard", "device": resolve_device(args.device, ray_tracing=False)}
    common |= {"seed": args.seed, "full": int(args.full), **machine(), **versions()}
    write_metrics(out / "metrics.json", common | metrics | {"wall_s": time.perf_counter() - start})
    if metrics["rigid_hard.failing"]:
        print(f"failing: {metrics['rigid_hard.failing']}")
    missing = metrics["rigid_hard.missing"]
    rest = f"; {missing} are missing: the same command goes on with them" if missing else ""
    print(f"{metrics['rigid_hard.passed']} of {metrics['rigid_hard.total']} cases pass{rest}; written: {out}")
    return metrics


def grasp_metrics(cases: dict[str, Callable[[], Outcome]], rows: dict[str, Row], names: Sequence[str]) -> dict[str, Metric]:
    """Number of grasps that were made, and seconds of a core for one, by shape; printed too."""
    metrics: dict[str, Metric] = {"rigid_hard.grasps": 0}
    for thing in OBJECTS:
        mine = [name for name in names if name.startswith(f"grasps_{thing}_") and name in rows]
        count = sum(cases[name].args[1] for name in mine)  # type: ignore[attr-defined]
        if not count:
            continue
        seconds = sum(rows[name]["cpu_s"] for name in mine) / count
        metrics |= {f"rigid_hard.grasps.{thing}.count": count, f"rigid_hard.grasps.{thing}.seconds_each": seconds}
        metrics["rigid_hard.grasps"] = int(metrics["rigid_hard.grasps"]) + count
        print(f"{thing:10} {count:6} grasps, {seconds:.3f} s of a core each")
    return metrics


def measured(name: str, case: Callable[[], Outcome]) -> Row:
    """The row of one case; one that the package refuses or breaks off has failed, and says why."""
    begin, used = time.perf_counter(), time.process_time()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            outcome = case()
    except Exception as error:  # a case that cannot be run is a case that fails; the others go on
        text = (str(error).splitlines() or [""])[0]
        where = (
            "" if isinstance(error, RaytacError) else f" ({Path(traceback.extract_tb(error.__traceback__)[-1].filename).name})"
        )
        outcome = Outcome([Check(f"error: {type(error).__name__}: {text}{where}", 1.0, 0.0)])
    return {
        "case": name,
        "passed": outcome.passed,
        "penetration_m": outcome.penetration if np.isfinite(outcome.penetration) else None,
        "checks": [asdict(check) | {"passed": check.passed} for check in outcome.checks],
        "curves": outcome.curves,
        "seconds": time.perf_counter() - begin,
        "cpu_s": time.process_time() - used,
    }


def line(row: Row) -> str:
    """A case in one line: what failed, or the check nearest to its bound."""
    failed = [f"{c['name']} {c['value']:.3g} {c['unit']} (bound {c['bound']:g})" for c in row["checks"] if not c["passed"]]
    return f"{row['case']:26} {'pass' if row['passed'] else 'FAIL'} {row['seconds']:6.1f} s  {'; '.join(failed)}"


def table(rows: list[Row]) -> str:
    """All checks, one a line."""
    lines = [f"{'case':26} {'check':44} {'measured':>12} {'bound':>10} {'':4} verdict"]
    for row in rows:
        for c in row["checks"]:
            relation = ">=" if c["at_least"] else "<="
            verdict = "pass" if c["passed"] else "FAIL"
            lines.append(
                f"{row['case']:26} {c['name'][:44]:44} {c['value']:12.4g} {relation} {c['bound']:7g} {c['unit']:4} {verdict}"
            )
    return "\n".join(lines) + "\n"


def summary(rows: list[Row]) -> dict[str, Metric]:
    """Keys of ``metrics.json``."""
    reach = [row["penetration_m"] for row in rows if row["penetration_m"] is not None]
    metrics: dict[str, Metric] = {"rigid_hard.passed": sum(row["passed"] for row in rows), "rigid_hard.total": len(rows)}
    metrics["rigid_hard.failing"] = " ".join(row["case"] for row in rows if not row["passed"])
    if reach:
        metrics["rigid_hard.max_penetration_of_bond_m"] = max(reach)
    for row in rows:
        metrics[f"rigid_hard.{row['case']}.passed"] = int(row["passed"])
        for c in row["checks"]:
            if np.isfinite(c["value"]) and not c["name"].startswith("error"):
                metrics[f"rigid_hard.{row['case']}.{re.sub(r'[^A-Za-z0-9]+', '_', c['name'])}"] = c["value"]
    return metrics


def agreement(rows: list[Row]) -> list[Row]:
    """Rows that compare every case with steps of 2 ms to the same one with 1 ms, by the curve ``result``."""
    known, result = {row["case"]: row for row in rows}, []
    for name, row in known.items():
        of = name.removesuffix("_2ms")  # a drop's speed may read _2ms-1
        other = known.get(f"{of}_1ms")
        if of == name or other is None or "result" not in row["curves"] or "result" not in other["curves"]:
            continue
        outcome = Outcome()
        for label, a, b in zip(row["curves"]["result_of"], row["curves"]["result"], other["curves"]["result"], strict=True):
            whole = 1.0 if label.startswith("share") else abs(b)
            outcome.add(f"steps of 2 and 1 ms: {label}", abs(a - b) / whole if whole else np.inf, 0.02)
        result.append(measured(f"{of}_steps", partial(_same, outcome)))
    return result


def _same(outcome: Outcome) -> Outcome:
    return outcome


def all_cases(args: Args) -> dict[str, Callable[[], Outcome]]:
    """All cases by name."""
    full, factor = args.full, args.seconds
    speeds = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0) if full else (0.1, 1.0, 5.0)
    steps = (0.5, 1.0, 2.0, 5.0, 10.0) if full else (1.0, 2.0, 10.0)
    frictions = (0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5) if full else (0.1, 0.5, 1.5)
    holding = (1.0, 2.0, 5.0, 10.0) if full else (2.0,)
    resting = (1.0, 2.0, 5.0, 10.0) if full else (10.0,)
    cases: dict[str, Callable[[], Outcome]] = {}

    def put(name: str, case: Callable[..., Outcome], *values: Any) -> None:
        cases[name] = partial(case, *values)

    for grams in (5.0, 50.0, 500.0):
        for speed in speeds:
            for dt in steps:
                put(f"drop_{grams:g}g_{speed:g}ms-1_{dt:g}ms", drop, 1e-3 * grams, speed, 1e-3 * dt)
    for dt in resting:
        put(f"rest_{dt:g}ms", rest, 0.0, 1e-3 * dt, factor)
        put(f"slope_{dt:g}ms", rest, 0.2, 1e-3 * dt, factor)
    for dt in holding:
        for mu in frictions:
            put(f"lift_mu{mu:g}_{dt:g}ms", lift, mu, 1e-3 * dt, factor)
        put(f"twist_{dt:g}ms", twist, 1e-3 * dt, factor)
        for name, (body, load, force) in grips().items():
            put(f"{name}_{dt:g}ms", grip, body, load, force, 1e-3 * dt, factor)
        put(f"pad_on_pad_{dt:g}ms", pad_on_pad, 1e-3 * dt)
        put(f"two_bodies_{dt:g}ms", two_bodies, 1e-3 * dt)
        put(f"thrown_{dt:g}ms", thrown, 1e-3 * dt)
    for dt in sorted({1.0, 2.0, *(holding if full else ())}):
        put(f"reversal_{dt:g}ms", reversal, 1e-3 * dt)
    count = args.grasps or (10_000 if full else 48)
    for k, name in enumerate(OBJECTS):
        share = count // len(OBJECTS) + (k < count % len(OBJECTS))
        for piece, first in enumerate(range(0, share, PIECE)):
            put(f"grasps_{name}_{piece}", grasps, name, min(PIECE, share - first), args.seed, piece)
    return cases


def drop(mass: float, speed: float, dt: float) -> Outcome:
    """A steel ball that falls on the middle of the pad and comes back.

    It begins at one height whatever the step, so that all steps have the same energy at the touch, and near the pad, since MuJoCo's own
    free fall of a height H is off by √(2 H g) Δt / 2.
    """
    radius = (mass / (STEEL * 4.0 / 3.0 * np.pi)) ** (1.0 / 3.0)
    # The touch comes at an uneven share of a step.
    gap = 1.37e-3 * speed
    ball = BodySpec("ball", "sphere", {"radius": radius}, position=(0.0, 0.0, radius + gap), mass=mass)
    outcome = Outcome()
    with Bench(on_pad([ball], dt)) as bench:
        bench.throw((0.0, 0.0, -speed))
        bench.run(0.25 + gap / speed, lambda b: len(b.normal) > 2 and b.path()[-1, 2] > radius + 0.5 * gap)
        height, speeds = bench.path()[:, 2], bench.speed()[:, 2]
        energy = bench.kinetic(mass) + mass * G * height
        begun = energy[0] + mass * G * (GEL.thickness - radius)  # over the bonded face
        outcome.add("energy gained", float((energy - energy[0]).max() / begun), 1e-3)
        bench.common(outcome)
        depth = radius - height
        mean_force = mass * (np.diff(speeds) / np.diff(bench.time) + G)
        outcome.curves |= {
            "time": _thinned(1e3 * bench.time),
            "depth": _thinned(1e3 * depth),
            "result_of": ["greatest depth", "greatest force", "share of the energy kept"],
            "result": [float(depth.max()), float(mean_force.max()), float((energy[-1] - mass * G * radius) / begun)],
        }
    return outcome


def rest(slope: float, dt: float, factor: float) -> Outcome:
    """1 kg of steel that lies on the pad for a minute; of the slope's tangent four fifths of the friction coefficient."""
    side, height = 0.060, 0.0356
    box: Lengths = {"length": side, "width": side, "height": height}
    block = BodySpec("block", "box", box, position=(0.0, 0.0, 0.5 * height + 0.1e-3), mass=1.0, friction=0.25 if slope else None)
    down = G / np.hypot(1.0, slope)
    outcome = Outcome()
    with Bench(on_pad([block], dt, (slope * down, 0.0, -down))) as bench:
        bench.run(5.0 * factor)
        settled = len(bench.time)
        bench.run(55.0 * factor)
        path = bench.path()
        outcome.add("creep", 1e6 * float(np.linalg.norm(path[settled:] - path[settled - 1], axis=1).max(initial=0.0)), 10.0, "um")
        last = np.mean(bench.wrench[-round(0.5 / dt) :], axis=0)[0, :3]
        weight = np.array([slope * down, 0.0, -down])
        outcome.add("weight carried, error", float(np.linalg.norm(last - weight) / G), 1e-4)
        pose = bench.in_pad()[-1]
        if not slope:
            outcome.add("depth against the press", _off(bench.depth(), press_depth(block, pose, down)), 0.01)
        bench.common(outcome)
        outcome.curves |= {
            "time": _thinned(bench.time),
            "creep": _thinned(1e6 * np.linalg.norm(path - path[settled - 1], axis=1)),
        }
    return outcome


def lift(mu: float, dt: float, factor: float) -> Outcome:
    """A cube between two pads that press with 4 N, lifted with nine tenths of the load at which it slips, then with eleven."""
    side, press = 0.030, 4.0
    cube = BodySpec("cube", "box", {"length": side, "width": side, "height": side}, mass=0.05, friction=mu)
    outcome = Outcome()
    with Bench(within_grip([cube], dt, side + 1e-3)) as bench:
        bench.force = lambda t: press * min(t / 0.2, 1.0)
        bench.run(0.4)
        bench.settle()
        limit, begin = mu * float(np.mean(bench.normal[-10:], axis=0).sum()), float(bench.data.time)
        outcome.add("normal load, error", abs(limit / (2.0 * mu * press) - 1.0), 1e-3)
        bench.raised = lambda t: 8e-3 * min(max(t - begin, 0.0) / 0.5, 1.0)
        bench.run(0.5, lambda b: b.push((0.0, 0.0, -0.9 * limit * min((b.data.time - begin) / 0.5, 1.0))))
        bench.push((0.0, 0.0, -0.9 * limit))
        bench.run(1.0 * factor)
        settled = len(bench.time) - 1
        bench.run(9.0 * factor)
        way = bench.in_pad()[:, :3, 3]
        outcome.add("creep at 90 %", 1e6 * float(np.linalg.norm(way[settled:] - way[settled], axis=1).max()), 20.0, "um")
        carried = np.mean(bench.wrench[-round(0.2 / dt) :], axis=0)[:, :3].sum(axis=0)
        outcome.add(
            "load carried, error", float(np.linalg.norm(carried + np.array([0.0, 0.0, 0.9 * limit])) / (0.9 * limit)), 1e-4
        )
        held = len(bench.time) - 1
        bench.common(outcome)
        # What slips out leaves the pads, where no bound holds.
        bench.push((0.0, 0.0, -1.1 * limit))
        bench.run(1.0, lambda b: float(np.linalg.norm(b.in_pad()[-1, :3, 3] - way[held])) > 2e-3)
        slipped = float(np.linalg.norm(bench.in_pad()[-1, :3, 3] - way[held]))
        outcome.add("slip at 110 % within 1 s", 1e3 * slipped, 1.0, "mm", at_least=True)
        outcome.curves |= {
            "time": _thinned(bench.time[settled : held + 1] - bench.time[settled]),
            "creep": _thinned(1e6 * np.linalg.norm(way[settled:] - way[settled], axis=1)),
        }
    return outcome


def twist(dt: float, factor: float) -> Outcome:
    """A standing cylinder that 5 N press on the pad, turned by nine tenths of the torque 3π/16 μ a N at which it slips, then by eleven."""
    mu, load, mass = 0.8, 5.0, 0.02
    puck = BodySpec("puck", "cylinder", {"radius": 6e-3, "length": 8e-3}, position=(0.0, 0.0, 4.05e-3), mass=mass, friction=mu)
    outcome = Outcome()
    with Bench(on_pad([puck], dt)) as bench:
        bench.push((0.0, 0.0, mass * G - load))
        bench.run(0.5)
        pose = bench.in_pad()[-1]
        depth = bench.depth()
        radius = contact_radius(puck, pose, depth)
        limit = 3.0 * np.pi / 16.0 * mu * radius * load
        outcome.add("depth against the press", _off(depth, press_depth(puck, pose, load)), 0.01)
        begin = float(bench.data.time)
        bench.run(0.3, lambda b: b.push((0, 0, mass * G - load), (0, 0, 0.9 * limit * min((b.data.time - begin) / 0.3, 1.0))))
        bench.push((0, 0, mass * G - load), (0, 0, 0.9 * limit))
        bench.run(1.0 * factor)
        settled = len(bench.time) - 1
        bench.run(3.0 * factor)
        turned = np.unwrap(_yaw(bench.in_pad()))
        creep = float(np.abs(turned[settled:] - turned[settled]).max())
        outcome.add("creep of the rim at 90 %", 1e6 * radius * creep, 20.0, "um")
        torque = float(np.mean(bench.wrench[-round(0.2 / dt) :], axis=0)[0, 5])
        outcome.add("torque carried, error", abs(torque / (0.9 * limit) - 1.0), 1e-4)
        bench.common(outcome)
        bench.push((0, 0, mass * G - load), (0, 0, 1.1 * limit))
        bench.run(1.0, lambda b: abs(_yaw(b.in_pad()[-1:])[0] - turned[-1]) > 0.5)
        outcome.add("turn at 110 % within 1 s", abs(float(_yaw(bench.in_pad()[-1:])[0] - turned[-1])), 0.3, "rad", at_least=True)
    return outcome


def grips() -> dict[str, tuple[BodySpec, float, float]]:
    """Bodies between two pads: each with the load as a share of the slip limit, and the force that the pads press with [N]."""
    (length, width), ball = GEL.size, Lengths(radius=8e-3)
    return {
        "edge": (BodySpec("ball", "sphere", ball, position=(0.5 * length - 0.8e-3, 0.0, 0.0), mass=0.02), 0.3, 2.0),
        "corner": (
            BodySpec("ball", "sphere", ball, position=(0.5 * length - 0.8e-3, 0.0, 0.5 * width - 0.8e-3), mass=0.02),
            0.3,
            2.0,
        ),
        "blade": (BodySpec("blade", "box", {"length": 18e-3, "width": 25e-3, "height": 1e-3}, mass=0.01), 0.5, 3.0),
        "wide": (BodySpec("board", "box", {"length": 60e-3, "width": 30e-3, "height": 60e-3}, mass=0.1), 0.5, 5.0),
        "pin": (BodySpec("pin", "cylinder", {"radius": 0.5e-3, "length": 25e-3}, quaternion=UPRIGHT, mass=1e-3), 0.5, 1.0),
    }


def grip(body: BodySpec, share: float, press: float, dt: float, factor: float) -> Outcome:
    """A body that two pads hold under a load.

    The depth is that of a press with the part of the contact's force along the gel's normal: a press goes along the pad's z, where the law
    of a contact is along the normal, which the dome tilts by 3° at an edge and by 5° at a corner.
    """
    low, high = object_bounds(object_parts(body), pose_of((0.0, 0.0, 0.0), body.quaternion))
    outcome = Outcome()
    with Bench(within_grip([body], dt, float(high[1] - low[1]) + 1.5e-3)) as bench:
        bench.force = lambda t: press * min(t / 0.2, 1.0)
        bench.run(0.4)
        bench.settle()
        for k, name in enumerate(bench.names):
            pose = bench.in_pad(k)[-1]
            expected = press_depth(body, pose, normal_force(bench.felt[k], pose, object_parts(body)), THIN)
            outcome.add(f"depth on {name} against the press", _off(bench.depth(k), expected), 0.01)
        load = share * GEL.friction * float(np.mean(bench.normal[-10:], axis=0).sum())
        outcome.add("normal load, error", abs(load / (2.0 * share * GEL.friction * press) - 1.0), 0.01)
        begin = float(bench.data.time)
        bench.run(0.3, lambda b: b.push((0.0, 0.0, -load * min((b.data.time - begin) / 0.3, 1.0))))
        bench.push((0.0, 0.0, -load))
        bench.run(0.7 * factor)
        settled = len(bench.time) - 1
        bench.run(2.0 * factor)
        way = bench.in_pad()[:, :3, 3]
        outcome.add("creep", 1e6 * float(np.linalg.norm(way[settled:] - way[settled], axis=1).max()), 20.0, "um")
        carried = np.mean(bench.wrench[-round(0.2 / dt) :], axis=0)[:, :3].sum(axis=0)
        outcome.add("load carried, error", float(np.linalg.norm(carried + np.array([0.0, 0.0, load])) / load), 1e-4)
        bench.common(outcome)
    return outcome


def pad_on_pad(dt: float) -> Outcome:
    """Two pads that close on each other with 4 N: by symmetry each is pressed as by a flat plate."""
    press, outcome = 4.0, Outcome()
    with Bench(within_grip([], dt, 2e-3)) as bench:
        bench.press_pads_together()
        bench.force = lambda t: press * min(t / 0.2, 1.0)
        bench.run(1.0)
        felt = np.mean(bench.normal[-10:], axis=0)
        for name, force in zip(bench.names, felt, strict=True):
            outcome.add(f"force on {name}, error", abs(force / press - 1.0), 0.01)
        plate = BodySpec("plate", "box", {"length": 60e-3, "width": 60e-3, "height": 10e-3})
        expected = press_depth(plate, np.eye(4), press)
        outcome.add("depth against the press", _off(-0.5 * float(bench.between_pads()[-1]), expected), 0.01)
        bench.common(outcome)
    return outcome


def two_bodies(dt: float) -> Outcome:
    """Two pucks beside each other on one pad."""
    size: Lengths = {"radius": 3e-3, "length": 6e-3}
    mass = 0.02
    pucks = [
        BodySpec(f"puck{k}", "cylinder", size, position=(5e-3 * sign, 0.0, 3.05e-3), mass=mass) for k, sign in enumerate((-1, 1))
    ]
    outcome = Outcome()
    with Bench(on_pad(pucks, dt)) as bench:
        bench.run(1.0)
        settled = len(bench.time) - 1
        bench.run(2.0)
        for k in range(2):
            path = bench.path(k)
            outcome.add(f"creep of {k}", 1e6 * float(np.linalg.norm(path[settled:] - path[settled], axis=1).max()), 20.0, "um")
        weight = float(np.mean(bench.normal[-round(0.2 / dt) :]))
        outcome.add("weight carried, error", abs(weight / (2.0 * mass * G) - 1.0), 1e-4)
        for k, puck in enumerate(pucks):
            outcome.add(
                f"depth of {k} against the press",
                _off(bench.depth(0, k), press_depth(puck, bench.in_pad(0, k)[-1], mass * G)),
                0.01,
            )
        bench.common(outcome)
    return outcome


def thrown(dt: float) -> Outcome:
    """A ball that flies to and fro between two pads while they close on it; in the end they hold it, or it has left them."""
    radius, press, mass = 8e-3, 4.0, 0.017
    ball = BodySpec("ball", "sphere", {"radius": radius}, position=(-6e-3, 0.0, 0.0), mass=mass)
    outcome = Outcome()
    with Bench(within_grip([ball], dt, 0.030)) as bench:
        bench.throw((0.15, 2.0, 0.0))
        bench.force = lambda t: press
        bench.run(2.0)
        where, speed = bench.in_pad()[-1, :3, 3], float(np.linalg.norm(bench.speed()[-1, :3]))
        is_between = bool((np.abs(where[:2]) < 0.5 * np.array(GEL.size)).all())
        if is_between:
            outcome.add("speed in the end", 1e3 * speed, 1.0, "mm/s")
            outcome.add("force of the pads, error", float(np.abs(np.mean(bench.normal[-10:], axis=0) / press - 1.0).max()), 0.01)
        energy, apart = bench.kinetic(mass), bench.between_pads()
        gained = energy - energy[0] - press * (apart[0] - apart)
        outcome.add("energy gained beyond the pads' work", float(gained.max() / energy[0]), 1e-3)
        bench.common(outcome)
    return outcome


def reversal(dt: float) -> Outcome:
    """A block that a plunger over the pad's centre presses with 4 N and a spring drags 10 mm to one side and to the other, at its foot.

    Were the load to move with the block, the dome's slope would add to the friction: 6 % of it 6 mm from the centre.
    """
    mu, mass, load, stiffness, amplitude, pace = 0.5, 0.07, 4.0, 400.0, 10e-3, 20e-3
    half = 5e-3
    box: Lengths = {"length": 60e-3, "width": 40e-3, "height": 2.0 * half}
    block = BodySpec("block", "box", box, position=(0.0, 0.0, half + 0.05e-3), mass=mass, friction=mu)
    pulls: list[float] = []
    places: list[float] = []
    kinetic: list[float] = []
    begin = 0.3

    def stage(t: float) -> float:
        phase = max(t - begin, 0.0) * pace / amplitude
        return amplitude * (1.0 - abs((phase + 1.0) % 4.0 - 2.0))

    def drag(bench: Bench) -> None:
        # The present place: that of the last record is a step old, and a spring that lags behind feeds an oscillation.
        x, z = float(bench.data.qpos[0]), float(bench.data.qpos[2])
        pull = stiffness * (stage(float(bench.data.time)) - x)
        pulls.append(pull)
        places.append(x)
        kinetic.append(0.5 * mass * float(bench.data.qvel[:3] @ bench.data.qvel[:3]))
        # The line of the load stays over the pad's centre, that of the pull in the contact.
        bench.push((pull, 0.0, mass * G - load), (0.0, -z * pull - x * load, 0.0))

    outcome = Outcome()
    with Bench(on_pad([block], dt)) as bench:
        bench.run(begin + 4.0 * amplitude / pace + amplitude / pace, drag)
        force = -np.array(bench.wrench)[:, 0, 0]  # on the block
        time_of = dt * np.arange(1, len(force) + 1)
        for name, low, high in (("ahead", 0.42, 0.5), ("back", 1.35, 1.5)):
            at = (time_of > begin + low) & (time_of < begin + high)
            outcome.add(
                f"slip force {name}, error",
                abs(float(np.abs(force[at]).mean()) / (mu * load) - 1.0) if at.any() else np.inf,
                0.02,
            )
        first = round(begin / dt)
        gained = np.array(kinetic[first + 1 :]) - kinetic[first]
        work = np.cumsum(np.array(pulls)[first:-1] * np.diff(places[first:])) - gained
        outcome.add("energy given back", float(max(-work.min(), 0.0) / max(work.max(), 1e-12)), 1e-3)
        bench.common(outcome)
        count = min(len(force), len(places))
        outcome.curves |= {
            "place": _thinned(1e3 * np.array(places[:count])),
            "force": _thinned(-force[:count] / (mu * load)),
            "result_of": ["friction's work", "last place"],
            "result": [float(work[-1]), float(places[-1])],
        }
    return outcome


def grasps(name: str, count: int, seed: int, piece: int) -> Outcome:
    """Random grasps of one shipped object: any attitude, off centre, with 0.3 to 10 N, then a load of a fifth of that.

    ``piece`` numbers the cases of one object. One that is thrown out of the pads is no fault. Objects wider than the gripper opens keep the
    attitude of their file.
    """
    rng, outcome = np.random.default_rng((seed, OBJECTS.index(name), piece)), Outcome()
    thing = load_press(name).object
    body = BodySpec("object", thing.kind, dict(thing.params), mass=0.03)
    parts = object_parts(body)
    low, high = object_bounds(parts, np.eye(4))
    opening = min(2.0 * float(np.linalg.norm(np.maximum(np.abs(low), np.abs(high)))) + 8e-3, 0.0799)
    grasp = Grasps(within_grip([body], 2e-3, opening), min(16, count))
    for first in range(0, count, grasp.count):
        poses, width = np.empty((grasp.count, 4, 4)), np.empty(grasp.count)
        for b in range(grasp.count):
            turn = rng.normal(size=4)
            place = rng.uniform(-6e-3, 6e-3, 2)
            poses[b] = pose_of((0.0, 0.0, 0.0), tuple(turn / np.linalg.norm(turn)))
            near, far = object_bounds(parts, poses[b])
            if far[1] - near[1] > opening - 1e-3:
                poses[b] = np.eye(4)
                near, far = low, high
            poses[b, :3, 3] = [place[0], 0.0, place[1]] - 0.5 * (near + far)
            width[b] = far[1] - near[1]
        grasp.close(poses, width, 10.0 ** rng.uniform(-0.5, 1.0, grasp.count), min(count - first, grasp.count))
    outcome.penetration = grasp.penetration
    outcome.add("environments failed", grasp.failed, 0.0)
    outcome.add("beyond the bonded face", 1e3 * grasp.penetration, 0.0, "mm")
    outcome.add("states that are not finite", grasp.broken, 0.0)
    outcome.add("friction beyond its cone", grasp.cone, 0.01)
    outcome.add("share that is felt", grasp.felt / count, 0.9, at_least=True)
    return outcome


def _off(depth: float, expected: float) -> float:
    """Difference of two depths as a share of the second."""
    return abs(depth / expected - 1.0)


def _yaw(poses: np.ndarray) -> np.ndarray:
    """Rotation about z [rad], (n,)."""
    return np.arctan2(poses[:, 1, 0], poses[:, 0, 0])


def _thinned(values: np.ndarray, most: int = 300) -> list[float]:
    """At most so many of the values, evenly chosen."""
    return [float(v) for v in values[:: max(len(values) // most, 1)]]


if __name__ == "__main__":
    run(main, Args, __doc__)
