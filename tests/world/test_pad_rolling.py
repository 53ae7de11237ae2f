"""Friction of rolling by the gel's hysteresis: Greenwood, Minshall and Tabor's torque, which builds up over a part of the contact."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from raytac import TactileWorld, mount
from raytac.specs import load_sensor
from tests.ipc.oracles.closed_forms import BondedLayer, Elastic

G, RADIUS, MASS = 9.81, 5e-3, 0.02
SENSOR = load_sensor("gelsight_mini")
LAYER = BondedLayer(Elastic(SENSOR.gelpad.youngs_modulus, SENSOR.gelpad.poisson_ratio), SENSOR.gelpad.thickness)


def rolled(hysteresis: float, speed: float, timestep: float = 2e-3, num_envs: int = 1) -> TactileWorld:
    """Balls of 20 g that lie on a flat gel and are then rolled at a speed."""
    gelpad = replace(SENSOR.gelpad, dome_radius=(np.inf, np.inf), hysteresis=hysteresis)
    sensor = replace(SENSOR, gelpad=gelpad)
    body = f'<body name="ball" pos="-.004 0 {RADIUS}"><freejoint/><geom size="{RADIUS}" mass="{MASS}"/></body>'
    option = f'<option timestep="{timestep}" cone="elliptic" integrator="implicitfast"/>'
    spec = mujoco.MjSpec.from_string(f"<mujoco>{option}<worldbody>{body}</worldbody></mujoco>")
    mount(spec, sensor, body="world", name="pad", pose=np.eye(4))
    settings = {"sensors": {"pad": sensor}, "touches": {"ball": 1.0}, "outputs": (), "num_envs": num_envs}
    world = TactileWorld(spec, control_timestep=0.01, **settings)
    for _ in range(30):
        world.step()
    for data in world.data:
        data.qvel[0], data.qvel[4] = speed, speed / RADIUS
    return world


def deceleration(world: TactileWorld) -> float:
    """Between 20 and 100 ms."""
    speeds = []
    for _ in range(10):
        world.step()
        speeds.append(float(world.data[0].qvel[0]))
    return (speeds[1] - speeds[-1]) / 0.08


def expected(hysteresis: float) -> float:
    """3/16 α a N on a ball that rolls: 7/5 of its mass; a of the bonded layer under its weight."""
    radii = np.linspace(0.8e-3, 1.4e-3, 21)
    contact = np.interp(MASS * G, [LAYER.sphere(RADIUS, a)[1] for a in radii], radii)
    return float(3.0 / 16.0 * hysteresis * contact * G / RADIUS / 1.4)


def test_a_rolling_ball_is_slowed_by_the_hysteresis() -> None:
    free = deceleration(rolled(0.0, 0.05))
    for hysteresis in (0.1, 0.3):
        world = rolled(hysteresis, 0.05)
        slowed = deceleration(world)
        assert slowed - free == pytest.approx(expected(hysteresis), rel=0.06)
    assert free < 0.1 * expected(0.1)


def test_a_rolling_ball_stops_and_rocks_no_more_than_the_friction_gives_way() -> None:
    for timestep in (2e-3, 1e-2):
        world = rolled(0.3, 0.03, timestep)
        path = []
        for _ in range(240):
            world.step()
            path.append(float(world.data[0].qpos[0]))
        farthest = max(path)
        reach = 0.03**2 / 2.0 / expected(0.3)
        assert farthest + 0.004 == pytest.approx(reach, rel=0.1)
        # Back by a part of the contact's radius, then it stands.
        assert min(path[path.index(farthest) :]) > farthest - 0.3e-3
        assert np.ptp(path[-30:]) < 20e-6


def test_reset_forgets_the_friction_of_rolling_and_a_batch_rolls_as_its_environments_alone() -> None:
    both, alone = rolled(0.3, 0.02, num_envs=2), rolled(0.3, 0.02)
    both.data[1].qvel[1] = 0.01
    for _ in range(10):
        both.step()
        alone.step()
    pads = both._pads
    np.testing.assert_array_equal(both.data[0].qpos, alone.data[0].qpos)
    share = pads.contact.rolling.numpy()[:, 0, 0]  # type: ignore[attr-defined]
    assert share[0, 1] > 0.9 and np.hypot(*share[1]) <= 1.0
    both.reset([0])
    share = pads.contact.rolling.numpy()[:, 0, 0]  # type: ignore[attr-defined]
    assert not share[0].any() and share[1].any()
