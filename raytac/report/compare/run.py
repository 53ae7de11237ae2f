"""``raytac compare``: every optical mode on the same gel surfaces, error beside time.

Rows (scene x resolution x mode) are measured one after another and kept in ``out/rows``, converged references in ``out/references``:
the same command run again goes on where it stopped.
"""

from __future__ import annotations

import hashlib
import math
import os
import time
from collections.abc import Sequence
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
from raytac.report.compare.marker_error import PAD as MARKER_PAD
from raytac.report.compare.marker_error import MarkerErrors, marker_errors
from raytac.report.compare.modes import Mode, Setting, comparison_modes
from raytac.report.compare.physics_error import PhysicsError, physics_errors
from raytac.report.compare.settings import CompareSettings
from raytac.report.compare.store import References, Row, RowStore, Value, row_key
from raytac.report.image_error import METRICS, has_flip, image_errors, psnr, rmse
from raytac.report.image_error import mae as mean_absolute
from raytac.report.measure import machine, moving, timed_within
from raytac.report.press import press_peaks
from raytac.report.tracers import Tracers
from raytac.specs import load_sensor

if TYPE_CHECKING:
    from raytac.optics.base import OpticalMode

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
    physics: tuple[PhysicsError, ...] = ()
    """Rigid pad against the soft one, if that was asked for."""
    markers: MarkerErrors | None = None
    """Marker models against surface tracking, if that was asked for."""


def run_comparison(settings: CompareSettings, out: Path, modes: Sequence[Mode] | None = None) -> Comparison:
    """Measure every row that ``out`` does not hold yet, and return all.

    Args:
        settings: what to compare; checked first.
        out: folder of ``rows`` and ``references``, made if need be.
        modes: those of ``comparison_modes`` if None.

    Raises:
        RaytacError: as ``CompareSettings.check``; ``out`` is a file; or the ray tracer does not run on the device.
    """
    settings.check()
    if out.exists() and not out.is_dir():
        raise InputError("out", value=out, rule="must be a folder, and a file of that name exists")
    from raytac.optics.runtime import load_mitsuba

    device = load_mitsuba(settings.device)[1]
    modes = comparison_modes(settings.spp, quick=settings.quick) if modes is None else modes
    facts = machine()
    run = _Run(settings, device, RowStore(out / "rows", Progress.write), out / "references", facts)
    total = len(settings.resolutions) * len(settings.scenes) * len(modes)
    with Progress(total=total, desc="compare", unit="row") as bar:
        for size in settings.resolutions:
            run.measure_all(size, modes, bar)
        markers = None
        if settings.markers:
            bar.set_postfix_str("markers on the soft pad")
            markers = _marker_errors(settings, device)
    known = versions()
    known |= {key: value for key, value in versions(DISTRIBUTIONS).items() if key not in known}
    rows, left_out, physics = tuple(run.rows), tuple(run.left_out), tuple(run.physics)
    return Comparison(settings, device, rows, run.images, left_out, run.measured, facts | known, physics, markers)


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
        self.machine = {key: value for key, value in facts.items() if key != "machine.load_at_start"}
        self.rows: list[Row] = []
        self.images: dict[tuple[str, str], np.ndarray] = {}
        self.left_out: list[LeftOut] = []
        self.physics: list[PhysicsError] = []
        self.measured = 0
        self._digests: dict[tuple[str, ...], str] = {}

    def measure_all(self, size: tuple[int, int], modes: Sequence[Mode], bar: Progress) -> None:
        settings, name = self.settings, f"{size[0]}x{size[1]}"
        spec, surfaces = press_peaks(settings.sensor, settings.scenes, size, settings.seed)
        tracers = Tracers(spec, self.device, settings.seed)
        references = References(self.folder, tracers, size, settings.reference_spp, Progress.write)
        scenes = []
        for scene, surface in surfaces.items():
            bar.set_postfix_str(f"{name} {scene}: reference")
            scenes.append(_Scene(scene, surface, references, tracers, size))
            self.images[scene, name] = scenes[-1].truth
        if settings.pad is not None:
            bar.set_postfix_str(f"{name}: soft pad")
            self.physics += physics_errors(tracers, settings.scenes, size, settings.pad, surfaces)
        seen: set[str] = set()
        for mode in modes:
            done = len(self.rows)
            try:
                self._measure_mode(mode, Setting(tracers, size), scenes, mode.family not in seen, bar)
            except RaytacError as error:
                self.left_out.append(LeftOut(name, mode.name, mode.label, str(error)))
                bar.update(len(scenes) - (len(self.rows) - done))
            seen.add(mode.family)

    def _measure_mode(self, mode: Mode, setting: Setting, scenes: list[_Scene], first: bool, bar: Progress) -> None:
        """Rows of one mode; ``first`` says that no mode before has built and compiled the same."""
        name = f"{setting.size[0]}x{setting.size[1]}"
        built: OpticalMode | None = None
        first_image_s: float | None = None
        for scene in scenes:
            bar.set_postfix_str(f"{name} {scene.name}: {mode.label}")
            key, file = self._key(mode, scene), f"{scene.name}-{name}-{mode.name}"
            row = self.store.read(file, key)
            if row is None:
                if built is None:
                    if mode.prepare is not None:
                        mode.prepare(setting)
                    start = time.perf_counter()
                    built = mode.build(setting)
                    _rgb(built, scene.surface)
                    first_image_s = time.perf_counter() - start if first else None
                row = self._measure(mode, built, scene, name, setting.tracers.spec.name, first_image_s)
                self.store.write(file, key, row)
                self.measured += 1
            self.rows.append(row)
            bar.update()

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

    def _measure(self, mode: Mode, built: OpticalMode, scene: _Scene, size: str, sensor: str, first_image_s: float | None) -> Row:
        image = _rgb(built, scene.surface)[0]
        figures: dict[str, Value] = {
            "scene": scene.name,
            "resolution": size,
            "mode": mode.name,
            "family": mode.family,
            "label": mode.label,
            "words": mode.words or mode.family,
            "short": mode.short or mode.family,
            "unbiased": mode.unbiased,
            "spp": mode.spp,
            "sensor": sensor,
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
                figures[f"{region}_{metric}"] = _known(errors.get(f"{region}.{metric}"))
            for metric, value in scene.noise[region].items():
                figures[f"noise_{region}_{metric}"] = _known(value)
        # Half of the mean square or more is then the reference's own noise, and the figure is a bound, not a value.
        off, noise = figures["frame_rmse"], figures["noise_frame_rmse"]
        figures["at_noise"] = None if off is None else bool(float(off) < math.sqrt(2) * float(noise or 0.0))
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


def _known(value: float | None) -> float | None:
    """None for what is not a finite number (a region that is not there, PSNR of equal images)."""
    return None if value is None or not math.isfinite(value) else float(value)
