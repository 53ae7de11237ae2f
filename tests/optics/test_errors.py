"""Wrong input to the ray tracer: the message names value, rule and choices, and comes before any rendering."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from raytac.errors import BackendError, InputError
from raytac.gel.surface import GelSurface
from raytac.optics import RayTraced
from raytac.optics.runtime import load_mitsuba
from tests.optics.conftest import Build
from tests.optics.scenes import RESOLUTION, at_rest, ball, built, grid_of, led, like_a_mini, sensor, surface


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"integrator": "fats"}, r"integrator = 'fats'.*did you mean 'fast'.*fast, reference, path"),
        ({"layers": "color"}, r"layers = 'color'.*did you mean 'colour'.*colour, led"),
        ({"outputs": ("rgb", "normal")}, r"outputs = 'normal'.*did you mean 'normals'.*rgb, layers, normals, depth"),
        ({"spp": 3}, r"spp = 3.*square.*1, 4, 9, 16"),
        ({"led_points": 0}, r"led_points = 0.*>= 1"),
        ({"spp": 0, "integrator": "reference"}, r"spp = 0.*>= 1"),
        ({"max_depth": 0}, r"max_depth = 0.*>= 1, or -1"),
        ({"seed": -1}, r"seed = -1.*2\^32"),
        ({"seed": "x"}, r"seed = 'x'.*2\^32"),
        ({"spp": "x"}, r"spp = 'x'.*>= 1"),
        ({"led_points": float("nan")}, r"led_points = nan.*>= 1"),
        ({"max_depth": "x"}, r"max_depth = 'x'.*>= 1, or -1"),
        ({"layers": []}, r"layers = .*colour, led"),
        ({"resolution": (0, 60)}, r"resolution = \(0, 60\).*>= 1 pixel"),
        ({"denoise": True}, r"denoise = True.*no noise"),
        ({"device": "gpu"}, r"device = 'gpu'.*auto, cpu, cuda"),
        (
            {"flat_field": np.zeros((61, 80, 3), np.uint8)},
            r"flat_field = 'uint8 \(61, 80, 3\)'.*uint8 image of shape \(60, 80, 3\)",
        ),
        (
            {"flat_field": np.zeros((60, 80, 4))},
            r"flat_field = 'float64 \(60, 80, 4\)'.*uint8.*or levels in \[0, 255\] as floats",
        ),
        ({"flat_field": np.full((60, 80, 3), 255.5)}, r"flat_field = '255\.5 to 255\.5'.*levels in \[0, 255\]"),
        ({"flat_field": np.full((60, 80, 3), np.nan)}, r"flat_field = 'nan to nan'.*levels in \[0, 255\]"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_wrong_options_are_refused_at_once(options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        built(RayTraced, like_a_mini(), **{"resolution": RESOLUTION, "device": "cpu", **options})


def test_a_second_grid_is_refused(tracer: Build) -> None:
    spec = sensor([led("one", (0.0, -11e-3, -9e-3))])
    mode = tracer(spec, bounce=False)
    mode.render(at_rest(grid_of(spec)))
    mode.render(at_rest(grid_of(spec)))  # an equal grid is the same grid
    with pytest.raises(InputError, match=r"surface\.grid = \(53, 64\).*one grid.*\(84, 102\)"):
        mode.render(at_rest(grid_of(spec, 0.4e-3)))


@pytest.mark.parametrize("axis", ["x", "y"])
def test_a_camera_that_sees_past_the_pad_is_refused(axis: str) -> None:
    spec = sensor([led("one", (0.0, -11e-3, -9e-3))])
    x, y, z = spec.camera.position
    position = (x + 4e-3, y, z) if axis == "x" else (x, y - 4e-3, z)
    mode = RayTraced(bounce=False).build(
        replace(spec, camera=replace(spec.camera, position=position)), resolution=RESOLUTION, device="cpu"
    )
    with pytest.raises(InputError, match=rf"grid\.{axis} = .*the camera sees {axis} from -?\d+\.\d+ to -?\d+\.\d+ mm"):
        mode.render(at_rest(grid_of(spec)))


def test_a_process_has_one_variant(monkeypatch: pytest.MonkeyPatch) -> None:
    load_mitsuba("cpu")
    monkeypatch.setattr("raytac.optics.runtime.resolve_device", lambda device: "cuda")
    with pytest.raises(BackendError, match=r"already renders with llvm_ad_rgb.*one device per process"):
        load_mitsuba("cuda")


def test_without_llvm_the_error_says_how_to_mend_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("raytac.optics.runtime.llvm_library", lambda: None)
    with pytest.raises(BackendError, match=r"pip install karellen-llvm-core.*DRJIT_LIBLLVM_PATH.*raytac doctor"):
        load_mitsuba("cpu")


def test_an_llvm_that_was_loaded_before_and_is_too_old_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """It aborts the process in the first kernel."""
    monkeypatch.setattr("raytac.optics.runtime.LLVM_NAMED_BY_USER", False)
    monkeypatch.setattr("drjit.detail.llvm_version", lambda: (15, 0, 6))
    with pytest.raises(BackendError, match=r"libLLVM 15\.0\.6.*imported before raytac: import raytac\.optics first"):
        load_mitsuba("cpu")


def test_another_rest_surface_is_refused(tracer: Build) -> None:
    spec = sensor([led("one", (0.0, -11e-3, -9e-3))])
    mode = tracer(spec, bounce=False)
    grid = grid_of(spec)
    mode.render(at_rest(grid))
    with pytest.raises(InputError, match=r"surface\.grid.*rest surface"):
        mode.render(at_rest(replace(grid, rest=grid.rest - 1e-4)))


@pytest.mark.parametrize(
    "shape", [(0, 84, 102), (84, 102), (1, 82, 102)], ids=["no environment", "no batch axis", "rows missing"]
)
def test_surfaces_of_another_shape_are_refused(tracer: Build, shape: tuple[int, ...]) -> None:
    spec = sensor([led("one", (0.0, -11e-3, -9e-3))])
    grid = grid_of(spec)
    with pytest.raises(InputError, match=r"surface\.height = .*(of shape \(\d+, 84, 102\)|at least one environment)"):
        wrong = GelSurface(grid, np.zeros(shape, np.float32), np.zeros(shape, bool), np.zeros((shape[0], 2)))
        tracer(spec, bounce=False).render(wrong)


def test_device_heights_must_fill_whole_grids(tracer: Build) -> None:
    spec = sensor([led("one", (0.0, -11e-3, -9e-3))])
    mode = tracer(spec, bounce=False)
    mode.render(at_rest(grid_of(spec)))
    with pytest.raises(InputError, match="whole number of grids of 8568 nodes"):
        mode.render_device(mode.mi.Float(np.zeros(8569, np.float32)))
    with pytest.raises(InputError, match="call prepare"):
        RayTraced().build(spec, resolution=RESOLUTION, device="cpu").render_device(mode.mi.Float(0.0))


@pytest.mark.parametrize("integrator", ["fast", "reference"])
def test_an_environment_that_failed_leaves_the_others_running(tracer: Build, integrator: str) -> None:
    spec = sensor([led("one", (0.0, -11e-3, -9e-3))])
    grid = grid_of(spec)
    press, _ = ball(grid)
    broken = press.copy()
    broken[3, 4] = np.nan
    options: dict[str, Any] = {"bounce": False, "outputs": ("rgb", "layers", "depth")}
    if integrator == "reference":
        options = {"integrator": integrator, "spp": 1, "outputs": ("rgb", "layers", "depth")}
    mode = tracer(spec, **options)
    alone = mode.render(surface(grid, press))
    together = mode.render(surface(grid, press, broken))
    assert together.rgb is not None and together.depth is not None and together.layers is not None and alone.rgb is not None
    assert np.abs(together.rgb[0].astype(int) - alone.rgb[0]).max() <= 1 and alone.rgb.any()
    assert not together.rgb[1].any() and np.isnan(together.depth[1]).all() and np.isfinite(together.depth[0]).all()
    assert all(np.isnan(layer[1]).all() for layer in together.layers.values())


def test_geometry_alone_traces_no_light() -> None:
    mode = RayTraced(integrator="reference", spp=10**6).build(
        like_a_mini(), resolution=RESOLUTION, device="cpu", outputs=("depth",)
    )
    grid = grid_of(like_a_mini())
    images = mode.render(at_rest(grid))
    assert images.rgb is None and images.depth is not None
    assert mode.scene is None, "a Mitsuba scene was built though no output needs light"


def test_a_variant_that_the_user_set_first_works() -> None:
    import subprocess
    import sys

    code = (
        "import raytac.optics, mitsuba as mi; mi.set_variant('llvm_ad_rgb');"
        "from raytac.optics.runtime import load_mitsuba; load_mitsuba('cpu');"
        "mi.load_dict({'type': 'rectangle', 'emitter': {'type': 'raytac_led', 'radiance': [1, 1, 1], 'lobe': 2.0}})"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert run.returncode == 0, run.stderr[-2000:]
