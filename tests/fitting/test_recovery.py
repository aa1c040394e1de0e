from __future__ import annotations

import functools

import numpy as np
import pytest
from scipy.stats import chi2

from slipid.data.windows import windows
from slipid.fitting.optimise import optimise
from slipid.fitting.problem import FitState, linear_given
from slipid.infer.summary import summarise
from slipid.lab.selftest.logs import nominal_robot, true_robot
from tests.helpers import recovery

SEEDS = (0, 1, 2)
NO_VOLTAGE = ("motor.resistance", "motor.back_emf")


@functools.cache
def recovered(seed):
    return recovery.recover(seed)


@pytest.mark.slow
def test_starts_are_two_fold_off_the_truth():
    space = recovery.problem().space
    off = space.start - space.vector(recovery.TRUTH)
    for k, name in enumerate(space.names):
        is_lead, is_bias = name.endswith(".lead"), ".load_bias" in name
        if name.startswith(("motor.", "surface.")) and not (is_lead or is_bias):
            assert abs(off[k]) == pytest.approx(np.log(2)), name


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_motor_and_curves_are_recovered(seed):
    found = recovered(seed)
    assert found.converged
    assert abs(found.relative_error("motor.resistance")) < 0.02
    assert abs(found.relative_error("motor.back_emf")) < 0.02
    assert max(found.curve_gap.values()) < 0.02


@pytest.mark.slow
def test_errors_are_as_large_as_the_fit_says():
    """Of coordinates the plan identifies; bench_recovery.py does it for 40 seeds.

    Loads are said to be less sure than they are here: two floors cannot show that the law of every
    floor is right about them, as it is in these logs.
    """
    names, sure = np.array(recovery.problem().space.names), recovery.design()
    z = np.stack([recovered(seed).score for seed in SEEDS])[:, sure]
    of_load = np.array(["load" in name for name in names[sure]])
    assert np.abs(z).max() < 4
    for chosen, least in ((~of_load, 5e-4), (of_load, 0.0)):
        some = z[:, chosen]
        low, high = chi2.ppf([least, 1 - 5e-4], some.size)  # as if none were correlated: stricter
        assert low < np.sum(some**2) < high
    assert z[:, ~of_load].size >= 8 * len(SEEDS)


@pytest.mark.slow
def test_plan_identifies_what_the_demo_promises():
    names, sure = recovery.problem().space.names, recovery.design()
    identified = {name for name, ok in zip(names, sure, strict=True) if ok}
    assert {"motor.resistance", "motor.back_emf", "motor.coulomb_friction"} <= identified
    assert {
        f"robot.load_share@{x}[{k}]" for x in ("as_built", "moved") for k in (1, 2)
    } < identified
    assert {"surface.soft.creep", "surface.soft.roller_drag", "surface.soft.lead"} <= identified


@pytest.mark.slow
def test_another_start_ends_at_the_same_place():
    problem = recovery.problem()
    found = recovered(0)
    mirrored = 2 * problem.space.vector(recovery.TRUTH) - problem.space.start
    start = FitState(mirrored, 2 * np.log(3 * problem.noise.typical), 0, np.inf, np.inf, "joint")
    end = optimise(problem, start=start)
    assert end.converged
    assert np.abs((end.state.z - found.z) / found.std).max() < 0.2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "scatter"),  # of one seed, relative, as measured over 40
    [("camera.heading", 0.10), ("process.soft.across", 0.12), ("run.soft.yaw", 0.16)],
)
def test_noise_is_recovered(name, scatter):
    found = np.mean([recovered(seed).noise[name] for seed in SEEDS])
    sure = 4 * scatter / np.sqrt(len(SEEDS))
    assert found == pytest.approx(recovery.SimulatedSensors().of(name), rel=sure)


@functools.cache
def without_voltage():
    problem = recovery.problem(voltage=False)
    end = optimise(problem)
    data = recovery.dataset(0, voltage=False)
    return problem, summarise(problem, end, data, recovery.choices())


@pytest.mark.slow
@pytest.mark.parametrize("path", NO_VOLTAGE)
def test_without_voltage_no_number_is_silent(path):
    _, fit = without_voltage()
    said = fit.parameters[path]
    assert said.verdict == "not_identified"
    assert said.provenance == "borrowed"
    assert any(path in text and "log the motor voltage" in text for text in fit.messages)


@pytest.mark.slow
def test_without_voltage_the_resistance_is_its_prior():
    problem, fit = without_voltage()
    at = problem.space.slices["motor.resistance"].start
    assert fit.z[at] == pytest.approx(problem.space.prior_mean[at], abs=1e-3)
    assert np.sqrt(fit.covariance[at, at]) == pytest.approx(problem.space.prior_std[at], rel=1e-6)


@pytest.mark.slow
def test_motion_does_not_need_the_voltage():
    problem, fit = without_voltage()
    full = recovered(0)
    for path in ("surface.soft.creep", "surface.soft.lead", "robot.load_share@moved"):
        mine = problem.space.slices[path]
        there = recovery.problem().space.slices[path]
        gap = (fit.z[mine] - full.z[there]) / full.std[there]
        assert np.abs(gap).max() < 0.2


@pytest.mark.slow
def test_windows_of_one_shape_share_what_is_compiled():
    problem, compiled = recovery.problem(), linear_given._cached._cache_size
    z = problem.space.start
    volt = problem.electric(z, 2 * np.log(problem.noise.typical))
    problem.linear(z, volt)
    before = compiled()
    other = problem.of(windows(recovery.dataset(7), 0.04, recovery.LAG))
    mine, theirs = problem.linear(z, volt)[0]["motion"], other.linear(z, volt)[0]["motion"]
    assert compiled() == before
    assert float(np.abs(np.asarray(mine) - np.asarray(theirs)).max()) > 1e-4
    again = other.of(problem.windows).linear(z, volt)[0]["motion"]
    np.testing.assert_array_equal(again, mine)


def test_blank_robot_knows_names_and_no_numbers():
    a, b = nominal_robot(recovery.PLAN), true_robot(recovery.PLAN)
    assert a.surfaces.labels == b.surfaces.labels == ("firm", "soft")
    assert a.body.loads == ("as_built", "moved")
    assert float(a.motor.resistance) != pytest.approx(5.5)
