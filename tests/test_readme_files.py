"""What the README shows as a file is one, and what it links is there."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

from raytac.specs import load_press

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_mesh_scene_of_the_readme_loads(tmp_path: Path) -> None:
    (text,) = re.findall(r"```toml\n(.*?)```", README, flags=re.S)
    (tmp_path / "scene.toml").write_text(text, encoding="utf-8")
    shutil.copy(ROOT / "scenes" / "meshes" / "gear.stl", tmp_path / "part.stl")
    scene = load_press(tmp_path / "scene.toml")
    assert scene.object.kind == "mesh" and scene.trajectory[0].depth == 0.8e-3


def test_every_page_is_linked() -> None:
    pages = {f"docs/{path.name}" for path in (ROOT / "docs").glob("*.md")}
    assert pages <= set(re.findall(r"\]\(([^)#]+)\)", README))
