"""Scripts that draw by MuJoCo, in processes of their own: the GL backend is chosen when MuJoCo is imported."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

_ROOT = Path(__file__).parents[1]
_PROBE = """
import sys
import mujoco, numpy as np
try:
    mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8).close()
except Exception as error:
    print(error)
    sys.exit(77)
"""


def drawing_environment() -> dict[str, str]:
    """Variables of a process that draws without a display."""
    return {"MUJOCO_GL": "egl", **os.environ, "PYTHONPATH": os.pathsep.join(p for p in (str(_ROOT), *sys.path) if p)}


def run_drawing(script: str, *, timeout: float = 120.0) -> None:
    """Run ``script``, which finds ``mujoco`` and ``np`` imported; the test is skipped without OpenGL."""
    command = [sys.executable, "-c", _PROBE + script]
    done = subprocess.run(command, env=drawing_environment(), capture_output=True, text=True, timeout=timeout)
    if done.returncode == 77 or "EGL" in done.stderr or "OpenGL" in done.stderr:
        pytest.skip(f"no offscreen OpenGL here: {(done.stdout + done.stderr).strip()[-200:]}")
    assert done.returncode == 0, done.stderr
