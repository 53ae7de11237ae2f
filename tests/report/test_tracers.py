"""Ray tracers are built once; the regions of an image are where they should be."""

from __future__ import annotations

import numpy as np
import pytest

from raytac.optics import RayTraced
from raytac.report.press import press_peaks
from raytac.report.tracers import Tracers

SIZE = (80, 60)


@pytest.fixture(scope="module")
def pressed():
    spec, surfaces = press_peaks("gelsight_mini", ("sphere", "coin"), SIZE)
    return Tracers(spec, "cpu", 0), surfaces


def test_a_tracer_is_built_once_for_its_options(pressed) -> None:
    tracers, _ = pressed
    one = tracers.get(SIZE, RayTraced(bounce=False))
    assert tracers.get(SIZE, RayTraced(bounce=False)) is one and tracers.get(SIZE) is not one
    assert tracers.get(SIZE, RayTraced("path")).layer_names == ("all",) != one.layer_names


@pytest.mark.parametrize(("scene", "largest_share"), [("sphere", 0.3), ("coin", 0.7)])  # a relief's valleys belong to its ring
def test_the_shadow_ring_holds_what_shadows_take(pressed, scene: str, largest_share: float) -> None:
    tracers, surfaces = pressed
    masks = tracers.regions(SIZE, surfaces[scene])

    def light(shadows: bool) -> np.ndarray:
        layers = tracers.get(SIZE, RayTraced(bounce=False, shadows=shadows), ("layers",)).render_layers(surfaces[scene])
        return np.sum(list(layers.values()), axis=(0, 1, 4))

    taken = (light(False) - light(True)) * ~masks["contact"]
    assert taken.sum() > 0 and taken[masks["ring"]].sum() > 0.97 * taken.sum()
    assert masks["ring"].mean() < largest_share


def test_contact_lies_where_the_surface_says(pressed) -> None:
    tracers, surfaces = pressed
    surface = surfaces["sphere"]
    contact = tracers.contact(SIZE, surface)
    pitch = tracers.spec.camera.pixel_pitch[0] * tracers.spec.camera.resolution[0] / SIZE[0]
    area = surface.contact[0].sum() * surface.grid.pitch[0] * surface.grid.pitch[1]
    assert contact.sum() * pitch**2 == pytest.approx(area, rel=0.15)  # nearer than the gel plane, so a little larger
