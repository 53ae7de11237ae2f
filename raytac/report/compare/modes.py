"""Which optical modes a comparison measures, with which settings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from raytac.errors import BackendError
from raytac.gel.surface import GelSurface
from raytac.report.tracers import Tracers
from raytac.sensor import TactileSensor

if TYPE_CHECKING:
    from raytac.optics.base import OpticalMode, OpticsImages
    from raytac.optics.trace.fast_tracer import RayTracer

__all__ = ["FAMILIES", "Mode", "SampledMode", "Setting", "comparison_modes"]

FAMILIES = {
    "fast": "raytac fast",
    "fast_4_rays": "raytac fast, 4 rays a pixel",
    "reference": "raytac reference",
    "reference_denoised": "raytac reference, denoised",
    "path": "Mitsuba path",
    "taxim": "Taxim table",
    "taxim_shadow": "Taxim table with shadow",
    "phong": "Phong",
    "peer": "taxim package",
    "peer_shadow": "taxim package with shadow",
}
"""Name in keys and files, and in words, of every kind of mode; a sampled family has one mode for each number of samples a pixel."""


@dataclass(frozen=True)
class Setting:
    """What a mode is built for."""

    tracers: Tracers
    size: tuple[int, int]
    """(width, height) of the images [px]."""


@dataclass(frozen=True)
class Mode:
    """One way to make images: a label, and what builds it."""

    family: str
    """One of ``FAMILIES``."""
    build: Callable[[Setting], OpticalMode]
    """Raises RaytacError where the mode cannot run."""
    code: tuple[str, ...]
    """Modules whose source, with all that they import, shapes the image and its time."""
    spp: int | None = None
    """Samples a pixel, None for a mode without noise."""
    options: dict[str, Any] = field(default_factory=dict)
    """Settings as they go into the key of a row."""
    prepare: Callable[[Setting], object] | None = None
    """Work before the first image whose result stays on disk for later processes, such as baking a table; it is not timed."""
    has_reference: bool = True
    """Whether the image shows our sensor, so that its error against our reference means something."""
    note: str = ""
    """What a reader of its rows must know."""

    @property
    def name(self) -> str:
        """Unique name, e.g. ``fast`` or ``path.spp16``."""
        return self.family if self.spp is None else f"{self.family}.spp{self.spp}"

    @property
    def label(self) -> str:
        """In words, e.g. ``Mitsuba path, 16 spp``."""
        return FAMILIES[self.family] + ("" if self.spp is None else f", {self.spp} spp")


class SampledMode:
    """A sampled integrator at one number of samples; several share one ray tracer, which is costly to build."""

    def __init__(self, tracer: RayTracer, spp: int, seed: int) -> None:
        self.tracer, self.spp, self.seed = tracer, spp, seed
        self.label, self.device = f"{tracer.label}-{spp}spp", tracer.device

    def render(self, surface: GelSurface) -> OpticsImages:
        self.tracer.spp, self.tracer.seed = self.spp, self.seed
        return self.tracer.render(surface)


def comparison_modes(spp: Sequence[int] = (1, 4, 16, 64), *, quick: bool = False) -> tuple[Mode, ...]:
    """Every mode of the comparison; the sampled ones once for each of ``spp`` samples a pixel. ``quick`` leaves out costly variants."""
    modes = [_traced("fast")]
    if not quick:
        modes.append(_traced("fast_4_rays", spp=4))
    for family in ("reference", "reference_denoised", "path"):
        chosen = spp if not (quick and family == "reference_denoised") else spp[-1:]
        modes += [_sampled(family, n) for n in chosen]
    others = [
        _named("taxim", "taxim", {"shadows": False}),
        _named("taxim_shadow", "taxim", {"shadows": True}),
        _named("phong", "phong", {}),
        _peer("peer", shadow=False),
        _peer("peer_shadow", shadow=True),
    ]
    slow = ("taxim", "taxim_shadow", "peer", "peer_shadow") if quick else ()
    return (*modes, *(replace(mode, build=_too_slow, prepare=None) if mode.family in slow else mode for mode in others))


def _too_slow(setting: Setting) -> OpticalMode:
    raise BackendError("left out of a quick run: baking its table, or compiling it, takes longer than all the rest")


def _traced(family: str, **options: Any) -> Mode:
    def build(setting: Setting) -> OpticalMode:
        return setting.tracers.get(setting.size, **options)

    return Mode(family, build, ("raytac.optics.trace.fast_tracer",), options=options)


def _sampled(family: str, spp: int) -> Mode:
    integrator, denoise = family.removesuffix("_denoised"), family.endswith("_denoised")

    def build(setting: Setting) -> OpticalMode:
        options = {"denoise": True} if denoise else {}
        tracer = setting.tracers.get(setting.size, integrator=integrator, **options)
        # Seeds apart from those of the reference images: shared samples would share their error.
        return SampledMode(tracer, spp, (100_000 + 1_000 * setting.tracers.seed) % 2**32)

    code = ("raytac.optics.trace.fast_tracer",)
    return Mode(family, build, code, spp, {"integrator": integrator, "denoise": denoise, "spp": spp})


_MODULES = {"phong": "raytac.optics.image.phong", "mlp": "raytac.optics.image.mlp", "taxim": "raytac.optics.taxim.mode"}


def _named(family: str, optics: str, options: dict[str, Any]) -> Mode:
    def build(setting: Setting) -> OpticalMode:
        tracers = setting.tracers
        sensor = TactileSensor(
            tracers.spec,
            optics=optics,
            resolution=setting.size,
            device=tracers.device,
            seed=tracers.seed,
            optics_options=options,
        )
        return sensor.optical_mode

    table = optics == "taxim"
    code = (_MODULES[optics],)
    note = "" if table else "lights and constants as published for another sensor, not fitted to this one"
    return Mode(family, build, code, options={"optics": optics, **options}, prepare=_bake if table else None, note=note)


def _bake(setting: Setting) -> None:
    from raytac.optics.taxim.bake.bake import baked_table

    baked_table(setting.tracers.spec, device=setting.tracers.device)


def _peer(family: str, *, shadow: bool) -> Mode:
    def build(setting: Setting) -> OpticalMode:
        from raytac.report.compare.peer_taxim import PeerTaxim

        return PeerTaxim(setting.size, shadow=shadow, device=setting.tracers.device)

    note = (
        "its own sensor (GelSight with a dome), background and colours: no error against our reference is defined. "
        "Its time includes its own deformation of the gel, which the other modes are given."
    )
    return Mode(family, build, ("raytac.report.compare.peer_taxim",), options={"shadow": shadow}, has_reference=False, note=note)
