"""``raytac calibrate``: fit optics to photographs, gel to forces, markers to the soft pad."""

from __future__ import annotations

import time
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Literal

import tyro

from raytac.checks import check_number
from raytac.cli.fit_options import FitOptions
from raytac.cli.shared import SolverOptions, kept_if_interrupted, named, print_paths
from raytac.errors import InputError
from raytac.io.metrics import read_metrics
from raytac.io.options import parse_names
from raytac.report.markers import run_calibrate_markers
from raytac.specs import load_sensor
from raytac.specs.press import PADS

_FIT = ("sides", "split", "starts", "rounds", "prior", "border", "pixel_mm", "own_response", "heights", "virtual", "drift")
_TAKES = {
    "'markers'": ("level", "quick", "verbose"),
    "a table of forces": ("ball_diameter_mm", "pads", "verbose"),
    "a data set": ("model", "ball_diameter_mm", "holdout", "shadows", "shadow_table", *_FIT),
}
"""Options by what they fit; all others belong to every fit."""


@dataclass(frozen=True, kw_only=True)
class CalibrateArgs(FitOptions, SolverOptions):
    """Fit a sensor's optics to photographs, its gel to forces, or its markers to the soft pad.

    With a data set (docs/guide/calibrate.md), --model raytrace writes lights.toml and sensor.toml, --model taxim a calibration folder and
    --model mlp mlp.npz, each beside fit.png (photograph, fit, error), circles.csv and metrics.json, which says data, split, errors and
    date. Errors are printed. Every fifth press is held out and scored. Without --out the folder is runs/calibrate/MODEL/SENSOR. An error
    or Ctrl-C leaves the folder as it was.

    With a table of forces, a .csv with columns depth_mm (travel from first touch) and force_n of one ball: fit Young's modulus, and
    Poisson's ratio where that lowers errors at depths left out. Writes sensor.toml and metrics.json, and prints errors. Without --out the
    folder is runs/calibrate/forces/SENSOR.

    With `markers`: press the soft pad, and fit FOTS and the force field to the displacement of its surface. Writes marker_motion.toml
    (which a sensor file names as marker_motion), errors.md, errors.png and arrows.png (marker models against surface tracking on presses
    that the fit did not use) and metrics.json. Without --out the folder is runs/calibrate/markers/SENSOR, with --quick SENSOR-quick. An
    error or Ctrl-C leaves these files as they were; finished presses stay in presses/, and the same command continues from there.
    """

    what: Annotated[str, tyro.conf.Positional]
    """`markers`, a folder of photographs, a dataPack.npz, or a .csv of forces."""
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
    """Resolution of the soft pad's mesh, for `markers`."""
    pads: str = "rigid,coarse"
    """Pads whose forces are fitted together: rigid, and levels of the soft pad."""
    quick: bool = False
    """Few presses: shows that all runs; a poor fit."""

    def run(self) -> int:
        start = time.perf_counter()
        self._refuse_options_of_others()
        self.prepare_warp(soft=self._kind != "a data set")
        if self._kind == "a data set":
            return self._optics(start)
        if self._kind == "a table of forces":
            return self._forces(start)
        sensor = load_sensor(self.sensor)
        out = self.folder("calibrate", "markers", sensor.name + ("-quick" if self.quick else ""))
        with kept_if_interrupted(f"presses that are finished are kept in {out}"):
            written = run_calibrate_markers(
                sensor, out, level=self.level, quick=self.quick, device=self.device, seed=self.seed, start=start
            )
        return print_paths(written)

    @property
    def _kind(self) -> str:
        """Name in ``_TAKES`` of the fit."""
        if self.what == "markers":
            return "'markers'"
        return "a table of forces" if self.what.lower().endswith(".csv") else "a data set"

    def _refuse_options_of_others(self) -> None:
        """An option that says nothing to what is fitted would else be passed over in silence."""
        for default in fields(self):
            owners = [kind for kind, names in _TAKES.items() if default.name in names]
            value = getattr(self, default.name)
            if owners and self._kind not in owners and value != default.default:
                rule = f"belongs to `calibrate` with {' or '.join(owners)}, not with {self.what!r}: leave it out"
                raise InputError(default.name, value=value, rule=rule)

    def _forces(self, start: float) -> int:
        from raytac.report.gel_forces import FORCE_PADS, run_calibrate_forces

        if self.ball_diameter_mm is None:
            raise InputError("ball_diameter_mm", value=None, rule="must be given: the table of forces does not say it")
        sensor = load_sensor(self.sensor)
        written, table = run_calibrate_forces(
            sensor,
            Path(self.what),
            self.folder("calibrate", "forces", sensor.name),
            diameter_mm=check_number("ball_diameter_mm", self.ball_diameter_mm, "(0, 200]", "mm"),
            pads=parse_names(self.pads, "pads", FORCE_PADS),
            device=self.device,
            seed=self.seed,
            start=start,
        )
        print(table)
        return print_paths(written)

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
