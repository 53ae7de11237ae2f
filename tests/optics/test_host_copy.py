"""Copies of batches: equal, contiguous, and on memory of their own, whether divided among threads or not."""

from __future__ import annotations

import numpy as np
import pytest

from raytac.optics import host_copy


@pytest.mark.parametrize("shape", [(1, 5, 7), (3, 5, 7), (9, 300, 400), (1, 1500, 1500)])
@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.bool_])
def test_a_copy_is_equal_and_its_own(shape: tuple[int, ...], dtype: type) -> None:
    values = (np.arange(np.prod(shape)) % 251).reshape(shape).astype(dtype)
    copy = host_copy.copy_of(values)
    np.testing.assert_array_equal(copy, values)
    assert copy.dtype == values.dtype and copy.flags.c_contiguous and not np.shares_memory(copy, values)


def test_large_batches_are_divided_and_others_are_not(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[int] = []

    class Pool(host_copy.ThreadPoolExecutor):
        def __init__(self, workers: int) -> None:
            started.append(workers)
            super().__init__(workers)

    monkeypatch.setattr(host_copy, "ThreadPoolExecutor", Pool)
    monkeypatch.setattr(host_copy, "cpu_cores", lambda: 3)
    rows = host_copy.LARGE // 4 // 1000
    small, large = (np.random.default_rng(0).random((n, 1000)).astype(np.float32) for n in (rows, rows + 1))
    for values in (small, large):
        np.testing.assert_array_equal(host_copy.copy_of(values), values)
    assert started == [3]


def test_a_view_of_every_other_row_is_copied_by_rows() -> None:
    values = np.random.default_rng(1).random((40, 400, 300))[::2, :, ::-1]
    copy = host_copy.copy_of(values)
    np.testing.assert_array_equal(copy, values)
    assert copy.flags.c_contiguous
