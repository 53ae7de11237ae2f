"""A clock for tests of what is measured: no time of a shared machine can be asserted, those that it is made of can."""

from __future__ import annotations

import itertools
from types import ModuleType, SimpleNamespace

import pytest


def steady_clock(monkeypatch: pytest.MonkeyPatch, module: ModuleType, tick: float = 1e-3) -> None:
    """Let each reading of ``time.perf_counter`` in ``module`` be ``tick`` [s] after the one before."""
    ticks = itertools.count()
    monkeypatch.setattr(module, "time", SimpleNamespace(perf_counter=lambda: tick * next(ticks)))
