"""Surfaces and markers of rigid pads by kernels without the host, against what sensors of a world show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from raytac.errors import InputError
from raytac.gel import ElasticSurround
from raytac.gel.device_surround import DeviceSurround
from raytac.gel.surface import make_grid
from raytac.markers.device_fots import DeviceFots
from raytac.markers.registry import markers_config
from raytac.markers.tracker import MarkerTracker
from raytac.physics.rigid.shear_state import ShearState
from raytac.se3 import pose, rotations
from raytac.shapes import object_height, primitive
from raytac.specs import load_sensor
from raytac.world.pad_touch import PadTouch
from raytac.world.start_kernels import lose_marked

SPEC = load_sensor("gelsight_mini_9x11")
DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("pitch", [0.4e-3, 0.15e-3])
def test_the_surround_is_that_of_the_host(pitch: float, device: str) -> None:
    """Balls, boxes and two at once, at random places and depths, one pad untouched and one that is not sound."""
    grid, rng = make_grid(SPEC.gelpad, pitch), np.random.default_rng(0)
    x, y = np.meshgrid(grid.x, grid.y)
    under = np.full((7, *grid.shape), np.inf)
    for b in range(6):
        for _ in range(1 + b % 2):
            (cx, cy), size, depth = rng.uniform(-5e-3, 5e-3, 2), rng.uniform(2e-3, 5e-3), rng.uniform(1e-4, 1e-3)
            across = (x - cx) ** 2 + (y - cy) ** 2
            ball = np.where(across < size**2, size - depth - np.sqrt(np.maximum(size**2 - across, 0.0)), np.inf)
            box = np.where((np.abs(x - cx) < size) & (np.abs(y - cy) < 0.5 * size), -depth, np.inf)
            under[b] = np.minimum(under[b], ball if b < 3 else box)
    under[under > grid.rest] = np.inf
    expected = ElasticSurround(grid).surface(under)
    found = DeviceSurround(grid, SPEC.gelpad.thickness, num_envs=7, device=device)
    sound = np.ones(7, bool)
    sound[5] = False
    depths = (grid.rest - under).max(axis=(1, 2))[:, None]
    arrays = [wp.array(under, dtype=wp.float64, device=device), wp.array(depths, dtype=wp.float64, device=device)]
    for _ in range(2):  # nothing is left of the first time
        found.launch(arrays[0], arrays[1], wp.array(sound, dtype=wp.bool, device=device))
    height, contact = found.height.numpy(), found.contact.numpy().astype(bool)
    np.testing.assert_allclose(height[sound], expected.height[sound], rtol=0.0, atol=1e-9)
    assert (contact[sound] != expected.contact[sound]).sum() <= 2 and contact[:5].any(axis=(1, 2)).all()
    np.testing.assert_array_equal(height[5], grid.rest.astype(np.float32))
    assert not contact[5].any() and not contact[6].any() and not found.pierced.numpy().any()


class Both:
    """Two balls that are one body over B pads: surfaces and markers by the host and by kernels."""

    def __init__(self, markers: str, count: int, *, device: str = "cpu", patches: int = 8) -> None:
        grid, config = make_grid(SPEC.gelpad, 0.4e-3), markers_config(markers)
        self.tracker = MarkerTracker(SPEC, config, grid, num_envs=count, device="cpu")
        self.host = ElasticSurround(grid)
        parts = [primitive("sphere", (3e-3,)) for _ in range(2)]
        self.parts = [
            replace(part, object_from_part=pose(np.eye(3), np.array([side * 4e-3, 0.0, 0.0])))
            for part, side in zip(parts, (-1, 1), strict=True)
        ]
        self.surround = DeviceSurround(grid, SPEC.gelpad.thickness, num_envs=count, device=device)
        self.fots = DeviceFots(SPEC, config, grid, num_envs=count, patches=patches, device=device)
        self.shear, self.grid, self.device = ShearState(count, 1, 2, device=device), grid, device
        self.sound = wp.full(count, value=True, dtype=wp.bool, device=device)

    def at(self, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Displacements (B, M, 2) of the host and of the kernels, and the greatest error of heights, with bodies at poses (B, 4, 4)."""
        under = object_height(self.parts, poses, self.grid.x, self.grid.y, below=float(self.grid.rest.max()))
        under[under > self.grid.rest] = np.inf
        depth = (self.grid.rest - under).max(axis=(1, 2))
        shown = np.where((depth > 0.0)[:, None, None], poses, np.nan)
        surface = self.host.surface(under, shown)
        arrays = [wp.array(values, dtype=wp.float64, device=self.device) for values in (under, depth[:, None])]
        self.surround.launch(arrays[0], arrays[1], self.sound)
        moved = wp.array(np.stack([poses, poses], axis=1)[:, None], dtype=wp.mat44d, device=self.device)
        self.fots.launch(self.surround.height, self.surround.contact, moved, 0, arrays[1], self.sound, self.shear.struct)
        error = np.abs(self.surround.height.numpy() - surface.height).max(axis=(1, 2))
        return self.tracker.update(surface).displacement, self.fots.displacement.numpy(), error


def motion(step: int, count: int) -> np.ndarray:
    """Poses (B, 4, 4): pressed on, dragged, turned, lifted on one side, dragged back beyond the slip, away, and on again."""
    phase, t = divmod(step, 6)
    turn, shift = np.zeros(3), np.array([0.0, 0.0, 2.5e-3])
    shift[0] = {1: 3e-4 * t, 2: 1.5e-3, 3: 1.5e-3, 4: 1.5e-3 - 6e-4 * t}.get(phase, 0.0)
    turn[2], turn[1] = 0.02 * (t if phase == 2 else 5 if phase in (3, 4) else 0), 0.06 * (t if phase == 3 else 0)
    shift[2] = {0: 3.1e-3 - 1.2e-4 * t, 5: 4e-3}.get(phase, 2.5e-3)
    poses = np.stack([pose(rotations(turn * (1.0 + 0.3 * b)), shift * [1.0, 1.0 + b, 1.0]) for b in range(count)])
    poses[:, 1, 3] = 1e-4 * step * np.arange(count)
    return poses


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("markers", ["fots", "fots_published"])
def test_markers_follow_contacts_as_on_the_host(markers: str, device: str) -> None:
    """Two contacts, one that leaves and comes back, slip on reversal, nothing touched, and a reset of one pad alone."""
    both, most, contacts = Both(markers, 2, device=device), 0.0, set()
    for step in range(42):
        if step == 15:
            both.tracker.reset([1])
            both.fots.reset(wp.array([False, True], dtype=wp.bool, device=device))
        expected, found, error = both.at(motion(step, 2))
        assert error.max() < 1e-9
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-8, err_msg=str(step))
        most = max(most, float(np.abs(expected).max()))
        contacts.add(int(both.fots.contacts.table.numpy()[0, :, 0].sum()))
    assert most > 2e-4 and contacts == {0, 1, 2}
    both.fots.check()


def test_more_contacts_than_there_is_memory_for_are_an_error_that_names_it() -> None:
    both = Both("fots", 1, patches=1)
    both.at(motion(6, 1))
    with pytest.raises(InputError, match="must be 2 or more") as error:
        both.fots.check()
    assert error.value.name == "patches"


def test_a_gel_below_its_bonded_face_is_not_shown_as_sound() -> None:
    grid = make_grid(SPEC.gelpad, 0.4e-3)
    x, y = np.meshgrid(grid.x, grid.y)
    under = np.where(x**2 + y**2 < 4e-6, grid.rest - SPEC.gelpad.thickness - 2e-4, np.inf)[None]
    touch = PadTouch(SPEC, grid, [], None, pad=0, num_envs=1)
    touch._surround.launch(
        wp.array(under, dtype=wp.float64),
        wp.array([[SPEC.gelpad.thickness + 2e-4]], dtype=wp.float64),
        wp.full(1, value=True, dtype=wp.bool),
    )
    active = wp.full(1, value=True, dtype=wp.bool)
    wp.launch(lose_marked, dim=1, inputs=[touch._surround.pierced, active])
    assert not active.numpy()[0]
    np.testing.assert_array_equal(touch.height.numpy()[0], grid.rest.astype(np.float32))
