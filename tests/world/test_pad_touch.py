"""Surfaces and markers of rigid pads by kernels without the host, against what sensors of a world show."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import warp as wp

from raytac.errors import InputError
from raytac.gel import pyramid
from raytac.gel.gaussian import PYRAMID_SIGMAS
from raytac.gel.surface import make_grid
from raytac.markers.device_fots import DeviceFots
from raytac.markers.registry import markers_config
from raytac.markers.tracker import MarkerTracker
from raytac.physics.rigid.pressed_gel import PressedGel
from raytac.physics.rigid.shear_state import ShearState
from raytac.se3 import pose, rotations
from raytac.shapes import primitive
from raytac.specs import load_sensor
from raytac.world.pad_surfaces import PadSurfaces
from raytac.world.start_kernels import lose_marked

SPEC = load_sensor("gelsight_mini_9x11")
DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)]


class Both:
    """Two balls that are one body over B pads: surfaces and markers by the host and by kernels."""

    def __init__(self, markers: str, count: int, *, device: str = "cpu", patches: int = 8) -> None:
        grid, config = make_grid(SPEC.gelpad, 0.4e-3), markers_config(markers)
        self.tracker = MarkerTracker(SPEC, config, grid, num_envs=count, device="cpu")
        parts = [primitive("sphere", (3e-3,)) for _ in range(2)]
        self.parts = [
            replace(part, object_from_part=pose(np.eye(3), np.array([side * 4e-3, 0.0, 0.0])))
            for part, side in zip(parts, (-1, 1), strict=True)
        ]
        self.gel = PressedGel(grid, SPEC.gelpad.thickness, [self.parts], num_envs=count, device=device)
        self.host = PadSurfaces({"pad": SPEC.gelpad}, [self.parts], count)
        self.fots = DeviceFots(SPEC, config, grid, num_envs=count, patches=patches, device=device)
        self.shear, self.grid, self.device = ShearState(count, 1, 2, device=device), grid, device

    def at(self, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Displacements (B, M, 2) of the host and of the kernels, and the greatest error of heights, with bodies at poses (B, 4, 4)."""
        count, gel = len(poses), self.gel
        reading = self.host.reading(
            "pad", self.grid, poses[:, None], np.zeros((count, 6)), np.zeros(count, bool), np.arange(count)
        )
        moved: Any = wp.array(np.stack([poses, poses], axis=1)[:, None], dtype=wp.mat44d, device=self.device)
        wp.copy(gel.poses, moved[:, 0, :1])
        gel.sound.fill_(True)
        gel.launch()
        self.fots.launch(gel.surround.height, gel.surround.contact, moved, 0, gel.depth, gel.sound, self.shear.struct)
        error = np.abs(gel.surround.height.numpy() - reading.surface.height).max(axis=(1, 2))
        return self.tracker.update(reading.surface).displacement, self.fots.displacement.numpy(), error


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


def test_a_gel_below_its_bonded_face_is_not_shown_as_sound(monkeypatch: pytest.MonkeyPatch) -> None:
    """A plate wider than the pad: Gaussians without loss, mirrored at the borders, press the dome's flanks deeper than the plate is."""
    lossless = tuple((sigma / SPEC.gelpad.thickness, 1.0) for sigma in PYRAMID_SIGMAS)
    monkeypatch.setattr(pyramid, "LAYER_STEPS", lossless)
    grid, plate = make_grid(SPEC.gelpad, 0.4e-3), [primitive("box", (20e-3, 20e-3, 1e-3))]
    gel = PressedGel(grid, SPEC.gelpad.thickness, [plate], num_envs=3)
    poses = np.tile(np.eye(4), (3, 1, 1, 1))
    poses[:, 0, 2, 3] = 1e-3 - np.array([1e-3, SPEC.gelpad.thickness - 1e-5, 1e-3])
    pressed = gel.of(poses, np.ones(3, bool))
    np.testing.assert_array_equal(pressed.lost, [False, True, False])
    np.testing.assert_array_equal(pressed.height[1], grid.rest.astype(np.float32))
    assert not pressed.contact[1].any() and pressed.contact[0].any()
    active = wp.full(3, value=True, dtype=wp.bool)
    wp.launch(lose_marked, dim=3, inputs=[gel.surround.lost, active])
    np.testing.assert_array_equal(active.numpy(), [True, False, True])
    failed, rows = np.zeros(3, bool), np.arange(3)
    reading = PadSurfaces({"pad": SPEC.gelpad}, [plate], 3).reading("pad", grid, poses, np.zeros((3, 6)), failed, rows)
    np.testing.assert_array_equal(reading.failed, [False, True, False])
    assert np.isnan(reading.surface.height[1]).all() and np.isnan(reading.wrench[1]).all()
    np.testing.assert_array_equal(reading.surface.height[0], pressed.height[0])
