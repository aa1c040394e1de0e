"""Maps to nearly Gaussian coordinates: learnt, inverted, compiled once, stored in files."""

from __future__ import annotations

import numpy as np

from slipid.infer.posterior.blocks import ChainBlock, packed, unpacked
from slipid.infer.posterior.transport_map import Warp, _placed, learnt


def test_a_map_makes_draws_gaussian(bent):
    map, x = bent
    u = map.forward(x)
    np.testing.assert_allclose(u.std(axis=0), 1.0, atol=0.05)
    before = ((x - x.mean(axis=0)) ** 4).mean(axis=0) / x.var(axis=0) ** 2
    after = (u**4).mean(axis=0)
    assert (before[[3, 4, 8]] > 6).all()
    assert (np.abs(after - 3) < 1).all()
    bend = np.corrcoef(u[:, 2] ** 2, u[:, 3])[0, 1]
    width = np.corrcoef(u[:, 2], u[:, 4] ** 2)[0, 1]
    assert max(abs(bend), abs(width)) < 0.06
    assert np.abs(np.corrcoef(u.T) - np.eye(9)).max() < 0.06


def test_a_map_is_inverted_and_has_correct_slopes(bent):
    map, x = bent
    u = map.forward(x[:5])
    back, log = map.placed(u)
    np.testing.assert_allclose(back, x[:5], atol=1e-12)

    def value(u):
        x, log = map.placed(u)
        return -0.5 * (x**2).sum(axis=1) + log.sum(axis=1)

    step = 1e-6 * np.eye(9)
    jacobian = np.stack(
        [(map.placed(u + s)[0] - map.placed(u - s)[0]) / 2e-6 for s in step], axis=2
    )
    np.testing.assert_allclose(log.sum(axis=1), np.linalg.slogdet(jacobian)[1], atol=1e-7)
    numeric = np.stack([(value(u + s) - value(u - s)) / 2e-6 for s in step], axis=1)
    np.testing.assert_allclose(map.pulled_back(u, np.negative), numeric, atol=1e-7)


def test_maps_that_have_learnt_different_things_are_compiled_once(bent):
    map, x = bent
    other = learnt(np.flip(x, axis=1), 500.0, np.eye(9), np.repeat([-1, 0, 0], 3))
    assert not np.array_equal(other.factors, map.factors)
    u = np.random.default_rng(5).normal(size=(5, 9))
    map.placed(u)
    before = _placed._cache_size()
    x, _ = other.placed(u)
    assert _placed._cache_size() == before
    np.testing.assert_allclose(other.forward(x), u, atol=1e-9)


def test_a_map_is_stored_exactly(bent, tmp_path):
    map, _ = bent
    chain, log_prob = np.zeros((1, 2, 3, 9)), np.zeros((1, 2, 3))
    random = np.zeros((1, 624), np.uint32), np.zeros((1, 3))
    block = ChainBlock(7, chain, log_prob, random, np.zeros(1), map, np.array([0.3]))
    np.savez(tmp_path / "block.npz", **packed(block))
    with np.load(tmp_path / "block.npz", allow_pickle=False) as kept:
        again = unpacked(dict(kept))
    assert again.map.shift.any()
    u = np.random.default_rng(4).normal(size=(6, 9))
    for one, other in zip(map.placed(u), again.map.placed(u), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_warp_is_inverted_and_its_slope_is_a_derivative():
    rng = np.random.default_rng(0)
    draws = np.stack([rng.gamma(2.0, size=3000), -np.log(rng.gamma(1.0, size=3000))], axis=1)
    warp = Warp.learnt(draws)
    y = warp.forward(draws)
    np.testing.assert_allclose(warp.back(y), draws, rtol=1e-9)
    h = 1e-6
    numeric = np.log((warp.back(y + h) - warp.back(y - h)) / (2 * h))
    np.testing.assert_allclose(warp.log_slope(y), numeric, atol=1e-5)
    from scipy.stats import skew

    assert (np.abs(skew(draws)) > 0.9).all()
    assert (np.abs(skew(y)) < 0.2).all()
