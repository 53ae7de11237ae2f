"""How do I put tactile sensors on robosuite's Panda, lift its cube by 100 mm and check that the pads carry it?

pip install robosuite; python examples/panda_lift_cube.py

robosuite composes the model of its lift task, with elliptic cones. The loop is this file's own, and so is the control of the arm.
"""

from importlib import import_module
from importlib.util import find_spec

import mujoco
import numpy as np

import raytac

if find_spec("robosuite") is None:
    raise SystemExit("needs the models of robosuite: pip install robosuite")
suite = import_module("robosuite").models
robot = suite.robots.Panda(idn=0)
robot.add_base(suite.bases.RethinkMount(idn=0))
robot.add_gripper(suite.grippers.PandaGripper(idn=0))
robot.set_base_xpos(robot.base_xpos_offset["table"](0.8))
cube, table = suite.objects.BoxObject("cube", size=[0.021] * 3), suite.arenas.TableArena(table_offset=(0, 0, 0.8))
spec = mujoco.MjSpec.from_string(suite.tasks.ManipulationTask(table, [robot], cube).get_xml())
spec.body("cube_main").pos = 0.0, 0.0, 0.821
for side, number, sign in (("left", 1, 1.0), ("right", 2, -1.0)):
    for part in ("collision", "pad_collision"):
        finger = spec.geom(f"gripper0_finger{number}_{part}")
        finger.contype = finger.conaffinity = 0  # the sensor takes the finger's place: its gel is where the finger's face was
    pose = np.array([[-sign, 0, 0, 0], [0, 0, -sign, 0], [0, -1, 0, 0.045], [0, 0, 0, 1]])  # of the pad in the finger's frame
    raytac.mount(spec, "gelsight_mini_9x11", body=f"gripper0_{side}finger", name=side, pose=pose, mass=0.05)
spec.add_key(name="open")
model = spec.compile()
model.key("open").qpos[:9] = *robot.init_qpos, 0.04, -0.04
world = raytac.TactileWorld(model, control_timestep=0.02, keyframe="open", outputs="wrench", markers="fots")
arm, grip = slice(0, 7), model.site("gripper0_grip_site").id
straight = world.data[0].site_xmat[grip].reshape(3, 3).round()  # fingers down
TIMES, HEIGHTS = (0.0, 1.0, 1.6, 2.6, 3.2), (1.0, 0.823, 0.823, 0.923, 0.923)  # [s], of the pads' centres [m]


def pick(data: mujoco.MjData, time: float) -> None:
    """Down, closed with the servos' 20 N, 100 mm up: the gripper as a critically damped oscillator about its goal."""
    jacobian, lag = np.zeros((6, model.nv)), np.zeros((6, model.nv))
    mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], grip)
    mujoco.mj_solveM(model, data, lag, jacobian)
    turn = np.cross(data.site_xmat[grip].reshape(3, 3), straight, axis=0).sum(axis=1) / 2.0  # rotation vector of small angles
    away = np.r_[np.array([0.0, 0.0, np.interp(time, TIMES, HEIGHTS)]) - data.site_xpos[grip], turn]
    pull = np.linalg.solve(lag @ jacobian.T, 400.0 * away - 40.0 * jacobian @ data.qvel)
    data.ctrl[arm] = (jacobian.T @ pull + data.qfrc_bias)[arm] - data.qvel[arm]
    data.ctrl[7:] = (0.04, -0.04) if time < 1.2 else 0.0


while world.data[0].time < 3.2:
    state = world.step(pick)
frames = world.observe()
lifted, weight = state.world_from_body["cube_main"][0, 2, 3] - 0.821, 9.81 * model.body("cube_main").mass.item()
carried = sum(-(state.world_from_pad[name][0, :3, :3] @ state.wrench[name][0, :3])[2] for name in frames)
pressed = [-state.wrench[name][0, 2] for name in frames]
print("cube lifted by %.1f mm," % (1e3 * lifted), "pads press with %.1f and %.1f N," % tuple(pressed), end=" ")
print("and carry %.4f N of its %.4f N" % (carried, weight))
