"""Sensors and lights: the shipped ones load; each rule is broken once and must be named with file, key and value."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from raytac.assets import asset_root
from raytac.errors import SpecError
from raytac.specs import LedSpec, available, load_lights, load_sensor, validate_sensor, with_lights
from raytac.specs.sensor_check import led_corners

MakeSensor = Callable[..., Path]
NAN, INF = math.nan, math.inf


@pytest.mark.parametrize("name", available("sensor"))
def test_shipped_sensors_load(name: str) -> None:
    sensor = load_sensor(name)
    assert sensor.name == name
    assert set(sensor.lights.layers) == {"red", "green", "blue"}
    assert sensor == load_sensor(f"scenes/sensors/{name}.toml")
    for led in sensor.lights.leds:
        assert math.hypot(*led.axis) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("name", available("lights"))
def test_shipped_lights_load_alone(name: str) -> None:
    lights = load_lights(name)
    assert lights.leds and lights.source is not None and lights.source.name == f"{name}.toml"


def test_the_mini_in_si() -> None:
    mini = load_sensor("gelsight_mini")
    assert mini.gelpad.size == (0.02525, 0.02075)
    assert mini.gelpad.thickness == 0.004
    assert mini.gelpad.dome_radius == (0.21, 0.135)
    assert mini.gelpad.youngs_modulus == 430e3
    assert mini.camera.resolution == (320, 240)
    assert mini.markers.rows == mini.markers.columns == 0


def test_the_mini_dome_has_the_sag_of_its_source() -> None:
    """FEATS' gel mesh, source of the radii: 0.084 and 0.196 mm at 6 and 9 mm along x; 0.129 and 0.25 mm at 6 and 8 mm along y."""
    pad = load_sensor("gelsight_mini").gelpad
    assert pad.sag(0.006, 0.0) == pytest.approx(0.084e-3, abs=0.01e-3)
    assert pad.sag(0.009, 0.0) == pytest.approx(0.196e-3, abs=0.01e-3)
    assert pad.sag(0.0, 0.006) == pytest.approx(0.129e-3, abs=0.01e-3)
    assert pad.sag(0.0, 0.008) == pytest.approx(0.25e-3, abs=0.02e-3)


def test_the_dome_boards_are_one_board_turned_by_120_degrees() -> None:
    leds = load_sensor("gelsight_dome").lights.leds
    boards = [leds[k : k + 4] for k in (0, 4, 8)]
    angles = []
    for board in boards:
        assert len({led.layer for led in board}) == 1
        centre = [sum(led.position[k] for led in board) / 4 for k in range(3)]
        assert math.hypot(*centre[:2]) == pytest.approx(12.59e-3, abs=2e-6)
        inwards = sum(a * c for a, c in zip(board[0].axis[:2], centre[:2], strict=True))
        assert inwards < 0 < board[0].axis[2]
        angles.append(math.degrees(math.atan2(centre[1], centre[0])))
    turns = sorted(((b - a) % 360) for a, b in zip(angles, angles[1:] + angles[:1], strict=True))
    assert turns == pytest.approx([240, 240, 240], abs=0.02) or turns == pytest.approx([120, 120, 120], abs=0.02)


SENSOR_ERRORS: list[tuple[str, Any, str]] = [
    ("gelpad.size_mm", [25.25], "must be 2 numbers, each in [2, 200] mm"),
    ("gelpad.thickness_mm", -4.0, "must be a number in [0.2, 50] mm"),
    ("gelpad.thickness_mm", 0.004, "must be a number in [0.2, 50] mm"),
    ("gelpad.dome_radius_mm", [10.0, 135.0], "must be more than half the pad"),
    ("gelpad.dome_radius_mm", [12.7, 10.4], "must be less than the thickness 4 mm"),
    ("gelpad.dome_radius_mm", [NAN, 135.0], "must be 2 numbers, each in [1, inf] mm"),
    ("gelpad.youngs_modulus_kpa", 0.43, "must be a number in [1, 100000] kPa"),
    ("gelpad.poisson_ratio", 0.5, "must be a number in [0, 0.5)"),
    ("gelpad.density_kg_m3", 1.0, "must be a number in [100, 10000] kg/m³"),
    ("gelpad.friction", -0.1, "must be a number in [0, 10]"),
    ("coat.reflectance", [0.5, 1.1, 0.5], "must be 3 numbers, each in [0, 1]"),
    ("coat.reflectance", [-0.1, 0.5, 0.5], "must be 3 numbers, each in [0, 1]"),
    ("coat.specular", 1.0, "must be a number in [0, 1)"),
    ("coat.roughness", 0.01, "must be a number in [0.05, 1]"),
    ("case.size_mm", ["30", 26], "must be 2 numbers"),
    ("case.floor_z_mm", 28.5, "must be a number in [-500, 0) mm"),
    ("case.reflectance", 1.0, "must be a number in [0, 1)"),
    ("camera.resolution_px", [320.0, 240], "must be 2 whole numbers, each in [8, 8192] px"),
    ("camera.resolution_px", [0, 240], "must be 2 whole numbers, each in [8, 8192] px"),
    ("camera.pixel_pitch_mm", [0.0, 0.0634], "must be 2 numbers, each in [0.0005, 5] mm"),
    ("camera.pixel_pitch_mm", [0.08, 0.0634], "must not be larger than the pad"),
    ("camera.pixel_pitch_mm", [0.0634, 0.09], "must not be larger than the pad"),
    ("camera.position_mm", [0.0, 0.0, 28.0], "must lie behind the gel, z < -4 mm"),
    ("camera.position_mm", [0.0, 0.0, -2.0], "must lie behind the gel, z < -4 mm"),
    ("camera.position_mm", [20.0, 0.0, -28.0], "must lie between the case's walls, |x| <= 15.2 mm"),
    ("camera.position_mm", [0.0, 12.0, -28.0], "the camera does not see the pad"),
    ("camera.position_mm", [0.0, 0.0, INF], "must be 3 numbers"),
    ("response.exposure", 0.0, "must be a number in (0, 1e9]"),
    ("response.white_balance", [1.0, 1.0], "must be 3 numbers, each in (0, 100]"),
    ("response.gamma", 0.0, "must be a number in [0.5, 5]"),
    ("response.black_level", [0.0, 0.9, 0.0], "must be 3 numbers, each in [-0.5, 0.5]"),
    ("camera.principal_point_px", [210.0, 120.0], "the view runs off the pad: at z = 0 it covers x = -13.31 to 6.974 mm"),
    ("camera.principal_point_px", [110.0, 120.0], "the view runs off the pad: at z = 0 it covers x = -6.974 to 13.31 mm"),
    ("camera.principal_point_px", [160.0, 170.0], "the view runs off the pad: at z = 0 it covers y = -10.78 to 4.438 mm"),
    ("camera.principal_point_px", [160.0, 70.0], "the view runs off the pad: at z = 0 it covers y = -4.438 to 10.78 mm"),
    ("camera.position_mm", [-3.0, 0.0, -28.0], "the view runs off the pad: at z = 0 it covers x = -13.14 to 7.144 mm"),
    ("camera.position_mm", [0.0, 3.0, -28.0], "the view runs off the pad: at z = 0 it covers y = -4.608 to 10.61 mm"),
    ("response.vignetting", [-1.5, 0.0, 0.0], "must stay above 0 over the whole image"),
    ("response.vignetting", [-4.0, 4.0, 0.0], "must stay above 0 over the whole image"),  # 0 at r² = 1/2 alone
    ("response.vignetting", [0.0, 0.0, -1.0], "must stay above 0 over the whole image"),
    ("response.vignetting", [-9.0, 10.0, 1e-300], "must stay above 0 over the whole image"),
    ("response.shading_red", [0.1, 0.2], "(n + 1)(n + 2)/2 coefficients for a degree n (1, 3, 6, 10, 15, …), not 2"),
    ("response.shading_green", [], "must be a list of numbers, each in [-5, 5]"),
    ("response.shading_blue", [0.1, 5.1, 0.0], "must be a list of numbers, each in [-5, 5]"),
    ("response.shading_blue", [5.0, -5.0, 5.0, -5.0, 5.0, -5.0], "absolute values must not sum to more than 20"),
    ("markers.rows", 7, "must both be 0 or both be positive"),
    ("refraction.model", "fresnel", "must be a known name"),
    ("refraction.ior", 0.9, "must be a number in [1, 3]"),
    ("lights", 3, "must be a non-empty string"),
]


@pytest.mark.parametrize(("key", "value", "rule"), SENSOR_ERRORS)
def test_sensor_errors(make_sensor: MakeSensor, key: str, value: Any, rule: str) -> None:
    path = make_sensor({key: value})
    with pytest.raises(SpecError) as caught:
        load_sensor(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: {key} = {value!r}: ")
    assert rule in message


def test_a_principal_point_far_off_turns_the_camera_away(make_sensor: MakeSensor) -> None:
    with pytest.raises(SpecError, match="does not see the pad: its view is centred at"):
        load_sensor(make_sensor({"camera.principal_point_px": [500.0, 120.0]}))


@pytest.mark.parametrize("key", ["gelpad", "coat", "case", "camera", "response", "markers", "refraction"])
def test_a_missing_table(make_sensor: MakeSensor, delete: object, key: str) -> None:
    path = make_sensor({key: delete})
    with pytest.raises(SpecError) as caught:
        load_sensor(path)
    assert str(caught.value) == f"{path}: {key}: missing table [{key}]"


@pytest.mark.parametrize(
    "key",
    [
        "lights",
        "gelpad.thickness_mm",
        "coat.reflectance",
        "case.floor_z_mm",
        "camera.position_mm",
        "response.gamma",
        "markers.rows",
    ],
)
def test_a_missing_key(make_sensor: MakeSensor, delete: object, key: str) -> None:
    path = make_sensor({key: delete})
    with pytest.raises(SpecError) as caught:
        load_sensor(path)
    assert str(caught.value).startswith(f"{path}: {key}: missing key: must be ")


@pytest.mark.parametrize(
    ("key", "close"),
    [
        ("gelpad.thicknes_mm", "thickness_mm"),
        ("gelpad.thickness_m", "thickness_mm"),
        ("camra", "camera"),
        ("case.floor_mm", "floor_z_mm"),
    ],
)
def test_an_unknown_key(make_sensor: MakeSensor, key: str, close: str) -> None:
    path = make_sensor({key: 4.0})
    with pytest.raises(SpecError) as caught:
        load_sensor(path)
    assert str(caught.value).startswith(f"{path}: {key}: unknown key; did you mean '{close}'? choose from: ")


MARKERS = {"rows": 7, "columns": 9, "pitch_mm": [2.4, 2.4], "radius_mm": 0.3, "reflectance": 0.02}


def test_markers_load(make_sensor: MakeSensor) -> None:
    markers = load_sensor(make_sensor({"markers": MARKERS})).markers
    assert (markers.rows, markers.columns, markers.radius, markers.offset) == (7, 9, 3e-4, (0.0, 0.0))


@pytest.mark.parametrize(
    ("change", "key", "rule"),
    [
        ({"radius_mm": 0.0}, "markers.radius_mm", "must be > 0 where there are markers"),
        ({"pitch_mm": [0.5, 2.4]}, "markers.pitch_mm", "dots must not overlap"),
        ({"pitch_mm": [4.0, 2.4]}, "markers.pitch_mm", "must stay on the pad"),
        ({"offset_mm": [5.0, 0.0]}, "markers.pitch_mm", "must stay on the pad"),
        ({"columns": 0}, "markers.rows", "must both be 0 or both be positive"),
    ],
)
def test_marker_errors(make_sensor: MakeSensor, change: dict[str, Any], key: str, rule: str) -> None:
    path = make_sensor({"markers": {**MARKERS, **change}})
    with pytest.raises(SpecError) as caught:
        load_sensor(path)
    assert caught.value.key == key and caught.value.file == path and rule in str(caught.value)


LED_ERRORS: list[tuple[str, Any, str]] = [
    ("led[1].position_mm", [5.0, 0.0, -2.0], "LED 'green' lies inside the gel: under the pad all of it must have z <= -4 mm"),
    ("led[1].position_mm", [0.0, 0.0, 5.0], "lies inside the gel"),
    ("led[1].position_mm", [14.2, 5.0, 1.0], "LED 'green' lies above the gel"),
    ("led[1].position_mm", [14.2, 5.0, -0.2], "lies above the gel"),
    ("led[1].position_mm", [16.0, 5.0, -8.0], "LED 'green', [2.0, 1.0] mm large, must lie inside the case, |x| <= 15.2 mm"),
    ("led[1].position_mm", [0.0, -13.5, -8.0], "must lie inside the case"),
    ("led[1].position_mm", [0.0, 0.0, -30.0], "must lie inside the case"),
    ("led[1].size_mm", [18.0, 1.0], "LED 'green', [18.0, 1.0] mm large, must lie inside the case"),
    ("led[1].size_mm", [2.0, 0.0], "must be 2 numbers, each in (0, 50] mm"),
    ("led[1].position_mm", [0.0, NAN, -8.0], "must be 3 numbers, each in [-500, 500] mm"),
    ("led[1].axis", [0.0, 0.0, 0.0], "must be a direction of length > 0"),
    ("led[1].axis", [0.0, 0.0, INF], "must be 3 numbers"),
    ("led[1].lobe", 0.9, "must be a number in [1, 1000]"),
    ("led[1].power_w_per_sr", [0.0, -1e-4, 0.0], "must be 3 numbers, each in [0, 1e6] W/sr"),
    ("led[1].power_w_per_sr", 1.0, "must be 3 numbers"),
    ("led[1].layer", "Green LED", "must be a name of lower-case letters, digits and underscores"),
    ("led[1].name", "red", "must be unique among the LEDs of a file"),
    ("led", [], "at least one [[led]] table is needed"),
    ("led", 3, "must be an array of tables [[led]]"),
]


@pytest.mark.parametrize(("key", "value", "rule"), LED_ERRORS)
def test_led_errors_name_the_lights_file(make_sensor: MakeSensor, key: str, value: Any, rule: str) -> None:
    path = make_sensor(lights={key: value})
    with pytest.raises(SpecError) as caught:
        load_sensor(path)
    error = caught.value
    assert error.file == path.with_name("lights.toml")
    assert error.key == {"led[1].name": "led[0].name", "led[1].size_mm": error.key}.get(key, key)
    assert rule in str(error)
    assert value == [] or repr(value)[1:-1] in str(error)


def test_a_slab_keeps_camera_and_leds_out_of_the_plate(make_sensor: MakeSensor) -> None:
    slab = {"refraction.model": "slab", "refraction.plate_thickness_mm": 5.0}
    assert load_sensor(make_sensor({**slab, "refraction.plate_thickness_mm": 3.0})).refraction.model == "slab"
    for position in ([0.0, -8.0, -8.5], [0.0, -12.0, -8.5]):  # under the pad and beside it
        with pytest.raises(SpecError, match=r"below the slab's air face, z < -9 mm") as caught:
            load_sensor(make_sensor(slab, lights={"led[0].position_mm": position}))
        assert caught.value.file is not None and caught.value.file.name == "lights.toml"
        assert caught.value.key == "led[0].position_mm" and "reaches up to z = -8.053 mm" in str(caught.value)
    with pytest.raises(SpecError, match=r"camera.position_mm = .*must lie behind the gel, z < -9 mm"):
        load_sensor(make_sensor({**slab, "camera.position_mm": [0.0, 0.0, -8.9]}))


def test_a_led_may_not_dip_into_the_slab_with_one_corner(make_sensor: MakeSensor) -> None:
    """led[1] is centred at z = −8 mm and its corners are at −7.551 mm: a face between the two cuts it."""
    above = {"refraction.model": "slab", "refraction.plate_thickness_mm": 3.5}
    assert load_sensor(make_sensor(above))
    with pytest.raises(SpecError, match=r"led\[1\]\.position_mm = .*LED 'green' reaches up to z = -7\.551 mm"):
        load_sensor(make_sensor({**above, "refraction.plate_thickness_mm": 3.6}))


def test_the_mini_has_room_for_its_plate() -> None:
    mini = load_sensor("gelsight_mini")
    slab = dataclasses.replace(mini.refraction, model="slab")
    validate_sensor(dataclasses.replace(mini, refraction=slab))
    highest = max(corner[2] for led in mini.lights.leds for corner in led_corners(led))
    with pytest.raises(SpecError, match="below the slab's air face"):
        too_thick = -highest - mini.gelpad.thickness
        validate_sensor(dataclasses.replace(mini, refraction=dataclasses.replace(slab, plate_thickness=too_thick)))


@pytest.mark.parametrize("vignetting", [[-1.78, 1.17, 0.0], [0.5, -0.2, 0.0], [-3.9, 4.0, 0.0], [-0.9, 0.0, 0.0]])
def test_a_vignette_may_rise_again_while_it_leaves_light(make_sensor: MakeSensor, vignetting: list[float]) -> None:
    assert list(load_sensor(make_sensor({"response.vignetting": vignetting})).response.vignetting) == vignetting


def test_unknown_names_list_the_known_ones(make_sensor: MakeSensor, tmp_path: Path) -> None:
    with pytest.raises(SpecError, match=r"did you mean 'gelsight_mini'\? choose from: .*gelsight_dome"):
        load_sensor("gelsight_min")
    with pytest.raises(SpecError, match=r"did you mean 'gelsight_mini'\?"):
        load_sensor(make_sensor({"lights": "gelsight_mni"}))
    with pytest.raises(SpecError, match=r"nowhere\.toml: sensor = .*the file does not exist"):
        load_sensor(tmp_path / "nowhere.toml")
    with pytest.raises(SpecError, match=r"sensor = '~nobody-of-this-name/a.toml': the path has no meaning here"):
        load_sensor("~nobody-of-this-name/a.toml")
    with pytest.raises(SpecError, match=r"lamp\.toml: lights = 'lamp.toml': the file does not exist"):
        load_sensor(make_sensor({"lights": "lamp.toml"}))


def test_lights_are_found_beside_the_sensor_and_by_name(make_sensor: MakeSensor) -> None:
    beside = load_sensor(make_sensor(lights={"led[0].lobe": 3.0}))
    assert beside.lights.leds[0].lobe == 3.0
    named = load_sensor(make_sensor({"lights": "gelsight_mini"}))
    assert named.lights == load_lights("gelsight_mini")


def test_with_lights_checks_the_new_lights(make_sensor: MakeSensor) -> None:
    mini = load_sensor("gelsight_mini")
    assert with_lights(mini, mini.lights) == mini
    bad = dataclasses.replace(mini.lights.leds[0], position=(0.0, 0.0, -0.001))
    with pytest.raises(SpecError, match=r"led\[0\].position_mm = \[0.0, 0.0, -1.0\]: LED .* lies inside the gel"):
        with_lights(mini, dataclasses.replace(mini.lights, leds=(bad,)))


def test_validate_sensor_names_the_rule_for_a_sensor_made_in_code() -> None:
    mini = load_sensor("gelsight_mini")
    thin = dataclasses.replace(mini, gelpad=dataclasses.replace(mini.gelpad, thickness=3e-4), source=None)
    with pytest.raises(SpecError) as caught:
        validate_sensor(thin)
    assert caught.value.file is None and caught.value.key == "gelpad.dome_radius_mm"


UNIT = st.tuples(*[st.floats(-1, 1, allow_nan=False)] * 3).filter(lambda v: math.hypot(*v) > 0.1)
SIDE = st.floats(1e-4, 1e-2)


@given(UNIT, SIDE, SIDE)
def test_led_corners_are_the_rectangle_of_the_led(axis: tuple[float, float, float], a: float, b: float) -> None:
    norm = math.hypot(*axis)
    unit = (axis[0] / norm, axis[1] / norm, axis[2] / norm)
    position = (1e-3, 2e-3, -3e-3)
    led = LedSpec("l", "red", position, unit, (a, b), 1.0, (1.0, 0.0, 0.0))
    p, q, _, s = corners = led_corners(led)
    first, second = [[v - w for v, w in zip(end, p, strict=True)] for end in (q, s)]
    assert [sum(c[k] for c in corners) / 4 for k in range(3)] == pytest.approx(position, abs=1e-12)
    assert (math.hypot(*first), math.hypot(*second)) == pytest.approx((a, b), rel=1e-9)
    assert sum(v * w for v, w in zip(first, second, strict=True)) == pytest.approx(0, abs=1e-9 * a * b + 1e-15)
    assert first[2] == 0.0
    normal = [
        first[1] * second[2] - first[2] * second[1],
        first[2] * second[0] - first[0] * second[2],
        first[0] * second[1] - first[1] * second[0],
    ]
    assert [n / (a * b) for n in normal] == pytest.approx(unit, abs=1e-8)


def _on(folder: Path, name: str, base: str, rest: str = "") -> Path:
    path = folder / f"{name}.toml"
    path.write_text(f'base = "{base}"\n{rest}', "utf-8")
    return path


def test_a_sensor_is_its_base_but_for_what_it_gives(tmp_path: Path) -> None:
    """The last file that gives a table wins, over two bases: what ``raytac calibrate`` writes for a sensor that has one."""
    coat = "[coat]\nreflectance = [0.3, 0.3, 0.3]\nspecular = 0.0\nroughness = 0.4\n"
    _on(tmp_path, "first", "gelsight_mini", coat)
    second = load_sensor(_on(tmp_path, "second", "first.toml", 'lights = "gelsight_mini_calibrated"\n'))
    mini, calibrated = load_sensor("gelsight_mini"), load_sensor("gelsight_mini_calibrated")
    assert second.coat.reflectance == (0.3, 0.3, 0.3) != mini.coat.reflectance
    assert second.lights == calibrated.lights != mini.lights
    assert (second.gelpad, second.camera, second.response) == (mini.gelpad, mini.camera, mini.response)
    assert (second.name, second.source) == ("second", tmp_path / "second.toml")


@pytest.mark.parametrize("ring", [("own",), ("one", "two"), ("one", "two", "three")])
def test_bases_that_go_round_are_refused(tmp_path: Path, ring: tuple[str, ...]) -> None:
    for k, name in enumerate(ring):
        _on(tmp_path, name, f"{ring[(k + 1) % len(ring)]}.toml")
    with pytest.raises(SpecError, match="must be a sensor that is not built on this one"):
        load_sensor(tmp_path / f"{ring[0]}.toml")
    with pytest.raises(SpecError, match="not built on this one"):
        load_sensor(_on(tmp_path, "outside", f"{ring[-1]}.toml"))


def test_shadows_are_cast_unless_a_file_or_its_base_says_otherwise(tmp_path: Path) -> None:
    assert load_sensor("gelsight_mini").optics.shadows and not load_sensor("gelsight_mini_calibrated").optics.shadows
    first = _on(tmp_path, "first", "gelsight_mini", "[optics]\nshadows = false\n")
    assert not load_sensor(first).optics.shadows and not load_sensor(_on(tmp_path, "second", "first.toml")).optics.shadows
    text = (asset_root("scenes") / "sensors" / "gelsight_dome.toml").read_text("utf-8")
    (tmp_path / "plain.toml").write_text(text.split("[optics]")[0], "utf-8")
    assert load_sensor(tmp_path / "plain.toml").optics.shadows
    for value in ("0", '"no"', "[true]"):
        with pytest.raises(SpecError, match=r"bad\.toml: optics\.shadows = .*: must be true or false"):
            load_sensor(_on(tmp_path, "bad", "gelsight_mini", f"[optics]\nshadows = {value}\n"))


DIGITS = "9" * 5000


@pytest.mark.parametrize(
    "text",
    [
        f"[gelpad]\nthickness_mm = {DIGITS}",
        f"lights = 0x{'F' * 5000}",
        f"[gelpad]\nsize_mm = [{DIGITS}, 1]",
        "lights." + ".".join(["a"] * 5000) + " = 1",
        "gelpad.size_mm." + ".".join(["a"] * 5000) + " = 1",
        "lights = " + "[" * 5000 + "]" * 5000,
        "lights = " + "{a=" * 500 + "1" + "}" * 500,
        "x" * 10**5 + " = 1",
        "lights = '" + "y" * 10**6 + "'",
        "# " + "x" * 2**22,
        "lights = 2020-13-45",
    ],
    ids=lambda text: text[:30],
)
def test_numbers_tables_and_texts_without_measure_are_refused_in_a_sentence(text: str, tmp_path: Path) -> None:
    path = tmp_path / "s.toml"
    path.write_text(f'base = "gelsight_mini"\n{text}\n')
    with pytest.raises(SpecError, match=r"s\.toml: |lights = 'y") as caught:
        load_sensor(path)
    assert len(str(caught.value)) < 2500


def test_a_long_chain_of_bases_is_refused_in_a_sentence(tmp_path: Path) -> None:
    for i in range(3000):
        (tmp_path / f"c{i}.toml").write_text(f'base = "c{i + 1}.toml"\n')
    (tmp_path / "c3000.toml").write_text('base = "gelsight_mini"\n')
    with pytest.raises(SpecError, match=r"base = 'c\d+\.toml': a sensor must be built on at most 32 others") as caught:
        load_sensor(tmp_path / "c0.toml")
    assert len(str(caught.value)) < 500
    assert load_sensor(tmp_path / "c2980.toml").gelpad == load_sensor("gelsight_mini").gelpad


@pytest.mark.parametrize("name", [5, None, b"gelsight_mini", ["gelsight_mini"]])
def test_what_is_neither_name_nor_path_is_refused(name: Any) -> None:
    with pytest.raises(SpecError, match="must be a name or a path"):
        load_sensor(name)
