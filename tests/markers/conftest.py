from __future__ import annotations

import pytest

from raytac.gel.surface import PadGrid
from raytac.specs import SensorSpec
from tests.markers.pads import flat_sensor, pad_grid


@pytest.fixture(scope="session")
def sensor() -> SensorSpec:
    return flat_sensor()


@pytest.fixture(scope="session")
def grid(sensor: SensorSpec) -> PadGrid:
    return pad_grid(sensor)
