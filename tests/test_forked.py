"""A forked script has what a process of its own has: arguments, folder, environment, output and exit code."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

from tests import forked
from tests.forked import ROOT, run_forked

TELLS = """
import os, sys, threading
from helper import GREETING
print(__name__, sys.argv[1:], os.getcwd(), GREETING, os.environ.get("ASKED"), "UNASKED" in os.environ, "raytac.sensor" in sys.modules)
print(os.getpid(), sys.stdin.read(), file=sys.stderr)
threading.Timer(0.05, print, ["from a thread"]).start()
sys.exit(int(sys.argv[1]))
"""


def test_a_script_is_by_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "scripts").mkdir()
    (tmp_path / "scripts" / "tells.py").write_text(TELLS)
    (tmp_path / "scripts" / "helper.py").write_text("GREETING = 'hello'")
    script, processes = str(tmp_path / "scripts" / "tells.py"), set()
    for code in (0, 3):
        monkeypatch.setenv("UNASKED", "1") if code else monkeypatch.delenv("UNASKED", raising=False)
        done = run_forked(script, str(code), cwd=tmp_path, env={"ASKED": "yes"})
        assert done.returncode == code
        assert done.stdout == f"__main__ ['{code}'] {tmp_path} hello yes {code == 3} True\nfrom a thread\n"
        processes.add(int(done.stderr))
    assert len(processes | {os.getpid()}) == 3


def test_an_error_is_told_and_nothing_of_a_script_stays(tmp_path: Path) -> None:
    (tmp_path / "breaks.py").write_text("import math; math.pi = 3; raise ValueError('nobody')")
    (tmp_path / "reads.py").write_text("import math; print(math.pi)")
    broken = run_forked("breaks.py", cwd=tmp_path)
    assert broken.returncode == 1 and "breaks.py" in broken.stderr and broken.stderr.endswith("ValueError: nobody\n")
    assert run_forked("reads.py", cwd=tmp_path).stdout.startswith("3.14")


def test_a_module_runs_as_a_program(tmp_path: Path) -> None:
    done = run_forked("-m", "raytac", "press", "coin", "--optics", "phng", cwd=tmp_path)
    assert done.returncode == 2 and "did you mean 'phong'" in done.stderr and not done.stdout


def test_after_a_script_that_does_not_end_the_next_one_has_its_own_answer(tmp_path: Path) -> None:
    (tmp_path / "waits.py").write_text("import time; time.sleep(600)")
    (tmp_path / "tells.py").write_text("print('told'); raise SystemExit(5)")
    run_forked("tells.py", cwd=tmp_path)  # the imports

    def late(*_: object) -> None:
        raise TimeoutError

    before = signal.signal(signal.SIGALRM, late), signal.setitimer(signal.ITIMER_REAL, 1.0)
    try:
        with pytest.raises(TimeoutError):
            run_forked("waits.py", cwd=tmp_path)
    finally:
        signal.signal(signal.SIGALRM, before[0])
        signal.setitimer(signal.ITIMER_REAL, *before[1])
    done = run_forked("tells.py", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (5, "told\n")


def test_a_program_without_pytest_may_run_scripts_so(tmp_path: Path) -> None:
    """Whose environment limits no library's threads, and whose scripts' own processes have this checkout, too."""
    (tmp_path / "tells.py").write_text(
        "import subprocess, sys; subprocess.run([sys.executable, '-c', 'import raytac; print(raytac.__file__)'])"
    )
    code = f"from pathlib import Path; from tests.forked import run_forked; print(run_forked('tells.py', cwd=Path({str(tmp_path)!r})))"
    environment = {
        name: value for name, value in os.environ.items() if name != "PYTHONPATH" and not name.endswith("_NUM_THREADS")
    }
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "returncode=0" in done.stdout and str(ROOT / "raytac" / "__init__.py") in done.stdout


def test_a_forked_process_that_has_ended_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    @cache
    def ended() -> subprocess.Popen[str]:
        command, pipe = [sys.executable, "-c", "raise SystemExit(3)"], subprocess.PIPE
        return subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, start_new_session=True)

    monkeypatch.setattr(forked, "_server", ended)
    with pytest.raises(RuntimeError, match="the process that is forked ended with exit code 3"):
        run_forked("tells.py", cwd=tmp_path)
