"""Times of warm calls over changing surfaces, the machine, the confidence of a proportion."""

from __future__ import annotations

import math
import os
import platform
import subprocess
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

from raytac.errors import InputError
from raytac.gel.surface import GelSurface
from raytac.io.metrics import Metric

Input = TypeVar("Input")
"""Argument of a call that is timed."""


def moving(surfaces: Sequence[GelSurface], batch: int, count: int) -> list[GelSurface]:
    """``count`` batches of ``surfaces`` (B = 1), no two alike, at 70 to 100 % of indentation."""
    batches = []
    for k in range(count):
        picks = [surfaces[(k * batch + b) % len(surfaces)] for b in range(batch)]
        share = 0.7 + 0.3 * (0.618034 * (k * batch + np.arange(batch, dtype=np.float32)) % 1)
        rest = picks[0].grid.rest.astype(np.float32)
        height = rest + share[:, None, None].astype(np.float32) * (np.concatenate([s.height for s in picks]) - rest)
        contact, centre = (np.concatenate([getattr(s, a) for s in picks]) for a in ("contact", "contact_centre"))
        batches.append(GelSurface(picks[0].grid, height, contact, centre))
    return batches


def once(call: Callable[[Input], object], value: Input) -> float:
    """Milliseconds of one call, which must return only when its work is done."""
    start = time.perf_counter()
    call(value)
    return 1e3 * (time.perf_counter() - start)


def timed(call: Callable[[Input], object], inputs: Sequence[Input], frames: int) -> np.ndarray:
    """Milliseconds of ``frames`` warm calls with ``inputs`` in turn, each called once before."""
    for value in inputs:
        call(value)
    return np.array([once(call, inputs[k % len(inputs)]) for k in range(frames)])


def timed_within(call: Callable[[Input], object], inputs: Sequence[Input], frames: int, budget_s: float) -> np.ndarray:
    """As ``timed``, in at most ``budget_s`` [s] if three calls fit; a slow call warms up once."""
    call(inputs[0])
    first = once(call, inputs[1 % len(inputs)])
    if frames * first <= 1e3 * budget_s:
        return timed(call, inputs, frames)
    count = min(frames, max(3, int(1e3 * budget_s / first)))
    return np.array([first, *(once(call, inputs[k % len(inputs)]) for k in range(2, count + 1))])


def machine() -> dict[str, Metric]:
    """Metrics of the machine: ``machine.cpu``, ``.cores``, ``.load_at_start``, ``.gpu``."""
    cpu = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        cpu = next(
            (line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")), cpu
        )
    facts: dict[str, Metric] = {
        "machine.cpu": cpu,
        "machine.cores": os.cpu_count() or 0,
        "machine.load_at_start": os.getloadavg()[0],
    }
    try:
        ask = ["nvidia-smi", "--query-gpu=name", "--format=csv,noheader"]
        gpu = subprocess.run(ask, capture_output=True, text=True, check=False, timeout=20).stdout.strip()
    except (OSError, subprocess.TimeoutExpired):
        gpu = ""
    return facts | ({"machine.gpu": gpu.splitlines()[0]} if gpu else {})


def wilson_interval(successes: int, trials: int, z: float = 1.959964) -> tuple[float, float]:
    """Wilson's score interval of a proportion (J. Am. Stat. Assoc. 22, 1927).

    Its ends are the p with (p̂ − p)² = z² p (1 − p) / n; z = 1.96 is 95 %. Unlike p̂ ± z √(p̂ (1 − p̂) / n) it stays within 0 and 1 and
    has a width at p̂ = 0 and 1. Raises ``InputError`` without trials.
    """
    if trials < 1 or not 0 <= successes <= trials:
        raise InputError(
            "successes", value=(successes, trials), rule="must be from 0 to the number of trials, which must be at least 1"
        )
    share, square = successes / trials, z * z / trials
    middle = share + 0.5 * square
    half = math.sqrt(share * (1.0 - share) * square + 0.25 * square * square)
    return max(0.0, (middle - half) / (1.0 + square)), min(1.0, (middle + half) / (1.0 + square))
