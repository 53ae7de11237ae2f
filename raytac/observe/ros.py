"""Messages of ROS 2 as dictionaries, from a frame; ROS is not needed."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from raytac.checks import check_number, check_whole
from raytac.errors import InputError
from raytac.frame import TactileFrame
from raytac.optics.camera import Pinhole
from raytac.optics.refraction import Slab
from raytac.sensor import TactileSensor

_FLOAT32 = 7
"""``datatype`` of ``sensor_msgs/PointField``."""
ROS_TYPES = {
    "image": "sensor_msgs/msg/Image",
    "depth": "sensor_msgs/msg/Image",
    "camera_info": "sensor_msgs/msg/CameraInfo",
    "wrench": "geometry_msgs/msg/WrenchStamped",
    "points": "sensor_msgs/msg/PointCloud2",
    "transform": "geometry_msgs/msg/TransformStamped",
}
"""Type of each message of ``ros_messages``."""


def ros_messages(
    frame: TactileFrame, sensor: TactileSensor, *, env: int = 0, stamp: float = 0.0, frame_id: str = "gelsight"
) -> dict[str, dict[str, Any]]:
    """Messages of one environment of a frame, by name, of the types ``ROS_TYPES``.

    Every dictionary has all fields of its message and no others, nested messages as dictionaries, ``data`` as bytes, little-endian. So
    ``rosidl_runtime_py.set_message_fields(Image(), messages["image"])`` fills a message.

    - ``image``: ``rgb`` as ``rgb8``. ``depth``: the camera's depth along its axis [m] as ``32FC1``. Both are of ``<frame_id>_camera``.
    - ``camera_info``: the pinhole of these images, without distortion. ROS puts the centre of the first pixel at (0, 0), where this
      library has (0.5, 0.5).
    - ``wrench``: force [N] and torque [N m] of the object on the pad, about the origin of the pad frame, ``frame_id``.
    - ``points``: the gel's surface, rows and columns of the pad's grid, with ``x``, ``y``, ``z`` and ``indentation`` [m], pad frame.
    - ``transform``: of ``<frame_id>_camera`` in ``frame_id``, for ``tf2``. Behind a plate or gel that bends light it is where the camera
      appears to be, so that points of the gel at rest fall on their pixels.

    What the frame does not hold is left out; ``camera_info``, ``transform`` and ``points`` are always there.

    Args:
        frame: of ``sensor``.
        env: environment.
        stamp: time [s].
        frame_id: name of the pad frame.

    Raises:
        InputError: an environment that does not exist or has failed, or a stamp that ROS cannot hold.
    """
    batch = frame.surface.batch
    env = check_whole("env", env, 0, batch - 1)
    if frame.failed[env]:
        raise InputError("env", value=env, rule="has failed: its arrays hold nothing of use")
    check_number("stamp", stamp, "[0, 2147483648)", "s")
    if not isinstance(frame_id, str) or not frame_id:
        raise InputError("frame_id", value=frame_id, rule="must be a name")
    whole = round(stamp * 1e9)
    time = {"sec": whole // 10**9, "nanosec": whole % 10**9}
    of_pad, of_camera = ({"stamp": time, "frame_id": name} for name in (frame_id, f"{frame_id}_camera"))
    camera = Pinhole.from_spec(sensor.spec.camera, sensor.resolution, Slab.from_spec(sensor.spec))
    messages: dict[str, dict[str, Any]] = {}
    if "rgb" in frame.outputs:
        messages["image"] = _image(of_camera, frame.rgb[env], "rgb8")
    if "depth" in frame.outputs:
        messages["depth"] = _image(of_camera, frame.depth[env].astype("<f4"), "32FC1")
    messages["camera_info"] = _camera_info(of_camera, camera)
    if "wrench" in frame.outputs:
        force, torque = (dict(zip("xyz", part.tolist(), strict=True)) for part in frame.wrench[env].reshape(2, 3))
        messages["wrench"] = {"header": of_pad, "wrench": {"force": force, "torque": torque}}
    messages["points"] = _points(of_pad, frame, env)
    (x, y, _), pitch = camera.position, sensor.spec.camera.pitch_at(sensor.resolution)
    place = {"x": x, "y": y, "z": -camera.focal[0] * pitch[0]}
    moved = {"translation": place, "rotation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
    messages["transform"] = {"header": of_pad, "child_frame_id": of_camera["frame_id"], "transform": moved}
    return messages


def _image(header: dict[str, Any], image: np.ndarray, encoding: str) -> dict[str, Any]:
    height, width = image.shape[:2]
    return {
        "header": header,
        "height": height,
        "width": width,
        "encoding": encoding,
        "is_bigendian": 0,
        "step": image.itemsize * math.prod(image.shape[1:]),
        "data": image.tobytes(),
    }


def _camera_info(header: dict[str, Any], camera: Pinhole) -> dict[str, Any]:
    (width, height), (fx, fy), (cx, cy) = camera.resolution, camera.focal, camera.principal
    u, v = cx - 0.5, cy - 0.5
    return {
        "header": header,
        "height": height,
        "width": width,
        "distortion_model": "plumb_bob",
        "d": [0.0] * 5,
        "k": [fx, 0.0, u, 0.0, fy, v, 0.0, 0.0, 1.0],
        "r": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        "p": [fx, 0.0, u, 0.0, 0.0, fy, v, 0.0, 0.0, 0.0, 1.0, 0.0],
        "binning_x": 0,
        "binning_y": 0,
        "roi": {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False},
    }


def _points(header: dict[str, Any], frame: TactileFrame, env: int) -> dict[str, Any]:
    surface = frame.surface
    (rows, columns), height = surface.grid.shape, surface.height[env]
    names = ("x", "y", "z", "indentation")
    points = np.empty((rows, columns, len(names)), "<f4")
    points[..., 0], points[..., 1] = surface.grid.x, surface.grid.y[:, None]
    points[..., 2], points[..., 3] = height, surface.grid.rest - height
    step = points.itemsize * len(names)
    return {
        "header": header,
        "height": rows,
        "width": columns,
        "fields": [
            {"name": name, "offset": points.itemsize * k, "datatype": _FLOAT32, "count": 1} for k, name in enumerate(names)
        ],
        "is_bigendian": False,
        "point_step": step,
        "row_step": step * columns,
        "data": points.tobytes(),
        "is_dense": bool(np.isfinite(points).all()),
    }
