"""Worlds with soft pads: owners of bodies, forces, and a reset to the start."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from raytac.errors import InputError, SpecError
from raytac.specs import BodySpec, MountSpec, RobotSpec, TaskScene
from raytac.world.world import TactileWorld

pytestmark = pytest.mark.usefixtures("few_cells")
G = 9.81
BALL = BodySpec("ball", "sphere", {"radius": 0.005}, position=(0.0, 0.0, 0.0051), mass=0.05)
UP = TaskScene("upward", RobotSpec("fixed_sensor"), (BALL,), physics="ipc", coupling="one_way")
"""A sensor that lies on its back with a ball just above the middle of its pad; world and pad frame are one."""


@pytest.fixture(scope="module")
def resting(few_cells: None) -> TactileWorld:
    """The ball after 0.3 s."""
    world = TactileWorld(UP, outputs=("wrench", "traction"))
    for _ in range(30):
        world.step()
    return world


def test_a_ball_of_the_solver_weighs_what_it_weighs_and_mujoco_sees_it(resting: TactileWorld) -> None:
    state = resting.state()
    np.testing.assert_allclose(state.wrench["sensor"][0, :3], [0, 0, -0.05 * G], atol=2e-3 * 0.05 * G)
    body = resting.composed.bodies["ball"]
    assert body.mocap >= 0 and not body.is_free
    height = state.world_from_body["ball"][0, 2, 3]
    assert 0.0040 < height < 0.0049
    assert resting.data[0].xpos[body.index][2] == height
    assert state.report["min_gap"][0] > 0.0 and 0.5 < state.report["min_det"][0] <= 1.0


def test_the_sensor_reads_the_soft_pad(resting: TactileWorld) -> None:
    from raytac.gel.traction import cell_areas

    frame = resting.observe()["sensor"]
    assert frame.surface.coat is not None
    total = (frame.traction[0] * cell_areas(frame.surface.grid)[..., None]).sum(axis=(0, 1))
    np.testing.assert_allclose(total, resting.state().wrench["sensor"][0, :3], atol=2e-3)
    assert frame.surface.contact.any() and np.abs(frame.surface.contact_centre).max() < 1e-4
    assert frame.surface.grid.shape == resting.sensors["sensor"].grid.shape


def test_reset_restores(resting: TactileWorld) -> None:
    first = resting.state()
    resting.reset()
    state = resting.state()
    assert state.time[0] == 0.0 and state.world_from_body["ball"][0, 2, 3] == pytest.approx(0.0051, abs=1e-12)
    np.testing.assert_array_equal(state.wrench["sensor"], 0.0)
    assert state.report["min_gap"][0] == np.inf and state.report["min_det"][0] == 1.0 and state.report["converged"][0]
    for _ in range(30):
        again = resting.step()
    np.testing.assert_allclose(again.world_from_body["ball"], first.world_from_body["ball"], atol=1e-9)
    np.testing.assert_allclose(again.wrench["sensor"], first.wrench["sensor"], atol=1e-6)


def test_a_soft_body_is_held_where_it_touches_its_holder(monkeypatch: pytest.MonkeyPatch) -> None:
    plate = BodySpec(
        "plate", "box", {"length": 0.02, "width": 0.02, "height": 0.004}, position=(0.0, 0.0, -0.052), dynamics="fixed"
    )
    beam = BodySpec(
        "beam",
        "box",
        {"length": 0.006, "width": 0.006, "height": 0.018},
        position=(0.0, 0.0, -0.041),
        dynamics="soft",
        youngs_modulus=1e5,
        cell=0.003,
        held_by="plate",
    )
    with monkeypatch.context() as patched:
        patched.setattr("ipc.solver.patch_motion.MAX_ENTRIES", 1000)
        with pytest.raises(SpecError, match=r"body\[1\]\.cell_mm = 3\.0: 'beam' has .* at most 1000"):
            TactileWorld(replace(UP, coupling="two_way", bodies=(plate, beam)))
        world = TactileWorld(replace(UP, bodies=(plate, beam)))  # one-way asks for no stiffness
    assert set(world.composed.bodies) == {"plate"}  # MuJoCo has no soft bodies
    before = world.mesh("beam")[0]
    for _ in range(5):
        world.step()
    after = world.mesh("beam")[0]
    bottom = before[0, :, 2] < -0.0499
    np.testing.assert_allclose(after[0, bottom], before[0, bottom], atol=1e-12)
    sunk = (before - after)[0, before[0, :, 2] > -0.0321, 2]
    # A column under its own weight gives way by ρ g L² / 2E; the held end, which cannot widen, takes some off.
    assert sunk.mean() == pytest.approx(1000.0 * G * 0.018**2 / 2e5, rel=0.2)


def test_a_mesh_is_asked_for_by_a_name_that_is_there(resting: TactileWorld) -> None:
    vertices, faces = resting.mesh("ball")
    assert vertices.shape[2] == 3 and faces.max() < vertices.shape[1]
    gel, _ = resting.mesh("sensor")
    assert gel[0, :, 2].max() <= 0.0
    with pytest.raises(InputError, match="must be the name of"):
        resting.mesh("bal")


def test_a_ball_rests_alike_whoever_owns_it(resting: TactileWorld) -> None:
    """Quasi-static: MuJoCo's ball, led in the solver and held up by the wrench that comes back, against the solver's own."""
    world = TactileWorld(replace(UP, coupling="two_way", bodies=(replace(BALL, owner="mujoco"),)), outputs=("wrench",))
    assert world.composed.bodies["ball"].is_free
    for _ in range(40):
        state = world.step()
    own = resting.state()
    assert np.abs(world.data[0].qvel).max() < 1e-3
    np.testing.assert_allclose(state.wrench["sensor"][0, 2], -0.05 * G, rtol=0.01)
    assert state.world_from_body["ball"][0, 2, 3] == pytest.approx(own.world_from_body["ball"][0, 2, 3], abs=5e-6)


PRESS = """
<mujoco><worldbody><body name="head" pos="0 0 0.0405"><joint name="z" type="slide" axis="0 0 1"/><geom size="0.01" mass="0.5"
contype="0" conaffinity="0"/></body></worldbody>
<actuator><position joint="z" name="z" kp="{kp}" kv="{kv}"/></actuator></mujoco>
"""


def test_two_way_is_one_way_for_a_stiff_arm_and_a_spring_for_a_soft_one(tmp_path: Path) -> None:
    """A pad on a servo is pressed on a fixed ball, 0.3 mm in if it does not give way: the servo's spring and the contact share the way."""

    def press(kp: float, coupling: str, steps: int) -> tuple[float, float]:
        """Force [N] and how far the servo is off its target [m]."""
        (tmp_path / "press.xml").write_text(PRESS.format(kp=kp, kv=2.0 * (kp * 0.52) ** 0.5), "utf-8")
        mount = MountSpec("sensor", "head", position=(0.0, 0.0, -0.03), quaternion=(0.0, 1.0, 0.0, 0.0))
        robot = RobotSpec(str(tmp_path / "press.xml"), mounts=(mount,))
        ball = replace(BALL, position=(0.0, 0.0, 0.005), dynamics="fixed")
        scene = TaskScene("press", robot, (ball,), physics="ipc", timestep=0.001, gravity=(0.0, 0.0, 0.0))
        world = TactileWorld(scene, coupling=coupling, outputs=("wrench",))
        for k in range(steps):
            state = world.step(np.array([-0.0008 * min(1.0, (k + 1) / 6)]))
        return -float(state.wrench["sensor"][0, 2]), float(world.data[0].qpos[0]) + 0.0008

    held, off = press(1e6, "one_way", 9)
    assert off < 1e-7
    assert press(1e6, "two_way", 9)[0] == pytest.approx(held, rel=0.01)
    given, off = press(500.0, "two_way", 32)
    # What the servo bears is what the pad feels, and the link has moved by it.
    assert 500.0 * off == pytest.approx(given, rel=0.01) and given < 0.9 * held
