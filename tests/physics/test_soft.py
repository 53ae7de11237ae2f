"""The soft pad: what is commanded is reached, forces balance, and it agrees with the rigid pad where it should."""

from __future__ import annotations

import math

import ipctk
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from raytac.errors import InputError, RaytacError, SpecError
from raytac.gel.traction import cell_areas
from raytac.physics.rigid.pad import RigidPad
from raytac.physics.soft.pad import SoftPad
from raytac.physics.soft.reading import SoftReader, UnsolvedContactWarning
from raytac.physics.soft.scene import SoftScene
from raytac.physics.soft.settings import Correction
from raytac.specs import load_sensor, press_of
from raytac.specs.press import ObjectSpec, PressScene, StageSpec
from tests.physics.soft_presses import IDENTITY, PITCH, RADIUS, SENSOR, indent, press, soft, uncorrected


@pytest.fixture(scope="module")
def pressed():
    """A ball pressed 0.6 mm into the coarse pad, and the states on the way."""
    pad = soft(press(indent(0.6e-3), StageSpec("release")))
    return pad, list(pad.run(2))


def reached(states):
    """State at the end of the indent."""
    return states[2]


def test_the_imprint_is_as_deep_as_commanded(pressed):
    pad, states = pressed
    state = reached(states)
    assert not state.failed[0]
    assert state.depth[0] == pytest.approx(0.6e-3, abs=2e-6)
    surface = state.surface
    assert surface.indentation.max() == pytest.approx(0.6e-3, rel=0.02)
    deepest = np.unravel_index(surface.indentation[0].argmax(), pad.grid.shape)
    assert abs(pad.grid.x[deepest[1]]) < 0.3e-3 and abs(pad.grid.y[deepest[0]]) < 0.3e-3


@pytest.mark.parametrize(("scene", "depth"), [("cone", 0.1e-3), ("cone", 0.2e-3), ("sphere", 0.05e-3)])
def test_a_shallow_press_of_something_sharp_or_small_touches_at_its_depth(scene, depth):
    """What the coat's cells cannot follow is pressed in as far as commanded, and is never lifted off the pad."""
    state = list(uncorrected(press_of(scene, depth=depth)).run())[-1]
    assert not state.failed[0]
    assert state.depth[0] == pytest.approx(depth, abs=1.1e-6)
    rigid = list(RigidPad(SENSOR, press_of(scene, depth=depth), pitch=PITCH).run())[-1]
    assert 0.3 < state.normal_force[0] / rigid.normal_force[0] < 2.0


def test_inside_the_contact_the_coat_is_the_object_and_nowhere_in_it(pressed):
    pad, states = pressed
    surface = reached(states).surface
    under = pad.object_height(surface)[0]
    gap = under - surface.height[0]
    assert surface.contact[0].sum() > 20
    assert np.abs(gap[surface.contact[0]]).max() < 8e-6
    assert gap.min() > -1e-6
    assert under.min() == pytest.approx(-0.6e-3, abs=3e-6)  # the shown object is at the depth, without the barrier's clearance


def test_forces_balance_and_traction_integrates_to_the_wrench(pressed):
    pad, states = pressed
    state = reached(states)
    wrench, traction = state.wrench[0], state.traction()[0].astype(float)
    assert wrench[2] < -0.5
    assert wrench[:3] == pytest.approx((traction * cell_areas(pad.grid)[..., None]).sum(axis=(0, 1)), rel=1e-4, abs=1e-4)
    assert state.normal_force[0] == pytest.approx(-wrench[2])


def test_the_case_feels_what_the_object_does():
    """The wrench summed over the coat's contacts is that summed over the bonded vertices, within 1 % of the load."""
    pad = uncorrected(press(indent(0.3e-3), StageSpec("shear", shear=(0.1e-3, 0.0))))
    wrench = pad.peak(pad.run()).wrench[0]
    assert pad.solver is not None
    held = pad.solver.world.wrench("pad")
    load = np.linalg.norm(wrench[:3])
    assert load > 0.3 and np.linalg.norm(held.force[0] - wrench[:3]) < 0.01 * load
    assert np.linalg.norm(held.torque[0] - wrench[3:]) < 0.01 * load * SENSOR.gelpad.thickness


def test_a_symmetric_press_has_no_net_shear_and_no_twist(pressed):
    _pad, states = pressed
    wrench = reached(states).wrench[0]
    assert np.abs(wrench[:2]).max() < 1e-6 * abs(wrench[2])
    assert np.abs(wrench[3:]).max() < 1e-6 * abs(wrench[2]) * RADIUS
    traction = reached(states).traction()[0]
    assert np.abs(traction[..., :2]).max() > 1e2  # it is there, and cancels
    height = reached(states).surface.height[0]
    assert np.abs(height - height[::-1]).max() < 1e-7 and np.abs(height - height[:, ::-1]).max() < 1e-7
    coat = reached(states).surface.coat
    assert coat is not None
    moved = coat.displacement[0].reshape(*coat.mesh.shape, 3)  # what markers ride on
    assert np.linalg.norm(moved[..., :2], axis=-1).max() > 10e-6
    assert np.abs(moved - moved[::-1] * [1.0, -1.0, 1.0]).max() < 2e-7
    assert np.abs(moved - moved[:, ::-1] * [-1.0, 1.0, 1.0]).max() < 2e-7


def test_the_coats_vertices_lie_on_the_surface_that_is_shown(pressed):
    pad, states = pressed
    for state in states:
        surface = state.surface
        assert surface.coat is not None
        x, y, z = surface.coat.positions[0].T
        inside = (np.abs(x) < 8e-3) & (np.abs(y) < 6e-3)
        node = [np.interp(at[inside], line, np.arange(len(line))) for at, line in ((y, pad.grid.y), (x, pad.grid.x))]
        shown = map_coordinates(surface.height[0].astype(float), node, order=1)
        assert np.abs(z[inside] - shown).max() < (
            0.3e-6 if surface.contact.any() else 2e-6
        )  # bilinear on a dome, or a spline's own nodes
    touching = reached(states).solved
    assert np.abs(touching.surface.coat.positions - touching.vertices).max() > 20e-6  # the mesh alone is not there


@pytest.mark.parametrize(
    ("level", "steps", "count", "most"),
    [
        ("coarse", 1, 9, 6e-6),
        pytest.param("coarse", 16, 9, 6e-6, marks=pytest.mark.slow),
        pytest.param("medium", 1, 17, 16e-6, marks=pytest.mark.slow),
    ],
)
def test_a_light_ball_does_not_push_the_skin_out_from_under_itself(level, steps, count, most):
    """What touches sticks, however large the steps: markers do not spread, and vertices by ``most`` [m].

    On a pad with cells of 0.25 mm they spread by 1 to 3 µm. Inside the volume blocks of the medium level vertices move to and fro by more,
    which the skin does not follow. The area of contact is that of such a pad, 4.39 mm² (``experiments/bench_coat.py --shapes ball``),
    within 3 %.
    """
    pad = SoftPad(SENSOR, press(indent(0.3e-3)), pitch=0.1e-3, level=level)
    reading = pad.peak(pad.run(steps)).solved
    assert reading.surface.coat is not None
    assert reading.surface.contact.sum() * np.prod(pad.grid.pitch) == pytest.approx(4.39e-6, rel=0.03)
    rest = reading.surface.coat.mesh.rest
    under = np.hypot(*rest[:, :2].T) < 1.2e-3
    mesh, skin = (np.linalg.norm((at - rest)[0, under, :2], axis=1) for at in (reading.vertices, reading.surface.coat.positions))
    assert under.sum() == count and mesh.max() < most and skin.max() < 1e-6


def test_a_contact_that_is_not_solved_is_warned_of_once():
    pad = soft(press(indent(0.3e-3)))
    state = pad.peak(pad.run())
    assert state.solved.residual[0] < 1e-6
    pad = soft(press(indent(0.3e-3)), correction=Correction(normal_iterations=2))
    with pytest.warns(UnsolvedContactWarning, match=r"was left \d+\.\d µm from its solution, more than 5 µm") as warned:
        states = list(pad.run(2))
    residuals = [state.solved.residual[0] for state in states]
    assert len(warned) == 1 and np.isnan(residuals[0]) and residuals[-1] > Correction().unsolved


def test_without_correction_the_surface_goes_through_the_solvers_vertices():
    """The press is the same, and so are its forces; the stages can be left out one by one."""
    scene = press(indent(0.4e-3), StageSpec("shear", shear=(0.15e-3, 0.0)))
    readings = {}
    for name, correction in {"none": None, "all": Correction()}.items():
        pad = soft(scene, correction=correction)
        readings[name] = pad.peak(pad.run()).solved
    assert pad.solver is not None and pad._drive is not None
    state = pad.solver.coat_state(pad._drive.poses())
    for name, correction in {
        "height": Correction(tangential=False, friction=False),
        "sideways": Correction(normal=False),
    }.items():
        readings[name] = SoftReader(pad.mesh, SENSOR.gelpad, pad.grid, correction).read(state, np.zeros(1, bool))
    plain, grid = readings["none"], pad.grid
    vertices, height = plain.vertices[0], plain.surface.height[0].astype(float)
    assert np.array_equal(plain.surface.coat.positions[0], vertices) and np.isnan(plain.residual[0])
    inside = (np.abs(vertices[:, 0]) < 8e-3) & (np.abs(vertices[:, 1]) < 6e-3)
    node = [np.interp(vertices[inside, k], line, np.arange(len(line))) for k, line in ((1, grid.y), (0, grid.x))]
    assert np.abs(map_coordinates(height, node, order=3) - vertices[inside, 2]).max() < 1e-6
    gap = (plain.underside - plain.surface.height)[plain.surface.contact]
    assert gap.size > 20 and gap.max() < pad.mesh.d_hat and np.abs(gap).max() > 10e-6  # cells of a millimetre
    whole = readings["all"]
    for reading in readings.values():
        assert np.array_equal(reading.forces, plain.forces) and np.array_equal(reading.vertices, plain.vertices)
    assert np.array_equal(readings["height"].surface.height, whole.surface.height)
    assert np.array_equal(readings["height"].surface.coat.positions[..., :2], plain.vertices[..., :2])
    assert np.array_equal(readings["sideways"].surface.height, plain.surface.height)
    assert np.array_equal(readings["sideways"].surface.coat.positions[..., :2], whole.surface.coat.positions[..., :2])
    assert np.abs(whole.surface.coat.positions[..., :2] - plain.vertices[..., :2]).max() > 5e-6


def test_settings_of_the_correction_are_checked():
    with pytest.raises(InputError, match=r"normal_iterations = 0.*whole number >= 1"):
        Correction(normal_iterations=0)
    with pytest.raises(InputError, match=r"gap_tolerance = nan.*\(0, inf\)"):
        Correction(gap_tolerance=float("nan"))
    with pytest.raises(InputError, match=r"no_blend.*greater than full_blend"):
        Correction(no_blend=0.2)
    with pytest.raises(InputError, match=r"correction.*None shows the plain surface"):
        Correction(normal=False, tangential=False, friction=False)


def test_a_release_leaves_the_pad_at_rest(pressed):
    _pad, states = pressed
    last = states[-1]
    assert last.kind == "release" and last.normal_force[0] == 0.0
    assert np.abs(last.surface.indentation).max() < 1e-6
    assert not last.surface.contact.any() and np.isnan(last.surface.contact_centre).all()


def test_running_again_forgets_the_press(pressed):
    pad, states = pressed
    again = list(pad.run(2))
    for one, two in zip(states, again, strict=True):
        assert np.abs(one.surface.height - two.surface.height).max() < 1e-9
        assert one.normal_force[0] == pytest.approx(two.normal_force[0], abs=1e-9)


def test_rigid_and_soft_agree_in_contact_and_differ_around_it(pressed):
    pad, states = pressed
    scene = press(indent(0.6e-3))
    rigid = RigidPad(SENSOR, scene, pitch=PITCH)
    state = rigid.peak(rigid.run())
    one, two = state.surface, reached(states).surface
    both = one.contact[0] & two.contact[0]
    assert both.sum() > 20 and np.abs(one.height[0] - two.height[0])[both].max() < 10e-6
    # Both contacts are wider than the π R δ of a half-space, as on a layer, but not 2 π R δ.
    assert one.contact[0].sum() == pytest.approx(two.contact[0].sum(), rel=0.03)
    assert two.contact[0][one.contact[0]].mean() > 0.99
    assert 1.1 < two.contact[0].sum() * PITCH**2 / (math.pi * RADIUS * 0.6e-3) < 1.6
    # The gel hardly changes its volume: pressed down in one place it comes up around it, which the rigid pad leaves out.
    assert two.indentation.min() < -5e-6 and one.indentation.min() > -1e-7
    rho = np.hypot(pad.grid.x[None, :], pad.grid.y[:, None])
    around = (rho > 2.5e-3) & (rho < 5e-3)
    assert np.abs(one.height[0] - two.height[0])[around].mean() > 5e-6


def test_a_straight_edge_leaves_a_straight_furrow():
    """Across cells of a millimetre, at an angle to them: along the furrow's bottom and beside it the height does not vary."""
    half = math.radians(15.0) / 2.0
    spec = ObjectSpec("edge", {"side": 8e-3}, (0.0, 0.0, 0.0), (math.cos(half), 0.0, 0.0, math.sin(half)), 0.05)
    pad = SoftPad(SENSOR, PressScene("edge", spec, (indent(0.6e-3),)), pitch=0.1e-3)
    state = pad.peak(pad.run())
    surface = state.surface
    under = pad.object_height(surface)
    assert under is not None
    along = np.linspace(-2.5e-3, 2.5e-3, 101)

    def line(field, aside):
        """A field along a line beside the edge, linear between nodes in x and y."""
        x = along * math.cos(2 * half) - aside * math.sin(2 * half)
        y = along * math.sin(2 * half) + aside * math.cos(2 * half)
        column, row = (np.clip(np.searchsorted(at, t) - 1, 0, len(at) - 2) for at, t in ((pad.grid.x, x), (pad.grid.y, y)))
        u, v = (x - pad.grid.x[column]) / pad.grid.pitch[0], (y - pad.grid.y[row]) / pad.grid.pitch[1]
        lower = (1 - u) * field[row, column] + u * field[row, column + 1]
        return (1 - v) * lower + v * ((1 - u) * field[row + 1, column] + u * field[row + 1, column + 1])

    assert np.abs(line(surface.height[0], 0.0) - line(under[0], 0.0)).max() < 3e-6  # the object's own edge, as the nodes have it
    for aside in (0.5e-3, 1.0e-3):
        # The dome and the edge's ends bend the line; lumps of a cell's length would not be a parabola.
        beside = line(surface.height[0], aside)
        assert np.abs(beside - np.polyval(np.polyfit(along, beside, 2), along)).max() < 6e-6


def test_a_sharp_cone_can_be_pressed():
    spec = ObjectSpec("cone", {"radius": 5e-3, "height": 5e-3, "tip_radius": 0.3e-3}, (0.0, 0.0, 0.0), IDENTITY, 0.05)
    pad = soft(PressScene("cone", spec, (indent(0.8e-3),)))
    state = pad.peak(pad.run())
    assert not state.failed[0] and state.depth[0] == pytest.approx(0.8e-3, abs=2e-6)


def test_case_and_object_give_the_same_press():
    stages = indent(0.4e-3), StageSpec("shear", shear=(0.2e-3, -0.1e-3)), StageSpec("twist", twist=0.05)
    one, two = (soft(press(*stages, moves=moves)) for moves in ("object", "case"))
    a, b = one.peak(one.run()), two.peak(two.run())
    assert not np.allclose(b.world_from_pad[0], np.eye(4)) and np.allclose(a.world_from_pad[0], np.eye(4))
    assert np.abs(a.surface.height - b.surface.height).max() < 2e-6
    assert a.wrench[0] == pytest.approx(b.wrench[0], rel=5e-3, abs=2e-3 * a.normal_force[0])
    world_from_object = b.world_from_pad @ b.pad_from_object
    assert np.allclose(world_from_object[0, :2, 3], 0.0, atol=1e-9) and np.allclose(
        world_from_object[0, :3, :3], np.eye(3), atol=1e-9
    )


@pytest.mark.slow
def test_a_soft_object_gives_way():
    """A ball as soft as the gel shares the depth with it; needs pytetwild, whose mesh is kept in the user's cache."""
    pytest.importorskip("pytetwild")
    hard, squash = (soft(press(indent(0.5e-3), dynamics=d, youngs_modulus=m)) for d, m in (("kinematic", 1e6), ("soft", 2e5)))
    one, two = hard.peak(hard.run()), squash.peak(squash.run())
    assert not two.failed[0] and 0.1 * one.normal_force[0] < two.normal_force[0] < 0.8 * one.normal_force[0]
    assert two.surface.indentation.max() < 0.8 * one.surface.indentation.max()
    under = squash.object_height(two.surface)
    assert under is not None and np.abs((under - two.surface.height)[two.surface.contact]).max() < 3e-5
    # All of the ball is there, up to its equator and far from the contact, whether it touches or not.
    start = next(iter(squash.run()))
    for shown in (squash.object_height(start.surface), under):
        assert shown is not None
        there = np.isfinite(shown[0])
        assert there.sum() * PITCH**2 == pytest.approx(math.pi * RADIUS**2, rel=0.05)
        assert np.ptp(shown[0][there]) > 0.5 * RADIUS


def test_the_rigid_pad_refuses_a_soft_object():
    with pytest.raises(SpecError, match=r"object\.dynamics.*physics='ipc'.*kinematic, affine"):
        RigidPad(SENSOR, press(indent(0.4e-3), dynamics="soft", youngs_modulus=2e5), pitch=PITCH)


def test_an_untouched_pad_needs_no_solver():
    pad = soft(press(kind="none"))
    state = pad.peak(pad.run())
    assert np.array_equal(state.surface.height[0], pad.grid.rest.astype(np.float32))
    assert not state.wrench.any() and not state.traction().any() and pad.object_height(state.surface) is None


def test_bad_input_is_named():
    with pytest.raises(InputError, match=r"pad.*'huge'.*coarse, medium, fine"):
        soft(press(indent(0.4e-3)), level="huge")
    with pytest.raises(InputError, match="num_envs"):
        soft(press(indent(0.4e-3)), num_envs=0)
    with pytest.raises(InputError, match="offsets"):
        soft(press(indent(0.4e-3)), offsets=np.zeros((2, 2)))
    with pytest.raises(SpecError, match=r"depth_mm"):
        soft(press(indent(5e-3)))
    with pytest.raises(SpecError, match=r"object\.dynamics.*'ghost'.*kinematic, affine, soft"):
        soft(press(indent(0.4e-3), dynamics="ghost"))
    pad = soft(press(kind="none"))
    with pytest.raises(InputError, match="steps_per_stage"):
        next(pad.run(0))


def test_a_tilt_past_the_bonded_face_is_refused_before_a_step():
    """A disc 3.4 mm deep in 4 mm of gel, whose rim would go 1.5 mm deeper: in the scene, as a further stage, after a release."""
    tilt, level, deep = StageSpec("tilt", tilt=(0.0, 0.8)), StageSpec("tilt"), indent(3.4e-3)
    past = r"3\.4.*deeper than the pad is there: at most 2\.45"
    with pytest.raises(SpecError, match=rf"trajectory\[1\]\.tilt_deg = \[0\.0, 45\.8366\].*{past}"):
        soft(press(deep, tilt, kind="cylinder"))
    with pytest.raises(SpecError, match=rf"trajectory\[3\]\.depth_mm = {past}"):
        soft(press(indent(0.4e-3), tilt, StageSpec("release"), deep, kind="cylinder"))
    pad = soft(press(indent(0.4e-3), tilt, level, deep, kind="cylinder"))
    pad.reset()
    assert pad._drive is not None
    pad._drive.begin(-1, tilt)  # 1 mm above the pad it may be tilted
    pad._drive._depth[:] = 3.4e-3
    with pytest.raises(InputError, match=past):
        pad._drive.begin(-1, tilt)


def test_an_object_that_overlaps_the_pad_at_the_start_is_named(tmp_path):
    """A ball with a blade beside it that reaches lower, thinner than the grid that looks for the first touch."""
    import trimesh

    edge = SENSOR.gelpad.size[0] / 2
    wall = trimesh.creation.box((0.1e-3, 30e-3, 6e-3), trimesh.transformations.translation_matrix((edge - 0.1e-3, 0.0, -4e-3)))
    ball = trimesh.creation.icosphere(3, 4e-3)
    both = trimesh.util.concatenate([wall, ball])
    both.export(tmp_path / "cap.stl")
    spec = ObjectSpec("mesh", {"path": str(tmp_path / "cap.stl"), "scale": 1.0}, (0.0, 0.0, 0.0), IDENTITY, 0.05)
    scene = PressScene("cap", spec, (indent(0.4e-3),))
    with pytest.raises(RaytacError, match=r"overlaps the pad where it starts"):
        soft(scene)


def test_stages_that_are_followed_one_by_one_are_those_of_the_scene():
    stages = indent(0.3e-3), StageSpec("shear", shear=(0.1e-3, 0.0)), StageSpec("release")
    pad = soft(press(*stages))
    ran = list(pad.run())[1:]
    pad.reset()
    for state, stage in zip(ran, stages, strict=True):
        (followed,) = pad.follow(stage)
        assert (followed.stage, followed.kind) == (-1, state.kind)
        assert followed.pad_from_object == pytest.approx(state.pad_from_object, abs=1e-9)
        assert followed.normal_force == pytest.approx(state.normal_force, rel=1e-5, abs=1e-9)


def test_a_stage_deeper_than_the_surface_that_was_made_is_refused():
    pad = soft(press(indent(0.3e-3)))
    with pytest.raises(InputError, match=r"deepest stage, 0\.3 mm"):
        next(pad.follow(indent(0.4e-3)))
    with pytest.raises(InputError, match="deepest"):
        next(pad.follow(indent(force=1.0)))


@pytest.mark.slow
def test_gel_that_is_crushed_folds_and_does_not_pass_through_itself(monkeypatch):
    """A ring pressed with 72 N near the corner of a domed pad: the side of the gel was once driven through itself, step after step."""
    crossed, advance = [], SoftScene.advance

    def checked(scene, *args, **settings):
        report = advance(scene, *args, **settings)
        vertices, faces = scene.mesh("pad")
        edges = ipctk.edges(faces)
        crossed.append(ipctk.has_intersections(ipctk.CollisionMesh(vertices[0], edges, faces), vertices[0]))
        return report

    monkeypatch.setattr(SoftScene, "advance", checked)
    turn = -0.33007611, -0.86478793, 0.36885866, 0.08446829
    ring = ObjectSpec("torus", {"major_radius": 2.9491e-3, "minor_radius": 1.3064e-3}, (-7.9095e-3, 7.9068e-3, 0.0), turn, 0.05)
    pad = soft(PressScene("ring", ring, (indent(force=71.75607),)), load_sensor("gelsight_dome"))
    pad.peak(pad.run())
    assert len(crossed) > 30 and not any(crossed)
