"""FOTS on the CPU and on CUDA, and surface markers of a pad simulated on either, are the same."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from raytac.device import cuda_missing
from raytac.markers.tracker import MarkerTracker
from raytac.specs import load_sensor
from raytac.specs.press import ObjectSpec, PressScene, StageSpec

pytestmark = pytest.mark.gpu
ROOT = Path(__file__).parents[2]


@pytest.mark.skipif(bool(cuda_missing()), reason=f"CUDA for Mitsuba: {cuda_missing()}")
def test_fots_on_cuda_equals_the_cpu(tmp_path: Path) -> None:
    result = {}
    for device in ("cpu", "cuda"):
        path = tmp_path / f"{device}.npz"
        command = [sys.executable, "-m", "tests.markers.track_on", device, str(path)]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        with np.load(path) as arrays:
            assert arrays["device"] == device
            result[device] = arrays["displacement"], arrays["displacement_px"]
    (cpu, cpu_px), (cuda, cuda_px) = result["cpu"], result["cuda"]
    assert (np.linalg.norm(cpu[-1], axis=-1).max(axis=-1) > 2e-5).all() and not cpu[:-1, 2].any()
    # float32 sums over some hundred samples, with another exp.
    np.testing.assert_allclose(cuda, cpu, rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(cuda_px, cpu_px, rtol=1e-4, atol=1e-4)


@pytest.mark.skipif(bool(cuda_missing(ray_tracing=False)), reason=f"CUDA: {cuda_missing(ray_tracing=False)}")
def test_surface_markers_of_a_pad_simulated_on_cuda_equal_the_cpu() -> None:
    pytest.importorskip("warp")
    from raytac.physics.soft.pad import SoftPad

    sensor = load_sensor("gelsight_mini_9x11")
    target = ObjectSpec("sphere", {"radius": 4e-3}, (1e-3, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0.1)
    scene = PressScene("ball", target, (StageSpec("indent", depth=0.5e-3), StageSpec("shear", shear=(0.3e-3, 0.0))))
    moved = {}
    for device in ("cpu", "cuda"):
        pad = SoftPad(sensor, scene, pitch=0.2e-3, level="coarse", device=device)
        tracker = MarkerTracker(sensor, "surface", pad.grid)
        frames = [tracker.update(state.surface) for state in pad.run(steps_per_stage=2)]
        moved[device] = np.stack([frame.displacement[0] for frame in frames])
    length = np.linalg.norm(moved["cpu"], axis=-1)
    assert np.isfinite(moved["cuda"]).all() and length[-1].max() > 1e-4
    # Both end Newton's iterations within the solver's tolerance, not at the same place: a hundredth of the largest motion.
    np.testing.assert_allclose(moved["cuda"], moved["cpu"], atol=0.01 * length.max())
