"""Rigid pads under impact and load: nothing goes through, energy does not grow, weight is carried without creep."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from raytac.gel.surface import make_grid
from raytac.physics.rigid.load_law import LoadLaw
from raytac.physics.rigid.pad import RigidPad
from raytac.specs import BodySpec, ObjectSpec, PressScene, RobotSpec, StageSpec, TaskScene, load_sensor
from raytac.world.rigid_pads import RigidPads
from raytac.world.world import TactileWorld

G = 9.81
THICK = load_sensor("gelsight_mini").gelpad.thickness


def ball(mass: float, height: float = 5.1e-3) -> BodySpec:
    return BodySpec("ball", "sphere", {"radius": 0.005}, position=(0.0, 0.0, height), mass=mass)


def scene_of(*bodies: BodySpec, timestep: float = 1e-3, **options) -> TaskScene:
    scene = TaskScene("upward", RobotSpec("fixed_sensor"), bodies)
    return replace(scene, timestep=timestep, control_timestep=max(timestep, 1e-2), **options)


class Drop:
    """Path of a ball that hits the pad of a sensor on its back."""

    def __init__(self, mass: float, speed: float, timestep: float, seconds: float = 0.03) -> None:
        self.world = world = TactileWorld(scene_of(ball(mass, 5.05e-3), timestep=timestep), outputs=())
        data, pads = world.data[0], world._pads
        assert isinstance(pads, RigidPads)
        data.qvel[2] = -speed
        self.depth, self.force, self.energy = [], [], [0.5 * mass * speed**2 + mass * G * data.qpos[2]]
        step = pads._step

        def watched(*args, **options):
            ticks = step(*args, **options)
            self.depth.append(5e-3 - data.qpos[2])
            self.force.append(-world.state().wrench["sensor"][0, 2])
            self.energy.append(0.5 * mass * float(data.qvel[:3] @ data.qvel[:3]) + mass * G * data.qpos[2])
            return ticks

        pads._step = watched
        for _ in range(round(seconds / world.control_timestep)):
            self.state = world.step()


@pytest.mark.parametrize(
    ("mass", "speed", "timestep"),
    [(0.005, 5.0, 0.01), (0.05, 1.0, 0.01), (0.5, 1.0, 0.0005), (0.5, 5.0, 0.01), (0.05, 0.1, 0.005)],
)
def test_a_ball_that_hits_the_gel_stays_above_its_bonded_face_and_gains_no_energy(
    mass: float, speed: float, timestep: float
) -> None:
    drop = Drop(mass, speed, timestep)
    assert not drop.state.failed.any()
    assert 0.0 < max(drop.depth) < THICK
    assert max(drop.energy) <= drop.energy[0] * (1.0 + 1e-9)
    # It took its speed, so it did touch.
    assert max(drop.force) > mass * speed / 0.03


@pytest.mark.parametrize(("mass", "speed"), [(0.05, 1.0), (0.5, 1.0)])
def test_force_and_depth_of_an_impact_do_not_depend_on_the_scene_s_step(mass: float, speed: float) -> None:
    one, two = Drop(mass, speed, 1e-3), Drop(mass, speed, 2e-3)
    assert max(two.force) == pytest.approx(max(one.force), rel=0.02)
    assert max(two.depth) == pytest.approx(max(one.depth), rel=0.02)


def test_a_ball_thrown_at_a_case_is_stopped_by_it() -> None:
    """At 5 m/s and steps of 10 ms: from the side of the case, and from below, where it is 33 mm tall and 32 wide."""
    for start, velocity in (([0.05, 0.0, -0.015], [-5.0, 0.0, 0.0]), ([0.0, 0.0, -0.07], [0.0, 0.0, 5.0])):
        world = TactileWorld(scene_of(ball(0.05), timestep=0.01, gravity=(0.0, 0.0, 0.0)), outputs=())
        world.data[0].qpos[:3], world.data[0].qvel[:3] = start, velocity
        for _ in range(3):
            state = world.step()
        at = state.world_from_body["ball"][0, :3, 3]
        assert not state.failed.any()
        assert at @ velocity < -0.019 * 5.0  # outside still, on the side that it came from
        assert abs(world.data[0].qvel[:3] @ velocity) < 0.2 * 25.0


def test_a_ball_thrown_between_closing_pads_touches_both_and_goes_through_neither() -> None:
    gripper = RobotSpec("floating_gripper", opening=0.03, position=(0.0, 0.0, 0.0))
    thrown = replace(ball(0.02), position=(0.0, 0.0, 0.0))
    scene = TaskScene("catch", gripper, (thrown,), gravity=(0.0, 0.0, 0.0), timestep=2e-3, control_timestep=1e-2)
    world = TactileWorld(scene, outputs=())
    opening = world.composed.opening
    assert opening is not None
    world.data[0].qvel[world.model.jnt_dofadr[world.model.body_jntadr[world.composed.bodies["ball"].index]] + 1] = 2.0

    def close(data, time: float) -> None:
        data.ctrl[opening] = max(0.0, 0.03 - 0.5 * time)

    most = np.zeros(2)
    for _ in range(8):
        state = world.step(close)
        most = np.maximum(most, [-state.wrench[name][0, 2] for name in ("left", "right")])
    assert not state.failed.any() and (most > 0.05).all()


def test_a_heavy_block_lies_still_at_the_depth_of_the_press() -> None:
    """1 kg on a face of 12 mm at the scene's longest step: it carries its weight to 1e-4 and does not creep."""
    size: dict[str, float | int | str] = {"length": 0.012, "width": 0.012, "height": 0.02}
    world = TactileWorld(
        scene_of(BodySpec("block", "box", size, position=(0.0, 0.0, 0.0101), mass=1.0), timestep=0.01), outputs=()
    )
    for _ in range(100):
        world.step()
    before = world.state()
    for _ in range(100):
        world.step()
    state = world.state()
    # 60 s are as many steps as move it by less than 10 µm.
    moved = np.abs(state.world_from_body["block"][0, :3, 3] - before.world_from_body["block"][0, :3, 3]).max()
    assert moved < 10e-6 / 60.0
    assert -state.wrench["sensor"][0, 2] == pytest.approx(G, rel=1e-4)
    press = PressScene(
        "block",
        ObjectSpec("box", size, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 1.0),
        (StageSpec("indent", force=G),),
    )
    pad = RigidPad(load_sensor("gelsight_mini"), press, pitch=0.1e-3)
    depth = float(pad.peak(pad.run()).depth[0])
    assert 0.01 - state.world_from_body["block"][0, 2, 3] == pytest.approx(depth, rel=0.01)


def test_a_press_into_the_hard_back_is_as_deep_as_a_body_of_that_weight() -> None:
    """A ball of 12 kg leaves a fifth of the thickness or less, where force grows without bound."""
    mass = 12.0
    world = TactileWorld(scene_of(ball(mass), timestep=0.01), outputs=())
    for _ in range(12):
        world.step()
    sunk = 5e-3 - world.state().world_from_body["ball"][0, 2, 3]
    assert 0.8 * THICK < sunk < THICK
    press = PressScene(
        "ball",
        ObjectSpec("sphere", {"radius": 0.005}, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), mass),
        (StageSpec("indent", force=mass * G),),
    )
    pad = RigidPad(load_sensor("gelsight_mini"), press, pitch=0.1e-3)
    assert float(pad.peak(pad.run()).depth[0]) == pytest.approx(sunk, rel=0.01)


def test_two_gels_that_meet_carry_the_same_load_at_half_of_the_overlap_each() -> None:
    """A gripper that closes on nothing."""
    gripper = RobotSpec("floating_gripper", opening=0.004, position=(0.0, 0.0, 0.0))
    scene = TaskScene("meet", gripper, (), gravity=(0.0, 0.0, 0.0), timestep=2e-3, control_timestep=1e-2)
    world = TactileWorld(scene, outputs=("wrench",))
    opening = world.composed.opening
    assert opening is not None

    def close(data, time: float) -> None:
        data.ctrl[opening] = max(0.0, 0.004 - 0.1 * time)

    for k in range(20):
        if k == 8:  # the servo cannot ask for less than no gap
            for name in ("left", "right"):
                joint = world.model.joint(f"{name}_slide").id
                world.data[0].qfrc_applied[world.model.jnt_dofadr[joint]] = -5.0
        state = world.step(close)
    left, right = (state.world_from_pad[name][0] for name in ("left", "right"))
    overlap = -float((np.linalg.inv(left) @ right)[2, 3])
    assert not state.failed.any() and overlap > 1e-4
    pressed = [-state.wrench[name][0, 2] for name in ("left", "right")]
    assert pressed[0] > 1.0 and pressed[1] == pytest.approx(pressed[0], rel=1e-9)
    for frame in world.observe().values():
        assert float(frame.surface.indentation.max()) == pytest.approx(0.5 * overlap, rel=0.01)
    # Half of what one gel carries against a rigid copy of the other at the same overlap.
    gel = load_sensor("gelsight_mini").gelpad
    grid = make_grid(gel, 0.2e-3)
    law = LoadLaw(-2.0 * grid.rest, grid.x, grid.y, gel)
    assert pressed[0] == pytest.approx(0.5 * law.force(overlap), rel=0.02)
