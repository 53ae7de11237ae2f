"""Wilson's interval: its defining equation, the ends, and SciPy's."""

from __future__ import annotations

import pytest
from scipy.stats import binomtest

from raytac.errors import InputError
from raytac.report.measure import wilson_interval


@pytest.mark.parametrize(("successes", "trials"), [(0, 10), (3, 10), (97, 100), (100, 100)])
def test_it_is_wilsons_interval(successes: int, trials: int) -> None:
    low, high = wilson_interval(successes, trials)
    reference = binomtest(successes, trials).proportion_ci(method="wilson")
    assert (low, high) == pytest.approx((reference.low, reference.high), abs=1e-6)
    for p in (low, high):
        if 0.0 < p < 1.0:
            assert (successes / trials - p) ** 2 == pytest.approx(1.959964**2 * p * (1.0 - p) / trials)


def test_bad_input() -> None:
    for successes, trials in ((0, 0), (2, 1), (-1, 3)):
        with pytest.raises(InputError, match="number of trials"):
            wilson_interval(successes, trials)
