"""How near are the pads' forces to those that a real sensor bears? Force against depth of a ball: rigid pad and levels of the soft pad.

    python experiments/real_force.py feats_force.csv --radius-mm 7.5 --out runs/real_force
    python experiments/real_force.py feats_force.csv --radius-mm 7.5 --poisson-ratios 0.4,0.45 --frictions 0 --out runs/real_force

The file has columns ``depth_mm`` and ``force_n``; lines that begin with # are skipped. A depth is the travel from first touch. Keys:

- ``force.DEPTH.measured_n``, ``force.PAD.DEPTH.n``, ``….error``: force of a pad [N], and over the measured one, less 1.
- ``force.PAD.DEPTH.held_out_error``: the same with Young's modulus times one factor, fitted to the **other** depths (least relative
  squares; forces of a press are proportional to the modulus). ``force.PAD.modulus_kpa`` is the modulus fitted to all depths.
- ``force.PAD.worst``, ``….held_out_worst``: greatest error of any depth.
- ``force.PAD.poisson_NU.…``, ``force.PAD.friction_MU.…``, ``force.PAD.poisson_NU.friction_MU.…``: the same with another Poisson's ratio
  or friction than the sensor's, and both. The rigid pad's law knows no friction under a normal load.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from experiments.running import recorded, run
from raytac.calibrate import ForceTable, ball_forces, modulus_factor
from raytac.checks import check_number
from raytac.device import resolve_device
from raytac.errors import InputError
from raytac.io import CommonOptions, parse_names
from raytac.physics import Ipc, Rigid
from raytac.specs import PADS, load_sensor


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
    """Poisson's ratios to try besides the sensor's, joined by commas."""
    frictions: str = ""
    """Coefficients of friction to try besides the sensor's, joined by commas."""
    modulus_kpa: float | None = None
    """Young's modulus in place of the sensor's [kPa]."""
    sensor: str = "gelsight_mini"
    """Name of a shipped sensor, or path of a sensor file."""


def held_out_errors(force: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Error of every depth with the modulus fitted to the others, (N,)."""
    factors = [modulus_factor(np.delete(force, k), np.delete(measured, k)) for k in range(len(force))]
    return np.array(factors) * force / measured - 1.0


def main(args: Args) -> None:
    check_number("radius_mm", args.radius_mm, "(0, 100]", "mm")
    measured, sensor = ForceTable.read(args.data), load_sensor(args.sensor)
    levels = parse_names(args.levels, "levels", PADS) if args.levels else ()
    if args.modulus_kpa is not None:
        modulus = 1e3 * check_number("modulus_kpa", args.modulus_kpa, "(0, 1e6]", "kPa")
        sensor = replace(sensor, gelpad=replace(sensor.gelpad, youngs_modulus=modulus))
    ratios = _numbers("poisson_ratios", args.poisson_ratios, "[0, 0.5)")
    frictions = _numbers("frictions", args.frictions, "[0, 10]")
    variants = [("", sensor)]
    for ratio, friction in list(product((None, *ratios), (None, *frictions)))[1:]:
        changes = {"poisson_ratio": ratio, "friction": friction}
        changes = {name: value for name, value in changes.items() if value is not None}
        suffix = "".join(f".{name.removesuffix('_ratio')}_{value:g}" for name, value in changes.items())
        variants.append((suffix, replace(sensor, gelpad=replace(sensor.gelpad, **changes))))
    device = resolve_device(args.device, ray_tracing=False)
    with recorded(args, "real_force", device=device) as (_, metrics):
        pad = sensor.gelpad
        metrics |= {"sensor": sensor.name, "modulus_kpa": pad.youngs_modulus / 1e3}
        metrics |= {"poisson_ratio": pad.poisson_ratio, "friction": pad.friction}
        names = [f"{1e3 * depth:g}" for depth in measured.depth]
        metrics |= {f"force.{name}.measured_n": float(force) for name, force in zip(names, measured.force, strict=True)}
        print(
            f"| pad | {' | '.join(f'{name} mm' for name in names)} | worst | modulus by the others: worst | modulus by all [kPa] |"
        )
        print("|" + "---|" * (4 + len(names)))
        print("| measured [N] | " + " | ".join(f"{force:.2f}" for force in measured.force) + " | | | |", flush=True)
        for name in ("rigid", *levels):
            for suffix, own in variants:
                if name == "rigid" and ".friction" in suffix:
                    continue
                physics = Rigid() if name == "rigid" else Ipc(level=name)
                (force,) = ball_forces(own, [physics], args.radius_mm / 1e3, measured.depth, device=device)
                figures = errors_of(force, measured, names)
                figures["modulus_kpa"] = modulus_factor(force, measured.force) * pad.youngs_modulus / 1e3
                metrics |= {f"force.{name}{suffix}.{key}": value for key, value in figures.items()}
                cells = [f"{figures[f'{depth}.n']:.2f} ({100 * figures[f'{depth}.error']:+.1f} %)" for depth in names]
                cells += [f"{100 * figures[key]:.1f} %" for key in ("worst", "held_out_worst")]
                print(f"| {name}{suffix} | {' | '.join(cells)} | {figures['modulus_kpa']:.0f} |", flush=True)


def errors_of(force: np.ndarray, measured: ForceTable, names: Sequence[str]) -> dict[str, float]:
    """Forces of a pad and their errors, by the depths' ``names``."""
    error, held_out = force / measured.force - 1.0, held_out_errors(force, measured.force)
    figures = {"worst": float(np.abs(error).max()), "held_out_worst": float(np.abs(held_out).max())}
    for k, name in enumerate(names):
        figures |= {f"{name}.n": float(force[k]), f"{name}.error": float(error[k]), f"{name}.held_out_error": float(held_out[k])}
    return figures


def _numbers(option: str, text: str, interval: str) -> list[float]:
    try:
        return [check_number(option, float(number), interval) for number in text.split(",") if number.strip()]
    except ValueError as error:
        raise InputError(option, value=text, rule=f"must be numbers in {interval} joined by commas") from error


if __name__ == "__main__":
    run(main, Args)
