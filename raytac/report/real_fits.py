"""Fits and tests of ``raytac compare-real``, split by split, and its ablations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from raytac.calibrate.direct_fit import FitSettings
from raytac.calibrate.model_fits import MODES, Models, check_fit, fit_models, images_of, mode_times
from raytac.calibrate.photographs import Photographs
from raytac.calibrate.presses import RealPresses, Split
from raytac.checks import check_known
from raytac.errors import InputError
from raytac.io.metrics import Metric
from raytac.io.progress import Progress
from raytac.optics.trace.config import RayTraced
from raytac.report.real_imprints import FITTED, check_imprints, imprint_metrics, imprint_scores
from raytac.report.real_scores import outliers, press_scores, summary
from raytac.specs import SensorSpec
from raytac.specs.press import PADS
from raytac.specs.sensor import UNMIXED


@dataclass(frozen=True)
class Ablation:
    """An ablation: one thing left out of the ray tracer, which is fitted again without it."""

    sensor: Callable[[SensorSpec], SensorSpec] = lambda sensor: sensor
    fixed: tuple[str, ...] = ()
    """Blocks of parameters that stay at their start."""
    bounce: bool = True
    """Inter-reflection."""
    prior: str | None = None
    """Name of another strength of priors than that of the comparison."""
    settle: bool = True
    """True averages the image at rest (``drift.settled``)."""
    drift: bool = True
    """Session drift, where the comparison has it."""
    other_shadows: bool = False
    """Cast shadows where the comparison has none, and none where it has."""


def _leds(sensor: SensorSpec, **changes: Any) -> SensorSpec:
    leds = tuple(replace(led, **changes) for led in sensor.lights.leds)
    return replace(sensor, lights=replace(sensor.lights, leds=leds))


def _one_a_colour(sensor: SensorSpec) -> SensorSpec:
    first = [next(led for led in sensor.lights.leds if led.layer == layer) for layer in sensor.lights.layers]
    return replace(sensor, lights=replace(sensor.lights, leds=tuple(first)))


HELD = Ablation(fixed=("slope",))
"""Lights fitted under the rigid pad's profile of slopes, which stays."""
ABLATIONS: dict[str, Ablation] = {
    # The case's glow is rendered with the bounce, so it goes too: to be held against no_glow.
    "no_inter_reflection": Ablation(sensor=lambda s: _leds(s, glow=0.0), fixed=("glow",), bounce=False),
    "other_shadows": Ablation(other_shadows=True),
    "point_leds": Ablation(sensor=lambda s: _leds(s, size=(1e-4, 1e-4)), fixed=("height",)),
    "no_lobe": Ablation(sensor=lambda s: _leds(s, lobe=1.0), fixed=("lobe",)),
    "no_glow": Ablation(sensor=lambda s: _leds(s, glow=0.0), fixed=("glow",)),
    "flat_pad": Ablation(sensor=lambda s: replace(s, gelpad=replace(s.gelpad, dome_radius=(np.inf, np.inf), surface=None))),
    "no_response_curve": Ablation(
        sensor=lambda s: replace(s, response=replace(s.response, gamma=1.0, black_level=(0.0, 0.0, 0.0), tone=())),
        fixed=("stray", "tone"),
    ),
    "no_colour_matrix": Ablation(sensor=lambda s: replace(s, response=replace(s.response, colour_mix=UNMIXED)), fixed=("mix",)),
    "no_tone_curve": Ablation(sensor=lambda s: replace(s, response=replace(s.response, tone=())), fixed=("tone",)),
    "one_led_a_colour": Ablation(sensor=_one_a_colour),
    "given_camera": Ablation(fixed=("distance", "distortion")),
    "rigid_pad_imprint": HELD,
    "one_photograph_at_rest": Ablation(settle=False),
    "no_session_drift": Ablation(drift=False),
    "untied_leds": Ablation(prior="free"),
}
"""By the name of their keys in ``metrics.json``."""


@dataclass(frozen=True)
class RealSettings:
    """Settings of a comparison with photographs."""

    folds: int = 5
    tested: int | None = None
    """Folds that are fitted and tested, the first ones; None is all."""
    regions: bool = True
    """Also half of the pad to half, and shallow to deep."""
    ablations: bool = True
    prior: str | None = None
    """Name of the strength of priors; None chooses it within the presses that are fitted to."""
    starts: int = 3
    rounds: int = 3
    shadows: bool = False
    """True lets the ray tracer cast shadows on the coat."""
    drift: bool = True
    """True takes a gain and an offset a channel of every photograph from its far pixels."""
    imprints: tuple[str, ...] = (FITTED,)
    """Imprints of held-out presses under the ray tracer, of ``real_imprints.IMPRINTS``."""
    level: str = "medium"
    """Mesh of the soft pad, one of ``PADS``."""
    device: str = "auto"
    seed: int = 0

    def __post_init__(self) -> None:
        check_fit(prior=self.prior, device=self.device, starts=self.starts, rounds=self.rounds)
        check_imprints(self.imprints)
        check_known("level", self.level, PADS)
        if self.tested is not None and not 1 <= self.tested <= self.folds:
            raise InputError("tested", value=self.tested, rule=f"must be 1 to {self.folds}, the number of folds")


_PREFIXES = {"press": "", "labelled_press": "labelled.", "border_press": "border.", "labelled_border_press": "labelled.border."}
"""Beginning of keys in ``metrics.json`` by kind of split; of others it is the kind itself."""


class RealFits:
    """Fits of a comparison and their scores, split by split.

    Attributes:
        scores: errors of tested presses, by kind of split (with its prefix) and mode.
        tested: names of these presses, by kind of split.
        priors: strength of priors of each fit, by kind of split.
        images: those of tested presses by mode, by the press's number; of the folds.
        outliers: fitted presses that disagree with the others, and why.
        device: of the ray tracer.
    """

    def __init__(
        self, sensor: SensorSpec, presses: RealPresses, shots: Photographs, settings: RealSettings, bar: Progress
    ) -> None:
        self._sensor, self._presses, self._shots, self._settings, self._bar = sensor, presses, shots, settings, bar
        self.scores: dict[str, dict[str, list[dict[str, float]]]] = {}
        self.tested: dict[str, list[str]] = {}
        self.priors: dict[str, list[str]] = {}
        self.images: dict[int, dict[str, np.ndarray]] = {}
        self.outliers: dict[str, str] = {}
        self.device = ""
        self._start_errors: dict[str, list[tuple[float, ...]]] = {}
        self._imprints: dict[str, list[dict[str, float]]] = {}
        self._other_metrics: dict[str, Metric] = {}
        """Times of the modes, and errors of the ablations."""

    def run_split(self, kind: str, split: Split) -> None:
        """Fit to the first presses of a split and test on the others, those at the border apart."""
        sensor, shots, presses = self._sensor, self._shots, self._presses
        train, test = split
        models = self._fit(sensor, train)
        self.priors.setdefault(kind, []).append(models.prior)
        self._start_errors.setdefault(kind, []).append(models.fitted.start_errors)
        self.outliers |= _outliers(models, sensor, shots.take(train), [presses.names[k] for k in train])
        whole = shots.fully_visible
        test, edge = test[whole[test]], test[~whole[test]]
        images = self._test(kind, models, test) if len(test) else {}
        if len(edge):
            self._test(f"border_{kind}", models, edge)
        if kind == "press":
            self.images |= {int(k): {mode: stack[i] for mode, stack in images.items()} for i, k in enumerate(test)}
            self._score_imprints(models, train, test)
        if not self.device:
            some = shots.take(test)
            self._other_metrics |= {f"{mode}.ms": t for mode, t in mode_times(models, some, some.circles).items()}
            self.device = models.modes["raytrace"].device

    def run_ablation(self, name: str, split: Split) -> None:
        """Fit the ray tracer without one thing, and test it on a split's fully visible presses."""
        train, test = split[0], self._whole(split)
        ablation = replace(ABLATIONS[name], prior=ABLATIONS[name].prior or self.priors["press"][0])
        changed = ablation.sensor(self._sensor)
        models = self._fit(changed, train, modes=("raytrace",), ablation=ablation)
        images, _ = _tested(models, self._shots.take(test))
        scores = press_scores(self._sensor, images["raytrace"], self._shots.take(test))
        self._other_metrics |= {f"ablation.{name}.{key}": value for key, value in summary(scores).items()}

    def metrics(self, first: Split) -> dict[str, Metric]:
        """Means over presses, flat; ``first``: the split that ablations are tested on."""
        metrics = dict(self._other_metrics)
        unchanged = self.scores["press"]["raytrace"][: len(self._whole(first))]
        metrics |= {f"ablation.nothing.{key}": value for key, value in summary(unchanged).items()}
        for kind, by_mode in self.scores.items():
            prefix = _PREFIXES.get(kind, f"{kind}.")
            for mode, scores in by_mode.items():
                metrics |= {f"{prefix}{mode}.{key}": value for key, value in summary(scores).items()}
        metrics |= imprint_metrics(self._imprints)
        metrics |= {f"prior.{kind}": ", ".join(names) for kind, names in self.priors.items()}
        for kind, starts in self._start_errors.items():
            for k, errors in enumerate(starts):
                metrics[f"start_errors.{kind}_{k}"] = ", ".join(f"{error:.3f}" for error in errors)
        return metrics

    def _whole(self, split: Split) -> np.ndarray:
        """Numbers of a split's fully visible tested presses."""
        return split[1][self._shots.fully_visible[split[1]]]

    def _test(self, kind: str, models: Models, numbers: np.ndarray) -> dict[str, np.ndarray]:
        """Score presses at refined and at labelled circles; images at the refined ones by mode."""
        shots = self._shots.take(numbers)
        refined, labelled = _tested(models, shots)
        self.tested.setdefault(kind, []).extend(self._presses.names[k] for k in numbers)
        for name, images in ((kind, refined), (f"labelled_{kind}", labelled)):
            for mode, stack in images.items():
                self.scores.setdefault(name, {}).setdefault(mode, []).extend(press_scores(self._sensor, stack, shots))
        return refined

    def _score_imprints(self, models: Models, train: np.ndarray, test: np.ndarray) -> None:
        settings, lit = self._settings, models
        if set(settings.imprints) != {FITTED}:
            lit = self._fit(self._sensor, train, modes=("raytrace",), ablation=HELD)
        pad = {"level": settings.level, "device": settings.device}
        by_key = imprint_scores(models, lit, self._sensor, self._shots.take(test), settings.imprints, **pad)
        for key, scores in by_key.items():
            self._imprints.setdefault(key, []).extend(scores)

    def _fit(
        self, sensor: SensorSpec, numbers: np.ndarray, *, modes: tuple[str, ...] = MODES, ablation: Ablation = Ablation()
    ) -> Models:
        settings = self._settings
        return fit_models(
            sensor,
            self._shots.take(numbers),
            settings=FitSettings(fixed=("gamma", *ablation.fixed)),
            modes=modes,
            device=settings.device,
            seed=settings.seed,
            starts=settings.starts,
            rounds=settings.rounds,
            settle=ablation.settle,
            drift=settings.drift and ablation.drift,
            prior=settings.prior if ablation.prior is None else ablation.prior,
            tracing=RayTraced(shadows=settings.shadows != ablation.other_shadows, bounce=ablation.bounce),
            tick=lambda stage, cost: self._bar.set_postfix_str(f"{stage}, cost {cost:.4g}"),
        )


def _tested(models: Models, shots: Photographs) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Images of every mode and of the background at refined circles and at labelled ones.

    Modes' images have the session drift of their photographs; the background is the one photograph at rest.
    """
    refined, slopes, drift = models.circles(shots), models.fitted.state.slopes, models.drift(shots)
    nothing = np.broadcast_to(shots.background, shots.presses.shape)
    scores = []
    for circles in (refined, shots.circles):
        own = {
            name: drift.applied(images_of(mode, models.sensor_of(name), shots, circles, slopes))
            for name, mode in models.modes.items()
        }
        scores.append(own | {"background": nothing})
    return scores[0], scores[1]


def _outliers(models: Models, sensor: SensorSpec, shots: Photographs, names: Sequence[str]) -> dict[str, str]:
    """Fitted presses that disagree with the others, and why, by the fitted ray tracer."""
    state, drift = models.fitted.state, models.settled.drift
    mode, lit = models.modes["raytrace"], models.fitted.sensor
    images = drift.applied(images_of(mode, lit, shots, state.circles, state.slopes))
    errors = np.array([score["contact_mae"] for score in press_scores(sensor, images, shots)])
    return outliers(names, errors, state.circles, shots)
