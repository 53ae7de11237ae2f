"""Every Python block of the documents and every notebook runs, each page in a process of its own."""

from __future__ import annotations

import json
import re
import shutil
from importlib.util import find_spec
from pathlib import Path

import pytest

from raytac.device import cuda_missing
from tests.forked import run_forked

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
BLOCK = re.compile(r"(?:<!-- needs: ([\w ]+) -->\n)?^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)
TESTED_ELSEWHERE = {"guide/first-steps.md", "guide/own-model.md"}
"""Pages whose results are looked at: ``test_press_end_to_end.py``, ``world/test_own_model_page.py``."""
PAGES = [
    path
    for path in sorted(DOCS.rglob("*.md"))
    if "```python" in path.read_text(encoding="utf-8") and path.relative_to(DOCS).as_posix() not in TESTED_ELSEWHERE
]
NOTEBOOKS = sorted((DOCS / "notebooks").glob("*.ipynb"))


def lacking(needs: str) -> list[str]:
    """Those of ``cuda`` and package names that this machine has not."""
    return [need for need in needs.split() if (cuda_missing() if need == "cuda" else find_spec(need) is None)]


def blocks(text: str) -> list[str]:
    """Python blocks that this machine can run."""
    return [code for needs, code in BLOCK.findall(text) if not lacking(needs)]


def run(code: str, folder: Path) -> None:
    """Run a program in ``folder``, with this checkout's packages, on the CPU; pages name files as a checkout has them."""
    (folder / "examples").symlink_to(ROOT / "examples")
    (folder / "page.py").write_text(code, encoding="utf-8")
    result = run_forked("page.py", cwd=folder, env={"MPLBACKEND": "Agg"})
    assert result.returncode == 0, result.stderr[-3000:]


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.relative_to(DOCS).as_posix())
def test_the_blocks_of_a_page_run(path: Path, tmp_path: Path) -> None:
    shutil.copy(ROOT / "examples" / "gripper.xml", tmp_path)
    codes = blocks(path.read_text(encoding="utf-8"))
    if not codes:
        pytest.skip("every block needs what this machine has not")
    run("\n".join(codes), tmp_path)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
def test_a_notebook_runs(path: Path, tmp_path: Path) -> None:
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert all(not cell["outputs"] and cell["execution_count"] is None for cell in code), "clear the outputs before committing"
    run("\n\n".join("".join(cell["source"]) for cell in code), tmp_path)


def test_a_block_that_needs_a_package_is_left_out() -> None:
    text = "```python\na = 1\n```\n\n<!-- needs: no_such_package -->\n```python\nb = 2\n```\n```toml\nc = 3\n```\n"
    assert blocks(text) == ["a = 1\n"] and lacking("json no_such_package") == ["no_such_package"]


def test_a_block_that_fails_is_seen(tmp_path: Path) -> None:
    with pytest.raises(AssertionError, match="nobody"):
        run("raise ValueError('nobody')", tmp_path)
