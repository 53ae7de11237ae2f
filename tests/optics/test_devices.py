"""CPU and CUDA give one image, each rendered in a process of its own."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.optics.images import errors

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, np.ndarray]]:
    folder = tmp_path_factory.mktemp("devices")
    found = {}
    for device in ("cpu", "cuda"):
        command = [sys.executable, "-m", "tests.optics.render_on", device, str(folder / f"{device}.npz")]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        with np.load(folder / f"{device}.npz") as arrays:
            found[device] = {name: arrays[name] for name in arrays.files}
    return found


@pytest.mark.gpu
@pytest.mark.parametrize("mode", ["fast", "fast_fine"])
def test_fast_is_the_same_within_one_level(both: dict[str, dict[str, np.ndarray]], mode: str) -> None:
    cpu, cuda = both["cpu"], both["cuda"]
    assert np.abs(cpu[f"{mode}/rgb"].astype(int) - cuda[f"{mode}/rgb"]).max() <= 1
    for layer in ("red", "green", "blue"):
        assert errors(cuda[f"{mode}/{layer}"], cpu[f"{mode}/{layer}"])[0] < 1e-3
    np.testing.assert_allclose(cuda[f"{mode}/normals"], cpu[f"{mode}/normals"], atol=1e-4)
    np.testing.assert_allclose(cuda[f"{mode}/depth"], cpu[f"{mode}/depth"], atol=1e-7)


@pytest.mark.gpu
def test_reference_is_the_same_image(both: dict[str, dict[str, np.ndarray]]) -> None:
    """The same random numbers; a path whose shadow ray grazes an edge may go either way, so few pixels may differ."""
    cpu, cuda = (both[device]["reference/rgb"].astype(int) for device in ("cpu", "cuda"))
    assert (np.abs(cpu - cuda) > 1).mean() < 0.01
    assert abs(cpu.mean() - cuda.mean()) < 0.05
