"""``TactileSensor``: one sensor, physics and optical mode; a press in, a frame out."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Unpack

import numpy as np
from numpy.typing import ArrayLike

from raytac.checks import MOST_ENVIRONMENTS, check_seed, check_seeds, check_truth, check_whole
from raytac.device import resolve_device
from raytac.errors import InputError
from raytac.frame import IMAGES, TactileFrame
from raytac.gel.pyramid import ElasticSurround
from raytac.gel.surface import GelSurface, PadGrid, check_grid, chosen_envs, grid_pitch, make_grid, on_grid
from raytac.gel.traction import cell_areas
from raytac.markers.base import MarkersConfig
from raytac.markers.pattern import DotInk, MarkerPattern
from raytac.markers.registry import MARKERS
from raytac.markers.tracker import MarkerFrame, MarkerTracker
from raytac.optics.base import OPTICAL_OUTPUTS, BuiltOptics, OpticalMode, OpticsConfig, OpticsImages, start
from raytac.optics.grain import Grain
from raytac.optics.registry import chosen_optics
from raytac.physics.base import Pad, PadReading, PhysicsConfig, TargetArrays
from raytac.physics.registry import PHYSICS, checked_physics, scene_physics
from raytac.physics.soft.contact_width import cells_across, holds_force, warn_if_narrow
from raytac.sensor.options import (
    EnvironmentTargets,
    check_maps,
    checked_markers,
    checked_outputs,
    checked_pitch,
    checked_resolution,
    press_scene,
    warn_of_other_shape,
)
from raytac.specs import PressScene, SensorSpec, press_of, validate_press
from raytac.specs.sensor_file import sensor_spec


class TactileSensor:
    """A simulated GelSight sensor.

    .. code-block:: python

        sensor = TactileSensor("gelsight_mini", outputs=("rgb", "depth"))
        frame = sensor.press("coin")
        frame.rgb  # (B, H, W, 3) uint8

    The optical mode is built at the first image and reused for every later one. ``copy.copy``, ``copy.deepcopy`` and ``pickle`` give
    another sensor of the same settings, before any scene: renderer and simulation stay with this one.
    """

    spec: SensorSpec
    outputs: tuple[str, ...]
    resolution: tuple[int, int]
    """(width, height) of every image [px]."""
    grid: PadGrid
    """Nodes of the pad's surface."""
    optics: OpticsConfig[OpticalMode]
    """Configuration of the optical mode."""
    pitch: float
    """Spacing of the nodes that was asked for [m]; ``grid`` fits it to the pad."""
    markers: MarkersConfig | None
    """Configuration of the marker model; None without markers."""
    physics: PhysicsConfig | None
    """Configuration of the physics, as asked for; None is as each scene says, else ``rigid``."""

    def __init__(
        self,
        sensor: str | Path | SensorSpec = "gelsight_mini",
        *,
        physics: str | PhysicsConfig | None = None,
        optics: str | OpticsConfig[OpticalMode] | OpticalMode = "raytrace",
        outputs: Sequence[str] | str = ("rgb",),
        resolution: tuple[int, int] | str | None = None,
        device: str = "auto",
        seed: int = 0,
        num_envs: int = 1,
        pitch: float | None = None,
        markers: str | MarkersConfig | None = None,
        noise: bool = False,
    ) -> None:
        """Check everything and compute nothing yet.

        Args:
            sensor: name of a shipped sensor, path of a sensor file, or a specification.
            physics: how the gel deforms, a name of ``raytac.physics.PHYSICS`` or a configuration such as ``Rigid()`` or
                ``Ipc(level="medium")``; None is as each scene says, else ``rigid``.
            optics: how images are made: a name of ``raytac.optics.OPTICS``, a configuration such as ``Taxim(shadows=False)``, or an
                optical mode that is built already (it keeps its own resolution, outputs and device).
            outputs: what a frame holds, one name or several of ``raytac.frame.OUTPUTS``; nothing else is computed.
            resolution: (width, height) of the images [px], or text as ``"320x240"``; None is the sensor's own. The field of view stays
                the sensor's: another shape squeezes it, with a warning.
            device: ``auto``, ``cpu`` or ``cuda``.
            seed: of every random number, in [0, 2^32).
            num_envs: number of environments B that a press simulates; ``press`` and ``load`` say how they can differ.
            pitch: spacing of the pad's grid [m]; None is that of a pixel on the pad, at most 0.1 mm.
            markers: marker model, a name of ``raytac.markers.MARKERS`` or a configuration such as ``Fots(perturbation=…)``; frames then
                hold markers, and images show the dots. None leaves them out, and images show a plain coat.
            noise: True adds the camera's grain to ``rgb``, as the sensor file's ``[noise]`` says; ``rest`` and ``layers`` have none.

        Raises:
            InputError: an unknown name or a value out of range; the message lists the choices.
            SpecError: the sensor, light or calibration file breaks a rule.
            BackendError: ``device="cuda"`` where there is no CUDA or no OptiX.
        """
        settings = {name: value for name, value in locals().items() if name not in ("self", "__class__")}
        self._settings: dict[str, Any] = settings
        """Arguments that make this sensor again."""
        self.physics = checked_physics(physics)
        self.optics = chosen_optics(optics)
        resolve_device(device)
        self.outputs = checked_outputs(outputs, self.optics)
        self.markers = checked_markers(markers, self.physics)
        check_whole("num_envs", num_envs, 1, MOST_ENVIRONMENTS)
        size = checked_resolution(resolution)
        self.seed = check_seed("seed", seed)
        self.spec = sensor_spec(sensor)
        self._used = self.physics or PHYSICS.config("rigid")
        """Physics of the press that was loaded last."""
        self.resolution = size if size is not None else self.spec.camera.resolution
        warn_of_other_shape(self.resolution, self.spec.camera.resolution)
        self.device, self.num_envs = device, num_envs
        self.pitch = grid_pitch(self.spec.camera.pitch_at(self.resolution)) if pitch is None else pitch
        self.grid = make_grid(self.spec.gelpad, self.pitch)
        self._known_grid = self.grid
        """Grid of the last surface, which is of this pad."""
        if self.markers is not None:
            MarkerPattern.of(self.spec, self.resolution)  # refuse a pattern outside the view now
        self._tracker: MarkerTracker | None = None
        self._ink: DotInk | None = None
        is_noisy = check_truth("noise", noise)
        self._grain = Grain(self.spec, self.resolution, seed=self.seed, batch=self.num_envs) if is_noisy else None
        self.optics.check(self.spec)
        self._mode: OpticalMode | None = None
        self._pad: Pad | None = None
        self._has_warned = False
        """True once this press was warned of as too narrow for the pad's cells."""

    def __repr__(self) -> str:
        size, outputs = "{} x {} px".format(*self.resolution), ", ".join(self.outputs)
        return f"TactileSensor({self.spec.name}, {size}, {self.label}; outputs: {outputs}; environments: {self.num_envs})"

    def _repr_html_(self) -> str:
        """Card for notebooks; with the image at rest once a renderer is built."""
        from raytac.io.html import card, picture

        spec, (width, height) = self.spec, self.resolution
        x, y = (1e3 * side for side in spec.gelpad.size)
        u, v = (1e3 * n * pitch for n, pitch in zip(self.resolution, spec.camera.pitch_at(self.resolution), strict=True))
        rows = {
            "gelpad": f"{x:.1f} × {y:.1f} mm, {1e3 * spec.gelpad.thickness:.1f} mm thick",
            "image": f"{width} × {height} px, {u:.1f} × {v:.1f} mm of the pad",
            "lights": f"{len(spec.lights.leds)} LEDs",
            "physics": "as each scene says" if self.physics is None else self.physics.label,
            "optics": (self._mode or self.optics).label,
            "markers": "none" if self.markers is None else MARKERS.name_of(self.markers),
            "outputs": ", ".join(self.outputs),
            "environments": self.num_envs,
        }
        is_built = self._mode is not None and "rgb" in self.outputs
        return card(f"TactileSensor · {spec.name}", rows, picture(self.rest().rgb[0], "at rest") if is_built else "")

    def __reduce__(self) -> tuple[Any, ...]:
        """A sensor of the same settings.

        Raises ``InputError``: an optical mode that was given built, which only its maker can copy, or markers with a history, which would
        be lost.
        """
        if isinstance(self.optics, BuiltOptics):
            rule = "cannot be copied or pickled with its sensor: make the other sensor with an optical mode of its own"
            raise InputError("optics", value=self._settings["optics"], rule=rule)
        if self._tracker is not None:
            rule = "cannot be copied or pickled once they have a history: make another sensor with the same arguments"
            raise InputError("markers", value=self._settings["markers"], rule=rule)
        return partial(type(self), **self._settings), ()

    @property
    def label(self) -> str:
        """Physics of the last press and optics, e.g. ``rigid+raytrace-fast``, for headers.

        The optical mode names itself once it is built: a table casts shadows only if it has some.
        """
        return f"{self._used.label}+{(self._mode or self.optics).label}" if self._optical_outputs else self._used.label

    @property
    def sampling(self) -> dict[str, int | float | str]:
        """``integrator``, ``spp``, ``exposure`` of the optical mode; empty without images or rays."""
        return getattr(self.optical_mode, "sampling", {}) if self._optical_outputs else {}

    @property
    def device_used(self) -> str:
        """``cpu`` or ``cuda``: where images are made; without images, where a soft pad is solved."""
        if self._optical_outputs:
            return self.optical_mode.device
        return resolve_device(self.device, ray_tracing=False) if self._used.is_simulated else "cpu"

    @property
    def _optical_outputs(self) -> tuple[str, ...]:
        return tuple(name for name in self.outputs if name in OPTICAL_OUTPUTS)

    def press(
        self,
        scene: Any,
        *,
        depth: float | None = None,
        force: float | None = None,
        offset: tuple[float, float] = (0.0, 0.0),
        yaw: float = 0.0,
        tilt: float = 0.0,
        scale: float | None = None,
        pitch: float | None = None,
        repair: bool = False,
        progress: bool = False,
        **targets: Unpack[EnvironmentTargets],
    ) -> TactileFrame:
        """Run the scene's trajectory; frame at its peak: the end of the last stage but a release.

        Args:
            scene: name, path or scene, as of ``load``, or an object alone: a mesh (a file or a ``trimesh.Trimesh``) or an array of
                heights [m].
            depth: depth of a single indent [m]; an object alone needs this or ``force``. It replaces a scene's own trajectory.
            force: normal force of that indent [N], instead of ``depth``.
            offset: place of the object on the pad, x and y [m].
            yaw, tilt: turn of the object [rad].
            scale, pitch, repair: of a mesh or of heights, as of ``raytac.specs.press_of``. Like the five before, they are the same in
                all environments.
            progress: True shows the stages and the solver's steps of a soft pad, which takes seconds to minutes: a bar on a terminal,
                else lines, on standard error.
            targets: targets and seeds of each environment, as of ``load``.

        Raises:
            InputError: an argument of ``press_of``, or of ``load``, of the wrong kind or shape, or out of range.
            SpecError: the scene breaks a rule, alone or together with this sensor.
            MeshError: the mesh cannot be used.
        """
        press = press_of(
            scene, depth=depth, force=force, offset=offset, yaw=yaw, tilt=tilt, scale=scale, pitch=pitch, repair=repair
        )
        validate_press(self.spec, press)
        began = time.perf_counter()
        pad = self.load(press, **targets)
        reading = pad.peak(self._followed(pad.run(progress=progress)))
        physics_ms = 1e3 * (time.perf_counter() - began)
        frame = self.update(reading)
        return frame.with_values(time_ms={"physics": physics_ms, **frame.time_ms})

    def load(
        self,
        scene: str | Path | PressScene,
        *,
        offsets: np.ndarray | None = None,
        depths: np.ndarray | None = None,
        rotations: np.ndarray | None = None,
        shears: np.ndarray | None = None,
        twists: np.ndarray | None = None,
        seeds: Sequence[int] | None = None,
    ) -> Pad:
        """Put the scene's object before this sensor, and return the physics, which a loop can step.

        On the CPU images of a soft pad take at most half of the cores from now on: else their threads wait busily while the solver runs.

        Args:
            scene: name of a shipped press scene, path of a scene file, or a scene.
            offsets: added to the object's x, y per environment [m], pad frame, shape (B, 2) with B = ``num_envs``; None is none.
            depths: depth of every depth-driven indent per environment [m], shape (B,), in place of the scene's; as for the next three,
                None leaves the scene's, and what is not finite makes its environment fail.
            rotations: turn of the object about its origin, before the press, axes of the pad frame, wxyz, shape (B, 4).
            shears: target of every ``shear`` stage along x, y [m], shape (B, 2).
            twists: target of every ``twist`` stage [rad], shape (B,).
            seeds: of the markers' perturbations and of the images' noise, one an environment; None goes on with the present streams.

        Raises:
            InputError: an argument of the wrong shape or out of range.
            SpecError: the scene breaks a rule.
            BackendError: a soft pad is asked for, and its solver cannot run here.
            RaytacError: the object overlaps a soft pad where it starts.
        """
        press = press_scene(scene)
        own_seeds = None if seeds is None else check_seeds("seeds", seeds, self.num_envs)
        self._used = scene_physics(self.physics, press)
        if self._used.is_simulated and self._optical_outputs and resolve_device(self.device) == "cpu":
            from raytac.optics.runtime import share_cores

            share_cores()  # the solver runs between two images
        targets = TargetArrays(offsets=offsets, depths=depths, rotations=rotations, shears=shears, twists=twists)
        self._pad = self._used.build(self.spec, press, pitch=self.pitch, num_envs=self.num_envs, device=self.device, **targets)
        self._has_warned = False
        if own_seeds is not None:
            if self.markers is not None:
                self.marker_tracker.reseed(range(self.num_envs), own_seeds)
            self.reseed_noise(range(self.num_envs), own_seeds)
        if self._tracker is not None:
            self._tracker.reset()
        return self._pad

    def update(self, state: PadReading | GelSurface, envs: Sequence[int] | None = None) -> TactileFrame:
        """Frame of a pad's reading, in a press of ``load`` or in a world, or of a gel surface.

        With markers, call it for every reading in order: some models follow the object since first touch (``reset_markers`` forgets).
        ``envs``: environment of each row of a surface or a reading, so that only their markers go on; None is all.

        Raises:
            InputError: neither of both, a reading of another scene than was loaded last, a surface of another sensor's pad; ``envs``
                that do not exist, or not one for each row.
        """
        began = time.perf_counter()
        envs = None if envs is None else chosen_envs(envs, self.num_envs)
        reading = PadReading(state) if isinstance(state, GelSurface) else state
        if not isinstance(reading, PadReading):
            rule = "must be a GelSurface, or a reading of the physics that load() returned"
            raise InputError("state", value=type(state).__name__, rule=rule)
        if self._pad is not None and reading.scene is not None and reading.scene != self._pad.scene:
            rule = f"belongs to the scene {reading.scene.name!r}, and {self._pad.scene.name!r} was loaded since"
            raise InputError("state", value=type(state).__name__, rule=rule)
        surface = reading.surface
        if surface.grid is not self._known_grid:
            check_grid(self.spec.gelpad, surface.grid)
            self._known_grid = surface.grid
        if envs is not None and len(envs) != surface.batch:
            raise InputError("envs", value=len(envs), rule=f"must name one environment for each of {surface.batch} rows")
        forces = self._force_fields(reading)
        ready = time.perf_counter()
        time_ms = {"surface": 1e3 * (ready - began)}
        markers = None
        if self.markers is not None:
            markers = self.marker_tracker.update(surface, envs, shear=reading.shear)
            surface, ready = self._dotted(surface, markers), time.perf_counter()
            time_ms["markers"] = 1e3 * (ready - began) - time_ms["surface"]
        grain_seeds = None
        if self._grain is not None:  # a bare surface may have fewer or more rows than there are environments
            row_envs = envs if envs is not None else [row % self.num_envs for row in range(surface.batch)]
            grain_seeds = self._grain.seeds(row_envs)
        return self._frame(surface, markers, ready, time_ms, grain_seeds=grain_seeds, **forces)

    def _force_fields(self, reading: PadReading) -> dict[str, Any]:
        """Fields of a frame about forces, as far as they are asked for; none of a bare surface."""
        if not reading.has_forces:
            return {}
        surface, failed = reading.surface, reading.failed
        fields: dict[str, Any] = {"force": reading.force, "force_law_area": reading.force_law_area, "failed": failed}
        fields["unconverged"] = reading.unconverged
        if "wrench" in self.outputs:
            fields["wrench"] = reading.wrench
        if "traction" in self.outputs:
            fields["traction"] = reading.traction()
        if {"wrench", "traction"} & set(self.outputs):
            area = cell_areas(surface.grid)
            fields["contact_area"] = np.where(failed, np.nan, [float(area[contact].sum()) for contact in surface.contact])
            if surface.coat is not None:
                fields["contact_cells"] = np.where(failed, np.nan, cells_across(surface, surface.coat.mesh))
                self._check_width(reading, fields["contact_cells"])
        return fields

    def _check_width(self, reading: PadReading, cells: np.ndarray) -> None:
        """Warn once a press if a stage to a depth ends with a contact too narrow for the cells.

        While a stage goes on, every contact is narrow for some time.
        """
        if reading.stage < 0:
            self._has_warned = False  # a press begins
            return
        if self._has_warned or reading.fraction < 1.0 or reading.scene is None:
            return
        if not holds_force(reading.scene, reading.stage):
            self._has_warned = warn_if_narrow(cells, getattr(self._used, "level", None), stacklevel=4)

    def _frame(
        self,
        surface: GelSurface,
        markers: MarkerFrame | None,
        ready: float,
        time_ms: dict[str, float],
        *,
        grain_seeds: list[int] | None = None,
        **fields: Any,
    ) -> TactileFrame:
        """The frame with the images that are asked for.

        ``ready``: when surface and markers were ready, by ``time.perf_counter`` [s]; ``grain_seeds``: of the noise in each row's image,
        None for none.
        """
        fields |= {"height": surface.height if "height" in self.outputs else None, "markers": markers}
        if self._optical_outputs:
            images = start(self.optical_mode, surface)
            grain = None if self._grain is None or grain_seeds is None else partial(self._grain.added, seeds=grain_seeds)
            fields["images"] = partial(_image_fields, images, grain)
            time_ms["optics"] = 1e3 * (time.perf_counter() - ready)
        return TactileFrame(surface, time_ms=time_ms, label=self.label, **fields)  # a mode is named once it is built

    def render(
        self,
        heights: ArrayLike,
        pitch: float | tuple[float, float] | None = None,
        *,
        overlap: bool = False,
        contact: ArrayLike | None = None,
    ) -> TactileFrame:
        """Frame of a height map that something else computed, without a press.

        Args:
            heights: displacement of the gel's surface from its rest along z of the pad frame [m]: 0 untouched, negative where it is
                pressed in, shape (rows, columns), or (B, rows, columns) for B frames. As the camera sees it: row 0 at the top, column 0
                on the left; the middle over the pad's centre. Beyond its edges the value at the edge is taken.
            pitch: spacing of the columns and rows on the pad [m], one number or (x, y); None: the map covers the camera's view.
            overlap: True if the map holds the undeformed object where it lies below the resting gel, as a depth camera in a simulator
                of rigid bodies sees it and as Taxim's geometric overlap does; 0 elsewhere. The gel around it then follows as under the
                rigid pad. False takes the map as the gel itself.
            contact: mask of the map's shape, where the object touches; None is 0.4 of the greatest depth, as in Taxim. A table asks
                for it, a ray tracer does not. Not with ``overlap``, which knows it.

        Raises ``InputError``: a map of another kind or shape, that is not finite, or deeper than the gel is thick.
        """
        frame = self.update(self._mapped(heights, pitch, overlap=check_truth("overlap", overlap), contact=contact))
        _, plus, optics = frame.label.partition("+")
        return frame.with_values(label=("overlap" if overlap else "map") + plus + optics)

    def _mapped(
        self, heights: ArrayLike, pitch: float | tuple[float, float] | None, *, overlap: bool, contact: ArrayLike | None
    ) -> GelSurface:
        """Gel surface of height maps; arguments and errors as of ``render``."""
        maps = check_maps("heights", heights)
        spacing = self.spec.camera.pitch_at(maps.shape[:0:-1]) if pitch is None else checked_pitch(pitch)
        thickness = self.spec.gelpad.thickness
        if np.abs(maps).max() >= thickness or (overlap and maps.max() > 0.0):
            rule = f"must be displacements in metres, within the gel's thickness of {thickness:g} m" + overlap * ", and <= 0"
            raise InputError("heights", value=(float(maps.min()), float(maps.max())), rule=rule)
        displacement = on_grid(self.grid, maps, spacing)
        if not overlap:
            mask = None if contact is None else on_grid(self.grid, check_maps("contact", contact, maps.shape), spacing) >= 0.5
            return GelSurface.displaced(self.grid, displacement, mask)
        if contact is not None:
            raise InputError("contact", rule="is computed with overlap=True: leave it out")
        surround = ElasticSurround(self.grid, thickness=thickness)
        surface = surround.surface(np.where(displacement < 0.0, self.grid.rest + displacement, np.inf))
        if not np.isfinite(surface.height).all():
            raise InputError("heights", value=float(maps.min()), rule="would press the gel below its bonded face")
        return surface

    def rest(self, envs: Sequence[int] = (0,)) -> TactileFrame:
        """Frame of untouched pads, which difference images start from.

        ``envs``: environments, one row each; they differ only where the marker pattern is shifted or turned. The markers' history stays as
        it is.
        """
        began, markers = time.perf_counter(), None
        surface = GelSurface.at_rest(self.grid).rows([0] * len(envs))
        if self.markers is not None:
            markers = self.marker_tracker.at_rest(envs)
            surface = self._dotted(surface, markers)
        ready = time.perf_counter()
        return self._frame(surface, markers, ready, {"surface": 1e3 * (ready - began)})

    @property
    def marker_tracker(self) -> MarkerTracker:
        """The marker model with its history, built on first use.

        Raises:
            InputError: the sensor was given no marker model, or lacks what the model needs.
            BackendError: the model's backend does not work here.
        """
        if self.markers is None:
            raise InputError("markers", rule="was not asked for", choices=MARKERS.names)
        if self._tracker is None:
            self._tracker = MarkerTracker(
                self.spec,
                self.markers,
                self.grid,
                num_envs=self.num_envs,
                resolution=self.resolution,
                device=self.device,
                seed=self.seed,
            )
        return self._tracker

    def reset_markers(self, envs: np.ndarray | list[int] | None = None) -> None:
        """Forget the history of the markers of environments, and draw their placement again.

        ``envs``: a mask (B,), a list, or None for all. ``load`` and ``press`` do it for all.

        Raises ``InputError``: no marker model was asked for, or an environment that does not exist.
        """
        self.marker_tracker.reset(envs)

    def reseed_noise(self, envs: Iterable[int], seeds: Iterable[int]) -> None:
        """Seed the grain of environments, each as that of a single one; none without ``noise``."""
        if self._grain is not None:
            for env, own_seed in zip(envs, seeds, strict=True):
                self._grain.reseed(env, own_seed)

    def _followed(self, readings: Iterable[PadReading]) -> Iterator[PadReading]:
        """The same readings, while markers that need it see every one of them."""
        for reading in readings:
            if self.markers is not None:
                self.marker_tracker.follow(reading.surface, reading.shear)
            yield reading

    def _dotted(self, surface: GelSurface, markers: MarkerFrame) -> GelSurface:
        """The surface with dots printed where the markers are, if there is an image to show them."""
        if not {"rgb", "layers"} & set(self._optical_outputs):
            return surface
        if self._ink is None or self._ink.grid is not surface.grid:
            self._ink = DotInk(surface.grid, self.spec.markers.radius)
        return replace(surface, ink=self._ink(markers.position))

    def object_height(self, surface: GelSurface) -> np.ndarray | None:
        """Underside of the loaded object [m], (B, Ny, Nx), inf beside it; None without an object."""
        return None if self._pad is None else self._pad.object_height(surface)

    @property
    def optical_mode(self) -> OpticalMode:
        """The renderer, built on first use. Raises as ``OpticsConfig.build``."""
        mode = self._mode
        if mode is None:
            mode = self._mode = self.optics.build(
                self.spec, resolution=self.resolution, outputs=self._optical_outputs, device=self.device, seed=self.seed
            )
        return mode


def _image_fields(images: Callable[[], OpticsImages], grain: Callable[[np.ndarray], np.ndarray] | None) -> dict[str, Any]:
    """Wait for ``images``: fields of a frame by name; ``grain`` adds noise to ``rgb``."""
    rendered = images()
    fields = {name: getattr(rendered, name, None) for name in IMAGES}
    if grain is not None and fields["rgb"] is not None:
        fields["rgb"] = grain(fields["rgb"])
    return fields
