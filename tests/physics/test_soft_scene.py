"""Soft scenes: several pads and bodies, driven by poses; contact seen by each pad; motions cut where they must be."""

from __future__ import annotations

import numpy as np
import pytest

import ipc
from ipc.contact import overlap
from raytac.errors import InputError, OverlapError
from raytac.physics.soft.bodies import ScenePad, scene_body
from raytac.physics.soft.mesh import PadLevel, pad_mesh
from raytac.physics.soft.scene import SoftScene
from raytac.physics.soft.settings import SceneSettings, SubstepLimits
from raytac.physics.soft.substeps import BoxMotion, allowed_share
from raytac.shapes.part import primitive
from raytac.specs import load_sensor

SENSOR = load_sensor("gelsight_mini")
MESH = pad_mesh(SENSOR.gelpad, PadLevel(3e-3, 2, 1.5, 1.5, 5e-5))
HALF = 5e-3
LEFT = np.column_stack([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
RIGHT = np.column_stack([[-1.0, 0, 0], [0, 0, -1], [0, -1, 0]])


def pose(rotation=None, position=(0.0, 0.0, 0.0)):
    matrix = np.eye(4)
    if rotation is not None:
        matrix[:3, :3] = rotation
    matrix[:3, 3] = position
    return matrix


def fingers(gap, z=0.0, x=0.0):
    """Two pads that look at each other along y, their middles ``gap`` off the faces of a cube of 10 mm."""
    return np.stack([pose(LEFT, (x, -HALF - gap, z)), pose(RIGHT, (x, HALF + gap, z))])


def two_pads(kind="affine", mass=0.01, gravity=(0.0, 0.0, 0.0), num_envs=None, gap=0.2e-3, **settings):
    cube = scene_body("cube", (primitive("box", (HALF,) * 3),), kind, density=mass / (2 * HALF) ** 3, **settings)
    pads = [ScenePad("left", SENSOR, MESH), ScenePad("right", SENSOR, MESH)]
    return SoftScene(pads, [cube], fingers(gap), {"cube": np.eye(4)}, gravity=gravity, num_envs=num_envs)


def test_a_cube_between_two_pads_is_pressed_by_both_alike_and_seen_by_each():
    scene = two_pads()
    for gap in (0.1e-3, 0.0, -0.1e-3, -0.1e-3):
        report = scene.step(fingers(gap))
    assert report.converged.all() and not report.failed.any() and report.min_gap[0] > 0.0 and report.min_det[0] > 0.5
    left, right = scene.wrench("left")[0], scene.wrench("right")[0]
    assert left[1] < -1.0 and left[:3] == pytest.approx(-right[:3], abs=2e-3 * abs(left[1]))
    assert np.abs(scene.body_wrench("cube")[0, :3] + left[:3] + right[:3]).max() < 1e-6 * abs(left[1])
    for name in ("left", "right"):
        bond = scene.bond_wrench(name)[0]
        assert bond[:3] == pytest.approx(scene.wrench(name)[0, :3], abs=0.01 * abs(left[1]))
        reading = scene.reading(name)
        touched = reading.surface.contact[0]
        assert touched.sum() * 1e-8 == pytest.approx((2 * HALF) ** 2, rel=0.3)
        assert reading.forces[0, :, 2].sum() == pytest.approx(-abs(left[1]), rel=1e-3)
        # The flat face is shown where the coat is, and at the pose that the reading names.
        assert np.abs(reading.underside[0] - reading.surface.height[0])[touched].max() < 2e-5


def test_travel_through_the_air_leaves_pads_as_they_are():
    """Far from everything one step may go any way; the gel keeps its shape but for its own inertia."""
    scene = two_pads(gap=5e-3)
    rest = scene.coat("left")
    away = fingers(5e-3, z=0.3, x=-0.1)
    report = scene.step(away)
    assert report.substeps == 1 and scene.pose("left")[0] == pytest.approx(away[0], abs=1e-12)
    for _ in range(5):
        scene.step(away)
    assert np.abs(scene.coat("left") - rest).max() < 1e-7


def test_a_fast_approach_is_cut_and_a_too_fast_one_refused_before_anything_moves():
    scene = two_pads(kind="kinematic", gap=1e-3, friction=0.0)
    before = scene.save()
    with pytest.raises(InputError, match=r"world_from_pad.*takes left and cube too far.*6\.4 mm"):
        scene.step(np.stack([pose(LEFT, (0.0, 6e-3, 0.0)), pose(RIGHT, (0.0, 30e-3, 0.0))]))
    after = scene.save()
    assert np.array_equal(before.world.y, after.world.y) and np.array_equal(before.poses.pads, after.poses.pads)
    report = scene.step(fingers(-0.2e-3))
    assert report.substeps > 2 and report.blocked[0] == 0.0
    gentle = two_pads(kind="kinematic", gap=1e-3, friction=0.0)
    for gap in np.linspace(0.9e-3, -0.2e-3, 12):
        gentle.step(fingers(gap))
    for _ in range(2):
        scene.step(fingers(-0.2e-3))
        gentle.step(fingers(-0.2e-3))
    assert scene.wrench("left")[0, 1] == pytest.approx(gentle.wrench("left")[0, 1], rel=1e-2)


def test_what_flies_by_itself_is_never_refused():
    """A cube shot at a pad at 2 m/s, 20 mm a step: resolved in small parts, stopped, and thrown back slower."""
    scene = two_pads(gap=4e-3)
    scene.world.set_velocity("cube", (0.0, -2.0, 0.0))
    reports = [scene.step(fingers(4e-3)) for _ in range(2)]
    assert all(r.min_gap[0] > 0.0 and r.min_det[0] > 0.0 for r in reports) and max(r.substeps for r in reports) > 8
    assert abs(scene.velocity("cube")[0, 1]) < 2.0 and scene.pose("cube")[0, 1, 3] > -4.1e-3 - 4e-3


def test_the_share_of_a_motion_is_bounded_by_distance_and_step():
    box = np.full((1, 3), 1e-3)
    one = BoxMotion(np.eye(4)[None], pose(position=(10e-3, 0, 0))[None], -box, box)
    far, near = (pose(position=(d, 0.0, 0.0))[None] for d in (7e-3, 2.05e-3))
    limits = SubstepLimits()

    def share(a, b, reach=0.0, limits=limits):
        return allowed_share({"a": a, "b": BoxMotion(b, b, -box, box)}, [("a", "b")], reach, limits)

    assert share(one, far)[0] == pytest.approx(0.5)
    assert share(one, near, 1e-4)[0] == pytest.approx(limits.step / 10e-3)
    assert share(one, near, 1e-4, SubstepLimits(step=2e-4))[0] == pytest.approx(2e-4 / 10e-3)
    through = BoxMotion(np.eye(4)[None], pose(position=(0.1, 0, 0))[None], -box, box)
    assert share(through, far)[0] == pytest.approx(0.05)
    aside = pose(position=(0.0, 50e-3, 0.0))[None]
    assert share(one, aside) == (np.ones(1), [None])


def test_a_scene_takes_its_accuracy_and_its_substeps_from_its_settings():
    cube = scene_body("cube", (primitive("box", (HALF,) * 3),), "kinematic", friction=0.0)
    accuracy = SceneSettings(slip=1e-6, tolerance=1e-7, linear_tolerance=1e-5, substeps=SubstepLimits(step=1e-3, most=16))
    scene = SoftScene([ScenePad("left", SENSOR, MESH)], [cube], fingers(0.3e-3)[:1], {"cube": np.eye(4)}, accuracy=accuracy)
    solver = scene.settings
    assert (solver.friction_slip, solver.linear_tolerance) == (1e-6, 1e-5)
    assert solver.velocity_tolerance * solver.dt == pytest.approx(1e-7)
    usual = SoftScene([ScenePad("left", SENSOR, MESH)], [cube], fingers(0.3e-3)[:1], {"cube": np.eye(4)})
    goal = fingers(-0.2e-3)[:1]
    assert scene.is_small(goal) and not usual.is_small(goal)
    with pytest.raises(InputError, match=r"world_from_pad.*at most 16 mm"):
        scene.step(fingers(-30e-3)[:1])
    with pytest.raises(InputError, match=r"most = 48.*power of two"):
        SubstepLimits(most=48)


def test_environments_have_their_own_poses_and_reset_alone():
    scene = two_pads(num_envs=2)
    both = np.stack([fingers(-0.05e-3), fingers(0.15e-3)])
    for _ in range(2):
        scene.step(both)
    force = scene.wrench("left")[:, 1]
    assert force[0] < -0.2 and force[1] == 0.0
    start = two_pads()
    scene.reset([0])
    assert scene.coat("left")[0] == pytest.approx(start.coat("left")[0], abs=1e-15)
    scene.step(fingers(-0.05e-3))
    single = two_pads()
    single.step(fingers(-0.05e-3))
    assert scene.wrench("left")[0] == pytest.approx(single.wrench("left")[0], rel=1e-9, abs=1e-9)
    scene.reset([1], world_from_body={"cube": np.stack([pose(position=(0.0, 0.0, 2e-3))] * 2)})
    assert scene.pose("cube")[1, 2, 3] == pytest.approx(2e-3) and abs(scene.pose("cube")[0, 2, 3]) < 1e-6


def test_a_reset_tests_a_pad_against_itself_once(monkeypatch):
    """The pad's shape is that of the start, wherever pad and cube are put; what crosses there is refused all the same."""
    tested = []
    find = overlap._edge_face_hits
    monkeypatch.setattr(overlap, "_edge_face_hits", lambda x, edges, faces: (tested.append(len(edges)), find(x, edges, faces))[1])
    scene = two_pads(num_envs=3)
    pads = [int(np.diff(scene.world.layout.edge_start[[k, k + 1]])[0]) for k in range(2)]
    assert tested.count(pads[0]) > 0
    tested.clear()
    shifts = np.array([0.0, 0.05e-3, -0.05e-3])
    starts = {"cube": np.stack([pose(position=(x, 0.0, 0.0)) for x in shifts])}
    scene.reset([1, 2], world_from_body=starts)
    # In two environments the cube and each pad, edges of one against triangles of the other; the pads have not moved.
    assert len(tested) == 2 * 2 * 2 and scene.pose("cube")[:, 0, 3] == pytest.approx(shifts, abs=1e-12)
    tested.clear()
    scene.reset([2])
    scene.reset([1, 2], world_from_body=starts)
    assert not tested
    with pytest.raises(OverlapError, match=r"at the poses of the reset: environment 1.*(cube|left)"):
        scene.reset([1], world_from_body={"cube": pose(position=(0.0, -0.3e-3, 0.0))})
    assert scene.pose("cube")[1, 0, 3] == pytest.approx(shifts[1], abs=1e-12)
    state = scene.save()
    state.world.y[0, scene.world.layout.node_start[0] + MESH.coat_vertices[0]] += (
        0.0,
        0.0,
        -20e-3,
    )  # through the gel and out of its back
    with pytest.raises(ipc.OverlapError, match="'left'"):
        scene.restore(state)


def test_what_cannot_be_is_named():
    with pytest.raises(OverlapError, match=r"bodies overlap where they start.*left.*cube"):
        two_pads(gap=-1e-3)
    scene = two_pads()
    with pytest.raises(InputError, match=r"pad = 'middle'.*left, right"):
        scene.wrench("middle")
    with pytest.raises(InputError, match=r"name = 'ball'.*cube"):
        scene.pose("ball")
    with pytest.raises(InputError, match=r"driven = 'cube'.*moves freely"):
        scene.step(fingers(0.1e-3), {"cube": np.eye(4)})
    with pytest.raises(InputError, match=r"world_from_pad.*shape"):
        scene.step(np.eye(4))
    with pytest.raises(InputError, match=r"world_from_pad.*rigid"):
        scene.step(2.0 * fingers(0.1e-3))
    with pytest.raises(InputError, match=r"kind = 'jelly'.*kinematic, affine, soft, half_space"):
        scene_body("x", (primitive("box", (HALF,) * 3),), "jelly")
    with pytest.raises(OverlapError, match="reset"):
        scene.reset(world_from_pad=fingers(-1e-3))
    scene.step(fingers(0.1e-3))


@pytest.mark.gpu
def test_cuda_and_cpu_press_alike():
    """Steps of several lengths too, each of which is a recording of its own."""
    found = {}
    for device in ("cpu", "cuda"):
        cube = scene_body("cube", (primitive("box", (HALF,) * 3),), "affine", density=1e4)
        pads = [ScenePad("left", SENSOR, MESH), ScenePad("right", SENSOR, MESH)]
        scene = SoftScene(pads, [cube], fingers(0.2e-3), {"cube": np.eye(4)}, gravity=(0, 0, 0), device=device)
        for gap, dt in ((0.1e-3, 0.01), (0.0, 0.004), (-0.1e-3, 0.01), (-0.1e-3, 0.01)):
            scene.step(fingers(gap), dt=dt)
        found[device] = np.concatenate(
            [scene.wrench("left")[0], scene.pose("cube")[0].ravel(), scene.stiffness("left")[0].diagonal()]
        )
    assert found["cuda"] == pytest.approx(found["cpu"], rel=1e-3, abs=1e-4)


def test_what_failed_at_speed_does_not_cut_the_steps_of_others():
    scene = two_pads(num_envs=2, gap=1e-3)
    state = scene.save()
    state.world.velocity[1, scene.world.layout.node_start[2] :] = (0.0, 0.15, 0.0)  # the cube, after both pads
    scene.restore(state)
    alone, fast = scene.step(fingers(1e-3)).substeps
    assert alone == 1 and fast > 1
    state.world.failed[1] = True
    scene.restore(state)
    assert scene.failed.tolist() == [False, True]
    report = scene.step(fingers(1e-3))
    assert report.substeps.tolist() == [1, 0] and report.failed.tolist() == [False, True]


def test_gravity_is_that_of_the_settings():
    bodies = [scene_body("cube", (primitive("box", (HALF,) * 3),), "affine", density=500.0)]
    pads = [ScenePad("left", SENSOR, MESH), ScenePad("right", SENSOR, MESH)]
    given = ipc.Settings(gravity=(0.0, 1.0, -2.0), d_hat=MESH.d_hat)
    scene = SoftScene(pads, bodies, fingers(5e-3), {"cube": np.eye(4)}, settings=given)
    scene.step(fingers(5e-3))
    assert scene.gravity == pytest.approx([0.0, 1.0, -2.0])
    assert scene.velocity("cube")[0] == pytest.approx(given.dt * scene.gravity, rel=1e-3, abs=1e-9)
    with pytest.raises(InputError, match=r"gravity.*left out where settings are given"):
        SoftScene(pads, bodies, fingers(5e-3), {"cube": np.eye(4)}, settings=given, gravity=(0.0, 0.0, 0.0))


def test_a_motion_that_is_too_fast_fails_its_environment_alone():
    scene = two_pads(kind="kinematic", gap=1e-3, friction=0.0, num_envs=2)
    fast = np.stack([pose(LEFT, (0.0, 6e-3, 0.0)), pose(RIGHT, (0.0, 30e-3, 0.0))])
    assert scene.is_small(np.stack([fingers(1e-3), fast])).tolist() == [True, False]
    with pytest.warns(RuntimeWarning, match=r"failed: .*in environment 1 takes left and cube too far"):
        report = scene.step(np.stack([fingers(0.9e-3), fast]))
    assert report.failed.tolist() == scene.failed.tolist() == [False, True]
    assert scene.pose("left")[0] == pytest.approx(fingers(0.9e-3)[0], abs=1e-12)
    scene.reset([1])
    assert not scene.step(fingers(0.9e-3)).failed.any()
