"""Contact of what a damper holds that no step resolves: it gives way as the damper does, not as a heavier body."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from raytac import mount
from raytac.specs import load_sensor
from raytac.world.implicit_damping import ImplicitDamping
from raytac.world.world import TactileWorld

PUSH, DAMPING, MASS, GAP = 4.0, 100.0, 0.05, 0.3e-3


def plunger(integrator: str, timestep: float, kind: str = "joint") -> TactileWorld:
    """A ball of 50 g over a gel, which a force pushes down against a damper of 100 N s/m: for its mass alone, 0.5 ms are long."""
    joint = f'<joint name="z" type="slide" axis="0 0 1" damping="{DAMPING if kind == "joint" else 0.0}"/>'
    servo = f'<general joint="z" gainprm="0" biastype="affine" biasprm="{-PUSH} 0 {-DAMPING}"/>' if kind == "servo" else ""
    spec = mujoco.MjSpec.from_string(f"""
    <mujoco><option timestep="{timestep}" integrator="{integrator}" cone="elliptic" gravity="0 0 {-PUSH / MASS * (kind == "joint")}"/>
      <worldbody><site name="tip"/>
        <body name="ball" pos="0 0 {8e-3 + GAP}">{joint}<geom name="ball" type="sphere" size="0.008" mass="{MASS}"/></body>
      </worldbody><actuator>{servo}</actuator></mujoco>""")
    sensor = load_sensor("gelsight_mini")
    mount(spec, sensor, site="tip", name="pad", pose=np.eye(4))
    return TactileWorld(spec, sensors={"pad": sensor}, touches=["ball"], outputs=("wrench",), device="cpu")


def pushed(world: TactileWorld, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Depths [m] and forces [N] after every step."""
    depths, forces = [], []
    for _ in range(round(seconds / world.control_timestep)):
        state = world.step()
        depths.append(-GAP - world.data[0].qpos[0])
        forces.append(-state.wrench["pad"][0, 2])
    return np.array(depths), np.array(forces)


@pytest.mark.parametrize(
    ("integrator", "kind"), [("Euler", "joint"), ("implicitfast", "joint"), ("implicit", "joint"), ("implicitfast", "servo")]
)
def test_a_damped_body_sinks_in_as_its_damper_lets_it_at_any_step(integrator: str, kind: str) -> None:
    """Without inertia, D δ' = P − F(δ) never goes beyond the depth at rest."""
    fine, _ = pushed(plunger(integrator, 0.5e-3, kind), 0.3)
    depths, forces = pushed(plunger(integrator, 10e-3, kind), 0.3)
    rest = fine[-1]
    assert forces[-1] == pytest.approx(PUSH, rel=1e-4) and depths[-1] == pytest.approx(rest, rel=1e-3)
    assert depths.max() < 1.001 * rest and fine.max() < 1.001 * rest
    # Where the fine one is half a step before or after.
    assert np.abs(depths - fine[19::20]).max() < 0.12 * rest


def test_after_a_step_the_mass_matrix_is_mujoco_s_own_and_others_steps_are_left_alone() -> None:
    world = plunger("implicitfast", 5e-3)
    pushed(world, 0.2)
    data, own = world.data[0], mujoco.MjData(world.model)
    assert world.state().wrench["pad"][0, 2] < -1.0
    own.qpos[:] = data.qpos
    mujoco.mj_forward(world.model, own)
    np.testing.assert_array_equal(data.M, own.M)
    np.testing.assert_array_equal(data.qLD, own.qLD)
    light = mujoco.MjSpec.from_string('<mujoco><worldbody><body><joint damping="1"/><geom size="1"/></body></worldbody></mujoco>')
    assert not ImplicitDamping(light.compile()).matters and ImplicitDamping(world.model).matters


def test_a_finger_that_opens_does_not_push_what_lies_below_its_case() -> None:
    """Its servo accelerates it by some 900 m/s² for its mass alone: MuJoCo's cone would reach across the gap of 2.6 mm."""
    world = TactileWorld("lift_cube_env", outputs=())
    data, model = world.data[0], world.models[0]
    model.opt.gravity[:] = 0.0  # the arm's motors are idle
    case = data.geom("left_case")
    bottom = case.xpos[2] - np.abs(case.xmat.reshape(3, 3)[2]) @ model.geom("left_case").size
    pose = np.eye(4)
    pose[:3, 3] = case.xpos[0], case.xpos[1] + 10e-3, bottom - 2.6e-3 - 15e-3
    ctrl = world.composed.ctrl.copy()
    assert world.composed.opening is not None
    for opening in (0.02, 0.08):
        world.reset(bodies={"object": pose[None]})
        ctrl[world.composed.opening] = opening
        world.step(ctrl)
        assert not world.failed.any() and np.abs(data.qvel[7]) > 1e-3 * (opening < 0.05)
        np.testing.assert_allclose(data.body("object").xpos, pose[:3, 3], rtol=0.0, atol=1e-9)
