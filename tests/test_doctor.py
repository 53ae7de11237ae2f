"""The doctor survives what it examines, and its exit code follows the default job alone."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import raytac.doctor as doctor
from raytac.cli import main
from raytac.device import llvm_library
from raytac.doctor import Check, Probe, Report, diagnose, run_probe

WORKS = "print('it works')"


def probe(name: str, code: str = WORKS, required: bool = True) -> Probe:
    return Probe(name, code, required, f"mend {name}")


def test_an_abort_is_a_finding() -> None:
    check = run_probe(probe("x", "import os; os.abort()"))
    assert not check.ok and "SIGABRT" in check.detail and check.fix == "mend x"


def test_an_exception_is_told_with_its_message() -> None:
    check = run_probe(probe("x", "raise ImportError('no module of that kind')"))
    assert not check.ok and "no module of that kind" in check.detail


def test_a_hang_is_a_finding() -> None:
    check = run_probe(probe("x", "import time; time.sleep(60)"), timeout=0.5)
    assert not check.ok and "no answer" in check.detail


def test_what_works_needs_no_mending() -> None:
    check = run_probe(probe("x"))
    assert check.ok and check.detail.startswith("it works") and check.fix == ""


def test_nothing_is_started_where_there_is_nothing_to_try() -> None:
    check = run_probe(Probe("x", "raise SystemExit(3)", False, "mend", lambda: "no such card"))
    assert not check.ok and check.detail == "no such card"


def test_what_every_installation_has_is_required() -> None:
    assert {p.name for p in doctor.PROBES if p.required} == {"system", "mujoco", "exr", "assets", "figures, meshes", "warp"}


@pytest.mark.parametrize(
    ("name", "package", "needed_by", "extra"),
    [
        ("pytetwild", "pyvista", "soft objects", "raytac[ipc]"),
        ("pytetwild", "pytetwild", "soft objects", "raytac[ipc]"),
        ("report", "pyarrow", "raytac compare", "raytac[report]"),
    ],
)
def test_each_extra_says_what_lacks_and_what_needs_it(
    name: str, package: str, needed_by: str, extra: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda asked: None if asked == package else object())
    (found,) = (p for p in doctor.PROBES if p.name == name)
    check = run_probe(found)
    assert check.detail.startswith(f"not installed (without {package}): only {needed_by}")
    assert extra in check.fix and not check.required


@pytest.mark.parametrize("by_user", [None, "", "a library"])
def test_who_named_llvm(by_user: str | None) -> None:
    """An empty path names none: Dr.Jit would abort the process over it."""
    library = str(llvm_library())
    env = {key: value for key, value in os.environ.items() if key != "DRJIT_LIBLLVM_PATH"}
    code = (
        "import os, raytac.optics\n"
        "from raytac.doctor import PROBES, run_probe\n"
        "from dataclasses import replace\n"
        "assert os.environ['DRJIT_LIBLLVM_PATH'] and 'DRJIT_LIBOPTIX_PATH' not in os.environ\n"
        "(llvm,) = (probe for probe in PROBES if probe.name == 'mitsuba-llvm')\n"
        "print(run_probe(replace(llvm, code='print()')).detail)"
    )
    env |= {"PYTHONPATH": str(Path(doctor.__file__).parents[1]), "DRJIT_LIBOPTIX_PATH": ""}
    env |= {} if by_user is None else {"DRJIT_LIBLLVM_PATH": by_user and library}
    told = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True).stdout
    assert f"LLVM {'set by DRJIT_LIBLLVM_PATH' if by_user else 'found'}: {library}" in told


def test_a_broken_llvm_leaves_the_gpu_and_the_other_way_round() -> None:
    broken = "import os; os.abort()"
    assert diagnose([probe("mitsuba-cuda"), probe("mitsuba-llvm", broken, False)]).device == "cuda"
    assert diagnose([probe("mitsuba-cuda", broken, False), probe("mitsuba-llvm")]).device == "cpu"
    neither = diagnose([probe("mitsuba-cuda", broken, False), probe("mitsuba-llvm", broken, False)])
    assert (neither.device, neither.exit_code) == ("none", 1)
    assert "fixing one is enough" in neither.to_text()


@pytest.mark.parametrize(("required", "code"), [(True, 1), (False, 0)])
def test_exit_code_is_1_only_if_the_default_job_cannot_run(required: bool, code: int) -> None:
    checks = (Check("mitsuba-llvm", True, False, "", ""), Check("x", False, required, "gone", "mend x"))
    report = Report("cpu", checks, {})
    assert report.exit_code == code
    assert "fix: mend x" in report.to_text()


@pytest.mark.parametrize("abort", [False, True])
def test_the_command_prints_one_json_object(
    abort: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    exr = probe("exr", "import os; os.abort()" if abort else WORKS)
    monkeypatch.setattr("raytac.cli.doctor.diagnose", lambda: diagnose([probe("mitsuba-llvm"), exr]))
    assert main(["doctor", "--json"]) == int(abort)
    report = json.loads(capsys.readouterr().out)
    assert report["ok"] is not abort and report["device"] == "cpu"
    assert {check["name"]: check["ok"] for check in report["checks"]} == {"mitsuba-llvm": True, "exr": not abort, "ipc": True}
    assert "numpy" in report["versions"]


def test_this_machine_can_do_the_default_job() -> None:
    """By the probes on which that depends; Warp is tried by most of the other tests."""
    needed = [p for p in doctor.PROBES if (p.required or p.name.startswith("mitsuba")) and p.name != "warp"]
    report = diagnose(needed)
    assert report.ok and report.device != "none", report.to_text()
