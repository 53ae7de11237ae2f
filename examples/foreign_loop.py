"""Touch in a loop that somebody else steps: read from MuJoCo's own contacts, or with the gel's contact put in.

Run: python examples/foreign_loop.py
"""

import mujoco
import numpy as np

import raytac

PRESS = """
<mujoco><option timestep="0.002" cone="elliptic"/><worldbody>
<body name="ball" pos="0 0 0.0102"><joint type="slide" axis="0 0 1"/><geom name="ball" size="0.01" mass="0.1"/></body>
</worldbody></mujoco>
"""


def model_with_sensor(collide: bool) -> mujoco.MjModel:
    spec = mujoco.MjSpec.from_string(PRESS)
    raytac.mount(spec, "gelsight_mini", body="world", pose=np.eye(4), name="pad", collide=collide)
    return spec.compile()


# 1. A loop that only MuJoCo steps: the gel collides there, and a reader looks at the states. Three of them, pushed by 0, 1 and 2 N.
model = model_with_sensor(collide=True)
states = [mujoco.MjData(model) for _ in range(3)]
reader = raytac.TactileReader(model, touches=["ball"], num_envs=3, outputs=("height", "wrench"), pitch=0.2e-3)
for data, push in zip(states, (0.0, 1.0, 2.0), strict=True):
    data.body("ball").xfrc_applied[2] = -push
    for _ in range(250):
        mujoco.mj_step(model, data)
frame = reader.read(states)["pad"]
for force, deep in zip(-frame.force[:, 2], frame.surface.indentation.max(axis=(1, 2)), strict=True):
    print("reader: %.2f N of MuJoCo, imprint of the gel %.3f mm" % (force, 1e3 * deep))

# 2. A loop that takes the gel's contact: one call in place of mj_step, or two around mj_step2.
model = model_with_sensor(collide=False)
data = mujoco.MjData(model)
pads = raytac.PadStepper(model, touches=["ball"], outputs=("height", "wrench"), pitch=0.2e-3)
for _ in range(150):
    pads.step(model, data)
for _ in range(100):
    mujoco.mj_step1(model, data)
    pads.add(model, data)
    mujoco.mj_step2(model, data)
    pads.finish(model, data)
frame = pads.observe(data)["pad"]
deep = 1e3 * frame.surface.indentation.max()
print("stepper: the ball weighs %.3f N on the gel, imprint %.3f mm" % (-frame.force[0, 2], deep))
