"""Tables of measurements: pages agree with their metrics, and how a table is made."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import pytest

from raytac.io.metrics import check_metrics

ROOT = Path(__file__).parents[2]
_spec = importlib.util.spec_from_file_location("tables", ROOT / "docs" / "build" / "tables.py")
assert _spec is not None and _spec.loader is not None
tables = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(tables)

PAGE = """# Title

<!-- table: presses
| scene | force [N] | height |
| ball, coin = coin (relief) | {*.force:.1f} | {*.height_um:.0f} µm, {*.steps} |
| all | {total.force:.2f} | |
-->
old
<!-- end -->

Text with {braces}.
"""
VALUES = {
    "measured.command": "raytac press ball", "measured.date": "2026-01-02", "device": "cpu", "machine.cpu": "AMD EPYC", "machine.cores": 2,
    "ball.force": 1.26, "ball.height_um": 0.7, "ball.steps": 3, "coin.force": 23.0, "coin.height_um": 12.4, "coin.steps": 4,
    "total.force": 24.26, "wall_s": 1.0, "versions.raytac": "0.1.0",
}  # fmt: skip


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "presses.json").write_text(json.dumps(VALUES), encoding="utf-8")
    return tmp_path


def test_pages_agree_with_their_metrics() -> None:
    paths = tables.pages()
    assert len(paths) >= 1
    for path in paths:
        text = path.read_text(encoding="utf-8")
        assert tables.filled(text) == text, f"{path} differs from docs/measurements/metrics: run make tables"


def test_every_file_of_metrics_is_sound_and_shown_by_a_page() -> None:
    blocks = [match for path in tables.pages() for match in tables.BLOCK.finditer(path.read_text(encoding="utf-8"))]
    shown = {name for match in blocks for name in match[2].split()}
    files = sorted(tables.METRICS.glob("*.json"))
    assert {path.stem for path in files} == shown
    for path in files:
        check_metrics(tables.read(path))


def test_a_table_has_its_values_and_their_source(folder: Path) -> None:
    text = tables.filled(PAGE, folder)
    assert "`raytac press ball` · 2-core AMD EPYC · 2026-01-02" in text and "old" not in text
    assert "| ball | 1.3 | 1 µm, 3 |\n| coin (relief) | 23.0 | 12 µm, 4 |\n| all | 24.26 |  |" in text
    assert tables.filled(text, folder) == text and text.endswith("Text with {braces}.\n")
    (folder / "presses.json").write_text(json.dumps(VALUES | {"ball.force": 2.0}), encoding="utf-8")
    assert tables.filled(text, folder) != text


def test_a_table_of_several_files_names_them_in_its_keys(folder: Path) -> None:
    (folder / "again.json").write_text(json.dumps(VALUES | {"ball.force": 2.0}), encoding="utf-8")
    page = "<!-- table: presses again\n| a | b |\n| {presses.ball.force} | {again.ball.force} |\n-->\n<!-- end -->\n"
    text = tables.filled(page, folder)
    assert "| 1.26 | 2.0 |" in text and text.count("raytac press ball") == 1


def test_what_cannot_be_filled_is_named(folder: Path) -> None:
    for page, said in (
        (PAGE.replace("table: presses", "table: nothing"), "nothing.json: there is no such file"),
        (PAGE.replace("{*.force:.1f}", "{*.weight}"), "there is no 'ball.weight'"),
        (PAGE.replace("| force [N] ", ""), "must have 2 cells"),
    ):
        with pytest.raises(tables.TableError, match=said):
            tables.filled(page, folder)
    lacking = {key: value for key, value in VALUES.items() if key != "measured.date"}
    (folder / "presses.json").write_text(json.dumps(lacking), encoding="utf-8")
    with pytest.raises(tables.TableError, match=r"measured\.date"):
        tables.filled(PAGE, folder)


def test_metrics_of_a_run_are_kept_with_command_and_date(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = tmp_path / "metrics.json"
    run.write_text(json.dumps({key: value for key, value in VALUES.items() if not key.startswith("measured")}), encoding="utf-8")
    monkeypatch.setattr(tables, "METRICS", tmp_path / "metrics")
    values = tables.read(tables.add(run, "presses", "raytac press ball --device cpu"))
    assert values["measured.command"] == "raytac press ball --device cpu" and values["ball.force"] == 1.26
    assert str(values["measured.date"]).startswith("20")
    run.write_text("{}", encoding="utf-8")
    with pytest.raises(tables.TableError, match=r"metrics\.json: must have the key 'device'"):
        tables.add(run, "other", "raytac press ball")
    assert [path.name for path in tables.METRICS.iterdir()] == ["presses.json"]
