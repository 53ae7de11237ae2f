"""``WarpTouch``: sensors' observations of a ``WarpWorld``, as tensors on its device."""

# pyright: reportMissingImports=false
# (PyTorch belongs to the extra "rl", which the tests do without.)

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
import warp as wp

from raytac.errors import InputError
from raytac.gel.surface import make_grid
from raytac.gel.traction import cell_areas, spread_force
from raytac.markers import MarkerPerturbation
from raytac.markers.base import MarkersConfig
from raytac.markers.ink_kernels import DeviceInk
from raytac.markers.pattern import MarkerPattern
from raytac.observe import DeviceImages, ObservationSettings, Randomization, TactileObserver
from raytac.observe.observer import CellMeans
from raytac.observe.randomization import response_curves
from raytac.specs.sensor import ResponseSpec
from raytac.world.pad_touch import PadTouch
from raytac.world.warp_world import WarpWorld


class WarpTouch:
    """Observations of all sensors of B environments, as of ``TactileObserver``.

    Names and scales are the same.

    Attributes:
        pads: surfaces and markers of every sensor by its name; empty where the wrench alone is observed.
    """

    def __init__(
        self,
        world: WarpWorld,
        observers: Mapping[str, TactileObserver],
        *,
        pitch: float,
        generator: torch.Generator,
        patches: int = 16,
    ) -> None:
        """Make the arrays.

        Args:
            world: after a reset.
            observers: of all sensors by name: settings and randomisation of what is observed; they are not called.
            pitch: spacing of the pads' grids [m].
            generator: of noise, losses and cameras, on the device of the world.
            patches: most separate contacts of a pad, for its markers.

        Raises ``InputError`` as ``PadTouch`` and ``DeviceImages``, and for markers whose pattern moves.
        """
        self._world, self._fresh = world, torch.ones(world.engine.num_envs, dtype=torch.bool, device=generator.device)
        self._wrenches = wp.to_torch(world.contact.wrenches)
        self._sensors: dict[str, _SensorTouch] = {}
        for k, mounted in enumerate(world.composed.sensors):
            if observers[mounted.name].settings.needs_frames:
                sensor = _SensorTouch(world, k, observers[mounted.name], pitch=pitch, generator=generator, patches=patches)
                self._sensors[mounted.name] = sensor
        self.pads = {name: sensor.pad for name, sensor in self._sensors.items()}
        self._settings: dict[str, ObservationSettings] = {name: one.settings for name, one in observers.items()}
        self._last: dict[str, torch.Tensor] = {}
        self._scales: dict[tuple[str, str], torch.Tensor] = {}
        for name, settings in self._settings.items():
            for modality in settings.modalities:
                if modality not in ("rgb", "contact", "marker_visible"):
                    scale = torch.tensor(settings.scale(modality), dtype=torch.float64, device=generator.device)
                    self._scales[name, modality] = scale.expand(6) if modality == "wrench" else scale

    def launch(self) -> None:
        """Launch the surfaces and markers of the present poses."""
        for pad in self.pads.values():
            pad.launch(self._world.contact, self._world.engine.active)

    def forget(self, mask: wp.array) -> None:
        """Launch that the pads of a mask (B,), bool, forget the past."""
        for pad in self.pads.values():
            pad.reset(mask)

    def begin(self, mask: torch.Tensor) -> None:
        """Begin episodes of a mask (B,): empty their stacks and draw their cameras again."""
        self._fresh = self._fresh | mask
        for sensor in self._sensors.values():
            if sensor.cameras is not None:
                sensor.cameras.begin(mask)

    def check(self) -> None:
        """Wait for the device. Raises ``InputError`` if contacts were lost for want of memory."""
        for pad in self.pads.values():
            pad.check()

    def observe(self, mask: torch.Tensor | None = None) -> dict[str, torch.Tensor]:
        """Observations (B, …) after ``launch``: ``<sensor>_<modality>``.

        ``mask`` (B,): environments that are observed, None for all; the others keep their last observation, and their stacks do not move.
        """
        result = {}
        for k, (name, settings) in enumerate(self._settings.items()):
            values = {"wrench": self._wrenches[:, k]}
            if name in self._sensors:
                values |= self._sensors[name].observe(values["wrench"])
            for modality in settings.modalities:
                key, scale = f"{name}_{modality}", self._scales.get((name, modality))
                value = values[modality] if scale is None else (values[modality] / scale).float()
                if settings.stack > 1:
                    value = self._stacked(key, value, settings.stack)
                if mask is not None and key in self._last:
                    value = torch.where(_rows(mask, value), value, self._last[key])
                self._last[key] = value
                result[key] = value.clone()  # a learner may write to it
        self._fresh = torch.zeros_like(self._fresh) if mask is None else self._fresh & ~mask
        return result

    def _stacked(self, key: str, now: torch.Tensor, count: int) -> torch.Tensor:
        """The last ``count`` observations, all the present one where an episode has begun."""
        is_image = key.endswith("_rgb")
        first = now.repeat(1, 1, 1, count) if is_image else now[:, None].repeat(1, count, *(1 for _ in now.shape[1:]))
        if key not in self._last:
            return first
        last = self._last[key]
        moved = torch.cat([last[..., 3:], now], dim=-1) if is_image else torch.cat([last[:, 1:], now[:, None]], dim=1)
        return torch.where(_rows(self._fresh, first), first, moved)


class _SensorTouch:
    """Surface, markers and images of one sensor."""

    def __init__(
        self, world: WarpWorld, index: int, observer: TactileObserver, *, pitch: float, generator: torch.Generator, patches: int
    ) -> None:
        device, settings, spec = world.engine.device, observer.settings, observer.sensor
        count = world.engine.num_envs
        self._device, self._generator, self._settings = device, generator, settings
        self._grid, self._images = make_grid(spec.gelpad, pitch), None
        markers, self._perturbation = _without_perturbation(observer.markers)
        self.cameras = None
        if "rgb" in settings.modalities:
            self.cameras = WarpCameras.of(observer, generator)
            # With cameras that drift it is their images that are compared.
            drifts = self.cameras is not None
            shown = replace(settings, stack=1, difference=settings.difference and not drifts)
            plain = TactileObserver(spec, shown, num_envs=count, seed=observer.seed)
            sensor = plain.make_sensor(device="cuda" if device.is_cuda else "cpu", pitch=pitch, markers=markers)
            self._grid, self._images = sensor.grid, DeviceImages(plain, sensor)
        grid = self._grid
        bodies = [body.parts for body in world.composed.touched]
        gels = world.pairs.gels(index)
        self.pad = PadTouch(
            spec, grid, bodies, markers, gels=gels, pad=index, num_envs=count, patches=patches, device=str(device)
        )
        self._height, self._contact = wp.to_torch(self.pad.height), wp.to_torch(self.pad.contact)
        self._rest = torch.tensor(grid.rest, dtype=torch.float32, device=generator.device)
        self._ink = None
        if self.pad.fots is not None:
            self._markers = wp.to_torch(self.pad.fots.displacement)
            rest = MarkerPattern.of(spec).rest[0, :, :2]
            self._marker_rest = torch.tensor(rest, dtype=torch.float64, device=generator.device)
            self._centres = torch.empty((count, *rest.shape), dtype=torch.float64, device=generator.device)
            self._pixel = torch.tensor(spec.camera.pitch_at(observer.layout.rendered), device=generator.device)
            if self._images is not None:
                self._ink = DeviceInk(grid, spec.markers.radius, num_envs=count, device=str(device))
        self._at_rest: torch.Tensor | None = None
        if {"height", "indentation", "contact", "traction"} & set(settings.modalities):
            matrices = CellMeans(grid.shape, settings.map_shape).matrices()
            self._rows, self._columns = (torch.tensor(one, dtype=torch.float32, device=generator.device) for one in matrices)
            x, y, area = (
                torch.tensor(one, dtype=torch.float32, device=generator.device) for one in (grid.x, grid.y, cell_areas(grid))
            )
            self._nodes = x, y, area

    def observe(self, wrench: torch.Tensor) -> dict[str, torch.Tensor]:
        """All modalities but the ``wrench`` (B, 6), in SI units."""
        result, wanted = {}, self._settings.modalities
        if self._settings.needs_markers:
            result["markers"], result["marker_visible"] = self._tracked()
        if "height" in wanted:
            result["height"] = self._means(self._height)
        if "indentation" in wanted:
            result["indentation"] = self._means(self._rest - self._height)
        if "contact" in wanted:
            result["contact"] = self._means(self._contact.float())
        if "traction" in wanted:
            force, indentation = wrench.float(), self._rest - self._height
            spread = spread_force(self._nodes, self._contact != 0, indentation, force, force[:, 5], about_origin=True)
            result["traction"] = self._means(spread.movedim(-1, 1)).movedim(1, -1)
        if "rgb" in wanted:
            result["rgb"] = self._image()
        return result

    def _tracked(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Displacements (B, M, 2) [m] with noise, 0 where lost, and 1 (B, M) where not lost."""
        moved, drawn = self._markers, self._perturbation
        visible = torch.ones(moved.shape[:2], dtype=torch.int8, device=moved.device)
        if drawn.noise_px:
            noise = torch.randn(moved.shape, generator=self._generator, dtype=torch.float64, device=moved.device)
            moved = moved + drawn.noise_px * noise * self._pixel
        if drawn.dropout:
            chance = torch.rand(moved.shape[:2], generator=self._generator, device=moved.device)
            visible = (chance >= drawn.dropout).to(torch.int8)
            moved = moved * visible[..., None]
        return moved, visible

    def _means(self, values: torch.Tensor) -> torch.Tensor:
        return self._rows @ values @ self._columns

    def _image(self) -> torch.Tensor:
        """Images (B, height, width, 3) of 8 bit."""
        ink = None
        if self._ink is not None:
            torch.add(self._marker_rest, self._markers, out=self._centres)
            ink = wp.to_torch(self._ink(wp.from_torch(self._centres, dtype=wp.vec2d))).reshape(-1)
        image = self._render(self._height, self._contact, ink)
        if self.cameras is None:
            return image
        seen = self.cameras.apply(image)
        if not self._settings.difference:
            return seen
        if self._at_rest is None:
            at_rest = self._rest.expand_as(self._height), torch.zeros_like(self._contact)
            if self._ink is not None:
                self._centres[:] = self._marker_rest
                ink = wp.to_torch(self._ink(wp.from_torch(self._centres, dtype=wp.vec2d))).reshape(-1)
            self._at_rest = self._render(*at_rest, ink)[:1].clone()
        assert self._at_rest is not None
        rest = self.cameras.apply(self._at_rest.expand_as(image), noise=False)
        return ((255 + seen.to(torch.int16) - rest) // 2).to(torch.uint8)

    def _render(self, heights: torch.Tensor, contact: torch.Tensor, ink: torch.Tensor | None) -> torch.Tensor:
        """Images that another library renders, which must not begin before the heights are there."""
        assert self._images is not None
        if self._device.is_cuda:
            wp.synchronize_stream(wp.get_stream(self._device))
        arrays: tuple[Any, ...] = heights.reshape(-1), contact.reshape(-1), ink
        return torch.from_dlpack(self._images.observe(*arrays)["rgb"])


def _without_perturbation(markers: MarkersConfig | None) -> tuple[MarkersConfig | None, MarkerPerturbation]:
    """Model of markers, and its perturbation; InputError for a pattern that moves."""
    drawn = None if markers is None else markers.perturbation
    if markers is None or drawn is None:
        return markers, MarkerPerturbation()
    if drawn.moves_pattern:
        rule = "must not shift or turn the pattern on the device"
        raise InputError("perturbation", value=drawn, rule=rule, choices=("noise_px", "dropout"))
    return replace(markers, perturbation=None), drawn


def _rows(mask: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
    """A mask (B,) in the shape that chooses rows of values (B, …)."""
    return mask.reshape(-1, *(1 for _ in values.shape[1:]))


class WarpCameras:
    """``CameraDrift`` with draws from one generator of the device: cameras of B environments."""

    def __init__(self, randomization: Randomization, response: ResponseSpec, num_envs: int, generator: torch.Generator) -> None:
        """Draw all cameras; ``response`` is that of the sensor's camera."""
        self._settings, self._response, self._generator = randomization, response, generator
        self._curves = torch.zeros((num_envs, 3, 256), dtype=torch.float32, device=generator.device)
        first = 256 * torch.arange(3 * num_envs, dtype=torch.int32, device=generator.device)
        self._first = first.reshape(num_envs, 1, 1, 3)
        self.begin(torch.ones(num_envs, dtype=torch.bool, device=generator.device))

    @classmethod
    def of(cls, observer: TactileObserver, generator: torch.Generator) -> WarpCameras | None:
        """Cameras of an observer; None if they do not differ."""
        if not observer.randomization.changes_images:
            return None
        return cls(observer.randomization, observer.sensor.response, observer.num_envs, generator)

    def begin(self, mask: torch.Tensor) -> None:
        """Draw the cameras of the environments of a mask (B,)."""
        shape, device = (len(self._curves), 5), self._curves.device
        u = torch.rand(shape, generator=self._generator, dtype=torch.float64, device=device)
        curves = response_curves(2.0 * u - 1.0, self._settings, self._response)
        self._curves = torch.where(mask[:, None, None], curves.float(), self._curves)

    def apply(self, images: torch.Tensor, *, noise: bool = True) -> torch.Tensor:
        """8-bit images (B, H, W, 3) of these cameras; ``noise``: add the noise of a frame."""
        entry = (self._first + images).reshape(-1)
        values = self._curves.reshape(-1).index_select(0, entry).reshape(images.shape)
        if noise and self._settings.noise:
            drawn = torch.randn(images.shape, generator=self._generator, device=images.device)
            values = values + self._settings.noise * drawn
        return (values + 0.5).clamp(0.0, 255.0).to(torch.uint8)
