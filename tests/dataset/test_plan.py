"""Presses are drawn one by one: the same whatever the count, the shards, or what else is drawn; and bad sweeps are told at once."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from raytac.dataset import DatasetPlan
from raytac.dataset.arrays import ARRAYS
from raytac.errors import InputError, SpecError
from raytac.specs import HeightMap, MarkerMotionSpec, PressRanges, ResponseSpec, SweepSpec, load_press, load_sensor


def test_a_press_does_not_depend_on_count_shards_or_other_ranges(sweep: SweepSpec) -> None:
    plan = DatasetPlan(sweep)
    other = DatasetPlan(replace(sweep, count=1000, shard_size=7, ranges=replace(sweep.ranges, twist=(0.1, 0.2))))
    for i in (0, 5, 9):
        one, same = plan.draw(np.array([i])), other.draw(np.array([i]))
        for name in (f.name for f in fields(one) if f.name != "twist"):
            np.testing.assert_array_equal(getattr(one, name), getattr(same, name), name)
        assert one.twist[0] == 0.0 and 0.1 <= same.twist[0] <= 0.2
    assert not np.array_equal(plan.draw(np.arange(9)).x, DatasetPlan(replace(sweep, seed=6)).draw(np.arange(9)).x)


def test_shards_hold_every_press_once(sweep: SweepSpec) -> None:
    plan = DatasetPlan(replace(sweep, count=10, shard_size=4))
    assert plan.shards == 3
    np.testing.assert_array_equal(np.concatenate([plan.presses(s).index for s in range(3)]), np.arange(10))
    with pytest.raises(InputError, match="shard = 3"):
        plan.presses(3)


def test_draws_are_uniform_in_their_ranges(sweep: SweepSpec) -> None:
    ranges, presses = sweep.ranges, DatasetPlan(sweep).draw(np.arange(2000))
    drawn = {
        "depth": presses.press_depth,
        "x": presses.x,
        "y": presses.y,
        "yaw": presses.yaw,
        "tilt": presses.tilt,
        "shear": np.hypot(presses.shear_x, presses.shear_y),
    }
    for name, values in drawn.items():
        low, high = getattr(ranges, name)
        share = np.sort((values - low) / (high - low))
        assert share[0] >= -1e-9 and share[-1] <= 1.0 + 1e-9
        assert np.abs(share - np.linspace(0.0, 1.0, 2000)).max() < 0.04  # Kolmogorov-Smirnov: 0.036 at 1 %
    assert 900 < presses.scene.sum() < 1100
    angles = np.stack([presses.tilt_direction, np.arctan2(presses.shear_y, presses.shear_x) % (2 * math.pi)])
    assert np.abs(np.exp(1j * angles).mean(axis=1)).max() < 0.07
    assert abs(np.exp(1j * (angles[0] - angles[1])).mean()) < 0.07  # neither tells the other
    assert len(np.unique(presses.seed)) == 2000


def test_the_object_turns_by_yaw_and_then_leans_towards_its_direction(sweep: SweepSpec) -> None:
    presses = DatasetPlan(sweep).draw(np.arange(20))
    w, x, y, z = presses.rotations.T
    found = Rotation.from_quat(np.stack([x, y, z, w], axis=1)).as_matrix()
    top = np.array([np.cos(presses.tilt_direction), np.sin(presses.tilt_direction)]).T * np.sin(presses.tilt)[:, None]
    np.testing.assert_allclose(found[:, :2, 2], top, atol=1e-12)
    axis = np.stack([-np.sin(presses.tilt_direction), np.cos(presses.tilt_direction), np.zeros(20)], axis=1)
    lean = Rotation.from_rotvec(axis * presses.tilt[:, None])
    np.testing.assert_allclose(
        found, (lean * Rotation.from_rotvec(presses.yaw[:, None] * np.array([0.0, 0.0, 1.0]))).as_matrix(), atol=1e-12
    )


def test_sensors_and_their_drawn_copies_take_turns(sweep: SweepSpec) -> None:
    two = (load_sensor("gelsight_mini"), load_sensor("gelsight_mini_9x11"))
    plan = DatasetPlan(
        replace(sweep, sensors=two, variants=2, count=40, markers=None, marker_perturbation={}, randomization={"led_power": 0.2})
    )
    assert [plan.variant(s) for s in range(5)] == [(0, 0), (1, 0), (0, 1), (1, 1), (0, 0)]
    powers = [plan.sensor(s).lights.leds[0].power for s in range(4)]
    assert plan.sensor(4) == plan.sensor(0) and powers[0] == powers[1] != powers[2] == powers[3]


def test_the_digest_tells_plans_apart_and_names_no_path(sweep: SweepSpec, tmp_path: Path) -> None:
    plan = DatasetPlan(sweep)
    assert DatasetPlan(replace(sweep, source=tmp_path / "x.toml", name="other")).digest == plan.digest
    changed: list[dict[str, Any]] = [
        {"seed": 6},
        {"count": 11},
        {"resolution": (48, 36)},
        {"outputs": ("rgb",)},
        {"ranges": replace(sweep.ranges, x=(0.0, 1e-3))},
        {"objects": sweep.objects[:1]},
        {"sensors": (load_sensor("gelsight_mini_12x16"),), "marker_perturbation": {}},
        {"marker_perturbation": {}},
    ]
    digests = {DatasetPlan(replace(sweep, **change)).digest for change in changed}
    assert len(digests) == len(changed) and plan.digest not in digests
    mesh = DatasetPlan(replace(sweep, objects=(load_press("mesh"),)))
    assert "/" not in json.dumps(mesh.description) and "gear.stl" in json.dumps(mesh.description)


def test_data_sets_of_earlier_versions_go_on(sweep: SweepSpec) -> None:
    """Digests of sensors as data sets keep them, from raytac before responses had a ``colour_mix``.

    The R1.5 was never fitted; if its file is changed all the same, its data sets are others, and so is its digest.
    """
    shipped = load_sensor("gelsight_r15")
    motion = MarkerMotionSpec(1e7, 2e5, 3e5, 1e-4, 4e5, 0.1, 0.5, 0.8, 0.6, "none", None, Path("a.toml"))
    full = replace(
        shipped,
        name="full",
        gelpad=replace(shipped.gelpad, surface=HeightMap(1e-4 * np.eye(6, 7, 3), (5e-3, 7e-3))),
        camera=replace(shipped.camera, distortion=(0.01, 0.0, 0.0, 0.0)),
        response=replace(shipped.response, shading_red=(0.1,), shading_blue=(0.1, 0.2, 0.3)),
        lights=replace(shipped.lights, leds=shipped.lights.leds[:1]),
        noise=replace(shipped.noise, dark_variance=(1.0, 2.0, 3.0)),
        marker_motion=motion,
    )
    digests = {
        "gelsight_r15": "eded16f866041395c1de674717de8cb3918f568989a7eccfbe9c827036143df5",
        "full": "e99d845a29e39451cdcbf052ffa0636b367bf8ee344d237f0f27c2824a0cfa94",
    }
    plain = replace(sweep, outputs=("height",), markers=None, resolution=(24, 32), randomization={}, marker_perturbation={})
    assert DatasetPlan(replace(plain, sensors=(shipped, full))).description["sensors"] == digests


def test_a_new_optional_field_of_a_sensor_tells_data_sets_apart_only_where_it_is_used(sweep: SweepSpec) -> None:
    @dataclass(frozen=True)
    class Later(ResponseSpec):
        bloom: float = 0.0

    Later.__name__ = Later.__qualname__ = "ResponseSpec"
    sensor = sweep.sensors[0]
    later = Later(**vars(sensor.response))
    mixed = replace(sensor.response, colour_mix=(0.1, 0.0, 0.0, 0.0, 0.0, 0.0))
    same, bloom, mix = (
        DatasetPlan(replace(sweep, sensors=(replace(sensor, response=response),))).digest
        for response in (later, replace(later, bloom=0.1), mixed)
    )
    assert same == DatasetPlan(sweep).digest and len({same, bloom, mix}) == 3


def test_shapes_and_bytes_are_those_of_the_arrays(sweep: SweepSpec) -> None:
    plan = DatasetPlan(sweep)
    sensor = sweep.sensors[0]
    shapes = plan.array_shapes(sensor)
    assert shapes["rgb"] == (24, 32, 3) and shapes["markers"] == (99, 2) and "traction" not in shapes
    assert set(plan.array_shapes(sensor, plan.shared)) == {"grid_x", "grid_y", "rest_height", "rest_rgb"}
    bare = DatasetPlan(replace(sweep, outputs=("wrench",), randomization={}))
    assert set(bare.array_shapes(sensor, bare.shared)) == {"grid_x", "grid_y", "rest_height"}
    assert plan.shard_bytes(2) - plan.press_bytes(sensor) * 2 == plan.shard_bytes(0) - plan.press_bytes(sensor) * 4
    assert all(array.meaning for array in ARRAYS.values())


def test_a_video_has_its_frames_first_in_what_changes(sweep: SweepSpec) -> None:
    plan, video = DatasetPlan(sweep), DatasetPlan(replace(sweep, frames_per_stage=5))
    assert (plan.frames, video.frames) == (1, 11)  # an indent and a shear
    sensor = sweep.sensors[0]
    still, moving = plan.array_shapes(sensor), video.array_shapes(sensor)
    for name in ("rgb", "height", "contact", "wrench", "markers", "markers_px", "marker_visible", "pad_from_object"):
        assert moving[name] == (11, *still[name])
    for name in ("index", "markers_rest", "markers_rest_px"):
        assert moving[name] == still[name]
    assert set(moving) - set(still) == {"travel"} and moving["travel"] == (11,)
    assert video.array_shapes(sensor, video.shared) == plan.array_shapes(sensor, plan.shared)
    assert video.press_bytes(sensor) > 10 * plan.press_bytes(sensor)
    assert "frames_per_stage" not in plan.description and video.description["frames_per_stage"] == 5
    for name in ("x", "seed", "press_depth", "shear_x"):
        np.testing.assert_array_equal(getattr(plan.presses(0), name), getattr(video.presses(0), name))


def test_the_size_of_the_whole_is_the_sum_of_its_shards(sweep: SweepSpec) -> None:
    light = replace(sweep, outputs=("rgb",), markers=None, randomization={"led_power": 0.1}, marker_perturbation={}, variants=2)
    for count in (1, 4, 10, 33):
        first = sweep.sensors[0]
        small = replace(first, name="small", gelpad=replace(first.gelpad, size=(22e-3, 18e-3)))
        plan = DatasetPlan(replace(light, sensors=(first, load_sensor("gelsight_mini"), small), count=count))
        assert plan.total_bytes() == sum(plan.shard_bytes(shard) for shard in range(plan.shards))
        without = set(range(0, plan.shards, 2))
        assert plan.total_bytes(without) == sum(plan.shard_bytes(shard) for shard in range(plan.shards) if shard not in without)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"count": 0}, "count = 0"),
        ({"count": 10**9 + 1}, "count = 1000000001"),
        ({"count": 2.5}, "count = 2.5"),
        ({"shard_size": 0}, "shard_size = 0"),
        ({"seed": -1}, "seed = -1"),
        ({"outputs": ("rgb", "layers")}, r"outputs = 'layers'.*rgb, normals"),
        ({"markers": None}, "randomization.markers"),
        ({"outputs": ("height",)}, "outputs must have 'rgb'"),
        ({"variants": 3}, "variants = 3"),
        ({"randomization": {"exposure": 1.5}}, "exposure = 1.5"),
        ({"marker_perturbation": {"shift": 1e-3}}, "shift.*outside the view"),
        ({"optics": "taxm"}, "optics = 'taxm'.*taxim"),
        ({"markers": "surface"}, "rigid"),
        ({"ranges": PressRanges(depth=(1e-3, 4.5e-3))}, r"press\.depth_mm.*less deep than the pad"),
        ({"ranges": PressRanges(depth=(1e-4, 1e-3), y=(-20e-3, 0.0))}, r"press\.y_mm.*\[-20"),
        ({"objects": (load_press("soft_ball"),)}, "soft object"),
    ],
)
def test_bad_sweeps_are_refused_before_anything_is_rendered(change: dict[str, Any], message: str, sweep: SweepSpec) -> None:
    with pytest.raises((InputError, SpecError), match=message):
        DatasetPlan(replace(sweep, **change))
