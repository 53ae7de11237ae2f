"""The sensor's optical mode: chosen at once, built at the first image."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import TYPE_CHECKING, Any

from raytac.checks import is_number
from raytac.errors import InputError
from raytac.optics.base import chosen_shadows
from raytac.specs import SensorSpec

if TYPE_CHECKING:
    from raytac.optics.base import OpticalMode

__all__ = ["Imaging"]


class Imaging:
    """An optical mode that is given, or is built on first use from its name and settings."""

    def __init__(self, spec: SensorSpec, optics: str | OpticalMode, *, options: dict[str, Any], **settings: Any) -> None:
        """Read what the options name; build nothing yet.

        Args:
            spec: the sensor.
            optics: one of ``OPTICS``, or a mode that is built already.
            options: further keyword arguments of the mode.
            settings: ``resolution``, ``outputs`` and ``device`` of the mode, ``integrator``, ``spp`` and ``seed`` of the ray tracer.

        Raises:
            InputError: ``shadows`` that the mode cannot have. SpecError: a calibration folder that cannot be used. Both are told now,
                before anything is written.
        """
        if optics in ("raytrace", "taxim"):
            chosen_shadows(spec, options.get("shadows"), settings["integrator"] if optics == "raytrace" else "fast")
        self._spec, self._options, self._settings = spec, dict(options), settings
        if optics == "taxim" and isinstance(self._options.get("calibration"), (str, Path)):
            from raytac.optics.taxim.folder import load_calibration

            self._options["calibration"] = load_calibration(self._options["calibration"])
        self._optics, self._mode = (optics, None) if isinstance(optics, str) else ("", optics)

    @property
    def label(self) -> str:
        """Name for headers and reports; the mode's own once it is built, which options such as a denoiser change."""
        if self._mode is not None:
            return self._mode.label
        return f"raytrace-{self._settings['integrator']}" if self._optics == "raytrace" else self._optics

    @property
    def sampling(self) -> dict[str, int | float | str]:
        """``integrator``, ``spp`` and ``exposure`` of a mode that traces rays; empty if it does not.

        The exposure is a number. It is absent while it is ``AUTO``, where no output needs it.
        """
        integrator = getattr(self.mode, "integrator", None)
        if integrator is None:
            return {}
        spp = getattr(self.mode, "rays", 1) ** 2 if integrator == "fast" else getattr(self.mode, "spp", None)
        exposure = getattr(getattr(self.mode, "sensor", self._spec), "response", self._spec.response).exposure
        found = {"integrator": integrator, "spp": spp, "exposure": exposure if is_number(exposure) else None}
        return {key: value for key, value in found.items() if value is not None}

    @property
    def mode(self) -> OpticalMode:
        """The mode itself.

        Raises:
            InputError: an unknown name or a bad value in the options.
            BackendError: the renderer or the device does not work here.
        """
        mode = self._mode
        if mode is None:
            mode = self._mode = self._build()
        return mode

    def _build(self) -> OpticalMode:
        settings = self._settings
        if self._optics == "raytrace":
            from raytac.optics.trace.fast_tracer import RayTracer as Mode
        else:
            settings = {name: settings[name] for name in ("resolution", "outputs", "device")}
            if self._optics == "taxim":
                from raytac.optics.taxim.mode import TaximMode as Mode
            elif self._optics == "mlp":
                from raytac.optics.image.mlp import MlpMode as Mode
            else:
                from raytac.optics.image.phong import PhongMode as Mode
        known = [name for name in inspect.signature(Mode).parameters if name != "sensor" and name not in settings]
        for name, value in self._options.items():
            if name not in known:
                rule = f"is no option of optics={self._optics!r}, or an argument of TactileSensor itself"
                raise InputError(f"optics_options[{name!r}]", value=value, rule=rule, choices=known)
        return Mode(self._spec, **settings, **self._options)
