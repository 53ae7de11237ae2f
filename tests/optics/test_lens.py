"""Distortion, tilt and a camera without colours: the same rays and projections in every optical mode, or an error."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from raytac.errors import InputError, SpecError
from raytac.markers.pattern import MarkerPattern
from raytac.optics.base import OpticsImages
from raytac.optics.camera import Pinhole
from raytac.optics.grain import Grain
from raytac.optics.image.config import Mlp, Phong
from raytac.optics.image.mlp_weights import INPUTS, MlpWeights
from raytac.optics.image.network_files import look_digest
from raytac.optics.image.phong import PhongMode
from raytac.optics.image.unet_weights import load_unet
from raytac.optics.taxim.bake.bake import bake
from raytac.optics.taxim.bake.settings import BakeSettings
from raytac.optics.taxim.config import Taxim
from raytac.optics.trace.fast_tracer import total
from raytac.specs import load_sensor, validate_sensor
from raytac.specs.lens import Lens
from raytac.specs.sensor import CameraSpec, MarkerSpec, NoiseSpec, SensorSpec
from tests.optics.conftest import Build
from tests.optics.images import assert_images_agree, psnr_db
from tests.optics.scenes import RESOLUTION, at_rest, ball, built, grid_of, like_a_mini, surface

BARREL = (-0.35, 0.12, 0.004, -0.006)
TILT = (0.0, np.radians(12.0), np.radians(5.0))
PIXEL = np.random.default_rng(3).uniform(0, 1, (2000, 2))


def camera_spec(distortion: tuple[float, ...] = BARREL, tilt: tuple[float, ...] = TILT) -> CameraSpec:
    return CameraSpec((320, 240), (5e-5, 6.5e-5), (-2e-3, -0.4e-3, -25e-3), (151.0, 123.0), distortion, tilt)  # type: ignore[arg-type]


def with_camera(spec: SensorSpec, **changes: Any) -> SensorSpec:
    return replace(spec, camera=replace(spec.camera, **changes))


@pytest.fixture(scope="module")
def spec() -> SensorSpec:
    """A Mini whose view leaves room for what bends and turns it."""
    return with_camera(like_a_mini(), pixel_pitch=(5e-5, 5e-5))


@pytest.fixture(scope="module")
def odd(spec: SensorSpec) -> SensorSpec:
    """The same with a barrel lens that looks to a side."""
    tilted = with_camera(spec, distortion=BARREL, tilt=TILT, position=(-5e-3, 0.5e-3, -25e-3))
    validate_sensor(tilted)
    return tilted


@pytest.fixture(scope="module")
def pressed(tracer: Build, odd: SensorSpec) -> OpticsImages:
    grid = grid_of(odd)
    height, contact = ball(grid, radius=4e-3, depth=0.8e-3, centre=(1e-3, -1e-3))
    return tracer(odd, outputs=("normals", "depth")).render(surface(grid, height, contact=contact))


def opencv(point: np.ndarray, spec: CameraSpec, rotation: np.ndarray) -> np.ndarray:
    """Pixel of a point (3,) as the documentation of ``cv::projectPoints`` writes them down."""
    k1, k2, p1, p2 = spec.distortion
    x, y, z = (point - np.array(spec.position)) @ rotation
    x, y = x / z, y / z
    r2 = x**2 + y**2
    xd = x * (1 + k1 * r2 + k2 * r2**2) + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    yd = y * (1 + k1 * r2 + k2 * r2**2) + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
    return np.stack([spec.focal[0] * xd + spec.principal_point[0], spec.focal[1] * yd + spec.principal_point[1]], -1)


def test_projection_is_that_of_opencv() -> None:
    spec = camera_spec()
    points = np.column_stack([16e-3 * (PIXEL - 0.5), np.linspace(-2e-3, 0, len(PIXEL))])
    angle = np.linalg.norm(TILT)
    x, y, z = np.array(TILT) / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    rotation = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    expected = np.stack([opencv(point, spec, rotation) for point in points])
    np.testing.assert_allclose(Pinhole.from_spec(spec).project(points), expected, atol=1e-9)


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_rays_and_projection_are_inverse(data: st.DataObject) -> None:
    number = st.floats
    distortion = tuple(data.draw(number(-limit, limit)) for limit in (0.3, 0.1, 0.01, 0.01))
    tilt = tuple(data.draw(number(-0.4, 0.4)) for _ in range(3))
    spec = camera_spec(distortion, tilt)
    camera = Pinhole.from_spec(spec, (160, 120))
    u, v = 160 * data.draw(number(0, 1)), 120 * data.draw(number(0, 1))
    z = data.draw(number(-3e-3, 0))
    origin, (tx, ty) = camera.ray(u, v)
    point = np.array([origin[0] + (z - origin[2]) * tx, origin[1] + (z - origin[2]) * ty, z])
    np.testing.assert_allclose(camera.project(point), (u, v), atol=1e-5)


def test_the_pitch_holds_where_the_axis_meets_the_gel() -> None:
    spec = camera_spec()
    camera = Pinhole.from_spec(spec)
    middle = np.array([*spec.centre, 0.0])
    np.testing.assert_allclose(camera.project(middle), spec.principal_point, atol=1e-9)
    across = np.array([row[0] for row in spec.lens.rotation])  # the image's x in the pad frame
    step = camera.project(middle + 1e-6 * across) - camera.project(middle)
    np.testing.assert_allclose(step, [1e-6 / spec.pixel_pitch[0], 0], atol=1e-7)
    assert camera.depth(middle) == pytest.approx(np.linalg.norm(middle - spec.position))


def test_no_distortion_and_no_tilt_change_no_bit() -> None:
    plain = camera_spec((0.0,) * 4, (0.0,) * 3)
    camera, (u, v) = Pinhole.from_spec(plain), 300 * PIXEL.T
    by_hand = (u - camera.principal[0]) / camera.focal[0], (v - camera.principal[1]) / camera.focal[1]
    assert all((a == b).all() for a, b in zip(camera.slope(u, v), by_hand, strict=True))
    assert camera.focal == (25e-3 / 5e-5, 25e-3 / 6.5e-5)
    assert plain.centre == plain.position[:2] and plain == CameraSpec(*(getattr(plain, n) for n in plain.__match_args__[:4]))
    points = np.column_stack([PIXEL, PIXEL[:, 0]]).astype(np.float32)
    assert (camera.depth(points) == points[:, 2] - plain.position[2]).all()


def test_a_small_turn_is_no_jump() -> None:
    """What is written twice, with and without tilt, is one function: at a turn of 1e-9 both agree."""
    straight, turned = (Pinhole.from_spec(camera_spec((0.0,) * 4, (t, -t, t))) for t in (0.0, 1e-9))
    for a, b in zip(straight.slope(*(240 * PIXEL.T)), turned.slope(*(240 * PIXEL.T)), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-8)


def test_pixels_see_what_projects_to_them(pressed: OpticsImages, tracer: Build, odd: SensorSpec) -> None:
    assert pressed.position is not None and pressed.normals is not None and pressed.depth is not None
    camera = tracer(odd, outputs=("normals", "depth")).camera
    p = pressed.position[0].astype(float)
    v, u = np.indices(p.shape[:2]) + 0.5
    np.testing.assert_allclose(camera.project(p), np.stack([u, v], axis=-1), atol=2e-3)
    np.testing.assert_allclose(pressed.depth[0], (p - odd.camera.position) @ np.array(odd.camera.lens.axis), atol=1e-8)
    from_centre = p - np.array([1e-3, -1e-3, 4e-3 - 0.8e-3])
    inside = np.hypot(from_centre[..., 0], from_centre[..., 1]) < 1.2e-3
    assert inside.sum() > 40
    radial = from_centre / np.linalg.norm(from_centre, axis=-1, keepdims=True)
    off = np.degrees(np.arccos(np.clip((pressed.normals[0] * radial)[inside].sum(-1), -1, 1)))
    assert off.max() < 0.4


def test_fast_is_the_path_tracer_with_a_lens(tracer: Build, tmp_path: Path, odd: SensorSpec) -> None:
    grid = grid_of(odd, 0.2e-3)
    press = surface(grid, ball(grid, radius=4e-3, depth=0.8e-3, centre=(1e-3, -1e-3))[0])
    expected = total(tracer(odd, integrator="reference", max_depth=1, spp=256, pitch=0.2e-3).render_layers(press))[0]
    fine = total(tracer(odd, bounce=False, led_points=2, pitch=0.2e-3, resolution=(160, 120)).render_layers(press))[0]
    actual = fine.reshape(60, 2, 80, 2, 3).mean((1, 3))
    assert_images_agree(actual, expected, tmp_path, mean=6e-3)
    straight = total(
        tracer(with_camera(odd, tilt=(0.0,) * 3, position=(0.0, 0.0, -25e-3)), bounce=False, pitch=0.2e-3).render_layers(press)
    )[0]
    assert np.abs(straight / expected.mean() - expected / expected.mean()).mean() > 0.05  # the lens shows


def test_height_images_meet_the_same_points(pressed: OpticsImages, odd: SensorSpec) -> None:
    assert pressed.position is not None
    grid = grid_of(odd)
    height, contact = ball(grid, radius=4e-3, depth=0.8e-3, centre=(1e-3, -1e-3))
    grey = np.full((60, 80, 3), 128, np.uint8)
    mode = built(Phong, odd, background=grey)
    assert isinstance(mode, PhongMode)
    heights, _ = mode.image_heights(surface(grid, height, contact=contact))
    z = -heights[0] * mode.pitch[0]
    off = np.abs(z - pressed.position[0][..., 2])
    assert np.percentile(off, 99) < 3e-6 and off.max() < 60e-6  # the rim of the ball, where two Newton steps end early


def test_a_table_baked_for_a_lens_is_near_its_ray_tracer(tracer: Build, odd: SensorSpec) -> None:
    table = bake(odd, device="cpu", resolution=RESOLUTION, settings=BakeSettings(images=40, n_bins=45, pins=0)).table
    grid = grid_of(odd)
    height, contact = ball(grid, radius=4e-3, depth=0.6e-3, centre=(1e-3, -1e-3))
    press = surface(grid, height, contact=contact)
    traced, rest = tracer(odd).render(press).rgb[0], tracer(odd).render(at_rest(grid_of(odd))).rgb[0]
    drawn = built(Taxim, odd, calibration=table, shadows=False).render(press).rgb[0]
    assert psnr_db(drawn, traced) > psnr_db(rest, traced) + 6
    assert psnr_db(drawn, traced) > 30


def test_markers_are_drawn_where_they_project(tracer: Build, odd: SensorSpec) -> None:
    dotted = replace(odd, markers=MarkerSpec(3, 4, (2.4e-3, 2.4e-3), (0.0, 0.0), 0.5e-3, 0.02))
    pattern = MarkerPattern.of(dotted, (160, 120))
    grid = grid_of(dotted, 0.1e-3)
    x, y = np.meshgrid(grid.x, grid.y)
    distance = np.min([np.hypot(x - a, y - b) for a, b, _ in pattern.rest[0]], axis=0)
    ink = (distance < 0.5e-3).astype(np.float32)
    inked = replace(surface(grid, grid.rest), ink=ink[None])
    image = total(tracer(dotted, bounce=False, pitch=0.1e-3, resolution=(160, 120)).render_layers(inked))[0].sum(-1)
    plain = total(tracer(dotted, bounce=False, pitch=0.1e-3, resolution=(160, 120)).render_layers(surface(grid, grid.rest)))[
        0
    ].sum(-1)
    dark = 1 - image / plain
    v, u = np.indices(dark.shape) + 0.5
    for at_u, at_v in pattern.pixel[0]:
        near = np.hypot(u - at_u, v - at_v) < 9
        weight = dark[near].sum()
        assert (dark[near] * u[near]).sum() / weight == pytest.approx(at_u, abs=0.25)
        assert (dark[near] * v[near]).sum() / weight == pytest.approx(at_v, abs=0.25)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"distortion": (-2.0, 0.0, 0.0, 0.0), "position": (0.0, 0.0, -8e-3)}, "must have an inverse over the whole image"),
        ({"tilt": (np.radians(55.0), np.radians(55.0), 0.0)}, "must be at most 60"),
        ({"tilt": (0.0, np.radians(30.0), 0.0)}, r"camera\.tilt_deg.*runs off the pad"),
    ],
)
def test_cameras_that_cannot_see_the_pad_are_refused(spec: SensorSpec, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(SpecError, match=message):
        validate_sensor(with_camera(spec, **changes))


def test_a_lens_behind_a_slab_is_refused(odd: SensorSpec) -> None:
    behind = replace(odd, refraction=replace(odd.refraction, model="slab"))
    with pytest.raises(SpecError, match=r"camera\.tilt_deg.*slab"):
        validate_sensor(behind)
    with pytest.raises(SpecError, match=r"camera\.distortion.*slab"):
        validate_sensor(with_camera(behind, tilt=(0.0, 0.0, 0.0)))


def test_networks_refuse_a_lens(odd: SensorSpec) -> None:
    weights = MlpWeights((np.zeros((3, INPUTS), np.float32),), (np.zeros(3, np.float32),), np.zeros((60, 80, 3), np.float32))
    with pytest.raises(InputError, match="cannot show the distortion or tilt"):
        built(Mlp, odd, weights=weights)


def test_shipped_networks_know_their_sensor_still() -> None:
    """New keys of a camera, at their defaults, do not change the digest of a look; other values do."""
    shipped = load_unet(Path(__file__).parents[2] / "scenes" / "networks" / "gelsight_mini_unet.npz")
    mini = load_sensor("gelsight_mini")
    assert look_digest(mini) == shipped.provenance["look"]
    assert look_digest(with_camera(mini, distortion=(-0.01, 0.0, 0.0, 0.0))) != shipped.provenance["look"]


@pytest.mark.parametrize("integrator", ["fast", "reference"])
def test_a_monochrome_image_is_the_mean_of_the_channels(tracer: Build, spec: SensorSpec, integrator: str) -> None:
    grey = with_camera(spec, monochrome=True)
    grid = grid_of(spec)
    press = surface(grid, ball(grid)[0])
    options = {"integrator": integrator, "spp": 16} if integrator == "reference" else {}
    mode = tracer(grey, outputs=("rgb", "layers"), **options)
    images = mode.render(press)
    assert images.rgb is not None and images.layers is not None
    assert (images.rgb == images.rgb[..., :1]).all()
    response = grey.response
    signal = total(images.layers) * mode.response.scale + np.array(response.black_level)
    expected = 255 * np.clip(signal.mean(-1), 0, 1) ** (1 / response.gamma)
    assert np.abs(images.rgb[..., 0] - expected).max() <= 0.51
    assert np.ptp(images.rgb) > 20


def test_a_flat_field_holds_for_a_monochrome_camera(tracer: Build, spec: SensorSpec) -> None:
    grey = with_camera(spec, monochrome=True)
    field = np.broadcast_to(np.linspace(60, 150, 80).astype(np.uint8)[None, :, None], (60, 80, 3)).copy()
    mode = built(type(tracer(grey).config), grey, flat_field=field)
    rgb = mode.render(at_rest(grid_of(grey))).rgb
    assert rgb is not None and np.abs(rgb[0].astype(int) - field).max() <= 1


def test_other_modes_of_a_monochrome_sensor_are_grey(spec: SensorSpec) -> None:
    grey = with_camera(spec, monochrome=True)
    grid = grid_of(spec)
    height, contact = ball(grid)
    press = surface(grid, height, contact=contact)
    colours = np.stack([np.full((60, 80), level, np.uint8) for level in (40, 90, 170)], -1)
    one, three = (built(Phong, s, background=colours).render_levels(press)[0] for s in (grey, spec))
    np.testing.assert_allclose(one, np.broadcast_to(three.mean(-1, keepdims=True), three.shape), atol=1e-3)
    weights = MlpWeights((np.ones((3, INPUTS), np.float32),), (np.zeros(3, np.float32),), colours.astype(np.float32))
    drawn = built(Mlp, grey, weights=weights).render(press).rgb
    assert drawn is not None and (drawn == drawn[..., :1]).all()


def test_grain_of_a_monochrome_camera_is_grey(spec: SensorSpec) -> None:
    grey = replace(with_camera(spec, monochrome=True), noise=NoiseSpec((4.0, 4.0, 4.0), (4.0, 4.0, 4.0)))
    image = np.full((1, 240, 320, 3), 100, np.uint8)
    grain = Grain(grey, grey.camera.resolution, seed=1, batch=1)
    noisy = grain.added(image, grain.seeds())
    assert (noisy == noisy[..., :1]).all() and noisy.std() == pytest.approx(2.0, rel=0.05)


def test_lens_keeps_its_determinant() -> None:
    """``determinant`` is the area by finite differences of the distortion."""
    lens, (x, y), d = Lens(BARREL), PIXEL.T - 0.5, 1e-6
    along = [
        np.subtract(lens.image(x + d * a, y + d * b), lens.image(x - d * a, y - d * b)) / (2 * d) for a, b in ((1, 0), (0, 1))
    ]
    np.testing.assert_allclose(along[0][0] * along[1][1] - along[0][1] * along[1][0], lens.determinant(x, y), atol=1e-7)
