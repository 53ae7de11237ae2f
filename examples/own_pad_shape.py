"""How do I give the gel a shape of my own, and what does it change?

python examples/own_pad_shape.py
"""

from dataclasses import replace

import numpy as np

import raytac
from raytac.specs import HeightMap, load_sensor, validate_sensor

mini = load_sensor("gelsight_mini")
step, (width, height) = 0.25e-3, mini.gelpad.size
x, y = np.arange(-0.5, 0.5001, step / width) * width, np.arange(-0.5, 0.5001, step / height) * height

# A saddle: round like a finger of 30 mm radius across, and slightly hollow along. A scan of a real gel is an array as well.
saddle = np.sqrt(30e-3**2 - x[None, :] ** 2) - 30e-3 + y[:, None] ** 2 / (2 * 150e-3)
surface = HeightMap(saddle, (step, step)).centred()  # z = 0 in its middle
pad = replace(mini.gelpad, dome_radius=(np.inf, np.inf), surface=surface)
bent = replace(mini, name="bent", gelpad=pad, source=None)
validate_sensor(bent)  # a sensor file says the same with: surface = "saddle.npy"

for sensor in (mini, bent):
    sensor = raytac.TactileSensor(sensor, outputs=("rgb", "wrench"), resolution=(160, 120))
    frame = sensor.press("cylinder", force=2.0)
    print("%s: touches %.1f mm2 under 2 N" % (sensor.spec.name, 1e6 * frame.contact_area[0]))
    for path in frame.save("own_pad_shape_" + sensor.spec.name):
        print("wrote", path)
