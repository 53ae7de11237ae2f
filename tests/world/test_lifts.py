"""Slides of one body on several pads at once: MuJoCo's forces are those of the load law at the end of the step."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import pytest

from raytac import TactileWorld, mount
from raytac.specs import load_sensor

SENSOR = load_sensor("gelsight_mini")
FLAT = replace(SENSOR, gelpad=replace(SENSOR.gelpad, dome_radius=(np.inf, np.inf)))
SIDE, STEP, PRESS = 0.03, 1e-2, 4.0
TWO = ((1.0, 0.0, 0.0), (-1.0, 0.0, 0.0))
FOUR = (*TWO, (0.0, 1.0, 0.0), (0.0, -1.0, 0.0))


def grip(sides: tuple[tuple[float, float, float], ...], friction: float) -> TactileWorld:
    """A cube of 50 g between pads on fingers that motors press, without gravity; z is along all of them."""
    fingers = "".join(
        f'<body name="finger{k}" pos="{0.5 * SIDE * x} {0.5 * SIDE * y} 0"><joint name="slide{k}" type="slide" axis="{-x} {-y} 0" '
        f'damping="50"/><inertial mass=".1" pos="0 0 0" diaginertia="1e-4 1e-4 1e-4"/></body>'
        for k, (x, y, _) in enumerate(sides)
    )
    motors = "".join(f'<motor joint="slide{k}"/>' for k in range(len(sides)))
    spec = mujoco.MjSpec.from_string(
        f'<mujoco><option timestep="{STEP}" cone="elliptic" integrator="implicitfast" gravity="0 0 0"/><worldbody>{fingers}'
        f'<body name="body"><freejoint/><geom type="box" size="{0.5 * SIDE} {0.5 * SIDE} {0.5 * SIDE}" mass=".05"/></body>'
        f"</worldbody><actuator>{motors}</actuator></mujoco>"
    )
    for k, side in enumerate(sides):
        pose, normal, up = np.eye(4), -np.array(side), np.array([0.0, 0.0, 1.0])
        pose[:3, :3] = np.stack([np.cross(up, normal), up, normal], axis=1)
        mount(spec, FLAT, body=f"finger{k}", name=f"pad{k}", pose=pose)
    sensors = {f"pad{k}": FLAT for k in range(len(sides))}
    return TactileWorld(spec, sensors=sensors, touches={"body": friction}, outputs=("wrench",))


def law_and_force(contact: Any) -> tuple[np.ndarray, np.ndarray]:
    """Normal forces [N] of the load law at the last step's end, and MuJoCo's."""
    slots, held = contact.slots, contact.slots.held.numpy()[0] != 0
    given, lift, regular = (values.numpy()[0][held] for values in (slots.force, slots.lift, slots.regularisation))
    speed, carried = contact.velocity.numpy()[0][held], contact.force.numpy()[0][held]
    law = given[:, 0] + lift - speed[:, 0] / (regular[:, 0] * float(contact.steps.length.numpy()[0]))
    return law, carried[:, 0]


def press(world: TactileWorld, load: tuple[float, float, float], steps: int) -> list[np.ndarray]:
    """Push the cube; errors of forces over ``PRESS`` in all steps in which lifts were searched."""
    pads: Any = world._pads
    contact, end, result = pads.engine._contact, pads._end, []

    def note() -> None:
        end()
        if contact.steps.solves.numpy()[0]:
            law, force = law_and_force(contact)
            result.append((force - np.maximum(law, 0.0)) / PRESS)

    pads._end = note
    world.data[0].xfrc_applied[world.model.body("body").id, :3] = load
    for _ in range(steps):
        state = world.step(np.full(world.model.nu, PRESS))
        assert not state.failed.any() and np.isfinite(world.data[0].qpos).all() and np.isfinite(world.data[0].qvel).all()
    pads._end = end
    return result


@pytest.mark.parametrize(
    ("sides", "side_force"),
    [(TWO, 0.0), (TWO, 0.02), (TWO, 0.1), (TWO, 0.5), (FOUR, 0.0), (FOUR, 0.02)],
    ids=["even", "0.02N", "0.1N", "0.5N", "four", "four-0.02N"],
)
@pytest.mark.parametrize("friction", [0.4, 1.0])
def test_a_cube_that_slips_out_of_a_grip_feels_the_law(
    sides: tuple[tuple[float, float, float], ...], side_force: float, friction: float
) -> None:
    """Held by nine tenths of its bound, then pulled along z by eleven, with a force across."""
    world, bound = grip(sides, friction), friction * PRESS * len(sides)
    press(world, (0.0, 0.0, 0.0), 40)
    press(world, (0.0, 0.0, 0.9 * bound), 20)
    errors = press(world, (side_force, side_force, 1.1 * bound), 3)
    print(
        "XX",
        len(errors),
        np.round(world.data[0].qvel[-6:], 3),
        [e.round(3).tolist() for e in errors if np.abs(e).max() > 1e-3],
        0.1 * bound / 0.05 * 3 * STEP,
    )
    assert errors and max(np.abs(error).max() for error in errors) < 0.01
