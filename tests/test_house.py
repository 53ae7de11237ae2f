"""The measures of the code's structure, on a package whose circles, words and docstrings are known."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from experiments import house
from raytac.io.metrics import read_metrics

FILES = {
    "raytac/__init__.py": "",
    "raytac/a.py": '"""What it is."""\nfrom raytac import b\n\nfound = left_side = 1\n\n\ndef way(told):\n    """Result of a search."""\n',
    "raytac/b.py": "from . import c\n\nheight = 1\n'''Where it lies [m].'''\n"
    f"width = 1\n'''{90 * 'x'}'''\nlength = 1\n'''{91 * 'x'}\n{99 * 'x'}'''\n",
    "raytac/c.py": "def f():\n    from raytac.a import found\n    return found\n",
    "raytac/deep/__init__.py": "",
    "raytac/deep/one.py": "from ..deep.two import x\nfrom ..a import way\n",
    "raytac/deep/two.py": "import raytac.deep.one\nimport json\n\nx = 1\n",
    "raytac/long.py": "pass\n" * 401,
    "ipc/__init__.py": "",
    "ipc/alone.py": "class World:\n    held: int = 1\n    '''Whether it is held.'''\n",
}


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for name, text in FILES.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return tmp_path


def test_counts_of_a_known_package(root: Path) -> None:
    counts, details = house.measure(root)
    lines = {
        package: sum(text.count("\n") for name, text in FILES.items() if name.startswith(package)) for package in house.PACKAGES
    }
    assert counts == {
        "files": 10,
        "raytac_lines": lines["raytac"],
        "ipc_lines": lines["ipc"],
        "files_over_400": 1,
        "circles": 2,
        "single_importer_small_files": 4,
        "docstrings_wh": 3,
        "docstrings_long": 1,
        "words": 4,
    }
    assert details["circles"] == ["raytac.a <-> raytac.b <-> raytac.c", "raytac.deep.one <-> raytac.deep.two"]
    assert [item.split()[0] for item in details["single_importer_small_files"]] == [
        "raytac.b",
        "raytac.c",
        "raytac.deep.one",
        "raytac.deep.two",
    ]
    assert details["docstrings_wh"] == ["ipc.alone: Whether it is held.", "raytac.a: What it is.", "raytac.b: Where it lies [m]."]
    assert details["docstrings_long"] == [f"raytac.b: {91 * 'x'}"]
    assert sorted(details["words"]) == ["ipc.alone: held", "raytac.a: found", "raytac.a: told", "raytac.a: way"]


def test_files_of_a_toy_optical_mode(root: Path) -> None:
    example = root / house.EXAMPLE
    example.parent.mkdir()
    example.write_text("from raytac.optics import MODES\n@MODES.register('toy')\nclass Toy: pass\n", encoding="utf-8")
    assert house.measure(root)[1]["mode_files"] == [str(house.EXAMPLE)]
    (root / "raytac/outputs.py").write_text("OUTPUTS = ('rgb', 'toy')\n", encoding="utf-8")  # a word that means something else
    (root / "raytac/options.py").write_text("OPTICS = ('phong', 'toy')\n", encoding="utf-8")
    (example.parent / "toy_kernel.py").write_text("", encoding="utf-8")
    example.write_text("import toy_kernel\nfrom raytac.optics import register\nregister('toy')(Toy)\n", encoding="utf-8")
    assert house.measure(root)[1]["mode_files"] == [str(house.EXAMPLE), "examples/toy_kernel.py", "raytac.options"]
    example.write_text("class Toy: pass\n", encoding="utf-8")
    with pytest.raises(ValueError, match=r"own_optical_mode\.py must register"):
        house.measure(root)


def test_it_writes_metrics_in_the_common_format(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = root / "out"
    monkeypatch.setattr(sys, "argv", ["house.py", "--root", str(root), "--out", str(out)])
    house.main()
    metrics = read_metrics(out / "metrics.json")
    assert metrics["house.circles"] == 2 and metrics["device"] == "cpu" and "house.mode_files" not in metrics
    assert "# circles\nraytac.a <-> raytac.b <-> raytac.c\n" in (out / "details.txt").read_text(encoding="utf-8")
