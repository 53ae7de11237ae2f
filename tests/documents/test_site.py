"""The site builds without a warning and loads nothing from other hosts, where its builder is installed (``raytac[docs]``)."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

pytest.importorskip("zensical")


@pytest.mark.slow
def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    subprocess.run([sys.executable, "docs/build/pages.py", str(tmp_path / "pages")], cwd=ROOT, check=True)
    config = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    config = re.sub(r"^docs_dir: .*$", "docs_dir: pages", config, flags=re.MULTILINE)
    config = re.sub(r"^site_dir: .*$", "site_dir: site", config, flags=re.MULTILINE)
    (tmp_path / "mkdocs.yml").write_text(config.replace("paths: [.]", f"paths: [{ROOT}]"), encoding="utf-8")
    build = [sys.executable, "-m", "zensical", "build", "--strict", "--clean", "--config-file", str(tmp_path / "mkdocs.yml")]
    result = subprocess.run(build, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert result.returncode == 0, result.stdout + result.stderr
    pages = sorted((tmp_path / "site").rglob("*.html"))
    assert {"index.html", "command-line.html", "raytac.sensor.html"} <= {page.name for page in pages}
    loaded = [
        tag
        for page in pages
        for tag in re.findall(r'<(?:script|img)[^>]*src="https?:[^>]*>|<link[^>]*href="https?:[^>]*>', page.read_text("utf-8"))
    ]
    assert [tag for tag in loaded if "canonical" not in tag] == []
    assert "TactileSensor.press" in (tmp_path / "site" / "reference" / "python" / "raytac.sensor.html").read_text("utf-8")
