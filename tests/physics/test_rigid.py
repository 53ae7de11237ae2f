"""The rigid pad: first touch, load law, MuJoCo's contact, trajectories."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

from raytac.errors import InputError, SpecError
from raytac.gel.surface import make_grid, rest_height
from raytac.physics.base import PadReading
from raytac.physics.objects import object_parts
from raytac.physics.press import CLEARANCE
from raytac.physics.rigid.layer_response import reduced_modulus
from raytac.physics.rigid.load_law import LoadLaw, first_touch, gap_at_touch
from raytac.physics.rigid.pad import RigidPad
from raytac.physics.rigid.rig import PressRig
from raytac.specs import load_sensor
from raytac.specs.press import ObjectSpec, PressScene, StageSpec
from raytac.specs.sensor import (
    CameraSpec,
    CaseSpec,
    CoatSpec,
    GelpadSpec,
    LightsSpec,
    MarkerSpec,
    RefractionSpec,
    ResponseSpec,
    SensorSpec,
)
from tests.ipc.oracles.closed_forms import BondedLayer, Elastic

PAD = GelpadSpec((20e-3, 16e-3), 4e-3, (0.21, 0.135), 2e5, 0.48, 1000.0, 0.8)
PITCH = 0.15e-3
IDENTITY = (1.0, 0.0, 0.0, 0.0)
OBJECTS: dict[str, dict[str, float | int | str]] = {
    "sphere": {"radius": 4e-3},
    "cylinder": {"radius": 3e-3, "length": 8e-3},
    "edge": {"side": 6e-3},
    "cone": {"radius": 4e-3, "height": 5e-3, "tip_radius": 0.4e-3},
    "torus": {"major_radius": 4e-3, "minor_radius": 1.2e-3},
    "pins": {"rows": 3, "columns": 4, "pitch": 2.5e-3, "pin_radius": 0.5e-3, "pin_height": 2e-3},
    "coin": {"radius": 6e-3, "thickness": 1.5e-3, "relief_height": 0.2e-3},
}


def sensor_with(pad: GelpadSpec = PAD) -> SensorSpec:
    return SensorSpec(
        name="test",
        gelpad=pad,
        coat=CoatSpec((0.5, 0.5, 0.5), 0.0, 0.3),
        case=CaseSpec((25e-3, 20e-3), -30e-3, 0.2),
        camera=CameraSpec((320, 240), (6e-5, 6e-5), (0.0, 0.0, -20e-3), (160.0, 120.0)),
        response=ResponseSpec(1.0, (1.0, 1.0, 1.0), 1.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        markers=MarkerSpec(0, 0, (1e-3, 1e-3), (0.0, 0.0), 1e-4, 0.1),
        refraction=RefractionSpec("none", 1.4, 0.0),
        lights=LightsSpec(()),
    )


def scene_of(
    kind: str,
    *stages: StageSpec,
    position: tuple[float, float, float] = (0.0, 0.0, 0.0),
    quaternion: tuple[float, float, float, float] = IDENTITY,
) -> PressScene:
    return PressScene("test", ObjectSpec(kind, OBJECTS.get(kind, {}), position, quaternion, 0.05), stages)


def grain(*stages: StageSpec) -> PressScene:
    """A ball so small that 200 N would take it through the pad."""
    return dataclasses.replace(
        scene_of("sphere", *stages), object=ObjectSpec("sphere", {"radius": 1.2e-4}, (0.0, 0.0, 0.0), IDENTITY, 0.05)
    )


def indent(depth: float) -> StageSpec:
    return StageSpec("indent", depth=depth)


def press(scene: PressScene, steps: int = 1, **options: object) -> tuple[RigidPad, list[PadReading]]:
    pad = RigidPad(sensor_with(), scene, pitch=PITCH, **options)  # type: ignore[arg-type]
    return pad, list(pad.run(steps))


WIDE = np.linspace(-9e-3, 9e-3, 181)
DISTANCE = np.hypot(WIDE[None, :] - 0.03e-3, WIDE[:, None] + 0.021e-3)
LAYER = BondedLayer(Elastic(PAD.youngs_modulus, PAD.poisson_ratio), PAD.thickness)


def law_of(gap: np.ndarray, pad: Any = PAD) -> LoadLaw:
    return LoadLaw(gap, WIDE, WIDE, dataclasses.replace(pad, size=(30e-3, 30e-3)) if pad is PAD else pad)


@pytest.mark.parametrize("depth", [0.1e-3, 0.5e-3, 1e-3])
def test_load_law_is_hertz_on_a_thick_pad(depth: float) -> None:
    thick: Any = SimpleNamespace(**vars(PAD) | {"thickness": 0.4})  # nearly a half-space: thicker than a GelpadSpec may be
    hertz = 4.0 / 3.0 * reduced_modulus(thick) * math.sqrt(4e-3) * depth**1.5
    assert math.isclose(law_of(DISTANCE**2 / 8e-3, thick).force(depth), hertz, rel_tol=0.02)
    assert law_of(DISTANCE**2 / 8e-3).force(depth) > 1.1 * hertz  # a bonded layer is stiffer


@pytest.mark.parametrize("radius", [0.4e-3, 1e-3, 2e-3, 4e-3, 6e-3])
@pytest.mark.parametrize("kind", ["ball", "cone", "disc"])
def test_load_law_is_that_of_the_bonded_layer(kind: str, radius: float) -> None:
    """Force 1 % and radius 2 % off the layer without friction, contacts of 0.1 to 1.5 thicknesses."""
    if kind == "ball":
        gap, (depth, force) = DISTANCE**2 / 16e-3, LAYER.sphere(8e-3, radius)
    elif kind == "cone":
        gap, (depth, force) = 0.2 * DISTANCE, LAYER.cone(0.2, radius)
    else:
        gap, depth = np.where(radius > DISTANCE, 0.0, np.inf), 0.2e-3
        force = float(LAYER.punch_force(radius, depth))
    law = law_of(gap)
    assert depth < law.hard_from and law.force(depth) == pytest.approx(force, rel=0.01)
    assert law.contact_radius(depth) == pytest.approx(radius, rel=0.02)


@pytest.mark.parametrize("radius", [1e-3, 4e-3])
def test_a_flat_face_that_tilts_keeps_its_middle(radius: float) -> None:
    depth = 0.2e-3
    for share in (0.1, 0.3, 0.5):  # of the depth that the rim is deeper and higher
        tilted = np.where(radius > DISTANCE, share * depth * (1.0 + (WIDE - 0.03e-3) / radius), np.inf)
        force = law_of(tilted).force((1.0 + share) * depth)
        assert force == pytest.approx(float(LAYER.punch_force(radius, depth)), rel=0.01)


def test_nodes_on_the_edges_of_the_pad_stand_for_the_cells_on_it() -> None:
    x, y = (np.linspace(-0.5 * size, 0.5 * size, round(size / 0.4e-3) + 1) for size in PAD.size)
    whole = LoadLaw(np.zeros((len(y), len(x))), x, y, PAD)
    assert whole.contact_area(0.1e-3) == pytest.approx(PAD.size[0] * PAD.size[1], rel=1e-9)


def test_load_law_of_a_flat_punch_is_linear_and_inverts() -> None:
    law = law_of(np.where(DISTANCE < 1e-3, 0.0, np.inf))
    for depth in (0.2e-3, 0.5e-3, 1e-3):
        assert math.isclose(law.force(depth) / depth, law.force(0.1e-3) / 0.1e-3, rel_tol=1e-9)
        assert math.isclose(law.depth_at(law.force(depth)), depth, rel_tol=1e-9)
    assert law.force(-1e-3) == 0.0 and law.contact_radius(0.0) == 0.0
    with pytest.raises(InputError, match="deeper than the pad"):
        law.depth_at(2.0 * law.greatest)


@pytest.mark.parametrize("kind", sorted(OBJECTS))
def test_force_grows_with_depth(kind: str) -> None:
    _, states = press(scene_of(kind, indent(1e-3)), steps=8)
    force = np.array([s.normal_force[0] for s in states])
    assert force[0] == 0.0 and (np.diff(force) > 0.0).all()


@pytest.mark.parametrize("moves", ["object", "case"])
def test_mujoco_contact_has_the_stiffness_it_was_given(moves: str) -> None:
    rig = PressRig(mass=0.05, stiffest=5e3, moves=moves)
    rig.place(np.array([0.0, 0.0, 3e-3]), 3e-3)
    for stiffness in (200.0, 1000.0, 5000.0):
        force = rig.hold(np.array([0.0, 0.0, -0.4e-3, 0.0]), lambda _, k=stiffness: k)
        assert math.isclose(force, stiffness * 0.4e-3, rel_tol=1e-6)
        rig.hold(np.zeros(4), lambda _, k=stiffness: k)
        assert rig.load(0.0, 0.3, 0.2, lambda _, k=stiffness: k)
        assert math.isclose(rig.depth, 0.3 / stiffness, rel_tol=1e-3)


@pytest.mark.parametrize("position", [(0.0, 0.0, 0.0), (5e-3, -3e-3, 0.0)])
def test_sphere_touches_the_dome_where_geometry_says(position: tuple[float, float, float]) -> None:
    scene = scene_of("sphere", position=position)
    pose = np.eye(4)
    pose[:2, 3] = position[:2]
    x, y = (np.linspace(p - 1e-3, p + 1e-3, 801) for p in position[:2])
    above = -np.sqrt((4e-3) ** 2 - (x[None, :] - position[0]) ** 2 - (y[:, None] - position[1]) ** 2)
    expected = (rest_height(PAD, x[None, :], y[:, None]) - above).max()
    for pitch in (0.2e-3, 0.0634e-3):
        found = first_touch(object_parts(scene.object), pose, PAD, make_grid(PAD, pitch)).z
        assert math.isclose(found, expected, abs_tol=1e-9)


@pytest.mark.parametrize("kind", sorted(OBJECTS))
def test_first_touch_has_no_overlap_and_no_gap(kind: str) -> None:
    angle = 0.05
    scene = scene_of(kind, quaternion=(math.cos(angle), 0.5 * math.sin(angle), 0.2 * math.sin(angle), 0.0))
    pad = RigidPad(sensor_with(), scene, pitch=PITCH)
    state = next(pad.run())
    pose = state.pad_from_object[0].copy()
    pose[2, 3] -= CLEARANCE
    gap = gap_at_touch(pad.parts, pose, pad.grid)
    z, found, _, _ = first_touch(pad.parts, pose, pad.sensor.gelpad, pad.grid)
    assert z == pytest.approx(pose[2, 3], abs=1e-9)
    np.testing.assert_allclose(found, gap, atol=1e-9)
    assert 0.0 <= gap.min() < 20e-6  # a sharp corner may lie between nodes
    assert not pad.surface_from_pose(pose[None]).contact.any() or gap.min() < 1e-9


@pytest.mark.parametrize("kind", sorted(OBJECTS))
def test_commanded_depth_is_reached_and_release_restores_rest(kind: str) -> None:
    pad, states = press(scene_of(kind, indent(0.5e-3), StageSpec("release")))
    assert [s.kind for s in states] == ["start", "indent", "release"]
    start, pressed, released = states
    assert abs(pressed.depth[0] - 0.5e-3) < 1e-9
    travel = start.pad_from_object[0, 2, 3] - CLEARANCE - pressed.pad_from_object[0, 2, 3]
    assert abs(travel - 0.5e-3) < 1e-6
    surface = pressed.surface
    assert surface.contact.any() and 0.4e-3 < surface.indentation.max() < 0.5e-3 + 1e-7
    rest = pad.grid.rest.astype(np.float32)
    for state in (start, released):
        assert state.normal_force[0] == 0.0 and state.depth[0] < 0.0
        np.testing.assert_array_equal(state.surface.height[0], rest)
    assert pad.peak(iter(states)) is pressed


@pytest.mark.parametrize(
    ("kind", "force"), [("sphere", 0.3), ("sphere", 3.0), ("cone", 0.5), ("torus", 2.0), ("pins", 1.0), ("coin", 8.0)]
)
def test_commanded_force_is_reached(kind: str, force: float) -> None:
    _, states = press(scene_of(kind, StageSpec("indent", force=force)))
    assert math.isclose(states[-1].normal_force[0], force, rel_tol=1e-3)
    _, by_depth = press(scene_of(kind, indent(float(states[-1].depth[0]))))
    assert math.isclose(by_depth[-1].normal_force[0], force, rel_tol=1e-3)


def test_shear_and_twist_move_the_contact_as_commanded() -> None:
    shear = StageSpec("shear", shear=(1e-3, -0.5e-3))
    twist = StageSpec("twist", twist=0.3)
    scene = scene_of("torus", indent(0.5e-3), shear, twist, position=(1e-3, 0.0, 0.0), quaternion=IDENTITY)
    _pad, states = press(scene)
    pressed, sheared, twisted = states[1:]
    np.testing.assert_allclose(
        sheared.pad_from_object[0, :3, 3] - pressed.pad_from_object[0, :3, 3], (1e-3, -0.5e-3, 0.0), atol=1e-12
    )
    c, s = math.cos(0.3), math.sin(0.3)
    np.testing.assert_allclose(twisted.pad_from_object[0, :3, :3], [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], atol=1e-12)
    np.testing.assert_allclose(twisted.pad_from_object[0, :3, 3], sheared.pad_from_object[0, :3, 3], atol=1e-12)
    moved = sheared.surface.contact_centre - pressed.surface.contact_centre
    np.testing.assert_allclose(moved[0], (1e-3, -0.5e-3), atol=0.15e-3)  # the dome moves the deepest point a little less
    assert pressed.shear_force[0].tolist() == [0.0, 0.0] and sheared.shear_force[0, 0] > 0.0 > sheared.shear_force[0, 1]
    assert sheared.twist_torque[0] == 0.0 < twisted.twist_torque[0]


def test_a_tilt_turns_the_object_about_its_origin_before_the_twist() -> None:
    """The tilt's axis turns with the twist, and a tilted disc touches at its rim, lower by r sin α − (1 − cos α) l/2 less the dome."""
    stages = indent(0.3e-3), StageSpec("tilt", tilt=(0.0, 0.05)), StageSpec("twist", twist=0.3)
    _, (_, pressed, tilted, twisted) = press(scene_of("cylinder", *stages))
    c, s = math.cos(0.05), math.sin(0.05)
    about_y = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    np.testing.assert_allclose(tilted.pad_from_object[0, :3, :3], about_y, atol=1e-12)
    c, s = math.cos(0.3), math.sin(0.3)
    about_z = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(twisted.pad_from_object[0, :3, :3], about_z @ about_y, atol=1e-12)
    for state in (tilted, twisted):
        np.testing.assert_allclose(state.pad_from_object[0, :3, 3], pressed.pad_from_object[0, :3, 3], atol=1e-12)
    radius, half = float(OBJECTS["cylinder"]["radius"]), 0.5 * float(OBJECTS["cylinder"]["length"])
    lower = radius * math.sin(0.05) - half * (1.0 - math.cos(0.05)) - float(PAD.sag(radius, 0.0))
    assert tilted.surface.indentation.max() - 0.3e-3 == pytest.approx(lower, abs=0.004e-3)
    assert tilted.surface.contact_centre[0, 0] > 0.1e-3 > 10.0 * abs(tilted.surface.contact_centre[0, 1])


@pytest.mark.parametrize("at", [0.0, 7e-3])
def test_a_ball_that_rolls_does_not_shear_the_gel(at: float) -> None:
    """Its lowest point stays: shear −R ω × z. A tilt alone shears as R ω × z, up to slip; so a slide against it doubles it.

    So it is on the flank of a strong dome, where the ball touches lower, and R cos θ below its middle.
    """
    dome, radius, angle = load_sensor("gelsight_dome"), float(OBJECTS["sphere"]["radius"]), 0.004
    lever = radius * math.cos(math.asin(at / (dome.gelpad.dome_radius[0] + radius)))

    def shear_of(*stages: StageSpec) -> np.ndarray:
        scene = scene_of("sphere", indent(0.5e-3), *stages, position=(at, 0.0, 0.0))
        return list(RigidPad(dome, scene, pitch=0.2e-3).run())[-1].shear_force[0]

    tilt = StageSpec("tilt", tilt=(0.6 * angle, -0.8 * angle))
    path = lever * angle * np.array([0.8, 0.6])  # of the matter that touches under the tilt alone
    shears = {"roll": -path, "tilt": 0.0 * path, "slide": path}
    shear_force = {name: shear_of(StageSpec("shear", shear=tuple(shear.tolist())), tilt) for name, shear in shears.items()}
    alone = shear_of(StageSpec("shear", shear=tuple(path.tolist())))
    assert np.hypot(*alone) > 0.005
    np.testing.assert_allclose(shear_force["tilt"], alone, rtol=0.01)
    np.testing.assert_allclose(shear_force["slide"], 2.0 * alone, rtol=0.01)
    assert np.hypot(*shear_force["roll"]) < 0.01 * np.hypot(*alone)


def test_shear_force_sticks_then_slips_at_the_friction_limit() -> None:
    stages = [StageSpec("shear", shear=(x, 0.0)) for x in (0.01e-3, 0.02e-3, 2e-3, 3e-3)]
    _, states = press(scene_of("sphere", indent(0.5e-3), *stages))
    small, twice, slipped, further = (s.shear_force[0, 0] for s in states[2:])
    assert math.isclose(twice, 2.0 * small, rel_tol=0.02)
    for state, force in ((states[-2], slipped), (states[-1], further)):
        assert math.isclose(force, PAD.friction * state.normal_force[0], rel_tol=1e-6)


def test_force_is_kept_while_shearing() -> None:
    stages = (StageSpec("indent", force=1.0), StageSpec("shear", shear=(2e-3, 1e-3)))
    _, states = press(scene_of("sphere", *stages), steps=2)
    np.testing.assert_allclose([s.normal_force[0] for s in states[2:]], 1.0, rtol=1e-3)


def test_batch_equals_single_bit_for_bit() -> None:
    offsets = np.array([[0.0, 0.0], [2e-3, -1e-3], [-3e-3, 0.5e-3]])
    scene = scene_of("torus", StageSpec("indent", force=1.0), indent(0.6e-3), StageSpec("shear", shear=(0.5e-3, 0.0)))
    _pad, states = press(scene, num_envs=3, offsets=offsets)
    for b in range(3):
        _alone, single = press(scene, offsets=offsets[b : b + 1])
        for together, one in zip(states, single, strict=True):
            for name in ("pad_from_object", "depth", "normal_force", "shear_force", "twist_torque", "failed"):
                np.testing.assert_array_equal(getattr(together, name)[b], getattr(one, name)[0])
        np.testing.assert_array_equal(states[-1].surface.height[b], single[-1].surface.height[0])


def test_depths_by_environment_and_a_failed_one_leaves_the_others_running() -> None:
    offsets = np.array([[0.0, 0.0], [np.nan, 0.0], [1e-3, 0.0]])
    _pad, states = press(
        scene_of("sphere", indent(0.5e-3)), num_envs=3, offsets=offsets, depths=np.array([0.2e-3, 0.3e-3, 0.4e-3])
    )
    np.testing.assert_array_equal(states[-1].failed, [False, True, False])
    np.testing.assert_allclose(states[-1].depth, [0.2e-3, np.nan, 0.4e-3])
    height = states[-1].surface.height
    assert np.isnan(height[1]).all() and np.isfinite(height[[0, 2]]).all()


def test_turn_shear_and_twist_by_environment_are_those_of_scenes_of_their_own() -> None:
    turns = np.array([[1.0, 0.0, 0.0, 0.0], [0.98, 0.1, 0.0, 0.2], [2.0, 0.0, -0.2, -0.5]])
    shears = np.array([[0.3e-3, 0.0], [-0.2e-3, 0.1e-3], [0.0, 0.4e-3]])
    twists = np.array([0.1, -0.2, 0.05])
    own = np.array([0.9433, 0.0, 0.3144, 0.1048])
    stages = indent(0.6e-3), StageSpec("shear", shear=(1e-3, 0.0)), StageSpec("twist", twist=0.3)
    scene = scene_of("torus", *stages, quaternion=(0.9433, 0.0, 0.3144, 0.1048))
    _pad, states = press(scene, num_envs=3, rotations=turns, shears=shears, twists=twists)
    for b in range(3):
        turned = np.empty(4)
        mujoco.mju_mulQuat(turned, turns[b], own)
        alone_stages = indent(0.6e-3), StageSpec("shear", shear=tuple(shears[b])), StageSpec("twist", twist=twists[b])
        w, x, y, z = (turned / np.linalg.norm(turned)).tolist()
        _alone, single = press(scene_of("torus", *alone_stages, quaternion=(w, x, y, z)))
        for name in ("pad_from_object", "depth", "normal_force", "shear_force", "twist_torque"):
            np.testing.assert_allclose(getattr(states[-1], name)[b], getattr(single[-1], name)[0], rtol=1e-6, atol=1e-9)
        apart = states[-1].surface.height[b] - single[-1].surface.height[0]
        assert np.abs(apart).max() < 1e-8 and np.ptp(states[-1].surface.height[b]) > 0.5e-3


def test_a_turn_of_zeros_is_refused_and_one_that_is_not_finite_fails_alone() -> None:
    with pytest.raises(InputError, match=r"rotations.*environment 1"):
        press(scene_of("sphere", indent(0.5e-3)), num_envs=2, rotations=np.array([[1.0, 0, 0, 0], [0.0, 0, 0, 0]]))
    _, states = press(scene_of("sphere", indent(0.5e-3)), num_envs=2, rotations=np.array([[1.0, 0, 0, 0], [np.nan, 0, 0, 0]]))
    np.testing.assert_array_equal(states[-1].failed, [False, True])


def test_diverging_state_marks_its_environment() -> None:
    rig = PressRig(0.05, 1e3)
    rig.place(np.zeros(3), 0.0)
    assert not rig.load(0.0, math.nan, 0.01, lambda _: 1e3)


@pytest.mark.parametrize("kind", ["sphere", "torus", "coin"])
def test_moving_the_case_is_the_same_press(kind: str) -> None:
    """Every stage; the rig of the case has other joints in another order, so nothing but the physics makes them agree."""
    tilted = (math.cos(0.04), 0.6 * math.sin(0.04), 0.8 * math.sin(0.04), 0.0)
    stages = (
        indent(0.4e-3),
        StageSpec("indent", force=1.5),
        StageSpec("shear", shear=(0.8e-3, -0.5e-3)),
        StageSpec("twist", twist=0.4),
        StageSpec("tilt", tilt=(0.05, -0.08)),
        StageSpec("release"),
    )
    scene = scene_of(kind, *stages, position=(2e-3, 1e-3, 0.0), quaternion=tilted)
    _, moved_object = press(scene, steps=2)
    _, moved_case = press(dataclasses.replace(scene, moves="case"), steps=2)
    fixed = moved_case[0].world_from_pad[0] @ moved_case[0].pad_from_object[0]
    for a, b in zip(moved_object, moved_case, strict=True):
        np.testing.assert_array_equal(a.world_from_pad[0], np.eye(4))
        np.testing.assert_allclose(b.pad_from_object, a.pad_from_object, rtol=0.0, atol=1e-9)
        for name in ("depth", "normal_force", "shear_force", "twist_torque"):
            np.testing.assert_allclose(getattr(b, name), getattr(a, name), rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(b.surface.height, a.surface.height, rtol=0.0, atol=1e-9)
        np.testing.assert_array_equal(b.surface.contact, a.surface.contact)
        np.testing.assert_allclose(b.world_from_pad[0] @ b.pad_from_object[0], fixed, rtol=0.0, atol=1e-12)
    assert moved_case[-3].surface.contact.any()


def test_the_case_moves_against_the_object() -> None:
    """Up by the depth, against the shear; turned the other way about the object's axis."""
    scene = scene_of(
        "sphere", indent(0.5e-3), StageSpec("shear", shear=(1e-3, 0.0)), StageSpec("twist", twist=0.3), position=(2e-3, 0, 0)
    )
    _, (start, pressed, sheared, twisted) = press(dataclasses.replace(scene, moves="case"))
    np.testing.assert_allclose(start.world_from_pad[0, :3, 3], (0.0, 0.0, -CLEARANCE), atol=1e-12)
    np.testing.assert_allclose(pressed.world_from_pad[0, :3, 3], (0.0, 0.0, 0.5e-3), atol=1e-12)
    np.testing.assert_allclose(sheared.world_from_pad[0, :3, 3], (-1e-3, 0.0, 0.5e-3), atol=1e-12)
    c, s = math.cos(0.3), math.sin(0.3)
    np.testing.assert_allclose(twisted.world_from_pad[0, :2, :2], [[c, s], [-s, c]], atol=1e-12)
    # The ball's centre, x = 2 mm in the world, stays put: in the turned case it is at x = 3 mm on the pad's own axis.
    np.testing.assert_allclose(twisted.world_from_pad[0, :2, :] @ [3e-3, 0.0, 0.0, 1.0], (2e-3, 0.0), atol=1e-12)


def test_untouched_pad() -> None:
    pad, states = press(scene_of("none"))
    assert len(states) == 1 and pad.peak(states) is states[0]
    surface = states[0].surface
    assert surface.pad_from_object is None
    np.testing.assert_array_equal(surface.height[0], pad.grid.rest.astype(np.float32))


FORCE = StageSpec("indent", force=1.0)


@pytest.mark.parametrize(
    ("scene", "key", "value", "rule"),
    [
        (grain(StageSpec("indent", force=200.0)), "trajectory[0].force_n", 200.0, "deeper than the pad"),
        (grain(FORCE, StageSpec("indent", force=200.0)), "trajectory[1].force_n", 200.0, "deeper than the pad"),
        (scene_of("sphere", indent(1e-3), position=(50e-3, 0, 0)), "object.position_mm", [50.0, 0.0], "above a node"),
        (scene_of("sphere", FORCE, StageSpec("shear", shear=(0, 40e-3))), "trajectory[1].shear_mm", [0.0, 40.0], "above a node"),
        (scene_of("sphere", indent(4.1e-3)), "trajectory[0].depth_mm", 4.1, "thickness, 4 mm"),
    ],
)
def test_a_press_that_cannot_be_done_names_file_and_key(scene: PressScene, key: str, value: object, rule: str) -> None:
    source = Path("press.toml")
    with pytest.raises(SpecError) as caught:
        press(dataclasses.replace(scene, source=source))
    error = caught.value
    assert (error.file, error.key) == (source, key) and error.value == pytest.approx(value) and rule in error.rule


def test_a_kept_force_that_would_go_through_the_pad_is_blamed_on_the_stage_that_moves() -> None:
    """Near the pad's edge there is less gel under a grain, so the pad cannot carry what it carried in the middle."""
    scene = grain(FORCE)
    grid, pose = make_grid(PAD, PITCH), np.eye(4)
    touch = first_touch(object_parts(scene.object), pose, PAD, grid)
    force = 0.99 * LoadLaw(touch.gap, grid.x, grid.y, PAD, touch.deepest).greatest
    stages = StageSpec("indent", force=force), StageSpec("shear", shear=(9e-3, 0.0))
    with pytest.raises(SpecError, match=r"trajectory\[1\]\.shear_mm = .*the force kept here, .* N, would press deeper"):
        press(grain(*stages))


@pytest.mark.parametrize(
    ("own", "value", "where"),
    [
        ({"shears": [[0, 0], [30e-3, 0], [0, 0]]}, [30e-3, 0.0], r"trajectory\[1\]"),
        ({"offsets": [[0, 0], [30e-3, 0], [0, 0]]}, [30e-3, 0.0], "the start"),
        # In reach where it begins, sheared off by the scene.
        ({"offsets": [[0, 0], [13e-3, 0], [0, 0]]}, [13e-3, 0.0], r"trajectory\[1\]"),
    ],
)
def test_what_one_environment_of_a_batch_cannot_do_is_named_with_it(own: dict, value: list[float], where: str) -> None:
    scene = scene_of("sphere", indent(0.3e-3), StageSpec("shear", shear=(2e-3, 0.0)))
    name = next(iter(own))
    with pytest.raises(InputError, match=f"{name} = .*in environment 1, (in|at) {where}: no part of the object") as caught:
        press(scene, 1, num_envs=3, **{name: np.array(own[name], float)})
    assert caught.value.value == value


@pytest.mark.parametrize(
    ("own", "mentioned"),
    [
        ({"offsets": [[0.1e-3, 0.0], [0.0, 0.0]]}, r"offsets = \[0\.0001, 0\.0\]"),
        ({"twists": [0.1, 0.0]}, "twists = 0.1"),
        ({"rotations": [[0.999, 0.0, 0.0, 0.02], [1.0, 0.0, 0.0, 0.0]]}, "rotations = "),
        ({"depths": [0.3e-3, 3.5e-3]}, r"depths \[mm\] = 3\.5"),
    ],
)
def test_a_tilt_that_cannot_be_followed_is_not_blamed_on_what_the_environment_has_of_its_own(own: dict, mentioned: str) -> None:
    """A disc 3.5 mm deep in 4 mm of gel, tilted by 29°: no environment could follow."""
    scene = scene_of("cylinder", indent(3.5e-3), StageSpec("twist", twist=0.1), StageSpec("tilt", tilt=(0.0, 0.5)))
    with pytest.raises(SpecError, match=rf"{mentioned}.*the depth kept here, 3\.5 mm") as caught:
        press(scene, 1, num_envs=2, **{name: np.array(values) for name, values in own.items()})
    assert caught.value.key == "trajectory[2].tilt_deg" and caught.value.value == pytest.approx([0.0, 28.6479])


def test_impossible_scenes_are_refused() -> None:
    with pytest.raises(SpecError, match=r"object\.quaternion_wxyz.*unit quaternion"):
        press(scene_of("sphere", quaternion=(0.0, 0.0, 0.0, 0.0)))
    with pytest.raises(SpecError, match="thickness"):
        press(scene_of("sphere", indent(4.1e-3)))
    with pytest.raises(InputError, match="thickness"):
        press(scene_of("sphere", indent(1e-3)), depths=np.array([5e-3]))
    with pytest.raises(SpecError, match="exactly one"):
        press(scene_of("sphere", StageSpec("indent")))
    with pytest.raises(SpecError, match=r"moves = 'camera'.*object, case"):
        press(dataclasses.replace(scene_of("sphere", indent(1e-3)), moves="camera"))
    with pytest.raises(SpecError, match="sphere"):
        object_parts(ObjectSpec("ball", {}, (0.0, 0.0, 0.0), IDENTITY, 0.1))
    with pytest.raises(SpecError, match="radius"):
        object_parts(ObjectSpec("sphere", {"radius": -1.0}, (0.0, 0.0, 0.0), IDENTITY, 0.1))
    with pytest.raises(InputError, match="offsets"):
        press(scene_of("sphere"), num_envs=2, offsets=np.zeros((3, 2)))


def test_stages_that_are_followed_one_by_one_are_those_of_the_scene():
    stages = (
        StageSpec("indent", depth=0.6e-3),
        StageSpec("shear", shear=(0.4e-3, 0.0)),
        StageSpec("twist", twist=0.2),
        StageSpec("release"),
    )
    whole = RigidPad(sensor_with(), scene_of("sphere", *stages), pitch=PITCH)
    followed = RigidPad(sensor_with(), scene_of("sphere"), pitch=PITCH)
    for ran, stage in zip(list(whole.run(2))[2::2], stages, strict=True):
        state = list(followed.follow(stage, 2))[-1]
        assert (state.stage, state.kind, state.fraction) == (-1, ran.kind, 1.0)
        for name in ("pad_from_object", "depth", "normal_force", "shear_force", "twist_torque"):
            np.testing.assert_array_equal(getattr(state, name), getattr(ran, name))


def test_a_stage_may_be_left_on_the_way_and_one_that_fails_leaves_the_object_where_it_was():
    pad = RigidPad(sensor_with(), scene_of("sphere", StageSpec("indent", depth=0.6e-3)), pitch=PITCH)
    half = next(pad.follow(StageSpec("indent", depth=0.8e-3), 2))
    assert half.depth[0] == pytest.approx(0.4e-3)
    with pytest.raises(InputError, match="no part of the object"):
        list(pad.follow(StageSpec("shear", shear=(0.05, 0.0))))
    state = next(pad.follow(StageSpec("shear", shear=(0.1e-3, 0.0))))
    assert state.depth[0] == pytest.approx(0.4e-3, abs=1e-5) and state.shear_force[0, 0] > 0.0
    assert state.pad_from_object[0, 0, 3] - half.pad_from_object[0, 0, 3] == pytest.approx(0.1e-3)
    with pytest.raises(SpecError, match="thickness"):
        list(pad.follow(StageSpec("indent", depth=0.05)))
    with pytest.raises(InputError, match="steps"):
        list(pad.follow(StageSpec("release"), 0))


def test_a_reading_of_some_environments_is_theirs() -> None:
    pad, states = press(scene_of("torus", indent(0.5e-3)), num_envs=2, offsets=np.array([[0.0, 0.0], [1e-3, 0.0]]))
    whole, one = states[-1], states[-1].of([1])
    for name in ("wrench", "pad_from_object", "depth", "failed", "force_law_area"):
        np.testing.assert_array_equal(getattr(one, name), getattr(whole, name)[1:])
    np.testing.assert_array_equal(one.surface.height, whole.surface.height[1:])
    np.testing.assert_array_equal(one.traction(), whole.traction()[1:])
    assert one.stage == whole.stage == 0 and one.scene is pad.scene and whole.surface.batch == 2
