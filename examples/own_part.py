"""How do I press a part of my own, from a mesh in memory, and see where it touches?

python examples/own_part.py
"""

import math

import trimesh

import raytac

# A hexagonal bolt, standing; metres. trimesh.load_mesh("part.stl") gives the same for a file (scale=0.001 for millimetres).
bolt = trimesh.creation.cylinder(radius=2.5e-3, height=8e-3, sections=6)

sensor = raytac.TactileSensor("gelsight_mini", outputs=("rgb", "wrench"), resolution=(160, 120))
for yaw in (0, 15, 30):
    frame = sensor.press(bolt, depth=0.4e-3, offset=(1e-3, 0.0), yaw=math.radians(yaw))
    print("turned by %2d degrees: load %.2f N" % (yaw, -frame.force[0, 2]))

frame = sensor.press(bolt, force=3.0, tilt=math.radians(10))  # it leans, so an edge goes in first
x, y = 1e3 * frame.surface.contact_centre[0]
print("leaning: touches at x = %.2f, y = %.2f mm" % (x, y))
for path in frame.save("own_part"):  # frame.npz and rgb.png; frame.show() draws them
    print("wrote", path)
