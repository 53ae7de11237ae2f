"""Optical modes of a comparison: all registered modes, and the package ``taxim``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from raytac.errors import BackendError, InputError
from raytac.gel.surface import GelSurface
from raytac.optics.base import Variant
from raytac.optics.registry import OPTICS
from raytac.report.tracers import Tracers
from raytac.specs.sensor import SensorSpec

if TYPE_CHECKING:
    from raytac.optics.base import OpticalMode, OpticsImages


@dataclass(frozen=True)
class Setting:
    """Circumstances for which a mode is built."""

    tracers: Tracers
    size: tuple[int, int]
    """(width, height) of the images [px]."""


@dataclass(frozen=True)
class Mode:
    """One way to make images: a label, and what builds it."""

    family: str
    """Name in keys and files; a sampled family has one mode for each number of samples a pixel."""
    build: Callable[[Setting], OpticalMode]
    """Raise ``RaytacError`` where the mode cannot run."""
    code: Callable[[], tuple[str, ...]]
    """Modules whose source, with all that they import, shapes the image and its time."""
    words: str = ""
    """The family for a reader; its name if empty."""
    short: str = ""
    """Label of its point in a figure; its name if empty."""
    spp: int | None = None
    """Samples a pixel, None for a mode without noise."""
    unbiased: bool = False
    """True if the error of a sampled family falls as 1/√spp, so that it may be extrapolated."""
    options: str = ""
    """Settings as they go into the key of a row."""
    prepare: Callable[[Setting], object] | None = None
    """Untimed work whose result stays on disk for later processes, such as baking a table."""
    prepare_renders: Callable[[SensorSpec], int] = lambda _: 0
    """Images of the sensor's own size that ``prepare`` would render."""
    has_reference: bool = True
    """True if the image shows our sensor, so that an error against our reference is defined."""
    note: str = ""
    """Remark for readers of its rows."""

    @property
    def name(self) -> str:
        """Unique name, e.g. ``fast`` or ``path.spp16``."""
        return self.family if self.spp is None else f"{self.family}.spp{self.spp}"

    @property
    def label(self) -> str:
        """In words, e.g. ``Mitsuba path, 16 spp``."""
        return (self.words or self.family) + ("" if self.spp is None else f", {self.spp} spp")


class _Sampled:
    """A mode with noise at one number of samples; several share one costly tracer."""

    def __init__(self, mode: Any, spp: int, seed: int) -> None:
        self._render = partial(mode.render, spp=spp, seed=seed)
        self.label, self.device = f"{mode.label}-{spp}spp", mode.device

    def render(self, surface: GelSurface) -> OpticsImages:
        return self._render(surface)


def comparison_modes(spp: Sequence[int] = (1, 4, 16, 64), *, quick: bool = False) -> tuple[Mode, ...]:
    """Every mode, sampled ones once for each of ``spp``; ``quick`` builds no costly variants."""
    modes = []
    for name in OPTICS.names:
        for variant in OPTICS.config_class(name).variants():
            for n in spp if variant.config.sampled else (None,):
                modes.append(_mode(variant, n, left_out=quick and variant.slow))
    return (*modes, _peer("peer", shadow=False, left_out=quick), _peer("peer_shadow", shadow=True, left_out=quick))


def chosen_modes(modes: Sequence[Mode], names: Sequence[str] | None) -> tuple[Mode, ...]:
    """Modes of these names or families; None is all. Raises ``InputError`` for an unknown name."""
    if names is None:
        return tuple(modes)
    families = tuple(dict.fromkeys(mode.family for mode in modes))
    for name in names:
        if name not in families and name not in [mode.name for mode in modes]:
            raise InputError("modes", value=name, rule="must be known modes joined by commas, or all", choices=families)
    return tuple(mode for mode in modes if mode.family in names or mode.name in names)


def _too_slow(setting: Setting) -> OpticalMode:
    raise BackendError("left out of a quick run: baking its table, or compiling it, takes longer than all the rest")


def _mode(variant: Variant, spp: int | None, *, left_out: bool) -> Mode:
    config = variant.config

    def build(setting: Setting) -> OpticalMode:
        mode = setting.tracers.mode(setting.size, config)
        # Seeds apart from those of the reference images: shared samples would share their error.
        return mode if spp is None else _Sampled(mode, spp, (100_000 + 1_000 * setting.tracers.seed) % 2**32)

    def bake(setting: Setting) -> None:
        config.bake(setting.tracers.spec, setting.tracers.device)

    return Mode(
        variant.name,
        _too_slow if left_out else build,
        lambda: (config.maker().__module__,),
        words=variant.words,
        short=variant.short,
        spp=spp,
        unbiased=config.unbiased,
        options=repr(config),
        prepare=None if left_out else bake,
        prepare_renders=(lambda _: 0) if left_out else config.bake_renders,
        note=variant.note,
    )


def _peer(family: str, *, shadow: bool, left_out: bool) -> Mode:
    def build(setting: Setting) -> OpticalMode:
        from raytac.report.compare.peer_taxim import PeerTaxim

        return PeerTaxim(setting.size, shadow=shadow, device=setting.tracers.device)

    note = (
        "its own sensor (GelSight with a dome), background and colours: no error against our reference is defined. "
        "Its time includes its own deformation of the gel, which the other modes are given."
    )
    return Mode(
        family,
        _too_slow if left_out else build,
        lambda: ("raytac.report.compare.peer_taxim",),
        words="taxim package" + (" with shadow" if shadow else ""),
        has_reference=False,
        note=note,
    )
