"""Draws of a short chain, and where they contradict the Laplace approximation."""

from __future__ import annotations

import numpy as np
import pytest

from slipid.infer.verdicts.draws import Draws


def gaussian(seed: int, std: float = 1.0, shape: tuple[int, int, int] = (64, 8, 1)) -> Draws:
    return Draws(std * np.random.default_rng(seed).standard_normal(shape))


def test_independent_draws_all_count_and_walkers_at_rest_count_once():
    many = [gaussian(seed).effective[0] for seed in range(40)]
    assert np.mean(many) == pytest.approx(64 * 8, rel=0.1)
    assert max(many) <= 64 * 8
    still = Draws(np.broadcast_to(gaussian(0, shape=(64, 1, 1)).z, (64, 8, 1)))
    assert still.effective[0] == pytest.approx(64, rel=0.05)


def test_a_gaussian_is_seldom_contradicted_and_a_wider_or_skewed_one_always():
    mean, unit = np.zeros(1), np.eye(1)
    found = [gaussian(seed).contradict(mean, unit) for seed in range(200)]
    assert np.mean(found) < 0.1
    assert all(gaussian(seed, 1.5).contradict(mean, unit) for seed in range(20))
    skewed = [Draws(np.log(np.exp(gaussian(s).z) + 1.0)) for s in range(20)]
    assert all(
        one.contradict(one.flat.mean(axis=0), np.cov(one.flat.T)[None, None]) for one in skewed
    )


def test_correlations_count_as_much_as_widths():
    mean, covariance = np.zeros(2), np.array([[1.0, 0.9], [0.9, 1.0]])
    assert gaussian(0, shape=(64, 8, 2)).contradict(mean, covariance)
    root = np.linalg.cholesky(covariance)
    right = [Draws(gaussian(s, shape=(64, 8, 2)).z @ root.T) for s in range(100)]
    assert np.mean([one.contradict(mean, covariance) for one in right]) < 0.15


def test_draws_of_walkers_that_do_not_move_or_disagree_or_are_not_finite_are_useless():
    assert gaussian(0).useful
    still = np.broadcast_to(gaussian(0, shape=(64, 1, 1)).z, (64, 8, 1))
    assert not Draws(still).useful
    apart = gaussian(0).z + np.where(np.arange(64) < 32, -3.0, 3.0)[:, None, None]
    assert not Draws(apart).useful
    broken = gaussian(0).z.copy()
    broken[3, 2] = np.nan
    assert not Draws(broken).useful
