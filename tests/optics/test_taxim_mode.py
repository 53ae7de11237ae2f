"""The table mode as a whole: from a gel surface through the camera to the image, its batch, its refusals."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import pytest

from raytac.errors import InputError
from raytac.gel.surface import GelSurface, PadGrid
from raytac.optics import OPTICS, Phong, Taxim
from raytac.optics.taxim.folder import save_calibration
from raytac.optics.taxim.mode import resized
from raytac.optics.taxim.table import PolyTable, ShadowTable
from raytac.sensor import TactileSensor
from raytac.specs.sensor import SensorSpec
from tests.optics.conftest import Build
from tests.optics.scenes import RESOLUTION, at_rest, ball, built, grid_of, like_a_mini, relief, surface

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def spec() -> SensorSpec:
    return like_a_mini()


@pytest.fixture(scope="module")
def grid(spec: SensorSpec) -> PadGrid:
    return grid_of(spec)


def make_table(spec: SensorSpec, *, slopes_of: str = "displacement", shadow: bool = True) -> PolyTable:
    """Random and smooth: colours turn with the slope's direction and grow with its magnitude; bins steeper than 45° are not covered."""
    rng = np.random.default_rng(3)
    n = 32
    gradients = np.zeros((3, n, n, 6))
    gradients[..., 5] = np.linspace(0, 90, n)[:, None] * np.sin(np.linspace(0, 2 * np.pi, n) + np.arange(3)[:, None, None])
    gradients[..., 3:5] = rng.normal(scale=0.02, size=(3, n, n, 2))
    covered = np.broadcast_to(np.arange(n)[:, None] < n // 2, (n, n)).copy()
    width, height = RESOLUTION
    camera = spec.camera
    pitch = tuple(p * m / k for p, m, k in zip(camera.pixel_pitch, camera.resolution, RESOLUTION, strict=True))
    lists = np.full((3, 63, 12), 10, np.int32)
    values = np.full((3, 63, 12, 10), -30, np.float32)
    cast = ShadowTable(np.arange(0, 2 * np.pi, 0.1), values, lists, first_depth=0.0, depth_offset=0)
    background = rng.integers(60, 180, (height, width, 3)).astype(np.float32)
    return PolyTable(gradients, covered, background, (pitch[0], pitch[1]), cast if shadow else None, slopes_of=slopes_of)


def pressed(grid: PadGrid) -> GelSurface:
    height, contact = ball(grid)
    return surface(grid, height, contact=contact)


@pytest.mark.parametrize("shadow", [False, True])
def test_at_rest_it_is_the_background_also_on_a_dome(spec: SensorSpec, grid: PadGrid, shadow: bool) -> None:
    table = make_table(spec)
    if shadow:  # the last blur reaches the background too (upstream); a flat one shows what else may change
        table = replace(table, background=np.full_like(table.background, 100))
    mode = Taxim(calibration=table, shadows=shadow).build(spec, resolution=RESOLUTION, device="cpu")
    assert np.abs(grid.rest).max() > 1e-4
    images = mode.render(at_rest(grid))
    assert images.rgb is not None
    np.testing.assert_array_equal(images.rgb[0], table.background.astype(np.uint8))
    assert images.uncovered is not None and np.isnan(images.uncovered).all()


def test_upstreams_tables_shade_the_dome_itself(spec: SensorSpec, grid: PadGrid) -> None:
    table = make_table(spec, slopes_of="height", shadow=False)
    image = Taxim(calibration=table).build(spec, resolution=RESOLUTION, device="cpu").render(at_rest(grid)).rgb
    assert image is not None and np.abs(image[0].astype(float) - table.background).max() > 2


@pytest.mark.parametrize("shadow", [False, True])
def test_a_batch_is_its_single_images(spec: SensorSpec, grid: PadGrid, shadow: bool) -> None:
    mode = Taxim(calibration=make_table(spec), shadows=shadow).build(spec, resolution=RESOLUTION, device="cpu")
    height, contact = ball(grid)
    moved, touched = ball(grid, depth=0.4e-3, centre=(-2e-3, 1e-3))
    heights = np.stack([height, grid.rest, relief(grid), moved, height]).astype(np.float32)
    contacts = np.stack([contact, np.zeros_like(contact), grid.rest - relief(grid) > 0.3e-3, touched, contact])
    both = GelSurface(grid, heights, contacts, np.zeros((5, 2)))
    batch = mode.render(both).rgb
    assert batch is not None and np.abs(np.diff(batch.astype(int), axis=0)).max() > 20
    for b in range(5):
        one = mode.render(GelSurface(grid, heights[b : b + 1], contacts[b : b + 1], np.zeros((1, 2)))).rgb
        assert one is not None
        np.testing.assert_array_equal(batch[b], one[0])
    np.testing.assert_array_equal(batch[0], batch[4])


def test_pixels_see_the_height_that_the_ray_tracer_sees(tracer: Build, spec: SensorSpec, grid: PadGrid) -> None:
    mode = Taxim(calibration=make_table(spec)).build(spec, resolution=RESOLUTION, device="cpu")
    seen, moved = mode.image_heights(pressed(grid))
    depth = tracer(spec, outputs=("depth",)).render(pressed(grid)).depth
    assert depth is not None
    error = -seen * mode.pitch[0] - (depth + spec.camera.position[2])
    assert np.abs(error).max() < 2e-6 and np.abs(seen).max() * mode.pitch[0] > 0.7e-3
    assert 0.7e-3 < moved.max() * mode.pitch[0] < 0.85e-3


def test_normals_and_depth_are_those_of_the_ray_tracer(tracer: Build, spec: SensorSpec, grid: PadGrid) -> None:
    outputs = ("rgb", "normals", "depth")
    images = (
        Taxim(calibration=make_table(spec))
        .build(spec, resolution=RESOLUTION, outputs=outputs, device="cpu")
        .render(pressed(grid))
    )
    traced = tracer(spec, outputs=("normals", "depth")).render(pressed(grid))
    for name in ("normals", "depth", "position", "contact"):
        np.testing.assert_array_equal(getattr(images, name), getattr(traced, name))
    assert images.rgb is not None and images.layers is None


def test_uncovered_bins_are_told(spec: SensorSpec, grid: PadGrid) -> None:
    table = make_table(spec)
    surfaces = surface(grid, ball(grid)[0], grid.rest, contact=ball(grid)[1])
    share = Taxim(calibration=table).build(spec, resolution=RESOLUTION, device="cpu").render(surfaces).uncovered
    assert share is not None and share.tolist() == [0.0, 0.0]  # no slope of this ball is 45°
    flat_only = replace(table, covered=np.arange(32)[:, None] + np.zeros((32, 32)) < 1)
    share = Taxim(calibration=flat_only).build(spec, resolution=RESOLUTION, device="cpu").render(surfaces).uncovered
    assert share is not None and 0.8 < share[0] < 1 and share[1] == 0
    unknown = replace(table, covered=None)
    assert Taxim(calibration=unknown).build(spec, resolution=RESOLUTION, device="cpu").render(surfaces).uncovered is None


def test_touched_pixels_and_those_around_have_sheets_of_their_own(spec: SensorSpec, grid: PadGrid) -> None:
    """Where the ball touches it shows the first sheet's table, elsewhere the second's; the two seen apart tell which pixel is which."""
    one = make_table(spec, shadow=False)
    other = replace(one, gradients=-0.5 * one.gradients)
    both = replace(one, surround=other.gradients)
    first, second, found = (
        Taxim(calibration=table).build(spec, resolution=RESOLUTION, device="cpu").render_levels(pressed(grid))[0]
        for table in (one, other, both)
    )
    apart = np.abs(first - second).max(axis=-1) > 1
    inside = apart & (np.abs(found - first).max(axis=-1) < 1e-3)
    around = apart & (np.abs(found - second).max(axis=-1) < 1e-3)
    assert (inside | around)[apart].all() and inside.sum() > 100 and around.sum() > 100
    row, column = np.nonzero(inside)
    reach = np.hypot(row - row.mean(), column - column.mean())
    again_row, again_column = np.nonzero(around)
    assert np.quantile(reach, 0.98) < np.quantile(np.hypot(again_row - row.mean(), again_column - column.mean()), 0.02) + 2
    for name in ("surround", "one_sheet"):
        with pytest.raises(InputError, match=f"{name}.*gradients' shape"):
            replace(both, **{name: one.gradients[:, :4, :4]})
    with pytest.raises(InputError, match="one_sheet"):
        replace(one, one_sheet=other.gradients)


def test_a_failed_environment_is_black_and_alone(spec: SensorSpec, grid: PadGrid) -> None:
    surfaces = surface(grid, ball(grid)[0], np.full(grid.shape, np.nan), contact=ball(grid)[1])
    mode = Taxim(calibration=make_table(spec)).build(spec, resolution=RESOLUTION, device="cpu")
    images = mode.render(surfaces)
    assert images.rgb is not None and images.uncovered is not None
    assert (images.rgb[1] == 0).all() and np.isnan(images.uncovered[1]) and np.isfinite(images.uncovered[0])
    alone = mode.render(pressed(grid)).rgb
    assert alone is not None
    np.testing.assert_array_equal(images.rgb[0], alone[0])


def test_twice_the_pixels_show_the_same_press(spec: SensorSpec, grid: PadGrid) -> None:
    """A table's polynomials, shadows and widths keep their size on the pad."""
    table = replace(make_table(spec), background=np.full((60, 80, 3), 100, np.float32))
    fine = Taxim(calibration=table).build(spec, resolution=(160, 120), device="cpu").render_levels(pressed(grid))[0]
    coarse = Taxim(calibration=table).build(spec, resolution=RESOLUTION, device="cpu").render_levels(pressed(grid))[0]
    averaged = fine.reshape(60, 2, 80, 2, 3).mean(axis=(1, 3))
    assert np.abs(coarse - 100).max() > 20
    assert np.abs(averaged - coarse).mean() < 0.03 * np.abs(coarse - 100).max()


def test_resized_keeps_the_mean_and_the_image_of_its_own_size() -> None:
    image = np.random.default_rng(0).uniform(0, 255, (60, 80, 3)).astype(np.float32)
    assert resized(image, (80, 60)) is image
    assert abs(resized(image, (40, 30)).mean() - image.mean()) < 1


def test_what_it_cannot_do_is_refused(spec: SensorSpec, grid: PadGrid) -> None:
    table = make_table(spec, shadow=False)
    common: dict[str, Any] = {"resolution": RESOLUTION, "device": "cpu"}
    with pytest.raises(InputError, match=r"layers.*choose from: rgb, normals, depth"):
        built(Taxim, spec, calibration=table, outputs=("rgb", "layers"), **common)
    with pytest.raises(InputError, match="has no shadows"):
        built(Taxim, spec, calibration=table, shadows=True, **common)
    with pytest.raises(InputError, match="aspect ratio of the table's image, 80x60"):
        Taxim(calibration=table).build(spec, resolution=(80, 70), device="cpu")
    with pytest.raises(InputError, match="PolyTable, a calibration folder or None"):
        built(Taxim, spec, calibration=3, **common)  # type: ignore[arg-type]
    mode = built(Taxim, spec, calibration=table, **common)
    with pytest.raises(InputError, match="call prepare"):
        mode.render_device(mode.mi.Float(0))
    mode.render(at_rest(grid))
    with pytest.raises(InputError, match="whole number of grids"):
        mode.render_device(mode.mi.Float([0, 1, 2]))
    nodes = dr.zeros(mode.mi.Float, grid.rest.size)
    with pytest.raises(InputError, match="contact"):
        mode.render_device(nodes, mode.mi.UInt8(0))
    with pytest.raises(InputError, match="ink = 3: must have one value a node"):
        mode.render_device(nodes, dr.zeros(mode.mi.UInt8, grid.rest.size), mode.mi.Float([0, 1, 0]))


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
@pytest.mark.parametrize("kind", ["table", "shadow", "phong"])
def test_memory_of_an_environment_is_what_is_stated(spec: SensorSpec, grid: PadGrid, kind: str, device: str) -> None:
    """The peak of Dr.Jit's own arrays stays below what is stated, and that is no wild guess."""
    from raytac.optics.runtime import peak_bytes

    size = (160, 120)
    mode = (
        Phong(background=np.zeros((120, 160, 3), np.uint8)).build(spec, resolution=size, device=device)
        if kind == "phong"
        else Taxim(calibration=make_table(spec), shadows=kind == "shadow").build(spec, resolution=size, device=device)
    )
    height, contact = ball(grid)
    for envs, inked in ((1, False), (3, False), (7, False), (7, True)):  # powers of two suit some batches better than others
        batch = surface(grid, *[height] * envs, contact=contact)
        batch = replace(batch, ink=np.full(batch.height.shape, 0.3, np.float32)) if inked else batch
        mode.render(batch)
        peak = peak_bytes(lambda batch=batch: mode.render(batch), device)
        assert 0.4 * envs * mode.memory_per_env(grid) < peak <= envs * mode.memory_per_env(grid)


def test_a_batch_that_does_not_fit_is_refused(spec: SensorSpec, grid: PadGrid, monkeypatch: pytest.MonkeyPatch) -> None:
    mode = Taxim(calibration=make_table(spec)).build(spec, resolution=RESOLUTION, device="cpu")
    assert mode.memory_per_env(grid) > 4 * (grid.rest.size + 80 * 60 * 5)
    monkeypatch.setattr(mode, "_memory", 5 * mode.memory_per_env(grid) // 2)
    assert mode.largest_batch(grid) == 2
    mode.render(surface(grid, grid.rest, grid.rest))
    with pytest.raises(InputError, match="must be at most 2: an environment takes"):
        mode.render(surface(grid, grid.rest, grid.rest, grid.rest))


def test_the_sensor_takes_a_calibration_folder(tmp_path: Path) -> None:
    sensor = TactileSensor("gelsight_mini", outputs=("height",))
    table = make_table(sensor.spec)
    save_calibration(table, tmp_path / "calibration")
    sensor = TactileSensor("gelsight_mini", optics=Taxim(tmp_path / "calibration"), resolution=RESOLUTION, device="cpu")
    frame = sensor.press("sphere")
    assert frame.rgb is not None and frame.uncovered is not None and sensor.label == "rigid+taxim-shadow"
    assert np.abs(frame.rgb[0].astype(int) - sensor.rest().rgb[0]).max() > 10  # type: ignore[index]
    np.testing.assert_allclose(sensor.optical_mode.view_ratio, 1)  # type: ignore[attr-defined]
    with pytest.raises(InputError, match=r"spp = 4: is no option of optics='taxim'.*choose from: calibration, shadows"):
        OPTICS.config("taxim", spp=4)
    with pytest.raises(InputError, match="layers"):
        TactileSensor("gelsight_mini", optics="phong", outputs=("layers",))


@pytest.mark.gpu
@pytest.mark.parametrize("mode", ["taxim", "taxim-shadow", "phong"])
def test_cuda_gives_the_images_of_the_cpu(mode: str, tmp_path: Path) -> None:
    """float32 may put a slope on the edge of two bins into either; all other pixels agree within one level."""
    images = []
    for device in ("cpu", "cuda"):
        command = [sys.executable, "-m", "tests.optics.render_cheap_on", device, mode, str(tmp_path / f"{device}.npy")]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        images.append(np.load(tmp_path / f"{device}.npy").astype(int))
    difference = np.abs(images[0] - images[1]).max(axis=-1)
    assert (difference > 1).mean() < 0.002 and difference.mean() < 0.02
