"""Wrong input to the ray tracer: the message names value, rule and choices, and comes before any rendering."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from raytac.errors import BackendError, InputError
from raytac.optics.raytrace import RayTracer
from raytac.optics.variant import load_mitsuba
from tests.optics.conftest import Build
from tests.optics.scenes import RESOLUTION, at_rest, grid_of, led, like_a_mini, sensor


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"integrator": "fats"}, r"integrator = 'fats'.*did you mean 'fast'.*fast, reference, path"),
        ({"layers": "color"}, r"layers = 'color'.*did you mean 'colour'.*colour, led"),
        ({"outputs": ("rgb", "normal")}, r"outputs = 'normal'.*did you mean 'normals'.*rgb, layers, normals, depth"),
        ({"spp": 3}, r"spp = 3.*square.*1, 4, 9, 16"),
        ({"led_points": 0}, r"led_points = 0.*at least 1"),
        ({"denoise": True}, r"denoise = True.*no noise"),
        ({"device": "gpu"}, r"device = 'gpu'.*auto, cpu, cuda"),
        (
            {"flat_field": np.zeros((61, 80, 3), np.uint8)},
            r"flat_field = 'uint8 \(61, 80, 3\)'.*uint8 image of shape \(60, 80, 3\)",
        ),
        ({"flat_field": np.zeros((60, 80, 3))}, r"flat_field = 'float64 \(60, 80, 3\)'.*uint8"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_wrong_options_are_refused_at_once(options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        RayTracer(like_a_mini(), resolution=RESOLUTION, **{"device": "cpu", **options})


def test_a_second_grid_is_refused(tracer: Build) -> None:
    spec = sensor([led("one", (0.0, -11e-3, -9e-3))])
    mode = tracer(spec, bounce=False)
    mode.render(at_rest(grid_of(spec)))
    mode.render(at_rest(grid_of(spec)))  # an equal grid is the same grid
    with pytest.raises(InputError, match=r"surface\.grid = \(53, 64\).*one grid, \(84, 102\)"):
        mode.render(at_rest(grid_of(spec, 0.4e-3)))


@pytest.mark.parametrize("axis", ["x", "y"])
def test_a_camera_that_sees_past_the_pad_is_refused(axis: str) -> None:
    spec = sensor([led("one", (0.0, -11e-3, -9e-3))])
    x, y, z = spec.camera.position
    position = (x + 4e-3, y, z) if axis == "x" else (x, y - 4e-3, z)
    mode = RayTracer(
        replace(spec, camera=replace(spec.camera, position=position)), resolution=RESOLUTION, device="cpu", bounce=False
    )
    with pytest.raises(InputError, match=rf"grid\.{axis} = .*the camera sees {axis} from -?\d+\.\d+ to -?\d+\.\d+ mm"):
        mode.render(at_rest(grid_of(spec)))


def test_a_process_has_one_variant(monkeypatch: pytest.MonkeyPatch) -> None:
    load_mitsuba("cpu")
    monkeypatch.setattr("raytac.optics.variant.resolve_device", lambda device: "cuda")
    with pytest.raises(BackendError, match=r"already renders with llvm_ad_rgb.*one device per process"):
        load_mitsuba("cuda")


def test_without_llvm_the_error_says_how_to_mend_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("raytac.optics.variant.llvm_library", lambda: None)
    with pytest.raises(BackendError, match=r"pip install karellen-llvm-core.*DRJIT_LIBLLVM_PATH.*raytac doctor"):
        load_mitsuba("cpu")
