"""A loop of many frames holds its memory flat."""

from __future__ import annotations

import gc
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from raytac.errors import InputError
from raytac.optics.memory import peak_bytes
from tests.optics.conftest import Build
from tests.optics.scenes import ball, grid_of, like_a_mini, surface

STATM = Path("/proc/self/statm")
needs_proc = pytest.mark.skipif(not STATM.exists(), reason="resident memory is read from /proc")


def resident_mb() -> float:
    gc.collect()
    return int(STATM.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def growth_mb(tracer: Build, updates: int, warm_up: int = 40, **options: Any) -> float:
    """Growth of the resident memory over ``updates`` frames of ever new surfaces, after a warm-up."""
    spec = like_a_mini()
    grid = grid_of(spec)
    mode = tracer(spec, **options)
    base = ball(grid)[0]

    def frame(k: int) -> np.ndarray:
        height = grid.rest + (base - grid.rest) * (0.2 + 0.8 * (k % 97) / 97)
        image = mode.render(surface(grid, height)).rgb
        assert image is not None
        return image

    for k in range(warm_up):
        frame(k)
    before = resident_mb()
    images = {frame(k).tobytes() for k in range(warm_up, warm_up + updates)}
    assert len(images) >= min(updates, 97)  # the frames did differ
    return resident_mb() - before - sum(map(len, images)) / 1e6


@needs_proc
def test_300_fast_updates_hold_memory_flat(tracer: Build) -> None:
    assert growth_mb(tracer, 300, outputs=("rgb", "layers", "normals", "depth")) < 20


@needs_proc
def test_30_reference_updates_hold_memory_flat(tracer: Build) -> None:
    assert growth_mb(tracer, 30, warm_up=10, integrator="reference", spp=1, resolution=(32, 24)) < 20


@needs_proc
@pytest.mark.slow
@pytest.mark.parametrize(
    "options", [{}, {"integrator": "reference", "spp": 1, "resolution": (32, 24)}], ids=["fast", "reference"]
)
def test_2000_updates_hold_memory_flat(tracer: Build, options: dict) -> None:
    assert growth_mb(tracer, 2000, **options) < 20


@pytest.mark.parametrize("layers", ["colour", "led"])
@pytest.mark.parametrize("outputs", [("rgb",), ("rgb", "layers", "normals", "depth")])
def test_memory_of_an_environment_is_what_is_stated(tracer: Build, layers: str, outputs: tuple[str, ...]) -> None:
    """The peak of Dr.Jit's own arrays stays below what is stated, and that is no wild guess."""
    spec = like_a_mini()
    grid = grid_of(spec)
    mode = tracer(spec, layers=layers, outputs=outputs)
    height, contact = ball(grid)
    for envs in (1, 3, 5):  # the allocator's powers of two suit some batches better than others
        batch = surface(grid, *[height] * envs, contact=contact)
        mode.render(batch)
        peak = peak_bytes(lambda batch=batch: mode.render(batch), "cpu")
        assert 0.3 * envs * mode.memory_per_env(grid) < peak <= envs * mode.memory_per_env(grid)


def test_a_batch_that_does_not_fit_is_refused(tracer: Build, monkeypatch: pytest.MonkeyPatch) -> None:
    spec = like_a_mini()
    grid = grid_of(spec)
    mode = tracer(spec)
    monkeypatch.setattr(mode, "_memory", 5 * mode.memory_per_env(grid) // 2)
    assert mode.largest_batch(grid) == 2
    mode.render(surface(grid, grid.rest, grid.rest))
    with pytest.raises(InputError, match="must be at most 2: an environment takes"):
        mode.render(surface(grid, grid.rest, grid.rest, grid.rest))
