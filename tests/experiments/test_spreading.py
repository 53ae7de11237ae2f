"""Work spread over processes: it ends in time, and a process that dies is an error."""

from __future__ import annotations

import os
import time
from functools import partial

import pytest

from experiments.spreading import spread
from raytac.errors import RaytacError


def place(number: int) -> tuple[int, int, str | None, str | None]:
    return number, os.getpid(), os.environ.get("OMP_NUM_THREADS"), os.environ.get("CUDA_VISIBLE_DEVICES")


def sleep(seconds: float) -> float:
    time.sleep(seconds)
    return seconds


def die(status: int) -> None:
    os._exit(status)


def test_processes_have_one_thread_and_no_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0")
    results = list(spread(place, range(6), 2, first=partial(place, -1), seconds=60.0))
    assert sorted(number for number, *_ in results) == list(range(6))
    assert {(threads, gpus) for _, _, threads, gpus in results} == {("1", "")}
    assert os.getpid() not in {process for _, process, *_ in results} and os.environ["CUDA_VISIBLE_DEVICES"] == "0"


def test_what_is_not_done_in_time_is_left_out() -> None:
    start = time.monotonic()
    assert 100.0 not in list(spread(sleep, [0.0, 100.0], 2, first=partial(sleep, 0.0), seconds=3.0))
    assert time.monotonic() - start < 60.0


def test_a_process_that_dies_is_an_error() -> None:
    with pytest.raises(RaytacError, match="ended by itself"):
        list(spread(die, [3], 1, first=partial(sleep, 0.0), seconds=float("inf")))
