"""TactileSensor refuses bad names before any work, computes only what is asked, and contact shows."""

from __future__ import annotations

import copy
import pickle
import subprocess
import sys
import warnings

import numpy as np
import pytest

from raytac.errors import InputError
from raytac.frame import OUTPUTS, MissingOutputError, TactileFrame
from raytac.optics import OPTICS
from raytac.sensor import TactileSensor
from raytac.specs import SensorSpec
from tests.conftest import Shader, make_surface
from tests.ipc.oracles.closed_forms import BondedLayer, Elastic


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"physics": "rigd"}, r"physics = 'rigd'.*did you mean 'rigid'.*rigid"),
        ({"optics": "taxm"}, r"optics = 'taxm'.*raytrace"),
        ({"outputs": ("rgb", "deph")}, r"outputs = 'deph'.*did you mean 'depth'.*rgb, layers"),
        ({"outputs": 3}, "sequence of names"),
        ({"outputs": "rgb,depth"}, "outputs = 'rgb,depth'.*layers"),
        ({"device": "gpu"}, "auto, cpu, cuda"),
        ({"num_envs": 0}, "num_envs = 0"),
        ({"outputs": ("rgb", "markers")}, "markers are asked for by the argument markers"),
        ({"optics": "mlp"}, "weights: must name a network"),
        ({"resolution": (0, 240)}, "resolution = 0"),
        ({"resolution": (320, 9000)}, "resolution = 9000.*8192"),
        ({"resolution": (320,)}, r"\(width, height\)"),
        ({"resolution": "320*240"}, "WIDTHxHEIGHT"),
        ({"seed": -1}, r"seed = -1.*2\^32"),
        ({"seed": 2**32}, "seed = 4294967296"),
    ],
)
def test_bad_names_and_numbers_are_refused_with_the_choices(options: dict, message: str, sensor_spec: SensorSpec) -> None:
    with pytest.raises(InputError, match=message):
        TactileSensor(sensor_spec, **options)


def test_a_state_needs_a_scene(sensor_spec: SensorSpec) -> None:
    with pytest.raises(InputError, match=r"load\(\)"):
        TactileSensor(sensor_spec, outputs=("height",)).update(object())  # type: ignore[arg-type]


def test_a_sensor_or_scene_of_another_type_is_named(sensor_spec: SensorSpec) -> None:
    with pytest.raises(InputError, match=r"sensor = 3.*not int"):
        TactileSensor(3)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"scene = 3.*not int"):
        TactileSensor(sensor_spec, outputs="height").press(3)  # type: ignore[arg-type]


def test_one_output_and_resolution_as_text(sensor_spec: SensorSpec) -> None:
    sensor = TactileSensor(sensor_spec, outputs="depth", resolution="32x24")
    assert sensor.outputs == ("depth",) and sensor.resolution == (32, 24)


@pytest.mark.parametrize("resolution", ["320x240", "640x480", "100x75", "86x64", "81x61"])
def test_the_sensors_shape_up_to_rounding_is_no_squeeze(resolution: str, sensor_spec: SensorSpec) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        TactileSensor(sensor_spec, resolution=resolution)


@pytest.mark.parametrize(
    ("resolution", "message"),
    [
        ("640x240", r"640x240 squeezes the sensor's view of 320x240: .*2 times as high as wide; 640x480 keeps"),
        ("240x240", r"1\.33 times as wide as high; 240x180 keeps"),
    ],
)
def test_another_shape_is_told(resolution: str, message: str, sensor_spec: SensorSpec) -> None:
    with pytest.warns(UserWarning, match=message):
        TactileSensor(sensor_spec, resolution=resolution)


def test_a_frame_prints_on_one_line(sensor_spec: SensorSpec) -> None:
    sensor = TactileSensor(sensor_spec, optics=Shader(sensor_spec), outputs=OUTPUTS, pitch=0.2e-3)
    text = repr(sensor.press("sphere"))
    assert text.startswith(
        "TactileFrame(surface=GelSurface(grid=PadGrid(x=float64 (127,), y=float64 (105,), rest=float64 (105, 127))"
    )
    assert "rgb=uint8 (1, 48, 64, 3)" in text and "layers={red: float32 (1, 48, 64, 3), green: " in text
    assert "force=float64 (1, 3)" in text and "time_ms={physics: " in text and "array(" not in text
    assert "\n" not in text and len(text) < 1500
    bare = repr(TactileSensor(sensor_spec, outputs="height", pitch=0.5e-3).rest())
    assert "rgb" not in bare and "force" not in bare and "height=float32 (1, " in bare


def test_the_area_of_the_force_law_is_told_beside_that_of_the_surface(sensor_spec: SensorSpec) -> None:
    """A ball on a flat pad: that of the bonded layer in the law, and less in the surface, whose Gaussians hold the gel off the ball."""
    sensor, radii = TactileSensor(sensor_spec, outputs="height", num_envs=2), np.array([0.6e-3, 1.0e-3])
    gel = sensor_spec.gelpad
    layer = BondedLayer(Elastic(gel.youngs_modulus, gel.poisson_ratio), gel.thickness)
    frame = sensor.press("sphere", depths=np.array([layer.sphere(3.155e-3, radius)[0] for radius in radii]))
    np.testing.assert_allclose(frame.force_law_area, np.pi * radii**2, rtol=0.05)
    pitch = sensor.grid.pitch
    area = frame.surface.contact.sum(axis=(1, 2)) * pitch[0] * pitch[1]
    assert (area > 0).all() and not np.allclose(area, frame.force_law_area, rtol=0.05)
    assert "force_law_area" not in sensor.rest().outputs


def test_a_state_of_another_scene_is_refused(sensor_spec: SensorSpec) -> None:
    sensor = TactileSensor(sensor_spec, outputs="height", pitch=0.5e-3)
    pad = sensor.load("coin")
    state = next(pad.run())
    sensor.load("sphere")
    with pytest.raises(InputError, match=r"'coin'.*'sphere' was loaded since"):
        sensor.update(state)
    sensor.load("coin")
    assert sensor.update(state).height is not None


def test_what_was_not_asked_for_says_how_to_ask(sensor_spec: SensorSpec) -> None:
    frame = TactileSensor(sensor_spec, outputs="height", pitch=0.5e-3).press("sphere")
    assert frame.outputs == ("surface", "height", "force", "force_law_area", "failed", "time_ms", "label")
    for name, how in (
        ("rgb", r'outputs=\("rgb", …\)'),
        ("contact_area", "wrench"),
        ("markers", "markers='fots'"),
        ("unconverged", "ipc"),
    ):
        with pytest.raises(MissingOutputError, match=rf"frame.{name}: .*{how}"):
            getattr(frame, name)
        assert not hasattr(frame, name)
    with pytest.raises(AttributeError, match="no attribute 'hight'"):
        _ = frame.hight  # type: ignore[attr-defined]
    with pytest.raises(InputError, match=r"must be a field of a frame.*rgb"):
        frame.with_values(rbg=frame.height)
    again = pickle.loads(pickle.dumps(frame.with_values(time_ms={}, force=None)))
    assert again.time_ms == {} and "force" not in again.outputs and again.label == "rigid"
    with pytest.raises(InputError, match="bare surface"):
        _ = TactileFrame(frame.surface).force


def test_environments_differ_by_offset_and_depth(sensor_spec: SensorSpec) -> None:
    sensor = TactileSensor(sensor_spec, outputs="height", num_envs=2, pitch=0.2e-3)
    frame = sensor.press("sphere", offsets=np.array([[0.0, 0.0], [2e-3, 0.0]]), depths=np.array([0.4e-3, 0.8e-3]))
    assert frame.surface.contact_centre[1, 0] - frame.surface.contact_centre[0, 0] == pytest.approx(2e-3, abs=0.2e-3)
    assert frame.surface.indentation[1].max() > 1.5 * frame.surface.indentation[0].max()


def test_the_mode_names_itself(sensor_spec: SensorSpec) -> None:
    mode = Shader(sensor_spec)
    mode.label = "raytrace-reference-denoised"
    assert TactileSensor(sensor_spec, optics=mode).label == "rigid+raytrace-reference-denoised"


def test_contact_changes_the_image_and_release_restores_it(sensor_spec: SensorSpec) -> None:
    sensor = TactileSensor(sensor_spec, optics=Shader(sensor_spec), outputs=("rgb",), pitch=0.2e-3)
    rest = sensor.rest().rgb
    pressed = sensor.press("sphere")
    assert rest is not None and pressed.rgb is not None
    assert np.abs(pressed.rgb.astype(int) - rest).max() > 10
    pad = sensor.load("sphere")
    *_, released = pad.run()
    assert released.kind == "release"
    np.testing.assert_array_equal(sensor.update(released).rgb, rest)


def test_a_surface_is_all_that_a_loop_needs(sensor_spec: SensorSpec) -> None:
    sensor = TactileSensor(sensor_spec, optics=Shader(sensor_spec), outputs=("rgb", "height"))
    surface = make_surface(batch=3)
    frame = sensor.update(surface)
    assert frame.rgb.shape[0] == 3 and frame.rgb.dtype == np.uint8
    assert frame.height is surface.height and "force" not in frame.outputs


def test_force_pushes_into_the_pad_and_holds_for_every_environment(sensor_spec: SensorSpec) -> None:
    sensor = TactileSensor(sensor_spec, outputs=("height",), num_envs=2, pitch=0.5e-3)
    frame = sensor.press("sphere")
    assert frame.force.shape == (2, 3) and not frame.failed.any()
    assert (frame.force[:, 2] < 0).all()
    np.testing.assert_array_equal(frame.surface.height[0], frame.surface.height[1])


_LAZY = """
import sys
import raytac
heavy = {"mitsuba", "drjit", "mujoco", "matplotlib", "trimesh", "OpenEXR", "PIL", "tyro", "warp", "scipy"}
assert not heavy & set(sys.modules), ("import raytac", heavy & set(sys.modules))
sensor = raytac.TactileSensor("gelsight_mini", outputs=("height",), pitch=0.5e-3)
assert not {"mujoco", "mitsuba"} & set(sys.modules), "a sensor that has done nothing"
frame = sensor.press("sphere")
assert frame.height.max() <= 0 and "rgb" not in frame.outputs
assert "mujoco" in sys.modules
assert not {"mitsuba", "drjit", "matplotlib"} & set(sys.modules), "a press without images"
"""


def test_nothing_heavy_is_imported_before_it_is_needed() -> None:
    done = subprocess.run([sys.executable, "-c", _LAZY], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_outputs_are_kept_in_one_order(sensor_spec: SensorSpec) -> None:
    assert TactileSensor(sensor_spec, outputs=tuple(reversed(OUTPUTS))).outputs == OUTPUTS


@pytest.mark.parametrize(("optics", "known"), [("raytrace", "denoise"), ("taxim", "calibration"), ("phong", "lights")])
def test_an_unknown_option_of_the_optics_is_refused_with_the_choices(optics: str, known: str) -> None:
    for name in ("calibratoin", "resolution"):
        with pytest.raises(InputError, match=f"{name} = 1: is no option of optics='{optics}'.*choose from: .*{known}"):
            OPTICS.config(optics, **{name: 1})


@pytest.mark.renderer
def test_images_wait_until_they_are_read() -> None:
    sensor = TactileSensor("gelsight_mini", optics="phong", outputs=("rgb", "depth"), resolution=(64, 48), pitch=0.4e-3)
    frame = sensor.press("sphere")
    launched = frame.time_ms["optics"]
    other = frame.with_values(label="other")
    copied, kept = copy.copy(other), pickle.loads(pickle.dumps(other))
    assert "rgb" in frame.outputs and frame.time_ms["optics"] >= launched
    for one in (other, copied, kept):
        np.testing.assert_array_equal(one.rgb, frame.rgb)
        np.testing.assert_array_equal(one.depth, frame.depth)
    black = np.zeros_like(frame.rgb)
    assert sensor.press("sphere").with_values(rgb=black).rgb is black
    with pytest.raises(MissingOutputError, match="normals"):
        _ = sensor.press("sphere").normals


def test_a_lookup_that_another_thread_overtakes_finds_the_image() -> None:
    rgb = np.zeros((1, 2, 2, 3), np.uint8)
    frame = TactileFrame(make_surface(), images=lambda: {"rgb": rgb, "depth": None})
    assert "rgb" in frame.outputs  # waits, as another thread does between a failed lookup and __getattr__
    assert TactileFrame.__dict__["__getattr__"](frame, "rgb") is rgb
    with pytest.raises(MissingOutputError, match="depth"):
        _ = frame.depth
