"""Figures over all scenes of a comparison: summary by mode, equal error, flat keys."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from raytac.io.metrics import Metric
from raytac.report.compare.marker_error import marker_error_metrics
from raytac.report.compare.run import REGIONS, Comparison
from raytac.report.compare.store import Row
from raytac.report.image_error import METRICS

KEYS = {"mae": "mae_levels", "rmse": "rmse_levels", "psnr": "psnr_db", "ssim": "ssim", "flip": "flip"}


def select(rows: Iterable[Row], **values: object) -> list[Row]:
    """Rows whose figures have these ``values``."""
    return [row for row in rows if all(row.figures[key] == value for key, value in values.items())]


def resolutions(rows: Iterable[Row]) -> list[str]:
    """Resolutions in the order of the rows, as ``320x240``."""
    return list(dict.fromkeys(str(row.figures["resolution"]) for row in rows))


def known(rows: Iterable[Row], name: str) -> list[float]:
    """Values of a numeric column, without those that are not there."""
    values = [row.figures.get(name) for row in rows]
    return [float(value) for value in values if value is not None]


@dataclass(frozen=True)
class Summary:
    """One mode at one resolution over its scenes; None where no scene has the figure."""

    resolution: str
    mode: str
    family: str
    label: str
    words: str
    """The family for a reader."""
    short: str
    """Label of its point in a figure."""
    unbiased: bool
    spp: int | None
    device: str
    scenes: int
    ms: float
    """Median over scenes of the median at batch 1 [ms]."""
    batch: int
    batch_ms_per_frame: float | None
    first_image_s: float | None
    memory_mib: float | None
    memory_mib_per_env: float | None
    errors: dict[str, float]
    """Means over scenes, such as ``frame_mae``; RMSE, and PSNR by it, over the mean square.
    ``frame_psnr_worst`` is the PSNR of the worst scene."""
    at_noise: bool
    """True if the noise of the reference makes up half of the mean square error in some scene."""


def summaries(rows: Sequence[Row]) -> list[Summary]:
    """A summary for each resolution and mode, in the order of the rows."""
    keys = dict.fromkeys((str(row.figures["resolution"]), str(row.figures["mode"])) for row in rows)
    return [_summary(select(rows, resolution=resolution, mode=mode)) for resolution, mode in keys]


def _summary(rows: list[Row]) -> Summary:
    first: dict[str, Any] = rows[0].figures

    def middle(name: str) -> Any:
        values = known(rows, name)
        return statistics.median(values) if values else None

    errors: dict[str, float] = {}
    for region in REGIONS:
        for metric in METRICS:
            values = known(rows, f"{region}_{metric}")
            if values and metric == "rmse":
                errors[f"{region}_rmse"] = float(np.sqrt(np.mean(np.square(values))))
                if errors[f"{region}_rmse"] > 0:
                    errors[f"{region}_psnr"] = float(20 * np.log10(255 / errors[f"{region}_rmse"]))
            elif values and metric == "psnr":
                errors[f"{region}_psnr_worst"] = min(values)
            elif values:
                errors[f"{region}_{metric}"] = float(np.mean(values))
    return Summary(
        **{
            name: first[name] for name in ("resolution", "mode", "family", "label", "words", "short", "unbiased", "spp", "device")
        },
        **{name: middle(name) for name in ("batch_ms_per_frame", "memory_mib", "memory_mib_per_env")},
        scenes=len(rows),
        ms=statistics.median(known(rows, "ms")),
        batch=int(first["batch"] or 0),
        first_image_s=next(iter(known(rows, "first_image_s")), None),
        errors=errors,
        at_noise=any(row.figures["at_noise"] is True for row in rows),
    )


@dataclass(frozen=True)
class EqualError:
    """Cost of a sampled family at the error of ``fast`` in one scene."""

    resolution: str
    scene: str
    family: str
    target_rmse: float
    """RMSE of ``fast`` over the frame [levels], the reference's noise included."""
    spp: float | None
    """Samples a pixel at that error; None if it is not reached and must not be extrapolated."""
    ratio: float | None
    """Time at those samples over the time of ``fast``, whole frames at batch 1."""
    how: str
    """``interpolated``, ``extrapolated as 1/√spp`` or ``not reached``."""


def equal_errors(rows: Sequence[Row]) -> list[EqualError]:
    """For each resolution, scene and sampled family: samples and time at the error of ``fast``.

    A denoised image is biased, so that its error need not fall on: beyond the last measured point nothing is said of it.
    """
    costs = []
    families = dict.fromkeys(str(row.figures["family"]) for row in rows if row.figures["spp"] is not None)
    for resolution in resolutions(rows):
        for fast in select(rows, resolution=resolution, mode="fast"):
            scene, target, ms = fast.figures["scene"], float(fast.figures["frame_rmse"] or 0), float(fast.figures["ms"] or 0)
            for family in families:
                sampled = select(rows, resolution=resolution, scene=scene, family=family)
                sampled.sort(key=lambda row: int(row.figures["spp"] or 0))
                if sampled and target > 0:
                    costs.append(_equal_error(resolution, str(scene), family, target, ms, sampled))
    return costs


def _equal_error(resolution: str, scene: str, family: str, target: float, ms: float, sampled: list[Row]) -> EqualError:
    spp = [int(row.figures["spp"] or 0) for row in sampled]
    errors, times = known(sampled, "frame_rmse"), known(sampled, "ms")
    reached = target >= errors[-1]
    if not reached and not sampled[0].figures["unbiased"]:
        return EqualError(resolution, scene, family, target, None, None, "not reached")
    needed = spp_for_error(spp, errors, target)
    how = "interpolated" if reached else "extrapolated as 1/√spp"
    return EqualError(resolution, scene, family, target, needed, cost_at(spp, times, needed) / ms, how)


def compare_metrics(comparison: Comparison) -> dict[str, Metric]:
    """Everything of ``metrics.json`` but ``wall_s``.

    ``<family>.<device>.<resolution>[.spp<n>].<figure>[.<scene>]``, as in experiments/bench_optics.py where they mean the same.
    """
    settings, rows = comparison.settings, comparison.rows
    metrics: dict[str, Metric] = {
        "command": "compare",
        "sensor": settings.sensor,
        "scenes": ",".join(settings.scenes),
        "scenes_pending": len(comparison.pending),
        "resolutions": ",".join(f"{w}x{h}" for w, h in settings.resolutions),
        "device": comparison.device,
        "seed": settings.seed,
        "reference.spp": settings.reference_spp,
        "rows": len(rows),
        "rows_measured_in_this_run": comparison.measured,
        **comparison.facts,
        **marker_error_metrics(comparison.markers),
    }
    for summary in summaries(rows):
        key = _key(summary.family, summary.device, summary.resolution, summary.spp)
        metrics |= {f"{key}.ms": summary.ms, f"{key}.fps": 1e3 / summary.ms}
        optional = {
            **{
                name: getattr(summary, name)
                for name in ("batch_ms_per_frame", "first_image_s", "memory_mib", "memory_mib_per_env")
            },
            "psnr_db": summary.errors.get("frame_psnr_worst"),
            "mae_levels": summary.errors.get("frame_mae"),
            "rmse_levels": summary.errors.get("frame_rmse"),
        }
        metrics |= {f"{key}.{name}": value for name, value in optional.items() if value is not None}
        if summary.batch_ms_per_frame is not None:
            metrics[f"{key}.batch"] = summary.batch
            metrics[f"{key}.numpy_ms_per_frame"] = min(summary.ms, summary.batch_ms_per_frame)
    for row in rows:
        metrics |= _row_metrics(row)
    for equal in equal_errors(rows):
        if equal.spp is not None and equal.ratio is not None:
            base = f"{comparison.device}.{equal.resolution}"
            metrics[f"{equal.family}.{base}.spp_for_equal_error.{equal.scene}"] = equal.spp
            metrics[f"fast.{base}.time_ratio_{equal.family}_equal_error.{equal.scene}"] = equal.ratio
            metrics[f"fast.{base}.time_ratio_{equal.family}_equal_error_how.{equal.scene}"] = equal.how
    for shadow in ("", "_shadow"):
        metrics |= _against_peer(rows, shadow)
    metrics |= {f"left_out.{one.mode}.{one.resolution}": one.reason for one in comparison.left_out}
    return metrics


def _key(family: str, device: object, resolution: object, spp: object) -> str:
    return f"{family}.{device}.{resolution}" + ("" if spp is None else f".spp{spp}")


def _row_metrics(row: Row) -> dict[str, Metric]:
    figures, metrics = row.figures, {}
    scene = figures["scene"]
    key = _key(str(figures["family"]), figures["device"], figures["resolution"], figures["spp"])
    metrics[f"{key}.ms.{scene}"] = figures["ms"]
    for region in REGIONS:
        prefix = "" if region == "frame" else f"{region}_"
        for metric in METRICS:
            metrics[f"{key}.{prefix}{KEYS[metric]}.{scene}"] = figures[f"{region}_{metric}"]
    if figures["family"] == "fast":
        base = f"reference.{figures['resolution']}"
        metrics[f"{base}.noise_levels.{scene}"] = figures["noise_frame_rmse"]
        metrics[f"{base}.noise_psnr_db.{scene}"] = figures["noise_frame_psnr"]
    return {name: value for name, value in metrics.items() if isinstance(value, (int, float, str))}


def _against_peer(rows: Sequence[Row], shadow: str) -> dict[str, Metric]:
    """Time of the package over ours at the largest common resolution, batch 1, median of scenes."""
    metrics: dict[str, Metric] = {}
    for resolution in resolutions(rows):
        here = select(rows, resolution=resolution)
        ours, peers = (known(select(here, family=f"{family}{shadow}"), "ms") for family in ("taxim", "peer"))
        if ours and peers:
            metrics[f"taxim{shadow}.vs_peer_speedup"] = statistics.median(peers) / statistics.median(ours)
            metrics[f"taxim{shadow}.vs_peer_resolution"] = resolution
    return metrics


def spp_for_error(spp: Sequence[int], errors: Sequence[float], target: float) -> float:
    """Samples a pixel at which path tracing has the error ``target``, at least ``spp[0]``.

    Between the measured points log error is linear in log spp; beyond the last, error falls as spp^−1/2.
    """
    if target < errors[-1]:
        return float(spp[-1] * (errors[-1] / target) ** 2)
    falling = np.maximum.accumulate(-np.log(errors))
    return float(np.exp(np.interp(-np.log(target), falling, np.log(spp))))


def cost_at(spp: Sequence[int], ms: Sequence[float], samples: float) -> float:
    """Time [ms] at ``samples`` samples: linear between points, proportional beyond the last."""
    return float(ms[-1] * samples / spp[-1]) if samples > spp[-1] else float(np.interp(samples, spp, ms))
