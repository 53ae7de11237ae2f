"""The fit of the case's light, which tests share by way of ``tests.case_lights``: it is the same each time it is made."""

from __future__ import annotations

from inspect import unwrap
from typing import Any

import numpy as np

from raytac.optics.runtime import load_mitsuba
from raytac.optics.trace.interreflection import CaseLight
from raytac.optics.trace.led import Lamp
from raytac.optics.trace.scene import SensorScene
from tests.optics.scenes import grid_of, like_a_mini


def test_a_fit_is_the_same_each_time_and_another_with_another_seed() -> None:
    mi, _ = load_mitsuba("cpu")
    spec = like_a_mini()
    scene = SensorScene(mi, spec, grid_of(spec))
    lamps = [Lamp.from_spec(mi, led) for led in spec.lights.leds]
    fit: Any = unwrap(CaseLight.fit)
    groups = [0, 1, 1, 2]
    one, same, other = (fit(scene, lamps, groups, seed, 1 << 12).coefficients for seed in (0, 0, 1))
    assert one.any()
    np.testing.assert_allclose(same, one, rtol=1e-5, atol=1e-5 * np.abs(one).max())
    assert np.abs(other - one).max() > 1e-3 * np.abs(one).max()
