"""Strength of a fit's priors, by cross-validation within the presses that are fitted.

Weak priors let LEDs go where they explain the presses at hand best, and be wrong where no press was. So the presses at hand are cut into
halves of the pad, along x and along y; direct light is fitted to each half with every candidate and tested on the other. Presses that a
model is judged on have no part in it. Four halves tell little: another strength than the ``USUAL`` is taken only where it is better by
more than the standard error of the difference (after the one-standard-error rule of L. Breiman, J. Friedman, R. Olshen, C. Stone,
Classification and Regression Trees, 1984, section 3.4.3).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping

import numpy as np

from raytac.calibrate.direct_fit import SIGMA, DirectFit, FitSettings, FitState
from raytac.calibrate.photographs import Photographs
from raytac.calibrate.ray_fit import FACTOR, FEWEST, first_state, solve_direct
from raytac.errors import InputError
from raytac.specs import SensorSpec

INNER = "inner"
"""Name of the choice by cross-validation, beside the names of ``STRENGTHS``."""

STRENGTHS: dict[str, dict[str, float]] = {
    "free": {"prior": 30.0, "ties": 0.0, "rest_weight": 0.3},
    "tied": {"prior": 300.0, "ties": 1000.0, "rest_weight": 0.3},
    "tied-dark": {"prior": 300.0, "ties": 1000.0, "rest_weight": 0.1},
    "tied-darkest": {"prior": 300.0, "ties": 1000.0, "rest_weight": 0.03},
}
"""``FitSettings`` by name: ties of LEDs of a side, and weight of the brightness at rest."""
CHOICES = {name: values for name, values in STRENGTHS.items() if values["ties"]}
"""Candidates of the choice. LEDs of a side are alike, as sensors are built so."""
USUAL = "tied-dark"
SAMPLES = (90, 45)
"""Pixels of a press that count, inside and outside its circle: fewer than in the fit."""
STEPS, CIRCLE_STEPS = 40, 6
"""Most steps of a fit, and of that of the tested presses' circles."""


def choose_strength(
    sensor: SensorSpec,
    shots: Photographs,
    settings: FitSettings,
    *,
    candidates: Mapping[str, Mapping[str, float]] = CHOICES,
    seed: int = 0,
    tick: Callable[[str, float], None] | None = None,
) -> tuple[str, dict[str, float]]:
    """Name of the candidate chosen, and the error of each.

    The error is the mean absolute residual [levels] in contacts of other halves. Raises InputError for too few presses to halve.
    """
    if len(shots.circles) < 2 * FEWEST:
        rule = f"are too few to choose the strength of priors within: at least {2 * FEWEST}, or name one with --prior"
        raise InputError("presses", value=len(shots.circles), rule=rule)
    few = dataclasses.replace(settings, samples=SAMPLES)
    all_fixed = dataclasses.replace(few, fixed=tuple(SIGMA))
    errors = {}
    for name, values in candidates.items():
        own, results = dataclasses.replace(few, **values), []
        for train, test in _halves(shots.circles):
            fitted, tested = shots.take(train), shots.take(test)
            begin = first_state(sensor, fitted, own, seed)
            _, state = solve_direct(DirectFit(sensor, fitted, begin, own, factor=FACTOR, seed=seed), begin, STEPS)
            start = FitState(state.p, state.slopes, tested.circles.copy())
            problem = DirectFit(sensor, tested, start, all_fixed, factor=FACTOR, seed=seed)
            off, _ = problem.residuals(problem.solve(start, CIRCLE_STEPS))
            results.append(float(np.abs(off[problem.inside]).mean()))
            if tick is not None:
                tick(f"prior {name}", results[-1])
        errors[name] = np.array(results)
    means = {name: float(results.mean()) for name, results in errors.items()}
    best = min(means, key=means.__getitem__)
    if USUAL in errors:
        worse = errors[USUAL] - errors[best]
        if worse.mean() <= worse.std(ddof=1) / np.sqrt(len(worse)):
            best = USUAL
    return best, means


def _halves(circles: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """(fitted, tested) pairs: the halves by x and by y, each in both directions."""
    splits = []
    for axis in (0, 1):
        order = np.argsort(circles[:, axis], kind="stable")
        a, b = np.sort(order[: len(order) // 2]), np.sort(order[len(order) // 2 :])
        splits += [(a, b), (b, a)]
    return splits
