"""How do I put a tactile sensor on every fingertip of the Shadow Hand of gymnasium-robotics and hold its block?

pip install gymnasium-robotics; python examples/shadow_hand.py

Only the package's model files are used, and the loop is this file's own.
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

# A pad of 12 mm instead of the Mini's 25 mm, without a camera of its own: what is asked for is force and the gel's surface.
mini = load_sensor("gelsight_mini")
gelpad = replace(mini.gelpad, size=(12e-3, 12e-3), thickness=2.5e-3, dome_radius=(30e-3, 20e-3))
case, camera = replace(mini.case, size=(12e-3, 12e-3), floor_z=-7e-3), replace(mini.camera, position=(0.0, 0.0, -6.9e-3))
leds = tuple(
    replace(led, position=(0.38 * led.position[0], 0.38 * led.position[1], led.position[2]), size=(0.3e-3, 0.3e-3))
    for led in mini.lights.leds
)
mini = replace(mini, lights=replace(mini.lights, leds=leds))
tip = replace(mini, gelpad=gelpad, case=case, camera=replace(camera, pixel_pitch=(30e-6, 30e-6)))
sensors = {}
for finger in ("ff", "mf", "rf", "lf", "th"):
    distal = f"robot0:{finger}distal"
    for geom in spec.body(distal).geoms:
        geom.contype = geom.conaffinity = 0  # the sensor takes the fingertip's place
    facing = np.array([[1, 0, 0, 0], [0, 0, -1, -8e-3], [0, 1, 0, 16e-3], [0, 0, 0, 1.0]])  # of the pad: its z to the palm's side
    raytac.mount(spec, tip, body=distal, name=finger, pose=facing, mass=4e-3)
    sensors[finger] = tip

world = raytac.TactileWorld(
    spec, sensors=sensors, touches=["object"], control_timestep=0.02, outputs=("wrench", "height"), allow_overlap=()
)
CLOSED = {"J2": 1.3, "J1": 1.1, "THJ4": 1.0, "THJ3": 1.1, "THJ2": 0.0, "THJ1": 0.5, "THJ0": -0.8, "WRJ1": 0.0}
"""Angles of a fist, by the ends of the servos' names [rad]."""
names = [world.model.actuator(i).name for i in range(world.model.nu)]
fist = np.array([CLOSED.get(name[-4:], CLOSED.get(name[-2:], 0.0)) for name in names])


def close(data: mujoco.MjData, time: float) -> None:
    data.ctrl[:] = fist * min(time / 0.8, 1.0)


felt = dict.fromkeys(sensors, 0.0)
for _ in range(60):
    state = world.step(close)
    felt = {name: max(felt[name], -float(state.wrench[name][0, 2])) for name in felt}
print("greatest load on each fingertip [N]:", {name: round(load, 2) for name, load in felt.items()})
