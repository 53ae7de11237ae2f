"""Table and image sheet of ``raytac compare-real``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from raytac.io.metrics import Metric
from raytac.report.real_models import ALONE

__all__ = ["draw", "table_text"]

_ROWS = (
    ("raytrace", "ray tracer"),
    (ALONE, "ray tracer, no photograph"),
    ("taxim", "table"),
    ("mlp", "network"),
    ("phong", "Phong"),
    ("background", "background only"),
)
_SPLITS = (("left_right.", "left half → right"), ("right_left.", "right half → left"), ("shallow_deep.", "shallow → deep"))


def table_text(metrics: Mapping[str, Metric], ablations: Sequence[str]) -> str:
    """Markdown tables of the figures; errors in levels of 255."""

    def cell(key: str, digits: str = ".2f") -> str:
        value = metrics.get(key)
        return "–" if value is None else format(value, digits)

    lines = [
        "| mode | contact MAE | contact RMSE | ring MAE | box PSNR [dB] | box SSIM | frame MAE | contact, ring MAE, labelled circles | ms |"
    ]
    lines.append("|" + "---|" * 9)
    for key, name in _ROWS:
        cells = [cell(f"{key}.{m}") for m in ("contact_mae", "contact_rmse", "ring_mae", "box_psnr")]
        cells += [
            cell(f"{key}.box_ssim", ".3f"),
            cell(f"{key}.frame_mae"),
            cell(f"labelled.{key}.contact_mae") + ", " + cell(f"labelled.{key}.ring_mae"),
            cell(f"{key}.ms", ".1f"),
        ]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    lines += ["", f"Noise floor: {cell('noise_floor')}.", ""]
    shown = [(prefix, name) for prefix, name in _SPLITS if f"{prefix}raytrace.contact_mae" in metrics]
    if shown:
        lines += ["| contact MAE (ring MAE) | " + " | ".join(name for _, name in shown) + " |", "|" + "---|" * (len(shown) + 1)]
        for key, name in _ROWS:
            cells = [f"{cell(f'{prefix}{key}.contact_mae')} ({cell(f'{prefix}{key}.ring_mae')})" for prefix, _ in shown]
            lines.append(f"| {name} | {' | '.join(cells)} |")
        lines.append("")
    if ablations:
        lines += ["| ray tracer, first fold | contact MAE | ring MAE |", "|---|---|---|"]
        for name in ("nothing", *ablations):
            row = f"ablation.{name}"
            text = "nothing left out" if name == "nothing" else name.replace("_", " ")
            lines.append(f"| {text} | {cell(f'{row}.contact_mae')} | {cell(f'{row}.ring_mae')} |")
        lines.append("")
    return "\n".join(lines)


def draw(real: np.ndarray, images: list[dict[str, np.ndarray]], circles: list[np.ndarray], path: Path) -> None:
    """A row a press: the photograph, every mode that uses the one at rest, and its signed error (grey is none), cut to what is about the
    contact."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    modes = [(key, name) for key, name in _ROWS if key in images[0] and key not in (ALONE, "background")]
    columns = ["photograph", *(name for _, name in modes), *(f"{name}, error × 4" for _, name in modes)]
    with plt.rc_context({"font.size": 6.5}):
        figure, axes = plt.subplots(
            len(real), len(columns), figsize=(1.1 * len(columns), 1.12 * len(real)), squeeze=False, layout="constrained"
        )
        for line, photo, own, (x, y, r) in zip(axes, real, images, circles, strict=True):
            low_x, low_y = (max(0, int(c - 2.2 * r)) for c in (x, y))
            box = np.s_[low_y : int(y + 2.2 * r), low_x : int(x + 2.2 * r)]
            shown = [photo, *(own[key] for key, _ in modes), *(128 + 4 * (own[key].astype(float) - photo) for key, _ in modes)]
            for axis, image in zip(line, shown, strict=True):
                axis.imshow(np.clip(image[box], 0, 255).astype(np.uint8))
                axis.set(xticks=[], yticks=[])
        for axis, name in zip(axes[0], columns, strict=True):
            axis.set_title(name)
        figure.savefig(path, dpi=110)
        plt.close(figure)
