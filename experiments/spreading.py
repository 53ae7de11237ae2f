"""Work that is spread over processes of one thread each, without a GPU; results come as they are done."""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import TypeVar

from raytac.envs import one_thread
from raytac.errors import RaytacError

__all__ = ["spread"]

Item = TypeVar("Item")
Result = TypeVar("Result")


def spread(
    work: Callable[[Item], Result], items: Sequence[Item], processes: int, *, first: Callable[[], object], seconds: float
) -> Iterator[Result]:
    """Results of ``work`` for all items in no order; after ``seconds`` what is not done is broken off, and left out.

    Args:
        work: a function of a module, with arguments and results that pickle.
        items: taken in their order, so that long ones should come first.
        processes: their number.
        first: called in one process before the others start, so that they find compiled kernels.
        seconds: from now on; ``inf`` for no end.

    Raises:
        RaytacError: a process ended by itself.
    """
    before, end = set(multiprocessing.active_children()), time.monotonic() + seconds

    def remaining() -> float | None:
        return None if end == float("inf") else max(end - time.monotonic(), 0.0)

    executor = ProcessPoolExecutor(processes, mp_context=multiprocessing.get_context("spawn"))
    try:
        with one_thread(), _no_gpu():
            executor.submit(first).result(remaining())
            running = [executor.submit(work, item) for item in items]
        for future in as_completed(running, remaining()):
            yield future.result()
    except TimeoutError:
        return
    except BrokenProcessPool as error:
        raise RaytacError(
            "a process ended by itself, perhaps for want of memory; run again to go on with what is missing"
        ) from error
    finally:
        executor.shutdown(wait=False, cancel_futures=True)
        for process in set(multiprocessing.active_children()) - before:
            process.terminate()
            process.join()


@contextmanager
def _no_gpu() -> Iterator[None]:
    """Hide GPUs from processes that start within: each would take a context of its own, which the work does not need."""
    name = "CUDA_VISIBLE_DEVICES"
    kept = os.environ.get(name)
    os.environ[name] = ""
    try:
        yield
    finally:
        if kept is None:
            del os.environ[name]
        else:
            os.environ[name] = kept
