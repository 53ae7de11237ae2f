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


def pulled(sides: tuple[tuple[float, float, float], ...], friction: float, across: float) -> list[np.ndarray]:
    """Errors of a cube that is held by nine tenths of its bound along z, then pulled by eleven, with a force along x and y [N]."""
    world, bound = grip(sides, friction), friction * PRESS * len(sides)
    press(world, (0.0, 0.0, 0.0), 40)
    press(world, (0.0, 0.0, 0.9 * bound), 20)
    return press(world, (across, across, 1.1 * bound), 3)


@pytest.mark.parametrize(
    ("sides", "friction", "across"),
    [
        *((TWO, friction, across) for friction in (0.4, 1.0) for across in (0.0, 0.02, 0.1, 0.5)),
        (TWO, 1.0, 2.0),
        *((FOUR, friction, across) for friction in (0.4, 1.0) for across in (0.0, 0.02, 0.5)),
    ],
)
def test_a_cube_that_slips_out_of_a_grip_feels_the_law(
    sides: tuple[tuple[float, float, float], ...], friction: float, across: float
) -> None:
    errors = pulled(sides, friction, across)
    assert len(errors) >= 3 and max(np.abs(error).max() for error in errors) < 0.01


@pytest.mark.parametrize(("friction", "across"), [(0.4, 0.1), (1.0, 0.1)])
def test_a_cube_that_slips_out_of_a_grip_does_not_spin(friction: float, across: float) -> None:
    """Two faces hold it by their pressure, whether they slide or stick; cut by the cone, they let it spin at 4 to 8 rad/s."""
    world, bound = grip(TWO, friction), 2 * friction * PRESS
    press(world, (0.0, 0.0, 0.0), 40)
    press(world, (0.0, 0.0, 0.9 * bound), 20)
    for _ in range(3):
        press(world, (across, across, 1.1 * bound), 1)
        assert np.abs(world.data[0].qvel[-3:]).max() < 0.2
    assert world.data[0].qvel[-4] > 0.1, "it slips along z"


@pytest.mark.parametrize("garbage", [np.nan, 1e5])
def test_lifts_stay_those_of_the_start_where_no_solve_helps(garbage: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every solve for lifts but the first of a step gives accelerations of no sense."""
    world = grip(TWO, 1.0)
    pads: Any = world._pads
    engine, solve, lifts = pads.engine, mujoco.mj_fwdConstraint, []
    slots, foresee, solves = engine._contact.slots, engine._foresee_slides, [0]

    def spoil(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        solve(model, data)
        solves[0] += 1
        if solves[0] > 1:
            data.qacc[:] = garbage * np.arange(1, model.nv + 1)

    def watch(*args: Any) -> None:
        before, solves[0] = slots.lift.numpy().copy(), 0
        with monkeypatch.context() as patch:
            patch.setattr(mujoco, "mj_fwdConstraint", spoil)
            foresee(*args)
        if solves[0] > 1:
            lifts.append((before, slots.lift.numpy().copy()))

    monkeypatch.setattr(engine, "_foresee_slides", watch)
    press(world, (0.0, 0.0, 0.0), 40)
    press(world, (0.0, 0.0, 8.8), 3)
    assert lifts
    for before, after in lifts:
        np.testing.assert_allclose(after, before, atol=1e-9)
