"""Settings of ``raytac compare``, checked before anything is computed."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from raytac.checks import check_known, check_seed
from raytac.errors import BackendError, InputError
from raytac.markers.base import marker_motion_of
from raytac.report.compare.modes import Mode, chosen_modes, comparison_modes
from raytac.report.image_error import SSIM_BORDER
from raytac.sensor import LARGEST_SIDE
from raytac.specs import PADS, SensorSpec, load_press, load_sensor, validate_press

MODES = ("fast", "taxim", "taxim_shadow", "phong", "reference", "path")
"""Modes of a comparison in minutes; ``full`` adds variants, denoiser, networks and peer."""
SPP = (4, 16)
"""Samples a pixel of the sampled modes."""


_RENDERS = 9
"""Renders for a row of a sampled mode: image, warm-up, timings, memory; some are slower."""
_TIMINGS, _FRAME_S, _BUILD_S = 2.5, 0.1, 3.0
"""Timings of a row, time of a frame and of building a mode [s], for an estimate."""
_BAKED = 1.7
"""Time of an image in a bake, with its fit, over that of a frame of ``fast``."""


@dataclass(frozen=True, kw_only=True)
class CompareSettings:
    """Settings of a comparison."""

    sensor: str = "gelsight_mini"
    scenes: tuple[str, ...] = ("sphere", "coin", "pins")
    resolutions: tuple[tuple[int, int], ...] = ((320, 240),)
    """(width, height) of the images [px]."""
    device: str = "auto"
    seed: int = 0
    modes: tuple[str, ...] | None = MODES
    """Names or families of modes; None is all that are registered."""
    reference_spp: int = 512
    """Samples a pixel of the reference, half of them in each of its halves."""
    spp: tuple[int, ...] = SPP
    """Samples a pixel at which the sampled modes are measured."""
    batch: int | None = None
    """Environments of the batched timing; None is ``compare.BATCH`` of the device."""
    frames: int = 30
    """Timed frames a figure, fewer for a mode that would need more than ``budget_s``."""
    budget_s: float = 1.0
    """Longest time for one timing [s], as far as three frames allow."""
    quick: bool = False
    """Fewer modes."""
    pad: str | None = None
    """Level of the soft pad for ``markers``; None is the one that they were fitted to."""
    markers: bool = False
    """Also measure marker models against surface tracking."""

    @classmethod
    def full(cls, **settings: Any) -> CompareSettings:
        """Every mode, more samples, longer timings: half an hour in place of minutes."""
        return cls(**({"modes": None, "reference_spp": 1024, "spp": (1, 4, 16, 64), "frames": 60, "budget_s": 10.0} | settings))

    def quickened(self) -> CompareSettings:
        """The first scene at 80 x 60 pixels with few samples, frames and costly variants."""
        small = {"scenes": self.scenes[:1], "resolutions": ((80, 60),), "reference_spp": 32, "spp": (1, 4), "batch": 2}
        return replace(self, **small, frames=3, budget_s=0.5, quick=True)

    def check(self) -> None:
        """Refuse what cannot be run, before anything is computed or written.

        Raises:
            InputError: a number or a resolution out of range, two scenes of one name, or a sensor without the marker motion that
                ``markers`` needs.
            SpecError: an unknown sensor or scene, or a file that breaks a rule.
            BackendError: a package of the ``report`` extra is missing.
        """
        for name, value, lowest in (
            ("reference spp", self.reference_spp, 2),
            ("frames", self.frames, 3),
            ("batch", 2 if self.batch is None else self.batch, 2),
            ("spp", min(self.spp, default=0), 1),
        ):
            if value < lowest:
                raise InputError(name, value=value, rule=f"must be at least {lowest}")
        if self.pad is not None:
            check_known("pad", self.pad, PADS)
            if not self.markers:
                rule = "is the pad of --markers, which is not asked for; raytac compare-physics compares pads"
                raise InputError("level", value=self.pad, rule=rule)
        if not self.budget_s > 0:
            raise InputError("budget_s", value=self.budget_s, rule="must be > 0 [s]")
        check_seed("seed", self.seed)
        for size in self.resolutions:
            if min(size) <= 2 * SSIM_BORDER or max(size) > LARGEST_SIDE:
                rule = f"must have sides from {2 * SSIM_BORDER + 1} (the window of SSIM) to {LARGEST_SIDE} pixels"
                raise InputError("resolution", value=f"{size[0]}x{size[1]}", rule=rule)
        if not self.resolutions or not self.scenes:
            raise InputError("scenes, resolutions", value=(self.scenes, self.resolutions), rule="must name at least one each")
        stems = [Path(scene).stem for scene in self.scenes]
        if len(set(stems)) < len(stems):
            raise InputError("scenes", value=self.scenes, rule="must have different names, since rows are named after them")
        chosen_modes(comparison_modes(self.spp), self.modes)
        spec = load_sensor(self.sensor)
        if self.markers:
            marker_motion_of(spec)
        for scene in self.scenes:
            validate_press(spec, load_press(scene))
        missing = [name for name in ("jinja2", "pyarrow", "skimage") if importlib.util.find_spec(name) is None]
        if missing:
            raise BackendError(f"the report needs {', '.join(missing)}: `pip install 'raytac[report]'`")


def expected_seconds(settings: CompareSettings, modes: Sequence[Mode], sample_s: float, bake_s: float = 0.0) -> float:
    """Estimated time of a comparison of which no row is kept [s].

    Args:
        sample_s: measured time of one sample a pixel of the reference at the first resolution [s].
        bake_s: that of ``expected_bake_seconds``.
    """
    width, height = settings.resolutions[0]
    share = sum(w * h for w, h in settings.resolutions) / (width * height)
    scene = settings.reference_spp * sample_s
    for mode in modes:
        renders = _RENDERS * (mode.spp or 0) * sample_s
        scene += renders if mode.spp is not None else min(_TIMINGS * settings.budget_s, settings.frames * _FRAME_S)
    return bake_s + len(settings.scenes) * share * scene + _BUILD_S * len(modes) * len(settings.resolutions)


def expected_bake_seconds(spec: SensorSpec, modes: Sequence[Mode], frame_s: Callable[[], float]) -> float:
    """Estimated time of the tables that have to be baked first [s].

    ``frame_s`` measures a frame of ``fast`` of the sensor's own size [s]; it is called if there is something to bake. Modes share a table.
    """
    renders = max((mode.prepare_renders(spec) for mode in modes), default=0)
    return renders * _BAKED * frame_s() if renders else 0.0
