"""Error of the rigid pad against the soft one, on a shallow press at a small size."""

from __future__ import annotations

from pathlib import Path

import pytest

from raytac.io.metrics import check_metrics
from raytac.report.compare.physics_error import physics_errors, physics_metrics
from raytac.report.press import press_peaks
from raytac.report.tracers import Tracers

SCENE = """
[object]
kind = "sphere"
radius_mm = 4.0
[[trajectory]]
kind = "indent"
depth_mm = 0.4
"""


@pytest.mark.slow
def test_rigid_and_soft_pad_differ_around_the_contact_not_in_it(tmp_path: Path) -> None:
    path = tmp_path / "ball.toml"
    path.write_text(SCENE)
    spec, surfaces = press_peaks("gelsight_mini", (path,), (80, 60))
    (error,) = physics_errors(Tracers(spec, "cpu", 0), (path,), (80, 60), "coarse", surfaces)
    assert (error.scene, error.resolution, error.pad) == ("ball", "80x60", "coarse")
    assert error.contact_um < error.ring_um and 3.0 < error.bulge_um < 60.0
    assert 0.0 < error.frame_levels < error.ring_levels
    metrics = physics_metrics((error,))
    assert metrics["physics.coarse.80x60.contact_um.ball"] == error.contact_um
    check_metrics(metrics | {"command": "compare", "device": "cpu", "wall_s": 1.0, "versions.raytac": "0"})
