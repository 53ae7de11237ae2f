"""The load law for contacts of any shape and in pieces, against an elastic layer solved by itself; and what a law must do."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from raytac.gel.surface import make_grid
from raytac.physics.objects import object_parts
from raytac.physics.rigid.contacts import LAW_POINTS
from raytac.physics.rigid.layer_response import layer_response, reduced_modulus
from raytac.physics.rigid.load_law import LoadLaw, first_touch
from raytac.physics.rigid.pad import RigidPad
from raytac.physics.rigid.regions import elliptic_compliance
from raytac.physics.rigid.search import PadSearch
from raytac.se3 import rotations
from raytac.specs import load_press, load_sensor
from raytac.specs.press import StageSpec
from tests.gel.layer_contact import ABSENT, Layer

MINI = load_sensor("gelsight_mini")
GEL = MINI.gelpad
WIDE = replace(GEL, size=(38e-3, 38e-3), dome_radius=(math.inf, math.inf))
LAYER = Layer(384, 38.4e-3, GEL.thickness, GEL.poisson_ratio)
LINE = LAYER.lines
X, Y = LINE[None, :] - 0.011e-3, LINE[:, None] - 0.017e-3


def law_of(gap: np.ndarray) -> LoadLaw:
    return LoadLaw(gap, LINE, LINE, WIDE)


def layer_force(gap: np.ndarray, depth: float) -> float:
    pressure, _ = LAYER.press(np.where(np.isfinite(gap), depth - gap, ABSENT), 2e-4)
    return float(pressure.sum()) * LAYER.pitch**2 * reduced_modulus(GEL)


def faces(*boxes: tuple[float, float, float, float]) -> np.ndarray:
    """Gap of flat rectangles: middle and half sides [mm]."""
    on = np.any([(np.abs(X - 1e-3 * a) < 1e-3 * p) & (np.abs(Y - 1e-3 * b) < 1e-3 * q) for a, b, p, q in boxes], axis=0)
    return np.where(on, 0.0, np.inf)


def pins(count: int, pitch: float, radius: float) -> np.ndarray:
    line = (np.arange(count) - 0.5 * (count - 1)) * pitch
    return np.where(np.any([np.hypot(X - a, Y - b) < radius for a in line for b in line], axis=0), 0.0, np.inf)


def balls(*places: tuple[float, float], radius: float = 3.155e-3) -> np.ndarray:
    squares = [radius**2 - (X - a) ** 2 - (Y - b) ** 2 for a, b in places]
    return np.min([np.where(s > 0.0, radius - np.sqrt(np.maximum(s, 0.0)), np.inf) for s in squares], axis=0)


def test_an_elliptic_punch_on_a_half_space_has_the_mean_of_its_axes_as_radius() -> None:
    """The arithmetic-geometric one, of a contact that is small against the layer."""
    layer, ratio = layer_response(GEL), np.array([1.0, 0.9, 0.5, 0.2, 0.05])
    one, two = np.ones(5), ratio
    for _ in range(8):
        one, two = 0.5 * (one + two), np.sqrt(one * two)
    long = np.full(5, 1e-6)
    radius = 1.0 / (2.0 * reduced_modulus(GEL) * elliptic_compliance(long, ratio * long, layer, GEL))
    np.testing.assert_allclose(radius / 1e-6, one, rtol=2e-3)


@pytest.mark.parametrize(
    ("count", "pitch", "radius"), [(2, 3e-3, 0.5e-3), (5, 3e-3, 0.5e-3), (5, 1.5e-3, 0.5e-3), (3, 4e-3, 1e-3)]
)
def test_pins_carry_what_they_carry_on_the_layer(count: int, pitch: float, radius: float) -> None:
    """A disc of their area would carry 40 to 65 % less."""
    gap = pins(count, pitch, radius)
    assert law_of(gap).force(0.3e-3) == pytest.approx(layer_force(gap, 0.3e-3), rel=0.08)


@pytest.mark.parametrize("cut", [0.0, 0.2, 0.6, 1.0, 2.0, 4.0])
def test_a_punch_that_is_cut_into_quarters_gets_stiffer_as_on_the_layer(cut: float) -> None:
    at = 1.0 + 0.5 * cut
    gap = faces(*((a, b, 1.0, 1.0) for a in (-at, at) for b in (-at, at)))
    assert law_of(gap).force(0.3e-3) == pytest.approx(layer_force(gap, 0.3e-3), rel=0.06)


@pytest.mark.parametrize("distance", [2e-3, 4e-3, 12e-3])
def test_two_balls_carry_what_they_carry_on_the_layer(distance: float) -> None:
    gap = balls((-0.5 * distance, 0.0), (0.5 * distance, 0.0))
    assert law_of(gap).force(0.5e-3) == pytest.approx(layer_force(gap, 0.5e-3), rel=0.08)


def test_two_balls_far_apart_carry_twice_as_much_as_one() -> None:
    law, one = law_of(balls((-8e-3, 0.0), (8e-3, 0.0))), law_of(balls((0.0, 0.0)))
    for depth in (0.2e-3, 0.5e-3, 1e-3):
        assert law.force(depth) == pytest.approx(2.0 * one.force(depth), rel=0.08)
        assert law.contact_area(depth) == pytest.approx(2.0 * one.contact_area(depth), rel=0.15)


@pytest.mark.parametrize(("half_x", "half_y"), [(2.0, 2.0), (6.0, 1.0), (5.0, 0.3)])
def test_a_long_face_is_that_of_the_layer(half_x: float, half_y: float) -> None:
    gap = faces((0.0, 0.0, half_x, half_y))
    assert law_of(gap).force(0.3e-3) == pytest.approx(layer_force(gap, 0.3e-3), rel=0.05)
    turned = law_of(faces((0.0, 0.0, half_y, half_x)))
    assert turned.force(0.3e-3) == pytest.approx(law_of(gap).force(0.3e-3), rel=0.02)


@pytest.mark.parametrize("share", [0.1, 0.3, 0.5])
@pytest.mark.parametrize("shape", ["strip", "pins"])
def test_what_tilts_keeps_its_middle(shape: str, share: float) -> None:
    """A strip and a field of pins that tilt by a share of the depth carry what they carry level."""
    gap, depth, half = (faces((0.0, 0.0, 5.0, 1.0)), 0.2e-3, 5e-3) if shape == "strip" else (pins(4, 3e-3, 0.5e-3), 0.2e-3, 5e-3)
    tilted = law_of(gap + share * depth * (1.0 + X / half))
    assert tilted.force((1.0 + share) * depth) == pytest.approx(law_of(gap).force(depth), rel=0.01)


@pytest.mark.parametrize("kind", ["pins", "discs", "balls"])
def test_the_force_does_not_jump_where_pieces_meet(kind: str) -> None:
    """Two things that part by a fifth of a node's spacing a step: less than 4 % a step for pins of ten nodes, 1 % for balls."""
    steps = np.arange(0.0, 3.2e-3, 0.02e-3)
    force, near = [], slice(132, 253)
    for apart in steps:
        at = 0.5 * apart
        if kind == "balls":
            gap = balls((-at, 0.0), (at, 0.0))
        else:
            radius = 0.5e-3 if kind == "pins" else 1.4e-3
            gap = np.where(np.minimum(np.hypot(X - at, Y), np.hypot(X + at, Y)) < radius, 0.0, np.inf)
        force.append(LoadLaw(gap[near, near], LINE[near], LINE[near], WIDE).force(0.4e-3))
    force = np.array(force)
    step = {"pins": 0.04, "discs": 0.02, "balls": 0.01}[kind]  # nodes of a flat face come and go, as for one piece
    assert (np.abs(np.diff(force)) / force[1:]).max() < step
    assert force[-1] > 1.4 * force[0]


def test_a_law_grows_with_depth_and_area() -> None:
    """Of pins of several heights, a wavy face and a coin; and a press inverts it."""
    stairs = pins(5, 3e-3, 0.5e-3) + 0.1e-3 * np.round((X + 8e-3) / 3e-3)
    wavy = np.where((np.abs(X) < 5e-3) & (np.abs(Y) < 5e-3), 0.1e-3 * (1.0 + np.cos(3e3 * X) * np.cos(3e3 * Y)), np.inf)
    for gap in (stairs - stairs.min(), wavy - wavy.min()):
        law = law_of(gap)
        depths = np.linspace(0.0, 1.5e-3, 400)
        force = np.array([law.force(depth) for depth in depths])
        assert force[0] == 0.0 and (np.diff(force) > 0.0).all() and (np.diff(force, 2) > -1e-9 * force[-1]).all()
        assert (np.diff(law.area) >= 0.0).all()
        for depth in (0.1e-3, 0.4e-3, 1.2e-3):
            assert law.depth_at(law.force(depth)) == pytest.approx(depth, rel=1e-3)


@pytest.mark.parametrize("name", ["sphere", "cylinder", "edge", "torus", "pins", "mesh"])
def test_a_press_and_a_world_have_the_same_force(name: str) -> None:
    scene = load_press(name).object
    parts, pose = object_parts(scene), np.eye(4)
    w, *axis = scene.quaternion
    length = math.hypot(*axis)
    if length > 0.0:
        pose[:3, :3] = rotations(2.0 * math.atan2(length, w) / length * np.array([axis]))[0]
    grid = make_grid(GEL, 0.1e-3)
    touch = first_touch(parts, pose, GEL, grid)
    law, depths = LoadLaw(touch.gap, grid.x, grid.y, GEL, touch.deepest), np.array([0.3e-3, 0.5e-3, 0.7e-3])
    poses = np.tile(pose, (3, 1, 1))
    poses[:, 2, 3] = touch.z - depths
    contacts = PadSearch([GEL], [parts], num_envs=3).contacts(poses[:, None, None], np.arange(3), 0.1e-3)
    at = contacts.deepest[:, None] * np.linspace(0.0, 1.0, LAW_POINTS) ** 2
    force = [np.interp(*row) for row in zip(contacts.depth, at, contacts.force, strict=True)]
    np.testing.assert_allclose(force, [law.force(depth) for depth in depths], rtol=0.05)
    k = np.searchsorted(at[1], contacts.depth[1])
    assert contacts.radius[1, k] == pytest.approx(law.contact_radius(at[1, k]), rel=0.1)


def test_a_press_by_force_of_many_pins_goes_to_the_depth_that_carries_it() -> None:
    scene = load_press("pins")
    by_depth = [*RigidPad(MINI, replace(scene, trajectory=(StageSpec("indent", depth=0.4e-3),)), pitch=0.1e-3).run()][-1]
    force = float(by_depth.normal_force[0])
    assert force > 2.0
    by_force = [*RigidPad(MINI, replace(scene, trajectory=(StageSpec("indent", force=force),)), pitch=0.1e-3).run()][-1]
    assert float(by_force.depth[0]) == pytest.approx(0.4e-3, rel=1e-3)
