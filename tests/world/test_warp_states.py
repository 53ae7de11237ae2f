"""``TactileWorld`` on MuJoCo Warp, through the same face as on C MuJoCo."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest
import warp as wp

from raytac import mount
from raytac.errors import InputError, OverlapError
from raytac.world import TactileWorld, Variation, WarpEngine, WorldState

pytestmark = pytest.mark.timeout(1200)  # the first test compiles MuJoCo Warp for the CPU: minutes

pytest.importorskip("mujoco_warp")

FREE = """
<mujoco>
  <option timestep="{timestep}" gravity="{tilt} 0 -9.81" cone="elliptic" integrator="implicitfast"/>
  <worldbody>
    <site name="pad" pos="0 0 0.1"/>
    <body name="ball" pos="0 0 {z}"><freejoint/><geom name="ball" type="sphere" size="0.01" mass="0.05"/></body>
  </worldbody>
</mujoco>"""


def world(
    engine: str | WarpEngine,
    num_envs: int = 2,
    z: float = 0.1101,
    tilt: float = 0.0,
    timestep: float = 0.002,
    **settings: Any,
) -> TactileWorld:
    """A ball above a pad that looks upwards."""
    spec = mujoco.MjSpec.from_string(FREE.format(z=z, tilt=9.81 * tilt, timestep=timestep))
    mount(spec, "gelsight_mini_7x9", site="pad", name="left", pose=np.eye(4))
    settings = {"outputs": ("wrench", "height"), "pitch": 0.4e-3, "control_timestep": 0.01, "device": "cpu", **settings}
    return TactileWorld(spec, touches={"ball": 0.8}, num_envs=num_envs, engine=engine, **settings)


def assert_same_places(ours: WorldState, wanted: WorldState) -> None:
    """Places within 0.5 mm, and nothing has failed."""
    assert not ours.failed.any() and not wanted.failed.any()
    one, other = (state.world_from_body["ball"][:, :3, 3] for state in (ours, wanted))
    np.testing.assert_allclose(one, other, atol=0.5e-3)


def test_a_ball_presses_a_pad_as_on_c_mujoco_and_its_frame_shows_the_same() -> None:
    """A bounce and its end, by steps so short that C MuJoCo, which divides steps, has the same impact."""
    ours, wanted = (world(engine, z=0.11, timestep=0.0005) for engine in ("mujoco_warp", "mujoco"))
    forces = []
    for _ in range(8):
        one, other = ours.step(), wanted.step()
        assert_same_places(one, other)
        forces.append((one.wrench["left"][:, :3], other.wrench["left"][:, :3]))
    force, reference = np.swapaxes(forces, 0, 1)
    assert np.linalg.norm(force - reference) < 0.03 * np.linalg.norm(reference)
    np.testing.assert_allclose(one.time, 0.08, rtol=1e-5)
    frame, shown = ours.observe()["left"], wanted.observe()["left"]
    assert shown.force[0, 2] < -0.3 and shown.surface.indentation.max() > 5e-5
    np.testing.assert_allclose(frame.wrench[:, 2], shown.wrench[:, 2], rtol=0.03)
    np.testing.assert_allclose(frame.height, shown.height, atol=2e-6)


def test_variations_reach_the_physics_of_the_environments_named() -> None:
    moved = np.tile(np.eye(4), (1, 1, 1))
    moved[:, 2, 3] = -0.5e-3
    variation = Variation(mass={"ball": np.array([2.0])}, gel_stiffness={"left": np.array([0.5])}, mounting={"left": moved})
    ours, wanted = world("mujoco_warp"), world("mujoco")
    for one in (ours, wanted):
        one.reset([1], variation=variation)
    for _ in range(25):
        state, reference = ours.step(), wanted.step()
    assert_same_places(state, reference)
    np.testing.assert_allclose(state.wrench["left"][:, 2], reference.wrench["left"][:, 2], rtol=0.03)
    load = -state.wrench["left"][:, 2]
    assert load[1] == pytest.approx(2.0 * load[0], rel=0.02)
    height = state.world_from_body["ball"][:, 2, 3]
    assert height[1] < height[0] - 0.5e-3
    ours.reset(variation=Variation())
    for _ in range(25):
        state = ours.step()
    np.testing.assert_allclose(state.wrench["left"][1], state.wrench["left"][0], atol=1e-6)


def test_friction_of_an_environment_decides_how_fast_a_ball_slips() -> None:
    """Gravity is tilted by 20°: a ball rolls, or slips past the pad's middle without it."""
    ours, wanted = world("mujoco_warp", tilt=0.36), world("mujoco", tilt=0.36)
    for one in (ours, wanted):
        one.reset([1], variation=Variation(friction={"ball": np.array([0.02])}))
    for _ in range(12):
        state, reference = ours.step(), wanted.step()
    assert_same_places(state, reference)
    along = state.world_from_body["ball"][:, 0, 3]
    assert along[1] > 1.2 * along[0] > 0.0


def test_a_reset_leaves_the_other_environments_to_the_bit() -> None:
    ours = world("mujoco_warp", num_envs=3)
    for _ in range(10):
        ours.step()
    before, poses = ours.state(), np.tile(np.eye(4), (1, 1, 1))
    poses[0, :3, 3] = 0.001, 0.0, 0.112
    after = ours.reset(np.array([False, True, False]), bodies={"ball": poses})
    for name in ("world_from_body", "world_from_pad", "wrench"):
        for key, values in getattr(before, name).items():
            np.testing.assert_array_equal(getattr(after, name)[key][[0, 2]], values[[0, 2]])
    np.testing.assert_array_equal(after.time > 0.0, [True, False, True])
    np.testing.assert_allclose(after.world_from_body["ball"][1], poses[0], atol=1e-6)
    assert not after.wrench["left"][1].any()


def test_constant_controls_move_an_arm_and_none_holds_it_as_on_c_mujoco() -> None:
    ours, wanted = (TactileWorld("ball_rolling", outputs=(), engine=name, device="cpu") for name in ("mujoco_warp", "mujoco"))
    torque = wanted.data[0].qfrc_bias[wanted.arm.dof].copy() if wanted.arm is not None else np.zeros(0)
    torque[3] += 3.0
    on_device = wp.array(torque[None].astype(np.float32), dtype=wp.float32, device="cpu")
    for control in (torque, on_device, None, None):
        state = ours.step(control)  # pyright: ignore[reportArgumentType]
        reference = wanted.step(torque if control is not None else None)
        assert state.joints is not None and reference.joints is not None
        np.testing.assert_allclose(state.joints, reference.joints, atol=2e-5)
    assert np.abs(reference.joints - wanted.composed.start[wanted.arm.qpos]).max() > 1e-3  # type: ignore[union-attr]


def test_what_mujoco_warp_cannot_do_is_refused_when_the_world_is_made() -> None:
    with pytest.raises(InputError, match=r"engine.*mujoco_warp"):
        world("isaac")
    with pytest.raises(InputError, match="engine"):
        world(3)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="launches"):
        world(WarpEngine(launches=1))
    with pytest.raises(InputError, match="must not start beyond"):
        world("mujoco_warp", z=0.09)


def test_a_start_that_cannot_be_changes_nothing() -> None:
    ours = world("mujoco_warp")
    for _ in range(5):
        before = ours.step()
    poses = np.tile(np.eye(4), (1, 1, 1))
    poses[0, :3, 3] = 0.0, 0.0, 0.09
    with pytest.raises(OverlapError, match="environment 1"):
        ours.reset([1], bodies={"ball": poses}, variation=Variation(mass={"ball": np.array([2.0])}))
    np.testing.assert_array_equal(ours.state().world_from_body["ball"], before.world_from_body["ball"])
    assert not ours.models.differ([0, 1])
    with pytest.raises(InputError, match=r"control.*NumPy array"):
        ours.step(lambda data, time: None)
    with pytest.raises(InputError, match="control"):
        ours.step(np.zeros(3))
    with pytest.raises(InputError, match=r"data.*mujoco"):
        _ = ours.data


def test_contacts_that_do_not_fit_are_an_error_that_names_the_number_to_set() -> None:
    ours = TactileWorld("push_cube", outputs=(), num_envs=2, engine=WarpEngine(contacts=1, rows=64), device="cpu")
    with pytest.raises(InputError, match=r"contacts.*or more"):
        for _ in range(5):
            ours.step()
    assert ours.failed.all()


def test_readings_on_the_device_share_its_memory_and_are_what_the_host_observes() -> None:
    ours = world("mujoco_warp", z=0.11, markers="fots_published", pitch=0.8e-3)
    frame = ours.read("left")
    rest = frame.numpy()
    for _ in range(8):
        ours.step()
        host = ours.observe()["left"]
    now = ours.read("left").numpy()
    assert set(now) == {"wrench", "active", "height", "contact", "markers"} and now["active"].all()
    np.testing.assert_array_equal(frame.numpy()["wrench"], now["wrench"])
    assert (
        now["wrench"][0, 2] < -0.3 and not rest["wrench"].any() and now["contact"].any() and np.abs(now["markers"]).max() > 1e-6
    )
    np.testing.assert_array_equal(now["wrench"], ours.state().wrench["left"])
    np.testing.assert_allclose(now["height"], host.height, atol=2e-6)
    ours.reset([1])
    after = ours.read("left").numpy()
    assert not after["wrench"][1].any() and not np.array_equal(after["markers"][1], now["markers"][1])
    for name, values in now.items():
        np.testing.assert_array_equal(after[name][0], values[0])
    torch = pytest.importorskip("torch")
    tensors = frame.torch()
    assert {tensors[name].data_ptr() for name in ("active", "height", "markers")} == {
        int(array.ptr or 0) for array in (frame.active, frame.height, frame.markers) if array is not None
    }
    before = tensors["height"].clone()
    ours.step()
    np.testing.assert_array_equal(tensors["wrench"].numpy(), ours.state().wrench["left"])
    assert tensors["wrench"][0, 2] < -0.3
    ours.reset()
    assert not tensors["wrench"].any()
    assert not torch.equal(tensors["height"], before)


def test_readings_on_a_device_need_mujoco_warp_and_what_it_has() -> None:
    with pytest.raises(InputError, match="mujoco_warp"):
        world("mujoco").read("left")
    ours = world("mujoco_warp", outputs=("wrench",))
    assert set(ours.read("left").numpy()) == {"wrench", "active"}
    with pytest.raises(InputError, match=r"sensor = 'right'.*left"):
        ours.read("right")
