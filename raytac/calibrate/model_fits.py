"""Every optical mode fitted to the same real presses, and its images of others."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from raytac.calibrate.direct_fit import SIGMA, FitSettings
from raytac.calibrate.drift import Drift, Settled, measured_drift, no_drift, settled
from raytac.calibrate.image_fits import fit_mlp, fit_table, press_samples, with_cast_shadows, with_shading
from raytac.calibrate.imprint import press_surface
from raytac.calibrate.photographs import Photographs
from raytac.calibrate.prior_choice import STRENGTHS, choose_strength
from raytac.calibrate.ray_fit import Fitted, check_fitted, fit_lights, refine_circles
from raytac.checks import check_whole
from raytac.device import DEVICES
from raytac.errors import InputError
from raytac.gel.surface import make_grid
from raytac.optics.base import OpticalMode
from raytac.optics.image.config import Mlp, Phong
from raytac.optics.taxim.config import Taxim
from raytac.optics.trace.config import RayTraced
from raytac.optics.trace.tracer import Tracer
from raytac.specs import SensorSpec

ALONE = "raytrace_alone"
"""The fitted ray tracer with colour shading (``with_shading``) in place of a flat field."""
MODES = ("raytrace", ALONE, "taxim", "mlp", "phong")
"""Modes that are compared, beside the background alone."""
SHADOW_TABLES = ("none", "raytrace")
"""Sources of a table's shadows: none, or the fitted ray tracer."""
GRID_PITCH = 0.06e-3
"""Spacing of the pad's nodes [m], about a pixel's."""


@dataclass(frozen=True)
class Models:
    """Fits to one set of presses: the lights with imprint and circles, and a mode of each kind."""

    given: SensorSpec
    """The sensor before the fit."""
    fitted: Fitted
    settled: Settled
    """The fitted photographs with the image at rest of all modes, without session drift."""
    drifts: bool
    """True if session drift is part of the model."""
    prior: str
    """Name of the strength of priors (``STRENGTHS``)."""
    modes: dict[str, OpticalMode]
    device: str
    tracing: RayTraced
    """Configuration of the ray tracer."""

    @property
    def rest(self) -> np.ndarray:
        """The image at rest of all modes [levels], (H, W, 3)."""
        return self.settled.shots.background

    def sensor_of(self, mode: str) -> SensorSpec:
        """The sensor that a mode was built for: the ray tracer alone has the fitted camera."""
        return self.fitted.sensor if mode in ("raytrace", ALONE) else self.given

    def drift(self, shots: Photographs) -> Drift:
        """Session drift of presses that were not fitted, from their pixels far from a contact."""
        return measured_drift(self.fitted.sensor, shots, self.rest) if self.drifts else no_drift(len(shots.presses))

    def circles(self, shots: Photographs) -> np.ndarray:
        """Circles (N, 3) [px] of presses that were not fitted, from labels and fitted lights."""
        own = dataclasses.replace(shots, background=self.rest, presses=self.drift(shots).removed(shots.presses))
        return refine_circles(self.fitted.sensor, own, self.fitted.state, device=self.device, tracing=self.tracing)


def check_fit(
    *,
    modes: Sequence[str] = MODES,
    prior: str | None = None,
    fixed: Sequence[str] = (),
    shadow_table: str = SHADOW_TABLES[0],
    device: str = "auto",
    starts: int = 1,
    rounds: int = 0,
) -> None:
    """Raise InputError for arguments that ``fit_models`` could not use, before a fit."""
    for name, values, rule, choices in (
        ("modes", modes, "must be known modes", MODES),
        ("prior", () if prior is None else (prior,), "must be a known strength, or None to choose it", tuple(STRENGTHS)),
        ("fixed", fixed, "must be known blocks of parameters", tuple(SIGMA)),
        ("shadow_table", (shadow_table,), "must be a known source of shadows", SHADOW_TABLES),
        ("device", (device,), "must be a known device", DEVICES),
    ):
        for value in values:
            if value not in choices:
                raise InputError(name, value=value, rule=rule, choices=choices)
    check_whole("starts", starts)
    check_whole("rounds", rounds, 0)


def raytrace_mode(sensor: SensorSpec, background: np.ndarray, device: str, tracing: RayTraced) -> Tracer:
    """The ray tracer with the real background (H, W, 3) [levels] as flat field."""
    height, width = background.shape[:2]
    return dataclasses.replace(tracing, flat_field=background).build(sensor, resolution=(width, height), device=device)


def fit_models(
    sensor: SensorSpec,
    shots: Photographs,
    *,
    settings: FitSettings | None = None,
    modes: tuple[str, ...] = MODES,
    device: str = "auto",
    seed: int = 0,
    starts: int = 3,
    rounds: int = 3,
    settle: bool = True,
    drift: bool = True,
    prior: str | None = None,
    shadow_table: str = SHADOW_TABLES[0],
    tracing: RayTraced | None = None,
    tick: Callable[[str, float], None] | None = None,
) -> Models:
    """Fit ``modes`` to the presses of ``shots``, with imprint and circles of the lights' fit.

    ``prior`` names one of ``STRENGTHS``; None chooses it within ``shots``. ``shadow_table``: one of ``SHADOW_TABLES``. ``settle``: all
    modes have the image at rest of ``drift.settled``, and not the one photograph of it. ``drift``: gain and offset of every photograph are
    measured far from contacts and taken from it before the fit. Raises as ``check_fit`` and ``fit_lights``.
    """
    tracing = RayTraced() if tracing is None else tracing
    settings = FitSettings() if settings is None else settings
    own = {"device": device, "starts": starts, "rounds": rounds}
    check_fit(modes=modes, prior=prior, fixed=settings.fixed, shadow_table=shadow_table, **own)
    if settle:
        steady = settled(sensor, shots, drift=drift)
    else:
        own_drift = measured_drift(sensor, shots, shots.background) if drift else no_drift(len(shots.presses))
        one = dataclasses.replace(shots, presses=own_drift.removed(shots.presses))
        steady = Settled(one, own_drift, no_drift(1))
    shots = steady.shots
    if prior is None:
        prior, _ = choose_strength(sensor, shots, settings, seed=seed, tick=tick)
    settings = dataclasses.replace(settings, **STRENGTHS[prior])
    fitted = fit_lights(sensor, shots, settings=settings, seed=seed, tracing=tracing, tick=tick, **own)
    state, background, built = fitted.state, shots.background, {}

    def count_rendered(images: int) -> None:
        if tick is not None:
            tick(f"{images} images of shadows", fitted.costs[-1])

    if {"taxim", "mlp"} & set(modes):
        samples = press_samples(sensor, shots, state.circles, state.slopes, device=device)
    for name in modes:
        if name == "raytrace":
            built[name] = raytrace_mode(fitted.sensor, background, device, tracing)
        elif name == ALONE:
            shaded = with_shading(fitted.sensor, background, device=device, tracing=tracing)
            check_fitted(shaded)
            built[name] = tracing.build(shaded, resolution=(background.shape[1], background.shape[0]), device=device)
        elif name == "taxim":
            table = fit_table(sensor, background, samples)
            if shadow_table == "raytrace":
                # Pixels of the table are those of the given camera, and so are its shadows'.
                lit = dataclasses.replace(fitted.sensor, camera=sensor.camera)
                table = with_cast_shadows(table, lit, device=device, seed=seed, tick=count_rendered)
            built[name] = Taxim(table, shadows=table.shadow is not None).build(sensor, device=device)
        elif name == "mlp":
            built[name] = Mlp(fit_mlp(sensor, background, samples, seed=seed)).build(sensor, device=device)
        else:
            built[name] = Phong(background=np.rint(background).astype(np.uint8)).build(sensor, device=device)
    return Models(sensor, fitted, steady, drift, prior, built, device, tracing)


def images_of(mode: OpticalMode, sensor: SensorSpec, shots: Photographs, circles: np.ndarray, slopes: np.ndarray) -> np.ndarray:
    """8-bit images (N, H, W, 3) of balls at ``circles`` (N, 3) [px], imprint ``slopes``."""
    grid, images = make_grid(sensor.gelpad, GRID_PITCH), []
    for k in range(len(circles)):
        surface = press_surface(sensor, grid, circles[k : k + 1], shots.radius[k : k + 1], slopes)
        rgb = mode.render(surface).rgb
        assert rgb is not None
        images.append(rgb[0])
    return np.array(images)


def mode_times(models: Models, shots: Photographs, circles: np.ndarray, repeats: int = 9) -> dict[str, float]:
    """Median time [ms] of every mode for one image, everything compiled, the image on the host."""
    grid = make_grid(models.given.gelpad, GRID_PITCH)
    times = {}
    for name, mode in models.modes.items():
        surface = press_surface(models.sensor_of(name), grid, circles[:1], shots.radius[:1], models.fitted.state.slopes)
        taken = []
        for _ in range(repeats + 2):
            began = time.perf_counter()
            mode.render(surface)
            taken.append(time.perf_counter() - began)
        times[name] = 1e3 * float(np.median(taken[2:]))
    return times
