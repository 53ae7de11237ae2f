"""The benchmark of the table modes, small, from end to end."""

from __future__ import annotations

from pathlib import Path

import pytest

from experiments import bench_taxim as bench
from raytac.errors import InputError, RaytacError
from raytac.io.metrics import read_metrics
from raytac.report import measure
from tests.clock import steady_clock


@pytest.mark.parametrize(("options", "error"), [({"scenes": " , "}, InputError), ({"scenes": "shpere"}, RaytacError)])
def test_bad_options_are_refused_before_anything_is_written(tmp_path: Path, options: dict, error: type[Exception]) -> None:
    with pytest.raises(error):
        bench.main(bench.Args(out=tmp_path / "out", device="cpu", **options))
    assert not (tmp_path / "out").exists()


def test_quick_run_measures_speed_and_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("RAYTAC_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(
        bench, "peer", lambda *_: {"peer.cpu.80x60.ms_per_frame": 50.0, "peer_shadow.cpu.80x60.ms_per_frame": 90.0}
    )
    steady_clock(monkeypatch, measure, 20e-3)
    bench.main(bench.Args(out=tmp_path / "out", device="cpu", quick=True))
    metrics = read_metrics(tmp_path / "out" / "metrics.json")
    numbers = {key: float(value) for key, value in metrics.items() if not isinstance(value, str)}
    for family in ("taxim", "taxim_shadow", "phong"):
        assert numbers[f"{family}.cpu.80x60.fps"] == pytest.approx(50.0) == 1e3 / numbers[f"{family}.cpu.80x60.ms_per_frame"]
        for part in ("", "device_"):
            assert numbers[f"{family}.cpu.80x60.batch2.{part}fps"] == pytest.approx(100.0)
            assert numbers[f"{family}.cpu.80x60.batch2.{part}ms_per_frame"] == pytest.approx(10.0)
    assert numbers["taxim.vs_peer_speedup"] == pytest.approx(2.5)
    assert numbers["taxim.sphere.psnr_box_db"] > 28 and numbers["taxim_shadow.sphere.contact_mae_levels"] < 12
    assert "taxim.sphere.psnr_box_db = " in capsys.readouterr().out
    assert len(list((tmp_path / "cache" / "tables").iterdir())) == 1
