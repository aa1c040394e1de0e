"""Thinned draws of chains, the std of load biases, and convergence."""

from __future__ import annotations

import tempfile
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm
from xarray import DataTree, open_datatree

from slipid.fitting.hierarchy import POOLED_RANGE, pooled_stds, stds_given
from slipid.fitting.problem import Problem
from slipid.infer.posterior.blocks import ChainBlock
from slipid.infer.posterior.sample import thinned, write
from slipid.search_space import Choice
from tests.helpers.made_windows import made, robot

STD = {"camera.place": 0.0005, "process.along": 0.003, "run.along": 0.01, "current.window": 0.05}
FREE = [
    Choice("*", free=False),
    Choice("surface.*.creep", free=True),
    Choice("surface.*.load_bias", free=True),
]


@pytest.fixture(scope="module")
def problem():
    truth = robot()
    return Problem(replace(made(truth, std=STD), has_voltage=False), truth, FREE)


def test_a_posterior_needs_no_room_where_the_system_has_temporary_files(tmp_path, monkeypatch):
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    for name in ("mkdtemp", "mkstemp", "gettempdir"):
        monkeypatch.setattr(tempfile, name, full)
    write(DataTree.from_dict({"posterior/x": ("draw", np.arange(3.0))}), tmp_path / "posterior.nc")
    assert [p.name for p in tmp_path.iterdir()] == ["posterior.nc"]
    with open_datatree(tmp_path / "posterior.nc", engine="h5netcdf") as tree:
        assert tree["posterior"]["x"].values.tolist() == [0.0, 1.0, 2.0]


def test_the_std_of_load_biases_has_the_posterior_that_its_likelihood_gives(problem):
    """Load biases with known likelihoods have a half-normal prior of their common std."""
    log_v, at, typical = 2 * np.log(problem.noise.typical), problem.space.pooled, 0.05
    now, sure = np.exp(0.5 * log_v[problem.objective.pooled]), 0.02**-2
    measured = np.array([0.06, -0.09, 0.12, -0.05])

    def moments(means):
        def density(s, power=0):
            spread = np.sqrt(s**2 + 1 / sure)
            return s**power * norm.pdf(s / typical) * np.prod(norm.pdf(means / spread) / spread)

        return np.array([quad(density, low, high, (k,))[0] for k in range(3)])

    low, high = np.array(POOLED_RANGE) * typical
    for means, near in ((measured, 2e-3), (np.zeros(4), 0.03)):  # the grid has steps of 6 %
        z = problem.space.start.copy()
        z[at] = means * sure / (sure + now**-2)
        precision = np.diag(np.where(at, sure + now**-2, 100.0))
        found = pooled_stds(precision, z, problem.objective, log_v)
        whole, first, second = moments(means)
        assert found.weight @ found.std == pytest.approx(first / whole, rel=near)
        assert found.weight @ found.std**2 == pytest.approx(second / whole, rel=near)


def test_the_std_of_some_coordinates_has_all_others_integrated_out():
    """Against the evidence of every candidate, from matrices of all coordinates."""
    rng, at, typical = np.random.default_rng(2), np.array([1, 4]), 0.05
    root = rng.standard_normal((6, 8))
    precision, pull = 100 * root @ root.T, 100 * rng.standard_normal(6)
    found = stds_given(precision, pull, at, typical)
    log = []
    for std in found.std:
        whole = precision.copy()
        whole[at, at] += std**-2
        evidence = 0.5 * pull @ np.linalg.solve(whole, pull) - 0.5 * np.linalg.slogdet(whole)[1]
        log.append(evidence - (len(at) - 1) * np.log(std) - 0.5 * (std / typical) ** 2)
    weight = np.exp(log - np.max(log))
    np.testing.assert_allclose(found.weight, weight / weight.sum(), rtol=1e-9)


def test_thinned_draws_are_spread_over_steps_and_walkers_and_keep_their_log_density():
    chain = np.arange(2 * 60 * 8, dtype=float).reshape(2, 60, 8, 1)
    random = np.zeros((2, 624), np.uint32), np.zeros((2, 3))
    blocks = [
        ChainBlock(k, part, 0.5 * part[..., 0], random, np.zeros(2), None)
        for k, part in enumerate(np.split(chain, 3, axis=1))
    ]
    x, log_prob = thinned(chain, blocks, 40)
    assert x.shape == (2, 40, 1)
    np.testing.assert_array_equal(log_prob, 0.5 * x[..., 0])
    step, walker = np.divmod(x[0, :, 0].astype(int), 8)
    assert (np.diff(step) > 0).all()
    assert step[0] < 2
    assert step[-1] >= 58
    assert np.bincount(walker, minlength=8).tolist() == [5] * 8
    many, _ = thinned(chain[:, :10], blocks[:1], 100)
    assert len(np.unique(many[0])) <= 80  # some repeat where there are too few
