"""Files of a comparison: report, figures, sheets of images, table, metrics."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

from raytac.io.folder import result_folder
from raytac.io.metrics import write_metrics
from raytac.report.compare.metrics import compare_metrics, equal_errors, resolutions, select, summaries
from raytac.report.compare.run import REGIONS, Comparison
from raytac.report.image_error import FLIP_PPD, RING_WIDTH, has_flip

FILES = ("report.html", "pareto.png", "results.parquet", "metrics.json")
"""Files of every comparison besides sheets of scenes, ``rows/`` and ``references/``."""
TEMPLATE = "compare_report.html.j2"


def write_comparison(comparison: Comparison, out: Path, wall_s: float) -> list[Path]:
    """Write all files of the report into ``out`` at once, in place of those of an earlier run.

    Sheets of other scenes are removed. Returns the files written. ``wall_s`` is the time of this run.
    """
    from raytac.report.compare.figures import write_pareto, write_sheet_of_scene

    earlier = [path.name for path in out.glob("sheet_*.png")] if out.is_dir() else []
    with result_folder(out, (*FILES, *earlier)) as folder:
        write_pareto(comparison, folder / "pareto.png")
        sheets = []
        for scene, resolution in comparison.references:
            path = folder / f"sheet_{scene}_{resolution}.png"
            write_sheet_of_scene(comparison, scene, resolution, path)
            sheets.append((scene, resolution, path))
        page = report_html(comparison, folder / "pareto.png", sheets)
        (folder / "report.html").write_text(page, encoding="utf-8")
        write_parquet(comparison, folder / "results.parquet")
        write_metrics(folder / "metrics.json", compare_metrics(comparison) | {"wall_s": wall_s})
        names = sorted(path.name for path in folder.iterdir())
    return [out / name for name in names]


def write_parquet(comparison: Comparison, path: Path) -> None:
    """One row per scene, resolution and mode; machine and versions are in the schema's metadata."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns = list(dict.fromkeys(name for row in comparison.rows for name in row.figures))
    fields = [pa.field(name, _column_type(pa, [row.figures.get(name) for row in comparison.rows])) for name in columns]
    facts = {key: str(value) for key, value in comparison.facts.items()}
    schema = pa.schema(fields, metadata=facts)
    pq.write_table(pa.Table.from_pylist([row.figures for row in comparison.rows], schema=schema), str(path))


def _column_type(pa: Any, values: list[Any]) -> Any:
    """Type of a column that may have nulls; a column of nulls alone is a float."""
    there = [value for value in values if value is not None]
    for kind, arrow in ((bool, pa.bool_()), (str, pa.string()), (int, pa.int64())):
        if there and all(isinstance(value, kind) for value in there):
            return arrow
    return pa.float64()


def report_html(comparison: Comparison, pareto: Path, sheets: list[tuple[str, str, Path]]) -> str:
    """The page, with its pictures inside; ``sheets`` are (scene, resolution, PNG)."""
    import jinja2

    rows, settings = comparison.rows, comparison.settings
    summary = summaries(rows)
    templates = jinja2.FileSystemLoader(Path(__file__).parent)
    environment = jinja2.Environment(loader=templates, autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True)
    flip = any(row.figures["frame_flip"] is not None for row in rows)
    figures = [row.figures for row in rows]
    noise = list({(f["scene"], f["resolution"]): f for f in figures if f["noise_frame_rmse"] is not None}.values())
    scenes = ", ".join(dict.fromkeys(scene for scene, _ in comparison.references))
    return environment.get_template(TEMPLATE).render(
        sensor=rows[0].figures["sensor"] if rows else settings.sensor,
        device=comparison.device,
        scenes=scenes,
        pareto=_embedded(pareto),
        tables=[
            {
                "resolution": resolution.replace("x", " × "),
                "summaries": [s for s in summary if s.resolution == resolution],
            }
            for resolution in resolutions(rows)
        ],
        batch=next((s.batch for s in summary), 0),
        settings=settings,
        pending=comparison.pending,
        has_flip=has_flip(),
        flip_ppd=f"{FLIP_PPD:.2f}",
        ring_mm=f"{1e3 * RING_WIDTH:g}",
        flip=flip,
        errors_wide=4 if flip else 3,
        any_at_noise=any(s.at_noise for s in summary),
        noise=noise,
        reference_spp=f"{settings.reference_spp:,}",
        equal=equal_errors(rows),
        families={f["family"]: f["words"] for f in figures},
        left_out=comparison.left_out,
        markers=comparison.markers,
        sheets=[{"scene": scene, "resolution": size.replace("x", " × "), "png": _embedded(path)} for scene, size, path in sheets],
        groups=[
            {
                "scene": scene,
                "resolution": size.replace("x", " × "),
                "rows": [row.figures for row in chosen],
                "notes": [(row.figures["label"], row.figures["note"]) for row in chosen if row.figures["note"]],
            }
            for scene, size in comparison.references
            for chosen in [select(rows, scene=scene, resolution=size)]
        ],
        regions=REGIONS,
        facts=sorted(comparison.facts.items()),
    )


def _embedded(path: Path) -> str:
    return base64.b64encode(path.read_bytes()).decode("ascii")
