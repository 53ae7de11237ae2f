"""Links, anchors and files of the README and the documents."""

from __future__ import annotations

import re
import shutil
import tomllib
from pathlib import Path

import pytest

from raytac.specs import load_press

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
README = (ROOT / "README.md").read_text(encoding="utf-8")
FIRST_STEPS = (DOCS / "guide" / "first-steps.md").read_text(encoding="utf-8")
PAGES = (
    sorted(ROOT.glob("*.md"))
    + [ROOT / folder / "README.md" for folder in ("scenes", "ipc", "examples")]
    + sorted(DOCS.rglob("*.md"))
)
SOURCES = [
    path
    for folder in ("raytac", "ipc", "scenes", "lights", "experiments", "examples", "tests")
    for path in sorted((ROOT / folder).rglob("*"))
    if path.suffix in (".py", ".pyi", ".toml", ".xml")
]
LINK = re.compile(r"\]\(([^)\s]+)\)")


def prose(text: str) -> str:
    """Text without blocks and spans of code, whose brackets are no links."""
    return re.sub(r"`[^`\n]*`", "", re.sub(r"^```.*?^```", "", text, flags=re.S | re.M))


def anchors(text: str) -> set[str]:
    """Anchors of a page's headings, as GitHub and the site make them."""
    result: set[str] = set()
    for heading in re.findall(r"^#{1,6} +(.+?)\s*$", re.sub(r"^```.*?^```", "", text, flags=re.S | re.M), flags=re.M):
        words = re.sub(r"\]\([^)]*\)", "", heading).lower()
        result.add(re.sub(r"[^\w\- ]", "", words).replace(" ", "-"))
    return result


def test_anchors_are_those_of_the_headings() -> None:
    text = "# The gel, [bonded](a.md) `now`\n```\n# no heading\n```\n## Zwei Größen: λ′ = μ/4\n"
    assert anchors(text) == {"the-gel-bonded-now", "zwei-größen-λ--μ4"}


def test_the_mesh_scene_of_the_first_steps_loads(tmp_path: Path) -> None:
    (text,) = re.findall(r"```toml\n(.*?)```", FIRST_STEPS, flags=re.S)
    (tmp_path / "scene.toml").write_text(text, encoding="utf-8")
    shutil.copy(ROOT / "scenes" / "meshes" / "gear.stl", tmp_path / "part.stl")
    scene = load_press(tmp_path / "scene.toml")
    assert scene.object.kind == "mesh" and scene.trajectory[0].depth == 0.8e-3


def test_every_page_is_linked_from_the_index() -> None:
    pages = {path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md")} - {"index.md"}
    links = {link.partition("#")[0] for link in LINK.findall((DOCS / "index.md").read_text(encoding="utf-8"))}
    assert pages <= links, f"link these from docs/index.md: {sorted(pages - links)}"


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_links_lead_to_files_and_headings(path: Path) -> None:
    broken = []
    for link in LINK.findall(prose(path.read_text(encoding="utf-8"))):
        if link.startswith(("http://", "https://", "mailto:")):
            continue
        name, _, anchor = link.partition("#")
        target = (path.parent / name).resolve() if name else path
        if not target.exists() or (anchor and anchor not in anchors(target.read_text(encoding="utf-8"))):
            broken.append(link)
    assert broken == []


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_pages_have_no_marks_of_a_merge(path: Path) -> None:
    marks = re.findall(r"^(?:<{7}|>{7}) .*$", path.read_text(encoding="utf-8"), flags=re.M)
    assert not marks, f"{path.relative_to(ROOT)}: {marks}"


def test_pages_that_the_code_names_exist() -> None:
    named = {
        (path.relative_to(ROOT).as_posix(), page)
        for path in SOURCES
        for page in re.findall(r"\bdocs/[\w/-]+\.md", path.read_text("utf-8"))
    }
    assert len(named) > 20
    assert sorted(f"{path}: {page}" for path, page in named if not (ROOT / page).exists()) == []


def test_every_example_is_listed() -> None:
    listed = set(LINK.findall((ROOT / "examples" / "README.md").read_text(encoding="utf-8")))
    assert {path.name for path in (ROOT / "examples").glob("*.py")} <= listed, "list it in examples/README.md"


def test_the_readme_is_one_page() -> None:
    assert len(README.splitlines()) <= 110


def test_the_documents_stay_readable_in_a_day() -> None:
    """Sentences of ``docs``, without tables, code and addresses: about 150 kB."""
    sentences = 0
    for path in DOCS.rglob("*.md"):
        text = re.sub(r"^```.*?^```|<!--.*?-->", "", path.read_text(encoding="utf-8"), flags=re.S | re.M)
        lines = [line for line in LINK.sub("]", text).splitlines() if not line.lstrip().startswith("|")]
        sentences += len("\n".join(lines).encode())
    assert 100_000 < sentences < 165_000, f"{sentences:,} bytes: shorten a page for what is added"


def test_the_container_is_made_of_what_is_here() -> None:
    text = (ROOT / "Dockerfile").read_text(encoding="utf-8")
    copied = [name for line in re.findall(r"^COPY (.+)$", text, flags=re.M) for name in line.split()[:-1]]
    assert {"pyproject.toml", "raytac", "ipc", "scenes", "lights"} <= set(copied)
    assert [name for name in copied if not (ROOT / name).exists()] == []
    known = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    extras = {extra for names in re.findall(r"EXTRAS=([\w,]+)", text) for extra in names.split(",")}
    assert {"ipc", "robots", "gpu"} <= extras <= set(known)
    # What Dr.Jit loads beyond a bare image, and its kernels in the volume that the file tells to mount.
    assert "libatomic1" in text and "-v raytac-cache:/root/.cache" in text and "DRJIT_CACHE_DIR=/root/.cache/" in text
