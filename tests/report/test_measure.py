"""Times are taken over surfaces that differ."""

from __future__ import annotations

import numpy as np
import pytest

from raytac.report import measure
from raytac.report.measure import moving, timed
from tests.clock import steady_clock
from tests.conftest import make_surface


def test_moving_changes_every_environment_of_every_frame() -> None:
    surface = make_surface()
    frames = moving([surface], batch=3, count=2)
    depths = np.concatenate([frame.indentation.max(axis=(1, 2)) for frame in frames])
    full = surface.indentation.max()
    assert len(np.unique(depths)) == 6 and (depths >= 0.7 * full - 1e-9).all() and (depths <= full + 1e-9).all()


def test_moving_takes_turns_among_surfaces() -> None:
    shallow, deep = make_surface(0.4e-3), make_surface(1e-3)
    depths = [frame.indentation.max() for frame in moving([shallow, deep], batch=1, count=4)]
    assert max(depths[0], depths[2]) <= 0.4e-3 + 1e-9 < 0.7e-3 - 1e-9 <= min(depths[1], depths[3])


def test_timed_warms_up_with_each_input_and_then_takes_them_in_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[int] = []
    steady_clock(monkeypatch, measure, 0.25)
    ms = timed(seen.append, [1, 2, 3], 4)
    assert seen == [1, 2, 3, 1, 2, 3, 1] and ms.tolist() == [250.0] * 4


def test_a_slow_call_is_timed_less_often(monkeypatch: pytest.MonkeyPatch) -> None:
    """At 1 s a call a budget of 5 s holds five of ten, and one of 1 s the least, three."""
    for budget, count in ((5.0, 5), (1.0, 3), (10.0, 10)):
        steady_clock(monkeypatch, measure, 1.0)
        assert measure.timed_within(lambda _: None, [1, 2], 10, budget).tolist() == [1000.0] * count
