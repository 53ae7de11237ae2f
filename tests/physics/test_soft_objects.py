"""Objects that give way, or lie free, on the soft pad: symmetry, balance, and Hertz' law of two elastic bodies."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from raytac.physics.soft.coat_state import CoatState, ContactObject
from raytac.physics.soft.pad import SoftPad
from raytac.specs import load_sensor
from raytac.specs.press import ObjectSpec, PressScene, StageSpec

SENSOR = load_sensor("gelsight_mini")
FLAT = replace(SENSOR, gelpad=replace(SENSOR.gelpad, friction=0.0, dome_radius=(math.inf, math.inf)))
RADIUS, YOUNG, POISSON = 4e-3, 430e3, 0.45


def ball(sensor, stage, **settings):
    """A pad and its state at the end of a stage that presses a ball into it."""
    spec = ObjectSpec("sphere", {"radius": RADIUS}, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0.05, **settings)
    pad = SoftPad(sensor, PressScene("ball", spec, (stage,)), pitch=0.1e-3)
    return pad, pad.peak(pad.run())


@pytest.fixture(scope="module")
def rigid():
    return ball(FLAT, StageSpec("indent", depth=0.25e-3))


@pytest.fixture(scope="module")
def soft():
    pytest.importorskip("pytetwild")
    return ball(FLAT, StageSpec("indent", depth=0.5e-3), dynamics="soft", youngs_modulus=YOUNG, poisson_ratio=POISSON)


def test_a_soft_ball_leaves_a_symmetric_imprint_shallower_than_its_way(soft):
    """Ball and gel share the way by 1 − ν² over E of each, so that as stiff a ball leaves half of it to the gel at most."""
    _pad, state = soft
    assert not state.failed[0] and state.depth[0] == pytest.approx(0.5e-3, abs=2e-6)
    height, deepest = state.surface.height[0], state.surface.indentation.max()
    assert 0.3 * 0.5e-3 < deepest < 0.5 * 0.5e-3
    for turned in (height[::-1], height[:, ::-1]):
        assert (
            np.abs(height - turned).max() < 20e-6
        )  # its tetrahedra are not symmetric; facets of 0.8 mm lie so far inside a ball
    assert np.abs(state.shear_force[0]).max() < 0.01 * state.normal_force[0]


def test_a_soft_balls_imprint_has_no_facets(soft):
    """Ripple in contact, what a polynomial of degree 8 leaves: less than a third of that of the ball's own triangles."""
    pad, _ = soft
    assert pad.solver is not None
    seen = pad.solver.coat_state(pad._drive.poses())
    triangles = ContactObject((), np.eye(4)[None], pad.solver.scene.mesh("object", "pad"))
    facets = CoatState.of(seen.vertices.numpy(), seen.forces.numpy(), [triangles])
    x, y = (a / 3e-3 for a in np.meshgrid(pad.grid.x, pad.grid.y))
    inside = np.hypot(x, y) < 0.3
    powers = np.stack([x[inside] ** i * y[inside] ** j for i in range(9) for j in range(9 - i)], axis=1)
    ripple = []
    for state in (seen, facets):
        height = pad._reader.read(state, np.zeros(1, bool)).surface.height[0].astype(float)[inside]
        left = height - powers @ np.linalg.lstsq(powers, height, rcond=None)[0]
        ripple.append(float(np.sqrt((left**2).mean())))
    assert ripple[0] < 0.3 * ripple[1] and ripple[1] > 0.4e-6, f"ripple {ripple}"


def test_what_drives_a_soft_ball_is_what_the_case_feels(soft):
    pad, state = soft
    assert pad.solver is not None
    driven, case = (pad.solver.world.wrench(name).force[0] for name in ("object", "pad"))
    assert state.normal_force[0] > 0.1
    assert np.abs(driven + case).max() < 0.01 * state.normal_force[0]
    assert case == pytest.approx(state.wrench[0, :3], abs=0.01 * state.normal_force[0])


def test_two_elastic_bodies_touch_by_hertzs_law(rigid, soft):
    """F R/a³ = 4/3 E*, with 1/E* the sum of (1 − ν²)/E of both, within 4 %: neither pad nor ball locks.

    The constant is that of a rigid ball on the same mesh, which the layer makes 5 % larger than a half-space's.
    """
    gelpad = FLAT.gelpad
    gel, rubber = ((1.0 - nu**2) / young for nu, young in ((gelpad.poisson_ratio, gelpad.youngs_modulus), (POISSON, YOUNG)))
    moduli = []
    for pad, state in (rigid, soft):
        radius = math.sqrt(state.surface.contact.sum() * np.prod(pad.grid.pitch) / math.pi)
        moduli.append(0.75 * state.normal_force[0] * RADIUS / radius**3)
    assert moduli[1] / moduli[0] == pytest.approx(gel / (gel + rubber), rel=0.04)
    assert moduli[0] * gel == pytest.approx(1.05, rel=0.02)


def test_a_free_ball_rests_upright():
    """Symmetric, without shear or torque, and as deep as a driven one that bears the same force.

    On a flat pad without friction: with friction it may roll, on a dome it rolls off.
    """
    states = [ball(FLAT, StageSpec("indent", force=0.3), dynamics=dynamics) for dynamics in ("affine", "kinematic")]
    (_pad, lying), (_other, driven) = states
    height = lying.surface.height[0]
    assert max(np.abs(height - height[::-1]).max(), np.abs(height - height[:, ::-1]).max()) < 2e-6
    wrench = lying.wrench[0]
    assert wrench[2] == pytest.approx(-0.3, rel=0.01)
    assert np.abs(wrench[:2]).max() < 1e-3 * 0.3 and np.abs(wrench[3:]).max() < 1e-3 * 0.3 * RADIUS
    deepest = driven.surface.indentation.max()
    assert np.abs(height - driven.surface.height[0]).max() < 0.05 * deepest  # while it comes to rest, friction gives way
