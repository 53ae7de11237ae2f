"""Task scenes on MuJoCo Warp, driven by joint targets, against the same on C MuJoCo."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from raytac.errors import InputError
from raytac.robots.impedance import JointImpedance
from raytac.robots.joint_springs import JointSprings
from raytac.specs import RobotSpec, TaskScene
from raytac.world import TactileWorld
from raytac.world.world_state import BatchController

pytest.importorskip("mujoco_warp")
from experiments.bench_gpu import PRESS, Args, Bench, joint_table, scene_of
from raytac.world.warp_world import WarpWorld

pytestmark = pytest.mark.timeout(1200)  # the first test compiles MuJoCo Warp for the CPU: minutes


class Follow(BatchController):
    """Springs in the joints of all environments."""

    def __init__(self, springs: JointSprings) -> None:
        self._springs = springs

    def drive(self, datas: Sequence[Any], envs: Sequence[int] | np.ndarray) -> None:
        self._springs.drive(envs)


@pytest.mark.slow
@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_a_cube_is_pushed_as_by_c_mujoco(device: str) -> None:
    """Pressed on, then dragged for 50 control steps, in two worlds whose cubes lie differently: 0.5 mm, 3 % of the force."""
    args = Args(worlds=2, divided=2, device="cuda" if device == "cuda" else "cpu")
    bench, world = Bench(args), TactileWorld(scene_of(args), outputs=(), num_envs=2)
    table = joint_table(bench.world)
    for data, qpos in zip(world.data, bench.world.engine.data.qpos.numpy(), strict=True):
        data.qpos[:] = qpos
    assert world.arm is not None
    springs = JointImpedance(world.arm, frequency=30.0).springs(world.data)
    cube, off, apart = world.composed.bodies["cube"].qpos, [], np.zeros((2, 0))
    wrenches = []
    for k in range(50):
        speed = (table[k + 1] - table[k]) / world.control_timestep
        springs.aim(table[k][None], speed[None], np.array([data.time for data in world.data]))
        wanted = world.step(Follow(springs)).wrench["sensor"]
        bench.control_step()
        wrenches.append((wanted[:, :3], bench.world.contact.wrenches.numpy()[:, 0, :3].copy()))
        apart = np.array([data.qpos for data in world.data]) - bench.world.engine.data.qpos.numpy()
        off.append(np.abs(apart[:, cube : cube + 3]).max())
    bench.world.check()
    ours, found = (np.array(values) for values in zip(*wrenches, strict=True))
    assert max(off) < 0.5e-3
    assert np.linalg.norm(found - ours) < 0.03 * np.linalg.norm(ours)
    np.testing.assert_array_equal(found.any(axis=2), ours.any(axis=2))
    assert (-ours[PRESS + 5 :, :, 2] > 1.0).all() and np.abs(apart[:, :7]).max() < 1e-3


def test_a_world_holds_its_start_and_returns_to_it() -> None:
    world = WarpWorld("push_cube", num_envs=2, device="cpu")
    arm, start = world.composed.arm, world.composed.start
    assert arm is not None
    world.target.assign(start[arm.qpos] + np.array([[0.0], [0.02]]))
    for _ in range(4):
        world.step()
    world.check()
    joints = world.engine.data.qpos.numpy()[:, arm.qpos] - start[arm.qpos]
    assert np.abs(joints[0]).max() < 1e-4 and np.abs(joints[1]).min() > 2e-3
    before = world.engine.data.qpos.numpy()[0].copy()
    world.reset(envs=np.array([False, True]))
    qpos = world.engine.data.qpos.numpy()
    np.testing.assert_array_equal(qpos[0], before)
    np.testing.assert_array_equal(qpos[1], start.astype(np.float32))
    np.testing.assert_allclose(world.target.numpy(), np.tile(start[arm.qpos], (2, 1)), atol=1e-6)
    np.testing.assert_array_equal(world.engine.data.time.numpy() > 0.0, [True, False])


def test_what_a_world_on_mujoco_warp_cannot_be_is_refused() -> None:
    with pytest.raises(InputError, match="torque motors"):
        WarpWorld(TaskScene("none", RobotSpec("fixed_sensor"), ()), device="cpu")
    with pytest.raises(InputError, match="launches"):
        WarpWorld("push_cube", device="cpu", launches=1)
    world = WarpWorld("push_cube", device="cpu")
    with pytest.raises(InputError, match="qpos"):
        world.reset(np.zeros((1, 3)))
    with pytest.raises(InputError, match="envs"):
        world.reset(envs=np.array([0]))


def cubes(world: WarpWorld) -> np.ndarray:
    """Poses (B, 4, 4) of the cube."""
    return world.state["bodies"].numpy()[:, list(world.composed.bodies).index("cube")].copy()


def test_a_world_that_has_lost_contacts_is_not_active() -> None:
    """MuJoCo's contacts of the cube with the table do not fit; nobody may take its fall through it for sound."""
    world = WarpWorld("push_cube", num_envs=2, device="cpu", contacts=1, rows=64)
    height = cubes(world)[:, 2, 3]
    for _ in range(5):
        world.step()
    assert not world.engine.active.numpy().any()
    np.testing.assert_allclose(cubes(world)[:, 2, 3], height, atol=1e-5)
    with pytest.raises(InputError, match="contacts"):
        world.check()


def test_targets_are_written_in_place_alone() -> None:
    world = WarpWorld("push_cube", device="cpu")
    for name in ("target", "target_speed", "tool_target", "tool_twist", "opening"):
        with pytest.raises(AttributeError):
            setattr(world, name, world.target)


def test_starts_that_are_no_positions_are_refused() -> None:
    world = WarpWorld("push_cube", device="cpu")
    with pytest.raises(InputError, match="qpos"):
        world.reset(np.full((1, world.composed.model.nq), np.nan))
    with pytest.raises(InputError, match="cube"):
        world.reset(bodies={"cube": np.full((1, 4, 4), np.nan)})
    with pytest.raises(InputError, match="free body"):
        world.reset(bodies={"ball": np.eye(4)[None]})


def test_bodies_start_where_they_are_put_in_the_worlds_of_a_mask_alone() -> None:
    world = WarpWorld("push_cube", num_envs=2, device="cpu")
    start = cubes(world)
    poses = start.copy()
    poses[:, 0, 3] += 0.05
    poses[:, :3, :3] = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    world.reset(envs=np.array([False, True]), bodies={"cube": poses})
    np.testing.assert_allclose(cubes(world), [start[0], poses[1]], atol=1e-6)
    world.reset(envs=np.array([False, True]))  # which does not remember it
    np.testing.assert_allclose(cubes(world), start, atol=1e-6)
