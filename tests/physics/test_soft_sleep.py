"""Sleep of soft scenes: what sleeps, what wakes it in time, and that nobody could tell."""

from __future__ import annotations

import numpy as np
import pytest

from raytac.errors import InputError
from raytac.physics.soft.bodies import ScenePad, scene_body
from raytac.physics.soft.mesh import PadLevel, pad_mesh
from raytac.physics.soft.scene import SoftScene
from raytac.physics.soft.substeps import Sleep
from raytac.se3 import rotations
from raytac.shapes.part import primitive
from raytac.specs import load_sensor

SENSOR = load_sensor("gelsight_mini")
MESH = pad_mesh(SENSOR.gelpad, PadLevel(3e-3, 2, 1.5, 1.5, 5e-5))
RADIUS = 4e-3
FAR = 30e-3
TOLERANCE = 2e-8
"""Of a soft scene [m]."""


def ball_at(gap: float | np.ndarray) -> np.ndarray:
    """Pose of a ball whose lowest point is ``gap`` above a pad at the origin."""
    pose = np.tile(np.eye(4), (*np.shape(gap), 1, 1))
    pose[..., 2, 3] = RADIUS + np.asarray(gap)
    return pose


def ball_over_pad(gap: float | np.ndarray = FAR, num_envs: int | None = None, **changes) -> SoftScene:
    """A driven ball over one pad that looks up."""
    ball = scene_body("ball", (primitive("sphere", (RADIUS,)),), "kinematic")
    return SoftScene(
        [ScenePad("pad", SENSOR, MESH)], [ball], np.eye(4)[None], {"ball": ball_at(gap)}, num_envs=num_envs, **changes
    )


def settled(scene: SoftScene) -> SoftScene:
    """Step until all environments sleep."""
    for _ in range(4):
        scene.step(scene.pose("pad")[:, None])
    assert scene.asleep.all()
    return scene


def waking(scene: SoftScene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep every scene from sleeping, from now on."""
    monkeypatch.setattr(Sleep, "choose", lambda self, now, goal: np.zeros(scene.num_envs, bool))


def test_a_pad_in_the_air_sleeps_and_says_so():
    scene = ball_over_pad()
    first = scene.step(np.eye(4)[None])
    assert not scene.asleep.any() and first.substeps.tolist() == [1] and first.newton[0] > 0
    report = [scene.step(np.eye(4)[None]) for _ in range(3)][-1]
    assert scene.asleep.all() and report.substeps.tolist() == [0] and report.newton.tolist() == [0]
    assert report.converged.all() and not report.failed.any() and report.blocked[0] == 0.0 and np.isinf(report.min_gap[0])
    assert scene.wrench("pad")[0] == pytest.approx(np.zeros(6))


def test_what_comes_within_one_step_meets_the_gel():
    """From 5 mm to 0.3 mm deep in one step of 10 ms, at half a metre a second, onto a pad that slept through the step before."""
    scene = settled(ball_over_pad(5e-3))
    report = scene.step(np.eye(4)[None], {"ball": ball_at(-0.3e-3)})
    assert not scene.asleep.any() and report.min_gap[0] > 0.0 and report.min_det[0] > 0.3 and report.blocked[0] == 0.0
    assert scene.world.overlap() is None and scene.wrench("pad")[0, 2] < -0.05
    slow = ball_over_pad(1e-3)
    for gap in np.linspace(0.9e-3, -0.3e-3, 13):
        slow.step(np.eye(4)[None], {"ball": ball_at(gap)})
    for one in (scene, slow):
        for _ in range(2):
            one.step(np.eye(4)[None])
    assert scene.wrench("pad")[0, 2] == pytest.approx(slow.wrench("pad")[0, 2], rel=1e-2)


def test_what_comes_too_fast_is_refused_and_not_slept_through():
    """Through the pad and beyond in one step: it begins and ends far from the gel."""
    scene = settled(ball_over_pad(FAR))
    through = ball_at(-FAR - 2 * RADIUS - 10e-3)
    with pytest.raises(InputError, match="pad and ball too far"):
        scene.step(np.eye(4)[None], {"ball": through})
    aside = scene.pose("ball")[0] @ np.array([[1.0, 0, 0, 0.2], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    settled(scene)
    scene.step(np.eye(4)[None], {"ball": aside})  # as far in one step, but past the pad
    assert scene.asleep.all()


def test_a_body_that_flies_wakes_the_pad_in_time():
    cube = scene_body("cube", (primitive("box", (3e-3,) * 3),), "affine", density=1000.0)
    start = np.eye(4)
    start[2, 3] = 3e-3 + 15e-3
    scene = SoftScene([ScenePad("pad", SENSOR, MESH)], [cube], np.eye(4)[None], {"cube": start}, gravity=(0.0, 0.0, 0.0))
    settled(scene)
    scene.world.set_velocity("cube", (0.0, 0.0, -1.2))  # 12 mm a step
    for _ in range(3):
        report = scene.step(np.eye(4)[None])
        assert not scene.asleep.any() and report.min_gap[0] > 0.0 and report.min_det[0] > 0.3
    assert scene.world.overlap() is None and scene.pose("cube")[0, 2, 3] > 0.0


def test_a_pad_released_sleeps_once_it_has_come_to_rest(monkeypatch):
    """And then lies where one lies that never slept, through moves in the air, a press, and a release."""
    places = np.zeros((24, 3))
    places[:8, 0] = 1e-2 * (1.0 - np.cos(np.linspace(0.0, 2.0 * np.pi, 8)))  # up to 0.8 g
    places[16:, 2] = -2e-3 * np.arange(8) ** 1.5  # away, and on
    turn = np.zeros((24, 3))
    turn[16:, 1] = 0.02 * np.arange(8)
    gaps = np.concatenate([np.full(8, 4e-3), [2e-3, 0.5e-3, 0.0, -0.3e-3, -0.3e-3, 0.2e-3, 2e-3], np.full(9, 4e-3)])
    found: dict[str, list] = {"sleeping": [], "waking": []}
    for kind, states in found.items():
        scene = settled(ball_over_pad(4e-3))
        if kind == "waking":
            waking(scene, monkeypatch)
        for place, angle, gap in zip(places, turn, gaps, strict=True):
            pad = np.eye(4)
            pad[:3, :3], pad[:3, 3] = rotations(angle), place
            scene.step(pad[None], {"ball": pad @ ball_at(gap)})
            states.append((scene.coat("pad")[0], scene.wrench("pad")[0], scene.bond_wrench("pad")[0], bool(scene.asleep[0])))
    asleep = [state[3] for state in found["sleeping"]]
    assert not any(state[3] for state in found["waking"])
    touched = [k for k, state in enumerate(found["sleeping"]) if np.abs(state[1]).max() > 0.0]
    assert touched and not any(asleep[k] for k in range(touched[0], touched[-1] + 2)) and all(asleep[1:7]) and all(asleep[-6:])
    moved = np.abs(found["waking"][3][0] - found["waking"][0][0]).max()
    assert moved > 5 * TOLERANCE  # the gel bends as its case is moved
    for one, two in zip(found["sleeping"], found["waking"], strict=True):
        assert np.linalg.norm(one[0] - two[0], axis=1).max() < 2 * TOLERANCE
        assert one[1] == pytest.approx(two[1], abs=1e-3 * max(np.abs(two[1]).max(), 1e-6))
        assert one[2][:3] == pytest.approx(two[2][:3], abs=1e-3)


def test_an_environment_sleeps_and_wakes_as_it_would_alone():
    both = ball_over_pad(np.array([FAR, 1e-3]))
    singles = [ball_over_pad(FAR), ball_over_pad(1e-3)]
    for gap in (0.5e-3, 0.1e-3, -0.2e-3, -0.2e-3, 3e-3, 3e-3, 3e-3):
        gaps = FAR, gap
        report = both.step(np.eye(4)[None], {"ball": np.stack([ball_at(one) for one in gaps])})
        for env, single in enumerate(singles):
            alone = single.step(np.eye(4)[None], {"ball": ball_at(gaps[env])})
            assert alone.substeps[0] == report.substeps[env] and single.asleep[0] == both.asleep[env]
            assert np.array_equal(single.coat("pad")[0], both.coat("pad")[env])
            assert np.array_equal(single.wrench("pad")[0], both.wrench("pad")[env])
    assert both.asleep.all()


def test_a_cube_that_slides_does_not_divide_the_step_of_a_pad_that_is_pressed():
    cube = scene_body("cube", (primitive("box", (3e-3,) * 3),), "affine", density=1000.0, friction=0.3)
    bodies = [
        scene_body("ball", (primitive("sphere", (RADIUS,)),), "kinematic"),
        cube,
        scene_body("table", (), "half_space", friction=0.3),
    ]
    beside, below = np.eye(4), np.eye(4)
    below[2, 3] = -0.1
    beside[:3, 3] = 0.2, 0.0, -0.1 + 3e-3 + 5e-5
    scene = SoftScene(
        [ScenePad("pad", SENSOR, MESH)], bodies, np.eye(4)[None], {"ball": ball_at(0.2e-3), "cube": beside, "table": below}
    )
    for gap in (0.1e-3, 0.0, -0.1e-3, -0.2e-3, -0.2e-3):
        scene.step(np.eye(4)[None], {"ball": ball_at(gap)})
    scene.world.set_velocity("cube", (0.5, 0.0, 0.0))
    speeds = [0.5]
    for _ in range(10):
        report = scene.step(np.eye(4)[None])
        assert report.substeps.tolist() == [1] and report.converged.all() and not report.blocked.any()
        speeds.append(float(scene.velocity("cube")[0, 0]))
    assert np.diff(speeds) == pytest.approx(-0.3 * 9.81 * 0.01, rel=0.03)  # Coulomb's law: a = μ g
