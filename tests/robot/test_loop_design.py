"""The design of loops: the sampled plant, the Riccati equation, phase margins and their meaning."""

import numpy as np
import pytest
from scipy.linalg import expm, solve_discrete_are

from slipid.robot.loop_design import (
    Actuator,
    SampledPlant,
    design,
    exponential,
    riccati,
)

ROBOTINO = Actuator(0.12, 0.03, 0.05)
ACTUATORS = (
    ROBOTINO,
    Actuator(0.0, 0.0, 0.05),
    Actuator(0.05, 0.2, 0.05),
    Actuator(0.31, 0.1, 0.02),
)


def late(actuator, seconds):
    return Actuator(actuator.delay_s + seconds, actuator.lag_s, actuator.period_s)


def test_the_plant_moves_like_its_differential_equation():
    for delay, lag in ((0.12, 0.03), (0.1, 0.2), (0.0, 0.07)):
        plant = SampledPlant.of(Actuator(delay, lag, 0.05), 2)
        state, times = np.zeros(len(plant.matrix)), 0.05 * np.arange(1, 31)
        states = []
        for _ in times:
            state = plant.matrix @ state + plant.column[:, 0]
            states.append(state[:3])
        t = np.maximum(times - delay, 0.0)
        rate = 1 - np.exp(-t / lag)
        heading = t - lag * rate
        offset = 0.5 * t**2 - lag * t + lag**2 * rate
        np.testing.assert_allclose(states, np.stack([offset, heading, rate], axis=1), atol=1e-12)


def test_the_exponential_is_that_of_scipy():
    matrix = np.array([[0.0, 1.0, 0.0], [0.0, -500.0, 500.0], [0.3, -2.0, 0.0]])
    for scale in (0.0, 1e-6, 0.05, 3.0):
        np.testing.assert_allclose(exponential(scale * matrix), expm(scale * matrix), atol=1e-9)


@pytest.mark.parametrize("errors", [1, 2])
def test_the_riccati_equation_is_solved(errors):
    for actuator in ACTUATORS:
        plant = SampledPlant.of(actuator, errors)
        q = np.diag([1.0, 0.3, *[0.0] * len(plant.matrix)][: len(plant.matrix)])
        for rho in (1e-3, 1.0, 1e3):
            r = np.array([[rho]])
            oracle = solve_discrete_are(plant.matrix, plant.column, q, r)
            found = riccati(plant.matrix, plant.column, q, r)
            np.testing.assert_allclose(found, oracle, rtol=1e-6, atol=1e-8 * oracle.max())


def test_the_margin_of_a_pure_delay():
    """A held integrator with the gain k crosses at 2 sin(w T / 2) = k T, with the known phase."""
    k, delay = 2.0, 0.2
    for period in (0.05, 0.01):
        plant = SampledPlant.of(Actuator(delay, 0.0, period), 1)
        margin, crossover = plant.crossover(np.array([k]))
        w = 2 / period * np.arcsin(0.5 * k * period)
        assert crossover == pytest.approx(w / (2 * np.pi), rel=1e-4)
        assert margin == pytest.approx(np.degrees(np.pi / 2 - w * (delay + 0.5 * period)), abs=2e-3)
    plant = SampledPlant.of(Actuator(delay, 0.0, 1e-3), 1)
    exact = np.degrees(np.pi / 2 - k * delay)
    assert plant.crossover(np.array([k]))[0] == pytest.approx(exact, abs=0.1)


@pytest.mark.parametrize("lateral", [False, True])
@pytest.mark.parametrize("actuator", ACTUATORS)
def test_a_design_has_its_margin_in_extra_delay(actuator, lateral):
    """The loop stays stable for nearly the delay that its margin stands for, and not for more."""
    found = design(actuator, 60.0, lateral)
    assert found.margin_deg == pytest.approx(60.0, abs=0.01)
    extra = found.margin_deg / 360 / found.bandwidth_hz
    for part, stable in ((0.0, True), (0.95, True), (1.05, False)):
        plant = SampledPlant.of(late(actuator, part * extra), 1 + lateral)
        radius = np.abs(np.linalg.eigvals(plant.closed(np.array(found.gains)))).max()
        assert (radius < 1) == stable
        assert (plant.crossover(np.array(found.gains))[0] > 0) == stable


def test_gains_fall_with_delay_and_lag():
    for lateral in (False, True):
        by_delay = [design(late(ROBOTINO, s), 60.0, lateral).gains for s in (0.0, 0.02, 0.1, 0.5)]
        by_lag = [design(Actuator(0.1, s, 0.05), 60.0, lateral).gains for s in (0.0, 0.05, 0.3)]
        for series in (by_delay, by_lag):
            assert np.all(np.diff(np.array(series), axis=0) < 0)


def test_no_lateral_loop_of_this_margin_pulls_harder():
    found, plant = design(ROBOTINO, 60.0, lateral=True), SampledPlant.of(ROBOTINO, 2)
    most = 0.0
    for heading in np.linspace(0.3, 3.0, 28) * found.gains[1]:
        offsets = np.linspace(0.9, 1.5, 25) * found.gains[0]
        fits = [plant.crossover(np.array([one, heading]))[0] >= 60.0 for one in offsets]
        most = max(most, *(offsets * fits))
    assert most == pytest.approx(found.gains[0], rel=0.03)


def test_a_bound_of_the_gain_gives_a_larger_margin():
    free = design(ROBOTINO, 60.0)
    bound = design(ROBOTINO, 60.0, most=0.5 * free.gains[0])
    assert bound.gains[0] == pytest.approx(0.5 * free.gains[0], rel=1e-6)
    assert bound.margin_deg > 70 > free.margin_deg


def test_a_margin_that_no_linear_quadratic_loop_has_is_refused():
    with pytest.raises(ValueError, match="no gains have a phase margin of 95 deg"):
        design(ROBOTINO, 95.0)
