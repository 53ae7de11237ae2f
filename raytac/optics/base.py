"""Interface of every optical mode: a configuration builds what turns surfaces into images."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, Protocol, TypeVar

import numpy as np

from raytac.errors import InputError
from raytac.gel.surface import GelSurface
from raytac.specs.sensor import SensorSpec

OPTICAL_OUTPUTS = ("rgb", "layers", "normals", "depth")
"""Outputs that need an optical mode; without them no renderer is imported."""


@dataclass(frozen=True)
class OpticsImages:
    """Images of B sensors; fields as in ``TactileFrame``, None where not asked for."""

    rgb: np.ndarray | None = None
    layers: dict[str, np.ndarray] | None = None
    normals: np.ndarray | None = None
    position: np.ndarray | None = None
    depth: np.ndarray | None = None
    contact: np.ndarray | None = None
    uncovered: np.ndarray | None = None
    """Share of contact pixels (B,) whose table bin no sample reached; None where unknown."""

    def repeated(self, batch: int, envs: list[int], images: OpticsImages | None) -> OpticsImages:
        """These images (B = 1) in every environment of a batch, but ``images`` in ``envs``."""

        def spread(one: np.ndarray, some: np.ndarray | None) -> np.ndarray:
            whole = np.repeat(one, batch, axis=0)
            if some is not None:
                whole[envs] = some
            return whole

        merged: dict[str, Any] = {}
        for name, value in vars(self).items():
            some = None if images is None else getattr(images, name)
            if isinstance(value, dict):
                merged[name] = {key: spread(one, None if some is None else some[key]) for key, one in value.items()}
            else:
                merged[name] = None if value is None else spread(value, some)
        return OpticsImages(**merged)


class OpticalMode(Protocol):
    """One way to make images, built once for one sensor, resolution and set of outputs.

    Modes that render on the device have ``mi``, ``camera``, ``outputs``, ``prepare(grid)`` and
    ``render_device(heights, contact=None, ink=None)`` too, as ``raytac.optics.DeviceMode`` says; those that compute beside their caller
    have ``start(surface)``.
    """

    label: str
    """Name for headers and reports, e.g. ``raytrace-fast``."""
    device: str
    """``"cpu"`` or ``"cuda"``: where it runs."""

    def render(self, surface: GelSurface) -> OpticsImages:
        """Render every environment of ``surface``."""
        ...


def start(mode: OpticalMode, surface: GelSurface) -> Callable[[], OpticsImages]:
    """Begin the images of a surface; returns a function that waits. A mode may lack this."""
    begin: Callable[[GelSurface], Callable[[], OpticsImages]] | None = getattr(mode, "start", None)
    if begin is not None:
        return begin(surface)
    images = mode.render(surface)
    return lambda: images


Mode = TypeVar("Mode", bound=OpticalMode, covariant=True)


class OpticsConfig(Generic[Mode]):
    """Base of optical modes' configurations: frozen, checked, and able to build the mode.

    .. code-block:: python

        @raytac.optics.register("grey")
        @dataclass(frozen=True)
        class Grey(OpticsConfig):
            gamma: float = 1.0

            def maker(self):
                return GreyMode

    From then on the name is accepted wherever raytac asks for an optical mode, and ``raytac compare`` measures it.
    """

    outputs: ClassVar[tuple[str, ...]] = ("rgb", "normals", "depth")
    """Those of ``OPTICAL_OUTPUTS`` that the mode can make."""

    @property
    def sampled(self) -> bool:
        """True if images have noise, so that ``render`` takes ``spp`` and ``seed``."""
        return False

    @property
    def unbiased(self) -> bool:
        """True if the error falls as 1/√spp, so that a comparison may extrapolate it."""
        return self.sampled

    @property
    def label(self) -> str:
        """Name for headers and reports before the mode is built; the class's in lower case."""
        return type(self).__name__.lower()

    def build(
        self,
        spec: SensorSpec,
        *,
        resolution: tuple[int, int] | None = None,
        outputs: tuple[str, ...] = ("rgb",),
        device: str = "auto",
        seed: int = 0,
    ) -> Mode:
        """The mode for one sensor.

        Args:
            resolution: (width, height) [px]; None is the sensor's own.
            outputs: some of the class's own.
            device: ``auto``, ``cpu`` or ``cuda``.

        Raises:
            InputError: a value out of its choices.
            SpecError: a sensor that the mode cannot show.
            CalibrationError: a file that is missing or malformed.
            BackendError: the renderer cannot run on ``device``.
        """
        return self.maker()(spec, self, resolution=resolution, outputs=outputs, device=device, seed=seed)

    def maker(self) -> Callable[..., Mode]:
        """Class of the mode, called with ``(spec, self, resolution, outputs, device, seed)``."""
        raise NotImplementedError

    def check(self, spec: SensorSpec) -> None:
        """Raise at once what else the first image would, as far as that takes no renderer."""

    def bake(self, spec: SensorSpec, device: str) -> None:
        """Do work before the first image that stays on disk; a comparison does not time it."""

    def bake_renders(self, spec: SensorSpec) -> int:
        """Images of the sensor's own size that ``bake`` would render; 0 if its work is there."""
        return 0

    @classmethod
    def variants(cls) -> tuple[Variant, ...]:
        """Settings that ``raytac compare`` measures: the defaults, unless the mode says otherwise."""
        config = cls()
        return (Variant(config.label, config.label, config.label, config),)


@dataclass(frozen=True)
class Variant:
    """One setting of an optical mode in a comparison."""

    name: str
    """Unique among all modes: in keys, files and tables."""
    words: str
    """The same for a reader."""
    short: str
    """Label of its point in a figure."""
    config: OpticsConfig[OpticalMode]
    note: str = ""
    """Remark for readers of its figures."""
    slow: bool = False
    """Left out of a quick comparison, for its time."""


@dataclass(frozen=True)
class BuiltOptics(OpticsConfig[OpticalMode]):
    """A mode that is built already; it keeps its own resolution, outputs and device."""

    mode: OpticalMode
    outputs: ClassVar[tuple[str, ...]] = OPTICAL_OUTPUTS

    @property
    def label(self) -> str:
        return self.mode.label

    def maker(self) -> Callable[..., OpticalMode]:
        return lambda *_, **__: self.mode


def casts_shadows(sensor: SensorSpec, shadows: bool | None) -> bool:
    """``shadows``; if None, as the sensor says."""
    return sensor.optics.shadows if shadows is None else shadows


def check_shadows(shadows: bool | None) -> None:
    """Raise InputError unless ``shadows`` is True, False or None."""
    if shadows is not None and not isinstance(shadows, bool):
        raise InputError("shadows", value=shadows, rule="must be True, False or None", choices=(True, False, None))
