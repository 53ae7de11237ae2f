"""How does the same press look under other lights?

    python examples/relight.py

Lights are data: a sensor file names a light file, and a specification can be changed in Python.
"""

from dataclasses import replace

import raytac

spec = raytac.load_sensor("gelsight_mini")
dimmer = replace(spec, lights=replace(spec.lights, leds=tuple(led for led in spec.lights.leds if led.layer != "blue")))

for name, sensor in (("all LEDs", spec), ("without blue", dimmer)):
    frame = raytac.TactileSensor(sensor, resolution=(160, 120)).press("pins")
    print(name, "mean of red, green, blue:", frame.rgb[0].mean(axis=(0, 1)).round(1))
