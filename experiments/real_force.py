"""How near are the pads' forces to those that a real sensor was measured to bear? Force against depth of a ball: rigid pad, soft pad's levels.

    python experiments/real_force.py feats_force.csv --radius-mm 7.5 --out runs/real_force
    python experiments/real_force.py feats_force.csv --radius-mm 7.5 --levels coarse,medium,fine --out runs/real_force

The file has columns ``depth_mm`` and ``force_n``; lines that begin with # are skipped. A depth is the travel from first touch. Keys:

- ``force.DEPTH.measured_n``, ``force.PAD.DEPTH.n``, ``….error``: force of a pad [N], and over the measured one, less 1.
- ``force.PAD.DEPTH.held_out_error``: the same with Young's modulus times one factor, fitted to the **other** depths (least relative
  squares; forces of a press are proportional to the modulus). ``force.PAD.modulus_factor`` is that of all depths.
- ``force.PAD.worst``, ``….held_out_worst``: greatest error of any depth.
- ``force.PAD.poisson_NU.worst`` and ``….modulus_kpa``, with ``--poisson-ratios``: Poisson's ratio another one and the modulus fitted to it.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from experiments.running import recorded, run
from raytac.checks import check_number
from raytac.device import resolve_device
from raytac.errors import InputError, RaytacError
from raytac.io import CommonOptions, parse_names
from raytac.physics import RigidPad, SoftPad, quiet_solver
from raytac.physics.press import PressPad
from raytac.specs import PADS, SensorSpec, load_sensor
from raytac.specs.press import ObjectSpec, PressScene, StageSpec

COLUMNS = "depth_mm", "force_n"
PITCH = 0.1e-3
"""Spacing of the nodes [m]."""


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Compare forces with measured ones."""

    data: Annotated[Path, tyro.conf.Positional]
    """File of depths and forces."""
    radius_mm: float
    """Radius of the ball [mm]."""
    levels: Annotated[str, tyro.conf.arg(metavar="{" + ",".join(PADS) + "}")] = "coarse,medium"
    """Levels of the soft pad, joined by commas; empty for none."""
    poisson_ratios: str = ""
    """Poisson's ratios to try besides the sensor's, of the rigid pad, joined by commas."""
    sensor: str = "gelsight_mini"
    """Name of a shipped sensor, or path of a sensor file."""


@dataclass(frozen=True)
class Measured:
    """Forces [N] at depths [m], (N,) each."""

    depth: np.ndarray
    force: np.ndarray

    @classmethod
    def read(cls, path: Path) -> Measured:
        """Rows of a file, by depth; raises ``InputError`` for anything but numbers above 0, each depth once, at least two."""
        try:
            lines = [line for line in path.read_text("utf-8").splitlines() if line.strip() and not line.startswith("#")]
        except (OSError, UnicodeDecodeError) as error:
            raise InputError("data", value=str(path), rule=f"cannot be read: {error}") from error
        rows = list(csv.DictReader(lines))
        if not rows or any(name not in rows[0] for name in COLUMNS):
            raise InputError("data", value=str(path), rule=f"must have the columns {', '.join(COLUMNS)} and a row of numbers")
        try:
            values = np.array([[float(row[name]) for name in COLUMNS] for row in rows])
        except (TypeError, ValueError) as error:
            raise InputError("data", value=str(path), rule=f"must hold numbers: {error}") from error
        if not (np.isfinite(values) & (values > 0.0)).all() or len(np.unique(values[:, 0])) < max(2, len(values)):
            raise InputError("data", value=str(path), rule="must hold depths and forces above 0, each depth once, at least two")
        depth, force = values[values[:, 0].argsort()].T
        return cls(1e-3 * depth, force)


def pressed_forces(pad: PressPad, depths: np.ndarray) -> np.ndarray:
    """Normal force [N] at each of ``depths`` [m], ascending; raises ``RaytacError`` for a state that the physics marks as failed."""
    forces = []
    for depth in depths:
        (reading,) = pad.follow(StageSpec("indent", depth=float(depth)))
        if reading.failed.any() or reading.unconverged is not None and reading.unconverged.any():
            raise RaytacError(f"the press to {1e3 * depth:g} mm did not converge")
        forces.append(float(reading.wrench[0, 2]))
    return np.abs(forces)


def modulus_factor(force: np.ndarray, measured: np.ndarray) -> float:
    """Factor c of the modulus that makes Σ (c F / F_measured − 1)² least."""
    share = force / measured
    return float(share.sum() / (share**2).sum())


def held_out_errors(force: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Error of every depth with the modulus fitted to the others, (N,)."""
    factors = [modulus_factor(np.delete(force, k), np.delete(measured, k)) for k in range(len(force))]
    return np.array(factors) * force / measured - 1.0


def main(args: Args) -> None:
    check_number("radius_mm", args.radius_mm, "(0, 100]", "mm")
    measured, sensor = Measured.read(args.data), load_sensor(args.sensor)
    levels = parse_names(args.levels, "levels", PADS) if args.levels else ()
    ratios = [_ratio(text) for text in args.poisson_ratios.split(",") if text.strip()]
    device = resolve_device(args.device, ray_tracing=False)
    quiet_solver()
    ball = ObjectSpec("sphere", {"radius": args.radius_mm / 1e3}, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0.1)
    scene = PressScene("ball", ball, (StageSpec("indent", depth=float(measured.depth[-1])),))

    def rigid(sensor: SensorSpec) -> np.ndarray:
        return pressed_forces(RigidPad(sensor, scene, pitch=PITCH), measured.depth)

    with recorded(args, "real_force", device=device) as (_, metrics):
        young = sensor.gelpad.youngs_modulus / 1e3
        metrics |= {"sensor": sensor.name, "modulus_kpa": young, "poisson_ratio": sensor.gelpad.poisson_ratio}
        names = [f"{1e3 * depth:g}" for depth in measured.depth]
        metrics |= {f"force.{name}.measured_n": float(force) for name, force in zip(names, measured.force, strict=True)}
        print("| pad | " + " | ".join(f"{name} mm" for name in names) + " | worst | modulus fitted to the others: worst | factor |")
        print("|" + "---|" * (4 + len(names)))
        print("| measured [N] | " + " | ".join(f"{force:.2f}" for force in measured.force) + " | | | |", flush=True)
        for pad in ("rigid", *levels):
            if pad == "rigid":
                force = rigid(sensor)
            else:
                force = pressed_forces(SoftPad(sensor, scene, pitch=PITCH, level=pad, device=device), measured.depth)
            error, held_out = force / measured.force - 1.0, held_out_errors(force, measured.force)
            worst, worst_held_out = float(np.abs(error).max()), float(np.abs(held_out).max())
            factor = modulus_factor(force, measured.force)
            for k, name in enumerate(names):
                metrics[f"force.{pad}.{name}.n"] = float(force[k])
                metrics[f"force.{pad}.{name}.error"] = float(error[k])
                metrics[f"force.{pad}.{name}.held_out_error"] = float(held_out[k])
            metrics |= {f"force.{pad}.worst": worst, f"force.{pad}.held_out_worst": worst_held_out}
            metrics[f"force.{pad}.modulus_factor"] = factor
            cells = [f"{f:.2f} ({100 * e:+.1f} %)" for f, e in zip(force, error, strict=True)]
            print(f"| {pad} | {' | '.join(cells)} | {100 * worst:.1f} % | {100 * worst_held_out:.1f} % | {factor:.3f} |", flush=True)
        for ratio in ratios:
            force = rigid(replace(sensor, gelpad=replace(sensor.gelpad, poisson_ratio=ratio)))
            factor = modulus_factor(force, measured.force)
            worst = float(np.abs(factor * force / measured.force - 1.0).max())
            metrics[f"force.rigid.poisson_{ratio:g}.worst"] = worst
            metrics[f"force.rigid.poisson_{ratio:g}.modulus_kpa"] = factor * young
            print(f"rigid, Poisson's ratio {ratio:g}: worst {100 * worst:.1f} % with a modulus of {factor * young:.0f} kPa", flush=True)


def _ratio(text: str) -> float:
    try:
        ratio = float(text)
    except ValueError:
        ratio = np.nan
    if not 0.0 <= ratio < 0.5:
        raise InputError("poisson_ratios", value=text, rule="must be numbers in [0, 0.5) joined by commas")
    return ratio


if __name__ == "__main__":
    run(main, Args)
