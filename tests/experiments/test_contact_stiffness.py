"""The bound that two-way coupling takes for a pad's stiffness is one, and no wild one."""

from __future__ import annotations

import pytest

from experiments import contact_stiffness
from raytac.errors import InputError
from raytac.io.metrics import read_metrics


def test_a_ball_presses_no_stiffer_than_the_bound_says(tmp_path) -> None:
    contact_stiffness.main(contact_stiffness.Args(out=tmp_path / "run", shapes=("ball",), depth_mm=0.2, device="cpu"))
    found = read_metrics(tmp_path / "run" / "metrics.json")
    assert float(found["contact_stiffness.ball.coarse.least"]) > 1.0
    for name, most in (("normal", 6.0), ("shear", 2.0), ("twist", 4.0)):
        true, bound = (float(found[f"contact_stiffness.ball.coarse.{name}{end}"]) for end in ("", "_bound"))
        assert 0.0 < true < bound < most * true


def test_unknown_shapes_are_named() -> None:
    with pytest.raises(InputError, match=r"shapes = 'cup'.*ball, face, plate"):
        contact_stiffness.main(contact_stiffness.Args(shapes=("cup",)))
