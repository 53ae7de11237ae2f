"""A mode that a user registers in one file is pressed, compared, observed and viewed by its name."""

from __future__ import annotations

import importlib.util
import json
import pickle
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from raytac import ObservationSettings, TactileSensor
from raytac.cli import main
from raytac.errors import InputError
from raytac.optics import OPTICS, Mlp, Phong, RayTraced, Taxim, register
from raytac.report.compare.modes import comparison_modes
from raytac.report.compare.page import write_comparison
from raytac.report.compare.run import run_comparison
from raytac.report.compare.settings import CompareSettings
from raytac.specs import load_press
from raytac.view import PressSession

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def example() -> Iterator[ModuleType]:
    """The example as a module, with its mode registered as long as these tests run."""
    spec = importlib.util.spec_from_file_location("own_optical_mode", ROOT / "examples" / "own_optical_mode.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    yield module
    del OPTICS._classes["grey"], sys.modules[spec.name]


def test_it_is_pressed_by_name_and_has_its_options(example: ModuleType) -> None:
    by_name, deep = (
        TactileSensor("gelsight_mini", optics=optics, resolution=(80, 60)) for optics in ("grey", example.Grey(deepest=2e-3))
    )
    frame = by_name.press("sphere")
    deepest = float((frame.surface.grid.rest - frame.surface.height).max())
    assert frame.rgb is not None and frame.rgb.max() == pytest.approx(255 * min(deepest / 1e-3, 1), abs=6)
    np.testing.assert_allclose(deep.press("sphere").rgb, 0.5 * frame.rgb, atol=1)
    assert by_name.label == "rigid+grey" and by_name.sampling == {}
    assert pickle.loads(pickle.dumps(by_name)).optics == by_name.optics
    with pytest.raises(InputError, match=r"outputs = 'normals': must be an output of optics='grey'.*choose from: rgb, height"):
        TactileSensor("gelsight_mini", optics="grey", outputs=("normals",))
    with pytest.raises(InputError, match="deepst = 1: is no option of optics='grey'; choose from: deepest"):
        OPTICS.config("grey", deepst=1)
    assert ObservationSettings(("rgb",), optics="grey").optics == "grey"


def test_the_example_compares_it(example: ModuleType) -> None:
    assert 0 < example.compare(Phong()) < 30


def test_the_command_line_knows_it(example: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "press"
    assert main(["press", "sphere", "--optics", "grey", "--resolution", "80x60", "--outputs", "rgb", "--out", str(out)]) == 0
    assert json.loads((out / "metrics.json").read_text("utf-8"))["mode"] == "rigid+grey" and (out / "rgb.png").is_file()
    assert main(["press", "sphere", "--optics", "grey", "--spp", "4", "--out", str(tmp_path / "no")]) == 2
    assert "spp = 4: is no option of optics='grey'; choose from: deepest" in capsys.readouterr().err


def test_a_comparison_measures_and_draws_it(example: ModuleType, tmp_path: Path) -> None:
    modes = {mode.name: mode for mode in comparison_modes((1,))}
    assert {"grey", "fast", "fast_4_rays", "reference.spp1", "path.spp1", "taxim", "taxim_shadow", "phong", "peer"} <= set(modes)
    assert modes["grey"].code() == ("own_optical_mode",)
    settings = CompareSettings(
        device="cpu", reference_spp=2, resolutions=((32, 24),), scenes=("sphere",), frames=3, budget_s=0.1, batch=2
    )
    comparison = run_comparison(settings, tmp_path, [modes["grey"]])
    (row,) = comparison.rows
    assert row.figures["mode"] == row.figures["label"] == "grey" and 0 < float(row.figures["frame_mae"] or 0) < 255
    assert {"pareto.png", "report.html"} <= {path.name for path in write_comparison(comparison, tmp_path, 1.0)}
    assert "grey" in (tmp_path / "report.html").read_text("utf-8")


def test_the_viewer_shows_it(example: ModuleType) -> None:
    sensor = TactileSensor("gelsight_mini", optics="grey", outputs=("rgb", "wrench", "traction"), resolution=(80, 60))
    shot = PressSession(sensor, load_press("sphere")).snapshot()
    (pad,) = shot.pads.values()
    assert pad.rgb is not None and pad.rgb.shape == (60, 80, 3)


def test_a_name_is_taken_once(example: ModuleType) -> None:
    with pytest.raises(InputError, match="optics = 'taxim': is the name of another implementation"):
        register("taxim")(example.Grey)


def test_configurations_travel_and_compare() -> None:
    for config in (RayTraced("reference", spp=4), Taxim(shadows=False), Taxim(Path("folder")), Phong("gazebo"), Mlp("mlp.npz")):
        assert pickle.loads(pickle.dumps(config)) == config
    assert OPTICS.config("raytrace", spp=4) == RayTraced(spp=4) != RayTraced()
    assert [OPTICS.name_of(config) for config in (RayTraced(), Taxim(), Phong(), Mlp("mlp.npz"))] == list(OPTICS.names)[:4]
