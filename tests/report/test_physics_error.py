"""Error of the rigid pad against the soft one, on a shallow press at a small size."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from raytac.io.metrics import check_metrics
from raytac.report.compare.physics_error import PhysicsError, physics_errors, physics_metrics
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


def test_the_rigid_pad_is_a_star_in_the_plot_of_error_and_time() -> None:
    from matplotlib.figure import Figure

    from raytac.report.compare.figures import _pads

    errors = [
        PhysicsError(scene, "32x24", "coarse", 1.0, 2.0, 3.0, 4.0, contact, 0.5, 0.2, seconds, 20.0 * seconds)
        for scene, contact, seconds in (("sphere", 1.0, 0.2), ("coin", 3.0, 0.4), ("cone", float("nan"), 0.6))
    ]
    axes = Figure().subplots()
    _pads(axes, errors, "contact_mae")
    whisker, star, soft = axes.lines
    assert np.asarray(whisker.get_ydata()).tolist() == [1.0, 3.0]
    assert star.get_marker() == "*" and np.asarray(star.get_xydata()).tolist() == [[400.0, 2.0]]
    assert np.asarray(soft.get_xdata())[0] == 8000.0
