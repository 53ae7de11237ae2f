"""How do I put a tactile sensor on every fingertip of the Shadow Hand of gymnasium-robotics and hold its block by all five?

pip install gymnasium-robotics; python examples/shadow_hand.py (only the model files are used)
"""

from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import mujoco
import numpy as np

import raytac
from raytac.specs import load_sensor

package = find_spec("gymnasium_robotics")
if package is None or package.origin is None:
    raise SystemExit("needs the model files of gymnasium-robotics: pip install gymnasium-robotics")
spec = mujoco.MjSpec.from_file(str(Path(package.origin).parent / "envs/assets/hand/manipulate_block.xml"))
spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC

# A pad of 12 mm instead of the Mini's 25 mm.
mini, size = load_sensor("gelsight_mini"), (12e-3, 12e-3)
gelpad = replace(mini.gelpad, size=size, thickness=2.5e-3, dome_radius=(30e-3, 20e-3))
camera = replace(mini.camera, position=(0.0, 0.0, -6.9e-3), pixel_pitch=(30e-6, 30e-6))
places = [tuple(np.array([0.38, 0.38, 1.0]) * led.position) for led in mini.lights.leds]
leds = [replace(led, position=place, size=(0.3e-3, 0.3e-3)) for led, place in zip(mini.lights.leds, places, strict=True)]
tip = replace(mini, gelpad=gelpad, camera=camera, case=replace(mini.case, size=size, floor_z=-7e-3))
tip = replace(tip, lights=replace(mini.lights, leds=tuple(leds)))
sensors = {finger: tip for finger in ("ff", "mf", "rf", "lf", "th")}
for finger in sensors:
    for geom in spec.body(f"robot0:{finger}distal").geoms:
        geom.contype = geom.conaffinity = 0  # the sensor takes the fingertip's place
    c, s = (-0.4583, np.sqrt(1.0 - 0.4583**2)) if finger == "th" else (1.0, 0.0)  # the thumb's pad is turned to the fingers
    pose = np.array([[c, 0, -s, -11e-3 * s], [-s, 0, -c, -11e-3 * c], [0, 1, 0, 16e-3], [0, 0, 0, 1]])
    raytac.mount(spec, tip, body=f"robot0:{finger}distal", name=finger, pose=pose, mass=4e-3)

# Angles [mrad] in the order of the servos, found by inverse kinematics. The block hangs in the air until the hand has closed.
OPEN = 1e-3 * np.array([0, 0, -50, 424, 389, 73, 429, 439, 190, 404, 410, 271, 125, 57, 455, 809, 1137, 209, 434, 0])
GRASP = 1e-3 * np.array([0, 0, -50, 482, 435, 78, 487, 485, 200, 462, 454, 314, 128, 161, 526, 1023, 979, 146, 288, -33])
spec.body("object").pos, spec.body("object").quat = (0.9914, 0.8364, 0.2112), (0.9881, 0.1498, 0.0229, 0.0244)
weld = spec.add_equality(type=mujoco.mjtEq.mjEQ_WELD, objtype=mujoco.mjtObj.mjOBJ_BODY, name1="world", name2="object")
weld.data[:] = *np.zeros(10), 1.0, 1.0
spec.add_key(name="open")
model = spec.compile()
model.key("open").qpos[:24] = OPEN[np.sort([*range(20), 4, 7, 10, 14])]  # a servo bends the last two joints of a finger alike
world = raytac.TactileWorld(model, sensors=sensors, touches=["object"], keyframe="open", control_timestep=0.02, outputs="wrench")


def close(data: mujoco.MjData, time: float) -> None:
    data.ctrl[:] = OPEN + min(time / 0.8, 1.0) * (GRASP - OPEN)
    data.eq_active[:] = time < 1.2


while world.data[0].time < 3.0:
    state = world.step(close)
loads = {name: round(-float(state.wrench[name][0, 2]), 2) for name in sensors}
carried = sum(-(state.world_from_pad[name][0, :3, :3] @ state.wrench[name][0, :3])[2] for name in sensors)
weight = 9.81 * model.body("object").mass.item()
print("block of %.3f N, of which pads carry %.3f N; they press with" % (weight, carried), loads)
