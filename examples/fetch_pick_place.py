"""How do I put tactile sensors on the Fetch robot of gymnasium-robotics and pick its cube up?

pip install gymnasium-robotics; python examples/fetch_pick_place.py

Only the package's model files are used; the loop is this file's own, so that it runs with any MuJoCo.
"""

from importlib.util import find_spec
from pathlib import Path

import mujoco
import numpy as np

import raytac

package = find_spec("gymnasium_robotics")
if package is None or package.origin is None:
    raise SystemExit("needs the model files of gymnasium-robotics: pip install gymnasium-robotics")
spec = mujoco.MjSpec.from_file(str(Path(package.origin).parent / "envs/assets/fetch/pick_and_place.xml"))
spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
spec.body("object0").pos = 1.35, 0.75, 0.4251
for equality in spec.equalities:  # the gripper follows a mocap body from where it is, not from where both were drawn
    equality.data[:] = 0.0
    equality.data[6] = 1.0
for side, sign in (("l", 1.0), ("r", -1.0)):
    finger = spec.geom(f"robot0:{side}_gripper_finger_link")
    finger.contype = finger.conaffinity = 0  # the sensor takes the finger's place: its gel is where the finger's face was
    pose = np.array([[1, 0, 0, 0.02], [0, 0, sign, sign * 0.015], [0, -sign, 0, 0], [0, 0, 0, 1]])  # of the pad in the finger's frame
    raytac.mount(spec, "gelsight_mini_9x11", body=f"robot0:{side}_gripper_finger_link", name=side, pose=pose, mass=0.05)
START = {"slide0": 0.405, "slide1": 0.48, "l_gripper_finger_joint": 0.05, "r_gripper_finger_joint": 0.05}
for joint, value in START.items():
    spec.joint(f"robot0:{joint}").ref = 0.0
spec.add_key(name="open")
model = spec.compile()
for joint, value in START.items():
    model.key("open").qpos[model.joint(f"robot0:{joint}").qposadr[0]] = value

world = raytac.TactileWorld(model, touches=["object0"], control_timestep=0.02, keyframe="open", markers="fots", optics="taxim")
fingers = [world.model.joint(f"robot0:{side}_gripper_finger_joint").qposadr[0] for side in "lr"]
path = [(1.0, 0.55), (2.0, 0.43), (2.6, 0.43), (3.6, 0.50)]  # time [s] and height of the gripper [m]


def pick(data: mujoco.MjData, time: float) -> None:
    """Over the cube, down, closed with 25 N, up."""
    x, y, _ = data.body("object0").xpos if time < 2.0 else data.mocap_pos[0]
    data.mocap_pos[0] = x, y, np.interp(time, *zip(*path, strict=True)) + 0.02
    data.mocap_quat[0] = np.array([1.0, 0.0, 1.0, 0.0]) * np.sqrt(0.5)
    data.ctrl[:] = 0.05 if time < 2.0 else data.qpos[fingers] - 25.0 / 30000.0


while world.data[0].time < 3.6:
    state = world.step(pick)
frames = world.observe()
height, forces = state.world_from_body["object0"][0, 2, 3] - 0.425, [-state.wrench[name][0, 2] for name in "lr"]
print("cube of 2 kg lifted by %.1f mm, pads press with %.1f and %.1f N" % (1e3 * height, *forces))
print("longest marker motion %.2f mm" % max(1e3 * np.nanmax(np.abs(f.markers.displacement)) for f in frames.values()))
