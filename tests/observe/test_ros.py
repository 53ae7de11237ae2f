"""Messages of ROS 2 against their definitions, and what their bytes say; by the typestore of ``rosbags`` where that is installed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from raytac.errors import InputError
from raytac.frame import TactileFrame
from raytac.observe import ROS_TYPES, ros_messages
from raytac.sensor import TactileSensor

DEFINITIONS = {
    "builtin_interfaces/msg/Time": "int32 sec, uint32 nanosec",
    "std_msgs/msg/Header": "builtin_interfaces/msg/Time stamp, string frame_id",
    "geometry_msgs/msg/Vector3": "float64 x, float64 y, float64 z",
    "geometry_msgs/msg/Quaternion": "float64 x, float64 y, float64 z, float64 w",
    "geometry_msgs/msg/Wrench": "geometry_msgs/msg/Vector3 force, geometry_msgs/msg/Vector3 torque",
    "geometry_msgs/msg/WrenchStamped": "std_msgs/msg/Header header, geometry_msgs/msg/Wrench wrench",
    "geometry_msgs/msg/Transform": "geometry_msgs/msg/Vector3 translation, geometry_msgs/msg/Quaternion rotation",
    "geometry_msgs/msg/TransformStamped": "std_msgs/msg/Header header, string child_frame_id, geometry_msgs/msg/Transform transform",
    "sensor_msgs/msg/Image": "std_msgs/msg/Header header, uint32 height, uint32 width, string encoding, uint8 is_bigendian, uint32 step, "
    "uint8[] data",
    "sensor_msgs/msg/RegionOfInterest": "uint32 x_offset, uint32 y_offset, uint32 height, uint32 width, bool do_rectify",
    "sensor_msgs/msg/CameraInfo": "std_msgs/msg/Header header, uint32 height, uint32 width, string distortion_model, float64[] d, "
    "float64[9] k, float64[9] r, float64[12] p, uint32 binning_x, uint32 binning_y, sensor_msgs/msg/RegionOfInterest roi",
    "sensor_msgs/msg/PointField": "string name, uint32 offset, uint8 datatype, uint32 count",
    "sensor_msgs/msg/PointCloud2": "std_msgs/msg/Header header, uint32 height, uint32 width, sensor_msgs/msg/PointField[] fields, "
    "bool is_bigendian, uint32 point_step, uint32 row_step, uint8[] data, bool is_dense",
}
"""Fields of each message in order, as its .msg file has them."""
WHOLE = {"int32": (-(2**31), 2**31 - 1), "uint32": (0, 2**32 - 1), "uint8": (0, 255)}


def check(kind: str, value: Any) -> None:
    """Compare a value with a type of ROS."""
    if kind == "uint8[]":
        assert isinstance(value, bytes)
    elif kind.endswith("]"):
        inner, _, size = kind[:-1].partition("[")
        assert isinstance(value, list) and (not size or len(value) == int(size))
        for one in value:
            check(inner, one)
    elif kind in DEFINITIONS:
        fields = [field.rsplit(" ", 1) for field in DEFINITIONS[kind].split(", ")]
        assert list(value) == [name for _, name in fields]
        for inner, name in fields:
            check(inner, value[name])
    elif kind in WHOLE:
        low, high = WHOLE[kind]
        assert type(value) is int and low <= value <= high
    else:
        assert type(value) is {"float64": float, "bool": bool, "string": str}[kind]


@pytest.fixture(scope="module")
def sensor() -> TactileSensor:
    outputs = ("rgb", "depth", "height", "wrench")
    return TactileSensor("gelsight_mini", optics="phong", outputs=outputs, resolution=(64, 48), device="cpu", num_envs=2)


@pytest.fixture(scope="module")
def frame(sensor: TactileSensor) -> TactileFrame:
    return sensor.press("sphere", offsets=np.array([[0.0, 0.0], [2e-3, -1e-3]]))


@pytest.fixture(scope="module")
def messages(frame: TactileFrame, sensor: TactileSensor) -> dict[str, dict[str, Any]]:
    return ros_messages(frame, sensor, env=1, stamp=12.345678901, frame_id="left")


def test_fields_are_those_of_the_definitions(messages: dict[str, dict[str, Any]]) -> None:
    assert set(messages) == set(ROS_TYPES)
    for name, message in messages.items():
        check(ROS_TYPES[name], message)
        in_camera = name in ("image", "depth", "camera_info")
        assert message["header"] == {
            "stamp": {"sec": 12, "nanosec": 345678901},
            "frame_id": "left_camera" if in_camera else "left",
        }


def test_images_are_read_back_by_step_and_encoding(messages: dict[str, dict[str, Any]], frame: TactileFrame) -> None:
    for name, dtype, channels, values in (("image", "u1", 3, frame.rgb[1]), ("depth", "<f4", 1, frame.depth[1])):
        message = messages[name]
        assert (message["height"], message["width"]) == (48, 64) and message["is_bigendian"] == 0
        rows = np.frombuffer(message["data"], np.uint8).reshape(message["height"], message["step"])
        read = rows.view(dtype).reshape(48, 64, channels).squeeze()
        np.testing.assert_array_equal(read, values)
    assert (messages["image"]["encoding"], messages["depth"]["encoding"]) == ("rgb8", "32FC1")


def test_points_of_the_gel_fall_on_the_pixels_that_show_them(
    messages: dict[str, dict[str, Any]], sensor: TactileSensor, frame: TactileFrame
) -> None:
    """By the message alone: point cloud, moved to the camera and projected, against the pitch of a pixel on the pad."""
    cloud, info = messages["points"], messages["camera_info"]
    kinds = {field["name"]: (f"<f{4 if field['datatype'] == 7 else 0}", field["offset"]) for field in cloud["fields"]}
    dtype = np.dtype({"names": list(kinds), "formats": [k for k, _ in kinds.values()], "offsets": [o for _, o in kinds.values()],
                      "itemsize": cloud["point_step"]})  # fmt: skip
    points = np.frombuffer(cloud["data"], dtype).reshape(cloud["height"], cloud["width"])
    assert cloud["row_step"] == cloud["point_step"] * cloud["width"] and cloud["is_dense"]
    np.testing.assert_array_equal(points["z"], frame.surface.height[1])
    np.testing.assert_allclose(points["indentation"], frame.surface.indentation[1], atol=1e-9)
    np.testing.assert_allclose(points["x"][0], frame.surface.grid.x, rtol=1e-6)
    np.testing.assert_allclose(points["y"][:, 0], frame.surface.grid.y, rtol=1e-6)
    deepest = np.unravel_index(points["indentation"].argmax(), points.shape)
    assert points["x"][deepest] == pytest.approx(2e-3, abs=2e-4) and points["y"][deepest] == pytest.approx(-1e-3, abs=2e-4)

    moved = messages["transform"]["transform"]["translation"]
    k = np.array(info["k"]).reshape(3, 3)
    at = np.array([1.7e-3, -2.2e-3, 0.0]) - [moved["x"], moved["y"], moved["z"]]  # of the gel at rest, near the axis
    u, v, w = k @ at
    camera, pitch = sensor.spec.camera, sensor.spec.camera.pitch_at((64, 48))
    scale = 64 / camera.resolution[0], 48 / camera.resolution[1]
    expected = [
        camera.principal_point[0] * scale[0] + (1.7e-3 - camera.position[0]) / pitch[0] - 0.5,
        camera.principal_point[1] * scale[1] + (-2.2e-3 - camera.position[1]) / pitch[1] - 0.5,
    ]
    np.testing.assert_allclose([u / w, v / w], expected, rtol=1e-6)
    np.testing.assert_array_equal(np.array(info["p"]).reshape(3, 4)[:, :3], k)
    assert (info["width"], info["height"]) == (64, 48)


def test_the_image_shows_the_contact_where_the_cloud_has_it(messages: dict[str, dict[str, Any]], frame: TactileFrame) -> None:
    depth = np.frombuffer(messages["depth"]["data"], "<f4").reshape(48, 64)
    rest = np.frombuffer(ros_messages_at_rest()["depth"]["data"], "<f4").reshape(48, 64)
    row, column = np.unravel_index(np.argmax(rest - depth), depth.shape)
    k, moved = np.array(messages["camera_info"]["k"]).reshape(3, 3), messages["transform"]["transform"]["translation"]
    seen = np.linalg.solve(k, np.array([column, row, 1.0], float)) * -moved["z"] + [moved["x"], moved["y"], 0.0]
    np.testing.assert_allclose(seen[:2], [2e-3, -1e-3], atol=4e-4)  # a pixel is 0.3 mm


def ros_messages_at_rest() -> dict[str, dict[str, Any]]:
    sensor = TactileSensor("gelsight_mini", optics="phong", outputs=("depth",), resolution=(64, 48), device="cpu")
    return ros_messages(sensor.rest(), sensor)


def test_the_wrench_is_that_of_the_frame(messages: dict[str, dict[str, Any]], frame: TactileFrame) -> None:
    wrench = messages["wrench"]["wrench"]
    assert [*wrench["force"].values(), *wrench["torque"].values()] == frame.wrench[1].tolist()
    assert wrench["force"]["z"] < 0.0


def test_only_what_the_frame_holds_becomes_a_message() -> None:
    assert set(ros_messages_at_rest()) == {"depth", "camera_info", "points", "transform"}


def test_a_bad_request_is_refused(frame: TactileFrame, sensor: TactileSensor) -> None:
    lost = frame.with_values(failed=np.array([False, True]))
    for arguments, message in (
        ({"env": 2}, "env = 2"),
        ({"stamp": -1.0}, "stamp"),
        ({"stamp": float("nan")}, "stamp"),
        ({"frame_id": ""}, "frame_id"),
        ({"env": 1}, "has failed"),
    ):
        with pytest.raises(InputError, match=message):
            ros_messages(lost, sensor, **arguments)  # type: ignore[arg-type]


def test_messages_survive_the_wire(messages: dict[str, dict[str, Any]]) -> None:
    """Serialised as a ROS 2 node would, and read back."""
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)

    def made(kind: str, value: Any) -> Any:
        fields = dict(store.fielddefs[kind][1])
        assert set(fields) == set(value)
        return store.types[kind](**{name: filled(field, value[name]) for name, field in fields.items()})

    def filled(field: Any, value: Any) -> Any:
        node, detail = int(field[0]), field[1]
        if node == 2:
            return made(detail, value)
        if node in (3, 4):
            (inner, what), _ = detail
            if int(inner) == 2:
                return [made(what, one) for one in value]
            return np.frombuffer(value, np.uint8) if isinstance(value, bytes) else np.array(value, what[0])
        return value

    for name, message in messages.items():
        kind = ROS_TYPES[name]
        read = store.deserialize_cdr(store.serialize_cdr(made(kind, message), kind), kind)
        assert read.header.frame_id == message["header"]["frame_id"] and read.header.stamp.nanosec == 345678901
        if "data" in message:
            assert read.data.tobytes() == message["data"] and (read.height, read.width) == (message["height"], message["width"])
        if name == "camera_info":
            np.testing.assert_array_equal(read.k, message["k"])
        if name == "wrench":
            assert read.wrench.force.z == message["wrench"]["force"]["z"]
        if name == "points":
            assert [field.name for field in read.fields] == ["x", "y", "z", "indentation"]
