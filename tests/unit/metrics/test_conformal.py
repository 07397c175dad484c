"""Conformal intervals cover as often as they promise, whatever the errors look like."""

from __future__ import annotations

import math

import numpy as np
import pytest

from gpe_pl.metrics.conformal import (
    chance_range,
    conformal_factor,
    conformal_factor_of_nodes,
    conformal_interval,
    conformal_scores,
    coverage,
    fewest_scenes,
    interval_score,
)


def test_scores_are_errors_over_scales() -> None:
    assert conformal_scores([1.0, 2.0], [2.0, 0.0], [0.5, 4.0]).tolist() == [2.0, 0.5]
    assert conformal_scores([1.0, math.nan, math.inf], [1.5, 0.0, 0.0]).tolist() == [0.5, math.inf, math.inf]


def test_factor_is_an_order_statistic() -> None:
    scores = np.arange(1.0, 10.0)
    assert conformal_factor(scores, 0.9) == 9.0  # (9 + 1) 0.9 = 9
    assert conformal_factor(scores, 0.5) == 5.0
    assert conformal_factor(scores, 0.91) == math.inf
    assert [fewest_scenes(level) for level in (0.5, 0.8, 0.9, 0.95)] == [1, 4, 9, 19]
    for level in (0.5, 0.8, 0.9, 0.95):
        number = fewest_scenes(level)
        assert math.isfinite(conformal_factor(np.ones(number), level)) and math.isfinite(
            conformal_factor_of_nodes([np.ones(2)] * number, level)
        )
        assert conformal_factor(np.ones(number - 1), level) == conformal_factor_of_nodes([np.ones(2)] * (number - 1), level) == math.inf


@pytest.mark.parametrize("level", [0.5, 0.9])
def test_intervals_cover_skewed_errors(level: float) -> None:
    """The average over many draws is at least the level, and above it by at most 1 / (n + 1)."""
    rng, n, covered = np.random.default_rng(0), 19, []
    for _ in range(1500):
        scale = rng.exponential(size=n + 1) + 0.1
        estimate = rng.normal(size=n + 1)
        truth = estimate + scale * rng.exponential(size=n + 1) ** 2
        factor = conformal_factor(conformal_scores(estimate[:n], truth[:n], scale[:n]), level)
        covered.append(coverage(*conformal_interval(estimate[n:], scale[n:], factor), truth[n:]))
    assert level - 0.02 < np.mean(covered) < level + 1 / (n + 1) + 0.02


def test_nodes_of_a_scene_are_one_draw() -> None:
    """Nodes of a scene share an error. Whoever pools them as independent covers too little; the factor of nodes covers as promised."""
    rng, n = np.random.default_rng(1), 12
    own: list[float] = []
    pooled: list[float] = []
    for _ in range(500):
        sizes = rng.integers(1, 40, size=n + 1)
        scenes = [np.abs(rng.standard_t(2)) * (10.0 if size < 10 else 1.0) + rng.random(size) for size in sizes]
        for found, factor in (
            (own, conformal_factor_of_nodes(scenes[:n], 0.9)),
            (pooled, conformal_factor(np.concatenate(scenes[:n]), 0.9)),
        ):
            found.append(float(np.mean(scenes[n] <= factor)))
    assert np.mean(own) > 0.89
    assert np.mean(pooled) < 0.88


def test_factor_of_nodes_is_the_smallest() -> None:
    scenes = [np.array([1.0, 2.0, 3.0, 4.0])] * 19
    assert conformal_factor_of_nodes(scenes, 0.9) == 4.0  # 19 u + 1 ≤ 2 allows a fraction of 1/19, so no node of a scene is left out
    assert conformal_factor_of_nodes(scenes, 0.7) == 3.0
    uneven = [np.array([1.0]), np.full(1000, 5.0), np.array([2.0])]
    assert conformal_factor_of_nodes(uneven, 0.5) == 2.0  # 1000 nodes weigh as much as one


def test_interval_score_prefers_true_quantiles() -> None:
    assert interval_score([0.0], [1.0], [0.5], 0.9).tolist() == [1.0]
    assert interval_score([0.0, 0.0], [1.0, 1.0], [-0.5, 2.0], 0.9) == pytest.approx([11.0, 21.0])
    truth = np.random.default_rng(2).normal(size=20000)
    score = {
        width: interval_score(np.full_like(truth, -width), np.full_like(truth, width), truth, 0.9).mean() for width in (1.3, 1.645, 2.0)
    }
    assert score[1.645] < score[1.3] and score[1.645] < score[2.0]


def test_chance_range_is_that_of_repeated_draws() -> None:
    rng, observed = np.random.default_rng(3), []
    for _ in range(4000):
        scores = rng.random(50)
        observed.append(float(np.mean(scores[30:] <= conformal_factor(scores[:30], 0.9))))
    low, high = chance_range(30, 20, 0.9)
    assert low < 0.9 < high
    assert 0.88 < np.mean([low <= value <= high for value in observed]) <= 1
    narrow = chance_range(3000, 2000, 0.9)
    assert low < narrow[0] < 0.9 < narrow[1] < high


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: conformal_factor([1.0], 1.0), "between 0 and 1"),
        (lambda: conformal_factor([math.nan], 0.5), "not NaN"),
        (lambda: conformal_factor_of_nodes([np.ones(2), np.ones(0)], 0.5), "no nodes"),
        (lambda: conformal_scores([1.0], [1.0, 2.0]), "shape"),
        (lambda: conformal_scores([1.0], [math.inf]), "not finite"),
        (lambda: conformal_scores([1.0], [1.0], 0.0), "not positive"),
        (lambda: chance_range(8, 10, 0.9), "at least 9"),
    ],
)
def test_wrong_input_is_refused(call: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()  # type: ignore[operator]
