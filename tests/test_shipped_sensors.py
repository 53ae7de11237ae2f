"""Shipped sensors under both physics: forces, imprints and images of a DIGIT and an R1.5 are sound."""

from __future__ import annotations

import numpy as np
import pytest

from raytac import TactileSensor
from raytac.calibrate import ball_forces
from raytac.physics import Ipc, PhysicsConfig, Rigid
from raytac.specs import available, load_press, load_sensor

NEW = ("digit", "gelsight_r15")
SIZE = (60, 80)


@pytest.mark.parametrize("name", NEW)
@pytest.mark.parametrize("physics", [Rigid(), Ipc(level="coarse")], ids=["rigid", "soft"])
def test_a_ball_shows_where_it_is_pressed(name: str, physics: PhysicsConfig) -> None:
    sensor = TactileSensor(name, physics=physics, resolution=SIZE, outputs=("rgb", "normals", "wrench"), device="cpu")
    frame, rest = sensor.press(load_press("sphere")), sensor.rest()
    assert frame.rgb is not None and rest.rgb is not None and frame.wrench is not None and frame.contact is not None
    change = np.abs(frame.rgb[0].astype(int) - rest.rgb[0]).mean(-1)
    assert change[frame.contact[0]].mean() > 10 * max(change[0].mean(), 0.5)
    row, column = np.argwhere(frame.contact[0]).mean(0)
    assert abs(row - 0.5 * SIZE[1]) < 3 and abs(column - 0.5 * SIZE[0]) < 3
    assert frame.wrench[0, 2] < -0.5  # the ball pushes the pad in


def test_they_are_listed_and_lit_in_three_colours() -> None:
    assert set(NEW) <= set(available("sensor"))
    for name in NEW:
        sensor = load_sensor(name)
        assert set(sensor.lights.layers) == {"red", "green", "blue"}
        assert sensor.camera.resolution == (240, 320)


def test_the_gel_fitted_to_forces_presses_as_measured() -> None:
    """Forces published with FEATS of a ball of 7.5 mm radius; the default gel is farther off."""
    depths, measured = 1e-3 * np.array([0.5, 1.0, 1.5, 2.0]), np.array([1.6503, 5.9641, 13.5257, 23.2532])
    pads = Rigid(), Ipc(level="coarse")
    worst = [
        np.abs(ball_forces(load_sensor(name), pads, 7.5e-3, depths, device="cpu") / measured - 1.0).max(axis=1)
        for name in ("gelsight_mini_feats", "gelsight_mini")
    ]
    assert (worst[0] < 0.08).all() and (worst[1] > 0.15).all()
