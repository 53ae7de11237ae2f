"""The rigid pad near its bonded face: depth is compared with the gel where the object is, and traction sums to the wrench."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from raytac.errors import InputError, SpecError
from raytac.gel import pyramid
from raytac.gel.gaussian import PYRAMID_SIGMAS
from raytac.gel.traction import cell_areas
from raytac.physics.rigid.pad import RigidPad
from raytac.sensor import TactileSensor
from raytac.specs import load_press, load_sensor
from raytac.specs.press import ObjectSpec, PressScene, StageSpec

SHIPPED = ("coin", "cone", "cylinder", "edge", "mesh", "pins", "sphere", "torus")
SENSORS = {name: load_sensor(name) for name in ("gelsight_mini", "gelsight_dome")}
MINI = SENSORS["gelsight_mini"]
CORNER = np.array([11e-3, 8e-3])
BELOW = MINI.gelpad.thickness - MINI.gelpad.sag(*CORNER)
"""Gel under a corner of the Mini's dome [m]: 3.47 mm of 4."""


def scene_of(*stages: StageSpec, at: np.ndarray | tuple[float, float] = (0.0, 0.0), **size: float) -> PressScene:
    kind = "box" if "length" in size else "sphere"
    shape = ObjectSpec(kind, dict(size or {"radius": 1e-3}), (float(at[0]), float(at[1]), 0.0), (1.0, 0.0, 0.0, 0.0), 0.1)
    return PressScene("press", shape, stages, source=Path("press.toml"))


def pad_of(scene: PressScene, *, pitch: float = 0.2e-3, **options) -> RigidPad:
    return RigidPad(MINI, scene, pitch=pitch, **options)


def test_depth_is_compared_with_the_gel_under_the_object() -> None:
    """A ball of 1 mm touches the dome a little up the slope: first touch is r (1/cos θ − 1), 3 µm, higher than the gel under its middle."""
    for depth, sound in ((BELOW - 1e-6, True), (BELOW + 5e-6, False)):
        pad = pad_of(scene_of(StageSpec("indent", depth=depth), at=CORNER))
        if sound:
            state = pad.peak(pad.run())
            assert not state.failed.any()
            assert 0.0 < state.surface.height.min() + MINI.gelpad.thickness < 20e-6  # nodes beside the lowest point
        else:
            with pytest.raises(
                SpecError, match=r"trajectory\[0\].depth_mm = 3.4.*deeper than the pad is there: at most 3.4"
            ) as caught:
                list(pad.run())
            assert caught.value.value == pytest.approx(depth * 1e3, abs=1e-5)


def test_a_force_is_compared_with_it_too() -> None:
    corner, middle = (pad_of(scene_of(StageSpec("indent", force=200.0), at=at, radius=5e-5)) for at in (CORNER, (0.0, 0.0)))
    most = []
    for pad in (corner, middle):
        with pytest.raises(SpecError, match=r"trajectory\[0\]\.force_n = .*deeper than the pad is there"):
            list(pad.run())
        most.append(next(iter(pad._touches.values()))[1])
    assert most[0].deepest == pytest.approx(BELOW, abs=10e-6) and most[1].deepest == MINI.gelpad.thickness
    assert most[0].greatest < most[1].greatest < 200.0
    # A thousandth deeper it is more, so this was the depth with a twentieth of the thickness left.
    for law in most:
        depth = law.depth_at(law.greatest)
        assert depth == pytest.approx(law.deepest - 0.05 * MINI.gelpad.thickness, abs=1e-8)


def test_a_depth_kept_where_there_is_less_gel_is_blamed_on_what_moves() -> None:
    """A tilted box touches with a flank at the edge of the pad; sheared in, its corner comes over the gel, which is lower."""
    tilt = (math.cos(0.3), 0.0, -math.sin(0.3), 0.0)
    stages = StageSpec("indent", depth=2.5e-3), StageSpec("shear", shear=(-4e-3, 0.0))
    scene = scene_of(*stages, at=(14e-3, 0.0), length=6e-3, width=2e-3, height=9e-3)
    scene = dataclasses.replace(scene, object=dataclasses.replace(scene.object, quaternion=tilt))
    pad = pad_of(scene)
    with pytest.raises(
        SpecError, match=r"trajectory\[1\].shear_mm = .*the depth kept here, 2.5 mm, would press deeper than the pad is"
    ):
        list(pad.run())


def test_one_environment_of_a_batch_is_named() -> None:
    deep = 0.99 * MINI.gelpad.thickness
    scene = scene_of(StageSpec("indent", depth=1e-3))
    at = np.array([[0.0, 0.0], CORNER])
    with pytest.raises(
        InputError, match=r"depths \[mm\] = 3.96: in environment 1, in trajectory\[0\]: would press deeper"
    ) as caught:
        list(pad_of(scene, num_envs=2, offsets=at, depths=np.array([deep, deep])).run())
    assert caught.value.value == pytest.approx(3.96)
    scene = scene_of(StageSpec("indent", depth=deep))
    with pytest.raises(
        InputError, match=r"offsets = .*in environment 1, in trajectory\[0\]: the depth, 3.96 mm, would press deeper"
    ):
        list(pad_of(scene, num_envs=2, offsets=at).run())


def test_gel_that_would_lie_below_the_bonded_face_fails_its_environment_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """A plate wider than the pad, under Gaussians without loss (Taxim's): mirrored at the borders, they lift its displacement there."""
    scene = scene_of(StageSpec("indent", depth=1e-3), StageSpec("release"), length=40e-3, width=40e-3, height=5e-3)
    depths = np.array([2.0, 3.99, 3.0]) * 1e-3
    pad = pad_of(scene, num_envs=3, depths=depths)
    assert not any(state.failed.any() for state in pad.run())  # the layer's own gains hold it at the plate
    monkeypatch.setattr(pyramid, "LAYER_STEPS", tuple((sigma / MINI.gelpad.thickness, 1.0) for sigma in PYRAMID_SIGMAS))
    pad = pad_of(scene, num_envs=3, depths=depths)
    start, pressed, released = pad.run()
    assert not start.failed.any()
    for state in (pressed, released):
        assert state.failed.tolist() == [False, True, False] and np.isnan(state.normal_force[1])
        assert np.isnan(state.surface.height[1]).all() and not state.surface.contact[1].any()
    alone = pad_of(scene, depths=depths[:1])
    np.testing.assert_array_equal(pressed.surface.height[0], list(alone.run())[1].surface.height[0])


def test_a_pose_that_pierces_the_gel_gives_no_surface() -> None:
    pad = pad_of(scene_of(StageSpec("indent", depth=1e-3)))
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 2, 3] = 1e-3 - np.array([0.5e-3, MINI.gelpad.thickness + 1e-6, MINI.gelpad.thickness - 1e-6])
    surface = pad.surface_from_pose(poses)
    assert np.isnan(surface.height).any(axis=(1, 2)).tolist() == [False, True, False]
    assert surface.contact.any(axis=(1, 2)).tolist() == [True, False, True]
    assert np.isnan(surface.contact_centre).any(axis=1).tolist() == [False, True, False]


def test_area_and_traction_count_half_a_cell_at_the_edge() -> None:
    sensor = TactileSensor("gelsight_mini", outputs=("wrench", "traction"))
    half = 0.5 * MINI.gelpad.size[0]
    frame = sensor.press(scene_of(StageSpec("indent", depth=0.5e-3), at=(half, 0.0), length=4e-3, width=4e-3, height=5e-3))
    assert frame.surface.contact[0][:, -1].any() and frame.wrench is not None
    area = cell_areas(frame.surface.grid)
    total = (frame.traction[0] * area[..., None]).sum(axis=(0, 1))
    np.testing.assert_allclose(total, frame.wrench[0, :3], rtol=1e-5)
    touched = frame.surface.contact[0]
    assert frame.contact_area[0] == pytest.approx((touched * area).sum(), rel=1e-9)
    assert frame.contact_area[0] < 0.9999 * touched.sum() * np.prod(frame.surface.grid.pitch)


def test_a_contact_of_one_node_carries_a_twist_without_a_force() -> None:
    node = 0.5 * MINI.gelpad.size[0] / 63  # the grid has 64 nodes along x and one at y = 0
    pad = pad_of(scene_of(StageSpec("indent", depth=5e-6), StageSpec("twist", twist=0.5), at=(node, 0.0)), pitch=0.4e-3)
    state = list(pad.run())[-1]
    assert state.surface.contact.sum() == 1 and state.twist_torque[0] > 0.0
    total = (state.traction()[0] * cell_areas(pad.grid)[..., None]).sum(axis=(0, 1))
    np.testing.assert_allclose(total, state.wrench[0, :3], atol=1e-6 * state.normal_force[0])


def random_press(rng: np.random.Generator, pitch: float) -> tuple[str, float]:
    """One press of a shipped object anywhere, at any tilt: what became of it, and how far traction and wrench are apart."""
    sensor = SENSORS[str(rng.choice(sorted(SENSORS)))]
    scene = load_press(str(rng.choice(SHIPPED)))
    thickness, half = sensor.gelpad.thickness, 0.5 * np.array(sensor.gelpad.size)
    at, turn = rng.uniform(-1.0, 1.0, 2) * half, rng.normal(size=4)
    if rng.random() < 0.3:
        turn = np.array([1.0, 0.0, 0.0, 0.0])
    turn /= np.linalg.norm(turn)
    depth = float(rng.choice([rng.uniform(0.05, 0.9), rng.uniform(0.9, 0.9999)])) * thickness
    indent = (
        StageSpec("indent", depth=depth)
        if rng.random() < 0.8
        else StageSpec("indent", force=float(10.0 ** rng.uniform(-1.0, 2.0)))
    )
    stages = [
        indent,
        StageSpec("shear", shear=tuple(rng.uniform(-2e-3, 2e-3, 2))),
        StageSpec("twist", twist=rng.uniform(-1.0, 1.0)),
    ]
    shape = dataclasses.replace(scene.object, position=(*at.tolist(), 0.0), quaternion=tuple(turn.tolist()))
    pad = RigidPad(
        sensor, dataclasses.replace(scene, object=shape, trajectory=tuple(stages[: int(rng.integers(1, 4))])), pitch=pitch
    )
    apart, pressed = 0.0, "pressed"
    try:
        for state in pad.run():
            if state.failed[0]:
                return "failed", apart
            surface, wrench = state.surface, state.wrench[0]
            assert surface.height.min() >= -thickness - 1e-8
            total = (state.traction()[0].astype(float) * cell_areas(pad.grid)[..., None]).sum(axis=(0, 1))
            if wrench[2] < 0.0:
                apart = max(apart, float(np.abs(total - wrench[:3]).max() / np.linalg.norm(wrench[:3])))
    except (SpecError, InputError) as error:
        assert "deeper than the pad" in str(error) or "above a node" in str(error), error
        pressed = "refused"
    return pressed, apart


@pytest.mark.parametrize(
    ("count", "pitch"), [(24, 0.4e-3), pytest.param(300, 0.1e-3, marks=pytest.mark.slow)], ids=["few", "300"]
)
def test_random_presses_have_no_gel_below_the_bonded_face_and_balance(count: int, pitch: float) -> None:
    rng = np.random.default_rng(17)
    found = [random_press(rng, pitch) for _ in range(count)]
    assert max(apart for _, apart in found) < 1e-3
    became = [what for what, _ in found]
    assert became.count("pressed") > count // 3 and became.count("refused") > 0
    assert became.count("failed") <= count // 20
