"""Stiffness of contacts that stick, against integral equations of the bonded layer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from raytac.physics.rigid.load_law import twist_stiffness
from raytac.specs import load_sensor
from tests.ipc.oracles.closed_forms import BondedLayer, Elastic

MINI = load_sensor("gelsight_mini").gelpad


@pytest.mark.parametrize("poisson", [0.3, 0.48])
@pytest.mark.parametrize("ratio", [0.1, 0.25, 0.5, 0.75, 1.0, 1.5, 2.5, 5.0])
def test_twist_is_that_of_a_disc_that_sticks_to_a_layer(ratio: float, poisson: float) -> None:
    gel = replace(MINI, poisson_ratio=poisson)
    layer = BondedLayer(Elastic(gel.youngs_modulus, poisson), gel.thickness)
    radius = ratio * gel.thickness
    assert float(twist_stiffness(np.asarray(radius), gel)) == pytest.approx(layer.twist_stiffness(radius), rel=0.015)
