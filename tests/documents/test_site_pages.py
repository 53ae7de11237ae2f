"""Pages of the site: what is generated, and where links lead."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
_spec = importlib.util.spec_from_file_location("site_pages", ROOT / "docs" / "build" / "pages.py")
assert _spec is not None and _spec.loader is not None
pages = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(pages)


def test_links_to_files_of_the_repository_become_links_of_the_site() -> None:
    text = (
        "[keys](../../scenes/README.md#rules) [one](../../examples/own_pad.py) [all](../../examples) [code](../../raytac/se3.py)"
    )
    expected = "[keys](../reference/files.md#rules) [one](../examples.md#own_padpy) [all](../examples.md) code"
    assert pages.relink(text, "guide/page.md") == expected


def test_generated_pages_link_from_where_their_file_lies() -> None:
    assert (
        pages.relink("[exposure](../docs/guide/own-sensor.md#exposure)", "reference/files.md")
        == "[exposure](../guide/own-sensor.md#exposure)"
    )


def test_links_in_code_and_to_other_hosts_stay() -> None:
    text = "```python\na = [b](c)\n```\n[far](https://example.org/a.md)\n"
    assert pages.relink(text, "guide/page.md") == text


def test_every_public_name_has_a_page() -> None:
    names = pages.packages()
    assert names["raytac"]["TactileSensor"] == "raytac.sensor.tactile_sensor.TactileSensor"
    text = pages.package_page("raytac.sensor", names["raytac.sensor"])
    assert "::: raytac.sensor.tactile_sensor.TactileSensor\n" in text
    front = pages.package_page("raytac", names["raytac"])
    assert "::: raytac.sensor.tactile_sensor" not in front and "`TactileSensor`: [raytac.sensor](raytac.sensor.md)" in front


def test_every_page_of_the_site_is_in_its_menu(tmp_path: Path) -> None:
    menu = set(re.findall(r"[\w/-]+\.md", (ROOT / "mkdocs.yml").read_text(encoding="utf-8").split("\nnav:")[1]))
    written = {path.relative_to(pages.DOCS).as_posix() for path in pages.DOCS.rglob("*.md")}
    written |= {name for name in pages.generated() if not name.startswith(pages.PACKAGES)}
    assert written == menu


@pytest.mark.slow
def test_the_command_line_page_has_every_command_and_option() -> None:
    text = pages.command_line()
    for heading in ("raytac press", "raytac calibrate", "raytac compare-real", "raytac doctor"):
        assert f"## {heading}\n" in text
    assert "--no-shadows" in text and "\x1b" not in text
