"""``raytac compare-real``: optical modes against photographs that they were not fitted to."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from raytac.cli.fit_options import FitOptions
from raytac.cli.shared import named, print_paths
from raytac.io.options import parse_names
from raytac.specs.press import PADS
from raytac.warp_messages import quiet_warp


@dataclass(frozen=True, kw_only=True)
class CompareRealArgs(FitOptions):
    """Fit ray tracer, table and network to real presses of balls, and test them on the others.

    Phong's model is tested too. Writes real.md (tables), real.png (photographs, every mode, signed errors), drift.csv, presses.csv (errors
    of every held-out press) and metrics.json. Without --out the folder is runs/compare-real/SENSOR. An error or Ctrl-C leaves the folder as
    it was.
    """

    data: Annotated[Path, tyro.conf.Positional]
    """Folder of photographs or dataPack.npz (docs/guide/calibrate.md)."""
    sensor: str = "gelsight_mini"
    """Name of a shipped sensor, or path of a sensor file."""
    folds: int = 5
    """Number of folds: each is held out in turn, every fifth press with 5."""
    tested: int | None = None
    """Number of folds to fit and test, for a run about regions or ablations; all if not given."""
    regions: bool = True
    """Also fit to one half of the pad and to shallow presses, and test on the others."""
    ablations: bool = True
    """Also fit the ray tracer with one thing after another left out."""
    shadows: bool = False
    """Let the ray tracer cast shadows on the coat; a real Mini shows next to none."""
    imprint: str = "fitted"
    """Imprints to compare, joined by commas: fitted, rigid, ipc (docs/guide/calibrate.md).

    Under rigid and ipc the pad's physics gives the gel's surface, at the depth where the edge of the imprint is as wide as the label's
    circle, and lights are fitted under the rigid pad's profile of slopes."""
    imprint_level: Annotated[str, named(PADS)] = "medium"
    """Mesh of the soft pad of `--imprint ipc`."""

    def run(self) -> int:
        began = time.perf_counter()
        from raytac.report.real import check_folds, compare_real
        from raytac.report.real_fits import RealSettings

        quiet_warp()
        sensor, presses, shots = self.read(self.data, self.sensor)
        check_folds(presses, self.folds)
        settings = RealSettings(
            folds=self.folds,
            tested=self.tested,
            regions=self.regions,
            ablations=self.ablations,
            starts=self.starts,
            rounds=self.rounds,
            prior=self.chosen_prior,
            shadows=self.shadows,
            drift=self.drift,
            imprints=parse_names(self.imprint, "imprint"),
            level=self.imprint_level,
            device=self.device,
            seed=self.seed,
        )
        out = self.folder("compare-real", sensor.name)
        return print_paths(compare_real(sensor, presses, shots, out, settings, began=began))
