"""A GelSight on each finger of a MuJoCo model of your own: a cube is grasped, and both sensors see it.

Run: python examples/own_mujoco_model.py
"""

import mujoco
import numpy as np

import raytac

GRIPPER = """
<mujoco><option timestep="0.002" cone="elliptic" integrator="implicitfast"/>
<default><geom friction="0.8"/><joint type="slide" armature="0.1" damping="2"/><position kp="500" dampratio="1"/></default>
<worldbody><geom name="floor" type="plane" size="1 1 .1"/><light pos="0 0 1"/>
<body name="hand" pos="0 0 .1" gravcomp="1"><joint name="lift" axis="0 0 1"/><geom type="box" size=".02 .08 .01" mass=".3"/>
<body name="left_finger" pos="0 .045 -.088" gravcomp="1"><joint name="left" axis="0 1 0"/>
<geom type="box" size=".01 .004 .035" pos="0 .005 .045" mass=".03"/><site name="left_tip" zaxis="0 -1 0"/></body>
<body name="right_finger" pos="0 -.045 -.088" gravcomp="1"><joint name="right" axis="0 -1 0"/>
<geom type="box" size=".01 .004 .035" pos="0 -.005 .045" mass=".03"/><site name="right_tip" zaxis="0 1 0"/></body></body>
<body name="cube" pos="0 0 .012"><freejoint/><geom type="box" size=".01 .01 .012" mass=".05"/></body></worldbody>
<actuator><position name="lift" joint="lift" kp="2000"/><position joint="left"/><position joint="right"/></actuator></mujoco>
"""

spec = mujoco.MjSpec.from_string(GRIPPER)
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
