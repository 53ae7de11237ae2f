"""``raytac compare-real``: every optical mode against photographs of a real sensor that it was not fitted to."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from raytac.cli.shared import FROM_SCRATCH, INNER, prior_of, read_data
from raytac.io.options import CommonOptions

__all__ = ["CompareRealArgs"]


@dataclass(frozen=True, kw_only=True)
class CompareRealArgs(CommonOptions):
    """Fit ray tracer, table and network to the same real presses of balls and test them, and Phong's model, on the others.

    Writes real.md (tables), real.png (photographs, every mode, signed errors) and metrics.json. Without --out the folder is
    runs/compare-real/SENSOR. An error or Ctrl-C leaves the folder as it was.
    """

    data: Annotated[Path, tyro.conf.Positional]
    """Folder of photographs or dataPack.npz (docs/real-images.md)."""
    sensor: str = "gelsight_mini"
    """Name of a shipped sensor, or path of a sensor file."""
    folds: int = 5
    """Every so manieth press is held out in turn."""
    tested: int | None = None
    """Number of folds that are fitted and tested, for a run that is about regions or ablations; all if not given."""
    ball_diameter_mm: float | None = None
    """Needed by a dataPack.npz, which does not say it."""
    sides: str = FROM_SCRATCH
    """Numbers of red, green and blue LEDs joined by commas, which begin at their walls; `own` begins at the sensor's own lights, and where
    these were fitted to photographs that are tested on, errors are not of held-out presses."""
    split: int = 1
    """With `--sides own`: LEDs that each of the sensor's own is split into, side by side over 1.5 times its width, as LEDs behind
    a diffuser light like a row."""
    regions: bool = True
    """Also fit to one half of the pad and to shallow presses, and test on the others."""
    ablations: bool = True
    """Also fit the ray tracer with one thing after another left out."""
    shadows: bool = False
    """Let the ray tracer cast shadows on the coat: photographs of a GelSight Mini show next to none (docs/accuracy.md)."""
    starts: int = 3
    """Places that a fit of direct light starts from; the best goes on."""
    rounds: int = 3
    """Rounds with the ray tracer after direct light."""
    prior: str = INNER
    """Strength of the LEDs' priors: free, tied, tied-dark, tied-darkest (docs/real-images.md), or `inner`, which chooses by
    cross-validation between halves of the pad within the presses that are fitted to."""

    def run(self) -> int:
        began = time.perf_counter()
        from raytac.report.real import RealSettings, check_folds, compare_real

        sensor, presses, shots, doubtful = read_data(
            self.data, self.sensor, self.ball_diameter_mm, self.sides, self.split, self.device
        )
        check_folds(presses, self.folds)
        settings = RealSettings(
            folds=self.folds,
            tested=self.tested,
            regions=self.regions,
            ablations=self.ablations,
            starts=self.starts,
            rounds=self.rounds,
            prior=prior_of(self.prior),
            shadows=self.shadows,
            device=self.device,
            seed=self.seed,
        )
        out = self.out if self.out is not None else Path("runs") / "compare-real" / sensor.name
        for name in doubtful:
            print(f"the circle of press {name} is doubtful")
        for path in compare_real(sensor, presses, shots, out, settings, began=began):
            print(path)
        return 0
