"""Start of Warp, also where another package of its name hides ``ipc``."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import warp as wp

from raytac import warp_runtime
from tests.forked import run_forked


@pytest.fixture(autouse=True)
def not_started() -> Iterator[None]:
    """Warp starts once a process; here at every call."""
    warp_runtime.start_warp.cache_clear()
    yield
    warp_runtime.start_warp.cache_clear()


def test_warp_starts_where_another_package_hides_ours(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[bool] = []
    monkeypatch.setattr(wp, "init", lambda: started.append(True))
    monkeypatch.setattr(warp_runtime, "foreign_ipc", lambda: "/elsewhere/ipc.py")
    monkeypatch.setitem(sys.modules, "ipc", None)
    warp_runtime.start_warp()
    assert started


def test_a_cache_that_can_be_written_is_made_sure_of_first(monkeypatch: pytest.MonkeyPatch) -> None:
    from ipc import warp_start

    calls: list[str] = []
    monkeypatch.setattr(warp_start, "use_writable_cache", lambda: calls.append("cache"))
    monkeypatch.setattr(warp_start, "_init", lambda: calls.append("init"))
    warp_runtime.start_warp()
    assert calls == ["cache", "init"]


_PRINTED = """
import warp as wp
import raytac
{before}
sensor = raytac.TactileSensor("gelsight_mini", outputs=("height",), device="cpu")
sensor.press("sphere")
print("level", wp.config.log_level)
"""


@pytest.mark.parametrize(
    ("before", "level", "lists"),
    [
        ("", wp.LOG_WARNING, False),
        ("raytac.quiet_warp(False)", wp.LOG_INFO, True),
        ("raytac.quiet_warp()", wp.LOG_WARNING, False),
        ("wp.config.log_level = wp.LOG_ERROR", wp.LOG_ERROR, False),
        ("wp.config.log_level = wp.LOG_DEBUG", wp.LOG_DEBUG, True),
    ],
)
def test_warp_is_quiet_unless_asked(before: str, level: int, lists: bool, tmp_path: Path) -> None:
    (tmp_path / "press.py").write_text(_PRINTED.format(before=before))
    run = run_forked("press.py", cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    assert f"level {level}" in run.stdout and ("load on device" in run.stdout + run.stderr) == lists
    assert ("Warp" in run.stdout + run.stderr) == lists
