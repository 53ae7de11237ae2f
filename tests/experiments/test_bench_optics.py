"""The benchmark of the optics: its arithmetic against closed forms, and a small run from end to end."""

from __future__ import annotations

import importlib.util
import math
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from raytac.errors import InputError
from raytac.io.metrics import read_metrics
from raytac.io.png import read_png
from tests.conftest import make_surface


@pytest.fixture(scope="module")
def bench() -> ModuleType:
    path = Path(__file__).parents[2] / "experiments" / "bench_optics.py"
    spec = importlib.util.spec_from_file_location("bench_optics", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["bench_optics"] = module
    spec.loader.exec_module(module)
    return module


def test_psnr_of_known_error(bench: ModuleType) -> None:
    assert bench.psnr(2.55) == pytest.approx(40.0)
    image = np.zeros((4, 4, 3), np.uint8)
    assert bench.rmse(image, image + 5) == pytest.approx(5.0)
    assert math.isfinite(bench.psnr(0.0))


@pytest.mark.parametrize("target", [5.0, 2.0, 1.0, 0.3, 0.01])
def test_spp_for_error_inverts_a_monte_carlo_law(bench: ModuleType, target: float) -> None:
    spp = (1, 4, 16, 64)
    errors = [8.0 / math.sqrt(n) for n in spp]
    assert bench.spp_for_error(spp, errors, target) == pytest.approx((8.0 / target) ** 2, rel=1e-6)


def test_one_sample_is_the_least(bench: ModuleType) -> None:
    assert bench.spp_for_error((1, 4), [3.0, 1.5], 50.0) == 1.0


def test_cost_follows_the_measured_points_and_grows_on_beyond(bench: ModuleType) -> None:
    assert bench.cost_at((1, 4, 16), [2.0, 5.0, 17.0], 10.0) == pytest.approx(11.0)
    assert bench.cost_at((1, 4, 16), [2.0, 5.0, 17.0], 160.0) == pytest.approx(170.0)


def test_moving_changes_every_environment_of_every_frame(bench: ModuleType) -> None:
    surface = make_surface()
    frames = bench.moving([surface], batch=3, count=2)
    depths = np.concatenate([frame.indentation.max(axis=(1, 2)) for frame in frames])
    full = surface.indentation.max()
    assert len(np.unique(depths)) == 6 and (depths >= 0.7 * full - 1e-9).all() and (depths <= full + 1e-9).all()


def test_contact_box_holds_the_contact_and_little_else(bench: ModuleType, sensor_spec) -> None:
    from raytac.optics.camera import Pinhole

    class Tracer:
        camera = Pinhole.from_spec(sensor_spec.camera)

    surface = make_surface()
    rows, columns = bench.contact_box(Tracer(), surface)
    assert rows.start + rows.stop == pytest.approx(240, abs=2) and columns.start + columns.stop == pytest.approx(320, abs=2)
    radius = np.hypot(*np.meshgrid(surface.grid.x, surface.grid.y))[surface.contact[0]].max()
    wide = 2 * radius / sensor_spec.camera.pixel_pitch[0]
    assert wide <= columns.stop - columns.start <= 1.1 * wide + 2  # nearer than the gel plane, so a little larger
    still = replace(surface, contact=np.zeros_like(surface.contact))
    assert bench.contact_box(Tracer(), still) == (slice(0, 240), slice(0, 320))


@pytest.mark.parametrize("options", [{"parts": "speed,colour"}, {"parts": ""}, {"scenes": " , "}, {"spp": 1}])
def test_bad_options_are_refused_before_anything_is_written(bench: ModuleType, tmp_path: Path, options: dict) -> None:
    with pytest.raises(InputError):
        bench.main(bench.Args(out=tmp_path / "out", device="cpu", **options))
    assert not (tmp_path / "out").exists()


def test_quick_run_measures_everything_and_keeps_its_reference(
    bench: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))  # for the process that the benchmark starts
    bench.main(bench.Args(out=tmp_path, device="cpu", quick=True))
    metrics = read_metrics(tmp_path / "metrics.json")
    numbers = {key: float(value) for key, value in metrics.items() if not isinstance(value, str)}
    assert numbers["fast.cpu.80x60.fps"] > 1 and numbers["fast.cpu.80x60.batch2.device_fps"] > 1
    assert numbers["fast.cpu.80x60.psnr_db"] == numbers["fast.cpu.80x60.psnr_db.sphere"] > 30
    # Both tracers are unbiased: four times the samples halve the error, less the reference's own noise and clipping.
    for kind in ("path", "reference"):
        one, four = (numbers[f"{kind}.cpu.80x60.spp{n}.rmse_linear"] for n in (1, 4))
        assert 0.3 < four / one < 0.8
        assert numbers[f"{kind}.cpu.80x60.spp4.kernel_ms"] < numbers[f"{kind}.cpu.80x60.spp4.ms"]
    assert numbers["fast.cpu.speedup_vs_path_equal_error"] > 1
    assert numbers["bvh.cpu.rebuild_ms"] > 0 and numbers["memory.growth_mb_50"] < 20
    assert 0 < numbers["import_raytac_s"] < numbers["first_image_s"] < numbers["first_image_process_s"]
    assert read_png(tmp_path / "pareto.png").shape[1] == 1050
    assert "fast.cpu.80x60.psnr_db = " in capsys.readouterr().out

    kept = list((tmp_path / "references").iterdir())
    written = kept[0].stat().st_mtime_ns
    bench.main(bench.Args(out=tmp_path, device="cpu", quick=True, parts="error"))
    assert list((tmp_path / "references").iterdir()) == kept and kept[0].stat().st_mtime_ns == written
    assert read_metrics(tmp_path / "metrics.json")["fast.cpu.80x60.psnr_db"] == metrics["fast.cpu.80x60.psnr_db"]
