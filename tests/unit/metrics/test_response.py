"""Rank correlation of a response with the material parameter over paired scenes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import spearmanr

from gpe_pl.metrics.response import rank_correlation

MODULI = np.array([1e6, 2e6, 4e6])


def test_it_is_the_mean_over_scenes() -> None:
    rising, falling = [1.0, 5.0, 6.0], [3.0, 2.0, 1.0]
    assert rank_correlation(MODULI, np.array([rising, rising])) == pytest.approx(1)
    assert rank_correlation(MODULI, np.array([rising, falling])) == pytest.approx(0)
    assert rank_correlation(MODULI[::-1], np.array([rising])) == pytest.approx(-1)


def test_it_is_spearmans_with_ties() -> None:
    response = np.array([[1.0, 2.0, 2.0, 0.5, 7.0]])
    parameter = np.array([1.0, 2.0, 3.0, 3.0, 5.0])
    assert rank_correlation(parameter, response) == pytest.approx(spearmanr(parameter, response[0]).statistic)


def test_scenes_without_change_or_with_a_failure_count_as_none() -> None:
    rising = [1.0, 2.0, 3.0]
    for none in ([5.0, 5.0, 5.0], [1.0, np.inf, 3.0], [1.0, 2.0, np.nan]):
        assert rank_correlation(MODULI, np.array([rising, none])) == pytest.approx(0.5)
    with pytest.raises(ValueError, match="different values"):
        rank_correlation(np.array([1.0, 1.0]), np.ones((1, 2)))
