"""Frames of the sensors of a model: one tactile sensor for each, made when it is first used."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any, Unpack

import numpy as np

from raytac.errors import InputError
from raytac.frame import TactileFrame
from raytac.gel.surface import PadGrid, chosen_envs
from raytac.physics.base import PadReading, PhysicsConfig
from raytac.robots.mount import MountedSensor
from raytac.sensor import SensorSettings, TactileSensor

Read = Callable[[str, PadGrid, list[int] | None], PadReading]
"""Reading of a sensor on a grid, for the environments named; None is all."""


class SensorFrames:
    """Sensors of one model in B environments, and what they see."""

    def __init__(
        self,
        mounted: Sequence[MountedSensor],
        *,
        num_envs: int,
        seed: int,
        physics: PhysicsConfig | None = None,
        **settings: Unpack[SensorSettings],
    ) -> None:
        """Check the settings; sensors are made on first use.

        ``settings``: those of every ``TactileSensor``. Raises what that raises, but for a device without ray tracing.
        """
        self._mounted, self._num_envs, self._seed = tuple(mounted), num_envs, seed
        self._settings: dict[str, Any] = {**settings, "physics": physics}
        self._made: dict[str, TactileSensor] = {}
        self._has_warned = False
        with warnings.catch_warnings(action="ignore"):  # the sensors that are kept warn
            for one in self._mounted:  # pads alone may run on a device that cannot trace rays
                TactileSensor(one.spec, **{"seed": seed, "num_envs": num_envs, **self._settings, "device": "cpu"})

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the sensors, without making them."""
        return tuple(mounted.name for mounted in self._mounted)

    @property
    def sensors(self) -> dict[str, TactileSensor]:
        """Every sensor by its name."""
        for i, mounted in enumerate(self._mounted):
            if mounted.name not in self._made:
                own = {"seed": self._seed + i, "num_envs": self._num_envs, **self._settings}
                self._made[mounted.name] = TactileSensor(mounted.spec, **own)
        return self._made

    def reset(self, envs: list[int]) -> None:
        """Forget the markers' history in environments."""
        for sensor in self._made.values():
            if sensor.markers is not None:
                sensor.reset_markers(envs)

    def observe(
        self, read: Read, failed: np.ndarray, sensors: Sequence[str] | str | None, envs: np.ndarray | list[int] | None
    ) -> dict[str, TactileFrame]:
        """Frames of the sensors named (None: all) in ``envs`` (mask (B,), list, None for all).

        Environments whose surface cannot be are marked in ``failed`` (B,); a ``RuntimeWarning`` says so the first time.

        Raises ``InputError``: an unknown sensor or environment, or no environment at all; as ``TactileSensor.update``.
        """
        rows = None if envs is None else chosen_envs(envs, self._num_envs)
        if rows is not None and not rows:
            raise InputError("envs", value=envs, rule="must name one environment or more")
        frames = {}
        chosen = self.names if sensors is None else (sensors,) if isinstance(sensors, str) else tuple(sensors)
        for name in chosen:
            if name not in self.names:
                raise InputError("sensors", value=name, rule="must be a sensor of the world", choices=self.names)
        for name in chosen:
            sensor = self.sensors[name]
            reading = read(name, sensor.grid, rows)
            failed[slice(None) if rows is None else rows] |= reading.failed
            frames[name] = sensor.update(reading, rows)
            if reading.failed.any() and not self._has_warned:
                self._has_warned = True
                env = int((range(self._num_envs) if rows is None else rows)[int(reading.failed.argmax())])
                text = "its state is not finite, or a body lies beyond the bonded face of a gel; its values are NaN until it is reset"
                warnings.warn(f"environment {env} failed, as frame.failed says: {text}", RuntimeWarning, stacklevel=3)
        return frames
