"""``raytac calibrate FORCES.csv``: a gel fitted to forces, errors, and a sensor file."""

from __future__ import annotations

import datetime
import os
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from raytac.calibrate.gel_forces import ForceTable, GelFit, ball_forces, fit_gel
from raytac.device import resolve_device
from raytac.errors import InputError
from raytac.io.folder import result_folder
from raytac.io.metrics import VERSIONED, Metric, versions, write_metrics
from raytac.physics import Ipc, PhysicsConfig, Rigid
from raytac.report.measure import machine
from raytac.specs.files import available, find_file
from raytac.specs.press import PADS
from raytac.specs.sensor import SensorSpec
from raytac.specs.sensor_check import validate_sensor
from raytac.specs.sensor_file import files_in_chain, gelpad_files, load_sensor

FORCE_PADS = ("rigid", *PADS)
"""Pads that forces can be fitted on: the rigid one, and levels of the soft one."""
TITLES = {"modulus": "modulus", "poisson_ratio": "modulus and Poisson's ratio", "compliance": "modulus and a rig that yields"}
POOR = 0.2
"""Error of force from which a fit is called poor."""
END = "\nIts Poisson's ratio lies at an end of what was tried."
FILES = ("sensor.toml", "surface.csv", "metrics.json")


def run_calibrate_forces(
    sensor: SensorSpec, data: Path, out: Path, *, diameter_mm: float, pads: Sequence[str], device: str, seed: int, start: float
) -> tuple[list[Path], str]:
    """Fit the gel of ``pads`` to the table ``data`` and write ``FILES`` to ``out``.

    Returns these files and a table of errors in Markdown. Of the readings that a sensor file can hold, the one with least error at held-out
    depths is written.

    Raises:
        InputError: a table that says nothing, a sensor without a file, or ``out`` cannot be written.
        RaytacError: a press did not converge.
    """
    table, radius = ForceTable.read(data), 0.5e-3 * diameter_mm
    if sensor.source is None:
        raise InputError("sensor", value=sensor.name, rule="must have been read from a file, which the fitted one is built on")
    check_apart(sensor.source, Path(out))
    names = [f"{1e3 * depth:g}" for depth in table.depth]
    solver = resolve_device(device, ray_tracing=False)
    physics: list[PhysicsConfig] = [Rigid() if pad == "rigid" else Ipc(level=pad) for pad in pads]
    with result_folder(out, FILES) as folder:
        fits = fit_gel(sensor, table, radius, physics, device=solver, progress=True)
        best = min((fit for fit in fits if fit.compliance == 0.0), key=lambda fit: fit.held_out_rms)
        gelpad = replace(
            sensor.gelpad, youngs_modulus=1e3 * round(best.youngs_modulus / 1e3), poisson_ratio=round(best.poisson_ratio, 3)
        )
        fitted = replace(sensor, gelpad=gelpad)
        validate_sensor(fitted)
        errors = ball_forces(fitted, physics, radius, table.depth, device=solver) / table.force - 1.0
        for name, text in gelpad_files(fitted, _base(sensor, out), _comment(best, data, diameter_mm, pads, errors)).items():
            (folder / name).write_text(text, encoding="utf-8")
        metrics: dict[str, Metric] = {"data": data.name, "sensor": sensor.name, "ball_diameter_mm": diameter_mm}
        metrics |= {"fitted": best.name, "youngs_modulus_kpa": gelpad.youngs_modulus / 1e3, "poisson_ratio": gelpad.poisson_ratio}
        for fit in fits:
            metrics |= _fit_metrics(fit, pads, names)
        for pad, row in zip(pads, errors.tolist(), strict=True):
            metrics |= {f"error.{pad}.{name}": value for name, value in zip(names, row, strict=True)}
        metrics |= {"device": solver, "seed": seed, **versions((*VERSIONED, "warp-lang")), **machine()}
        write_metrics(folder / "metrics.json", metrics | {"wall_s": time.perf_counter() - start})
        written = [Path(out) / path.name for path in sorted(folder.iterdir())]
    load_sensor(Path(out) / "sensor.toml")  # the written file can be read where it lies
    return written, force_table(fits, best, pads, names, errors)


def check_apart(source: Path, out: Path) -> None:
    """InputError if ``out`` holds the sensor's file ``source``, or one that it is built on."""
    for file in files_in_chain(source):
        if file.resolve().parent == out.resolve():
            raise InputError("out", value=str(out), rule=f"must be another folder: the sensor is read from {file.name} in it")


def force_table(fits: Sequence[GelFit], best: GelFit, pads: Sequence[str], names: Sequence[str], errors: np.ndarray) -> str:
    """Errors at held-out depths of every fit, and of the sensor as written, in Markdown."""
    lines = [
        "| fitted | E [kPa] | ν | rig yields [µm/N] | pad | " + " | ".join(f"{name} mm" for name in names) + " | worst |",
        "|" + "---|" * (6 + len(names)),
    ]

    def row(pad: str, values: np.ndarray) -> str:
        cells = [f"{100 * value:+.1f} %" for value in values]
        return f"{pad} | {' | '.join(cells)} | {100 * np.abs(values).max():.1f} % |"

    for fit in fits:
        head = f"| {TITLES[fit.name]} | {fit.youngs_modulus / 1e3:.0f} | {fit.poisson_ratio:.3f} | {1e6 * fit.compliance:.1f} | "
        if fit.at_end:
            head = head.replace(TITLES[fit.name], f"{TITLES[fit.name]}, at an end of what is tried", 1)
        lines += [head + row(pad, values) for pad, values in zip(pads, fit.held_out, strict=True)]
    text = "Errors of force at each depth, with values fitted to the other depths:\n\n" + "\n".join(lines)
    text += f"\n\nWritten: {TITLES[best.name]}. Errors of the pads with the sensor as written, all depths in view:\n"
    text += "".join(f"\n| {row(pad, values)}" for pad, values in zip(pads, errors, strict=True))
    rig = next((fit for fit in fits if fit.compliance > 0.0), None)
    if rig is not None and rig.held_out_rms < 1.5 * best.held_out_rms:
        how = "better" if rig.held_out_rms < best.held_out_rms else "nearly as well"
        text += f"\n\nA rig that yields {1e6 * rig.compliance:.1f} µm/N explains the forces {how}: one ball cannot tell it from the gel."
    if best.at_end or np.abs(errors).max() > POOR:
        text += "\n\nDo not use this gel: its fit is poor, or its Poisson's ratio lies at an end of what is tried."
    return text


def _fit_metrics(fit: GelFit, pads: Sequence[str], names: Sequence[str]) -> dict[str, Metric]:
    key = f"fit.{fit.name}"
    metrics: dict[str, Metric] = {
        f"{key}.youngs_modulus_kpa": fit.youngs_modulus / 1e3,
        f"{key}.poisson_ratio": fit.poisson_ratio,
        f"{key}.compliance_um_per_n": 1e6 * fit.compliance,
        f"{key}.at_end": int(fit.at_end),
        f"{key}.held_out_rms": fit.held_out_rms,
        f"{key}.held_out_worst": float(np.abs(fit.held_out).max()),
    }
    for pad, row in zip(pads, fit.held_out.tolist(), strict=True):
        metrics |= {f"{key}.{pad}.{name}.held_out_error": value for name, value in zip(names, row, strict=True)}
    return metrics


def _base(sensor: SensorSpec, out: Path) -> str:
    """Name of the shipped sensor, else the path of its file from ``out``."""
    assert sensor.source is not None
    source = sensor.source.resolve()
    if source.stem in available("sensor") and find_file("sensor", source.stem).resolve() == source:
        return source.stem
    return Path(os.path.relpath(source, Path(out).resolve())).as_posix()


def _comment(fit: GelFit, data: Path, diameter_mm: float, pads: Sequence[str], errors: np.ndarray) -> str:
    return (
        f"The base with another gel: {TITLES[fit.name]} fitted to {data.name}, a ball of {diameter_mm:g} mm diameter,\n"
        f"pads {', '.join(pads)} together, by raytac calibrate, {datetime.date.today()}. Greatest error of force at a depth: "
        f"{100 * np.abs(fit.held_out).max():.1f} % with values\n"
        f"fitted to the other depths, {100 * np.abs(errors).max():.1f} % as written. All else in [gelpad] is the base's, and so is the\n"
        f"motion of markers, which `raytac calibrate markers` fits to this gel.{END if fit.at_end else ''}"
    )
