"""How do I press many objects at once, each in another place and to another depth?

python examples/batch.py
"""

import numpy as np

import raytac

environments = 8
rng = np.random.default_rng(0)
sensor = raytac.TactileSensor("gelsight_mini", outputs=("height", "wrench"), num_envs=environments)
frame = sensor.press(
    "sphere",
    offsets=rng.uniform(-3e-3, 3e-3, (environments, 2)),  # added to the object's x, y [m]
    depths=rng.uniform(0.2e-3, 0.9e-3, environments),  # [m]
)
for indentation, wrench in zip(frame.surface.indentation, frame.wrench, strict=True):
    print("indented %.3f mm, load %.2f N" % (1e3 * indentation.max(), -wrench[2]))
