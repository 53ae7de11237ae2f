"""One thread a process, imported before NumPy: the suite runs in as many processes as there are cores, and idle threads wait busily."""

from __future__ import annotations

import os
import sys

NUMPY_WAS_FIRST = "numpy" in sys.modules and os.environ.get("OPENBLAS_NUM_THREADS") != "1"
"""True if NumPy was imported before, and so has as many threads as there are cores."""
ONE_THREAD = {f"{library}_NUM_THREADS": "1" for library in ("OPENBLAS", "OMP", "MKL")}
os.environ.update(ONE_THREAD)


def limit_renderer() -> None:
    """One thread for Dr.Jit, once it is imported, which reads no number from the environment."""
    if "mitsuba" in sys.modules:
        sys.modules["drjit"].set_thread_count(1)
