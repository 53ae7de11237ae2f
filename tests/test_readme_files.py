"""Links and files of the README and the documents."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

from raytac.specs import load_press

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
FIRST_STEPS = (ROOT / "docs" / "first-steps.md").read_text(encoding="utf-8")


def test_the_mesh_scene_of_the_first_steps_loads(tmp_path: Path) -> None:
    (text,) = re.findall(r"```toml\n(.*?)```", FIRST_STEPS, flags=re.S)
    (tmp_path / "scene.toml").write_text(text, encoding="utf-8")
    shutil.copy(ROOT / "scenes" / "meshes" / "gear.stl", tmp_path / "part.stl")
    scene = load_press(tmp_path / "scene.toml")
    assert scene.object.kind == "mesh" and scene.trajectory[0].depth == 0.8e-3


def test_every_page_is_linked_from_the_index() -> None:
    pages = {path.name for path in (ROOT / "docs").glob("*.md")} - {"index.md"}
    links = set(re.findall(r"\]\(([^)#]+)\)", (ROOT / "docs" / "index.md").read_text(encoding="utf-8")))
    assert pages <= links


@pytest.mark.parametrize("path", [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))], ids=lambda path: path.name)
def test_links_lead_to_files(path: Path) -> None:
    links = re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", path.read_text(encoding="utf-8"))
    broken = [link for link in links if not link.startswith("http") and not (path.parent / link).exists()]
    assert broken == []


def test_the_readme_is_one_page() -> None:
    assert len(README.splitlines()) <= 110
