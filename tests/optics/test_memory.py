"""A loop of many frames holds its memory flat."""

from __future__ import annotations

import gc
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from raytac.errors import InputError
from raytac.optics.runtime import peak_bytes
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
def test_12_reference_updates_hold_memory_flat(tracer: Build) -> None:
    assert growth_mb(tracer, 12, warm_up=4, integrator="reference", spp=1, resolution=(32, 24)) < 8


@needs_proc
@pytest.mark.slow
@pytest.mark.parametrize(
    "options", [{}, {"integrator": "reference", "spp": 1, "resolution": (32, 24)}], ids=["fast", "reference"]
)
def test_2000_updates_hold_memory_flat(tracer: Build, options: dict) -> None:
    assert growth_mb(tracer, 2000, **options) < 20


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
@pytest.mark.parametrize("layers", ["colour", "led"])
@pytest.mark.parametrize("outputs", [("rgb",), ("rgb", "layers", "normals", "depth"), ("depth",)], ids=["rgb", "all", "depth"])
def test_memory_of_an_environment_is_what_is_stated(tracer: Build, layers: str, outputs: tuple[str, ...], device: str) -> None:
    """The peak of Dr.Jit's own arrays stays below what is stated, which is twice what arrays take that are no power of two."""
    spec = like_a_mini()
    grid = grid_of(spec)
    mode = tracer(spec, layers=layers, outputs=outputs, device=device)
    stated = mode.memory_per_env(grid)
    height, contact = ball(grid)
    shares = []
    for envs, inked in ((1, False), (3, False), (5, False), (3, True)):  # powers of two suit some batches better than others
        batch = surface(grid, *[height] * envs, contact=contact)
        batch = replace(batch, ink=np.full(batch.height.shape, 0.3, np.float32)) if inked else batch
        mode.render(batch)
        shares.append(peak_bytes(lambda batch=batch: mode.render(batch), device) / (envs * stated))
    assert min(shares) > 0.5 and max(shares) <= 1, shares


def test_a_batch_that_does_not_fit_is_refused(tracer: Build, monkeypatch: pytest.MonkeyPatch) -> None:
    """On the device as from NumPy."""
    spec = like_a_mini()
    grid = grid_of(spec)
    mode = tracer(spec)
    monkeypatch.setattr(mode, "_memory", 5 * mode.memory_per_env(grid) // 2)
    assert mode.largest_batch(grid) == 2
    mode.render(surface(grid, grid.rest, grid.rest))
    with pytest.raises(InputError, match="must be at most 2: an environment takes"):
        mode.render(surface(grid, grid.rest, grid.rest, grid.rest))
    nodes, arrays = grid.rest.size, mode.mi.Float
    with pytest.raises(InputError, match="must be at most 2: an environment takes"):
        mode.render_device(arrays(np.zeros(3 * nodes, np.float32)))
    both = arrays(np.zeros(2 * nodes, np.float32))
    assert len(mode.render_device(both).rgb) == 2 * 3 * mode.camera.resolution[0] * mode.camera.resolution[1]
    with pytest.raises(InputError, match=f"ink.*{nodes}.*one value a node, {2 * nodes} here"):
        mode.render_device(both, ink=arrays(np.zeros(nodes, np.float32)))
    with pytest.raises(InputError, match="whole number of grids"):
        mode.render_device(arrays(np.zeros(nodes + 1, np.float32)))
    with pytest.raises(InputError, match=r"integrator.*fast"):
        tracer(spec, integrator="reference", spp=1).render_device(both)
