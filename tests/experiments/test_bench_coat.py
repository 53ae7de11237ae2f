"""The bench of the shown coat, small: an edge and a light ball against truths that are coarse themselves."""

from __future__ import annotations

import pytest

from experiments import bench_coat
from raytac.errors import InputError
from raytac.io.metrics import read_metrics


@pytest.mark.slow
def test_the_shown_coat_is_nearer_than_the_mesh(tmp_path):
    bench_coat.Args(out=tmp_path, levels="coarse", shapes="edge", cell_um=190.0).run()
    found = {key: float(value) for key, value in read_metrics(tmp_path / "metrics.json").items() if key.startswith("edge")}
    assert found["edge.coarse.near_um"] < 0.25 * found["edge.coarse.mesh_near_um"]
    assert found["edge.coarse.beyond_um"] < 0.25 * found["edge.coarse.mesh_beyond_um"]
    # The truth is stiffer: its cells along the edge are a millimetre long and more.
    assert 0.75 * found["edge.truth_force_n"] < found["edge.coarse.force_n"] < found["edge.truth_force_n"] < 2.5


@pytest.mark.slow
def test_markers_are_no_farther_than_the_mesh(tmp_path):
    """With volume blocks the mesh itself is near; the skin is no farther, and off by a tenth of its motion."""
    bench_coat.Args(out=tmp_path, levels="coarse", shapes="ball", cell_um=150.0).run()
    found = {key: float(value) for key, value in read_metrics(tmp_path / "metrics.json").items() if key.startswith("ball")}
    for load in ("force", "depth"):
        start = f"ball.{load}.coarse"
        assert found[f"{start}.markers_most_um"] < found[f"{start}.mesh_markers_most_um"]
        assert found[f"{start}.markers_um"] < found[f"{start}.mesh_markers_um"] < 0.15 * found[f"ball.{load}.truth.markers_um"]
    for load in ("shear", "twist"):
        assert 0.0 < found[f"ball.{load}.coarse.markers_um"] < 0.4 * found[f"ball.{load}.truth.markers_um"]
    assert found["ball.force.coarse.force_n"] == pytest.approx(0.33, rel=0.01)
    assert found["ball.depth.coarse.force_n"] > found["ball.depth.truth.force_n"] > 0.3
    assert found["ball.depth.coarse.contact_mm2"] == pytest.approx(found["ball.depth.truth.contact_mm2"], rel=0.03)


def test_an_unknown_shape_is_named(tmp_path):
    with pytest.raises(InputError, match=r"shapes.*'cone'.*ball"):
        bench_coat.Args(out=tmp_path, shapes="cone").run()
