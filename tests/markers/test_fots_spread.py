"""FOTS' spread by a normal press: none inside a contact that sticks, outside that of an elastic disc that holds, and of the soft pad."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from raytac.gel.surface import GelSurface, PadGrid
from raytac.markers.calibration_presses import Press, press_frames, simulate_press
from raytac.markers.config import Fots, FotsPublished
from raytac.markers.contact_tracker import ContactTracker
from raytac.markers.contacts import ContactCells
from raytac.markers.fots import FotsKernel
from raytac.markers.surface import SurfaceModel
from raytac.specs import SensorSpec, load_sensor
from tests.markers.pads import MOTION, pose, pressed
from tests.markers.test_fots_layer import in_plane
from tests.markers.test_fots_punch import PAD, moved

GAIN = 2e6
WIDE = replace(PAD, dilate_lambda=1e3)
"""So wide a Gaussian that what is not held is stretched alike everywhere: Σ a Δh (M − C), by parts in a thousand."""


def flat(grid: PadGrid, radius: float, depth: float = 3e-4) -> np.ndarray:
    """Indentation of the cells under a flat disc in the middle [m]."""
    cells = ContactCells.over(grid)
    return np.where(np.hypot(cells.x[None], cells.y[:, None]) < radius, depth, 0.0)


def disc(radius: float) -> tuple[float, ...]:
    return 0.0, 0.0, 0.0, 0.0, 0.0, radius**2, 0.0, radius**2, 3e-4


def ring(radius: float, count: int = 16) -> np.ndarray:
    angle = 2 * math.pi * (np.arange(count) + 0.3) / count
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def test_inside_a_contact_that_sticks_nothing_spreads(grid: PadGrid) -> None:
    """Below 1 nm, where the same skin would move by tens of micrometres if it were free."""
    inside = np.concatenate([ring(r) for r in (0.0, 1e-3, 2e-3, 2.95e-3)])
    depth = flat(grid, 3e-3)
    held = moved(grid, WIDE, [disc(3e-3)], inside, gain=GAIN, depth=depth)
    free = moved(grid, WIDE, [disc(1e-5)], inside, gain=GAIN, depth=depth)
    assert np.abs(held).max() < 1e-9
    assert np.linalg.norm(free, axis=1).max() > 3e-5


def test_outside_it_is_stretch_less_that_of_a_disc_on_a_half_space(grid: PadGrid) -> None:
    """The disc's field by conjugate gradients in the Fourier domain, on gel so thick that its base does not matter."""
    radius, thick = 2e-3, 40e-3
    r, along = in_plane(radius, thick, 0.4999, stretch=True, n=256, size=40e-3)
    near = (r > 1.3 * radius) & (r < 4 * radius)
    places = np.stack([r[near], np.zeros(int(near.sum()))], axis=1)
    depth = flat(grid, radius)
    free = moved(grid, WIDE, [disc(1e-5)], places, gain=GAIN, depth=depth)[:, 0]
    held = moved(grid, WIDE, [disc(radius)], places, gain=GAIN, depth=depth)[:, 0]
    share = 1.0 - along[near] / r[near]
    assert share.min() < 0.8 and share.max() > 0.97
    np.testing.assert_allclose(held / free, share, atol=0.03)


def test_mirroring_the_press_mirrors_the_spread() -> None:
    """A leaning ellipse, deeper at one end, on cells about the middle."""
    line = 0.4e-3 * (np.arange(40) - 19.5)
    x, y = np.meshgrid(line, line)
    places = np.random.default_rng(0).uniform(-7e-3, 7e-3, (100, 2))
    kernel, box = FotsKernel(line, line, device="cpu"), np.array([[0, 40, 0, 40]], np.uint32)
    motion = replace(MOTION, punch=replace(PAD, dilate_gain=GAIN, dilate_lambda=2e4))
    form = np.array([[1 / 9e-6, 1.5e5], [1.5e5, 1 / 2.25e-6]])
    lean = np.linalg.inv(form)

    def spread(sign: tuple[int, int], places: np.ndarray) -> np.ndarray:
        """By the press mirrored by ``sign``, of markers mirrored too."""
        u, v = sign[0] * x, sign[1] * y
        inside = form[0, 0] * u * u + 2.0 * form[0, 1] * u * v + form[1, 1] * v * v < 1.0
        contact = 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, lean[0, 0], sign[0] * sign[1] * lean[0, 1], lean[1, 1], 3e-4, 1e3, 1e3
        depth = np.where(inside, 3e-4 + 0.05 * u, 0.0).astype(np.float32)
        return kernel.displacement(np.asarray(sign) * places[None], depth[None], box, np.array([[contact]]), motion)[0]

    plain = spread((1, 1), places)
    assert np.linalg.norm(plain, axis=1).max() > 1e-5
    for sign in ((-1, 1), (1, -1), (-1, -1)):
        np.testing.assert_allclose(spread(sign, places), plain * sign, atol=2e-9)
        assert np.abs(spread(sign, places * sign) - plain * sign).max() > 1e-6  # without it: another field


def test_the_history_of_a_press_does_not_matter(sensor: SensorSpec, grid: PadGrid) -> None:
    """Straight down, or deeper and back: the same to the last bit."""
    motion = replace(sensor.marker_motion, punch=replace(PAD, dilate_gain=GAIN, dilate_lambda=2e4))  # type: ignore[type-var]
    model = Fots().build(replace(sensor, marker_motion=motion), grid, num_envs=1, device="cpu")
    cells = ContactCells.over(grid)
    rest = np.concatenate([ring(r) for r in (1e-3, 3e-3, 6e-3)])
    rest = np.concatenate([rest, np.zeros((len(rest), 1))], axis=1)[None]

    def end(*depths: float) -> np.ndarray:
        tracker, result = ContactTracker(1, slip=PAD.slip), np.empty(0)
        for depth in depths:
            surface: GelSurface = pressed(grid, [(0.0, 0.0, depth)], poses=[pose(z=-depth)])
            samples = cells.sample(surface)
            result = model.displacement(rest, surface, samples, tracker.update(surface, samples))
        return result

    straight = end(2e-4, 6e-4)
    assert np.abs(straight).max() > 1e-5
    np.testing.assert_array_equal(end(2e-4, 9e-4, 4e-4, 6e-4), straight)


@pytest.mark.parametrize(
    ("kind", "params", "depth", "most"),
    [("cylinder", {"radius": 3e-3, "length": 6e-3}, 0.5e-3, 22e-6), ("sphere", {"radius": 6e-3}, 0.8e-3, 14e-6)],
    ids=["punch", "ball"],
)
def test_it_agrees_with_the_soft_pad(kind: str, params: dict[str, float | int | str], depth: float, most: float) -> None:
    """Mean distance on the coarse level, whose dots move by up to 0.13 and 0.08 mm; the published form, which spreads inside, errs more."""
    mini = load_sensor("gelsight_mini")
    press = Press(kind, kind, params, (0.0, 0.0), depth)
    last = press_frames(mini, press, simulate_press(mini, press, level="coarse"))[-1]
    x, y = np.meshgrid(np.arange(-8.5e-3, 9e-3, 1e-3), np.arange(-6.5e-3, 7e-3, 1e-3))
    rest = np.stack([x.ravel(), y.ravel(), -mini.gelpad.sag(x, y).ravel()], axis=1)[None]
    truth = SurfaceModel().displacement(rest, last.surface, None, None)[0, :, :2]
    samples = ContactCells.over(last.surface.grid).sample(last.surface)
    contacts = ContactTracker(1).update(last.surface, samples)
    fots, published = (
        config.build(mini, last.surface.grid, num_envs=1, device="cpu").displacement(rest, last.surface, samples, contacts)[0]
        for config in (Fots(), FotsPublished())
    )
    inside = np.hypot(*rest[0, :, :2].T) < 0.8 * contacts.radius.max()
    size, distance, without = (np.linalg.norm(u, axis=1) for u in (truth, fots - truth, published - truth))
    print(
        kind,
        np.round(1e6 * np.array([size.max(), size[inside].mean(), distance.mean(), without.mean(), without[inside].mean()]), 1),
    )
    assert np.abs(fots[inside]).max() < 1e-9
    assert size[inside].mean() < 0.25 * size.max() and size.max() > 5e-5
    assert without[inside].mean() > 2.0 * distance[inside].mean()
    assert distance.mean() < min(most, 0.9 * without.mean())
