"""``scenes/README.md`` lists every key with the range that the reader enforces."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from raytac.assets import asset_root
from raytac.specs.press import POSE_SCHEMA, SCENE_SCHEMA, STAGE_SCHEMA
from raytac.specs.sensor import LED_SCHEMA, SENSOR_SCHEMA, SURFACE_SCHEMA
from raytac.specs.shape_file import OBJECT_SCHEMA
from raytac.specs.toml import ANY, Flag, Integer, Number, Schema, Text

README = asset_root("scenes") / "README.md"


def section(title: str) -> str:
    parts = re.split(r"^## ", README.read_text("utf-8"), flags=re.MULTILINE)
    return next(part for part in parts if part.startswith(title))


def ranged(schema: Schema) -> Iterator[tuple[str, str]]:
    """Keys of a schema with their range as the tables write it."""
    for key, field in schema.items():
        if isinstance(field, Flag):
            yield key, "`true` or `false`"
        elif not isinstance(field, Text):
            many = "× " if field.length == ANY else f"{field.length} × " if field.length else ""
            word = f' or `"{field.word}"`' if isinstance(field, Number) and field.word else ""
            yield key, f"{many}`{field.interval}`{word}"


def row(text: str, key: str) -> str:
    rows = [line for line in text.splitlines() if line.startswith("|") and f"`{key}`" in line.split("|")[1]]
    assert len(rows) == 1, f"{key} stands in {len(rows)} rows"
    return rows[0]


@pytest.mark.parametrize("table", [name for name in SENSOR_SCHEMA if name])
def test_sensor_keys(table: str) -> None:
    text = section("Sensor").split(f"**`[{table}]`**")[1].split("| **`[")[0]
    for key, interval in ranged({**SENSOR_SCHEMA[table], **(SURFACE_SCHEMA if table == "gelpad" else {})}):
        assert interval in row(text, key)


def test_led_keys() -> None:
    for key, interval in ranged(LED_SCHEMA):
        assert interval in row(section("Lights"), key)
    assert set(LED_SCHEMA) == set(re.findall(r"^\| `(\w+)` \|", section("Lights"), flags=re.MULTILINE))


def test_scene_keys() -> None:
    for key, field in SCENE_SCHEMA.items():
        assert isinstance(field, Text) and all(
            f"`{choice}`" in row(section("Press"), key).split("|")[2] for choice in field.choices
        )


def test_object_keys() -> None:
    text = section("Press")
    others = {"rows": "[1, 50]", "columns": "[1, 50]", "scale_m_per_unit": "(0, 10]", "tip_radius_mm": "[0, 100]"}
    for key, interval in ranged(POSE_SCHEMA):
        assert interval in row(text, key)
    for kind, schema in OBJECT_SCHEMA.items():
        assert re.findall(r"`(\w+)`", row(text, kind).split("|")[2]) == list(schema)
        for key, field in schema.items():
            if isinstance(field, Number | Integer):
                expected = others.get(key, "(0, 100]")
                assert field.interval == expected and f"`{expected}`" in text


def test_stage_keys() -> None:
    text = section("Press")
    for kind, schema in STAGE_SCHEMA.items():
        for key, interval in ranged(schema):
            where = row(text, kind) if key != "duration_s" else text
            assert f"`{key}`" in where and interval in where


def test_every_shipped_file_says_where_its_values_come_from() -> None:
    for path in (asset_root("scenes") / "sensors").glob("*.toml"):
        bare = [line for line in lines_with_values(path) if "#" not in line]
        # What is switched off or fully said by the key itself needs no source.
        assert [
            line for line in bare if not re.match(r"(lights|rows|columns|model|black_level|vignetting|white_balance) =", line)
        ] == []
    for path in asset_root("lights").glob("*.toml"):
        head = path.read_text("utf-8").split("[[led]]")[0].lower()
        assert "provenance" in head and "fit" in head, path


def lines_with_values(path: Path) -> list[str]:
    return [line for line in path.read_text("utf-8").splitlines() if re.match(r"\w+ =", line)]
