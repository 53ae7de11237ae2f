"""How do I publish a simulated GelSight on ROS 2? Dictionaries with the fields of its messages, without ROS.

Run: python examples/ros_messages.py

In a node: ``rosidl_runtime_py.set_message_fields(message, messages[name])`` fills a message of the type ``ROS_TYPES[name]``.
"""

import numpy as np

from raytac import TactileSensor
from raytac.observe import ROS_TYPES, ros_messages

sensor = TactileSensor("gelsight_mini", optics="phong", outputs=("rgb", "depth", "wrench"), resolution=(320, 240))
frame = sensor.press("coin")
messages = ros_messages(frame, sensor, stamp=12.5, frame_id="left_gel")

for name, message in messages.items():
    size = "%d bytes" % len(message["data"]) if "data" in message else ""
    print("%-12s %-34s %-16s %s" % (name, ROS_TYPES[name], message["header"]["frame_id"], size))
print("focal length %.1f px" % messages["camera_info"]["k"][0])
print("force on the pad along z: %.2f N" % messages["wrench"]["wrench"]["force"]["z"])

# What a subscriber makes of the bytes.
cloud = messages["points"]
points = np.frombuffer(cloud["data"], "<f4").reshape(cloud["height"], cloud["width"], -1)
print("deepest imprint in the cloud: %.2f mm" % (1e3 * points[..., 3].max()))
