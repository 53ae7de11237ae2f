"""Observations: shapes as announced, values as the frame has them, stacks, differences, crops, failed environments, randomised cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from raytac.errors import InputError
from raytac.frame import TactileFrame
from raytac.gel.surface import GelSurface, make_grid
from raytac.gel.traction import cell_areas, foundation_traction
from raytac.markers import Fots, MarkerFrame, MarkerPerturbation
from raytac.observe import MODALITIES, ObservationSettings, Randomization, TactileObserver, gymnasium_space, randomised_sensor
from raytac.observe.observer import CellMeans
from raytac.observe.randomization import CameraDrift
from raytac.optics import RayTraced
from raytac.specs import load_sensor

SENSOR = load_sensor("gelsight_mini_9x11")
GRID = make_grid(SENSOR.gelpad, 0.4e-3)
B = 3


def frame(step: int = 0, failed: tuple[int, ...] = (), size: tuple[int, int] = (12, 8)) -> TactileFrame:
    """Numbers that tell environment and step apart."""
    rng = np.random.default_rng(step)
    height = np.repeat(GRID.rest[None], B, axis=0) - 1e-4 * (step + np.arange(B)[:, None, None])
    contact = np.zeros(height.shape, bool)
    contact[:, :10, :5] = True
    moved = rng.normal(0.0, 1e-4, (B, 99, 2))
    seen = rng.random((B, 99)) > 0.2
    moved[~seen] = np.nan
    flags = np.isin(np.arange(B), failed)
    height[flags], moved[flags] = np.nan, np.nan
    markers = MarkerFrame(moved, moved, np.zeros((B, 99, 3)), np.zeros((B, 99, 2)), np.zeros((B, 99, 3)), seen)
    surface = GelSurface(GRID, height.astype(np.float32), contact, np.zeros((B, 2)))
    wrench = np.where(flags[:, None], np.nan, np.arange(6.0) + step)
    rgb = rng.integers(0, 256, (B, size[1], size[0], 3), np.uint8)
    traction = foundation_traction(surface, wrench[:, :3], wrench[:, 5])
    return TactileFrame(surface, rgb=rgb, markers=markers, traction=traction, wrench=wrench, failed=flags)


def rows_of(whole: TactileFrame, rows: list[int]) -> TactileFrame:
    """A frame of some of its environments."""
    surface, markers = whole.surface, whole.markers
    assert markers is not None and whole.rgb is not None and whole.wrench is not None and whole.failed is not None
    return TactileFrame(
        traction=whole.traction[rows],
        surface=GelSurface(GRID, surface.height[rows], surface.contact[rows], surface.contact_centre[rows]),
        rgb=whole.rgb[rows],
        markers=MarkerFrame(*(values[rows] for values in vars(markers).values())),
        wrench=whole.wrench[rows],
        failed=whole.failed[rows],
    )


def observer(*modalities: str, randomization: Randomization | None = None, seed: int = 0, **settings) -> TactileObserver:
    made = ObservationSettings(modalities, **{"resolution": (12, 8), "crop": (0, 0, 0, 0), **settings})
    return TactileObserver(SENSOR, made, num_envs=B, randomization=randomization, seed=seed)


@pytest.mark.parametrize("stack", [1, 3])
def test_arrays_are_what_the_space_says(stack: int) -> None:
    seen = observer(*MODALITIES, stack=stack)
    found = seen.observe(frame())
    space = gymnasium_space(seen.arrays)
    for b in range(B):
        one = {name: values[b] for name, values in found.items()}
        assert space.contains(one)
    assert found["rgb"].shape == (B, 8, 12, 3 * stack) and found["rgb"].dtype == np.uint8


def test_values_are_the_frame_s_over_the_scale() -> None:
    given = frame(2)
    found = observer("markers", "marker_visible", "wrench", "indentation", "height", map_shape=GRID.shape).observe(given)
    assert given.markers is not None and given.wrench is not None
    shown = given.markers.visible
    np.testing.assert_allclose(found["markers"][shown], given.markers.displacement[shown] / 1e-3, rtol=1e-6)
    assert (found["markers"][~shown] == 0.0).all() and (found["marker_visible"] == shown).all() and not shown.all()
    np.testing.assert_allclose(found["wrench"], given.wrench / [10, 10, 10, 0.1, 0.1, 0.1], rtol=1e-6)
    np.testing.assert_allclose(found["indentation"][:, 0, 0], [0.2, 0.3, 0.4], atol=1e-4)
    si = observer("wrench", "height", normalise=False, map_shape=GRID.shape).observe(given)
    np.testing.assert_allclose(si["wrench"], given.wrench, rtol=1e-6)
    np.testing.assert_allclose(si["height"], given.surface.height, rtol=1e-6)


def test_cells_are_means_of_the_nodes_in_them() -> None:
    values = np.random.default_rng(0).normal(size=(2, 7, 10))
    means = CellMeans((7, 10), (3, 4))(values)
    rows, columns = [0, 2, 4, 7], [0, 2, 5, 7, 10]
    expected = [[values[0, rows[i] : rows[i + 1], columns[j] : columns[j + 1]].mean() for j in range(4)] for i in range(3)]
    np.testing.assert_allclose(means[0], expected)
    with pytest.raises(InputError, match="more rows"):
        CellMeans((7, 10), (8, 4))
    found = observer("contact", map_shape=(4, 5)).observe(frame())["contact"]
    assert GRID.shape == (53, 64) and found[0, 0, 0] == pytest.approx(10 * 5 / (13 * 12)) and found[0, -1, -1] == 0.0


def test_traction_adds_up_to_the_force() -> None:
    given = frame(2)
    seen = observer("traction", map_shape=GRID.shape, normalise=False)
    assert seen.sensor_options()["outputs"] == ("traction",)
    found = seen.observe(given)["traction"]
    total = (found * cell_areas(GRID)[None, ..., None]).sum(axis=(1, 2))
    np.testing.assert_allclose(total, given.wrench[:, :3], rtol=1e-4)
    coarse = observer("traction", map_shape=(4, 5)).observe(given)["traction"]
    assert coarse.shape == (B, 4, 5, 3) and np.abs(coarse[..., 2]).argmax(axis=(1)).max() == 0  # the contact is in a corner
    np.testing.assert_allclose(coarse[..., 2], 1e-4 * CellMeans(GRID.shape, (4, 5))(found[..., 2]), rtol=1e-5)


def test_stack_holds_the_last_frames_oldest_first_and_begins_anew_where_told() -> None:
    seen = observer("wrench", "rgb", stack=2, normalise=False)
    first, second, third = frame(0), frame(1), frame(2)
    assert (seen.observe(first)["wrench"][:, :, 0] == 0.0).all()
    found = seen.observe(second)
    np.testing.assert_array_equal(found["wrench"][0, :, 0], [0.0, 1.0])
    assert first.rgb is not None and second.rgb is not None and third.rgb is not None
    np.testing.assert_array_equal(found["rgb"], np.concatenate([first.rgb, second.rgb], axis=-1))
    seen.reset([1])
    found = seen.observe(third)
    np.testing.assert_array_equal(found["wrench"][:, :, 0], [[1.0, 2.0], [2.0, 2.0], [1.0, 2.0]])
    np.testing.assert_array_equal(found["rgb"][1], np.concatenate([third.rgb, third.rgb], axis=-1)[1])


def test_failed_environments_and_those_not_asked_keep_what_they_saw() -> None:
    seen = observer("wrench", "markers", normalise=False)
    seen.observe(frame(0))
    given = rows_of(frame(1, failed=(2,)), [0, 2])
    later = seen.observe(given, envs=np.array([True, False, True]))
    np.testing.assert_array_equal(later["wrench"][:, 0], [1.0, 0.0, 0.0])
    assert all(np.isfinite(values).all() for values in later.values())
    last = seen.last()
    assert last.keys() == later.keys() and all(np.array_equal(last[name], later[name]) for name in last)
    with pytest.raises(InputError, match="must have 1 environments"):
        seen.observe(given, envs=[1])
    broken = frame(1)
    assert broken.wrench is not None
    broken.wrench[1, 3] = np.inf
    with pytest.raises(InputError, match="environment 1"):
        seen.observe(broken)


def test_rows_may_come_in_any_order_and_twice() -> None:
    noisy = Randomization(noise=3.0, exposure=0.2)
    whole, some = (observer("rgb", "wrench", stack=2, randomization=noisy) for _ in range(2))
    for step in range(3):
        expected = whole.observe(frame(step))
        some.observe(rows_of(frame(step), [1]), envs=[1])
        found = some.observe(rows_of(frame(step), [2, 0, 0]), envs=[2, 0, 0])
    for name, values in expected.items():
        np.testing.assert_array_equal(found[name], values)


def test_crop_and_downscale_are_of_the_rendered_image() -> None:
    seen = observer("rgb", resolution=(4, 2), crop=(1, 1, 1, 1), downscale=2)
    assert seen.sensor_options()["resolution"] == (12, 8)
    given = frame()
    assert given.rgb is not None
    cut = given.rgb[:, 2:6, 2:10].astype(float)
    expected = cut.reshape(B, 2, 2, 4, 2, 3).mean(axis=(2, 4))
    assert np.abs(seen.observe(given)["rgb"] - expected).max() <= 0.5
    square = TactileObserver(SENSOR, ObservationSettings(("rgb",), resolution=(32, 32)))
    wide = square.layout.rendered
    assert wide[1] == 32 and wide[0] / wide[1] == pytest.approx(
        SENSOR.camera.resolution[0] / SENSOR.camera.resolution[1], rel=0.02
    )
    with pytest.raises(InputError, match="12x8"):
        seen.observe(frame(size=(10, 8)))


@pytest.mark.renderer
@pytest.mark.parametrize("settings", [{"resolution": (12, 12)}, {"crop": (3, 1, 2, 4), "downscale": 2, "difference": True}])
def test_only_the_crop_is_rendered_and_it_is_that_of_the_whole_image(settings: dict) -> None:
    made = ObservationSettings(("rgb",), **{"resolution": (16, 12), "optics": RayTraced(bounce=False), **settings})
    seen, of_whole = (TactileObserver("gelsight_mini", made) for _ in range(2))
    sensor, whole = seen.make_sensor(), of_whole.make_sensor(optics=made.optics)
    surface = sensor.press("sphere").surface
    cropped, given = sensor.update(surface).rgb, whole.update(surface).rgb
    assert cropped is not None and given is not None
    k, (width, height) = made.downscale, seen.layout.observed
    assert cropped.shape[1:3] == (k * height, k * width) and given.shape[1:3] == seen.layout.rendered[::-1]
    found, expected = seen.observe(sensor.update(surface), sensor), of_whole.observe(whole.update(surface), whole)
    np.testing.assert_array_equal(found["rgb"], expected["rgb"])
    assert len(np.unique(found["rgb"])) > 10


@pytest.mark.renderer
def test_difference_to_rest_with_a_real_sensor() -> None:
    settings = ObservationSettings(("rgb",), resolution=(16, 12), difference=True, optics="phong")
    seen = TactileObserver("gelsight_mini", settings)
    sensor = seen.make_sensor()
    assert (seen.observe(sensor.rest(), sensor)["rgb"] == 127).all()
    pressed = sensor.press("sphere")
    at_rest = sensor.rest().rgb
    assert pressed.rgb is not None and at_rest is not None
    expected = (255 + pressed.rgb.astype(int) - at_rest) // 2
    np.testing.assert_array_equal(seen.observe(pressed, sensor)["rgb"], expected)
    assert np.abs(expected - 127).max() > 5
    with pytest.raises(InputError, match="rest"):
        TactileObserver("gelsight_mini", settings).observe(pressed)


def test_cameras_differ_between_environments_and_repeat_by_seed() -> None:
    images = np.full((B, 4, 4, 3), 100, np.uint8)
    settings = Randomization(exposure=0.2, white_balance=0.1, gamma=0.05)
    one, same, other = (CameraDrift(SENSOR, settings, B, seed).apply(images) for seed in (7, 7, 8))
    np.testing.assert_array_equal(one, same)
    assert (one != other).any() and len({int(v) for v in one[:, 0, 0, 0]}) == B
    # Gains are of linear light, so with γ the image's own, u8 goes as the gain to the power 1/γ.
    drift = CameraDrift(SENSOR, Randomization(exposure=0.2), 1, 3)
    gain = 1.0 + 0.2 * np.random.default_rng((3, 0xCA3)).uniform(-1.0, 1.0, 5)[0]
    assert drift.apply(images[:1])[0, 0, 0, 0] == int(100 * gain ** (1.0 / SENSOR.response.gamma) + 0.5)
    np.testing.assert_array_equal(CameraDrift(SENSOR, Randomization(), B, 0).apply(images), images)
    # Under a tone curve too, and what is brighter than white saturates.
    bent = replace(SENSOR, response=replace(SENSOR.response, tone=(0.3, -0.1, 0.4)))
    curve, u = bent.response.curve, np.arange(256) / 255
    every = np.arange(256, dtype=np.uint8)[None, :, None, None].repeat(3, 3)
    np.testing.assert_array_equal(CameraDrift(bent, Randomization(), 1, 0).apply(every), every)
    linear = gain * curve.straight(u) ** bent.response.gamma
    expected = 255 * curve.bent(np.minimum(linear, 1) ** (1 / bent.response.gamma))
    seen = CameraDrift(bent, Randomization(exposure=0.2), 1, 3).apply(every)[0, :, 0, 0]
    assert np.abs(seen - expected).max() <= 0.51 and np.abs(seen - u * 255).max() > 3
    noisy = CameraDrift(SENSOR, Randomization(noise=3.0), B, 0).apply(np.full((B, 64, 64, 3), 100, np.uint8))
    assert noisy.std() == pytest.approx(3.0, rel=0.03) and noisy.mean() == pytest.approx(100.0, abs=0.1)
    # What an environment draws does not depend on how many there are, and reseeding restarts its stream.
    alone = CameraDrift(SENSOR, settings, 1, 8)
    np.testing.assert_array_equal(alone.apply(images[:1])[0], one[1])
    alone.reseed([0], [7])
    alone.reset([0])
    np.testing.assert_array_equal(alone.apply(images[:1])[0], one[0])


def test_sensors_are_drawn_once_by_seed_within_their_ranges() -> None:
    settings = Randomization(led_power=0.2, led_colour=0.1, reflectance=0.1, youngs_modulus=0.3, friction=0.2)
    one, same, other = (randomised_sensor(SENSOR, settings, seed) for seed in (1, 1, 2))
    assert one == same != other and randomised_sensor(SENSOR, Randomization(exposure=0.5), 1) is SENSOR
    for led, at in zip(one.lights.leds, SENSOR.lights.leds, strict=True):
        ratio = np.asarray(led.power)[np.asarray(at.power) > 0] / np.asarray(at.power)[np.asarray(at.power) > 0]
        assert (np.abs(np.log(ratio)) < np.log(1.0 / 0.8 / 0.9)).all() and (ratio != 1.0).all()
    assert 0.7 < one.gelpad.youngs_modulus / SENSOR.gelpad.youngs_modulus < 1.3
    assert TactileObserver(SENSOR, randomization=settings, seed=1).sensor == one


def test_a_perturbation_is_given_once() -> None:
    own = ObservationSettings(markers=Fots(MarkerPerturbation(dropout=0.1)))
    assert TactileObserver(SENSOR, own).sensor_options()["markers"] == own.markers
    with pytest.raises(InputError, match=r"randomization\.markers.*one of the two"):
        TactileObserver(SENSOR, own, randomization=Randomization(markers=MarkerPerturbation(noise_px=0.5)))
    with pytest.raises(InputError, match="did you mean 'fots'"):
        ObservationSettings(markers="fotz")


def test_marker_perturbation_reaches_the_sensor() -> None:
    seen = TactileObserver(SENSOR, randomization=Randomization(markers=MarkerPerturbation(noise_px=0.5)))
    assert seen.sensor_options()["markers"].perturbation.noise_px == 0.5
    assert TactileObserver(SENSOR, ObservationSettings(("wrench",))).sensor_options()["markers"] is None


def test_tensors_share_memory() -> None:
    torch = pytest.importorskip("torch")
    from raytac.observe import as_tensors

    found = observer("wrench", "rgb").observe(frame())
    tensors = as_tensors(found)
    assert tensors["rgb"].dtype == torch.uint8 and tensors["rgb"].shape == found["rgb"].shape
    found["wrench"][0, 0] = 123.0
    assert float(tensors["wrench"][0, 0]) == 123.0


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"modalities": ("touch",)}, "choose from"),
        ({"modalities": ()}, "one or more"),
        ({"modalities": ("rgb", "rgb")}, "none twice"),
        ({"modalities": ("rgb",), "resolution": (0, 32)}, "resolution"),
        ({"modalities": ("rgb",), "crop": (1, 2, 3)}, "crop"),
        ({"stack": 0}, "stack"),
        ({"map_shape": (0, 3)}, "map_shape"),
        ({"difference": True}, "rgb"),
        ({"scales": {"markers": -1.0}}, "positive"),
        ({"scales": {"rgb": 1.0}}, "has a unit"),
    ],
)
def test_wrong_settings_are_told_at_once(settings: dict, text: str) -> None:
    with pytest.raises(InputError, match=text):
        ObservationSettings(**settings)


def test_what_a_sensor_or_frame_lacks_is_told() -> None:
    with pytest.raises(InputError, match="markers"):
        TactileObserver("gelsight_mini", ObservationSettings(("markers",)))
    seen = observer("wrench")
    with pytest.raises(InputError, match="must have 2 environments"):
        TactileObserver(SENSOR, ObservationSettings(("wrench",)), num_envs=2).observe(frame())
    with pytest.raises(InputError, match="wrench"):
        seen.observe(frame().with_values(wrench=None))
    with pytest.raises(InputError, match="exposure"):
        Randomization(exposure=1.5)
