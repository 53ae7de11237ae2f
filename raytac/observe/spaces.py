"""Spaces of Gymnasium and tensors of PyTorch for observations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from raytac.errors import BackendError, InputError
from raytac.observe.settings import ObservationSettings, image_layout
from raytac.specs.sensor import SensorSpec

if TYPE_CHECKING:
    import gymnasium


@dataclass(frozen=True)
class ArraySpec:
    """Array of one environment."""

    shape: tuple[int, ...]
    dtype: type
    low: float
    high: float


def array_specs(sensor: SensorSpec, settings: ObservationSettings) -> dict[str, ArraySpec]:
    """Arrays of an observation with ``settings``, by modality.

    Raises ``InputError``: markers are observed and the sensor has none, or an image is too large.
    """
    count = sensor.markers.rows * sensor.markers.columns
    if settings.needs_markers and not count:
        raise InputError("modalities", value="markers", rule=f"needs a sensor with markers; {sensor.name} has none")
    width, height = image_layout(sensor, settings).observed
    specs = {
        "rgb": ArraySpec((height, width, 3), np.uint8, 0, 255),
        "markers": ArraySpec((count, 2), np.float32, -np.inf, np.inf),
        "marker_visible": ArraySpec((count,), np.int8, 0, 1),
        "height": ArraySpec(tuple(settings.map_shape), np.float32, -np.inf, np.inf),
        "indentation": ArraySpec(tuple(settings.map_shape), np.float32, -np.inf, np.inf),
        "contact": ArraySpec(tuple(settings.map_shape), np.float32, 0.0, 1.0),
        "traction": ArraySpec((*settings.map_shape, 3), np.float32, -np.inf, np.inf),
        "wrench": ArraySpec((6,), np.float32, -np.inf, np.inf),
    }
    return {name: _stacked(name, specs[name], settings.stack) for name in settings.modalities}


def _stacked(name: str, spec: ArraySpec, stack: int) -> ArraySpec:
    if stack == 1:
        return spec
    shape = (*spec.shape[:-1], spec.shape[-1] * stack) if name == "rgb" else (stack, *spec.shape)
    return ArraySpec(shape, spec.dtype, spec.low, spec.high)


def gymnasium_space(specs: Mapping[str, ArraySpec]) -> gymnasium.spaces.Dict:
    """A ``Dict`` of boxes. Raises ``BackendError`` if Gymnasium is not installed."""
    try:
        from gymnasium import spaces
    except ImportError as error:
        raise BackendError(f"spaces need Gymnasium ({error}): `pip install 'raytac[envs]'`") from error
    return spaces.Dict({name: spaces.Box(spec.low, spec.high, spec.shape, spec.dtype) for name, spec in specs.items()})


def as_tensors(observation: Mapping[str, Any]) -> dict[str, Any]:
    """``torch.Tensor`` by name, through DLPack, without a copy; nested dictionaries stay nested.

    Raises ``BackendError``: PyTorch is not installed.
    """
    try:
        import torch  # pyright: ignore[reportMissingImports]  # gigabytes: the checks run without it
    except ImportError as error:
        raise BackendError(f"tensors need PyTorch ({error}): `pip install 'raytac[rl]'`") from error
    return {
        name: as_tensors(value) if isinstance(value, Mapping) else torch.from_dlpack(value) for name, value in observation.items()
    }
