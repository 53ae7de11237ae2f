"""Progress of long work: lines every few seconds where there is no terminal, a bar where there is one."""

from __future__ import annotations

import io
import subprocess
import sys
from pathlib import Path

import pytest
import tqdm.std

from raytac.io.progress import Progress

ROOT = Path(__file__).parents[2]


class Clock:
    """A clock that moves when it is told to [s]."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(tqdm.std, "time", clock)
    return clock


def test_long_work_writes_a_line_every_few_seconds(clock: Clock) -> None:
    log = io.StringIO()
    for _ in Progress(range(60), desc="compare", unit="row", file=log):
        clock.now += 1.0
    lines = log.getvalue().splitlines()
    assert lines[0] == "compare 5/60 rows, 00:05, about 00:55 to go"
    assert lines[-1] == "compare 60/60 rows, 01:00"
    assert len(lines) == 12 and not set("\r\x1b") & set(log.getvalue())


def test_short_work_writes_nothing(clock: Clock) -> None:
    log = io.StringIO()
    for _ in Progress(range(4), desc="bake", file=log):
        clock.now += 1.0
    assert log.getvalue() == ""


def test_steps_of_unknown_number_say_what_they_are_at_no_oftener_than_others(clock: Clock) -> None:
    """A fit reports each of its steps: a bar is redrawn, a log must not grow by every one of them."""
    log = io.StringIO()
    with Progress(desc="calibrate", unit="step", file=log) as bar:
        for step in range(1000):
            clock.now += 0.02
            bar.update()
            bar.set_postfix_str(f"cost {step}")
    lines = log.getvalue().splitlines()
    assert len(lines) == 4 and lines[0].startswith("calibrate 251 steps, 00:05: cost 249")


def test_a_loop_of_slow_steps_writes_one_line_a_step(clock: Clock) -> None:
    log = io.StringIO()
    with Progress(desc="boxes", total=3, unit="press", file=log) as bar:
        for _ in range(3):
            clock.now += 100.0
            bar.update()
    assert [line.split(",")[0] for line in log.getvalue().splitlines()] == [
        "boxes 1/3 presses",
        "boxes 2/3 presses",
        "boxes 3/3 presses",
    ]


def test_a_terminal_gets_a_bar(clock: Clock) -> None:
    terminal = Terminal()
    for _ in Progress(range(3), desc="bake", file=terminal, ncols=60):
        clock.now += 1.0
    assert "\r" in terminal.getvalue() and "100%" in terminal.getvalue()


def test_none_is_shown_if_none_is_wanted(clock: Clock) -> None:
    log = io.StringIO()
    for _ in Progress(range(60), desc="bake", show=False, file=log):
        clock.now += 1.0
    assert log.getvalue() == ""


NOTEBOOK = """
import io, sys, types

class Widget:
    shown = []
    def __init__(self, children=(), **options):
        self.value, self.children, self.layout = 0, children, types.SimpleNamespace(width="")
        self.style, self.bar_style, self.max = types.SimpleNamespace(), "", 100

class Box(Widget):
    pass

ipython, shell, widgets = (types.ModuleType(name) for name in ("IPython", "IPython.display", "ipywidgets"))
ipython.get_ipython, ipython.display, shell.display = object, shell, Widget.shown.append
widgets.HTML = widgets.FloatProgress = Widget
widgets.HBox, widgets.__version__ = Box, "8.1"
sys.modules |= {"IPython": ipython, "IPython.display": shell, "ipywidgets": widgets}
sys.modules["ipykernel.zmqshell"] = types.ModuleType("ipykernel.zmqshell")

from raytac.io import Progress

for _ in Progress(range(3), desc="bake"):
    pass
(bar,) = Widget.shown
assert bar.children[1].value == 3 and bar.children[1].bar_style == "success", vars(bar.children[1])
log = io.StringIO()
for _ in Progress(range(3), desc="bake", file=log, interval=0.0):
    pass
for _ in Progress(range(3), desc="bake", show=False):
    pass
assert len(Widget.shown) == 1 and "bake 3/3 it" in log.getvalue(), log.getvalue()
"""


def test_a_notebook_gets_a_bar_of_widgets_and_a_log_its_lines() -> None:
    """Stand-ins for IPython and ipywidgets: tqdm decides by them where it runs."""
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", NOTEBOOK], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
