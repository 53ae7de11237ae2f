"""Marks by place name what is there, and what their packages are is kept from tests that do not have them."""

from __future__ import annotations

import importlib
import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests import marks

TESTS = Path(__file__).parent
QUICK = "not (slow or gpu or renderer or solver or script)"


@pytest.mark.parametrize(("mark", "place"), [(mark, place) for mark, places in marks.PLACES.items() for place in places])
def test_every_place_exists(mark: str, place: str) -> None:
    assert (TESTS / place).exists()
    assert mark in marks.marks_of(TESTS / place) and mark in marks.marks_of(TESTS / place / "test_inside.py")


def test_a_place_is_no_part_of_a_name() -> None:
    assert marks.marks_of(TESTS / "optics_of_others" / "test_x.py") == [] == marks.marks_of(Path("/elsewhere/optics/test_x.py"))


def test_no_plugin_of_pytest_imports_numpy_before_its_threads_are_limited() -> None:
    """Else a test in one process waits busily: fits by small matrices take several times their time. See addopts of pyproject.toml."""
    code = "import sys, pytest; pytest.main(['--collect-only', '-q', 'tests/test_words.py']); from tests import one_thread as o; "
    environment = {
        name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS") and "PYTEST" not in name
    }
    command = [sys.executable, "-c", code + "sys.exit('NumPy came first' if o.NUMPY_WAS_FIRST else 0)"]
    done = subprocess.run(command, cwd=TESTS.parent, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("expression", "deselected"),
    [
        (QUICK, True),
        ("not renderer", True),
        ("renderer", False),
        ("not slow and not gpu", False),
        ("", False),
        ("not solver", False),
    ],
)
def test_what_an_expression_leaves_out(expression: str, deselected: bool) -> None:
    assert marks.is_deselected("renderer", expression) is deselected


def test_a_package_of_a_missing_mark_is_found_and_named_but_not_imported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "meta_path", list(sys.meta_path))
    for package in ("mitsuba", "drjit", "warp"):
        monkeypatch.delitem(sys.modules, package, raising=False)
    marks.block("not renderer")
    assert importlib.util.find_spec("drjit") is not None
    for package in ("mitsuba", "drjit"):
        with pytest.raises(pytest.fail.Exception, match=f"imports {package} without the mark 'renderer'.*tests/marks.py"):
            importlib.import_module(package)
    assert "drjit" not in sys.modules
    assert marks.block("not slow") is None


def collected(*places: str) -> str:
    """Output of the collection of the quick tests, which must succeed."""
    command = [sys.executable, "-m", "pytest", "--collect-only", "-q", "-p", "no:cacheprovider", "-m", QUICK]
    run = subprocess.run([*command, *places], cwd=TESTS.parent, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stdout
    return run.stdout


def test_files_that_are_left_out_are_not_even_imported() -> None:
    """Else they would import what their marks name."""
    text = collected("tests/ipc", "tests/optics", __file__)
    assert "test_every_place_exists" in text and "tests/ipc/" not in text and "tests/optics/" not in text


@pytest.mark.script
def test_make_check_can_collect_its_tests() -> None:
    """No file that it takes imports a renderer or a solver at its top; ``make test`` says so before ``make check`` fails."""
    assert QUICK in (TESTS.parent / "Makefile").read_text(encoding="utf-8")
    (count,) = re.findall(r"^(\d+)/\d+ tests collected", collected("tests"), flags=re.MULTILINE)
    assert int(count) > 500
