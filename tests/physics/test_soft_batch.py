"""Environments of the soft pad and objects that lie free on it: each is what it would be alone."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from raytac.errors import InputError, SpecError
from raytac.physics.soft.mesh import pad_mesh
from raytac.physics.soft.press_solver import PressSolver
from raytac.physics.soft.scene import SoftScene
from raytac.physics.soft.settings import PressControl
from raytac.specs.press import StageSpec
from tests.physics.soft_presses import SENSOR, indent, press, soft, uncorrected

pytestmark = pytest.mark.usefixtures("few_cells")
COARSE = pad_mesh(SENSOR.gelpad, "coarse")
"""Steps of a shear are resolved by its cells."""


def test_a_batch_is_its_single_presses_and_lost_environments_fail_alone():
    scene = press(indent(0.4e-3))
    offsets = np.array([[0.0, 0.0], [2e-3, -1e-3], [np.nan, 0.0]])
    many = soft(scene, num_envs=3, offsets=offsets)
    state = many.peak(many.run())
    assert list(state.failed) == [False, False, True] and np.isnan(state.depth[2])
    assert np.isnan(state.surface.height[2]).all() and np.isfinite(state.surface.height[:2]).all()
    for b in range(2):
        one = soft(scene, offsets=offsets[b : b + 1])
        alone = one.peak(one.run())
        assert np.abs(alone.surface.height[0] - state.surface.height[b]).max() < 1e-6
        assert alone.normal_force[0] == pytest.approx(state.normal_force[b], rel=1e-3)


def test_a_press_at_the_border_is_sound_and_leaves_the_others_as_they_are():
    """It once ended in an IndexError, and took the whole batch with it."""
    scene, offsets = press(indent(0.15e-3)), np.array([[0.0, 0.0], [12e-3, 0.0]])
    many = soft(scene, num_envs=2, offsets=offsets)
    state = many.peak(many.run())
    surface = state.surface
    assert not state.failed.any() and unconverged(state) == [0, 0]
    assert surface.coat is not None and np.isfinite(surface.coat.positions).all()
    assert surface.indentation[1].max() == pytest.approx(0.15e-3, rel=0.05)
    one = soft(scene)
    alone = one.peak(one.run())
    assert np.abs(alone.surface.height[0] - surface.height[0]).max() < 1e-6


def test_a_number_that_is_not_finite_fails_its_own_environment(monkeypatch):
    scene, offsets = press(indent(0.1e-3)), np.array([[0.0, 0.0], [2e-3, 0.0]])
    seen = PressSolver.coat_state

    def spoilt(contact, poses):
        found = seen(contact, poses)
        found.forces.numpy()[0, 7, 1] = np.inf  # a view
        return found

    with monkeypatch.context() as patch:
        patch.setattr(PressSolver, "coat_state", spoilt)
        many = soft(scene, num_envs=2, offsets=offsets)
        state = many.peak(many.run())
        surface, wrench = state.surface, state.wrench
    assert state.failed.tolist() == [True, False] and surface.coat is not None
    for values in (surface.height, surface.coat.positions, wrench, state.traction(), state.normal_force, state.depth):
        assert np.isnan(values[0]).all() and np.isfinite(values[1]).all()
    assert not surface.contact[0].any() and surface.contact[1].any()
    one = soft(scene, offsets=offsets[1:])
    alone = one.peak(one.run())
    assert np.abs(alone.surface.height[0] - surface.height[1]).max() < 1e-6


def unconverged(state):
    assert state.unconverged is not None
    return state.unconverged.tolist()


class Converging:
    """Lets the solver's reports say that the steps named did not converge, in environment 0 of as many as there are."""

    def __init__(self, monkeypatch, *steps):
        self.calls, advance = 0, SoftScene.advance

        def told(scene, *args, **settings):
            report = advance(scene, *args, **settings)
            self.calls += 1
            if self.calls in steps:
                bad = np.arange(scene.num_envs) == 0
                ends, count = report.last_converged & ~bad, report.unconverged + bad
                report = replace(report, converged=report.converged & ~bad, unconverged=count, last_converged=ends)
            return report

        monkeypatch.setattr(SoftScene, "advance", told)


def test_steps_that_do_not_converge_are_counted_and_one_that_ends_a_press_is_followed_by_still_ones(monkeypatch):
    scene = press(indent(0.05e-3))
    with monkeypatch.context() as patch:
        steps = Converging(patch)
        pad = uncorrected(scene)
        assert unconverged(pad.peak(pad.run())) == [0]
        usual = steps.calls
    with monkeypatch.context() as patch:
        steps = Converging(patch, 2, usual)
        many = uncorrected(scene, num_envs=2)
        state = many.peak(many.run())
        assert steps.calls > usual and unconverged(state) == [2, 0] and not state.failed.any()
    with monkeypatch.context() as patch:
        Converging(patch, *range(usual, usual + 50))
        many = uncorrected(scene, num_envs=2)
        state = many.peak(many.run())
        assert state.failed.tolist() == [True, False] and unconverged(state)[0] > 1 and unconverged(state)[1] == 0
        many.reset()
        assert unconverged(next(iter(many.run()))) == [0, 0]


def test_a_solver_that_never_converges_fails_the_press():
    pad = uncorrected(press(indent(0.02e-3)), control=PressControl(tolerance=1e-40, refinements=1))
    state = pad.peak(pad.run())
    assert state.failed.all() and unconverged(state)[0] >= 2


def test_what_has_failed_is_not_stepped(monkeypatch):
    steps = Converging(monkeypatch)
    pad = uncorrected(press(indent(0.05e-3)), offsets=np.full((1, 2), np.nan))
    assert pad.peak(pad.run()).failed.all() and steps.calls == 0
    many = uncorrected(press(indent(0.05e-3)), num_envs=2, offsets=np.array([[0.0, 0.0], [np.nan, 0.0]]))
    assert many.peak(many.run()).failed.tolist() == [False, True] and steps.calls > 0
    assert many.solver is not None and many.solver.scene.failed.tolist() == [False, True]
    many.reset()
    assert not many.solver.scene.failed.any()


def test_turn_and_shear_by_environment_are_those_of_scenes_of_their_own():
    turns = np.array([[1.0, 0.0, 0.0, 0.0], [math.cos(0.6), 0.0, math.sin(0.6), 0.0]])
    shears = np.array([[0.1e-3, 0.0], [0.0, -0.2e-3]])
    stages = indent(0.4e-3), StageSpec("shear", shear=(1e-3, 1e-3))
    many = soft(press(*stages, kind="cylinder"), num_envs=2, level=COARSE, rotations=turns, shears=shears)
    state = many.peak(many.run())
    for b in range(2):
        scene = press(indent(0.4e-3), StageSpec("shear", shear=tuple(shears[b])), kind="cylinder")
        one = soft(replace(scene, object=replace(scene.object, quaternion=tuple(turns[b]))), level=COARSE)
        alone = one.peak(one.run())
        # A batch takes as many steps as the longest of its ways asks for.
        assert np.abs(alone.surface.height[0] - state.surface.height[b]).max() < 3e-6
        assert alone.normal_force[0] == pytest.approx(state.normal_force[b], rel=5e-3)
        assert alone.shear_force[0] == pytest.approx(state.shear_force[b], rel=0.03, abs=2e-3)
    assert state.normal_force[1] < 0.5 * state.normal_force[0]  # on its rim


def test_a_shear_in_one_step_has_the_friction_of_four():
    """A flat face, whose slow modes conjugate gradients reach last: ended by ‖r‖ alone, one step lost 5 % of its friction."""
    scene = press(indent(0.4e-3), StageSpec("shear", shear=(0.1e-3, 0.0)), kind="cylinder")
    one, four = (list(uncorrected(scene, level=COARSE).run(states))[-1].shear_force[0, 0] for states in (1, 4))
    assert four > 0.3 and one == pytest.approx(four, rel=0.01)


def test_every_environment_has_its_depth():
    depths = np.array([0.2e-3, 0.4e-3])
    pad = uncorrected(press(indent(0.3e-3)), num_envs=2, depths=depths)
    state = pad.peak(pad.run())
    assert state.depth == pytest.approx(depths, abs=2e-6) and state.normal_force[1] > 2 * state.normal_force[0]


def test_a_resting_weight_presses_with_its_weight():
    pad = uncorrected(press(indent(force=0.3), StageSpec("release"), dynamics="affine"))
    states = list(pad.run())
    assert not states[1].failed[0]
    assert states[1].normal_force[0] == pytest.approx(0.3, rel=0.01)
    assert 0.0 < states[1].depth[0] < 1e-3
    assert not states[2].surface.contact.any()


def test_free_objects_lie_where_their_offsets_put_them():
    offsets = np.array([[0.0, 0.0], [3e-3, 1e-3]])
    pad = soft(press(indent(force=0.3), kind="cylinder", dynamics="affine"), num_envs=2, offsets=offsets)
    state = pad.peak(pad.run())
    assert not state.failed.any() and state.normal_force == pytest.approx([0.3, 0.3], rel=0.01)
    assert np.abs(state.surface.contact_centre - offsets).max() < 0.1e-3  # the second leans down the dome


@pytest.mark.slow
def test_a_ball_rolls_down_the_dome_and_says_that_it_does_not_rest():
    """Near the top, where the slope is below 0.5°, a coarse pad's cells hold it within 1 mm; further down nothing stops it."""
    pad = soft(press(indent(force=0.3), dynamics="affine"), num_envs=2, offsets=np.array([[0.0, 0.0], [8e-3, 5e-3]]))
    state = pad.peak(pad.run())
    assert state.failed.tolist() == [False, True]
    assert np.linalg.norm(state.pad_from_object[0, :2, 3]) < 1e-3


def test_a_ball_is_not_at_rest_where_it_turns_back(monkeypatch):
    """A swinging ball is slow at its turning points, for one step."""
    pad = soft(press(indent(force=0.3), dynamics="affine"))
    speeds = iter([1e-2, 1e-6, 1e-2, 1e-6, 1e-6])
    calls = []

    def speed(solver):
        calls.append(next(speeds))
        return np.array(calls[-1:])

    monkeypatch.setattr(type(pad.solver), "speed", speed)
    assert not pad.peak(pad.run()).failed[0]
    assert len(calls) == 5


def test_where_one_environment_of_a_batch_leaves_the_pad_is_told_before_the_solver_starts():
    sheared = press(indent(0.4e-3), StageSpec("shear", shear=(1e-3, 0.0)), StageSpec("twist", twist=0.1))
    with pytest.raises(InputError, match=r"shears = .*in environment 2, in trajectory\[1\]: no part of the object") as caught:
        soft(sheared, num_envs=3, shears=np.array([[0.0, 0.0], [np.nan, 0.0], [0.0, -40e-3]]))
    assert caught.value.value == [0.0, -40e-3]
    with pytest.raises(InputError, match=r"offsets = .*in environment 1, at the start: no part"):
        soft(sheared, num_envs=2, offsets=np.array([[0.0, 0.0], [40e-3, 0.0]]))
    far = press(indent(0.4e-3), StageSpec("shear", shear=(40e-3, 0.0)))
    with pytest.raises(SpecError, match=r"trajectory\[1\]\.shear_mm = \[40\.0, 0\.0\]"):
        soft(far)
