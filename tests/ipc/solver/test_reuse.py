"""When elastic blocks of an earlier iteration may be used again."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from ipc.solver.reuse import DEFORMED, NONE, choose_stale

FILLED = np.broadcast_to(np.eye(3), (1, 3, 3, 3))
"""F of three elements at the last time."""


def chosen(F: np.ndarray, project: int = 0, filled: int = 0, active: int = 1) -> tuple[bool, np.ndarray, int]:
    """Whether blocks have to be computed, and what is kept."""
    kept = wp.array(FILLED, dtype=wp.mat33d, device="cpu")
    flags = [wp.array([value], dtype=wp.int32, device="cpu") for value in (project, active, filled, 7)]
    wp.launch(
        choose_stale, dim=1, inputs=[wp.array(F, dtype=wp.mat33d, device="cpu"), *flags[:2], kept, *flags[2:]], device="cpu"
    )
    return bool(flags[3].numpy()[0]), kept.numpy(), int(flags[2].numpy()[0])


def deformed(element: int, change: float) -> np.ndarray:
    F = FILLED.copy()
    F[0, element, 0, 1] += change
    return F


@pytest.mark.parametrize("element", range(3))
def test_blocks_are_stale_once_an_element_has_deformed(element: int) -> None:
    limit = float(DEFORMED)
    stale, kept, _ = chosen(deformed(element, 0.99 * limit))
    assert not stale and (kept == FILLED).all()
    for change in (1.01 * limit, np.inf, np.nan):
        F = deformed(element, change)
        stale, kept, _ = chosen(F)
        assert stale
        np.testing.assert_array_equal(kept, F)


def test_blocks_of_another_matrix_or_of_none_are_stale() -> None:
    assert chosen(FILLED, project=1)[::2] == (True, 1)
    assert chosen(FILLED, filled=int(NONE))[::2] == (True, 0)
    stale, kept, filled = chosen(deformed(1, 1.0), project=1, active=0)
    assert not stale and (kept == FILLED).all() and filled == 0
