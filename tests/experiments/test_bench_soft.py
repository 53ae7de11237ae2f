"""Forces of the soft pad's levels against the fine level's."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from experiments.bench_soft import STUDY, TOOLS, pressed
from raytac.specs import load_sensor

FINE = {"ball": 1.612, "cylinder": 3.898, "punch": 0.996}
"""``soft.fine.force_n.*`` of ``experiments/bench_soft.py --forces`` (docs/measurements/soft-pad.md) [N]."""
GELPAD = replace(load_sensor("gelsight_mini").gelpad, dome_radius=(math.inf, math.inf))


@pytest.mark.parametrize(("tool", "most"), [("ball", 0.05), ("cylinder", 0.08), ("punch", 0.25)])
def test_the_coarse_level_has_the_force_of_the_fine_one(tool: str, most: float) -> None:
    """At a depth, in steps that converge (``pressed`` raises where one does not) and turn no element over."""
    force, cost = pressed(GELPAD, "coarse", tool, "cpu")
    assert abs(force / FINE[tool] - 1) < most
    assert 0.4 < cost["least_det_f"] < 0.9 and cost["newton"] < 20


def test_without_blocks_it_locks() -> None:
    force, cost = pressed(GELPAD, STUDY["coarse_2.5_plain"], "ball", "cpu")
    assert force / FINE["ball"] - 1 > 0.4 and cost["least_det_f"] > 0.9
    assert set(TOOLS) == set(FINE)
