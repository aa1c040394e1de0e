"""The short chain gives intervals where the Laplace approximation fails, elsewhere this does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slipid.infer.posterior import short_chain as module
from slipid.infer.posterior.coordinates import Fitted
from slipid.infer.posterior.short_chain import short_chain
from slipid.infer.result import required
from slipid.search_space import Choice
from slipid.support.progress import Reporter
from tests.helpers import calibration
from tests.infer.posterior.test_electric import parts

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def chained():
    """Return a fit with a short chain."""
    fit, _ = calibration.experiment(12)
    chain = short_chain(required(fit.problem), Fitted.of(fit), 0, Reporter(quiet=True))
    assert chain is not None
    return replace(fit, chain=chain)


def test_draws_of_numbers_with_small_errors_are_those_of_the_laplace_approximation(
    chained, monkeypatch
):
    problem, fitted = required(chained.problem), Fitted.of(chained)
    none = np.zeros_like(fitted.covariance)
    monkeypatch.setattr(module, "added_covariance", lambda *_: none)
    chain = short_chain(problem, fitted, 0, Reporter(quiet=True))
    std = np.sqrt(np.diag(chained.covariance))
    sharp = np.flatnonzero(std < 0.02)
    assert len(sharp) >= 3
    error = 1 / np.sqrt(2 * chain.effective[sharp])
    ratio = chain.flat[:, sharp].std(axis=0) / std[sharp]
    assert (np.abs(ratio - 1) < 4 * error).all()
    sources = [e.source for e in chained.parameters.values() if e.interval90 is not None]
    assert {"laplace", "short_chain"} == set(sources)


def test_the_chain_is_the_same_for_the_same_seed(chained):
    problem, fitted = required(chained.problem), Fitted.of(chained)
    again = short_chain(problem, fitted, 0, Reporter(quiet=True))
    np.testing.assert_array_equal(again.z, chained.chain.z)


@pytest.mark.parametrize("electric", [False, True])
def test_uncertain_variances_widen_the_draws(chained, monkeypatch, electric):
    problem, fitted = required(chained.problem), Fitted.of(chained)
    narrow = np.sqrt(np.diag(fitted.covariance)) < 0.02
    sharp = np.flatnonzero(narrow & (problem.space.electric == electric))
    assert sharp.size
    added = np.zeros_like(fitted.covariance)
    added[sharp, sharp] = 8 * np.diag(fitted.covariance)[sharp]
    monkeypatch.setattr(module, "added_covariance", lambda *_: added)
    wide = short_chain(problem, fitted, 0, Reporter(quiet=True)).flat.std(axis=0)
    ratio = wide[sharp] / np.sqrt(np.diag(fitted.covariance)[sharp])
    np.testing.assert_allclose(ratio, 3.0, rtol=0.15)


def test_a_chain_that_refuses_electric_proposals_is_of_no_use(chained, monkeypatch):
    drawn = module.electric_given_motion

    def refusing(*given):
        x, moved = drawn(*given)
        return x, np.zeros_like(moved)

    monkeypatch.setattr(module, "electric_given_motion", refusing)
    problem, fitted = required(chained.problem), Fitted.of(chained)
    assert short_chain(problem, fitted, 0, Reporter(quiet=True)) is None


def test_a_fit_of_electric_numbers_alone_has_no_chain():
    first, _, covariance = parts([Choice("*", free=False), Choice("motor.resistance", free=True)])
    problem = first.problem
    log_v = 2 * np.log(problem.noise.typical)
    fitted = Fitted(np.asarray(first.anchor.z), log_v, covariance)
    assert short_chain(problem, fitted, 0, Reporter(quiet=True)) is None


def test_its_convergence_is_not_judged_by_packages_of_an_extra():
    assert module.SHORT.most - module.SHORT.warm_up[-1] < 4
