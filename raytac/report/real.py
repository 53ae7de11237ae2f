"""``raytac compare-real``: optical modes against photographs of other presses."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from raytac.calibrate.direct_fit import FitSettings
from raytac.calibrate.drift import settled
from raytac.calibrate.grain import measured_grain
from raytac.calibrate.model_fits import ALONE, MODES, Models, check_fit, fit_models, images_of, mode_times
from raytac.calibrate.photographs import Photographs
from raytac.calibrate.presses import RealPresses, Split, by_half, by_press, shallow_to_deep
from raytac.calibrate.ray_fit import FEWEST
from raytac.checks import check_known
from raytac.device import resolve_device
from raytac.errors import InputError
from raytac.io.folder import result_folder
from raytac.io.metrics import Metric, versions, write_metrics
from raytac.io.progress import Progress
from raytac.optics.trace.config import RayTraced
from raytac.report.real_drift import drift_metrics, drift_rows, grain_metrics, session_lines
from raytac.report.real_imprints import FITTED, check_imprints, imprint_metrics, imprint_scores, imprint_table
from raytac.report.real_scores import noise_floor, outliers, press_rows, press_scores, summary
from raytac.specs import SensorSpec
from raytac.specs.press import PADS

SHOWN = 3
"""Presses on the image sheet: in true colour, with their noise, more make a large file."""

_LOG = logging.getLogger("raytac")


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
        sensor=lambda s: replace(s, response=replace(s.response, gamma=1.0, black_level=(0.0, 0.0, 0.0))), fixed=("stray",)
    ),
    "one_led_a_colour": Ablation(sensor=_one_a_colour),
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


def compare_real(
    sensor: SensorSpec, presses: RealPresses, shots: Photographs, out: Path, settings: RealSettings, *, began: float | None = None
) -> list[Path]:
    """Fit, test and write ``real.md``, ``real.png``, tables and ``metrics.json`` to ``out``.

    ``shots`` are the ``presses``. Those at the border are fitted with the others, and tested apart: keys ``border.…``.

    Raises:
        InputError: a split that leaves too few presses, or a folder that cannot be written.
        BackendError: the ray tracer cannot run on ``settings.device``.
    """
    resolve_device(settings.device)
    began = time.perf_counter() if began is None else began
    whole = shots.fully_visible
    splits = real_splits(presses, whole, settings)
    least = FEWEST if settings.prior is not None else 2 * FEWEST  # a choice halves them again
    for kind, (train, _) in splits:  # now, and not after the fits before it
        count = int(whole[train].sum())
        if count < least:
            rule = f"are too few to fit the split {kind!r} to: at least {least}"
            if count >= FEWEST:
                rule += f", or {FEWEST} with a named prior"
            raise InputError("presses", value=count, rule=rule)
    ablations = list(ABLATIONS) if settings.ablations else []
    scores: dict[str, dict[str, list[dict[str, float]]]] = {}
    tested: dict[str, list[str]] = {}
    metrics: dict[str, Metric] = {}
    priors: dict[str, list[str]] = {}
    starts: dict[str, list[tuple[float, ...]]] = {}
    imprints: dict[str, list[dict[str, float]]] = {}
    images: dict[int, dict[str, np.ndarray]] = {}
    bad: dict[str, str] = {}
    with result_folder(out) as folder:  # before the fits, so that a folder that cannot be written is refused at once
        with Progress(total=len(splits) + len(ablations), desc="fits") as bar:
            for number, (kind, (train, test)) in enumerate(splits):
                models = _fitted(sensor, shots.take(train), settings, bar)
                priors.setdefault(kind, []).append(models.prior)
                starts.setdefault(kind, []).append(models.fitted.start_errors)
                bad |= _outliers(models, sensor, shots.take(train), [presses.names[k] for k in train])
                test, edge = test[whole[test]], test[~whole[test]]
                for part, prefix in ((test, ""), (edge, "border_")):
                    if not len(part):
                        continue
                    both = _tested(models, sensor, shots.take(part))
                    tested.setdefault(prefix + kind, []).extend(presses.names[k] for k in part)
                    for where, scores_of in zip(("", "labelled_"), both, strict=True):
                        for mode, stack in scores_of.items():
                            of = scores.setdefault(where + prefix + kind, {}).setdefault(mode, [])
                            of += press_scores(sensor, stack, shots.take(part))
                    if part is test:
                        seen = both[0]
                if kind == "press":
                    lit = models
                    if set(settings.imprints) != {FITTED}:
                        lit = _fitted(sensor, shots.take(train), settings, bar, modes=("raytrace",), one=HELD)
                    own = {"level": settings.level, "device": settings.device}
                    for key, of in imprint_scores(models, lit, sensor, shots.take(test), settings.imprints, **own).items():
                        imprints.setdefault(key, []).extend(of)
                    images |= {int(k): {mode: stack[i] for mode, stack in seen.items()} for i, k in enumerate(test)}
                if number == 0:
                    some = shots.take(test)
                    metrics |= {f"{mode}.ms": t for mode, t in mode_times(models, sensor, some, some.circles).items()}
                    device = models.modes["raytrace"].device
                bar.update()
            train, test = splits[0][1]
            test = test[whole[test]]
            for name in ablations:
                one = replace(ABLATIONS[name], prior=ABLATIONS[name].prior or priors["press"][0])
                changed = one.sensor(sensor)
                models = _fitted(changed, shots.take(train), settings, bar, modes=("raytrace",), one=one)
                seen, _ = _tested(models, changed, shots.take(test))
                for key, value in summary(press_scores(sensor, seen["raytrace"], shots.take(test))).items():
                    metrics[f"ablation.{name}.{key}"] = value
                bar.update()
            for key, value in summary(scores["press"]["raytrace"][: len(test)]).items():
                metrics[f"ablation.nothing.{key}"] = value
        for kind, by_mode in scores.items():
            prefix = _PREFIXES.get(kind, f"{kind}.")
            for mode, of in by_mode.items():
                metrics |= {f"{prefix}{mode}.{key}": value for key, value in summary(of).items()}
        metrics |= imprint_metrics(imprints)
        metrics |= {f"prior.{kind}": ", ".join(of) for kind, of in priors.items()}
        metrics |= {
            f"start_errors.{kind}_{k}": ", ".join(f"{error:.3f}" for error in errors)
            for kind, of in starts.items()
            for k, errors in enumerate(of)
        }
        metrics["noise_floor"] = noise_floor(sensor, shots.take(whole))
        steady = settled(sensor, shots.take(whole), drift=settings.drift)
        level = float(steady.shots.background.mean())
        metrics |= drift_metrics(steady.drift, steady.background, level)
        metrics |= grain_metrics(measured_grain(sensor, steady), level)
        metrics["outliers"] = ", ".join(bad)
        for name, reason in bad.items():
            _LOG.info("press %s is an outlier: %s", name, reason)
        head: dict[str, Metric] = {
            "command": "compare-real",
            "device": device,
            "seed": settings.seed,
            "sensor": sensor.name,
            "presses": int(whole.sum()),
            "presses_at_border": int((~whole).sum()),
            "drift": int(settings.drift),
            "folds": settings.folds,
            "tested_folds": len(priors["press"]),
            "shadows": int(settings.shadows),
            "imprints": ", ".join(settings.imprints),
            "imprint_level": settings.level,
            "starts": settings.starts,
            "rounds": settings.rounds,
            "leds": len(sensor.lights.leds),
            "start_lights": "at walls" if sensor.lights.source is None else sensor.lights.source.stem,
            **versions(),
        }
        (folder / "real.md").write_text(table_text(metrics, ablations), "utf-8")
        rows = drift_rows(tuple(presses.names[k] for k in np.flatnonzero(whole)), steady.drift)
        (folder / "drift.csv").write_text("\n".join(rows) + "\n", "utf-8")
        (folder / "presses.csv").write_text("\n".join(press_rows(tested, scores)) + "\n", "utf-8")
        shown = sorted(images)[len(images) // (2 * SHOWN) :: max(1, len(images) // SHOWN)][:SHOWN]
        draw(shots.presses[shown], [images[k] for k in shown], [shots.circles[k] for k in shown], folder / "real.png")
        write_metrics(folder / "metrics.json", head | metrics | {"wall_s": time.perf_counter() - began})
    return [out / name for name in ("real.md", "real.png", "drift.csv", "presses.csv", "metrics.json")]


_PREFIXES = {"press": "", "labelled_press": "labelled.", "border_press": "border.", "labelled_border_press": "labelled.border."}
"""Beginning of keys in ``metrics.json`` by kind of split; of others it is the kind itself."""


def real_splits(presses: RealPresses, whole: np.ndarray, settings: RealSettings) -> list[tuple[str, Split]]:
    """Splits by name; ``whole`` (N,) marks presses that are fully visible.

    Those and the presses at the border are split apart, so that folds of the former do not depend on the latter. From half to half,
    and from shallow to deep, presses at the border are only fitted.
    """
    inner, edge = np.flatnonzero(whole), np.flatnonzero(~whole)
    splits: list[tuple[str, Split]] = []
    for fold, (train, test) in enumerate(by_press(len(inner), settings.folds)[: settings.tested]):
        held_out = np.arange(len(edge)) % settings.folds == fold
        own = np.concatenate([inner[train], edge[~held_out]]), np.concatenate([inner[test], edge[held_out]])
        splits.append(("press", own))
    if settings.regions:
        visible = presses.take(inner)
        middle, relative = presses.resolution[0] / 2, presses.circles[:, 2] / presses.ball_radius
        is_left = presses.circles[edge, 0] < middle
        deepest = shallow_to_deep(visible)
        for kind, (train, test), also in (
            ("left_right", by_half(visible)[0], is_left),
            ("right_left", by_half(visible)[1], ~is_left),
            ("shallow_deep", deepest, relative[edge] <= relative[inner[deepest[0]]].max()),
        ):
            splits.append((kind, (np.concatenate([inner[train], edge[also]]), inner[test])))
    return splits


def _fitted(
    sensor: SensorSpec,
    shots: Photographs,
    settings: RealSettings,
    bar: Any,
    *,
    modes: tuple[str, ...] = MODES,
    one: Ablation = Ablation(),
) -> Models:
    return fit_models(
        sensor,
        shots,
        settings=FitSettings(fixed=("gamma", *one.fixed)),
        modes=modes,
        device=settings.device,
        seed=settings.seed,
        starts=settings.starts,
        rounds=settings.rounds,
        settle=one.settle,
        drift=settings.drift and one.drift,
        prior=settings.prior if one.prior is None else one.prior,
        tracing=RayTraced(shadows=settings.shadows != one.other_shadows, bounce=one.bounce),
        tick=lambda stage, cost: bar.set_postfix_str(f"{stage}, cost {cost:.4g}"),
    )


def _tested(models: Models, sensor: SensorSpec, shots: Photographs) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Images of every mode and of the background at refined circles and at labelled ones.

    Modes' images have the session drift of their photographs; the background is the one photograph at rest.
    """
    refined, slopes, drift = models.circles(shots), models.fitted.state.slopes, models.drift(shots)
    nothing = np.broadcast_to(shots.background, shots.presses.shape)
    scores = []
    for circles in (refined, shots.circles):
        own = {name: drift.applied(images_of(mode, sensor, shots, circles, slopes)) for name, mode in models.modes.items()}
        scores.append(own | {"background": nothing})
    return scores[0], scores[1]


def _outliers(models: Models, sensor: SensorSpec, shots: Photographs, names: Sequence[str]) -> dict[str, str]:
    """Fitted presses that disagree with the others, and why, by the fitted ray tracer."""
    state, drift = models.fitted.state, models.settled.drift
    images = drift.applied(images_of(models.modes["raytrace"], sensor, shots, state.circles, state.slopes))
    errors = np.array([score["contact_mae"] for score in press_scores(sensor, images, shots)])
    return outliers(names, errors, state.circles, shots)


def check_folds(presses: RealPresses, folds: int) -> None:
    """Raises ``InputError`` for folds that leave too few fully visible presses to fit to."""
    count = int(presses.fully_visible.sum())
    if count - -(-count // max(folds, 1)) < FEWEST:
        raise InputError("presses", value=count, rule=f"are too few for {folds} folds: {FEWEST} must be left to fit to")


_ROWS = (
    ("raytrace", "ray tracer"),
    (ALONE, "ray tracer, no photograph"),
    ("taxim", "table"),
    ("mlp", "network"),
    ("phong", "Phong"),
    ("background", "background only"),
)
_SPLITS = (("left_right.", "left half → right"), ("right_left.", "right half → left"), ("shallow_deep.", "shallow → deep"))


def table_text(metrics: Mapping[str, Metric], ablations: Sequence[str]) -> str:
    """Markdown tables of the figures; errors in levels of 255."""

    def cell(key: str, digits: str = ".2f") -> str:
        value = metrics.get(key)
        return "–" if value is None else format(value, digits)

    measures = (
        "contact MAE | contact RMSE | ring MAE | box PSNR [dB] | box SSIM | frame MAE | contact, ring MAE, labelled circles"
    )
    lines = [f"| mode | {measures} | ms |", "|" + "---|" * 9]
    for key, name in _ROWS:
        cells = [cell(f"{key}.{m}") for m in ("contact_mae", "contact_rmse", "ring_mae", "box_psnr")]
        cells += [
            cell(f"{key}.box_ssim", ".3f"),
            cell(f"{key}.frame_mae"),
            cell(f"labelled.{key}.contact_mae") + ", " + cell(f"labelled.{key}.ring_mae"),
            cell(f"{key}.ms", ".1f"),
        ]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    lines += ["", f"Noise floor: {cell('noise_floor')}.", ""]
    shown = [(prefix, name) for prefix, name in _SPLITS if f"{prefix}raytrace.contact_mae" in metrics]
    if shown:
        lines += ["| contact MAE (ring MAE) | " + " | ".join(name for _, name in shown) + " |", "|" + "---|" * (len(shown) + 1)]
        for key, name in _ROWS:
            cells = [f"{cell(f'{prefix}{key}.contact_mae')} ({cell(f'{prefix}{key}.ring_mae')})" for prefix, _ in shown]
            lines.append(f"| {name} | {' | '.join(cells)} |")
        lines.append("")
    if "border.raytrace.contact_mae" in metrics:
        lines += ["| held-out presses at the border | contact MAE | ring MAE |", "|---|---|---|"]
        for key, name in _ROWS:
            lines.append(f"| {name} | {cell(f'border.{key}.contact_mae')} | {cell(f'border.{key}.ring_mae')} |")
        lines.append("")
    lines += session_lines(metrics)
    lines += imprint_table(metrics)
    if ablations:
        lines += ["| ray tracer, first fold | contact MAE | ring MAE |", "|---|---|---|"]
        for name in ("nothing", *ablations):
            row = f"ablation.{name}"
            text = "nothing left out" if name == "nothing" else name.replace("_", " ")
            lines.append(f"| {text} | {cell(f'{row}.contact_mae')} | {cell(f'{row}.ring_mae')} |")
        lines.append("")
    return "\n".join(lines)


def draw(
    real: np.ndarray, images: list[dict[str, np.ndarray]], circles: list[np.ndarray], path: Path, labels: Sequence[str] = ()
) -> None:
    """Draw a row a press, cut to the contact: photograph, modes, signed errors (grey is none).

    ``labels``: text at the left of each row.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle

    modes = [(key, name) for key, name in _ROWS if key in images[0] and key not in (ALONE, "background")]
    columns = [
        "photograph",
        *(name for _, name in modes),
        *(f"{name}, error × 4" if len(modes) > 1 else "error × 4" for _, name in modes),
    ]
    with rc_context({"font.size": 6.5}):
        figure = Figure(figsize=(1.1 * len(columns), 1.12 * len(real)), layout="constrained")
        axes = figure.subplots(len(real), len(columns), squeeze=False)
        for line, photo, own, (x, y, r) in zip(axes, real, images, circles, strict=True):
            low_x, low_y = (max(0, int(c - 2.2 * r)) for c in (x, y))
            box = np.s_[low_y : int(y + 2.2 * r), low_x : int(x + 2.2 * r)]
            shown = [photo, *(own[key] for key, _ in modes), *(128 + 4 * (own[key].astype(float) - photo) for key, _ in modes)]
            for axis, image in zip(line, shown, strict=True):
                axis.imshow(np.clip(image[box], 0, 255).astype(np.uint8))
                axis.set(xticks=[], yticks=[])
            circle = Circle(
                (x - low_x - 0.5, y - low_y - 0.5), r, fill=False, color="white", linewidth=0.5, linestyle=(0, (4, 4))
            )
            line[0].add_patch(circle)
        for axis, name in zip(axes[0], columns, strict=True):
            axis.set_title(name)
        for axis, label in zip(axes[:, 0], labels, strict=False):
            axis.set_ylabel(label)
        figure.savefig(path, dpi=110)
