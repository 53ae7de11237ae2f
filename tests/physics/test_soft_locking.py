"""The coarse pad does not lock: the force of a ball up to ν = 0.499 against the bonded layer's."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from raytac.physics.soft.mesh import PAD_LEVELS, pad_mesh
from tests.ipc.oracles.closed_forms import BondedLayer, Elastic
from tests.physics.soft_presses import FRICTIONLESS, RADIUS, indent, press, uncorrected

RATIOS = (0.45, 0.48, 0.49, 0.499)


def ball_force(poisson: float, block: tuple[int, int, int] | None) -> float:
    """Force of a ball 0.3 mm deep in a coarse, flat pad over that of the bonded layer."""
    gelpad = replace(FRICTIONLESS.gelpad, poisson_ratio=poisson, dome_radius=(math.inf, math.inf))
    level = replace(PAD_LEVELS["coarse"], block=block)
    pad = uncorrected(press(indent(0.3e-3)), replace(FRICTIONLESS, gelpad=gelpad), level=pad_mesh(gelpad, level))
    *_, last = pad.run(4)
    layer = BondedLayer(Elastic(gelpad.youngs_modulus, poisson), gelpad.thickness)
    return float(last.normal_force[0]) / layer.sphere_force(RADIUS, 0.3e-3)


def test_a_ball_on_the_coarse_pad_does_not_lock() -> None:
    """With blocks the force is the bonded layer's at every ν; without, it is a quarter to more than a half too large."""
    blocked = [ball_force(nu, PAD_LEVELS["coarse"].block) for nu in RATIOS]
    plain = [ball_force(nu, None) for nu in (RATIOS[0], RATIOS[-1])]
    assert blocked == pytest.approx([1.0] * len(RATIOS), abs=0.03)
    assert plain[0] > 1.2 and plain[1] > plain[0] + 0.3
