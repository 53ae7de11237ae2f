"""Which machine a figure was measured on."""

from __future__ import annotations

import os
import platform
import subprocess
from pathlib import Path

from raytac.io.metrics import Metric

__all__ = ["machine"]


def machine() -> dict[str, Metric]:
    """CPU, cores, load and GPU as far as the system tells: keys ``machine.cpu``, ``.cores``, ``.load_at_start``, ``.gpu``."""
    cpu = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        cpu = next(
            (line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")), cpu
        )
    found: dict[str, Metric] = {
        "machine.cpu": cpu,
        "machine.cores": os.cpu_count() or 0,
        "machine.load_at_start": os.getloadavg()[0],
    }
    try:
        ask = ["nvidia-smi", "--query-gpu=name", "--format=csv,noheader"]
        gpu = subprocess.run(ask, capture_output=True, text=True, check=False, timeout=20).stdout.strip()
    except (OSError, subprocess.TimeoutExpired):
        gpu = ""
    return found | ({"machine.gpu": gpu.splitlines()[0]} if gpu else {})
