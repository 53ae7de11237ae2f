"""A frame does not depend on those before it: what one object shows of rest, press, rest and another press is what fresh ones show.

Dr.Jit records the kernels of a first frame and replays them for the next, so a recording must hold for every frame to come
(``raytac.optics.runtime`` says what that asks for). Every mode and marker model is taken through the same frames here.
"""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import drjit as dr
import numpy as np
import pytest

from raytac.gel.surface import GelSurface, PadGrid
from raytac.markers.base import MarkerModel
from raytac.markers.config import Fots
from raytac.markers.contact_tracker import ContactTracker
from raytac.markers.contacts import ContactCells
from raytac.markers.registry import MARKERS
from raytac.markers.tracker import MarkerTracker
from raytac.optics import Mlp, Phong, RayTraced, Taxim
from raytac.optics.base import OpticsImages
from raytac.optics.device_image import DeviceImage, ImageCut
from raytac.optics.image.phong import PhongMode
from raytac.optics.taxim.mode import TaximMode
from raytac.specs import PunchSpec
from raytac.specs.sensor import LightsSpec, SensorSpec
from tests.markers.pads import MOTION, coat_mesh, flat_sensor, pad_grid, pose, pressed, with_coat
from tests.optics.scenes import RESOLUTION, ball, grid_of, led, like_a_mini
from tests.optics.test_mlp import network
from tests.optics.test_taxim_mode import make_table

DEVICES = pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
SPEC = like_a_mini()
ONE_LED = replace(
    SPEC, lights=LightsSpec((led("one", (0, -11.2e-3, -9e-3), (0, 2e-3, 0), size=(2e-3, 1e-3), power=(3e-5, 3e-5, 3e-5)),))
)
"""For the ray tracer, whose kernels grow with the number of LEDs."""
GRID = grid_of(SPEC)
OFFSETS = range(0, 64, 4)
"""Bytes from an address that suits every vector register."""


def table_mode(
    device: str, *, shadow: bool, slopes_of: str = "displacement", depth_of: str = "drop", sheets: int = 2
) -> TaximMode:
    """A table as ``raytac bake`` makes it, or with slopes of the height, depths of the origin and one sheet as upstream's folders."""
    table = make_table(SPEC, slopes_of=slopes_of)
    assert table.shadow is not None
    table = replace(table, shadow=replace(table.shadow, depth_of=depth_of))
    table = replace(table, surround=-0.5 * table.gradients) if sheets == 2 else table
    return Taxim(calibration=table, shadows=shadow).build(SPEC, resolution=RESOLUTION, device=device)


def phong(device: str) -> PhongMode:
    return Phong(background=np.full((*RESOLUTION[::-1], 3), 120, np.uint8)).build(SPEC, resolution=RESOLUTION, device=device)


UPSTREAM = {"slopes_of": "height", "depth_of": "origin", "sheets": 1}
MODES: dict[str, Callable[[str], Any]] = {
    "fast": lambda device: RayTraced().build(ONE_LED, resolution=RESOLUTION, device=device),
    "fast-direct": lambda device: RayTraced(bounce=False).build(
        ONE_LED, resolution=RESOLUTION, device=device, outputs=("rgb", "layers", "normals", "depth")
    ),
    "taxim": lambda device: table_mode(device, shadow=False),
    "taxim-upstream": lambda device: table_mode(device, shadow=False, **UPSTREAM),
    "shadow": lambda device: table_mode(device, shadow=True),
    "shadow-upstream": lambda device: table_mode(device, shadow=True, **UPSTREAM),
    "shadow-origin": lambda device: table_mode(device, shadow=True, depth_of="origin"),
    "phong": phong,
    "mlp": lambda device: Mlp(weights=network()).build(SPEC, resolution=RESOLUTION, device=device),
}
EACH_MODE = pytest.mark.parametrize("mode", MODES)


def placed(values: np.ndarray, offset: int) -> np.ndarray:
    """The same values ``offset`` bytes beyond a multiple of 64."""
    memory = np.empty(values.nbytes + 128, np.uint8)
    start = -memory.ctypes.data % 64 + offset
    view = memory[start : start + values.nbytes].view(values.dtype).reshape(values.shape)
    view[:] = values
    return view


def stacked(*pads: tuple[np.ndarray, np.ndarray], offset: int = 0, ink: bool = False) -> GelSurface:
    """One environment for each (height, contact)."""
    heights = placed(np.stack([height for height, _ in pads]).astype(np.float32), offset)
    contacts = placed(np.stack([contact for _, contact in pads]), 60 - offset)
    stripes = np.broadcast_to(np.arange(GRID.shape[1]) % 8 < 3, heights.shape).astype(np.float32)
    return GelSurface(GRID, heights, contacts, np.zeros((len(pads), 2)), ink=placed(stripes, offset) if ink else None)


REST = GRID.rest, np.zeros(GRID.shape, bool)
PRESS = ball(GRID)
OTHER = ball(GRID, depth=0.4e-3, centre=(-2e-3, 1e-3))


def arrays(mode: Any, surface: GelSurface) -> dict[str, np.ndarray]:
    """Images of ``render``, which shows untouched pads as they were once; those of a frame that renders every pad must be the same."""
    lazy, every = (by_name(images) for images in (mode.render(surface), mode._begun(surface, *mode._checked(surface))()))
    assert_same(lazy, every, "render against a frame of all pads")
    return every


def by_name(images: OpticsImages) -> dict[str, np.ndarray]:
    found = {name: getattr(images, name) for name in ("rgb", "normals", "position", "depth")} | (images.layers or {})
    return {name: array for name, array in found.items() if array is not None}


def assert_same(found: dict[str, np.ndarray], expected: dict[str, np.ndarray], what: str) -> None:
    assert found.keys() == expected.keys()
    for name, array in expected.items():
        np.testing.assert_array_equal(found[name], array, err_msg=f"{what}: {name}")


@pytest.fixture(scope="module")
def fresh() -> Callable[[str, str], list[dict[str, np.ndarray]]]:
    """``fresh(mode, device)``: what three objects that render nothing else show of rest, press and another press."""
    known: dict[tuple[str, str], list[dict[str, np.ndarray]]] = {}

    def images(mode: str, device: str) -> list[dict[str, np.ndarray]]:
        if (mode, device) not in known:
            known[mode, device] = [arrays(MODES[mode](device), stacked(pad)) for pad in (REST, PRESS, OTHER)]
        return known[mode, device]

    return images


@EACH_MODE
@DEVICES
def test_rest_press_rest_and_another_press(mode: str, device: str, fresh: Callable) -> None:
    rest, press, other = fresh(mode, device)
    assert min(np.abs(a["rgb"].astype(int) - b["rgb"]).max() for a, b in ((rest, press), (press, other), (other, rest))) > 10
    one = MODES[mode](device)
    frames = ((REST, rest), (PRESS, press), (REST, rest), (OTHER, other), (PRESS, press))
    for k, (pad, expected) in enumerate(frames):
        assert_same(arrays(one, stacked(pad)), expected, f"frame {k}")


@EACH_MODE
@DEVICES
def test_batches_of_which_some_are_at_rest(mode: str, device: str, fresh: Callable) -> None:
    pads, known = (REST, PRESS, OTHER), fresh(mode, device)
    one = MODES[mode](device)
    for batch in ((0, 0, 0), (1, 0, 0), (0, 2, 1), (0, 0, 0), (2, 1, 0)):
        found = arrays(one, stacked(*(pads[k] for k in batch)))
        singles = [known[k] for k in batch]
        assert_same(found, {name: np.concatenate([s[name] for s in singles]) for name in singles[0]}, str(batch))


@pytest.mark.parametrize("mode", ["fast-direct", "phong"])
def test_pads_at_rest_with_dots_are_rendered_once_and_again_where_dots_moved(mode: str) -> None:
    one = MODES[mode]("cpu")
    surface = stacked(REST, REST, PRESS, REST, ink=True)
    assert surface.ink is not None
    surface.ink[3] = np.roll(surface.ink[3], 3, axis=1)
    known = arrays(one, surface)
    assert (known["rgb"][0] != known["rgb"][3]).any() and len(one._pressed(surface, *one._checked(surface))) == 2
    assert_same(arrays(one, stacked(REST, ink=True)), {name: values[:1] for name, values in known.items()}, "alone")
    assert (arrays(one, stacked(REST))["rgb"] != known["rgb"][:1]).any()  # without dots


@pytest.mark.parametrize(
    ("mode", "ink"),
    [
        pytest.param(mode, ink, marks=pytest.mark.slow if mode == "fast" and ink else ())
        for mode in MODES
        for ink in (False, True)
    ],
)
def test_memory_of_any_alignment(mode: str, ink: bool) -> None:
    """On the CPU an array made from NumPy's lies on its memory, and kernels for aligned memory are others."""
    one = MODES[mode]("cpu")
    known = [arrays(one, stacked(pad, ink=ink)) for pad in (PRESS, REST)]
    for offset in OFFSETS:
        for pad, expected in zip((REST, PRESS), known[::-1], strict=True):
            assert_same(arrays(one, stacked(pad, offset=offset, ink=ink)), expected, f"{offset} bytes")


@pytest.mark.parametrize("mode", ["fast-direct", "shadow", "phong"])
@DEVICES
def test_device_memory_of_any_alignment(mode: str, device: str, fresh: Callable) -> None:
    """Slices of PyTorch's memory, which no backend copies."""
    torch = pytest.importorskip("torch")
    one = MODES[mode](device)
    rest, press, _ = fresh(mode, device)
    arrays(one, stacked(REST))  # it learns the grid

    def sliced(values: np.ndarray, offset: int) -> Any:
        memory = torch.zeros(values.nbytes + 128, dtype=torch.uint8, device=device)
        start = -memory.data_ptr() % 64 + offset
        part = memory[start : start + values.nbytes]
        part.copy_(torch.from_numpy(np.ascontiguousarray(values).reshape(-1).view(np.uint8)))
        return part.view(torch.float32) if values.dtype == np.float32 else part

    def array(kind: Any, tensor: Any) -> Any:
        as_tensor: Any = dr.tensor_t(kind)
        return as_tensor(tensor).array

    for offset in OFFSETS:
        for (height, contact), expected in ((REST, rest), (PRESS, press)):
            memory = sliced(height.astype(np.float32), offset), sliced(contact, 60 - offset)
            if device == "cuda":
                torch.cuda.synchronize()
            heights, touched = (array(kind, part) for kind, part in zip((one.mi.Float, one.mi.UInt8), memory, strict=True))
            found = one.render_device(heights, touched).rgb
            np.testing.assert_array_equal(np.array(found), expected["rgb"].ravel(), err_msg=f"{offset} bytes")


@pytest.mark.parametrize("mode", ["fast-direct", "shadow", "phong"])
@DEVICES
def test_heights_that_are_one_number(mode: str, device: str) -> None:
    """Dr.Jit keeps an array of one number as that number until it is asked for in memory."""
    one = MODES[mode](device)
    arrays(one, stacked(REST))

    def image(literal: bool, height: float) -> np.ndarray:
        make = dr.full if literal else dr.opaque
        pad = make(one.mi.Float, height, GRID.rest.size), make(one.mi.UInt8, 0, GRID.rest.size)
        found = one.render_device(*pad).rgb
        return np.array(found)

    first, second = (image(False, height) for height in (0.0, -1e-4))
    assert (first != second).any()
    for literal, height, expected in ((True, 0.0, first), (True, -1e-4, second), (False, 0.0, first), (True, 0.0, first)):
        np.testing.assert_array_equal(image(literal, height), expected)


@pytest.mark.parametrize("mode", ["fast-direct", "shadow", "phong"])
@DEVICES
def test_a_surface_at_rest_may_lie_on_the_memory_of_its_grid(mode: str, device: str, fresh: Callable) -> None:
    """Dr.Jit tells inputs apart by their address: two on the same memory are one to a recording, and stay so."""
    grid = PadGrid(GRID.x, GRID.y, placed(GRID.rest.astype(np.float32), 0))
    still = replace(stacked(REST), grid=grid, height=grid.rest[None])
    assert np.shares_memory(still.height, grid.rest)
    one = MODES[mode](device)
    for surface, expected in ((still, 0), (replace(stacked(PRESS), grid=grid), 1), (still, 0)):
        np.testing.assert_array_equal(arrays(one, surface)["rgb"], fresh(mode, device)[expected]["rgb"])


@pytest.mark.parametrize("mode", ["fast-direct", "shadow", "phong"])
@DEVICES
def test_images_for_a_learner(mode: str, device: str) -> None:
    """Cut and compared with the image at rest on the device."""

    def make() -> DeviceImage:
        return DeviceImage(MODES[mode](device), GRID, ImageCut((30, 20), 4, 6, 2), difference=True)

    def image(images: DeviceImage, pad: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        return np.array(images(*images.upload(stacked(pad))))

    expected = [image(make(), pad) for pad in (REST, PRESS, OTHER)]
    assert (expected[0] == 127).all() and np.abs(expected[1].astype(int) - expected[2]).max() > 10
    one = make()
    for k, pad in ((0, REST), (1, PRESS), (0, REST), (2, OTHER)):
        np.testing.assert_array_equal(image(one, pad), expected[k])


# ---------------------------------------------------------------------- markers


def marker_sensor(model: str) -> SensorSpec:
    motion = replace(MOTION, punch=PunchSpec(0.7, 6e-3, 1e3, 2e8, 1e5) if model == "fots-punch" else None)
    return replace(flat_sensor(), marker_motion=motion)


def marker_surfaces(sensor: SensorSpec, grid: PadGrid) -> list[GelSurface]:
    """Rest, a press, rest and two balls beside each other, with a coat that moves along."""
    mesh = coat_mesh(sensor)
    presses: list[list[tuple[float, float, float]]] = [[], [(0.0, 0.0, 6e-4)], [], [(-4e-3, 1e-3, 4e-4), (4e-3, -2e-3, 5e-4)]]
    found = []
    for k, balls in enumerate(presses):
        surface = pressed(grid, balls, poses=[pose(1e-4 * k, 0.0, 0.0, 0.02 * k)])
        found.append(with_coat(surface, mesh, mesh.rest[None] + 1e-4 * len(balls) * np.cos(300 * mesh.rest[None])))
    return found


def beside(one: GelSurface, other: GelSurface) -> GelSurface:
    """Environments of both."""
    assert (
        one.coat is not None and other.coat is not None and one.pad_from_object is not None and other.pad_from_object is not None
    )
    return replace(
        one,
        height=np.concatenate([one.height, other.height]),
        contact=np.concatenate([one.contact, other.contact]),
        contact_centre=np.concatenate([one.contact_centre, other.contact_centre]),
        pad_from_object=np.concatenate([one.pad_from_object, other.pad_from_object]),
        coat=replace(one.coat, positions=np.concatenate([one.coat.positions, other.coat.positions])),
    )


@pytest.mark.parametrize("model", [*MARKERS.names, "fots-punch"])
@DEVICES
def test_markers_of_rest_press_rest_and_another_press(model: str, device: str) -> None:
    if device == "cuda" and not model.startswith("fots"):
        pytest.skip("computes on the CPU whatever the device")
    if model == "superposition":
        pytest.importorskip("warp")
    sensor = marker_sensor(model)
    grid = pad_grid(sensor)
    surfaces = marker_surfaces(sensor, grid)

    def make(num_envs: int = 1) -> MarkerTracker:
        return MarkerTracker(sensor, model.removesuffix("-punch"), grid, num_envs=num_envs, device=device)

    expected = [make().update(surface).displacement for surface in surfaces]
    assert not expected[0].any() and min(np.abs(moved).max() for moved in expected[1::2]) > 1e-5
    one, both = make(), make(2)
    for k, surface in enumerate(surfaces):
        np.testing.assert_array_equal(one.update(surface).displacement, expected[k])
        following = (k + 1) % len(surfaces)
        both.reset()
        found = both.update(beside(surface, surfaces[following])).displacement
        np.testing.assert_allclose(found, np.concatenate([expected[k], expected[following]]), rtol=0, atol=1e-9)


@DEVICES
def test_other_numbers_of_markers_are_other_recordings(device: str) -> None:
    sensor = marker_sensor("fots")
    grid = pad_grid(sensor)
    cells, surface = ContactCells.over(grid), pressed(grid, [(0, 0, 6e-4)])
    samples = cells.sample(surface)
    contacts = ContactTracker(1).update(surface, samples)
    places = np.random.default_rng(0).uniform(-4e-3, 4e-3, (1, 300, 3))

    def moved(model: MarkerModel, count: int) -> np.ndarray:
        return model.displacement(places[:, :count].copy(), surface, samples, contacts)

    def make() -> MarkerModel:
        return Fots().build(sensor, grid, num_envs=1, device=device)

    one = make()
    for count in (7, 300, 1, 7):
        np.testing.assert_array_equal(moved(one, count), moved(make(), count))


@EACH_MODE
def test_only_pressed_pads_are_rendered(mode: str, monkeypatch: pytest.MonkeyPatch) -> None:
    one, rendered = MODES[mode]("cpu"), []
    whole = type(one)._begun

    def counted(self: Any, surface: GelSurface, heights: np.ndarray, failed: np.ndarray) -> Callable[[], OpticsImages]:
        rendered.append(len(heights))
        return whole(self, surface, heights, failed)

    monkeypatch.setattr(type(one), "_begun", counted)
    for batch in ((REST, REST, REST, REST), (REST, PRESS, REST, REST), (REST, REST, REST, REST)):
        one.render(stacked(*batch))
    assert rendered == [1, 1]  # the pad at rest once, and the one that is pressed
    one.render(stacked(PRESS, REST, PRESS, PRESS))
    assert rendered == [1, 1, 4]  # three are rounded up, so that few sizes are recorded


@EACH_MODE
def test_images_that_are_read_late_are_those_of_their_own_surface(mode: str) -> None:
    one, surfaces = MODES[mode]("cpu"), [stacked(pad) for pad in (PRESS, REST, OTHER, PRESS)]
    expected = [by_name(MODES[mode]("cpu").render(surface)) for surface in surfaces]
    begun = [one.start(surface) for surface in surfaces]
    for k in (2, 0, 3, 1):
        assert_same(by_name(begun[k]()), expected[k], f"surface {k}, read late")


@EACH_MODE
def test_another_thread_reads_the_same_images(mode: str) -> None:
    one = MODES[mode]("cpu")
    expected, read = by_name(one.render(stacked(PRESS))), []
    for _ in range(5):
        begun = one.start(stacked(PRESS))
        thread = threading.Thread(target=lambda begun=begun: read.append(by_name(begun())))
        thread.start()
        thread.join()
    assert len(read) == 5
    for images in read:
        assert_same(images, expected, "read in another thread")


_POOL = """
from concurrent.futures import ThreadPoolExecutor
import numpy as np
import raytac

sensor = raytac.TactileSensor("gelsight_mini", optics="raytrace", resolution=(64, 48), pitch=0.4e-3, device="cpu")
first = sensor.press("sphere")
expected, surface = first.rgb.copy(), first.surface
with ThreadPoolExecutor(1) as pool:
    read = [pool.submit(lambda frame: np.array_equal(frame.rgb, expected), sensor.update(surface)) for _ in range(60)]
assert all(one.result() for one in read)
print("right")
"""


def test_frames_are_read_in_a_thread_while_others_are_launched() -> None:
    """In a process of its own: Dr.Jit ends one in which two threads record at a time."""
    ended = subprocess.run([sys.executable, "-c", _POOL], capture_output=True, text=True, check=False)
    assert ended.returncode == 0 and ended.stdout.splitlines()[-1] == "right", ended.stderr[-2000:]


def test_one_batch_alone_is_on_the_device() -> None:
    """The next call copies the images of the last one back, and nobody's images are computed twice."""
    one = MODES["phong"]("cpu")
    expected = by_name(one.render(stacked(PRESS)))
    first: Any = one.start(stacked(PRESS))
    assert first._images is None
    second: Any = one.start(stacked(PRESS))
    assert first._images is not None and second._images is None
    assert first() is first() and by_name(first()).keys() == expected.keys()
    third: Any = one.start(stacked(PRESS))
    assert second._images is not None and third._images is None
    for images in (first(), second(), third()):
        assert_same(by_name(images), expected, "read late")


@EACH_MODE
@pytest.mark.parametrize("in_thread", [False, True])
def test_arrays_may_be_written_to_before_the_images_are_read(mode: str, in_thread: bool) -> None:
    one, read = MODES[mode]("cpu"), []
    expected, surface = by_name(one.render(stacked(PRESS, ink=True))), stacked(PRESS, ink=True)
    begun = one.start(surface)
    surface.height[:], surface.contact[:] = GRID.rest, False
    assert surface.ink is not None
    surface.ink[:] = 0.0
    if in_thread:
        thread = threading.Thread(target=lambda: read.append(by_name(begun())))
        thread.start()
        thread.join()
    else:
        read.append(by_name(begun()))
    assert_same(read[0], expected, "arrays written to after the call")
