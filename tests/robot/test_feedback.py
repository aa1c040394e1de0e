"""Feedback gains as SysId designs them, against WPILib's published numbers and against SciPy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.linalg import expm, fractional_matrix_power, solve_discrete_are

from slipid.model.feedforward import Feedforward, Gain
from slipid.robot.feedback import FeedbackDemand, FeedbackGains, position_gains, velocity_gains

SYSID = FeedbackDemand(velocity_error=1.5, position_error=1.0, effort=7.0)
"""Demands in the tests of SysId."""


def motor(kS=0.3, kV=0.05, kA=0.01, verdicts=("identified", "identified")):
    kinds = zip((kV, kA), ("V*s/rad", "V*s^2/rad"), verdicts, strict=True)
    return Feedforward("m", Gain(kS, "V"), *(Gain(x, u, verdict=v) for x, u, v in kinds))


def by_scipy(kV, kA, d, states):
    """Gains of the same loop, discretised and solved by SciPy; states 1 is a velocity loop."""
    rates = np.array([[0, 1, 0], [0, -kV / kA, 1 / kA], [0, 0, 0]])
    whole = expm(rates * d.period_s)
    a, b = whole[2 - states : 2, 2 - states : 2], whole[2 - states : 2, 2:]
    errors = np.array([d.position_error, d.velocity_error])[2 - states :]
    effort = np.array([[d.effort**-2.0]])
    x = solve_discrete_are(a, b, np.diag(errors**-2.0), effort)
    gains = np.linalg.solve(effort + b.T @ x @ b, b.T @ x @ a)
    return (gains @ fractional_matrix_power(a - b @ gains, d.delay_s / d.period_s)).real[0]


@pytest.mark.parametrize(
    ("kV", "kA", "more", "published", "within"),
    [
        (3.060, 0.327, {}, 2.11, 0.005),
        (0.0693, 0.1170, {}, 3.11, 0.005),
        # the output of 12 V is 1, and the speed is per minute
        (1.97, 0.179, {"period_s": 1e-3, "delay_s": 0.0815}, 0.000417 * 12 * 60, 0.005),
    ],
)
def test_velocity_gains_are_those_in_the_tests_of_sysid(kV, kA, more, published, within):
    demand = FeedbackDemand(1.5, 1.0, 7.0, **more)
    (kP,) = velocity_gains(kV, kA, demand)
    assert kP == pytest.approx(published, abs=max(within, 0.02 * published * bool(more)))


def test_position_gains_are_those_in_the_tests_of_wpimath():
    demand = FeedbackDemand(math.sqrt(5.0), 1.0, 2.0, period_s=5e-3)
    found = position_gains(3.02, 0.642, demand)
    assert found == pytest.approx([1.9960017786537287, 0.51182128351092726], abs=1e-10)


def test_delays_are_compensated_as_in_the_tests_of_wpimath():
    """An elevator of 8 kg on four 775pro motors behind a gear of 14.67."""
    ohm, radius, gear = 12 / (4 * 134), 0.75 * 0.0254, 14.67
    torque_constant, free = 0.71 / 134, 18730 * 2 * math.pi / 60
    kV = gear / radius * (12 - ohm * 4 * 0.7) / free
    kA = ohm * radius * 8 / (gear * torque_constant)
    demand = FeedbackDemand(0.2, 0.1, 12.0)
    late = FeedbackDemand(0.2, 0.1, 12.0, delay_s=0.01)
    assert position_gains(kV, kA, demand) == pytest.approx([10.38, 0.69], abs=5e-3)
    assert position_gains(kV, kA, late) == pytest.approx([8.97115941, 0.07904881], abs=1e-5)


@pytest.mark.parametrize("delay", [0.0, 0.01, 0.05])
@pytest.mark.parametrize(("kV", "kA"), [(0.05, 0.01), (0.05, 1e-5), (3.0, 0.6), (0.4, 2.0)])
def test_gains_solve_the_riccati_equation_of_scipy(kV, kA, delay):
    demand = FeedbackDemand(50.0, 0.6, 7.0, 0.02, delay)
    for states, found in ((1, velocity_gains), (2, position_gains)):
        expected = by_scipy(kV, kA, demand, states)
        assert found(kV, kA, demand) == pytest.approx(expected, rel=1e-7, abs=1e-12)


def test_a_whole_delay_is_the_same_as_a_prediction_by_that_many_periods():
    late = FeedbackDemand(1.5, 1.0, 7.0, delay_s=2 * 0.02)
    (plain,), (found,) = velocity_gains(3.06, 0.327, SYSID), velocity_gains(3.06, 0.327, late)
    a = math.exp(-3.06 / 0.327 * 0.02)
    closed = a - (1 - a) / 3.06 * plain
    assert found == pytest.approx(plain * closed**2)


def test_defaults_are_those_of_sysid():
    found = FeedbackGains.of(motor())
    demand = found.demand
    assert demand.velocity_error == pytest.approx((12 - 0.3) / 0.05 / 4)
    assert demand.position_error == pytest.approx(0.2 * math.pi)
    assert (demand.effort, demand.period_s, demand.delay_s) == (7.0, 0.02, 0.0)
    assert found.velocity_kP == velocity_gains(0.05, 0.01, demand)[0]
    assert (found.position_kP, found.position_kD) == tuple(position_gains(0.05, 0.01, demand))
    given = FeedbackGains.of(motor(), SYSID)
    assert given.velocity_kP == velocity_gains(0.05, 0.01, SYSID)[0]


def test_feedback_has_the_weaker_verdict_of_the_two_gains():
    assert FeedbackGains.of(motor(verdicts=("weak", "not_identified"))).verdict == "not_identified"
    assert FeedbackGains.of(motor(verdicts=("weak", "fixed"))).verdict == "weak"


@pytest.mark.parametrize("part", [{"kS": 13.0}, {"kV": -0.1}, {"kA": 0.0}])
def test_there_is_no_feedback_for_a_motor_that_cannot_be(part):
    assert FeedbackGains.of(motor(**part)) is None
