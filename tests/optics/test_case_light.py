"""The fit of the case's light: the same each time it is made, and made once for sensors of one kind."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from raytac.optics import RayTraced
from raytac.optics.runtime import load_mitsuba
from raytac.optics.trace import interreflection
from raytac.optics.trace.interreflection import CaseLight
from raytac.optics.trace.led import Lamp
from raytac.optics.trace.scene import SensorScene
from raytac.specs import with_lights
from tests.optics.scenes import built, grid_of, like_a_mini


def test_a_fit_is_the_same_each_time_and_another_with_another_seed() -> None:
    mi, _ = load_mitsuba("cpu")
    spec = like_a_mini()
    scene = SensorScene(mi, spec, grid_of(spec))
    lamps = [Lamp.from_spec(mi, led) for led in spec.lights.leds]
    groups = [0, 1, 1, 2]
    one, same, other = (CaseLight.fit(scene, lamps, groups, seed, 1 << 12).coefficients for seed in (0, 0, 1))
    assert one.any()
    np.testing.assert_allclose(same, one, rtol=1e-5, atol=1e-5 * np.abs(one).max())
    assert np.abs(other - one).max() > 1e-3 * np.abs(one).max()


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[Any]:
    """Fits that a process with an empty cache makes."""
    made: list[Any] = []
    fit: Any = CaseLight.fit
    monkeypatch.setenv("RAYTAC_CACHE", str(tmp_path))
    monkeypatch.setattr(interreflection, "_fits", {})
    monkeypatch.setattr(interreflection, "SAMPLES", 1 << 10)
    monkeypatch.setattr(CaseLight, "fit", staticmethod(lambda *args: made.append(args) or fit(*args)))
    return made


def test_the_next_process_reads_the_fit(made: list[Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    mi, _ = load_mitsuba("cpu")
    spec = like_a_mini()
    lamps = [Lamp.from_spec(mi, led) for led in spec.lights.leds]

    def light() -> CaseLight:
        monkeypatch.setattr(interreflection, "_fits", {})
        return CaseLight.of(mi, spec, grid_of(spec), lamps, [0, 1, 1, 2], 0)

    first, again = light(), light()
    assert len(made) == 1 and first.coefficients.any() and first.half == again.half
    np.testing.assert_array_equal(again.coefficients, first.coefficients)
    monkeypatch.setattr(interreflection, "code_digest", lambda *_: "of other code")
    light()
    monkeypatch.setattr(interreflection, "SAMPLES", 1 << 11)
    light()
    assert len(made) == 3 == len(list((tmp_path / "case_light").iterdir()))
    for kept in (tmp_path / "case_light").iterdir():
        kept.write_bytes(b"damaged")
    with pytest.warns(RuntimeWarning, match="made again"):
        light()
    assert len(made) == 4


def test_sensors_of_one_kind_share_a_fit_and_others_do_not(
    made: list[Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Of all that light in the case depends on; the camera and its response are not among it."""
    monkeypatch.setattr(interreflection, "_MOST_FITS", 3)
    spec = like_a_mini()

    def fits(sensor: object, pitch: float = 0.25e-3, **options: object) -> int:
        """Fits that a tracer of a sensor makes."""
        before = len(made)
        built(RayTraced, sensor, **options).prepare(grid_of(spec, pitch))  # type: ignore[arg-type]
        return len(made) - before

    assert fits(spec) == 1 and fits(spec) == 0
    seen_otherwise = replace(spec, name="other", response=replace(spec.response, gamma=1.7))
    assert fits(seen_otherwise, resolution=(32, 24)) == 0
    darker = replace(spec, coat=replace(spec.coat, reflectance=(0.4, 0.5, 0.5)))
    led = replace(spec.lights.leds[0], power=(1e-5, 0.0, 0.0))
    relit = with_lights(spec, replace(spec.lights, leds=(led, *spec.lights.leds[1:])))
    assert [fits(darker), fits(relit), fits(spec, seed=1), fits(spec, layers="led"), fits(spec, pitch=0.5e-3)] == [1] * 5
    shutil.rmtree(tmp_path / "case_light")
    assert len(interreflection._fits) == 3 and fits(spec, pitch=0.5e-3) == 0 and fits(spec) == 1, "the oldest go first"
