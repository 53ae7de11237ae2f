"""Start of Warp, also where another package of its name hides ``ipc``."""

from __future__ import annotations

import sys

import pytest
import warp as wp

from raytac import warp_runtime


def test_warp_starts_where_another_package_hides_ours(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[bool] = []
    monkeypatch.setattr(wp, "init", lambda: started.append(True))
    monkeypatch.setattr(warp_runtime, "foreign_ipc", lambda: "/elsewhere/ipc.py")
    monkeypatch.setitem(sys.modules, "ipc", None)
    warp_runtime.start_warp()
    assert started


def test_a_cache_that_can_be_written_is_made_sure_of_first(monkeypatch: pytest.MonkeyPatch) -> None:
    import ipc

    calls: list[str] = []
    monkeypatch.setattr(ipc, "use_writable_cache", lambda: calls.append("cache"), raising=False)
    monkeypatch.setattr(wp, "init", lambda: calls.append("init"))
    warp_runtime.start_warp()
    assert calls == ["cache", "init"]
