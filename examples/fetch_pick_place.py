"""How do I put tactile sensors on the Fetch robot of gymnasium-robotics and pick its cube up?

pip install gymnasium-robotics; python examples/fetch_pick_place.py

Only the package's model files are used, and the loop is this file's own.
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
spec.body("object0").pos = 1.35, 0.75, 0.425
for equality in spec.equalities:
    equality.data[:7] = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0  # the gripper's frame is held where the mocap body is
for side, sign in (("l", 1.0), ("r", -1.0)):
    finger = spec.geom(f"robot0:{side}_gripper_finger_link")
    finger.contype = finger.conaffinity = 0  # the sensor takes the finger's place: its gel is where the finger's face was
    pose = np.array(
        [[1, 0, 0, 0.02], [0, 0, sign, sign * 0.015], [0, -sign, 0, 0], [0, 0, 0, 1]]
    )  # of the pad in the finger's frame
    raytac.mount(spec, "gelsight_mini_9x11", body=f"robot0:{side}_gripper_finger_link", name=side, pose=pose, mass=0.05)
    spec.add_exclude(bodyname1="robot0:gripper_link", bodyname2=f"{side}_body")
spec.add_key(name="open")
model = spec.compile()
joints = {"slide0": 0.405, "slide1": 0.48, "l_gripper_finger_joint": 0.05, "r_gripper_finger_joint": 0.05}
for joint, value in joints.items():
    model.key("open").qpos[model.joint(f"robot0:{joint}").qposadr[0]] = value

world = raytac.TactileWorld(model, touches=["object0"], control_timestep=0.02, keyframe="open", outputs="wrench", markers="fots")
fingers = [world.model.joint(f"robot0:{side}_gripper_finger_joint").qposadr[0] for side in "lr"]
TIMES, HEIGHTS = (0.6, 1.2, 2.4, 3.2), (0.55, 0.43, 0.43, 0.50)  # [s], of the gripper [m]


def pick(data: mujoco.MjData, time: float) -> None:
    """Over the cube, down, closed with 40 N, up."""
    data.mocap_pos[0] = 1.35, 0.75, np.interp(time, TIMES, HEIGHTS) + 0.02
    data.mocap_quat[0] = np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0
    data.ctrl[:] = 0.05 if time < 1.2 else data.qpos[fingers] - 40.0 / 30000.0  # of servos of 30 N/mm


while world.data[0].time < 3.8:
    state = world.step(pick)
frames = world.observe()
lifted = state.world_from_body["object0"][0, 2, 3] - 0.425
print("longest marker motion %.2f mm" % max(1e3 * np.nanmax(np.abs(frame.markers.displacement)) for frame in frames.values()))
print("cube of 2 kg lifted by %.0f mm, pads press with %.1f and %.1f N" % (1e3 * lifted, *(-state.wrench[n][0, 2] for n in "lr")))
