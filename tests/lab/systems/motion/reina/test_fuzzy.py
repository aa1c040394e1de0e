"""Fuzzy rules against hand calculations and scikit-learn."""

import numpy as np
import pytest
from sklearn.linear_model import Ridge

from slipid.lab.systems.motion.reina_indicators import Sugeno


def test_two_rules_by_hand():
    rules = Sugeno(2, np.array([0.1, 0.9]))
    assert rules.infer(np.array([[0.3]]))[0] == pytest.approx(0.7 * 0.1 + 0.3 * 0.9)
    assert rules.infer(np.array([[-1.0], [2.0]])) == pytest.approx([0.1, 0.9])


def test_two_inputs_with_two_sets_are_bilinear_and_the_last_changes_fastest():
    rng = np.random.default_rng(0)
    a, b, c, d = rng.normal(size=4)
    x, y = rng.random((2, 30))
    found = Sugeno(2, np.array([a, b, c, d])).infer(np.stack([x, y], axis=1))
    assert found == pytest.approx((1 - x) * ((1 - y) * a + y * b) + x * ((1 - y) * c + y * d))


def test_three_sets_are_linear_from_peak_to_peak():
    rules = Sugeno(3, np.array([0.2, 1.0, -0.4]))
    x = np.linspace(0.0, 1.0, 41)
    assert rules.infer(x[:, None]) == pytest.approx(np.interp(x, [0.0, 0.5, 1.0], [0.2, 1.0, -0.4]))
    strengths = Sugeno.logical_or(2, 3).strengths(np.random.default_rng(1).random((20, 2)))
    assert strengths.shape == (20, 9)
    assert strengths.sum(axis=1) == pytest.approx(np.ones(20))


def test_untrained_rules_are_a_logical_or():
    corners = np.array([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0]])
    assert Sugeno.logical_or(2, 2).infer(corners) == pytest.approx([0.0, 1.0, 1.0, 1.0])


def test_trained_consequents_are_those_of_ridge_regression_around_the_untrained():
    rng = np.random.default_rng(2)
    x, wanted = rng.random((50, 2)), (rng.random(50) < 0.5).astype(float)
    start = Sugeno.logical_or(2, 3)
    fires = start.strengths(x)
    ridge = Ridge(alpha=1.0, fit_intercept=False).fit(fires, wanted - fires @ start.consequents)
    assert start.trained(x, wanted).consequents == pytest.approx(start.consequents + ridge.coef_)


def test_a_rule_that_never_fires_keeps_its_output():
    start = Sugeno.logical_or(2, 2)
    trained = start.trained(np.tile([1.0, 0.0], (500, 1)), np.zeros(500))
    assert trained.consequents[[0, 1, 3]] == pytest.approx(start.consequents[[0, 1, 3]])
    assert trained.consequents[2] == pytest.approx(0.0, abs=0.01)
