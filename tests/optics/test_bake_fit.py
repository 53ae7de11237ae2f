"""The fit of the virtual calibration: polynomials that are known come back, and what was not sampled is said to be so."""

from __future__ import annotations

import numpy as np
import pytest

from raytac.optics.taxim.bake.fit import BinSums
from raytac.optics.taxim.table import polynomial_basis, slope_bins

SIZE = (80, 60)
BINS = 15


def known(i: np.ndarray, j: np.ndarray, column: np.ndarray, row: np.ndarray) -> np.ndarray:
    """Levels (N, 3) of a polynomial of the position that differs from bin to bin."""
    a = polynomial_basis(column, row)
    scale = np.array([1e-3, -2e-3, 5e-4, 0.05, -0.1, 3.0])
    return np.stack([a @ scale * (1 + i + c) + 0.2 * j for c in range(3)], axis=-1)


def anywhere(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.integers(0, SIZE[0], count), rng.integers(0, SIZE[1], count)


def test_known_polynomials_come_back_in_pixels() -> None:
    sums = BinSums(BINS, SIZE)
    for i, j in ((3, 0), (3, 7), (9, 13)):
        column, row = anywhere(500, seed=i + j)
        ij = np.full(500, i), np.full(500, j)
        sums.add(*ij, column, row, known(*ij, column, row))
    fit = sums.solve(neighbours=0.0, ridge=1e-9)
    column, row = anywhere(50, seed=99)
    for i, j in ((3, 0), (3, 7), (9, 13)):
        assert fit.degree[i, j] == 2
        expected = known(np.full(50, i), np.full(50, j), column, row)
        found = np.einsum("nk,ck->nc", polynomial_basis(column, row), fit.gradients[:, i, j])
        # The ridge's floor of 0.3 samples beside 500 leaves a bias.
        assert np.abs(found - expected).max() < 2e-2 * np.abs(expected).max()


def test_samples_may_come_in_any_batches() -> None:
    rng = np.random.default_rng(1)
    i, j = rng.integers(0, BINS - 1, 4000), rng.integers(0, BINS - 1, 4000)
    column, row = anywhere(4000)
    levels = rng.normal(size=(4000, 3))
    whole, parts = BinSums(BINS, SIZE), BinSums(BINS, SIZE)
    whole.add(i, j, column, row, levels)
    for some in np.array_split(rng.permutation(4000), 7):
        parts.add(i[some], j[some], column[some], row[some], levels[some])
    a, b = (s.solve(neighbours=0.3, ridge=1e-4) for s in (whole, parts))
    assert np.array_equal(a.counts, b.counts)
    np.testing.assert_allclose(a.gradients, b.gradients, atol=1e-9)


def test_few_or_badly_spread_samples_lower_the_degree() -> None:
    sums = BinSums(BINS, SIZE)
    column, row = anywhere(400)

    def add(i: int, columns: np.ndarray, rows: np.ndarray) -> None:
        ij = np.full(len(columns), i), np.full(len(columns), 5)
        sums.add(*ij, columns, rows, np.full((len(columns), 3), 7.0))

    add(1, column, row)  # all over the image
    add(3, column[:20], row[:20])  # too few for a quadratic
    add(5, column[:5], row[:5])  # too few for anything but a mean
    add(7, 40 + column % 3, 30 + row % 3)  # many, but in one place
    add(9, column, np.full(400, 30))  # on one line: y cannot be told
    fit = sums.solve(neighbours=0.0, ridge=1e-4)
    assert [int(fit.degree[i, 5]) for i in (1, 3, 5, 7, 9)] == [2, 1, 0, 0, 0]
    for i in (5, 7, 9):
        assert (fit.gradients[:, i, 5, :5] == 0).all()
        np.testing.assert_allclose(fit.gradients[:, i, 5, 5], 7.0)


def test_uncovered_bins_are_named_and_filled_from_the_nearest_magnitude() -> None:
    sums = BinSums(BINS, SIZE)
    column, row = anywhere(200)
    for i, j, level in ((2, 4, 10.0), (6, 4, 30.0)):
        sums.add(np.full(200, i), np.full(200, j), column, row, np.full((200, 3), level))
    fit = sums.solve(neighbours=0.3, ridge=1e-4)
    assert sorted(zip(*np.nonzero(fit.covered), strict=True)) == [(2, 4), (6, 4)]
    assert (fit.degree[~fit.covered] == -1).all() and (fit.counts[~fit.covered] == 0).all()
    middle = polynomial_basis(np.array(40), np.array(30))
    level = np.einsum("k,cijk->cij", middle, fit.gradients)[0]
    np.testing.assert_allclose(level[[0, 3, 4, 5, 14], 4], [10, 10, 10, 30, 30], atol=1e-6)  # half-way: the gentler one
    np.testing.assert_allclose(level[:, 9], level[:, 4])  # a direction without samples takes the nearest direction


def test_direction_pi_is_the_bin_before_it() -> None:
    sums = BinSums(BINS, SIZE)
    column, row = anywhere(300)
    i, j = slope_bins(np.full(300, -0.5), np.zeros(300), BINS)
    assert set(j) == {BINS - 1}
    sums.add(i, j, column, row, np.full((300, 3), 9.0))
    fit = sums.solve(neighbours=0.0, ridge=1e-4)
    assert fit.covered[i[0], BINS - 1] and fit.covered[i[0], BINS - 2]
    assert np.array_equal(fit.gradients[:, :, -1], fit.gradients[:, :, -2])


def test_neighbours_steady_a_bin_with_few_samples() -> None:
    rng = np.random.default_rng(3)
    errors = {}
    for weight in (0.0, 0.5):
        sums = BinSums(BINS, SIZE)
        for i in range(4, 7):
            for j in range(4, 7):
                count = 4 if (i, j) == (5, 5) else 400
                column, row = anywhere(count, seed=10 * i + j)
                noise = np.random.default_rng(i + 20 * j).normal(0, 5.0, (count, 3))
                sums.add(np.full(count, i), np.full(count, j), column, row, 20.0 + 0.2 * column[:, None] + noise)
        fit = sums.solve(neighbours=weight, ridge=1e-4)
        column, row = rng.integers(0, SIZE[0], 400), rng.integers(0, SIZE[1], 400)
        found = np.einsum("nk,ck->nc", polynomial_basis(column, row), fit.gradients[:, 5, 5])
        errors[weight] = np.abs(found - 20.0 - 0.2 * column[:, None]).mean()
        assert fit.counts[5, 5] == 4
    assert errors[0.5] < 0.3 * errors[0.0]


@pytest.mark.parametrize("bad", [{"images": 0}, {"radius": (2e-3, 1e-3)}, {"bare_share": 1.5}, {"n_bins": 2}, {"pins": -1}])
def test_impossible_settings_are_refused(bad: dict[str, object]) -> None:
    from raytac.errors import InputError
    from raytac.optics.taxim.bake.settings import BakeSettings

    with pytest.raises(InputError, match=f"bake.{next(iter(bad))}"):
        BakeSettings(**bad)  # type: ignore[arg-type]
