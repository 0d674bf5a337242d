"""Our inverse distribution functions against scipy's, and the same to the last bit alone and in a batch."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import special

from pmutools.impair.quantiles import LEAST, MOST, gamma_quantile, normal_cdf, normal_quantile

GRID = np.concatenate([2.0 ** -np.arange(1, 54), 1 - 2.0 ** -np.arange(2, 54), np.linspace(0.0005, 0.9995, 4001)])


def test_normal_quantile() -> None:
    ours, reference = normal_quantile(GRID), special.ndtri(GRID)
    assert np.all(np.abs(ours - reference) <= 1e-14 * np.abs(reference))
    assert normal_quantile(np.array([0.5]))[0] == 0.0
    assert np.isfinite(normal_quantile(np.array([LEAST, MOST]))).all()


def test_normal_cdf_is_its_inverse() -> None:
    z = np.linspace(-8, 5, 200)
    again = normal_quantile(np.array([normal_cdf(value) for value in z.tolist()]))
    assert np.allclose(again, z, rtol=0, atol=1e-9)


@pytest.mark.parametrize("shape", [0.05, 0.2, 0.5, 1.0, 2.5, 64.0, 900.0, 1e4])
def test_gamma_quantile(shape: float) -> None:
    reference = np.where(GRID < 0.5, special.gammaincinv(shape, GRID), special.gammainccinv(shape, 1 - GRID))
    known = reference > 1e-280
    error = np.abs(gamma_quantile(shape)(GRID)[known] / reference[known] - 1)
    assert error.max() < (1e-7 if shape < 0.5 else 2e-9)


@pytest.mark.parametrize("function", [normal_quantile, gamma_quantile(2.5)])
def test_a_batch_is_its_values_one_by_one(function: object) -> None:
    assert callable(function)
    alone = [function(np.array([u]))[0] for u in GRID.tolist()]
    assert function(GRID).tolist() == alone
