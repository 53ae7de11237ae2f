"""Open Image Denoise on sampled layers: nearer to the converged image, and still light that adds up."""

from __future__ import annotations

import importlib.util
import sys

import numpy as np
import pytest

from raytac.device import cuda_missing
from raytac.errors import BackendError, InputError
from raytac.gel.surface import GelSurface
from raytac.optics import RayTraced
from raytac.optics.trace.fast_tracer import total
from raytac.optics.trace.sampled_tracer import make_denoiser
from tests.optics.conftest import Build
from tests.optics.images import errors
from tests.optics.scenes import RESOLUTION, ball, grid_of, like_a_mini, surface

needs_oidn = pytest.mark.skipif(
    importlib.util.find_spec("mitsuba_oidn") is None, reason="mitsuba-oidn is not installed (pip install raytac[denoise])"
)


@pytest.fixture(scope="module")
def pressed() -> GelSurface:
    grid = grid_of(like_a_mini())
    height, contact = ball(grid)
    return surface(grid, height, contact=contact)


@pytest.fixture(scope="module")
def converged(tracer: Build, pressed: GelSurface) -> dict[str, np.ndarray]:
    mode = tracer(like_a_mini(), integrator="reference")
    return mode.render_layers(pressed, spp=384, seed=0)


@needs_oidn
@pytest.mark.parametrize("spp", [4, 16])
def test_denoising_lowers_the_error(spp: int, tracer: Build, pressed: GelSurface, converged: dict[str, np.ndarray]) -> None:
    """Of the image and of each layer: what the filter blurs must be less than the noise that it takes away."""
    plain = tracer(like_a_mini(), integrator="reference")
    mode = tracer(like_a_mini(), integrator="reference", denoise=True, outputs=("rgb", "layers"))
    noisy, images = plain.render_layers(pressed, spp=spp, seed=5), mode.render(pressed, spp=spp, seed=5)
    clean = images.layers
    assert clean is not None and mode.label == "raytrace-reference-denoised"

    def rmse(layers: dict[str, np.ndarray]) -> float:
        return float(np.sqrt(np.mean((total(layers) - total(converged)) ** 2)))

    assert rmse(clean) < 0.7 * rmse(noisy)
    for name, layer in clean.items():
        assert layer.shape == (1, RESOLUTION[1], RESOLUTION[0], 3) and layer.dtype == np.float32
        assert np.isfinite(layer).all() and layer.min() >= 0.0
        assert np.mean((layer - converged[name]) ** 2) < np.mean((noisy[name] - converged[name]) ** 2)


@needs_oidn
def test_denoised_layers_sum_to_the_image(tracer: Build, pressed: GelSurface) -> None:
    """Each layer is filtered alone, so their sum must be near the filtered sum, and is what the camera turns into the image."""
    mode = tracer(like_a_mini(), integrator="reference", denoise=True, outputs=("rgb", "layers"))
    images = mode.render(pressed, spp=16, seed=5)
    assert images.layers is not None and images.rgb is not None
    assert np.abs(mode.response.encode_numpy(total(images.layers)).astype(int) - images.rgb).max() <= 1
    plain = tracer(like_a_mini(), integrator="reference")
    noisy_sum = total(plain.render_layers(pressed, spp=16, seed=5))
    of_sum = make_denoiser(mode.mi, "cpu", RESOLUTION)(noisy_sum[0])
    assert errors(total(images.layers)[0], of_sum)[0] < 0.02
    assert abs(total(images.layers).mean() / noisy_sum.mean() - 1.0) < 0.01  # it moves light, it makes none


def test_fast_has_nothing_to_denoise() -> None:
    with pytest.raises(InputError, match="the fast integrator has no noise"):
        RayTraced(denoise=True).build(like_a_mini(), resolution=RESOLUTION, device="cpu")


def test_without_the_package_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba_oidn", None)
    with pytest.raises(BackendError, match=r"pip install raytac\[denoise\]"):
        RayTraced(integrator="reference", denoise=True).build(like_a_mini(), resolution=RESOLUTION, device="cpu")


@pytest.mark.skipif(not cuda_missing(), reason="OptiX may work here")
def test_optix_that_does_not_work_is_an_error_and_no_abort() -> None:
    with pytest.raises(BackendError, match=r"OptiX's denoiser does not work here: .+nvoptix\.bin"):
        make_denoiser(None, "cuda", (32, 32))
