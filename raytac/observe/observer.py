"""``TactileObserver``: arrays for a learner from frames of a sensor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from raytac.checks import MOST_ENVIRONMENTS, check_kind, check_whole
from raytac.errors import InputError
from raytac.frame import TactileFrame
from raytac.gel.surface import chosen_envs, rounded_envs
from raytac.markers import MarkerPerturbation
from raytac.markers.base import MarkersConfig
from raytac.markers.registry import markers_config
from raytac.observe.randomization import CameraDrift, Randomization, randomised_sensor
from raytac.observe.settings import ObservationSettings, image_layout
from raytac.observe.spaces import ArraySpec, array_specs
from raytac.optics.base import BuiltOptics
from raytac.optics.crop import Cropped
from raytac.optics.grain import check_grain
from raytac.optics.registry import chosen_optics
from raytac.sensor import TactileSensor
from raytac.specs.sensor import SensorSpec
from raytac.specs.sensor_file import sensor_spec


class TactileObserver:
    """Observations of one sensor in B environments.

    .. code-block:: python

        observer = TactileObserver("gelsight_mini_9x11", ObservationSettings(("rgb", "markers"), resolution=(32, 32)), num_envs=4)
        sensor = observer.make_sensor()          # or TactileWorld(..., **observer.sensor_options())
        frame = sensor.press("sphere")
        observer.observe(frame, sensor)["rgb"]   # (4, 32, 32, 3) uint8

    It holds the stacks of the last frames and the cameras' drift, and no state of the sensor.

    Attributes:
        sensor: the specification, after the randomisation of sensors.
        settings: choices of the observation.
        markers: marker model with its perturbation; None if no markers are observed.
        arrays: shape, type and bounds of every modality, of one environment.
    """

    sensor: SensorSpec
    settings: ObservationSettings
    markers: MarkersConfig | None
    arrays: dict[str, ArraySpec]

    def __init__(
        self,
        sensor: str | Path | SensorSpec,
        settings: ObservationSettings | None = None,
        *,
        num_envs: int = 1,
        randomization: Randomization | None = None,
        seed: int = 0,
    ) -> None:
        """Check the settings and the sizes of arrays; compute nothing.

        Args:
            sensor: name of a shipped sensor, path of a sensor file, or a specification.
            settings: choices of the observation; None is the markers.
            randomization: differences between environments and worlds; None is none.

        Raises:
            InputError: markers of a sensor without, an image too large, a number out of range, or a perturbation of markers that
                settings and randomization both give, grain of a sensor without.
        """
        check_whole("num_envs", num_envs, 1, MOST_ENVIRONMENTS)
        seed = check_whole("seed", seed, 0)
        self.settings = ObservationSettings() if settings is None else check_kind("settings", settings, ObservationSettings)
        self.randomization = (
            Randomization() if randomization is None else check_kind("randomization", randomization, Randomization)
        )
        self.sensor = randomised_sensor(sensor_spec(sensor), self.randomization, seed)
        self.num_envs, self.seed = num_envs, seed
        if self.settings.noise:
            check_grain(self.sensor)
        self.layout = image_layout(self.sensor, self.settings)
        self.arrays = array_specs(self.sensor, self.settings)
        drifts = "rgb" in self.settings.modalities and self.randomization.changes_images
        self._drift = CameraDrift(self.sensor, self.randomization, num_envs, seed) if drifts else None
        self._rest: np.ndarray | None = None
        self._rest_rgb: np.ndarray | None = None
        self.markers = self._perturbed_markers() if self.settings.needs_markers else None
        perturbation = None if self.markers is None else self.markers.perturbation
        self._moves_dots = "rgb" in self.settings.modalities and perturbation is not None and perturbation.moves_pattern
        self._stale_rest = np.ones(num_envs, bool)
        self._cells: CellMeans | None = None
        self._last: dict[str, np.ndarray] = {}
        self._fresh = np.ones(num_envs, bool)

    def _perturbed_markers(self) -> MarkersConfig:
        """Marker model of the settings with the perturbation of the randomisation, or with its own."""
        config, perturbation = markers_config(self.settings.markers), self.randomization.markers
        if perturbation == MarkerPerturbation():
            return config
        if config.perturbation is not None:
            rule = "is given by the settings' markers already; give it to one of the two"
            raise InputError("randomization.markers", value=perturbation, rule=rule)
        return replace(config, perturbation=perturbation)

    def sensor_options(self) -> dict[str, Any]:
        """Keyword arguments of a ``TactileSensor`` with the outputs observed.

        Sensor and physics are not among them. Of images only the observed crop is rendered.
        """
        settings, optics = self.settings, chosen_optics(self.settings.optics)
        if self.layout.crop is not None and not isinstance(optics, BuiltOptics):
            optics = Cropped(optics, self.layout.crop)
        return {
            "outputs": settings.outputs,
            "markers": self.markers,
            "optics": optics,
            "resolution": self.layout.rendered,
            "num_envs": self.num_envs,
            "seed": self.seed,
            "noise": settings.noise,
        }

    def make_sensor(self, **options: Any) -> TactileSensor:
        """Make a sensor with the outputs observed; ``options`` override those of the settings."""
        return TactileSensor(self.sensor, **{**self.sensor_options(), **options})

    def reseed(self, envs: Sequence[int], seeds: Sequence[int]) -> None:
        """Seed the random streams of environments; ``reset`` then draws from them."""
        if self._drift is not None:
            self._drift.reseed(envs, seeds)

    def reset(self, envs: np.ndarray | Sequence[int] | None = None) -> None:
        """Begin episodes: empty the stacks and draw the cameras again.

        Args:
            envs: mask (B,) or list of environments; None for all.

        Raises:
            InputError: an environment that does not exist.
        """
        chosen = chosen_envs(envs, self.num_envs)
        self._fresh[chosen] = True
        self._stale_rest[chosen] = True
        if self._drift is not None:
            self._drift.reset(chosen)

    def observe(
        self, frame: TactileFrame, sensor: TactileSensor | None = None, envs: np.ndarray | Sequence[int] | None = None
    ) -> dict[str, np.ndarray]:
        """Arrays (B, …) by modality, as in ``arrays``; none shares memory with another.

        Args:
            frame: frame of a sensor that was made with ``sensor_options``.
            sensor: that sensor; needed for the image at rest, with ``difference``.
            envs: environments of the frame's rows, a mask (B,) or a list; None is all. The others keep their last observation and draw no
                noise.

        An environment that failed keeps its last observation, or zeros if it has none, since its frame is not valid.

        Raises:
            InputError: a frame of another number of environments or without a modality observed, or a number that is not finite where the
                environment has not failed; the message names the environment.
        """
        batch, rows = frame.surface.batch, np.asarray(chosen_envs(envs, self.num_envs), int)
        if batch != len(rows):
            raise InputError("frame", value=batch, rule=f"must have {len(rows)} environments, as this observer")
        values = {name: self._values(name, frame, sensor, rows) for name in self.settings.modalities}
        return self._finished(values, frame.failed, rows)

    def observe_wrench(self, wrench: np.ndarray, failed: np.ndarray, envs: np.ndarray) -> dict[str, np.ndarray]:
        """Observe the ``wrench`` alone, from wrenches of the world; no surface is needed.

        Args:
            wrench: wrenches of all environments (B, 6).
            envs: mask (B,) of environments with new wrenches; the others keep their last observation.

        Raises:
            InputError: further modalities are observed, or a wrench that is not (B, 6) or not finite where the environment has not failed.
        """
        if self.settings.needs_frames:
            rule = "must be the wrench alone; otherwise give a frame"
            raise InputError("modalities", value=self.settings.modalities, rule=rule)
        if wrench.shape != (self.num_envs, 6):
            raise InputError("wrench", value=wrench.shape, rule=f"must have the shape {(self.num_envs, 6)}")
        rows = np.flatnonzero(envs)
        return self._finished({"wrench": self._scaled("wrench", wrench[rows])}, failed[rows], rows)

    def _finished(self, observed: dict[str, np.ndarray], failed: np.ndarray, rows: np.ndarray) -> dict[str, np.ndarray]:
        """Check and stack what ``rows`` observed; the last observation of all environments.

        ``observed``: an array (n, …) of each modality, of environments ``rows`` (n,), of which ``failed`` (n,) are left out.
        """
        for name, values in observed.items():
            self._check_finite(name, values, failed, rows)
        if failed.any():
            rows, observed = rows[~failed], {name: values[~failed] for name, values in observed.items()}
        for name, values in observed.items():
            self._stack(name, values, rows)
        self._fresh[rows] = False
        return self.last()

    def last(self) -> dict[str, np.ndarray]:
        """Last observation, arrays (B, …) as of ``observe``; zeros before the first."""
        return {name: self._last_of(name).copy() for name in self.settings.modalities}

    # --- modalities ------------------------------------------------------------------------------------------------------------

    def _values(self, name: str, frame: TactileFrame, sensor: TactileSensor | None, rows: np.ndarray) -> np.ndarray:
        match name:
            case "rgb":
                return self._rgb(frame, sensor, rows)
            case "markers":
                markers = frame.markers
                return self._scaled(name, np.where(markers.visible[..., None], markers.displacement, 0.0))
            case "marker_visible":
                return frame.markers.visible.astype(np.int8)
            case "contact":
                return self._map(frame, frame.surface.contact).astype(np.float32)
            case "height":
                return self._scaled(name, self._map(frame, frame.surface.height))
            case "indentation":
                return self._scaled(name, self._map(frame, frame.surface.indentation))
            case "traction":
                return self._scaled(name, self._map(frame, frame.traction))
            case "wrench":
                return self._scaled(name, frame.wrench)
        raise AssertionError(name)  # the settings know the names

    def _rgb(self, frame: TactileFrame, sensor: TactileSensor | None, rows: np.ndarray) -> np.ndarray:
        """Images (n, H, W, 3), or half of their difference from rest about 127."""
        images = self._cut(frame.rgb)
        if self._drift is not None:
            images = self._drift.apply(images, envs=rows.tolist())
        if not self.settings.difference:
            return images
        self._take_rest(sensor, rows)
        assert self._rest is not None
        return ((255 + images.astype(np.int16) - self._rest[rows]) // 2).astype(np.uint8)

    def _take_rest(self, sensor: TactileSensor | None, rows: np.ndarray) -> None:
        """Render pads at rest with their present cameras, where ``rows`` were reset."""
        stale = np.unique(rows[self._stale_rest[rows]])
        if not len(stale):
            return
        if sensor is None:
            raise InputError("sensor", rule="must be given for a difference: it renders the image at rest")
        if self._moves_dots:
            envs = rounded_envs(stale.tolist(), self.num_envs)
            images = self._cut(sensor.rest(envs).rgb)[: len(stale)]
        else:
            if self._rest_rgb is None:
                self._rest_rgb = self._cut(sensor.rest().rgb)
            images = np.repeat(self._rest_rgb, len(stale), axis=0)
        if self._drift is not None:
            images = self._drift.apply(images, noise=False, envs=stale.tolist())
        if self._rest is None:
            self._rest = np.zeros((self.num_envs, *images.shape[1:]), np.uint8)
        self._rest[stale] = images
        self._stale_rest[stale] = False

    def _cut(self, images: np.ndarray) -> np.ndarray:
        """The observed piece of images as rendered, whole or cropped, in observed pixels."""
        layout, (width, height) = self.layout, self.layout.observed
        k, size = layout.downscale, images.shape[2:0:-1]
        if size == layout.rendered:
            x, y = layout.crop_x * k, layout.crop_y * k
            images = images[:, y : y + height * k, x : x + width * k]
        elif layout.crop is None or size != layout.crop[2:]:
            expected = "x".join(str(n) for n in layout.rendered)
            how = "give its sensor or world **observer.sensor_options()"
            raise InputError("frame.rgb", value=size, rule=f"must be {expected}, or the crop that is observed: {how}")
        if k > 1:
            blocks = images.reshape(len(images), height, k, width, k, 3)
            images = (blocks.sum(axis=(2, 4), dtype=np.uint32) + k * k // 2) // (k * k)
        return images.astype(np.uint8, copy=False)

    def _map(self, frame: TactileFrame, values: np.ndarray) -> np.ndarray:
        """Means of values at nodes over the cells of the observed map."""
        if self._cells is None or self._cells.nodes != frame.surface.grid.shape:
            self._cells = CellMeans(frame.surface.grid.shape, self.settings.map_shape)
        return self._cells(values)

    def _scaled(self, name: str, values: np.ndarray) -> np.ndarray:
        return (values / np.asarray(self.settings.scale(name))).astype(np.float32)

    # --- last frames -----------------------------------------------------------------------------------------------------------

    def _check_finite(self, name: str, values: np.ndarray, failed: np.ndarray, rows: np.ndarray) -> None:
        """Raise ``InputError`` for a value that is not finite where a row has not failed."""
        if values.dtype.kind != "f":
            return
        bad = ~np.isfinite(values.reshape(len(values), -1).sum(axis=1)) & ~failed
        if bad.any():
            first = int(np.flatnonzero(bad)[0])
            rule = f"holds a number that is not finite, in environment {rows[first]}, which has not failed"
            numbers = values[first].reshape(-1)
            raise InputError(f"frame ({name})", value=numbers[~np.isfinite(numbers)][:3], rule=rule)

    def _last_of(self, name: str) -> np.ndarray:
        """Last observation of a modality, (B, …); zeros before the first."""
        if name not in self._last:
            spec = self.arrays[name]
            self._last[name] = np.zeros((self.num_envs, *spec.shape), spec.dtype)
        return self._last[name]

    def _stack(self, name: str, now: np.ndarray, rows: np.ndarray) -> None:
        """Append the present values of ``rows`` to their stacks."""
        count, last, is_first = self.settings.stack, self._last_of(name), self._fresh[rows]
        if count == 1:
            last[rows] = now
        elif name == "rgb":
            # Channels are images of three, oldest first.
            last[rows] = np.concatenate([last[rows][..., 3:], now], axis=-1)
            last[rows[is_first]] = np.tile(now[is_first], (1, 1, 1, count))
        else:
            last[rows] = np.concatenate([last[rows][:, 1:], now[:, None]], axis=1)
            last[rows[is_first]] = now[is_first][:, None]


class CellMeans:
    """Means over (rows, columns) cells of values at nodes (B, Ny, Nx, …), each in one cell."""

    def __init__(self, nodes: tuple[int, int], cells: tuple[int, int]) -> None:
        """Means over cells; ``InputError`` if there are more cells than nodes."""
        for name, n, m in zip(("rows", "columns"), nodes, cells, strict=True):
            if m > n:
                raise InputError("map_shape", value=tuple(cells), rule=f"must not have more {name} than the pad's grid, {n}")
        self.nodes, self.cells = tuple(nodes), tuple(cells)
        self._starts = [np.arange(m) * n // m for n, m in zip(nodes, cells, strict=True)]
        self._counts = [np.diff(np.append(s, n)) for s, n in zip(self._starts, nodes, strict=True)]

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Means (B, rows, columns, …), float64."""
        summed = np.add.reduceat(values, self._starts[0], axis=1, dtype=float)
        summed = np.add.reduceat(summed, self._starts[1], axis=2)
        counts = self._counts[0][:, None] * self._counts[1]
        return summed / counts.reshape(*counts.shape, *(1 for _ in values.shape[3:]))

    def matrices(self) -> tuple[np.ndarray, np.ndarray]:
        """Matrices P (rows, Ny) and Q (Nx, columns) with which the means are P v Q."""
        p, q = (
            (np.repeat(np.arange(len(count)), count) == np.arange(len(count))[:, None]) / count[:, None] for count in self._counts
        )
        return p, q.T
