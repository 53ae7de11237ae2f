"""``raytac compare``: every optical mode on the same gel surfaces, error beside time.

Rows (scene x resolution x mode) are measured scene after scene and kept in ``out/rows``, converged references in ``out/references``:
the same command run again goes on where it stopped.
"""

from __future__ import annotations

import hashlib
import logging
import math
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from raytac.errors import InputError, RaytacError
from raytac.gel.surface import GelSurface
from raytac.io.code_digest import code_digest
from raytac.io.metrics import Metric, versions
from raytac.io.progress import Progress
from raytac.optics.trace.config import RayTraced
from raytac.report.compare.marker_error import PAD as MARKER_PAD
from raytac.report.compare.marker_error import MarkerErrors, marker_errors
from raytac.report.compare.modes import Mode, Setting, chosen_modes, comparison_modes
from raytac.report.compare.settings import CompareSettings, expected_bake_seconds, expected_seconds
from raytac.report.compare.store import References, Row, RowStore, Value, row_key
from raytac.report.image_error import METRICS, has_flip, image_errors, psnr, rmse
from raytac.report.image_error import mae as mean_absolute
from raytac.report.measure import machine, moving, once, timed_within
from raytac.report.press import press_peaks
from raytac.report.tracers import Tracers, path_trace
from raytac.specs import load_sensor

if TYPE_CHECKING:
    from raytac.optics.base import OpticalMode

LOG = logging.getLogger("raytac")
REGIONS = ("frame", "contact", "ring", "box")
"""Parts of an image that errors are taken of, by ``raytac.report.image_error.regions``."""
BATCH = {"cpu": 8, "cuda": 64}
"""Environments of the batched timing where none are asked for."""
TURNS = 6
"""Surfaces that take turns in a timing."""
CODE = ("raytac.report.image_error", "raytac.report.measure")
"""Modules on which every row depends, besides those of its mode."""
DISTRIBUTIONS = ("numpy", "mitsuba", "drjit", "mitsuba-oidn", "scikit-image", "flip-evaluator", "taxim", "jax")
"""Packages whose version is part of a row's key."""


@dataclass(frozen=True)
class LeftOut:
    """A mode that did not run, and why."""

    resolution: str
    mode: str
    label: str
    reason: str


@dataclass(frozen=True)
class Comparison:
    """All that a report is made of."""

    settings: CompareSettings
    device: str
    """``cpu`` or ``cuda``."""
    rows: tuple[Row, ...]
    references: dict[tuple[str, str], np.ndarray]
    """8-bit reference (H, W, 3) by (scene, resolution)."""
    left_out: tuple[LeftOut, ...]
    measured: int
    """Rows measured in this run; the others were kept from an earlier one."""
    facts: dict[str, Metric]
    """Machine and versions."""
    markers: MarkerErrors | None = None
    """Marker models against surface tracking, if that was asked for."""
    pending: tuple[str, ...] = ()
    """Scenes that are not measured yet, as ``coin, 320x240``; empty at the end."""


def run_comparison(
    settings: CompareSettings,
    out: Path,
    modes: Sequence[Mode] | None = None,
    report: Callable[[Comparison], object] | None = None,
) -> Comparison:
    """Measure every row that ``out`` does not hold yet, and return all.

    Args:
        settings: what to compare; checked first.
        out: folder of ``rows`` and ``references``, made if need be.
        modes: those that the settings name if None.
        report: called after each scene but the last with all that is known so far.

    Raises:
        RaytacError: as ``CompareSettings.check``; ``out`` is a file; or the ray tracer does not run on the device.
    """
    settings.check()
    if out.exists() and not out.is_dir():
        raise InputError("out", value=out, rule="must be a folder, and a file of that name exists")
    from raytac.optics.runtime import load_mitsuba

    device = load_mitsuba(settings.device)[1]
    if modes is None:
        modes = chosen_modes(comparison_modes(settings.spp, quick=settings.quick), settings.modes)
    run = _Run(settings, device, RowStore(out / "rows", Progress.write), out / "references", machine())
    scenes = [(size, Path(scene).stem) for size in settings.resolutions for scene in settings.scenes]
    with Progress(total=len(scenes) * (len(modes) + 1), desc="compare", unit="step") as bar:
        for k, (size, scene) in enumerate(scenes):
            if size != run.size:
                run.begin(size, modes, bar)
            run.measure(scene, modes, bar)
            if report is not None and k + 1 < len(scenes):
                report(run.comparison(tuple(f"{name}, {w}x{h}" for (w, h), name in scenes[k + 1 :])))
        markers = None
        if settings.markers:
            bar.set_postfix_str("markers on the soft pad")
            markers = _marker_errors(settings, device)
    return run.comparison(markers=markers)


def _marker_errors(settings: CompareSettings, device: str) -> MarkerErrors:
    """Errors on presses that no fit sees; with ``quick`` on few of them."""
    from raytac.markers.calibration_presses import HELD_OUT, QUICK_HELD_OUT
    from raytac.report.markers import press_all

    spec, pad = load_sensor(settings.sensor), settings.pad or ("coarse" if settings.quick else MARKER_PAD)
    frames = press_all(spec, QUICK_HELD_OUT if settings.quick else HELD_OUT, pad, device, progress=True)
    return marker_errors(spec, frames, pad=pad, device=device)


class _Run:
    """State of a comparison under way."""

    def __init__(
        self, settings: CompareSettings, device: str, store: RowStore, references: Path, facts: dict[str, Metric]
    ) -> None:
        self.settings, self.device, self.store, self.folder = settings, device, store, references
        self.batch = settings.batch or BATCH[device]
        known = versions()
        self._facts = facts | known | {key: value for key, value in versions(DISTRIBUTIONS).items() if key not in known}
        self.machine = {key: value for key, value in facts.items() if key != "machine.load_at_start"}
        self.rows: list[Row] = []
        self.images: dict[tuple[str, str], np.ndarray] = {}
        self.left_out: list[LeftOut] = []
        self.measured = 0
        self.size: tuple[int, int] = (0, 0)
        """(width, height) that is measured now [px]."""
        self._digests: dict[tuple[str, ...], str] = {}

    def comparison(self, pending: tuple[str, ...] = (), markers: MarkerErrors | None = None) -> Comparison:
        """All that is measured so far."""
        rows, left_out = tuple(self.rows), tuple(self.left_out)
        images = dict(self.images)
        return Comparison(self.settings, self.device, rows, images, left_out, self.measured, self._facts, markers, pending)

    def begin(self, size: tuple[int, int], modes: Sequence[Mode], bar: Progress) -> None:
        """Press every scene for images of ``size``, and tell how long the comparison will take."""
        settings, first = self.settings, self.size == (0, 0)
        self.size = size
        bar.set_postfix_str(f"{self._size_text}: presses")
        spec, self._surfaces = press_peaks(settings.sensor, settings.scenes, size, settings.seed)
        self._tracers = Tracers(spec, self.device, settings.seed)
        self._references = References(self.folder, self._tracers, size, settings.reference_spp, Progress.write)
        self._built: dict[str, tuple[OpticalMode, float | None]] = {}
        self._families: set[str] = set()
        self._failed: set[str] = set()
        if first:
            bar.set_postfix_str("estimate of the time")
            surface = next(iter(self._surfaces.values()))
            tracer = self._tracers.get(size, RayTraced("reference"))
            path_trace(tracer, surface, 1, 0)  # compiles
            sample_s = 1e-3 * once(lambda seed: path_trace(tracer, surface, 4, seed), 1) / 4
            bake_s = expected_bake_seconds(spec, modes, self._frame_seconds)
            seconds = expected_seconds(settings, modes, sample_s, bake_s)
            LOG.info(
                "about %s for %d scenes and %d modes, if nothing is kept from before%s; %s/report.html grows after each scene",
                Progress.format_interval(seconds),
                len(settings.scenes) * len(settings.resolutions),
                len(modes),
                f", of which {Progress.format_interval(bake_s)} bake a table, once" if bake_s else "",
                self.folder.parent,
            )

    def _frame_seconds(self) -> float:
        """Time of a frame of ``fast`` of the sensor's own size [s]."""
        fast, surface = self._tracers.get(self._tracers.spec.camera.resolution), next(iter(self._surfaces.values()))
        fast.render(surface)  # compiles
        return 1e-3 * once(fast.render, surface)

    @property
    def _size_text(self) -> str:
        return f"{self.size[0]}x{self.size[1]}"

    def measure(self, name: str, modes: Sequence[Mode], bar: Progress) -> None:
        """Rows of one scene, by every mode."""
        size = self._size_text
        bar.set_postfix_str(f"{size} {name}: reference")
        scene = _Scene(name, self._surfaces[name], self._references, self._tracers, self.size)
        self.images[name, size] = scene.truth
        bar.update()
        for mode in modes:
            if mode.name not in self._failed:
                bar.set_postfix_str(f"{size} {name}: {mode.label}")
                try:
                    self._measure_mode(mode, scene)
                except RaytacError as error:
                    self._failed.add(mode.name)
                    self.left_out.append(LeftOut(size, mode.name, mode.label, str(error)))
            self._families.add(mode.family)
            bar.update()

    def _measure_mode(self, mode: Mode, scene: _Scene) -> None:
        key, file = self._key(mode, scene), f"{scene.name}-{self._size_text}-{mode.name}"
        row = self.store.read(file, key)
        if row is None:
            if mode.name not in self._built:
                self._built[mode.name] = self._build(mode, scene)
            built, first_image_s = self._built[mode.name]
            row = self._measure(mode, built, scene, first_image_s)
            self.store.write(file, key, row)
            self.measured += 1
        self.rows.append(row)

    def _build(self, mode: Mode, scene: _Scene) -> tuple[OpticalMode, float | None]:
        """The mode, and its time to the first image [s] unless one of its family came before."""
        setting = Setting(self._tracers, self.size)
        if mode.prepare is not None:
            mode.prepare(setting)
        start = time.perf_counter()
        built = mode.build(setting)
        _rgb(built, scene.surface)
        return built, None if mode.family in self._families else time.perf_counter() - start

    def _key(self, mode: Mode, scene: _Scene) -> str:
        settings = self.settings
        return row_key(
            {
                "reference": scene.key,  # sensor, lights, surface, size, seed, device, reference's samples and code
                "contact": hashlib.sha256(scene.surface.contact.tobytes()).hexdigest(),
                "mode": [mode.name, mode.options],
                "timing": [settings.frames, settings.budget_s, self.batch],
                "code": self._digest(mode),
                "versions": versions(DISTRIBUTIONS),
                "machine": self.machine,
                "flip": has_flip(),
            }
        )

    def _digest(self, mode: Mode) -> str:
        """Digest of the code behind a mode's row; each source is read once."""
        code = mode.code()
        if code not in self._digests:
            self._digests[code] = code_digest(*code, *CODE)
        return self._digests[code]

    def _measure(self, mode: Mode, built: OpticalMode, scene: _Scene, first_image_s: float | None) -> Row:
        """Times, memory and errors of a mode on a scene."""
        image = _rgb(built, scene.surface)[0]
        figures: dict[str, Value] = {
            "scene": scene.name,
            "resolution": self._size_text,
            "mode": mode.name,
            "family": mode.family,
            "label": mode.label,
            "words": mode.words or mode.family,
            "short": mode.short or mode.family,
            "unbiased": mode.unbiased,
            "spp": mode.spp,
            "sensor": self._tracers.spec.name,
            "device": built.device,
            "seed": self.settings.seed,
            "reference_spp": self.settings.reference_spp,
            "first_image_s": first_image_s,
        }
        figures |= self._times(built, scene.surface)
        figures |= self._memory(built, scene.surface, figures["batch_ms_per_frame"] is not None)
        errors = image_errors(image, scene.truth, scene.masks) if mode.has_reference else {}
        for region in REGIONS:
            for metric in METRICS:
                figures[f"{region}_{metric}"] = _finite(errors.get(f"{region}.{metric}"))
            for metric, value in scene.noise[region].items():
                figures[f"noise_{region}_{metric}"] = _finite(value)
        # Half of the mean square or more is then the reference's own noise, and the figure is a bound, not a value.
        error, noise = figures["frame_rmse"], figures["noise_frame_rmse"]
        figures["at_noise"] = None if error is None else bool(float(error) < math.sqrt(2) * float(noise or 0.0))
        figures["note"] = "; ".join(text for text in (mode.note, str(figures.pop("batch_note"))) if text)
        return Row(figures, image)

    def _times(self, built: OpticalMode, surface: GelSurface) -> dict[str, Value]:
        """Warm medians at batch 1 and at a batch, over surfaces that change."""
        settings = self.settings
        load = os.getloadavg()[0]
        ms = timed_within(built.render, moving([surface], 1, min(TURNS, settings.frames)), settings.frames, settings.budget_s)
        figures: dict[str, Value] = {
            "ms": float(np.median(ms)),
            "ms_p90": float(np.percentile(ms, 90)),
            "frames": len(ms),
            "load": load,
            "batch": self.batch,
            "batch_ms_per_frame": None,
            "batch_calls": None,
            "batch_note": "",
        }
        if 4 * self.batch * float(np.median(ms)) > 1e3 * settings.budget_s:
            figures["batch_note"] = f"too slow to be timed at batch {self.batch}"
            return figures
        try:
            calls = timed_within(built.render, moving([surface], self.batch, 3), settings.frames, settings.budget_s)
        except RaytacError as error:
            figures["batch_note"] = f"does not run at batch {self.batch}: {error}"
            return figures
        return figures | {"batch_ms_per_frame": float(np.median(calls)) / self.batch, "batch_calls": len(calls)}

    def _memory(self, built: OpticalMode, surface: GelSurface, batched: bool) -> dict[str, Value]:
        """Peak of device arrays of a call, its growth per environment [MiB]; None if not Dr.Jit's."""
        from raytac.optics.runtime import peak_bytes

        one, many = (moving([surface], n, 1)[0] for n in (1, self.batch))
        alone = peak_bytes(lambda: built.render(one), self.device)
        if alone == 0:
            return {"memory_mib": None, "memory_mib_per_env": None}
        together = peak_bytes(lambda: built.render(many), self.device) if batched else None
        each = None if together is None else max(0.0, (together - alone) / (self.batch - 1) / 2**20)
        return {"memory_mib": alone / 2**20, "memory_mib_per_env": each}


class _Scene:
    """One press at one resolution, with its references; masks are made when a row needs them."""

    def __init__(self, name: str, surface: GelSurface, references: References, tracers: Tracers, size: tuple[int, int]) -> None:
        self.name, self.surface, self._tracers, self._size = name, surface, tracers, size
        self.key = references.key(surface)
        halves = references.halves(name, surface)
        encode = tracers.get(size).response.encode_numpy
        self.truth = encode(halves.mean(axis=0))
        self._halves = [encode(half) for half in halves]

    @cached_property
    def masks(self) -> dict[str, np.ndarray]:
        return self._tracers.regions(self._size, self.surface)

    @cached_property
    def noise(self) -> dict[str, dict[str, float]]:
        """Noise of the reference by region: half the difference of its independent halves."""
        one, two = self._halves
        figures = {}
        for region, mask in self.masks.items():
            off = rmse(one[mask], two[mask]) / 2 if mask.any() else math.nan
            absolute = mean_absolute(one[mask], two[mask]) / 2 if mask.any() else math.nan
            figures[region] = {"mae": absolute, "rmse": off, "psnr": psnr(off)}
        return figures


def _rgb(mode: OpticalMode, surface: GelSurface) -> np.ndarray:
    rgb = mode.render(surface).rgb
    if rgb is None:
        raise InputError("mode", value=mode.label, rule="must render rgb to be compared")
    return rgb


def _finite(value: float | None) -> float | None:
    """None for what is not a finite number (a region that is not there, PSNR of equal images)."""
    return None if value is None or not math.isfinite(value) else float(value)
