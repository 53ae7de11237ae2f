"""Orientation of what a sensor observes: an object at +x, +y is at the lower right in image, markers, difference and panel."""

from __future__ import annotations

import numpy as np
import pytest

from raytac.envs.environments import magnified_difference, marker_panel
from raytac.sensor import TactileSensor

RESOLUTION = (80, 60)
SIDE = 240
"""Longer side of a panel [px]."""


@pytest.fixture(scope="module")
def sensor() -> TactileSensor:
    return TactileSensor("gelsight_mini_9x11", optics="phong", markers="fots", resolution=RESOLUTION, device="cpu")


def place(change: np.ndarray) -> tuple[float, float]:
    """Centroid of the strongest changes (H, W, 3), as a share of width and height from the middle, right and down: −0.5 to 0.5."""
    size = np.abs(change).sum(axis=2)
    weight = np.where(size > size.max() / 3, size, 0) / 1.0
    v, u = (np.indices(weight.shape) * weight).sum(axis=(1, 2)) / weight.sum()
    return float((u + 0.5) / weight.shape[1] - 0.5), float((v + 0.5) / weight.shape[0] - 0.5)


def source(points: np.ndarray, displacements: np.ndarray) -> np.ndarray:
    """Point (2,) from which displacements of points (M, 2) lead away, as the markers around a ball do, by least squares."""
    length = np.linalg.norm(displacements, axis=1)
    strong = length > length.max() / 2
    across = displacements[strong][:, ::-1] * (1.0, -1.0)
    result = np.linalg.lstsq(across, (across * points[strong]).sum(axis=1), rcond=None)[0]
    assert ((points - result) * displacements)[strong].sum() > 0.0, "they lead to it"
    return result


# An image that is turned, mirrored or transposed shows at least one of these places elsewhere.
@pytest.mark.parametrize("xy", [(5e-3, 2.5e-3), (-5e-3, 2.5e-3), (4e-3, -3e-3)])
def test_an_object_is_where_it_was_pressed_in_image_markers_difference_and_panel(
    sensor: TactileSensor, xy: tuple[float, float]
) -> None:
    frame, rest = sensor.press("sphere", depth=0.8e-3, offset=xy), sensor.rest().rgb[0]
    image, markers = frame.rgb[0], frame.markers
    view = np.array(sensor.spec.camera.pitch_at(RESOLUTION)) * RESOLUTION
    in_view, on_pad = tuple(xy / view), tuple(xy / np.array(sensor.spec.gelpad.size))
    assert place(image.astype(int) - rest) == pytest.approx(in_view, abs=0.05)
    displacement, positions = markers.displacement[0], markers.rest[0, :, :2]
    assert tuple(source(positions, displacement) / view) == pytest.approx(in_view, abs=0.02)
    # Pressed markers come nearer to the camera, which moves them away from the image's middle; under the ball they do nothing else.
    length = np.linalg.norm(displacement, axis=1)
    beside = length > length.max() / 2
    in_image = source(markers.rest_px[0][beside], markers.displacement_px[0][beside]) / RESOLUTION - 0.5
    assert (in_image * np.sign(xy) > 0.03).all(), in_image

    still = np.zeros_like(displacement)
    plain = marker_panel(sensor.spec, positions, still, SIDE).astype(int)
    longest = np.linalg.norm(displacement, axis=1).argmax()  # beside the ball
    arrow = marker_panel(sensor.spec, positions, np.where(np.arange(len(positions))[:, None] == longest, displacement, 0.0), SIDE)
    middle = (positions[longest] + 2.0 * displacement[longest]) / np.array(sensor.spec.gelpad.size)
    assert place(arrow - plain) == pytest.approx(tuple(middle), abs=0.02)
    behind, unpressed = (
        marker_panel(sensor.spec, positions, still, SIDE, behind=magnified_difference(seen, rest)) for seen in (image, rest)
    )
    assert place(behind.astype(int) - unpressed) == pytest.approx(on_pad, abs=0.05)


@pytest.mark.parametrize("axis", [0, 1])
def test_an_arrow_points_where_the_marker_moves(sensor: TactileSensor, axis: int) -> None:
    """To the right along +x and down along +y, four times as long as the displacement."""
    moved = np.zeros((1, 2))
    moved[0, axis] = 1e-3
    panel, still = (marker_panel(sensor.spec, np.zeros((1, 2)), displacement, SIDE) for displacement in (moved, 0 * moved))
    drawn = np.argwhere((panel != still).any(axis=2))[:, ::-1] - 0.5 * (np.array(panel.shape[1::-1]) - 1)
    assert drawn[:, axis].max() == pytest.approx(4e-3 * SIDE / max(sensor.spec.gelpad.size), abs=2.0)
    assert drawn[:, axis].min() > -4.0 and np.ptp(drawn[:, 1 - axis]) <= 3
