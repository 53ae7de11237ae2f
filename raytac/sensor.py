"""``TactileSensor``: one sensor, one physics, one optical mode; a press or a surface goes in, a ``TactileFrame`` comes out."""

from __future__ import annotations

import inspect
import time
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from raytac.device import resolve_device
from raytac.errors import BackendError, InputError
from raytac.frame import OUTPUTS, TactileFrame
from raytac.gel.pad import grid_pitch, make_grid
from raytac.gel.surface import GelSurface, PadGrid
from raytac.io.options import parse_resolution
from raytac.markers import MARKER_MODELS, MarkerFrame, MarkerPerturbation, MarkerTracker
from raytac.markers.pattern import MarkerPattern
from raytac.optics.base import INTEGRATORS, OPTICAL_OUTPUTS
from raytac.specs import PressScene, SensorSpec, load_press, load_sensor, validate_press
from raytac.specs.press import PADS, PHYSICS

if TYPE_CHECKING:
    from raytac.optics.base import OpticalMode
    from raytac.physics.contact_state import ContactState
    from raytac.physics.rigid import RigidPad
    from raytac.physics.soft import SoftPad
    from raytac.physics.soft_mesh import PadMesh

__all__ = ["INTEGRATORS", "OPTICS", "PADS", "PHYSICS", "TactileSensor", "sensor_outputs"]

OPTICS = ("raytrace", "taxim", "phong")
"""Names that ``optics=`` accepts."""
LARGEST_SIDE = 8192
"""Longest side of an image [px], as in sensor files."""
SHAPE_TOLERANCE = 0.02
"""How far an image may be from the sensor's own shape without a warning: rounding to whole pixels is no squeeze."""


class TactileSensor:
    """A simulated GelSight sensor.

    .. code-block:: python

        sensor = TactileSensor("gelsight_mini", outputs=("rgb", "depth"))
        frame = sensor.press("coin")
        frame.rgb  # (B, H, W, 3) uint8

    The optical mode is built at the first image and reused for every later one.
    """

    spec: SensorSpec
    outputs: tuple[str, ...]
    resolution: tuple[int, int]
    """(width, height) of every image [px]."""
    grid: PadGrid
    """Nodes of the pad's surface."""
    physics: str
    """How the gel deforms: as asked for, else as the scene that was loaded last asks, else ``rigid``."""

    def __init__(
        self,
        sensor: str | Path | SensorSpec = "gelsight_mini",
        *,
        physics: str | None = None,
        pad: str | PadMesh | None = None,
        optics: str | OpticalMode = "raytrace",
        outputs: Sequence[str] | str = ("rgb",),
        resolution: tuple[int, int] | str | None = None,
        integrator: str = "fast",
        spp: int | None = None,
        device: str = "auto",
        seed: int = 0,
        num_envs: int = 1,
        pitch: float | None = None,
        markers: str | None = None,
        marker_perturbation: MarkerPerturbation | None = None,
        optics_options: dict[str, Any] | None = None,
    ) -> None:
        """Check everything and compute nothing yet.

        Args:
            sensor: name of a shipped sensor, path of a sensor file, or a specification.
            physics: how the gel deforms, one of ``PHYSICS``: ``rigid`` (by geometry and Gaussians) or ``ipc`` (simulated); None is as the
                scene asks, else ``rigid``.
            pad: how finely a simulated pad is cut, one of ``PADS``, or a mesh of one's own; None is as the scene asks, else ``coarse``.
            optics: how images are made, one of ``OPTICS``, or an optical mode that is built already (it keeps its own resolution,
                outputs and device).
            outputs: what a frame holds, one name or several of ``raytac.frame.OUTPUTS``; nothing else is computed.
            resolution: (width, height) of the images [px], or text as ``"320x240"``; None is the sensor's own. The field of view stays
                the sensor's: another shape squeezes it, with a warning.
            integrator: of the ray tracer, one of ``INTEGRATORS``.
            spp: of the ray tracer; ``fast``: rays a pixel, a square number, 1 if None; sampled integrators: samples a pixel, 256 if None.
            device: ``auto``, ``cpu`` or ``cuda``.
            seed: of every random number, in [0, 2^32).
            num_envs: number of environments B that a press simulates; ``press`` and ``load`` say how they can differ.
            pitch: spacing of the pad's grid [m]; None is that of a pixel on the pad, at most 0.1 mm.
            markers: how the sensor's markers move, one of ``MARKER_MODELS``; frames then hold them, and images show the dots. None leaves
                them out, and images show a plain coat.
            marker_perturbation: noise, losses and shifts of the markers; None is none.
            optics_options: further keyword arguments of the optical mode, such as ``calibration`` and ``shadow`` of ``taxim``;
                their values are checked when it is built.

        Raises:
            InputError: an unknown name or a value out of range; the message lists the choices.
            SpecError: the sensor, light or calibration file breaks a rule.
            BackendError: ``device="cuda"`` where there is no CUDA or no OptiX.
        """
        if physics is not None:
            _check_name("physics", physics, PHYSICS)
        if isinstance(pad, str):
            _check_name("pad", pad, PADS)
        if pad is not None and physics == "rigid":
            raise InputError("pad", value=pad, rule="is how finely a simulated pad is cut; physics='rigid' has none")
        if isinstance(optics, str):
            _check_name("optics", optics, OPTICS)
        _check_name("integrator", integrator, INTEGRATORS)
        if optics in OPTICS and optics != "raytrace" and (integrator != "fast" or spp is not None):
            raise InputError(
                "integrator, spp", value=(integrator, spp), rule=f"are settings of the ray tracer; optics={optics!r} has none"
            )
        if not isinstance(optics, str) and (integrator != "fast" or spp is not None or optics_options):
            value = {"integrator": integrator, "spp": spp, "optics_options": optics_options}
            raise InputError(
                "integrator, spp, optics_options", value=value, rule="belong to a mode that is built here; it has its own"
            )
        resolve_device(device)
        if not isinstance(outputs, (str, Sequence)):
            raise InputError("outputs", value=outputs, rule="must be a sequence of names, as in ('rgb',)", choices=OUTPUTS)
        outputs = (outputs,) if isinstance(outputs, str) else tuple(outputs)
        for name in outputs:
            _check_name("outputs", name, OUTPUTS)
            if isinstance(optics, str) and name not in sensor_outputs(optics):
                rule = f"must be an output of optics={optics!r}; only the ray tracer knows the light of each LED"
                raise InputError("outputs", value=name, rule=rule, choices=sensor_outputs(optics))
        if markers is not None:
            _check_name("markers", markers, MARKER_MODELS)
            if markers == "surface" and physics == "rigid":
                rule = "tracks the surface of a simulated gel; physics='rigid' has none"
                raise InputError("markers", value=markers, rule=rule, choices=tuple(m for m in MARKER_MODELS if m != markers))
        elif marker_perturbation is not None:
            raise InputError("marker_perturbation", value=marker_perturbation, rule="needs a marker model: markers=…")
        _check_whole("num_envs", num_envs)
        _check_whole("spp", 1 if spp is None else spp)
        size = _checked_resolution(resolution)
        if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or not 0 <= seed < 2**32:
            raise InputError("seed", value=seed, rule="must be a whole number in [0, 2^32)")
        if not isinstance(sensor, (str, Path, SensorSpec)):
            raise InputError("sensor", value=sensor, rule=f"must be a name, a path or a SensorSpec, not {type(sensor).__name__}")
        self.spec = sensor if isinstance(sensor, SensorSpec) else load_sensor(sensor)
        self.integrator, self.spp = integrator, spp
        self._asked_physics, self._asked_pad = physics, pad
        self.physics = physics or ("ipc" if pad is not None else "rigid")
        self.outputs = tuple(name for name in OUTPUTS if name in outputs)
        self.resolution = size if size is not None else self.spec.camera.resolution
        _warn_of_other_shape(self.resolution, self.spec.camera.resolution)
        self.device, self.seed, self.num_envs = device, int(seed), num_envs
        self._pitch = grid_pitch(self.spec.camera.pitch_at(self.resolution)) if pitch is None else pitch
        self.grid = make_grid(self.spec.gelpad, self._pitch)
        self._level: str | PadMesh = pad or PADS[0]
        self.markers, self._marker_perturbation = markers, marker_perturbation
        if markers is not None:
            MarkerPattern.of(self.spec, self.resolution)  # a pattern that cannot be seen is told now
        self._tracker: MarkerTracker | None = None
        self._optics_options = dict(optics_options or {})
        if optics == "taxim" and isinstance(self._optics_options.get("calibration"), (str, Path)):
            from raytac.optics.calib_folder import load_calibration

            # A folder that cannot be used is told now, before anything is written.
            self._optics_options["calibration"] = load_calibration(self._optics_options["calibration"])
        self._mode: OpticalMode | None = None if isinstance(optics, str) else optics
        self._optics = optics if isinstance(optics, str) else ""
        self._optics_name = (
            optics.label if not isinstance(optics, str) else "raytrace-" + integrator if optics == "raytrace" else optics
        )
        self._pad: RigidPad | SoftPad | None = None

    @property
    def label(self) -> str:
        """Physics and optics that frames come from, e.g. ``rigid+raytrace-fast``; goes into headers and reports.

        The optical mode names itself once it is built, which options such as a denoiser change.
        """
        optics = self._optics_name if self._mode is None else self._mode.label
        physics = "ipc-" + self.pad if self.physics == "ipc" else self.physics
        return f"{physics}+{optics}" if self._optical_outputs else physics

    @property
    def pad(self) -> str:
        """How finely a simulated pad is cut: a level of ``PADS``, or ``own`` for a mesh of one's own; empty for the rigid pad."""
        if self.physics != "ipc":
            return ""
        return self._level if isinstance(self._level, str) else "own"

    @property
    def sampling(self) -> dict[str, int | str]:
        """``integrator`` and ``spp`` of the optical mode, for headers and reports; empty without images, or if it has neither."""
        mode = self.optical_mode if self._optical_outputs else None
        integrator = getattr(mode, "integrator", None)
        if integrator is None:
            return {}
        spp = getattr(mode, "rays", 1) ** 2 if integrator == "fast" else getattr(mode, "spp", None)
        return {"integrator": integrator} | ({} if spp is None else {"spp": spp})

    @property
    def device_used(self) -> str:
        """``cpu`` or ``cuda``: where the images are made; ``cpu`` if there are none."""
        return self.optical_mode.device if self._optical_outputs else "cpu"

    @property
    def _optical_outputs(self) -> tuple[str, ...]:
        return tuple(name for name in self.outputs if name in OPTICAL_OUTPUTS)

    def press(
        self, scene: str | Path | PressScene, *, offsets: np.ndarray | None = None, depths: np.ndarray | None = None
    ) -> TactileFrame:
        """Run the scene's trajectory and return the frame at its peak (the end of the last stage that is not a release).

        ``offsets`` and ``depths`` are as for ``load``.

        Raises:
            InputError: ``offsets`` or ``depths`` of the wrong shape or out of range.
            SpecError: the scene breaks a rule, alone or together with this sensor.
        """
        press = _press_scene(scene)
        validate_press(self.spec, press)
        start = time.perf_counter()
        pad = self.load(press, offsets=offsets, depths=depths)
        state = pad.peak(self._followed(pad.run()))  # type: ignore[arg-type]
        physics_ms = 1e3 * (time.perf_counter() - start)
        frame = self.update(state)
        return replace(frame, time_ms={"physics": physics_ms, **frame.time_ms})

    def load(
        self, scene: str | Path | PressScene, *, offsets: np.ndarray | None = None, depths: np.ndarray | None = None
    ) -> RigidPad | SoftPad:
        """Put the scene's object before this sensor, and return the physics, so that a loop can step it and call ``update``.

        Args:
            scene: name of a shipped press scene, path of a scene file, or a scene.
            offsets: added to the object's x, y per environment [m], pad frame, shape (B, 2) with B = ``num_envs``; None is none.
            depths: depth of every depth-driven indent per environment [m], shape (B,), in place of the scene's.

        Raises:
            InputError: ``offsets`` or ``depths`` of the wrong shape or out of range.
            SpecError: the scene breaks a rule.
            BackendError: a simulated pad is asked for, and its solver cannot run here.
            RaytacError: the object overlaps a simulated pad where it starts.
        """
        press = _press_scene(scene)
        self.physics = self._asked_physics or ("ipc" if self._asked_pad is not None else press.physics or "rigid")
        self._level = self._asked_pad or press.pad or PADS[0]
        settings: dict[str, Any] = {"pitch": self._pitch, "num_envs": self.num_envs, "seed": self.seed}
        settings |= {"offsets": offsets, "depths": depths}
        if self.physics == "ipc":
            self._pad = _soft_pad()(self.spec, press, pad=self._level, device=_solver_device(self.device), **settings)
        else:
            from raytac.physics.rigid import RigidPad

            self._pad = RigidPad(self.spec, press, **settings)
        if self._tracker is not None:
            self._tracker.reset()
        return self._pad

    def update(self, state: ContactState | GelSurface) -> TactileFrame:
        """Frame of a gel surface, or of a state of the physics that ``load`` or ``press`` set up.

        With markers, call it for every state in order: some models follow the object since first touch (``reset_markers`` forgets).

        Raises:
            InputError: a state, and no scene was loaded, or another one than the state is of.
        """
        start = time.perf_counter()
        if isinstance(state, GelSurface):
            surface, force, area, failed = state, None, None, None
            forces: dict[str, Any] = {}
        else:
            surface, failed = self._surface(state), state.failed
            area = state.force_law_area if self.physics == "rigid" else None
            forces = self._forces(state, surface)
            force = np.concatenate([state.shear_force, -state.normal_force[:, None]], axis=1)
        done = time.perf_counter()
        time_ms = {"surface": 1e3 * (done - start)}
        markers = None
        if self.markers is not None:
            markers = self.marker_tracker.update(surface)
            surface, done = self._dotted(surface, markers), time.perf_counter()
            time_ms["markers"] = 1e3 * (done - start) - time_ms["surface"]
        return self._frame(surface, markers, done, time_ms, force=force, force_law_area=area, failed=failed, **forces)

    def _frame(
        self, surface: GelSurface, markers: MarkerFrame | None, done: float, time_ms: dict[str, float], **fields: Any
    ) -> TactileFrame:
        """The frame with the images that are asked for; ``done``: when the surface was there."""
        height = surface.height if "height" in self.outputs else None
        if not self._optical_outputs:
            return TactileFrame(surface, height=height, markers=markers, time_ms=time_ms, **fields)
        images = self.optical_mode.render(surface)
        time_ms["optics"] = 1e3 * (time.perf_counter() - done)
        return TactileFrame(
            surface=surface,
            rgb=images.rgb,
            layers=images.layers,
            normals=images.normals,
            position=images.position,
            depth=images.depth,
            height=height,
            contact=images.contact,
            uncovered=images.uncovered,
            markers=markers,
            time_ms=time_ms,
            **fields,
        )

    def rest(self) -> TactileFrame:
        """Frame of one untouched pad (B = 1), what every difference image is taken from; markers keep their history."""
        start, surface, markers = time.perf_counter(), GelSurface.at_rest(self.grid), None
        if self.markers is not None:
            markers = self.marker_tracker.at_rest()
            surface = self._dotted(surface, markers)
        done = time.perf_counter()
        return self._frame(surface, markers, done, {"surface": 1e3 * (done - start)})

    @property
    def marker_tracker(self) -> MarkerTracker:
        """The marker model with its history, built on first use.

        Raises:
            InputError: the sensor was given no marker model, or lacks what the model needs.
            BackendError: the model's backend does not work here.
        """
        if self.markers is None:
            raise InputError("markers", value=None, rule="was not asked for", choices=MARKER_MODELS)
        if self._tracker is None:
            self._tracker = MarkerTracker(
                self.spec,
                self.markers,
                self.grid,
                num_envs=self.num_envs,
                resolution=self.resolution,
                device=self.device,
                seed=self.seed,
                perturbation=self._marker_perturbation,
            )
        return self._tracker

    def reset_markers(self, envs: np.ndarray | list[int] | None = None) -> None:
        """Forget what the markers of environments (a mask (B,), a list, or None for all) went through; draws their placement anew.

        ``load`` and ``press`` do it for all.

        Raises:
            InputError: no marker model was asked for, or an environment that does not exist.
        """
        self.marker_tracker.reset(envs)

    def _followed(self, states: Iterable[ContactState]) -> Iterator[ContactState]:
        """The same states, while markers that need it see every one of them."""
        for state in states:
            if self.markers is not None:
                self.marker_tracker.follow(self._surface(state))
            yield state

    def _dotted(self, surface: GelSurface, markers: MarkerFrame) -> GelSurface:
        """The surface with dots printed where the markers are, if there is an image to show them."""
        if not {"rgb", "layers"} & set(self._optical_outputs):
            return surface
        from raytac.markers.dots import dot_ink

        return replace(surface, ink=dot_ink(surface.grid, markers.position, self.spec.markers.radius))

    def object_height(self, surface: GelSurface) -> np.ndarray | None:
        """Underside of the loaded scene's object at the surface's poses, pad frame [m], shape (B, Ny, Nx), inf where it is not.

        None if the surface has no object.
        """
        return None if self._pad is None else self._pad.object_height(surface)

    def _forces(self, state: ContactState, surface: GelSurface) -> dict[str, Any]:
        """Wrench, traction and contact area, as far as they are asked for."""
        pad, found = self._pad, {}
        assert pad is not None
        if "wrench" in self.outputs:
            found["wrench"] = pad.wrench(state)
        if "traction" in self.outputs:
            found["traction"] = pad.traction(state)
        if found:
            cell = surface.grid.pitch[0] * surface.grid.pitch[1]
            found["contact_area"] = np.where(state.failed, np.nan, surface.contact.sum(axis=(1, 2)) * cell)
        return found

    def _surface(self, state: ContactState) -> GelSurface:
        if not hasattr(state, "pad_from_object"):
            raise InputError(
                "state", value=type(state).__name__, rule="must be a GelSurface, or a state of the physics that load() returned"
            )
        if self._pad is None:
            raise InputError("state", value=type(state).__name__, rule="needs a scene: call load() first, or give a GelSurface")
        if state.scene is not None and state.scene != self._pad.scene:
            rule = f"belongs to the scene {state.scene.name!r}, and {self._pad.scene.name!r} was loaded since"
            raise InputError("state", value=type(state).__name__, rule=rule)
        return self._pad.surface(state)

    @property
    def optical_mode(self) -> OpticalMode:
        """The renderer, built on first use.

        Raises:
            InputError: an unknown name or a bad value in ``optics_options``.
            BackendError: the renderer or the device does not work here.
        """
        mode = self._mode
        if mode is None:
            mode = self._mode = self._build_mode()
        return mode

    def _build_mode(self) -> OpticalMode:
        settings: dict[str, Any] = {"resolution": self.resolution, "outputs": self._optical_outputs, "device": self.device}
        if self._optics == "taxim":
            from raytac.optics.taxim import TaximMode as Mode
        elif self._optics == "phong":
            from raytac.optics.phong import PhongMode as Mode
        else:
            from raytac.optics.raytrace import RayTracer as Mode

            settings |= {"integrator": self.integrator, "spp": self.spp, "seed": self.seed}
        known = [name for name in inspect.signature(Mode).parameters if name != "sensor" and name not in settings]
        for name, value in self._optics_options.items():
            if name not in known:
                rule = f"is no option of optics={self._optics!r}, or an argument of TactileSensor itself"
                raise InputError(f"optics_options[{name!r}]", value=value, rule=rule, choices=known)
        return Mode(self.spec, **settings, **self._optics_options)


def _soft_pad() -> type[SoftPad]:
    try:
        from raytac.physics.soft import SoftPad
    except ImportError as error:
        raise BackendError(f"physics='ipc' needs the contact solver ({error}): `pip install raytac[ipc]`") from error
    return SoftPad


def _solver_device(device: str) -> str:
    """``cpu`` or ``cuda`` for the solver, which traces no rays and needs no OptiX."""
    return resolve_device(device, ray_tracing=False)


def sensor_outputs(optics: str) -> tuple[str, ...]:
    """Outputs that ``optics=`` offers: all of ``OUTPUTS``, but no layers without rays."""
    return OUTPUTS if optics == "raytrace" else tuple(name for name in OUTPUTS if name != "layers")


def _press_scene(scene: object) -> PressScene:
    if not isinstance(scene, (str, Path, PressScene)):
        raise InputError("scene", value=scene, rule=f"must be a name, a path or a PressScene, not {type(scene).__name__}")
    return scene if isinstance(scene, PressScene) else load_press(scene)


def _checked_resolution(resolution: object) -> tuple[int, int] | None:
    if resolution is None:
        return None
    if isinstance(resolution, str):
        resolution = parse_resolution(resolution)
    if not isinstance(resolution, (tuple, list)) or len(resolution) != 2:
        raise InputError("resolution", value=resolution, rule="must be (width, height) in pixels, as in (320, 240) or '320x240'")
    for side in resolution:
        _check_whole("resolution", side)
        if side > LARGEST_SIDE:
            raise InputError("resolution", value=side, rule=f"must be at most {LARGEST_SIDE} pixels a side")
    return int(resolution[0]), int(resolution[1])


def _warn_of_other_shape(resolution: tuple[int, int], native: tuple[int, int]) -> None:
    """The field of view is the sensor's, so an image of another shape has pixels that are not as wide as high on the gel."""
    stretch = (resolution[0] / native[0]) / (resolution[1] / native[1])
    if abs(stretch - 1.0) > SHAPE_TOLERANCE:
        (width, height), (w, h) = resolution, native
        warnings.warn(
            f"resolution {width}x{height} squeezes the sensor's view of {w}x{h}: against the sensor's pixels these are "
            f"{max(stretch, 1 / stretch):.3g} times as {'high as wide' if stretch > 1 else 'wide as high'}; "
            f"{width}x{max(round(width * h / w), 1)} keeps their shape",
            stacklevel=3,
        )


def _check_name(name: str, value: object, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise InputError(name, value=value, rule="must be a known name", choices=choices)


def _check_whole(name: str, value: object) -> None:
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
        raise InputError(name, value=value, rule="must be a whole number >= 1")
