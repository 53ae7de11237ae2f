"""``make`` installs once: a finished environment is left alone, and a changed project file installs again. Nothing is installed here."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
needs_make = pytest.mark.skipif(shutil.which("make") is None, reason="there is no make")


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """Makefile and project file, and an environment whose stamps say that both installs are done."""
    for name in ("Makefile", "pyproject.toml"):
        shutil.copy(ROOT / name, tmp_path / name)
    (tmp_path / ".venv").mkdir()
    past = time.time() - 100
    os.utime(tmp_path / "pyproject.toml", (past, past))
    for age, stamp in ((60, ".installed"), (30, ".installed-test")):
        path = tmp_path / ".venv" / stamp
        path.touch()
        done = time.time() - age
        os.utime(path, (done, done))
    return tmp_path


def planned(checkout: Path, target: str) -> str:
    """The commands that ``make`` would run."""
    done = subprocess.run(["make", "--dry-run", target], cwd=checkout, capture_output=True, text=True, check=True)
    return done.stdout


@needs_make
@pytest.mark.parametrize("target", ["demo", "test", "check", "test-random", "lint"])
def test_a_second_make_installs_nothing(checkout: Path, target: str) -> None:
    commands = planned(checkout, target)
    assert "pip" not in commands and "venv " not in commands, commands
    assert {"demo": "press_sheet.py", "lint": "ruff"}.get(target, "pytest") in commands


@needs_make
@pytest.mark.parametrize("target", ["demo", "test"])
def test_a_changed_project_file_or_a_lost_stamp_installs_again(checkout: Path, target: str) -> None:
    (checkout / "pyproject.toml").touch()
    assert "pip install" in planned(checkout, target)
    os.utime(checkout / "pyproject.toml", (0, 0))
    assert "pip install" not in planned(checkout, target)
    (checkout / ".venv" / ".installed").unlink()
    assert "pip install" in planned(checkout, target)


@needs_make
def test_the_documents_install_their_builder_once(checkout: Path) -> None:
    commands = planned(checkout, "docs")
    assert "'.[docs]'" in commands and commands.index("docs/build/pages.py") < commands.index("zensical build --strict")
    (checkout / ".venv" / ".installed-docs").touch()
    assert "pip" not in planned(checkout, "docs")


@needs_make
def test_a_check_asks_for_the_types_of_what_changed_only(checkout: Path) -> None:
    (checkout / "raytac").mkdir()
    kept, changed = checkout / "raytac" / "kept.py", checkout / "raytac" / "changed.py"
    for age, path in ((200, kept), (200, changed), (50, checkout / ".venv" / ".types")):
        path.touch()
        os.utime(path, (time.time() - age, time.time() - age))
    assert "pyright" not in planned(checkout, "check")
    changed.touch()
    (line,) = [line for line in planned(checkout, "check").splitlines() if "pyright" in line]
    assert line.split()[1:] == ["raytac/changed.py"]


@needs_make
@pytest.mark.parametrize(
    "change", ["raytac/kept.py", "raytac/kept.pyi", "pyproject.toml", ".venv/.installed-test", "new.py", None]
)
def test_the_whole_suite_asks_for_all_types_unless_nothing_has_changed(checkout: Path, change: str | None) -> None:
    """A file that is removed, and one that changes while pyright runs, count too."""
    (checkout / "raytac" / "__pycache__").mkdir(parents=True)
    for name in ("kept.py", "kept.pyi", "removed.py"):
        (checkout / "raytac" / name).touch()
    past = time.time() - 10
    for path in checkout.rglob("*"):
        os.utime(path, (past, past))
    (checkout / ".venv" / "bin").mkdir()
    checker = checkout / ".venv" / "bin" / "pyright"
    checker.write_text("#!/bin/sh\necho checked\n" + ("sleep 0.05; touch raytac/new.py\n" if change == "new.py" else ""))
    checker.chmod(0o755)
    if change == "new.py":
        (checkout / "raytac" / "new.py").touch()
    made = [subprocess.run(["make", "types"], cwd=checkout, capture_output=True, text=True, check=True).stdout for _ in range(2)]
    assert "checked" in made[0] and ("checked" in made[1]) == (change == "new.py")
    (checkout / "raytac" / "__pycache__" / "kept.pyc").touch()
    if change == "new.py":
        return
    assert "pyright" not in planned(checkout, "test")
    later = time.time() + 10
    if change is None:
        (checkout / "raytac" / "removed.py").unlink()
    else:
        os.utime(checkout / change, (later, later))
    (line,) = [line for line in planned(checkout, "test").splitlines() if line.endswith("pyright")]
    assert line.split()[1:] == []


@needs_make
def test_an_old_python_is_refused_with_what_to_do(checkout: Path, tmp_path: Path) -> None:
    (checkout / ".venv" / ".installed").unlink()
    old = tmp_path / "python-old"
    old.write_text("#!/bin/sh\n[ \"$1\" = --version ] && echo 'Python 3.9.1' && exit 0\nexit 1\n")
    old.chmod(0o755)
    done = subprocess.run(["make", "demo", f"PYTHON={old}"], cwd=checkout, capture_output=True, text=True, check=False)
    assert done.returncode != 0 and "needs Python >= 3.11" in done.stderr and "Python 3.9.1" in done.stderr
    assert not (checkout / ".venv" / ".installed").exists()


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "wait4"), reason="peak memory is read with wait4")
def test_the_demo_stays_below_2_gb(tmp_path: Path) -> None:
    """Peak resident memory of the program that ``make demo`` runs, as it runs it."""
    assert "experiments/press_sheet.py --out $(OUT)" in (ROOT / "Makefile").read_text()
    command = [sys.executable, "experiments/press_sheet.py", "--out", str(tmp_path / "demo")]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, env=os.environ | {"PYTHONPATH": str(ROOT)})
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    assert process.returncode == 0 and (tmp_path / "demo" / "sheet.png").is_file()
    peak = usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    print(f"peak resident memory {peak / 1e9:.2f} GB")
    assert peak < 2e9
