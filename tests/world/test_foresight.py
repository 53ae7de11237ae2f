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


def flat_world(
    bodies: str, timestep: float, rest: str = "", gravity: float = 0.0, num_envs: int = 1, touches=None
) -> TactileWorld:
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


SLIDE = """<body name="body" pos="-.002 0 .005"><joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>
<geom type="sphere" size=".005" mass="{}"/></body>"""
SERVO = '<actuator><velocity joint="x" kv="200"/><motor joint="z"/></actuator>'


@pytest.mark.parametrize("jacobian", ["dense", "sparse"])
@pytest.mark.parametrize(("mass", "timestep"), [(0.02, 5e-3), (0.02, 1e-2), (0.2, 1e-2)])
def test_a_slide_begins_and_ends_under_the_same_load(mass: float, timestep: float, jacobian: str) -> None:
    """Nothing acts along the normal but 1 N, while a servo moves the ball at once by 20 mm/s, stops it and moves it back."""
    friction, force, slip = {"body": 0.3}, [], []
    world = flat_world(SLIDE.format(mass), timestep, SERVO, touches=friction)
    world.model.opt.jacobian = getattr(mujoco.mjtJacobian, f"mjJAC_{jacobian.upper()}")
    for seconds, speed in ((0.2, 0.0), (0.06, 0.02), (0.05, 0.0), (0.06, -0.02)):
        for _ in range(round(seconds / timestep)):
            load = -world.step(np.array([speed, -1.0])).wrench["pad"][0, [2, 0]]
            if speed or force:
                force.append(load[0])
                slip.append(abs(load[1]) / load[0])
    np.testing.assert_allclose(force, 1.0, atol=0.02)
    # It slid indeed.
    assert max(slip) == pytest.approx(0.3, rel=1e-3)


def test_a_step_begins_with_the_solution_that_foresaw_its_slide(monkeypatch: pytest.MonkeyPatch) -> None:
    """So MuJoCo does not search for it again."""
    solves, iterations, solve = [0], [], mujoco.mj_fwdConstraint

    def count(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        solves[0] += 1
        solve(model, data)

    monkeypatch.setattr(mujoco, "mj_fwdConstraint", count)
    world = flat_world(SLIDE.format(0.02), 5e-3, SERVO, touches={"body": 0.3})
    for k in range(60):
        before = solves[0]
        world.step(np.array([0.02 * (k > 20), -1.0]))
        if k > 20 and solves[0] > before + 1:  # one is the step's own, with the servo's damping
            iterations.append(int(world.data[0].solver_niter[0]))
    assert iterations and not any(iterations)


def test_a_body_that_slides_into_the_gel_sinks_as_deep_as_one_that_does_not() -> None:
    """Friction takes no part in the normal force of an impact."""
    deepest = []
    for speed in (0.0, 0.1):
        world = flat_world(SLIDE.format(0.2), 5e-3, SERVO, touches={"body": 0.3})
        world.data[0].qpos[1], world.data[0].qvel[:] = 0.2e-3, [speed, -0.05]
        sunk = []
        for _ in range(12):
            world.step(np.array([speed, -1.0]))
            sunk.append(-float(world.data[0].qpos[1]))
        deepest.append(max(sunk))
    assert deepest[1] == pytest.approx(deepest[0], rel=0.01)


def test_a_batch_foresees_slides_as_its_environments_alone() -> None:
    """Each has a servo of its own and begins to slide when it likes."""
    speeds = np.array([0.02, 0.0, -0.05])
    both = flat_world(SLIDE.format(0.02), 5e-3, SERVO, num_envs=3, touches={"body": 0.3})
    some = [flat_world(SLIDE.format(0.02), 5e-3, SERVO, touches={"body": 0.3}) for _ in speeds]
    for k in range(30):
        controls = np.stack([speeds * (k > 15 + np.arange(3)), np.full(3, -1.0)], axis=1)
        both.step(controls)
        for world, control in zip(some, controls, strict=True):
            world.step(control)
    for b, world in enumerate(some):
        np.testing.assert_array_equal(both.data[b].qpos, world.data[0].qpos)
        np.testing.assert_array_equal(both.data[b].qvel, world.data[0].qvel)
    assert abs(both.data[0].qvel[0]) > 1e-3


def test_controls_of_a_step_are_known_before_its_contacts() -> None:
    """A controller is called once a step, and its force of this very step closes the gap."""
    calls = []
    world = flat_world(DISC, 2e-3, MOTOR)

    def press(data: mujoco.MjData, time: float) -> None:
        calls.append(time)
        data.ctrl[0] = -1.0

    state = world.step(press)
    assert len(calls) == 1
    # By itself the motor would sink it by 0.2 mm; at rest it is 28 µm deep.
    assert 5e-6 < -world.data[0].qpos[0] < 28e-6 and -state.wrench["pad"][0, 2] > 0.5
