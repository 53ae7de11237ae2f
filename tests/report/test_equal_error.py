"""What a sampled integrator pays for a given error, against the law that it follows."""

from __future__ import annotations

import math

import pytest

from raytac.report.compare.metrics import cost_at, spp_for_error


@pytest.mark.parametrize("target", [5.0, 2.0, 1.0, 0.3, 0.01])
def test_spp_for_error_inverts_a_monte_carlo_law(target: float) -> None:
    spp = (1, 4, 16, 64)
    errors = [8.0 / math.sqrt(n) for n in spp]
    assert spp_for_error(spp, errors, target) == pytest.approx((8.0 / target) ** 2, rel=1e-6)


def test_one_sample_is_the_least() -> None:
    assert spp_for_error((1, 4), [3.0, 1.5], 50.0) == 1.0


def test_cost_follows_the_measured_points_and_grows_on_beyond() -> None:
    assert cost_at((1, 4, 16), [2.0, 5.0, 17.0], 10.0) == pytest.approx(11.0)
    assert cost_at((1, 4, 16), [2.0, 5.0, 17.0], 160.0) == pytest.approx(170.0)
