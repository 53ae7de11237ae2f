"""Camera, normals, positions and depth against geometry."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates

from raytac.optics.base import OpticsImages
from raytac.optics.camera import Pinhole
from raytac.optics.trace.fast_tracer import total
from raytac.specs.sensor import CameraSpec, SensorSpec
from tests.optics.conftest import Build
from tests.optics.images import assert_images_agree
from tests.optics.scenes import at_rest, ball, grid_of, led, like_a_mini, plateau, sensor, surface
from tests.optics.test_closed_form import radiance

BALL: dict[str, Any] = {"radius": 4e-3, "depth": 0.8e-3, "centre": (1.5e-3, -1e-3)}
OUTPUTS = ("normals", "depth")
PIXEL = 0.3e-3
"""A little more than a pixel at the tests' resolution [m]."""


@pytest.fixture(scope="module")
def spec() -> SensorSpec:
    return like_a_mini()


@pytest.fixture(scope="module")
def pressed(tracer: Build, spec: SensorSpec) -> OpticsImages:
    grid = grid_of(spec)
    height, contact = ball(grid, **BALL)
    return tracer(spec, outputs=OUTPUTS).render(surface(grid, height, contact=contact))


def test_normals_are_unit_and_face_the_camera(pressed: OpticsImages) -> None:
    assert pressed.normals is not None and pressed.normals.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(pressed.normals, axis=-1), 1, atol=1e-5)
    assert pressed.normals[..., 2].max() < 0


def test_normals_in_the_imprint_are_those_of_the_ball(pressed: OpticsImages) -> None:
    assert pressed.normals is not None and pressed.position is not None
    # The pixels whose cell and its neighbours all touch the ball.
    centre = np.array([*BALL["centre"], BALL["radius"] - BALL["depth"]])
    to_axis = np.linalg.norm(pressed.position[0][..., :2] - centre[:2], axis=-1)
    inside = to_axis < 1.2e-3
    assert inside.sum() > 40
    expected = pressed.position[0][inside] - centre
    expected /= np.linalg.norm(expected, axis=-1, keepdims=True)
    angle = np.degrees(np.arccos(np.clip((expected * pressed.normals[0][inside]).sum(-1), -1, 1)))
    assert angle.max() < 0.3, f"{angle.max():.3f} degrees"
    # The ball is convex towards the camera: normals lean outwards, by asin(r / R).
    lean = np.degrees(np.arccos(-pressed.normals[0][inside][:, 2]))
    np.testing.assert_allclose(lean, np.degrees(np.arcsin(to_axis[inside] / BALL["radius"])), atol=0.3)


def test_depth_is_along_the_camera_axis(pressed: OpticsImages, spec: SensorSpec) -> None:
    assert pressed.depth is not None and pressed.position is not None
    np.testing.assert_allclose(pressed.depth, pressed.position[..., 2] - spec.camera.position[2], atol=2e-9)
    assert pressed.depth.min() == pytest.approx(28e-3 - BALL["depth"], abs=2e-5)


def test_positions_lie_on_the_surface_and_on_the_pixels_ray(tracer: Build, pressed: OpticsImages, spec: SensorSpec) -> None:
    assert pressed.position is not None
    grid = grid_of(spec)
    p = pressed.position[0].astype(float)
    rows, columns = (p[..., 1] - grid.y[0]) / grid.pitch[1], (p[..., 0] - grid.x[0]) / grid.pitch[0]
    height = map_coordinates(ball(grid, **BALL)[0], [rows, columns], order=1)
    assert np.abs(p[..., 2] - height).max() < 1e-6
    camera = tracer(spec, outputs=OUTPUTS).camera
    v, u = np.indices(p.shape[:2]) + 0.5
    np.testing.assert_allclose(camera.project(p), np.stack([u, v], axis=-1), atol=2e-3)


def test_a_steep_wall_hides_what_is_behind_it(tracer: Build) -> None:
    """Seen from above the centre, a wall that falls away from the centre hides a strip: the ray's first meeting counts."""
    spec = sensor([led("one", (0.0, -11e-3, -9e-3))])
    grid = grid_of(spec)
    height = plateau(grid, 1.5e-3, 6e-3)
    images = tracer(spec, outputs=OUTPUTS, bounce=False).render(surface(grid, height))
    assert images.position is not None
    edge = float(grid.x[grid.x <= 6e-3 + 1e-9].max())
    x, z = images.position[0, 30, :, 0], images.position[0, 30, :, 2]
    # A camera ray over the edge meets z = 0 here; between the foot of the wall and there is nothing to be seen.
    lands = edge * 28 / (28 - 1.5)
    seen = x[(z > -1e-5)]
    assert seen.min() > lands - 1e-5 and (np.diff(x) > 0).all()
    assert np.abs(z[x < edge] + 1.5e-3).max() < 1e-6


def test_contact_is_seen_where_it_is(pressed: OpticsImages, spec: SensorSpec) -> None:
    assert pressed.contact is not None and pressed.position is not None
    grid = grid_of(spec)
    _, contact = ball(grid, **BALL)
    radius = np.sqrt(contact.sum() * np.prod(grid.pitch) / np.pi)
    distance = np.linalg.norm(pressed.position[0][..., :2] - BALL["centre"], axis=-1)
    np.testing.assert_array_equal(pressed.contact[0][distance < radius - PIXEL], True)
    np.testing.assert_array_equal(pressed.contact[0][distance > radius + PIXEL], False)


@settings(max_examples=50, deadline=None)
@given(data=st.data())
def test_pinhole_round_trip(data: st.DataObject) -> None:
    number = st.floats
    width, height = data.draw(st.integers(8, 640)), data.draw(st.integers(8, 480))
    spec = CameraSpec(
        resolution=(320, 240),
        pixel_pitch=(data.draw(number(2e-5, 1e-4)), data.draw(number(2e-5, 1e-4))),
        position=(data.draw(number(-2e-3, 2e-3)), data.draw(number(-2e-3, 2e-3)), data.draw(number(-5e-2, -1e-2))),
        principal_point=(data.draw(number(100, 220)), data.draw(number(80, 160))),
    )
    camera = Pinhole.from_spec(spec, (width, height))
    u, v = data.draw(number(0, 1)) * width, data.draw(number(0, 1)) * height
    z = data.draw(number(-3e-3, 0))
    tx, ty = camera.slope(u, v)
    depth = z - spec.position[2]
    p = np.array([spec.position[0] + depth * tx, spec.position[1] + depth * ty, z])
    np.testing.assert_allclose(camera.project(p), (u, v), atol=1e-8)
    if z == 0:
        assert tx * depth == pytest.approx((u / width * 320 - spec.principal_point[0]) * spec.pixel_pitch[0])


def test_pixel_centres_on_the_plane() -> None:
    camera = Pinhole.from_spec(CameraSpec((320, 240), (6e-5, 7e-5), (1e-3, 0.0, -28e-3), (150.0, 130.0)), (160, 120))
    x, y = camera.pixel_centres_on_plane()
    np.testing.assert_allclose(x, 1e-3 + (2 * np.arange(160) + 1 - 150) * 6e-5, atol=1e-12)
    np.testing.assert_allclose(y, (2 * np.arange(120) + 1 - 130) * 7e-5, atol=1e-12)


ODD = CameraSpec((320, 240), (5e-5, 6.5e-5), (0.7e-3, -0.4e-3, -25e-3), (131.0, 143.0))
"""Principal point off centre, pixels that are not square, pinhole off the axis."""


@pytest.mark.parametrize(
    "options", [{"bounce": False}, {"integrator": "reference", "max_depth": 1, "spp": 64}], ids=["fast", "reference"]
)
def test_every_integrator_honours_an_odd_camera(tracer: Build, tmp_path: Path, options: dict) -> None:
    spec = sensor([led("one", (-12e-3, 4e-3, -5e-3), lobe=2.0)], camera=ODD)
    mode = tracer(spec, **options)
    image = total(mode.render_layers(at_rest(grid_of(spec))))[0]
    exact = options.get("integrator") is None
    assert_images_agree(image, radiance(spec, mode.camera.resolution), tmp_path, mean=1e-6 if exact else 5e-3)
    centred = radiance(replace(spec, camera=replace(ODD, principal_point=(160.0, 120.0))), mode.camera.resolution)
    assert np.abs(image - centred).mean() > 0.05 * image.mean()
