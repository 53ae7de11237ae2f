"""What a step of a pad's contact knows beforehand: forces that close a gap, and a slide that begins or ends."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from raytac import TactileWorld, mount
from raytac.specs import load_sensor

SENSOR = load_sensor("gelsight_mini")
FLAT = replace(SENSOR, gelpad=replace(SENSOR.gelpad, dome_radius=(np.inf, np.inf)))
DISC = """<body name="body" pos="0 0 .003"><joint name="z" type="slide" axis="0 0 1" damping="5"/>
<geom type="cylinder" size=".006 .003" mass=".02"/></body>"""
MOTOR = '<actuator><motor joint="z"/></actuator>'


def flat_world(bodies: str, timestep: float, rest: str = "", gravity: float = 0.0, num_envs: int = 1, touches=None) -> TactileWorld:
    """A flat gel that looks up, pad frame and world frame one, and what is over it."""
    option = f'timestep="{timestep}" cone="elliptic" integrator="implicitfast" gravity="0 0 {-gravity}"'
    spec = mujoco.MjSpec.from_string(f"<mujoco><option {option}/><worldbody>{bodies}</worldbody>{rest}</mujoco>")
    mount(spec, FLAT, body="world", name="pad", pose=np.eye(4))
    return TactileWorld(spec, sensors={"pad": FLAT}, touches=touches or ["body"], outputs=("wrench",), num_envs=num_envs)


@pytest.mark.parametrize("kind", ["motor", "applied", "weight"])
@pytest.mark.parametrize("timestep", [2e-3, 1e-2])
def test_a_disc_settles_at_the_same_depth_whatever_presses_it(kind: str, timestep: float) -> None:
    """1 N on 20 g: 50 m/s² close a gap by 0.1 mm in a step of 2 ms, seven times the depth at rest."""
    world = flat_world(DISC, timestep, MOTOR, 50.0 if kind == "weight" else 0.0)
    data, eaten = world.data[0], 0.0
    if kind == "applied":
        data.xfrc_applied[world.model.body("body").id, 2] = -1.0
    for _ in range(100):
        state = world.step(np.array([-1.0 if kind == "motor" else 0.0]))
        eaten += 5.0 * float(data.qvel[0]) ** 2 * timestep
    assert -state.wrench["pad"][0, 2] == pytest.approx(1.0, rel=1e-4)
    assert abs(data.qvel[0]) < 1e-6
    # The damper eats no more than the force does work down to the deepest place, which is not much deeper than that at rest.
    assert eaten < 2.0 * 1.0 * abs(data.qpos[0])


def test_a_light_finger_that_shuts_with_much_force_does_not_go_through() -> None:
    """35 g that 70 N drive: 2000 m/s², 4 mm in a step of 2 ms."""
    finger = DISC.replace('mass=".02"', 'mass=".035"').replace('pos="0 0 .003"', 'pos="0 0 .0031"')
    world = flat_world(finger, 2e-3, MOTOR)
    deepest, force = 0.0, 0.0
    for _ in range(100):
        state = world.step(np.array([-70.0]))
        deepest, force = max(deepest, -float(world.data[0].qpos[0]) - 1e-4), -float(state.wrench["pad"][0, 2])
    sunk = -float(world.data[0].qpos[0]) - 1e-4
    assert not state.failed.any() and force == pytest.approx(70.0, rel=1e-3)
    assert deepest < 1.3 * sunk


def test_controls_of_a_step_are_known_before_its_contacts() -> None:
    """A controller is called once a step, and its force of this very step closes the gap."""
    calls = []
    world = flat_world(DISC, 2e-3, MOTOR)

    def press(data: mujoco.MjData, time: float) -> None:
        calls.append(time)
        data.ctrl[0] = -1.0

    state = world.step(press)
    assert len(calls) == 1
    # By itself the motor would sink it by 0.2 mm.
    assert 5e-6 < -world.data[0].qpos[0] < 15e-6 and -state.wrench["pad"][0, 2] > 0.5
