"""``MarkerTracker``: marker displacements from surfaces, in metres and pixels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np

from raytac.errors import InputError
from raytac.gel.contact_shear import ContactShear
from raytac.gel.surface import GelSurface, PadGrid, chosen_envs, summary
from raytac.markers.base import MarkersConfig
from raytac.markers.contact_tracker import ContactTracker
from raytac.markers.contacts import ContactCells
from raytac.markers.pattern import MarkerPattern
from raytac.markers.perturbation import MarkerPerturbation, Perturber
from raytac.markers.registry import markers_config
from raytac.markers.sampling import height_at
from raytac.specs.sensor import SensorSpec


@dataclass(frozen=True, repr=False)
class MarkerFrame:
    """Markers of B pads at one instant, M each, row by row of the pattern."""

    displacement: np.ndarray
    """Displacement along x, y of the pad frame [m], (B, M, 2); NaN where lost or failed."""
    displacement_px: np.ndarray
    """Displacement along u, v of the image [px], (B, M, 2), with perspective; NaN likewise."""
    rest: np.ndarray
    """Positions at rest, pad frame [m], shape (B, M, 3)."""
    rest_px: np.ndarray
    """Positions at rest in the image [px], shape (B, M, 2)."""
    position: np.ndarray
    """Positions now, pad frame [m], (B, M, 3), without noise or losses; the image's dots."""
    visible: np.ndarray
    """True for markers that the tracker detects, shape (B, M), bool."""

    def __repr__(self) -> str:
        return summary(self)

    @property
    def pixel(self) -> np.ndarray:
        """Detected positions in the image [px], shape (B, M, 2)."""
        return self.rest_px + self.displacement_px


class _LazyFrame(MarkerFrame):
    """Markers whose ``position`` and ``displacement_px``, which learners seldom use, wait.

    They are computed when they are first read.
    """

    def __init__(
        self,
        displacement: np.ndarray,
        rest: np.ndarray,
        rest_px: np.ndarray,
        visible: np.ndarray,
        position: Callable[[], np.ndarray],
        displacement_px: Callable[[np.ndarray], np.ndarray],
    ) -> None:
        """Keep four fields; ``position`` makes the fifth, and ``displacement_px`` the sixth from it."""
        known = {"displacement": displacement, "rest": rest, "rest_px": rest_px, "visible": visible}
        self.__dict__.update(known, _position=position, _displacement_px=displacement_px)

    @cached_property
    def position(self) -> np.ndarray:  # type: ignore[override]
        return self._position()  # type: ignore[attr-defined]

    @cached_property
    def displacement_px(self) -> np.ndarray:  # type: ignore[override]
        return self._displacement_px(self.position)  # type: ignore[attr-defined]

    def __reduce__(self) -> tuple[Any, ...]:
        return MarkerFrame, tuple(getattr(self, field.name) for field in fields(MarkerFrame))


class MarkerTracker:
    """Moves a sensor's markers with one model.

    .. code-block:: python

        tracker = MarkerTracker(sensor, "fots", grid)
        for surface in surfaces:
            markers = tracker.update(surface)
            markers.displacement_px  # (B, M, 2)

    ``update`` is called for every surface in order: models that read contacts need the object's motion since first touch. ``reset`` drops
    this history.
    """

    def __init__(
        self,
        sensor: SensorSpec,
        markers: str | MarkersConfig,
        grid: PadGrid,
        *,
        num_envs: int = 1,
        resolution: tuple[int, int] | None = None,
        device: str = "auto",
        seed: int = 0,
    ) -> None:
        """Place the pattern and build the model.

        Args:
            sensor: gives the pattern, the camera and, for fitted models, the marker motion.
            markers: name of a marker model, or its configuration.
            grid: grid of the surfaces to come.
            num_envs: number of environments B.
            resolution: (width, height) of the image that pixels refer to [px]; None is the sensor's own.
            device: ``auto``, ``cpu`` or ``cuda``, for models that can use it.
            seed: of the perturbations.

        Raises:
            InputError: an unknown model, a sensor without markers or without the marker motion that the model needs, or a shift that
                takes a marker out of the view.
            SpecError: a marker lies outside the camera's view.
            BackendError: the model's backend does not work here.
        """
        config = markers_config(markers)
        self.sensor, self.grid, self.num_envs = sensor, grid, num_envs
        self._resolution = resolution
        self._perturber = Perturber(config.perturbation or MarkerPerturbation(), seed, num_envs)
        self._shift, self._turn = np.zeros((num_envs, 2)), np.zeros(num_envs)
        self._place(range(num_envs))
        self.model = config.build(sensor, grid, num_envs=num_envs, device=device)
        self._cells = ContactCells.over(grid, config.contacts) if self.model.needs_contacts else None
        self._contacts = ContactTracker(num_envs, config.contacts, slip=config.slip(sensor))
        self._follows_shear = config.follows_shear

    def _place(self, envs: range | list[int]) -> None:
        """Draw the pattern's placement in environments, where it is perturbed.

        All arrays of the pattern follow from it.
        """
        moves: dict[str, np.ndarray] = {}
        if self._perturber.settings.moves_pattern:
            for b in envs:
                self._shift[b], self._turn[b] = self._perturber.placement(b)
            moves = {"shift": self._shift, "turn": self._turn}
        elif hasattr(self, "pattern"):
            return  # it never moves
        self.pattern = pattern = MarkerPattern.of(self.sensor, self._resolution, **moves)
        self._rest = pattern.for_batch(self.num_envs)  # one array for every frame, so that models recognise it
        self._pixel = np.broadcast_to(pattern.pixel, (*self._rest.shape[:2], 2))
        self._all_visible = np.broadcast_to(True, self._rest.shape[:2])
        xy = pattern.rest[..., :2]
        self._grid_rest = height_at(GelSurface.at_rest(self.grid), xy.reshape(1, -1, 2)).reshape(xy.shape[:2])
        """z of the grid's rest surface at the pattern [m], (1 or B, M)."""

    def reset(self, envs: np.ndarray | list[int] | None = None) -> None:
        """Restart environments, as in ``chosen_envs``: no history, a new placement."""
        chosen = chosen_envs(envs, self.num_envs)
        self._contacts.reset(chosen)
        self._place(chosen)

    def reseed(self, envs: Sequence[int], seeds: Sequence[int]) -> None:
        """Restart perturbations, each from a seed; ``reset`` then draws from them."""
        for b, seed in zip(envs, seeds, strict=True):
            self._perturber.reseed(b, seed)

    def at_rest(self, envs: Sequence[int] = (0,)) -> MarkerFrame:
        """Markers of untouched pads, placed as in ``envs``; changes and draws nothing."""
        rest, pixel = self._rest[list(envs)], self._pixel[list(envs)]
        zero = np.zeros(pixel.shape)
        return MarkerFrame(zero, zero, rest, pixel, rest, np.ones(pixel.shape[:2], bool))

    def follow(self, surface: GelSurface, shear: ContactShear | None = None) -> None:
        """Add a surface to the history without computing markers; ``shear`` as in ``update``."""
        if self._cells is not None:
            self._contacts.update(surface, self._cells.sample(surface), None, shear if self._follows_shear else None)

    def update(self, surface: GelSurface, envs: Sequence[int] | None = None, *, shear: ContactShear | None = None) -> MarkerFrame:
        """Markers on ``surface``; call once for every surface of the motion, in order.

        ``envs``: environment of each row of the surface; None is all of them. Others keep their history and draw nothing; one that is named
        twice advances and draws once. ``shear``: of the gel in one contact of each row, where the physics knows it; models that follow it
        (``MarkersConfig.follows_shear``) then need no earlier surface for that contact.

        Raises ``InputError``: a surface of another number of environments or another grid, or one that lacks what the model needs.
        """
        count = self.num_envs if envs is None else len(envs)
        if surface.batch != count:
            raise InputError("surface", value=surface.batch, rule=f"must have {count} environments, as this tracker")
        failed = ~surface.is_finite  # first, since it brings the heights into the cache for the interpolation
        samples = None if self._cells is None else self._cells.sample(surface)
        contacts = None
        if samples is not None:
            contacts = self._contacts.update(surface, samples, envs, shear if self._follows_shear else None)
        rest = self._rest if envs is None else self._rest[envs]
        displacement = self.model.displacement(rest, surface, samples, contacts)
        rest_z = self._grid_rest if envs is None or len(self._grid_rest) == 1 else self._grid_rest[envs]
        position, axes = np.empty(rest.shape), displacement.shape[-1]
        np.add(rest[..., :axes], displacement, out=position[..., :axes])

        def in_space() -> np.ndarray:
            if axes == 2:
                # Differences of heights come first, so that the displacement of a marker at rest is exactly zero.
                np.subtract(height_at(surface, position[..., :2]), rest_z, out=position[..., 2])
                position[..., 2] += rest[..., 2]
            return position

        return self._frame(rest, position[..., :2] - rest[..., :2], in_space, failed, envs)

    def _frame(
        self,
        rest: np.ndarray,
        displacement: np.ndarray,
        position: Callable[[], np.ndarray],
        failed: np.ndarray,
        envs: Sequence[int] | None,
    ) -> MarkerFrame:
        """Markers as the tracker detects them: with noise and losses; ``displacement`` is changed."""
        rest_px, all_visible = (values if envs is None else values[envs] for values in (self._pixel, self._all_visible))
        camera, noise = self.pattern.camera, self._perturber.noise(self.pattern.count, envs)
        if noise is not None:
            displacement += noise * np.asarray(self.sensor.camera.pitch_at(camera.resolution))
        visible = self._perturber.visible(self.pattern.count, envs)
        lost_masks = ([] if visible is None else [~visible]) + ([failed] if failed.any() else [])

        def in_image(position: np.ndarray) -> np.ndarray:
            displacement_px = camera.project(position)
            displacement_px -= rest_px
            if noise is not None:
                displacement_px += noise
            for mask in lost_masks:
                displacement_px[mask] = np.nan
            return displacement_px

        for mask in lost_masks:
            displacement[mask] = np.nan
        return _LazyFrame(displacement, rest, rest_px, all_visible if visible is None else visible, position, in_image)
