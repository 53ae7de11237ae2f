"""Soft pads on MuJoCo Warp, on its CPU device and on CUDA: against C MuJoCo, balance of forces, copies, resets, what is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp

from raytac.errors import InputError, OverlapError
from raytac.specs import BodySpec, RobotSpec, TaskScene
from raytac.world import TactileWorld
from raytac.world.engine.choice import WarpEngine

pytest.importorskip("mujoco_warp")

# The first test compiles MuJoCo Warp for the CPU: minutes.
pytestmark = [pytest.mark.timeout(1200), pytest.mark.solver, pytest.mark.usefixtures("few_cells")]
DEVICES = [
    "cpu",
    pytest.param("cuda", marks=[pytest.mark.gpu, pytest.mark.skipif(not wp.is_cuda_available(), reason="needs CUDA")]),
]
CLOSING = 8e-5 * np.array([1.0, 1.2])
"""By how much the grippers of two environments close in a step [m]."""


def grip(owner: str, **options: Any) -> TactileWorld:
    """Two grippers just around cubes that MuJoCo or the solver moves, without gravity."""
    cube = BodySpec("cube", "box", {"length": 0.01, "width": 0.01, "height": 0.01}, dynamics="free", owner=owner, mass=0.02)
    robot = RobotSpec("floating_gripper", opening=0.0102)
    scene = TaskScene("grip", robot, (cube,), physics="ipc", timestep=0.002, gravity=(0.0, 0.0, 0.0))
    return TactileWorld(scene, outputs=("wrench",), num_envs=2, **options)


def closed(world: TactileWorld, steps: int) -> np.ndarray:
    """Wrenches of both pads [N, mN m] and place of the cube [mm] after every step, (steps, B, 15)."""
    opening, control, rows = world.composed.opening, np.tile(world.composed.ctrl, (2, 1)), []
    assert opening is not None
    for _ in range(steps):
        control[:, opening] -= CLOSING
        state = world.step(control)
        assert not state.failed.any()
        felt = [state.wrench[name] * [1.0, 1.0, 1.0, 1e3, 1e3, 1e3] for name in ("left", "right")]
        rows.append(np.concatenate([*felt, 1e3 * state.world_from_body["cube"][:, :3, 3]], axis=1))
    return np.array(rows)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("owner", ["mujoco", "ipc"])
def test_a_grip_is_that_of_c_mujoco(owner: str, device: str) -> None:
    world = grip(owner, engine="mujoco_warp", device=device)
    found, wanted = closed(world, 5), closed(grip(owner), 5)
    assert (-wanted[-1, :, 2] > [0.5, 1.0]).all()  # each environment its own force
    np.testing.assert_allclose(found, wanted, atol=2e-3)
    forces = found[-1, :, [2, 8]]
    np.testing.assert_allclose(forces[0], forces[1], rtol=0.01)  # the cube is in balance between the pads
    frame = world.observe()["left"]
    np.testing.assert_allclose(frame.wrench[:, 2], found[-1, :, 2], rtol=1e-12)
    assert frame.surface.contact.any(axis=(1, 2)).all()
    arrays = world.read("left").numpy()
    np.testing.assert_array_equal(arrays["wrench"], frame.wrench)


@pytest.mark.parametrize("device", DEVICES)
def test_the_host_is_given_poses_once_a_step_and_sums_once_a_solve(device: str) -> None:
    world = grip("mujoco", engine="mujoco_warp", device=device)
    pads, soft = world._pads, world.soft
    assert soft is not None
    closed(world, 2)
    before, sums = pads.copies, soft.world.sums.copies  # type: ignore[attr-defined]
    control = np.tile(world.composed.ctrl, (2, 1))
    solves = int(world.step(control).report["substeps"].max())
    steps = round(world.composed.control_timestep / world.composed.timestep)
    assert pads.copies - before == steps  # type: ignore[attr-defined]
    assert soft.world.sums.copies - sums <= solves + 1


def test_a_reset_puts_one_environment_back_and_it_does_the_same_again() -> None:
    world = grip("mujoco", engine="mujoco_warp", device="cpu")
    begin, first = world.state(), closed(world, 4)
    state = world.reset([1])
    assert state.time.tolist() == [pytest.approx(0.04), 0.0] and not state.wrench["left"][1].any()
    np.testing.assert_allclose(state.world_from_body["cube"][1], begin.world_from_body["cube"][1], atol=1e-7)
    assert state.wrench["left"][0, 2] == pytest.approx(first[-1, 0, 2], rel=1e-12)
    world.reset()
    np.testing.assert_allclose(closed(world, 4), first, atol=1e-3)
    inside = np.tile(np.eye(4), (2, 1, 1))
    inside[:, 1, 3] = 2e-3
    before = world.state()
    with pytest.raises(OverlapError):
        world.reset(bodies={"cube": inside})
    np.testing.assert_array_equal(world.state().world_from_body["cube"], before.world_from_body["cube"])


def test_what_soft_pads_on_mujoco_warp_cannot_do_is_refused() -> None:
    with pytest.raises(InputError, match="launches = 8: must be None with soft pads"):
        grip("mujoco", engine=WarpEngine(launches=8), device="cpu")
    world = grip("mujoco", engine="mujoco_warp", device="cpu")
    with pytest.raises(InputError, match="must be constant in a step"):
        world.step(lambda data, time: None)
    with pytest.raises(InputError, match=r"read world\.state"):
        _ = world.data
