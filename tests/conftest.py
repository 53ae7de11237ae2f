"""What the tests of several folders share: a synthetic sensor and press, and an optical mode that needs no renderer."""

from __future__ import annotations

from tests import one_thread  # isort: skip  (before NumPy)

import gc
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from raytac.frame import TactileFrame
from raytac.gel.surface import GelSurface, PadGrid
from raytac.optics.base import OpticsImages
from raytac.specs.sensor import (
    CameraSpec,
    CaseSpec,
    CoatSpec,
    GelpadSpec,
    LedSpec,
    LightsSpec,
    MarkerSpec,
    RefractionSpec,
    ResponseSpec,
    SensorSpec,
)
from tests import case_lights, coarse_figures, marks

BALL_RADIUS = 4e-3
BALL_DEPTH = 1e-3
GARBAGE = 20_000, 10, 20
"""Thresholds of searches for garbage: with Python's own, 700, they take 3 % of the suite."""


def pytest_configure(config: pytest.Config) -> None:
    gc.disable()  # a quarter of what collection takes, and it finds nothing: `pytest_collection_finish`
    marks.block(str(config.getoption("markexpr")))
    coarse_figures.limit()


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave out files all of whose tests are deselected: importing them would import what they need."""
    expression = str(config.getoption("markexpr"))
    return True if any(marks.is_deselected(mark, expression) for mark in marks.marks_of(collection_path)) else None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        for mark in marks.marks_of(item.path):
            item.add_marker(mark)


def pytest_collection_finish() -> None:
    """Leave what stays for the whole session, some thousand tests and all modules, out of every later search for garbage."""
    gc.freeze()
    gc.set_threshold(*GARBAGE)
    gc.enable()


def pytest_runtest_setup(item: pytest.Item) -> None:
    one_thread.limit_renderer()
    place = item.path.relative_to(Path(__file__).parent).as_posix()
    case_lights.limit(few=not place.startswith(case_lights.MEASURED))


def make_sensor_spec() -> SensorSpec:
    """A sensor in the size class of a GelSight Mini, made up for tests: three LEDs, one a side."""
    leds = tuple(
        LedSpec(name=layer, layer=layer, position=position, axis=(0.0, 0.0, 1.0), size=(1e-3, 1e-3), lobe=1.0, power=power)
        for layer, position, power in (
            ("red", (0.0, -11e-3, -8e-3), (1.0, 0.1, 0.1)),
            ("green", (12e-3, 0.0, -8e-3), (0.1, 1.0, 0.1)),
            ("blue", (0.0, 11e-3, -8e-3), (0.1, 0.1, 1.0)),
        )
    )
    return SensorSpec(
        name="test_sensor",
        gelpad=GelpadSpec((25.25e-3, 20.75e-3), 4e-3, (math.inf, math.inf), 4e5, 0.48, 1000.0, 1.0),
        coat=CoatSpec((0.5, 0.5, 0.5), 0.0, 0.3),
        case=CaseSpec((28e-3, 24e-3), -30e-3, 0.1),
        camera=CameraSpec((320, 240), (0.0634e-3, 0.0634e-3), (0.0, 0.0, -28e-3), (160.0, 120.0)),
        response=ResponseSpec(1.0, (1.0, 1.0, 1.0), 2.2, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        markers=MarkerSpec(0, 0, (1e-3, 1e-3), (0.0, 0.0), 0.2e-3, 0.05),
        refraction=RefractionSpec("none", 1.0, 0.0),
        lights=LightsSpec(leds),
    )


def ball_under(grid: PadGrid, depth: float = BALL_DEPTH) -> np.ndarray:
    """z of the underside of a ball pressed ``depth`` [m] into the pad centre, shape (Ny, Nx); inf beside the ball."""
    radius_squared = grid.x[None, :] ** 2 + grid.y[:, None] ** 2
    with np.errstate(invalid="ignore"):
        under = BALL_RADIUS - depth - np.sqrt(BALL_RADIUS**2 - radius_squared)
    return np.where(np.isfinite(under), under, np.inf)


def make_surface(depth: float = BALL_DEPTH, batch: int = 1) -> GelSurface:
    """A flat pad under a ball, with a Gaussian surround instead of elasticity."""
    x, y = np.linspace(-12.625e-3, 12.625e-3, 127), np.linspace(-10.375e-3, 10.375e-3, 105)
    grid = PadGrid(x=x, y=y, rest=np.zeros((105, 127)))
    under = ball_under(grid, depth)
    surround = -0.6 * depth * np.exp(-(x[None, :] ** 2 + y[:, None] ** 2) / (2 * 2.5e-3**2))
    height = np.minimum(surround, under)
    contact = under <= surround
    return GelSurface(
        grid=grid,
        height=np.repeat(height[None].astype(np.float32), batch, axis=0),
        contact=np.repeat(contact[None], batch, axis=0),
        contact_centre=np.zeros((batch, 2)) if contact.any() else np.full((batch, 2), np.nan),
    )


def shade(surface: GelSurface, resolution: tuple[int, int], sensor: SensorSpec) -> TactileFrame:
    """Lambert shading by three distant lights: not a sensor model, only arrays of the right kind that depend on the surface."""
    from scipy.ndimage import map_coordinates

    width, height = resolution
    pitch = sensor.camera.pixel_pitch[0] * sensor.camera.resolution[0] / width
    x, y = (np.arange(width) + 0.5 - width / 2) * pitch, (np.arange(height) + 0.5 - height / 2) * pitch
    grid = surface.grid
    rows = (y[:, None] - grid.y[0]) / grid.pitch[1] + 0 * x[None, :]
    columns = (x[None, :] - grid.x[0]) / grid.pitch[0] + 0 * y[:, None]
    z = np.stack([map_coordinates(h, [rows, columns], order=1, mode="nearest") for h in surface.height])
    zy, zx = np.gradient(z, pitch, axis=(1, 2))
    normals = np.stack([zx, zy, -np.ones_like(zx)], axis=-1) / np.sqrt(1 + zx**2 + zy**2)[..., None]
    layers = {}
    for led in sensor.lights.leds:
        light = np.array(led.position) / np.linalg.norm(led.position)
        lambert = np.clip(normals @ light, 0.0, None)
        layers[led.layer] = (0.35 * lambert[..., None] * np.array(led.power)).astype(np.float32)
    linear = sum(layers.values())
    position = np.stack([np.broadcast_to(x[None, None, :], z.shape), np.broadcast_to(y[None, :, None], z.shape), z], axis=-1)
    return TactileFrame(
        surface=surface,
        rgb=np.round(255 * np.clip(linear, 0, 1) ** (1 / 2.2)).astype(np.uint8),
        layers=layers,
        normals=normals.astype(np.float32),
        position=position.astype(np.float32),
        depth=(z - sensor.camera.position[2]).astype(np.float32),
        height=surface.height,
        time_ms={"physics": 1.0, "surface": 2.0, "optics": 3.0},
    )


class Shader:
    """An optical mode that needs no renderer; with ``fail`` its second image raises that."""

    label = "shader"
    device = "cpu"

    def __init__(self, spec: SensorSpec, size: tuple[int, int] = (64, 48), fail: type[BaseException] | None = None) -> None:
        self.spec, self.size, self.fail, self.rendered = spec, size, fail, 0

    def render(self, surface: GelSurface) -> OpticsImages:
        self.rendered += 1
        if self.fail is not None and self.rendered > 1:
            raise self.fail
        frame = shade(surface, self.size, self.spec)
        return OpticsImages(frame.rgb, frame.layers, frame.normals, frame.position, frame.depth)


@pytest.fixture(scope="session")
def sensor_spec() -> SensorSpec:
    return make_sensor_spec()


@pytest.fixture(scope="session")
def ball_surface() -> GelSurface:
    return make_surface()


@pytest.fixture(scope="module")
def few_cells() -> Iterator[None]:
    """Soft pads of fewer tetrahedra, for files that say nothing of a mesh's accuracy: coarse of a quarter, medium as coarse is."""
    from raytac.physics.soft import mesh

    coarse = mesh.PAD_LEVELS["coarse"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(mesh.PAD_LEVELS, "medium", coarse)
        patch.setitem(mesh.PAD_LEVELS, "coarse", replace(coarse, cell=2.5e-3, layers=2, layer_spread=2.0))
        yield


@pytest.fixture
def homeless(monkeypatch: pytest.MonkeyPatch) -> None:
    """A user whom the machine does not know and whose environment names no folder, as in many containers."""
    for name in ("HOME", "XDG_CACHE_HOME", "RAYTAC_CACHE", "WARP_CACHE_PATH"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("os.getuid", lambda: 4242424)
