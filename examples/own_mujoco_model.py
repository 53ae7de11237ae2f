"""A GelSight on each finger of a MuJoCo model of your own: a cube is grasped, and both sensors see it.

Run: python examples/own_mujoco_model.py
"""

from pathlib import Path

import mujoco
import numpy as np

import raytac

spec = mujoco.MjSpec.from_file(str(Path(__file__).with_name("gripper.xml")))
raytac.mount(spec, "gelsight_mini_9x11", site="left_tip", name="left")
raytac.mount(spec, "gelsight_mini", site="right_tip", name="right")
world = raytac.TactileWorld(spec, touches=["cube"], control_timestep=0.02, outputs=("height", "wrench"), pitch=0.4e-3)


def grasp(data: mujoco.MjData, time: float) -> None:
    """Write ``data.ctrl``: close in 0.2 s, then lift by 3 cm in 0.3 s."""
    data.ctrl[1:] = -0.012 * min(time / 0.2, 1.0)
    data.ctrl[0] = 0.03 * np.clip((time - 0.2) / 0.3, 0.0, 1.0)


for _ in range(30):
    state = world.step(grasp)
assert not state.failed.any()
print("cube at z = %.1f mm" % (1e3 * state.world_from_body["cube"][0, 2, 3]))
for name, frame in world.observe().items():
    force, deep = frame.force[0], frame.surface.indentation[0].max()
    print("%s: normal force %.2f N, %.2f N along the pad, imprint %.2f mm" % (name, -force[2], np.hypot(*force[:2]), 1e3 * deep))
