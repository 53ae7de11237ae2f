"""``raytac calibrate``: constants of cheap models, fitted to the simulated pad."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from raytac.cli.solver_options import SolverOptions
from raytac.errors import InputError
from raytac.report.markers import run_calibrate_markers
from raytac.specs import load_sensor
from raytac.specs.press import PADS

__all__ = ["CalibrateArgs"]


@dataclass(frozen=True, kw_only=True)
class CalibrateArgs(SolverOptions):
    """Fit the marker motion of a sensor's pad: press the simulated pad, fit FOTS and the force field to how its surface moves.

    Writes marker_motion.toml (which a sensor file names as marker_motion), errors.md, errors.png and arrows.png (every marker model
    against surface tracking on presses that the fit did not see) and metrics.json. Without --out the folder is
    runs/calibrate/markers/SENSOR, with --quick SENSOR-quick. An error or Ctrl-C leaves these files as they were; presses that are
    finished stay in presses/, and the same command goes on from there.
    """

    what: Annotated[Literal["markers"], tyro.conf.Positional]
    """What to calibrate."""
    sensor: str = "gelsight_mini"
    """Name of a shipped sensor, or path of a sensor file; it needs no markers of its own."""
    pad: Annotated[str, tyro.conf.arg(metavar="{" + ",".join(PADS) + "}")] = "medium"
    """How finely the simulated pad is cut."""
    quick: bool = False
    """Few presses: shows that all runs; a poor fit."""

    def run(self) -> int:
        start = time.perf_counter()
        if self.pad not in PADS:
            raise InputError("pad", value=self.pad, rule="must be a known level", choices=PADS)
        sensor = load_sensor(self.sensor)
        self.prepare_solver("calibrate markers")
        name = sensor.name + ("-quick" if self.quick else "")
        out = self.out if self.out is not None else Path("runs") / "calibrate" / "markers" / name
        try:
            written = run_calibrate_markers(
                sensor, out, pad=self.pad, quick=self.quick, device=self.device, seed=self.seed, start=start
            )
        except KeyboardInterrupt:
            print(
                f"raytac: interrupted; finished presses are kept in {out}, the same command goes on from there", file=sys.stderr
            )
            return 130
        for path in written:
            print(path)
        return 0
