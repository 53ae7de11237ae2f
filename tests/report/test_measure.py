"""Times are taken over surfaces that differ."""

from __future__ import annotations

import numpy as np

from raytac.report.measure import moving, timed
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


def test_timed_warms_up_with_each_input_and_then_takes_them_in_turn() -> None:
    seen: list[int] = []
    ms = timed(seen.append, [1, 2, 3], 4)
    assert seen == [1, 2, 3, 1, 2, 3, 1] and ms.shape == (4,) and (ms >= 0).all()
