"""Images of a crop: the pixels of the whole image, to the last bit, and only they are rendered."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from raytac.errors import InputError
from raytac.frame import IMAGES
from raytac.gel.surface import GelSurface
from raytac.optics import Mlp, Phong, RayTraced, Taxim
from raytac.optics.base import OpticsImages
from raytac.optics.crop import Cropped, CutMode
from raytac.optics.image.base import grown
from raytac.optics.trace import interreflection
from raytac.optics.trace.interreflection import BounceField
from tests.optics.scenes import RESOLUTION, ball, grid_of, like_a_mini
from tests.optics.test_mlp import network
from tests.optics.test_taxim_mode import make_table

SPEC = like_a_mini()
GRID = grid_of(SPEC)
WIDTH, HEIGHT = RESOLUTION
CROPS = {
    "inside": (WIDTH // 4, HEIGHT // 3, WIDTH // 2, HEIGHT // 3),
    "corner": (0, 0, 1, 1),
    "other corner": (WIDTH - 1, HEIGHT - 2, 1, 2),
    "rows": (0, 1, WIDTH, 2),
}


def pressed() -> GelSurface:
    height, contact = ball(GRID)
    heights = np.stack([height, GRID.rest.astype(np.float32), 0.5 * (height + GRID.rest.astype(np.float32))])
    contact = np.stack([contact, np.zeros_like(contact), contact])
    return GelSurface(GRID, heights.astype(np.float32), contact, np.full((3, 2), np.nan))


def modes() -> dict[str, tuple[Any, bool]]:
    """Configuration, and whether a piece is rendered alone."""
    displaced, shown = (make_table(SPEC, slopes_of=of) for of in ("displacement", "height"))
    return {
        "table": (Taxim(calibration=displaced, shadows=False), True),
        "table of heights": (Taxim(calibration=shown, shadows=False), True),
        "table with shadows": (Taxim(calibration=displaced, shadows=True), False),
        "network": (Mlp(weights=network()), True),
        "phong": (Phong(), False),
        "raytrace": (RayTraced(bounce=False, spp=4), True),
        "path": (RayTraced(integrator="path", spp=2), False),
    }


def images_of(mode: Any, shown: GelSurface) -> OpticsImages:
    return mode.render(shown)


@pytest.mark.parametrize("name", list(modes()))
def test_a_crop_is_a_piece_of_the_whole_image(name: str) -> None:
    config, alone = modes()[name]
    shown = pressed()
    options: dict[str, Any] = {"resolution": RESOLUTION, "outputs": ("rgb", "normals", "depth"), "device": "cpu"}
    whole = images_of(config.build(SPEC, **options), shown)
    some = CROPS if name in ("table", "table of heights") else {"inside": CROPS["inside"], "corner": CROPS["corner"]}
    for left, top, width, height in some.values():
        mode = Cropped(config, (left, top, width, height)).build(SPEC, **options)
        assert isinstance(mode, CutMode) is not alone
        images = images_of(mode, shown)
        for field in IMAGES:
            expected, found = getattr(whole, field), getattr(images, field)
            if field == "uncovered":  # a share of the pixels that are rendered
                continue
            assert (expected is None) == (found is None)
            if expected is not None:
                np.testing.assert_array_equal(found, expected[:, top : top + height, left : left + width], err_msg=field)
        if config.sampled:  # with noise of its own in every image
            continue
        again = images_of(mode, shown.rows([2]))
        assert again.rgb is not None and images.rgb is not None
        np.testing.assert_array_equal(again.rgb[0], images.rgb[2])


def test_fewer_rays_are_traced() -> None:
    config = RayTraced(bounce=False)
    crop = CROPS["inside"]
    mode = config.build(SPEC, resolution=RESOLUTION, device="cpu")
    assert mode.crop(crop)
    mode.prepare(GRID)
    frame = mode.render_device(mode._upload(GRID.rest[None]))
    assert np.array(frame.rgb).size == 3 * crop[2] * crop[3]


def test_slopes_have_their_neighbours_whatever_the_crop() -> None:
    for left in range(5):
        for width in range(1, 6 - left):
            x, y, wide, high = grown((left, left, width, width), (5, 5))
            for k in range(left, left + width):
                inner = min(max(k, 1), 3)
                assert x <= min(inner - 1, k) and max(inner + 1, k) < x + wide
                assert y <= min(inner - 1, k) and max(inner + 1, k) < y + high


@pytest.mark.parametrize("crop", [(-1, 0, 2, 2), (0, 0, WIDTH + 1, 1), (0, HEIGHT, 1, 1), (0, 0, 0, 1)])
def test_a_crop_beyond_the_image_is_refused(crop: tuple[int, int, int, int]) -> None:
    with pytest.raises(InputError, match="crop"):
        Cropped(Phong(), crop).build(SPEC, resolution=RESOLUTION, device="cpu")


def test_a_mode_of_ones_own_is_cut() -> None:
    class Grey:
        label, device = "grey", "cpu"

        def render(self, surface: GelSurface) -> OpticsImages:
            rows = np.arange(HEIGHT * WIDTH * 3).reshape(HEIGHT, WIDTH, 3) % 251
            return OpticsImages(rgb=np.repeat(rows[None].astype(np.uint8), surface.batch, axis=0))

    mode = CutMode(Grey(), (3, 2, 5, 4))
    image = mode.render(pressed()).rgb
    assert image is not None and mode.label == "grey"
    np.testing.assert_array_equal(image[1], Grey().render(pressed()).rgb[1, 2:6, 3:8])  # type: ignore[index]


def test_cropped_is_what_it_crops() -> None:
    config = RayTraced(integrator="reference", spp=4)
    cropped = Cropped(config, CROPS["inside"])
    assert (cropped.label, cropped.outputs) == (config.label, config.outputs)
    assert (cropped.sampled, cropped.unbiased) == (config.sampled, config.unbiased)


def test_indirect_light_is_that_of_all_patches_and_channels(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is gathered where the camera sees the coat, for the colours that its LEDs have."""
    shown, options = pressed(), {"resolution": RESOLUTION, "outputs": ("rgb", "layers"), "device": "cpu"}
    config = Cropped(RayTraced(), CROPS["inside"])
    seen = config.build(SPEC, **options)
    some = seen.render(shown)
    bounce = seen._arrays.bounce  # type: ignore[attr-defined]
    assert bounce.view[2] * bounce.view[3] < 0.8 * bounce.patches.nx * bounce.patches.ny

    def everything(cls: type, mi: Any, layout: Any, case: Any, camera: Any, thickness: float, lit: Any) -> Any:
        return build(mi, layout, case, camera, thickness, range(9))

    build = BounceField.build
    monkeypatch.setattr(interreflection, "nodes_in_view", lambda g, *_: (0, 0, g.nx, g.ny))
    monkeypatch.setattr(BounceField, "build", classmethod(everything))
    every = config.build(SPEC, **options).render(shown)
    assert some.rgb is not None and some.layers is not None and every.layers is not None
    np.testing.assert_array_equal(some.rgb, every.rgb)
    for name, layer in every.layers.items():
        np.testing.assert_allclose(some.layers[name], layer, rtol=1e-5, atol=1e-9)
    direct = Cropped(RayTraced(bounce=False), CROPS["inside"]).build(SPEC, **options).render(shown)
    assert (direct.rgb != some.rgb).mean() > 0.5
