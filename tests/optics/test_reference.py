"""The path tracer is unbiased: its error is noise that falls as 1/√spp, and Mitsuba's own ``path`` converges to the same image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from raytac.gel.surface import GelSurface
from raytac.optics import RayTraced
from raytac.optics.trace import reference
from raytac.optics.trace.fast_tracer import total
from raytac.specs.sensor import SensorSpec
from tests.optics.conftest import Build
from tests.optics.scenes import ball, grid_of, like_a_mini, surface

TINY = (32, 24)


@pytest.fixture(scope="module")
def spec() -> SensorSpec:
    return like_a_mini()


@pytest.fixture(scope="module")
def pressed(spec: SensorSpec) -> GelSurface:
    grid = grid_of(spec)
    return surface(grid, ball(grid)[0])


def layers(
    tracer: Build,
    spec: SensorSpec,
    pressed: GelSurface,
    spp: int,
    seed: int = 0,
    integrator: str = "reference",
    max_depth: int = -1,
) -> np.ndarray:
    """(G, H, W, 3) in double precision, from one scene for all numbers of samples and seeds."""
    mode = tracer(spec, integrator=integrator, resolution=TINY, max_depth=max_depth)
    return np.stack([layer[0] for layer in mode.render_layers(pressed, spp=spp, seed=seed).values()]).astype(float)


def image(tracer: Build, spec: SensorSpec, pressed: GelSurface, spp: int, seed: int = 0, max_depth: int = -1) -> np.ndarray:
    return layers(tracer, spec, pressed, spp, seed, max_depth=max_depth).sum(axis=0)


def noise(a: np.ndarray, b: np.ndarray) -> float:
    """Standard deviation of either of two independent images."""
    return float(np.sqrt(np.mean((a - b) ** 2) / 2))


def test_error_falls_as_one_over_root_spp(tracer: Build, spec: SensorSpec, pressed: GelSurface) -> None:
    counts = [4, 8, 16, 32, 64]
    error = [noise(*(image(tracer, spec, pressed, spp, seed) for seed in (0, 1))) for spp in counts]
    slope = np.polyfit(np.log(counts), np.log(error), 1)[0]
    assert -0.6 < slope < -0.4, f"slope {slope:.3f} of {error}"
    # And against an image with many more samples, so that the error is not only self-consistent.
    best = image(tracer, spec, pressed, 512, seed=2)
    against = [float(np.sqrt(np.mean((image(tracer, spec, pressed, spp) - best) ** 2))) for spp in (4, 64)]
    # The best image's own noise is a third of that at 64 samples, which makes 4 a little less.
    assert 3.2 < against[0] / against[1] < 4.4, against


def test_one_launch_or_many_is_one_estimate(
    tracer: Build, spec: SensorSpec, pressed: GelSurface, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = [image(tracer, spec, pressed, 32, seed) for seed in (0, 1)]
    monkeypatch.setattr(reference, "LAUNCH", 8 * TINY[0] * TINY[1])
    split = [image(tracer, spec, pressed, 32, seed) for seed in (0, 1)]
    assert (whole[0] != split[0]).any()
    sigma = noise(*whole)
    # Launches that shared random numbers would have the noise of fewer samples.
    assert noise(*split) == pytest.approx(sigma, rel=0.15)
    assert noise(whole[0], split[0]) == pytest.approx(sigma, rel=0.15)
    assert abs(np.mean(whole) - np.mean(split)) < 5 * sigma / np.sqrt(whole[0].size)


def test_seeds_reproduce_and_differ(tracer: Build, spec: SensorSpec, pressed: GelSurface) -> None:
    first = image(tracer, spec, pressed, 16)
    # Mitsuba rebuilds mesh and tree for every surface with several threads, which may move the last bit of a few pixels.
    np.testing.assert_allclose(image(tracer, spec, pressed, 16), first, rtol=1e-6)
    built_anew = RayTraced(integrator="reference", spp=16).build(spec, resolution=TINY, device="cpu")
    np.testing.assert_allclose(total(built_anew.render_layers(pressed))[0], first, rtol=1e-5)
    other, third = (image(tracer, spec, pressed, 16, seed) for seed in (1, 2))
    assert (other != first).mean() > 0.99
    # Neighbouring seeds light the environments of a batch: their noise must have nothing in common.
    best = image(tracer, spec, pressed, 512, seed=2)
    rho = np.corrcoef((first - best)[..., 1].ravel(), (other - best)[..., 1].ravel())[0, 1]
    assert abs(rho) < 5 / np.sqrt(TINY[0] * TINY[1]), rho
    assert noise(first, third) > 0


def test_mitsuba_path_converges_to_the_same_image(tracer: Build, spec: SensorSpec, pressed: GelSurface) -> None:
    ours, theirs = (
        np.stack([layers(tracer, spec, pressed, 256, seed, integrator) for seed in (0, 1)])
        for integrator in ("reference", "path")
    )
    for name, k in zip(("red", "green", "blue"), range(3), strict=True):
        a, b = ours[:, k], theirs[:, k]
        mean = a.mean()
        # Blocks of 8 × 8 pixels average the noise; what would be left is a difference between the two.
        blocks_a, blocks_b = (v.reshape(2, 3, 8, 4, 8, 3).mean(axis=(2, 4)) for v in (a, b))
        sigma = np.hypot(noise(*blocks_a), noise(*blocks_b)) / np.sqrt(2)
        worst = np.abs(blocks_a.mean(0) - blocks_b.mean(0)).max()
        assert worst < 6 * sigma + 1e-4 * mean, f"{name}: {worst / mean:.3%} with a noise of {sigma / mean:.3%}"
        assert b.mean() == pytest.approx(mean, rel=5e-3), name


def test_more_reflections_only_add_light(tracer: Build, spec: SensorSpec, pressed: GelSurface) -> None:
    means = {depth: image(tracer, spec, pressed, 64, max_depth=depth).mean() for depth in (1, 2, 3, -1)}
    assert means[1] < means[2] < means[3] < means[-1] * 1.001, means
    # Each further reflection loses at least the darker of coat and wall.
    assert means[3] - means[2] < 0.6 * (means[2] - means[1]), means


def test_a_pinhole_behind_the_floor_sees_through_it(tracer: Build, spec: SensorSpec, pressed: GelSurface) -> None:
    """As with a floor that lies behind the pinhole, but for light by way of the floor."""
    camera, floor = replace(spec.camera, position=(0.0, 0.0, -40e-3)), replace(spec.case, reflectance=0.0)
    images = [
        image(tracer, replace(spec, camera=camera, case=replace(floor, floor_z=z)), pressed, 16) for z in (-28.5e-3, -41e-3)
    ]
    assert images[1].mean() > 0
    np.testing.assert_allclose(images[0], images[1], atol=1e-3 * images[1].max())


@pytest.mark.parametrize("dotted", [False, True])
def test_a_surface_that_is_shown_is_not_built_again(
    dotted: bool, spec: SensorSpec, pressed: GelSurface, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor for further samples; another surface, or other ink, is."""
    dots = replace(spec.markers, rows=2, columns=2) if dotted else replace(spec.markers, rows=0, columns=0)
    tracer = RayTraced(integrator="reference", spp=1).build(replace(spec, markers=dots), resolution=TINY, device="cpu")
    tracer.render_layers(GelSurface.at_rest(pressed.grid))
    assert tracer.scene is not None
    built: list[str] = []
    params, update = tracer.scene.params, tracer.scene.params.update

    def counted() -> None:
        built.extend(sorted(key for _, keys in update() for key in keys if key.startswith("vertex")))

    monkeypatch.setattr(params, "update", counted)
    tracer.render_layers(GelSurface.at_rest(pressed.grid))
    assert not built
    for _ in range(2):
        tracer.render_layers(pressed, spp=2)
        assert built == ["vertex_positions"]
    tracer.render_layers(GelSurface.at_rest(pressed.grid))
    assert built == ["vertex_positions"] * 2
    if dotted:
        for _ in range(2):
            tracer.scene.set_surface(pressed.grid.rest, np.full(pressed.grid.shape, 0.5, np.float32))
        assert built == ["vertex_positions"] * 2 + ["vertex_albedo"]
