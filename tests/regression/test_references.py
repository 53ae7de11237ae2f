"""Images, forces and markers of the shipped sensor are those that were stored: a change of code that should change nothing is seen here.

Twelve images, four optical modes of three presses of the rigid pad, lie beside this file as ``{mode}_{scene}.png``; forces, heights and
markers in ``numbers.npz``. Everything comes from the public ``TactileSensor``, on the CPU.

    python -m tests.regression.test_references --write

replaces the stored files by what the code computes now. That is right only where images or forces are meant to change: the commit then
says why, and its reviewer looks at the images. It is never the way to make a refactoring pass.
"""

from __future__ import annotations

import argparse
import functools
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from raytac import TactileFrame, TactileSensor, load_press, load_sensor
from raytac.io.images import read_png, write_png
from raytac.optics import Mlp, Phong, RayTraced, Taxim
from raytac.optics.image.mlp_weights import INPUTS, MlpWeights
from raytac.optics.taxim.table import PolyTable, ShadowTable
from raytac.physics.soft.contact_width import NarrowContactWarning
from raytac.specs import StageSpec

STORED = Path(__file__).parent
SENSOR = "gelsight_mini"
RESOLUTION = (80, 60)
SCENES = ("sphere", "coin", "pins")
MODES = ("raytrace", "taxim", "phong", "mlp")
CHANGED_SHARE = 0.005
"""Most of an image's values that may differ, and then by one level.

A value midway between two levels may be rounded either way: Dr.Jit's kernels for processors with AVX2 and with AVX-512 may differ in the
last bit.
"""


def background() -> np.ndarray:
    """Image at rest of the table and the network [levels], (H, W, 3): a slope along x, y and both."""
    v, u = np.mgrid[0 : RESOLUTION[1], 0 : RESOLUTION[0]] / np.array(RESOLUTION[::-1])[:, None, None]
    return np.round(np.stack([70 + 60 * u, 130 - 50 * v, 90 + 30 * u * v], axis=-1)).astype(np.float32)


def table() -> PolyTable:
    """Smooth colours that turn with the direction of the slope and grow with it, two sheets, and shadows; from formulas, no file.

    With an even number of bins no direction along x, y or a diagonal lies on the edge of two bins, where the last bit would choose.
    """
    n = 126
    magnitude, direction = np.linspace(0, 1, n)[:, None], np.linspace(-np.pi, np.pi, n)[None, :]
    gradients = np.zeros((3, n, n, 6))
    for channel in range(3):
        turned = np.cos(direction - 2 * np.pi * channel / 3)
        gradients[channel, ..., 5] = 160 * np.sin(np.pi * magnitude) * turned - 40 * magnitude
        gradients[channel, ..., 3] = 0.1 * magnitude * turned
    spec = load_sensor(SENSOR)
    pitch = spec.camera.pitch_at(RESOLUTION)
    steps = np.arange(12, dtype=np.float32)
    values = np.broadcast_to(-25 + 2 * steps, (3, 63, 16, 12)).astype(np.float32)
    shadow = ShadowTable(
        np.arange(0, 2 * np.pi, 0.1), values, np.full((3, 63, 16), 12, np.int32), first_depth=0.0, depth_offset=0, depth_of="drop"
    )
    covered = np.ones((n, n), bool)
    return PolyTable(gradients, covered, background(), (pitch[0], pitch[1]), shadow, surround=0.7 * gradients)


def network() -> MlpWeights:
    """A network of two hidden layers whose weights are a formula."""
    sizes = ((8, INPUTS), (6, 8), (3, 6))
    matrices = tuple(0.6 * np.sin(1 + 1.7 * np.arange(a)[:, None] + 0.9 * np.arange(b) ** 1.3) for a, b in sizes)
    return MlpWeights(matrices, tuple(0.1 * np.cos(np.arange(a)) for a, _ in sizes), background())


@functools.cache
def sensor(mode: str) -> TactileSensor:
    optics = {
        "raytrace": RayTraced(),
        "taxim": Taxim(table(), shadows=True),
        "phong": Phong(background=background().astype(np.uint8)),
        "mlp": Mlp(network()),
    }[mode]
    return TactileSensor(SENSOR, optics=optics, resolution=RESOLUTION, device="cpu")


def image(mode: str, scene: str) -> np.ndarray:
    rgb = sensor(mode).press(scene).rgb
    assert rgb is not None
    return rgb[0]


def compare(actual: np.ndarray, expected: np.ndarray, name: str, folder: Path) -> None:
    """Images (H, W, 3) agree but for rounding; else ``folder`` gets what was computed, what is stored and the error."""
    assert actual.shape == expected.shape, f"{name}: shape {actual.shape} instead of {expected.shape}"
    error = actual.astype(int) - expected
    share = float((error != 0).mean())
    if np.abs(error).max() <= 1 and share <= CHANGED_SHARE:
        return
    strength = 127 / np.abs(error).max()
    pictures = {"actual": actual, "reference": expected, "error": (128 + strength * error).astype(np.uint8)}
    for what, picture in pictures.items():
        write_png(folder / f"{name}_{what}.png", picture)
    worst = tuple(int(i) for i in np.unravel_index(np.abs(error).argmax(), error.shape))
    raise AssertionError(
        f"{name}: {share:.2%} of the values differ (limit {CHANGED_SHARE:.2%}), by up to {np.abs(error).max()} levels (limit 1), "
        f"on average by {np.abs(error).mean():.3f}; "
        f"at (row, column, channel) {worst} {actual[worst]} instead of {expected[worst]}; images in {folder}"
    )


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("mode", MODES)
def test_image(mode: str, scene: str, tmp_path: Path) -> None:
    compare(image(mode, scene), read_png(STORED / f"{mode}_{scene}.png"), f"{mode}_{scene}", tmp_path)


def test_every_stored_image_shows_another_thing() -> None:
    """No mode is blind to the press, and no two images are the same."""
    images = np.stack([read_png(STORED / f"{mode}_{scene}.png").astype(int) for mode in MODES for scene in SCENES])
    for k, one in enumerate(images):
        assert min(np.abs(one - other).max() for j, other in enumerate(images) if j != k) > 20


def test_a_changed_image_is_reported_and_written(tmp_path: Path) -> None:
    stored = read_png(STORED / "raytrace_coin.png")
    changed = stored.copy()
    changed[20, 30, 1] += 2
    with pytest.raises(AssertionError, match=r"one: 0\.01% of the values differ.*up to 2 levels.*\(20, 30, 1\)"):
        compare(changed, stored, "one", tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["one_actual.png", "one_error.png", "one_reference.png"]
    assert read_png(tmp_path / "one_error.png")[20, 30].tolist() == [128, 255, 128]
    changed = stored.copy()
    changed[:10, :10] += 1  # one level, but of too many
    with pytest.raises(AssertionError, match=r"2\.08% of the values differ.*up to 1 levels"):
        compare(changed, stored, "many", tmp_path)


# ---------------------------------------------------------------------- forces, heights, markers

TOLERANCES = {
    "rigid.wrench": (1e-6, 1e-9),
    "rigid.height": (0.0, 2e-9),
    "fots.displacement": (0.0, 1e-8),
    "soft.wrench": (1e-4, 1e-6),
    "soft.height": (0.0, 2e-8),
}
"""Relative to the value and absolute, in its unit (N, N m, m): float64 for forces, float32 for heights and markers. The solver of the soft
pad stops at a residual, and sums in another order end at another point below it."""


def every(array: np.ndarray, stride: int) -> np.ndarray:
    return array[:, ::stride, ::stride]


def rigid_numbers() -> dict[str, np.ndarray]:
    """Three presses, two of them with shear and one with a twist: wrench (3, 6), and every eighth height."""
    one = TactileSensor(SENSOR, outputs=("height", "wrench"), resolution=RESOLUTION, device="cpu")
    frames = [one.press(scene) for scene in ("sphere", "cylinder", "torus")]
    wrench, height = ([getattr(frame, name) for frame in frames] for name in ("wrench", "height"))
    return {"rigid.wrench": np.concatenate(wrench), "rigid.height": every(np.concatenate(height), 8)}


def marker_numbers() -> dict[str, np.ndarray]:
    """FOTS on a ball that is sheared and twisted, so that all three of its motions count."""
    stages = (StageSpec("indent", depth=0.6e-3), StageSpec("shear", shear=(0.3e-3, -0.2e-3)), StageSpec("twist", twist=0.2))
    scene = replace(load_press("sphere"), trajectory=stages)
    one = TactileSensor("gelsight_mini_7x9", outputs=("height",), markers="fots", resolution=RESOLUTION, device="cpu")
    markers = one.press(scene).markers
    assert markers is not None
    return {"fots.displacement": markers.displacement}


def soft_numbers() -> dict[str, np.ndarray]:
    """A shallow press of the coarse soft pad, far from where its contact is resolved."""
    scene = replace(load_press("sphere"), trajectory=(StageSpec("indent", depth=0.1e-3),))
    one = TactileSensor(SENSOR, physics="ipc", outputs=("height", "wrench"), pitch=0.25e-3, device="cpu")
    with pytest.warns(NarrowContactWarning):
        frame: TactileFrame = one.press(scene)
    assert frame.wrench is not None and frame.height is not None
    return {"soft.wrench": frame.wrench, "soft.height": every(frame.height, 4)}


@pytest.mark.parametrize("numbers", [rigid_numbers, marker_numbers, soft_numbers], ids=lambda numbers: numbers.__name__)
def test_numbers(numbers: Any) -> None:
    with np.load(STORED / "numbers.npz") as stored:
        for name, actual in numbers().items():
            relative, absolute = TOLERANCES[name]
            np.testing.assert_allclose(actual, stored[name], rtol=relative, atol=absolute, err_msg=name)


def test_the_stored_numbers_are_of_real_presses() -> None:
    with np.load(STORED / "numbers.npz") as stored:
        assert set(stored) == set(TOLERANCES)
        assert (stored["rigid.wrench"][:, 2] < -1).all() and np.abs(stored["rigid.wrench"][1:, :2]).max(axis=1).min() > 1
        assert np.ptp(stored["rigid.height"], axis=(1, 2)).min() > 3e-4
        assert np.nanmax(np.abs(stored["fots.displacement"])) > 5e-5
        assert stored["soft.wrench"][0, 2] < -0.02 and np.ptp(stored["soft.height"]) > 5e-5


def write() -> None:
    images = {f"{mode}_{scene}.png": image(mode, scene) for mode in MODES for scene in SCENES}
    numbers = rigid_numbers() | marker_numbers() | soft_numbers()
    for name, pixels in images.items():
        write_png(STORED / name, pixels)
    np.savez_compressed(STORED / "numbers.npz", allow_pickle=False, **numbers)


def main() -> None:
    parser = argparse.ArgumentParser(description="Compare images with the stored ones, or store them.")
    parser.add_argument(
        "--write", action="store_true", help="replace the stored images and numbers; without it they are only compared"
    )
    if parser.parse_args().write:
        write()
        return
    folder = Path(tempfile.mkdtemp(prefix="raytac-references-"))
    for mode in MODES:
        for scene in SCENES:
            compare(image(mode, scene), read_png(STORED / f"{mode}_{scene}.png"), f"{mode}_{scene}", folder)


if __name__ == "__main__":
    main()
