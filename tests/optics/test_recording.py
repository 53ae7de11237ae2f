"""Recording of kernels while Python collects garbage: what aborted the process must not."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
from pathlib import Path

from raytac.optics.runtime import no_collection

CHILD = """
import gc
import numpy as np
from raytac.optics import RayTraced
from tests.optics.scenes import RESOLUTION, at_rest, grid_of, like_a_mini

spec = like_a_mini()
tracer = RayTraced(bounce=False).build(spec, resolution=RESOLUTION, device="cpu")
class Cycle:
    def __init__(self):
        self.me, self.array = self, tracer.mi.Float(np.ones(1000, np.float32))
held = [Cycle() for _ in range(50)]
shade = tracer._shade
def shade_and_drop(*args):
    held.clear()
    if gc.isenabled():
        gc.collect()
    return shade(*args)
tracer._shade = shade_and_drop
tracer.render(at_rest(grid_of(spec)))
print("alive")
"""
"""Arrays on NumPy memory become garbage in the middle of a recording, where the collector runs unless it is off."""


def test_garbage_during_recording_does_not_abort_the_process() -> None:
    root = Path(__file__).parents[2]
    environment = os.environ | {"PYTHONPATH": str(root)}
    done = subprocess.run([sys.executable, "-c", CHILD], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and "alive" in done.stdout, done.stderr[-500:]


def test_the_collector_is_left_as_it_was() -> None:
    with no_collection():
        assert not gc.isenabled()
    assert gc.isenabled()
    gc.disable()
    try:
        with no_collection():
            pass
        assert not gc.isenabled()
    finally:
        gc.enable()
