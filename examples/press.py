"""How do I press an object into a sensor and get its image, depth and force?

python examples/press.py
"""

import raytac

sensor = raytac.TactileSensor("gelsight_mini", outputs=("rgb", "depth", "wrench"), resolution=(160, 120))
frame = sensor.press("coin")  # a shipped scene; a path of a scene file works too

print("image ", frame.rgb.shape, frame.rgb.dtype)
print("depth  %.2f to %.2f mm" % (1e3 * frame.depth.min(), 1e3 * frame.depth.max()))
print("force  %.2f N along the pad's normal" % frame.wrench[0, 2])

# The same press step by step: a loop of yours decides what happens between readings.
pad = sensor.load("coin")
for reading in pad.run(steps_per_stage=3):
    frame = sensor.update(reading)
    print("deepest indentation %.3f mm" % (1e3 * frame.surface.indentation.max()))
