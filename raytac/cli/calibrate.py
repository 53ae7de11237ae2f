"""``raytac calibrate``: fit optics to photographs, or marker motion to the soft pad."""

from __future__ import annotations

import time
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Literal

import tyro

from raytac.cli.shared import FitOptions, SolverOptions, kept_if_interrupted, named, print_paths
from raytac.errors import InputError
from raytac.io.metrics import read_metrics
from raytac.report.markers import run_calibrate_markers
from raytac.specs import load_sensor
from raytac.specs.press import PADS

_OF_DATA = (
    "model",
    "ball_diameter_mm",
    "sides",
    "split",
    "holdout",
    "shadows",
    "shadow_table",
    "starts",
    "rounds",
    "prior",
    "border",
    "pixel_mm",
    "own_response",
    "heights",
    "virtual",
    "drift",
)
_OF_MARKERS = ("level", "quick", "verbose")


@dataclass(frozen=True, kw_only=True)
class CalibrateArgs(FitOptions, SolverOptions):
    """Fit a sensor's optics to photographs of presses, or its marker motion to the soft pad.

    With a data set (docs/guide/calibrate.md), --model raytrace writes lights.toml and sensor.toml, --model taxim a calibration folder and
    --model mlp mlp.npz, each beside fit.png (photograph, fit, error), circles.csv and metrics.json, which says data, split, errors and
    date. Errors are printed. Every fifth press is held out and scored. Without --out the folder is runs/calibrate/MODEL/SENSOR. An error
    or Ctrl-C leaves the folder as it was.

    With `markers`: press the soft pad, and fit FOTS and the force field to the displacement of its surface. Writes marker_motion.toml
    (which a sensor file names as marker_motion), errors.md, errors.png and arrows.png (marker models against surface tracking on presses
    that the fit did not use) and metrics.json. Without --out the folder is runs/calibrate/markers/SENSOR, with --quick SENSOR-quick. An
    error or Ctrl-C leaves these files as they were; finished presses stay in presses/, and the same command continues from there.
    """

    what: Annotated[str, tyro.conf.Positional]
    """`markers`, or a folder of photographs with background.png, or a dataPack.npz."""
    model: Literal["raytrace", "taxim", "mlp"] = "raytrace"
    """Model to fit to a data set; table and network start with a fit of the lights, too."""
    holdout: int = 5
    """Interval of the presses that are held out and scored: 5 is every fifth; 0 holds out none."""
    shadows: bool = False
    """Let the ray tracer cast shadows on the coat in the fit, and in sensor.toml."""
    shadow_table: Literal["none", "raytrace"] = "none"
    """Shadows of --model taxim: none, or of pins in the fitted ray tracer."""
    sensor: str = "gelsight_mini"
    """Name of a shipped sensor, or path of a sensor file; it needs no markers of its own."""
    level: Annotated[str, named(PADS)] = "medium"
    """Resolution of the soft pad's mesh."""
    quick: bool = False
    """Few presses: shows that all runs; a poor fit."""

    def run(self) -> int:
        start = time.perf_counter()
        self._refuse_options_of_the_other()
        self.prepare_warp()
        if self.what != "markers":
            return self._optics(start)
        sensor = load_sensor(self.sensor)
        out = self.folder("calibrate", "markers", sensor.name + ("-quick" if self.quick else ""))
        with kept_if_interrupted(f"finished presses are kept in {out}"):
            written = run_calibrate_markers(
                sensor, out, level=self.level, quick=self.quick, device=self.device, seed=self.seed, start=start
            )
        return print_paths(written)

    def _refuse_options_of_the_other(self) -> None:
        """An option that says nothing to what is fitted would else be passed over in silence."""
        others, owner = (_OF_DATA, "a data set") if self.what == "markers" else (_OF_MARKERS, "'markers'")
        for default in (one for one in fields(self) if one.name in others):
            value = getattr(self, default.name)
            if value != default.default:
                rule = f"belongs to `calibrate` with {owner}, not with {self.what!r}: leave it out"
                raise InputError(default.name, value=value, rule=rule)

    def _optics(self, start: float) -> int:
        from raytac.report.real_calibration import calibration_table, run_calibrate_optics

        if self.out is not None and self.out.resolve() == Path(self.what).resolve():
            raise InputError("out", value=self.out, rule="must not be the folder of the photographs: every PNG there is one")
        sensor, presses, shots = self.read(Path(self.what), self.sensor)
        written = run_calibrate_optics(
            sensor,
            shots,
            presses.names,
            self.folder("calibrate", self.model, sensor.name),
            model=self.model,
            data=Path(self.what).name,
            holdout=self.holdout,
            starts=self.starts,
            rounds=self.rounds,
            prior=self.chosen_prior,
            shadows=self.shadows,
            shadow_table=self.shadow_table,
            drift=self.drift,
            device=self.device,
            seed=self.seed,
            start=start,
        )
        print(calibration_table(read_metrics(next(path for path in written if path.name == "metrics.json"))))
        return print_paths(written)
