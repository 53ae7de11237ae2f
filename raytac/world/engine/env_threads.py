"""``EnvThreads``: threads among which calls of MuJoCo for many environments are divided."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from itertools import pairwise

from raytac.device import cpu_cores

_LEAST = 4
"""Environments a thread at least: fewer take about as long as handing them over."""


class EnvThreads:
    """Threads that each take a contiguous part of the environments.

    MuJoCo's functions let other threads run while they work, and environments share nothing that they write: the results are those of
    a loop, to the bit. Threads start with the first call that needs them, end with this object, and are started anew after a fork.
    """

    def __init__(self, threads: int | None = None) -> None:
        """``threads``: at most so many, the caller's among them.

        None is one a core, or ``OMP_NUM_THREADS`` if that is fewer: it is 1 in the processes of ``Workers``.
        """
        self.threads = _allowed() if threads is None else threads
        self._pool: ThreadPoolExecutor | None = None
        self._process = 0

    def run(self, work: Callable[[int], object], envs: Sequence[int]) -> None:
        """Call ``work(env)`` for every environment.

        In one thread environments keep their order. An error ends the part it is in, not the others, and is raised when all have ended;
        of several, that of the first part. ``work`` must launch no kernels of Warp and must not call this.
        """
        parts = min(self.threads, len(envs) // _LEAST)
        if parts < 2:
            _loop(work, envs)
            return
        if self._pool is None or self._process != os.getpid():
            self._pool = ThreadPoolExecutor(self.threads - 1, "raytac-environments")
            self._process = os.getpid()
        bounds = [len(envs) * i // parts for i in range(parts + 1)]
        others = [self._pool.submit(_loop, work, envs[a:b]) for a, b in pairwise(bounds[1:])]
        try:
            _loop(work, envs[: bounds[1]])
        finally:
            wait(others)
        for part in others:
            part.result()


def _allowed() -> int:
    """One thread a core, or as many as ``OMP_NUM_THREADS`` says if that is fewer."""
    named = os.environ.get("OMP_NUM_THREADS", "")
    return min(cpu_cores(), int(named)) if named.isdecimal() and int(named) > 0 else cpu_cores()


def _loop(work: Callable[[int], object], envs: Sequence[int]) -> None:
    for env in envs:
        work(env)
