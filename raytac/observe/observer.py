"""``TactileObserver``: frames of a sensor in, arrays for a learner out."""

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
from raytac.observe.cells import CellMeans
from raytac.observe.randomization import CameraDrift, Randomization, randomised_sensor
from raytac.observe.settings import ObservationSettings, image_layout
from raytac.observe.spaces import ArraySpec, array_specs
from raytac.sensor import TactileSensor
from raytac.sensor.options import sensor_spec
from raytac.specs.sensor import SensorSpec

__all__ = ["TactileObserver"]


class TactileObserver:
    """Observations of one sensor in B environments.

    .. code-block:: python

        observer = TactileObserver("gelsight_mini_9x11", ObservationSettings(("rgb", "markers"), resolution=(32, 32)), num_envs=4)
        sensor = observer.make_sensor()          # or TactileWorld(..., **observer.world_options())
        frame = sensor.press("sphere")
        observer.observe(frame, sensor)["rgb"]   # (4, 32, 32, 3) uint8

    It holds the stacks of the last frames and the cameras' drift, nothing of the sensor.

    Attributes:
        sensor: the specification; the drawn one if the randomisation changes sensors.
        settings: what is observed.
        arrays: shape, type and bounds of every modality, of one environment.
    """

    sensor: SensorSpec
    settings: ObservationSettings
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
        """Check and lay out; compute nothing.

        Args:
            sensor: name of a shipped sensor, path of a sensor file, or a specification.
            settings: what is observed; None is the markers.
            num_envs: number of environments B.
            randomization: differences between environments and worlds; None is none.
            seed: of every draw.

        Raises:
            InputError: markers of a sensor without, an image too large, or a number out of range.
        """
        check_whole("num_envs", num_envs, 1, MOST_ENVIRONMENTS)
        seed = check_whole("seed", seed, 0)
        self.settings = ObservationSettings() if settings is None else check_kind("settings", settings, ObservationSettings)
        self.randomization = (
            Randomization() if randomization is None else check_kind("randomization", randomization, Randomization)
        )
        self.sensor = randomised_sensor(sensor_spec(sensor), self.randomization, seed)
        self.num_envs, self.seed = num_envs, seed
        self.layout = image_layout(self.sensor, self.settings)
        self.arrays = array_specs(self.sensor, self.settings)
        drifts = "rgb" in self.settings.modalities and self.randomization.changes_images
        self._drift = CameraDrift(self.sensor, self.randomization, num_envs, seed) if drifts else None
        self._rest: np.ndarray | None = None
        self._rest_rgb: np.ndarray | None = None
        self._moves_dots = (
            "rgb" in self.settings.modalities and self.settings.needs_markers and self.randomization.markers.moves_pattern
        )
        self._unrested = np.ones(num_envs, bool)
        self._cells: CellMeans | None = None
        self._last: dict[str, np.ndarray] = {}
        self._fresh = np.ones(num_envs, bool)

    def sensor_options(self) -> dict[str, Any]:
        """Keyword arguments of a ``TactileSensor`` that gives what is observed, but for the sensor itself and the physics."""
        settings, disturbed = self.settings, self.randomization.markers
        return {
            "outputs": settings.outputs,
            "markers": settings.marker_model if settings.needs_markers else None,
            "marker_perturbation": replace(disturbed) if settings.needs_markers else None,
            "optics": settings.optics,
            "resolution": self.layout.rendered,
            "num_envs": self.num_envs,
            "seed": self.seed,
        }

    def world_options(self) -> dict[str, Any]:
        """The same as keyword arguments of a ``TactileWorld``; the sensor's specification is the task scene's."""
        options = self.sensor_options()
        return {**options, "sensor_options": {"marker_perturbation": options.pop("marker_perturbation")}}

    def make_sensor(self, **options: Any) -> TactileSensor:
        """A sensor that gives what is observed; ``options`` of ``TactileSensor`` go before those of the settings."""
        return TactileSensor(self.sensor, **{**self.sensor_options(), **options})

    def reseed(self, envs: Sequence[int], seeds: Sequence[int]) -> None:
        """Start the streams of environments anew, each from a seed; ``reset`` then draws from them."""
        if self._drift is not None:
            self._drift.reseed(envs, seeds)

    def reset(self, envs: np.ndarray | Sequence[int] | None = None) -> None:
        """Begin anew in environments (a mask (B,), a list, or None for all): stacks are empty, cameras are drawn anew.

        Raises:
            InputError: an environment that does not exist.
        """
        chosen = chosen_envs(envs, self.num_envs)
        self._fresh[chosen] = True
        self._unrested[chosen] = True
        if self._drift is not None:
            self._drift.reset(chosen)

    def observe(
        self, frame: TactileFrame, sensor: TactileSensor | None = None, envs: np.ndarray | Sequence[int] | None = None
    ) -> dict[str, np.ndarray]:
        """Arrays (B, …) by modality, as ``arrays`` say; each its own memory.

        Args:
            frame: of a sensor that was made with ``sensor_options``.
            sensor: that sensor; needed for the image at rest, with ``difference``.
            envs: the environments that the frame's rows are of, a mask (B,) or a list; the others keep what they observed last, and draw
                nothing. None is all.

        An environment that failed keeps what it observed last, or zeros if that was nothing: its frame holds nothing of use.

        Raises:
            InputError: a frame of another number of environments or without what is observed, or a number in it that is not finite
                where the environment has not failed; the message names the environment.
        """
        batch, rows = frame.surface.batch, np.asarray(chosen_envs(envs, self.num_envs), int)
        if batch != len(rows):
            raise InputError("frame", value=batch, rule=f"must have {len(rows)} environments, as this observer")
        failed = np.zeros(batch, bool) if frame.failed is None else frame.failed
        found = {
            name: self._rgb(frame, sensor, rows) if name == "rgb" else getattr(self, f"_{name}")(frame)
            for name in self.settings.modalities
        }
        return self._finished(found, failed, rows)

    def observe_wrench(self, wrench: np.ndarray, failed: np.ndarray, envs: np.ndarray) -> dict[str, np.ndarray]:
        """As ``observe``, where nothing but the ``wrench`` is observed, from the world's own: no sensor need look at the pad.

        Args:
            wrench: of all environments (B, 6).
            failed: which of them have failed, (B,), bool.
            envs: mask (B,) of those that are new; the others keep what they observed last.

        Raises:
            InputError: more is observed, a wrench that is not (B, 6), or that is not finite where the environment has not failed.
        """
        if self.settings.needs_frames:
            rule = "must be the wrench alone; otherwise give a frame"
            raise InputError("modalities", value=self.settings.modalities, rule=rule)
        if wrench.shape != (self.num_envs, 6):
            raise InputError("wrench", value=wrench.shape, rule=f"must have the shape {(self.num_envs, 6)}")
        rows = np.flatnonzero(envs)
        return self._finished({"wrench": self._scaled("wrench", wrench[rows])}, failed[rows], rows)

    def _finished(self, found: dict[str, np.ndarray], failed: np.ndarray, rows: np.ndarray) -> dict[str, np.ndarray]:
        for name, values in found.items():
            self._check_finite(name, values, failed, rows)
        if failed.any():
            rows, found = rows[~failed], {name: values[~failed] for name, values in found.items()}
        for name, values in found.items():
            self._stack(name, values, rows)
        self._fresh[rows] = False
        return self.last()

    def last(self) -> dict[str, np.ndarray]:
        """What was observed last, arrays (B, …) as of ``observe``; zeros where that was nothing."""
        return {name: self._kept(name).copy() for name in self.settings.modalities}

    # --- modalities ------------------------------------------------------------------------------------------------------------

    def _rgb(self, frame: TactileFrame, sensor: TactileSensor | None, rows: np.ndarray) -> np.ndarray:
        images = self._cut(_given(frame.rgb, "rgb"))
        if self._drift is not None:
            images = self._drift.apply(images, envs=rows.tolist())
        if not self.settings.difference:
            return images
        self._take_rest(sensor, rows)
        assert self._rest is not None
        return ((255 + images.astype(np.int16) - self._rest[rows]) // 2).astype(np.uint8)

    def _take_rest(self, sensor: TactileSensor | None, rows: np.ndarray) -> None:
        """Render the pads of ``rows`` at rest as their cameras see them, where they have begun anew since."""
        late = np.unique(rows[self._unrested[rows]])
        if not len(late):
            return
        if sensor is None:
            raise InputError("sensor", value=None, rule="must be given for a difference: it renders the image at rest")
        if self._moves_dots:
            envs = rounded_envs(late.tolist(), self.num_envs)
            images = self._cut(_given(sensor.rest(envs).rgb, "rgb"))[: len(late)]
        else:
            if self._rest_rgb is None:
                self._rest_rgb = self._cut(_given(sensor.rest().rgb, "rgb"))
            images = np.repeat(self._rest_rgb, len(late), axis=0)
        if self._drift is not None:
            images = self._drift.apply(images, noise=False, envs=late.tolist())
        if self._rest is None:
            self._rest = np.zeros((self.num_envs, *images.shape[1:]), np.uint8)
        self._rest[late] = images
        self._unrested[late] = False

    def _cut(self, images: np.ndarray) -> np.ndarray:
        layout, (width, height) = self.layout, self.layout.observed
        if images.shape[1:3] != layout.rendered[::-1]:
            shape, wanted = images.shape[2:0:-1], "x".join(str(n) for n in layout.rendered)
            raise InputError("frame.rgb", value=shape, rule=f"must be {wanted}, as sensor_options ask for")
        k = layout.downscale
        left, top = layout.left * k, layout.top * k
        images = images[:, top : top + height * k, left : left + width * k]
        if k > 1:
            blocks = images.reshape(len(images), height, k, width, k, 3)
            images = (blocks.sum(axis=(2, 4), dtype=np.uint32) + k * k // 2) // (k * k)
        return images.astype(np.uint8, copy=False)

    def _markers(self, frame: TactileFrame) -> np.ndarray:
        markers = _given(frame.markers, "markers")
        moved = np.where(markers.visible[..., None], markers.displacement, 0.0)
        return self._scaled("markers", moved)

    def _marker_visible(self, frame: TactileFrame) -> np.ndarray:
        return _given(frame.markers, "marker_visible").visible.astype(np.int8)

    def _height(self, frame: TactileFrame) -> np.ndarray:
        return self._scaled("height", self._map(frame, frame.surface.height))

    def _indentation(self, frame: TactileFrame) -> np.ndarray:
        return self._scaled("indentation", self._map(frame, frame.surface.indentation))

    def _contact(self, frame: TactileFrame) -> np.ndarray:
        return self._map(frame, frame.surface.contact).astype(np.float32)

    def _wrench(self, frame: TactileFrame) -> np.ndarray:
        return self._scaled("wrench", _given(frame.wrench, "wrench"))

    def _map(self, frame: TactileFrame, values: np.ndarray) -> np.ndarray:
        if self._cells is None or self._cells.nodes != frame.surface.grid.shape:
            self._cells = CellMeans(frame.surface.grid.shape, self.settings.map_shape)
        return self._cells(values)

    def _scaled(self, name: str, values: np.ndarray) -> np.ndarray:
        return (values / np.asarray(self.settings.scale(name))).astype(np.float32)

    # --- last frames -----------------------------------------------------------------------------------------------------------

    def _check_finite(self, name: str, values: np.ndarray, failed: np.ndarray, rows: np.ndarray) -> None:
        if values.dtype.kind != "f":
            return
        bad = ~np.isfinite(values.reshape(len(values), -1).sum(axis=1)) & ~failed
        if bad.any():
            first = int(np.flatnonzero(bad)[0])
            rule = f"holds a number that is not finite, in environment {rows[first]}, which has not failed"
            numbers = values[first].reshape(-1)
            raise InputError(f"frame ({name})", value=numbers[~np.isfinite(numbers)][:3], rule=rule)

    def _kept(self, name: str) -> np.ndarray:
        if name not in self._last:
            spec = self.arrays[name]
            self._last[name] = np.zeros((self.num_envs, *spec.shape), spec.dtype)
        return self._last[name]

    def _stack(self, name: str, now: np.ndarray, rows: np.ndarray) -> None:
        """Put what ``rows`` observe ``now`` upon what they did before."""
        count, last, begun = self.settings.stack, self._kept(name), self._fresh[rows]
        if count == 1:
            last[rows] = now
        elif name == "rgb":
            # Channels are images of three, oldest first.
            last[rows] = np.concatenate([last[rows][..., 3:], now], axis=-1)
            last[rows[begun]] = np.tile(now[begun], (1, 1, 1, count))
        else:
            last[rows] = np.concatenate([last[rows][:, 1:], now[:, None]], axis=1)
            last[rows[begun]] = now[begun][:, None]


def _given(value: Any, name: str) -> Any:
    if value is None:
        raise InputError("frame", value=name, rule="does not hold this modality: make its sensor with sensor_options")
    return value
