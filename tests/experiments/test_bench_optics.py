"""The benchmark of the optics: a small run from end to end."""

from __future__ import annotations

from pathlib import Path

import pytest

from experiments import bench_optics as bench
from raytac.errors import InputError
from raytac.io.images import read_png
from raytac.io.metrics import read_metrics
from raytac.report import measure
from tests import coarse_figures
from tests.clock import steady_clock


@pytest.mark.parametrize("options", [{"parts": "speed,colour"}, {"parts": ""}, {"scenes": " , "}, {"spp": 1}])
def test_bad_options_are_refused_before_anything_is_written(tmp_path: Path, options: dict) -> None:
    with pytest.raises(InputError):
        bench.main(bench.Args(out=tmp_path / "out", device="cpu", **options))
    assert not (tmp_path / "out").exists()


def test_quick_run_measures_everything_and_keeps_its_reference(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))  # for the process that the benchmark starts
    steady_clock(monkeypatch, measure, 1.0)
    bench.main(bench.Args(out=tmp_path, device="cpu", quick=True))
    metrics = read_metrics(tmp_path / "metrics.json")
    numbers = {key: float(value) for key, value in metrics.items() if not isinstance(value, str)}
    assert numbers["fast.cpu.80x60.fps"] == 1.0 == numbers["fast.cpu.80x60.batch2.fps"] / 2
    assert numbers["fast.cpu.80x60.batch2.device_fps"] == 2.0 and numbers["fast.cpu.80x60.batch2.device_call_ms"] == 1000.0
    assert numbers["fast.cpu.80x60.psnr_db"] == numbers["fast.cpu.80x60.psnr_db.sphere"] > 27
    # That is about the noise of a reference of 16 samples a pixel.
    # Both tracers are unbiased: four times the samples halve the error, less the reference's own noise and clipping.
    for kind in ("path", "reference"):
        one, four = (numbers[f"{kind}.cpu.80x60.spp{n}.rmse_linear"] for n in (1, 4))
        assert 0.3 < four / one < 0.8
        assert numbers[f"{kind}.cpu.80x60.spp4.kernel_ms"] < numbers[f"{kind}.cpu.80x60.spp4.ms"]
    assert numbers["fast.cpu.speedup_vs_path_equal_error"] > 1
    assert numbers["bvh.cpu.rebuild_ms"] > 0 and numbers["memory.growth_mb_50"] < 20
    assert 0 < numbers["import_raytac_s"] < numbers["first_image_s"] < numbers["first_image_process_s"]
    assert read_png(tmp_path / "pareto.png").shape[1] == round(3.5 * coarse_figures.MOST)
    assert coarse_figures.asked["pareto.png"] == 300
    assert "fast.cpu.80x60.psnr_db = " in capsys.readouterr().out

    kept = list((tmp_path / "references").iterdir())
    written = kept[0].stat().st_mtime_ns
    bench.main(bench.Args(out=tmp_path, device="cpu", quick=True, parts="error"))
    assert list((tmp_path / "references").iterdir()) == kept and kept[0].stat().st_mtime_ns == written
    assert read_metrics(tmp_path / "metrics.json")["fast.cpu.80x60.psnr_db"] == metrics["fast.cpu.80x60.psnr_db"]


def test_a_checkout_is_compared_with_one_that_is_there(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="must be a checkout of this project"):
        bench.main(bench.Args(out=tmp_path / "out", device="cpu", against=tmp_path))
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_frames_of_a_checkout_in_turn_with_its_own(tmp_path: Path) -> None:
    bench.main(bench.Args(out=tmp_path, device="cpu", against=Path(__file__).parents[2]))
    metrics = read_metrics(tmp_path / "metrics.json")
    ratios = [float(value) for key, value in metrics.items() if key.startswith("fast.cpu.320x240.speedup_vs_")]
    assert len(ratios) == 1 and 0.5 < ratios[0] < 2.0
