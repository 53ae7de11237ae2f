"""Forces of a ball on the coarse pad: the bonded layer's up to ν = 0.499, and axisymmetric finite elements' with friction, deep."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from raytac.physics.soft.mesh import PAD_LEVELS, pad_mesh
from tests.ipc.oracles.closed_forms import BondedLayer, Elastic
from tests.physics.soft.oracles.axisymmetric import RoundPad
from tests.physics.soft_presses import FRICTIONLESS, RADIUS, indent, press, uncorrected

RATIOS = (0.45, 0.48, 0.49, 0.499)
BALL = 7.5e-3
"""Radius of the ball that stiffens with depth [m]."""


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


@pytest.mark.slow
def test_friction_stiffens_a_deep_press_as_axisymmetric_elements_say() -> None:
    """Gel that cannot slide under the ball cannot flow from under it; a round pad of equal area says by how much."""
    flat, depths = replace(FRICTIONLESS.gelpad, dome_radius=(math.inf, math.inf)), np.array([1e-3, 2e-3])
    radius = math.sqrt(flat.size[0] * flat.size[1] / math.pi)
    forces, expected = [], []
    for friction in (0.0, 1.0):
        pad = uncorrected(press(indent(2e-3), radius=BALL), replace(FRICTIONLESS, gelpad=replace(flat, friction=friction)))
        states = [list(pad.follow(indent(depth)))[-1] for depth in depths]
        forces.append([float(state.normal_force[0]) for state in states])
        lengths = 1e3 * np.array([BALL, flat.thickness, radius])
        round_pad = RoundPad(1e-6 * flat.youngs_modulus, flat.poisson_ratio, friction, *lengths)
        expected.append(round_pad.press(1e3 * depths))
    print("depth [mm], without and with friction [N]: pad, round pad", 1e3 * depths, forces, expected)
    np.testing.assert_allclose(forces, expected, rtol=0.04)
    stiffer = np.divide(forces[1], forces[0])
    np.testing.assert_allclose(stiffer, np.divide(expected[1], expected[0]), atol=0.05)
    assert (stiffer > [1.05, 1.2]).all()
