"""Examples with robots that others modelled, and that their sensors carry what they lift; skipped without those packages."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"


def last_line(name: str, folder: Path) -> str:
    """What an example prints last."""
    command = [sys.executable, str(EXAMPLES / f"{name}.py")]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip().splitlines()[-1]


def test_examples_say_which_package_they_need(tmp_path: Path) -> None:
    """Without the packages that are not this project's own, in isolation from where they may be installed."""
    code = (
        "import importlib.util, runpy, sys; known = importlib.util.find_spec\n"
        "absent = ('gymnasium_robotics', 'robosuite')\n"
        "importlib.util.find_spec = lambda name, *rest: None if name in absent else known(name, *rest)\n"
        "runpy.run_path(sys.argv[1])"
    )
    needs = {"fetch_pick_place": "gymnasium-robotics", "shadow_hand": "gymnasium-robotics", "panda_lift_cube": "robosuite"}
    for name, package in needs.items():
        command = [sys.executable, "-c", code, str(EXAMPLES / f"{name}.py")]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 1 and f"pip install {package}" in done.stderr


@pytest.mark.slow
def test_fetch_lifts_its_cube_and_feels_it(tmp_path: Path) -> None:
    pytest.importorskip("gymnasium_robotics")
    lifted, left, right = (
        float(number) for number in re.findall(r"(-?[\d.]+) (?:mm|and|N)", last_line("fetch_pick_place", tmp_path))
    )
    assert 60.0 < lifted < 75.0
    assert left == pytest.approx(40.0, rel=0.01) and right == pytest.approx(40.0, rel=0.01)


@pytest.mark.slow
def test_the_panda_carries_its_cube_by_the_pads(tmp_path: Path) -> None:
    pytest.importorskip("robosuite")
    numbers = re.findall(r"(-?[\d.]+) (?:mm|and|N)", last_line("panda_lift_cube", tmp_path))
    lifted, left, right, carried, weight = (float(number) for number in numbers)
    assert lifted == pytest.approx(100.0, abs=1.0)
    assert left == pytest.approx(20.0, rel=0.01) and right == pytest.approx(20.0, rel=0.01)
    assert weight == pytest.approx(0.7268, abs=1e-4) and carried == pytest.approx(weight, rel=1e-3)


@pytest.mark.slow
def test_the_shadow_hand_holds_its_block_by_all_five_fingertips(tmp_path: Path) -> None:
    pytest.importorskip("gymnasium_robotics")
    line = last_line("shadow_hand", tmp_path)
    weight, carried = (float(number) for number in re.findall(r"([\d.]+) N", line))
    loads = [float(number) for number in re.findall(r": ([\d.]+)", line)]
    assert len(loads) == 5 and min(loads) > 0.2
    assert weight == pytest.approx(0.695, abs=1e-3) and carried == pytest.approx(weight, rel=0.01)
