"""Figures over scenes: summaries and time at equal error, on rows whose answers are known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from raytac.report.compare.figures import error_range, signed_error
from raytac.report.compare.metrics import equal_errors, summaries
from raytac.report.compare.run import REGIONS
from raytac.report.compare.store import Row, Value
from raytac.report.image_error import METRICS


def row(mode: str, rmse: float | None, ms: float, scene: str = "sphere", **more: Value) -> Row:
    family, _, spp = mode.partition(".spp")
    figures: dict[str, Value] = {"scene": scene, "resolution": "32x24", "mode": mode, "family": family, "label": mode}
    figures |= {"spp": int(spp) if spp else None, "device": "cpu", "ms": ms, "batch": 8, "batch_ms_per_frame": None}
    figures |= {"words": family, "short": family, "unbiased": family in ("reference", "path")}
    figures |= {"first_image_s": None, "memory_mib": None, "memory_mib_per_env": None, "at_noise": False}
    figures |= {f"{region}_{metric}": None for region in REGIONS for metric in METRICS}
    if rmse is not None:
        figures |= {"frame_rmse": rmse, "frame_mae": 0.8 * rmse, "frame_psnr": 20 * math.log10(255 / rmse)}
    return Row(figures | more, np.zeros((24, 32, 3), np.uint8))


def sweep(family: str, at_one: float, power: float = 0.5) -> list[Row]:
    """Error at_one · spp^−power, 10 ms and 2 ms a sample."""
    return [row(f"{family}.spp{n}", at_one * n**-power, 10.0 + 2.0 * n) for n in (1, 4, 16, 64)]


def test_equal_error_beyond_the_sweep_is_extrapolated_and_says_so() -> None:
    (found,) = equal_errors([row("fast", 1.0, 5.0), *sweep("path", 80.0)])
    assert found.spp == pytest.approx(6400.0) and found.how == "extrapolated as 1/√spp"
    assert found.ratio == pytest.approx((10 + 2 * 64) * 100 / 5.0)  # time grows in proportion beyond the last point


def test_equal_error_within_the_sweep_is_interpolated() -> None:
    (found,) = equal_errors([row("fast", 4.0, 5.0), *sweep("reference", 16.0)])
    assert found.spp == pytest.approx(16.0) and found.how == "interpolated" and found.ratio == pytest.approx(42.0 / 5.0)


def test_a_biased_mode_is_never_extrapolated() -> None:
    (found,) = equal_errors([row("fast", 1.0, 5.0), *sweep("reference_denoised", 6.0, 0.1)])
    assert found.spp is None and found.ratio is None and found.how == "not reached"


def test_equal_error_is_told_scene_by_scene() -> None:
    rows = [row("fast", 1.0, 5.0), row("fast", 2.0, 5.0, "coin"), *sweep("path", 80.0)]
    rows += [row(f"path.spp{n}", 40.0 * n**-0.5, 10.0 + 2.0 * n, "coin") for n in (1, 4, 16, 64)]
    assert {one.scene: one.spp for one in equal_errors(rows)} == pytest.approx({"sphere": 6400.0, "coin": 400.0})


def test_summary_takes_medians_of_times_and_mean_squares_of_errors() -> None:
    rows = [row("fast", rmse, ms, scene) for rmse, ms, scene in ((3.0, 5.0, "a"), (4.0, 7.0, "b"), (5.0, 30.0, "c"))]
    rows[1].figures["at_noise"] = True
    (found,) = summaries(rows)
    assert found.ms == 7.0 and found.scenes == 3 and found.at_noise
    assert found.errors["frame_rmse"] == pytest.approx(math.sqrt(50 / 3)) and found.errors["frame_mae"] == pytest.approx(3.2)
    assert found.errors["frame_psnr"] == pytest.approx(20 * math.log10(255 / math.sqrt(50 / 3)))
    assert found.errors["frame_psnr_worst"] == pytest.approx(20 * math.log10(255 / 5))
    assert "contact_mae" not in found.errors


def test_a_mode_without_errors_keeps_its_time() -> None:
    (found,) = summaries([row("peer", None, 6.0)])
    assert found.ms == 6.0 and not found.errors


def test_signed_error_keeps_its_sign_and_its_range_is_round() -> None:
    reference = np.full((4, 5, 3), 100, np.uint8)
    assert (signed_error(reference - 30, reference) == -30).all() and (signed_error(reference + 6, reference) == 6).all()
    assert (
        error_range([]) == 2.0 and error_range([np.full((4, 5), -6.0)]) == 10.0 and error_range([np.full((4, 5), 300.0)]) == 100.0
    )
