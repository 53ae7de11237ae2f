"""Bodies, gels and mounts that differ between environments of one world: drawn again at every reset, and acting as physics says."""

from __future__ import annotations

import numpy as np
import pytest

from raytac.envs import BalancePoleVectorEnv, PushCubeEnv, PushCubeVectorEnv, RollBallVectorEnv
from raytac.envs.balance_pole import BalancePole
from raytac.envs.batch import TaskBatch, TaskOptions
from raytac.envs.push_cube import PushCube
from raytac.errors import InputError
from raytac.observe import Randomization
from raytac.se3 import pose_error
from raytac.specs.task import BodySpec, RobotSpec, TaskScene
from raytac.world.environment_models import Variation
from raytac.world.world import TactileWorld


def equal(a: dict, b: dict) -> bool:
    return a.keys() == b.keys() and all(np.array_equal(a[k], b[k]) for k in a)


def test_bodies_and_mounts_are_drawn_at_every_reset_of_an_environment() -> None:
    widths = {"body_mass": 0.3, "body_friction": 0.2, "youngs_modulus": 0.2, "friction": 0.2, "pad_shift": 1e-3, "pad_turn": 0.02}
    batch = TaskBatch(PushCube(), num_envs=4, tactile=None, seed=0, randomization=Randomization(**widths))  # type: ignore[arg-type]
    world, cube, table = batch.world, batch.world.composed.bodies["cube"], batch.world.composed.bodies["table"]
    nominal = world.state().world_from_pad["sensor"][0]

    def drawn() -> np.ndarray:
        """Of every environment: mass, friction on the table's side and on the gel's, table's friction, gel, pad's place and turn."""
        models = [world.models[b] for b in range(4)]
        own = [[m.body_mass[cube.index], m.geom_friction[m.body_geomadr[cube.index], 0]] for m in models]
        gel = world.models.friction_on_gel[:, list(world.composed.bodies).index("cube")]
        other = [m.geom_friction[m.body_geomadr[table.index], 0] for m in models]
        off = pose_error(nominal, world.state().world_from_pad["sensor"])
        soft = world.models.gel_stiffness[:, 0], world.models.gel_friction[:, 0] / world.composed.sensor_specs[0].gelpad.friction
        return np.column_stack([np.array(own) / [0.05, 0.2], gel, np.array(other) / 0.2, *soft, off])

    streams = [np.random.default_rng(b) for b in range(4)]
    batch.reset(range(4), streams)
    first = drawn()
    assert np.ptp(first, axis=0).min() > 1e-4 and (np.ptp(first[:, :6], axis=0) > 0.05).all()
    assert (np.abs(first[:, :6] - 1.0) <= [0.3, 0.2, 0.2, 0.2, 0.2, 0.2]).all() and np.abs(first[:, 6:9]).max() <= 1e-3
    assert 0.0 < np.abs(first[:, 9:]).max() <= 0.0201
    np.testing.assert_allclose(first[:, 1], first[:, 2])
    assert np.abs(batch.control.state().tool - batch.start_tool).max() < 1e-9, "the arm knows nothing of it"
    batch.reset([1], streams[1:2])
    second = drawn()
    assert (second[[0, 2, 3]] == first[[0, 2, 3]]).all() and (second[1] != first[1]).all()
    batch.reseed(range(4), range(4))
    batch.reset(range(4), streams)
    np.testing.assert_array_equal(drawn(), first)
    # What is asked of one thing does not change what is drawn of another.
    alone = TaskBatch(PushCube(), tactile=None, seed=2, randomization=Randomization(pad_shift=1e-3))
    alone.reset([0], streams[:1])
    at = alone.world.state().world_from_pad["sensor"][0]
    np.testing.assert_allclose(pose_error(nominal, at)[:3], first[2, 6:9], atol=1e-12)
    assert alone.world.models[0].body_mass[cube.index] == 0.05


def test_environments_that_differ_are_the_single_ones_of_their_seeds_too() -> None:
    differs = Randomization(body_mass=0.5, body_friction=0.3, pad_shift=5e-4, pad_turn=0.02)
    options = {"randomization": differs, "tactile": ("wrench",), "max_episode_steps": 7}
    many, plain = PushCubeVectorEnv(3, **options), PushCubeVectorEnv(3, tactile=("wrench",), max_episode_steps=7)
    alone = [PushCubeEnv(**options) for _ in range(3)]
    seen, same = many.reset(seed=7)[0], plain.reset(seed=7)[0]
    mine = [env.reset(seed=7 + b)[0] for b, env in enumerate(alone)]
    assert equal(seen, same), "an episode starts as it would without"
    rng = np.random.default_rng(0)
    for step in range(10):  # beyond the end of the first episode
        for b in range(3):
            for name, values in mine[b].items():
                np.testing.assert_allclose(values, seen[name][b], atol=1e-5, err_msg=f"{step} {b} {name}")
        actions = rng.uniform(-1, 1, (3, 3)).astype(np.float32)
        actions[:, 2] = -1.0
        seen, same = many.step(actions)[0], plain.step(actions)[0]
        for b, env in enumerate(alone):
            mine[b], _, terminated, truncated, _ = env.step(actions[b])
            if terminated or truncated:
                mine[b] = env.reset()[0]
        if step == 5:
            pressed, usual = -seen["sensor_wrench"][:, 2], -same["sensor_wrench"][:, 2]
            assert (usual > 0.0).any() and (np.abs(pressed - usual) > 1e-3).any(), "it does nothing"


def test_a_heavier_cube_rises_slower_and_a_smoother_one_slides_further() -> None:
    """Newton's laws tell that a mass and a coefficient in the model are those that act."""
    world = TactileWorld("push_cube", outputs=(), num_envs=3)
    factors = np.array([1.0, 2.0, 1.0])
    smooth = {name: np.array([1.0, 1.0, 0.5]) for name in ("cube", "table")}
    away = world.state().world_from_body["cube"]
    away[:, 1, 3] = 0.15  # from under the pad
    world.reset(bodies={"cube": away}, variation=Variation(mass={"cube": factors}, friction=smooth))
    cube = world.composed.bodies["cube"]
    dof = int(world.model.jnt_dofadr[world.model.body_jntadr[cube.index]])
    for _ in range(10):
        world.step()
    for data in world.data:
        data.qvel[dof] = 0.2
    before = world.state().world_from_body["cube"][:, 0, 3]
    for _ in range(20):
        world.step()
    way = world.state().world_from_body["cube"][:, 0, 3] - before
    expected = 0.2**2 / (2.0 * 9.81 * 0.2) * np.array([1.0, 1.0, 2.0])  # v² / (2 μ g), whatever the mass
    np.testing.assert_allclose(way, expected, rtol=0.15)
    lift = 1.5 * 2.0 * 9.81 * 0.05  # [N]
    for data in world.data:
        data.xfrc_applied[cube.index, 2] = lift
    world.step()
    world.step()
    speed = [data.qvel[dof + 2] for data in world.data]
    np.testing.assert_allclose(speed, (lift / (0.05 * factors) - 9.81) * 0.04, rtol=0.05)


def _ball_on_a_pad() -> TaskScene:
    """Half a kilogram on a pad that looks up."""
    robot = RobotSpec("fixed_sensor", "gelsight_mini_9x11")
    ball = BodySpec("ball", "sphere", {"radius": 5e-3}, position=(0.0, 0.0, 5e-3), mass=0.5)
    return TaskScene("ball_on_a_pad", robot, (ball,), timestep=2e-3, soft_timestep=1e-2, control_timestep=1e-2)


def test_a_softer_gel_gives_way_further_under_a_ball_that_lies_on_it() -> None:
    gel = TactileWorld(_ball_on_a_pad(), outputs=("wrench",), num_envs=3)
    differs = Variation(gel_stiffness={"sensor": np.array([1.0, 0.5, 2.0])}, gel_friction={"sensor": np.array([1.0, 1.0, 0.5])})
    gel.reset(variation=differs)
    for _ in range(90):  # the softest has settled
        state = gel.step()
    weight = 9.81 * 0.5
    np.testing.assert_allclose(-state.wrench["sensor"][:, 2], weight, rtol=1e-3)
    depth = 5e-3 - state.world_from_body["ball"][:, 2, 3]
    assert depth[1] > depth[0] > depth[2] > 1e-4
    slip = np.array([data.contact.friction[-1, 0] for data in gel.data])  # the pads' contacts come last
    np.testing.assert_allclose(slip, gel.composed.sensor_specs[0].gelpad.friction * np.array([1.0, 1.0, 0.5]))
    # What bears F at half the modulus bears 2 F at the whole.
    whole = TactileWorld(_ball_on_a_pad(), outputs=("wrench",), num_envs=2)
    whole.reset(variation=Variation(mass={"ball": np.array([2.0, 0.5])}))
    for _ in range(60):
        other = whole.step()
    np.testing.assert_allclose(depth[1:], 5e-3 - other.world_from_body["ball"][:, 2, 3], rtol=2e-3)


def test_a_pole_stands_on_a_pad_that_is_mounted_askew() -> None:
    many = BalancePoleVectorEnv(4, tactile=("wrench",), randomization=Randomization(pad_shift=2e-3, pad_turn=0.01))
    many.reset(seed=0)
    state = many.batch.world.state()
    assert np.ptp(state.world_from_pad["sensor"][:, 2, 3]) > 5e-4
    for _ in range(3):
        seen, *_, infos = many.step(np.zeros((4, 2), np.float32))
    assert not infos["failed"].any() and (np.abs(10.0 * seen["sensor_wrench"][:, 2] + 0.49) < 0.25).all()


def test_a_pole_starts_to_a_turned_pad_as_to_a_straight_one() -> None:
    """Its foot, 4 mm wide and off the pad's middle, was up to a millimetre inside a pad that was turned by 0.2 rad."""
    places = []
    for turn in (0.0, 0.2):
        batch = TaskBatch(BalancePole(), num_envs=4, tactile=None, randomization=Randomization(pad_shift=1e-3, pad_turn=turn))
        batch.reset(range(4), [np.random.default_rng(b) for b in range(4)])
        state = batch.world.state()
        places.append(np.linalg.inv(state.world_from_pad["sensor"]) @ state.world_from_body["pole"])
    np.testing.assert_allclose(places[0], places[1], atol=1e-9)


def test_variations_that_cannot_be_are_told_and_change_nothing() -> None:
    world = TactileWorld("push_cube", outputs=(), num_envs=2)
    for variation, text in (
        (Variation(mass={"table": np.ones(2)}), "'table'.*cube"),
        (Variation(friction={"cup": np.ones(2)}), "'cup'"),
        (Variation(mass={"cube": np.ones(3)}), r"shape \(2,\)"),
        (Variation(mass={"cube": np.array([1.0, 0.0])}), "row 1"),
        (Variation(mounting={"sensor": np.zeros((2, 4, 4))}), "rigid"),
    ):
        with pytest.raises(InputError, match=text):
            world.reset(variation=variation)
    assert not world.models.differ(range(2))
    for wrong, text in (({"pad_shift": -1e-3}, "pad_shift"), ({"pad_turn": 2.0}, "0.5"), ({"body_mass": 1.0}, "relative")):
        with pytest.raises(InputError, match=text):
            Randomization(**wrong)  # type: ignore[arg-type]


@pytest.mark.slow
def test_soft_pads_are_mounted_off_their_drawing_too_and_bodies_are_drawn_once() -> None:
    options: TaskOptions = {
        "physics": "ipc",
        "tactile": ("wrench",),
        "randomization": Randomization(pad_shift=3e-4, body_mass=0.3),
    }
    many = RollBallVectorEnv(2, **options)
    many.reset(seed=3)
    pads = many.batch.world.state().world_from_pad["sensor"]
    assert np.abs(pads[0] - pads[1]).max() > 1e-5
    models, ball = many.batch.world.models, many.batch.world.composed.bodies["ball"].index
    usual = RollBallVectorEnv(1, physics="rigid", tactile=None).batch.world.model.body_mass[ball]
    assert models[0].body_mass[ball] == models[1].body_mass[ball] != usual
    options["physics"] = "rigid"
    rigid = RollBallVectorEnv(2, **options)
    rigid.reset(seed=3)
    np.testing.assert_allclose(pads, rigid.batch.world.state().world_from_pad["sensor"], atol=1e-9)
    seen = many.step(np.zeros((2, 3), np.float32))[0]
    assert many.observation_space.contains(seen)
    with pytest.raises(InputError, match="needs the rigid pad"):
        many.batch.world.reset(variation=Variation(mass={"ball": np.ones(2)}))
