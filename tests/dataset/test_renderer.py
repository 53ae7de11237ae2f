"""What a shard holds: presses as the sensor sees them alone, whatever the batch and the order; failures with their reason."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from raytac.dataset import ARRAYS, DatasetPlan, RenderJob, ShardRenderer
from raytac.dataset.arrays import SHARED
from raytac.io.arrays import npz_bytes
from raytac.sensor import TactileSensor
from raytac.specs import PressRanges, StageSpec, SweepSpec


@pytest.fixture(scope="module")
def renderer(sweep: SweepSpec) -> ShardRenderer:
    return ShardRenderer(RenderJob(DatasetPlan(sweep), "cpu", batch=3))


def test_arrays_are_those_that_the_plan_tells(renderer: ShardRenderer) -> None:
    plan, result = renderer.plan, renderer.render(2)
    sensor = plan.sensor(2)
    kept = plan.array_shapes(sensor) | plan.array_shapes(sensor, plan.shared)
    assert set(result.arrays) == set(kept)
    for name, values in result.arrays.items():
        shape = kept[name] if name in SHARED else (2, *kept[name])
        assert values.shape == shape and values.dtype == {**ARRAYS, **SHARED}[name].dtype, name
    size = len(npz_bytes(result.arrays))
    assert plan.shard_bytes(2) < size < plan.shard_bytes(2) + 8000
    assert [row["status"] for row in result.rows] == ["ok", "ok"]


def test_a_shard_is_the_same_after_any_other_and_nearly_so_with_any_batch(renderer: ShardRenderer) -> None:
    first = renderer.render(0)
    renderer.render(1)
    assert npz_bytes(renderer.render(0).arrays) == npz_bytes(first.arrays)
    other = ShardRenderer(replace(renderer.job, batch=4)).render(0)
    assert other.rows == first.rows
    for name, values in first.arrays.items():
        # Sums in another order: one step of 8 bits at most, and rounding.
        np.testing.assert_allclose(other.arrays[name], values, rtol=1e-5, atol=1 if name == "rgb" else 1e-6, err_msg=name)


def test_a_press_is_what_the_sensor_alone_gives(sweep: SweepSpec) -> None:
    plan = DatasetPlan(replace(sweep, randomization={}, marker_perturbation={}))
    result = ShardRenderer(RenderJob(plan, "cpu", batch=4)).render(0)
    presses = plan.presses(0)
    sensor = TactileSensor(
        sweep.sensors[0],
        physics="rigid",
        optics="phong",
        outputs=("rgb", "height", "wrench"),
        markers="fots",
        resolution=sweep.resolution,
        pitch=sweep.pitch,
        device="cpu",
    )
    for row in (0, 3):
        scene = sweep.objects[presses.scene[row]]
        turn, own = presses.rotations[row], scene.object.quaternion
        w, v = turn[0], turn[1:]
        turned = (w * own[0] - v @ own[1:], *(w * np.array(own[1:]) + own[0] * v + np.cross(v, own[1:])))
        target = replace(scene.object, position=(presses.x[row], presses.y[row], 0.0), quaternion=tuple(float(q) for q in turned))
        stages = (
            StageSpec("indent", depth=float(presses.press_depth[row])),
            StageSpec("shear", shear=(float(presses.shear_x[row]), float(presses.shear_y[row]))),
        )
        alone = sensor.press(replace(scene, object=target, trajectory=stages))
        assert alone.rgb is not None and alone.height is not None and alone.wrench is not None and alone.markers is not None
        assert np.abs(result.arrays["rgb"][row].astype(int) - alone.rgb[0]).max() <= 1
        np.testing.assert_allclose(result.arrays["height"][row], alone.height[0], atol=1e-8)
        np.testing.assert_allclose(result.arrays["wrench"][row], alone.wrench[0], rtol=1e-4, atol=1e-6)
        np.testing.assert_allclose(result.arrays["markers"][row], alone.markers.displacement[0], atol=1e-7)
        figures = result.rows[row]
        assert figures["force_z"] == pytest.approx(alone.wrench[0, 2], rel=1e-4) and figures["object"] == scene.name
        assert figures["indentation_max"] == pytest.approx(alone.surface.indentation[0].max(), rel=1e-4)
        assert np.abs(result.arrays["rgb"][row].astype(int) - result.arrays["rest_rgb"]).max() > 10


def test_presses_that_cannot_be_are_told_with_their_reason_and_stop_no_other(sweep: SweepSpec) -> None:
    ranges = PressRanges(depth=(0.3e-3, 0.6e-3), x=(8e-3, 12.5e-3), shear=(6e-3, 6e-3))
    plan = DatasetPlan(replace(sweep, ranges=ranges, count=8, shard_size=8, objects=sweep.objects[:1]))
    result = ShardRenderer(RenderJob(plan, "cpu", batch=4)).render(0)
    status = [row["status"] for row in result.rows]
    presses, size = plan.presses(0), plan.sensor(0).gelpad.size
    # A ball that is sheared off touches the pad's edge with its side; far enough out nothing is above the pad any more.
    radius = sweep.objects[0].object.params["radius"]
    assert isinstance(radius, float)
    off = presses.x + presses.shear_x > 0.5 * size[0] + radius
    assert "failed" in status and "ok" in status and [s == "failed" for s in status] == off.tolist()
    reasons = [str(row["reason"]) for row in result.rows if row["status"] == "failed"]
    assert all("no part of the object" in reason and "/" not in reason for reason in reasons)
    np.testing.assert_array_equal(result.arrays["index"], np.flatnonzero(np.array(status) == "ok"))
    assert all(row.get("force_z") is None for row in result.rows if row["status"] == "failed")
    forces = [row["force_z"] for row in result.rows if row["status"] == "ok"]
    assert all(isinstance(force, float) and math.isfinite(force) for force in forces)


def test_noise_and_camera_are_of_the_press(sweep: SweepSpec) -> None:
    same = PressRanges(depth=(0.5e-3, 0.5e-3))
    plan = DatasetPlan(replace(sweep, ranges=same, count=4, objects=sweep.objects[:1], randomization={"exposure": 0.3}))
    result = ShardRenderer(RenderJob(plan, "cpu", batch=4)).render(0)
    levels = result.arrays["rgb"].reshape(4, -1).mean(axis=1)
    assert np.ptp(levels) > 5.0 and len(np.unique(levels)) == 4
    assert np.ptp(result.arrays["wrench"][:, 2]) == 0.0
    rest = result.arrays["markers_rest"]
    assert all(not np.array_equal(rest[0], rest[b]) for b in range(1, 4))  # shifted patterns
    lost = ~result.arrays["marker_visible"]
    assert lost.any() and np.isnan(result.arrays["markers"][lost]).all() and np.isfinite(result.arrays["markers"][~lost]).all()
