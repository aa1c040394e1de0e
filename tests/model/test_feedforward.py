"""Feed-forward gains of made motors: closed forms, units, intervals and verdicts."""

from __future__ import annotations

import math

import jax.numpy as jnp
import numpy as np
import pytest

from slipid.model.feedforward import DriveNumbers, Feedforward, Gain, Known, feedforward
from slipid.model.motor import Motor

WHEEL = {
    "resistance": 1.8,
    "back_emf": 0.032,
    "coulomb_friction": 0.3,
    "viscous_friction": 0.02,
    "rotor_inertia": 1e-5,
    "load_inertia": 4e-3,
    "brush_drop": 0.4,
    "brush_current": 0.3,
    "efficiency": 0.8,
    "gear_ratio": 16.0,
}
"""A motor behind a gear, with a wheel."""


def exact(numbers):
    return {name: Known(value) for name, value in numbers.items()}


def simulated(volts, speed, acceleration, step=1e-6):
    """Torque that the motor `WHEEL` must lack at a voltage, from its equations of current."""
    m = WHEEL
    n, motor_speed = m["gear_ratio"], m["gear_ratio"] * speed
    dry = m["coulomb_friction"] / (n * m["efficiency"] * m["back_emf"])
    drop = m["brush_drop"] * (1 - math.exp(-dry / m["brush_current"]))
    current = (volts - drop - m["back_emf"] * motor_speed) / m["resistance"]
    shaft = m["back_emf"] * current - m["rotor_inertia"] * n * acceleration
    friction = m["coulomb_friction"] + m["viscous_friction"] * speed
    return n * m["efficiency"] * shaft - friction - m["load_inertia"] * acceleration


@pytest.mark.parametrize(("speed", "acceleration"), [(3.0, 0.0), (3.0, 20.0), (0.5, -2.0)])
def test_the_voltage_balances_all_torques_behind_a_gear(speed, acceleration):
    found = feedforward("wheel", exact(WHEEL))
    assert simulated(found.voltage(speed, acceleration), speed, acceleration) == pytest.approx(0.0)
    assert found.voltage(-speed, -acceleration) == -found.voltage(speed, acceleration)


def test_ks_is_the_voltage_of_a_motor_whose_current_only_overcomes_dry_friction():
    numbers = WHEEL | {"brush_shape": 0.6, "brush_tail": 0.2}
    found = feedforward("wheel", exact(numbers))
    motor = Motor(**{name: x for name, x in numbers.items() if name != "load_inertia"})
    dry = jnp.asarray([WHEEL["coulomb_friction"]]) / motor.gain
    volts = motor.voltage(dry, jnp.zeros(1))
    assert found.kS.value == pytest.approx(float(volts[0]), rel=1e-12)


def test_a_motor_without_gear_and_brushes_has_the_gains_of_the_textbook():
    plain = {k: WHEEL[k] for k in ("resistance", "back_emf", "rotor_inertia")}
    found = feedforward("m", exact(plain | {"coulomb_friction": 6e-3, "viscous_friction": 1e-5}))
    assert found.kS.value == pytest.approx(1.8 * 6e-3 / 0.032)
    assert found.kV.value == pytest.approx(0.032 + 1.8 * 1e-5 / 0.032)
    assert found.kA.value == pytest.approx(1.8 * 1e-5 / 0.032)
    assert [g.unit for g in found.gains.values()] == ["V", "V*s/rad", "V*s^2/rad"]


def test_at_standstill_dry_friction_acts_against_the_acceleration():
    found = Feedforward("m", Gain(0.5, "V"), Gain(1.0, "V*s/rad"), Gain(2.0, "V*s^2/rad"))
    assert found.voltage(0.0, 0.0) == 0.0
    assert found.voltage(0.0, 1.0) == 2.5
    assert found.voltage(0.0, -1.0) == -2.5
    assert found.voltage(1.0, -1.0) == -0.5


def test_other_units_mean_the_same_voltage():
    gains = (Gain.of(x, 0.1 * x, "V", "identified") for x in (0.5, 1.0, 2.0))
    found = Feedforward("m", *gains, radius=0.05)
    turns, metres = found.per_rotation(), found.per_metre()
    assert turns.kV.value * 3.0 == pytest.approx(found.kV.value * 3.0 * 2 * math.pi)
    assert metres.kA.value * 3.0 * 0.05 == pytest.approx(found.kA.value * 3.0)
    assert metres.kA.std == pytest.approx(0.1 * metres.kA.value)
    assert metres.kV.interval90[1] == pytest.approx(found.kV.interval90[1] / 0.05)
    assert (turns.kS, turns.kV.unit, metres.kA.unit) == (found.kS, "V*s/rot", "V*s^2/m")
    assert Feedforward("m", found.kS, found.kV, found.kA).per_metre() is None


def test_intervals_are_those_of_draws_of_the_numbers():
    """Log-normal numbers of ten percent, resistance and friction strongly correlated."""
    names = ("resistance", "back_emf", "coulomb_friction", "viscous_friction", "rotor_inertia")
    values = np.array([WHEEL[name] for name in names])
    correlation = np.eye(5)
    correlation[0, 2] = correlation[2, 0] = -0.8
    correlation[0, 1] = correlation[1, 0] = 0.5
    rng = np.random.default_rng(0)
    logs = rng.multivariate_normal(np.zeros(5), 0.01 * correlation, size=100_000)
    draws = DriveNumbers(*(values * np.exp(logs)).T, load_inertia=4e-3, gear_ratio=16.0).gains()
    numbers = {n: Known(v, 0.1 * v) for n, v in zip(names, values, strict=True)}
    fixed = {"load_inertia": Known(4e-3), "gear_ratio": Known(16.0)}
    whole = np.eye(7)
    whole[:5, :5] = correlation
    found = feedforward("wheel", numbers | fixed, whole)
    for gain, row in zip(found.gains.values(), np.asarray(draws), strict=True):
        assert gain.std == pytest.approx(row.std(), rel=0.04)
        assert gain.interval90 == pytest.approx(np.quantile(row, [0.05, 0.95]), rel=0.01)
        low, high = gain.interval90
        assert np.mean((row > low) & (row < high)) == pytest.approx(0.9, abs=0.01)
    independent = feedforward("wheel", numbers | fixed)
    assert independent.kS.std > 2 * found.kS.std


def test_a_gain_has_the_weakest_verdict_of_the_numbers_that_matter():
    numbers = exact(WHEEL) | {
        "resistance": Known(1.8, 0.05, "identified"),
        "back_emf": Known(0.032, 0.001, "identified"),
        "coulomb_friction": Known(0.3, 0.03, "weak"),
        "viscous_friction": Known(0.02, 1e-4, "not_identified"),
        "load_inertia": Known(4e-3, 2e-3, "not_identified"),
    }
    found = feedforward("wheel", numbers)
    assert [g.verdict for g in found.gains.values()] == ["weak", "identified", "not_identified"]
    assert feedforward("wheel", exact(WHEEL)).kA.verdict == "fixed"


def test_a_number_that_hardly_changes_a_gain_does_not_spoil_its_verdict():
    """Friction per speed is the only uncertain part of kV, and a hundredth of it."""
    unknown = Known(0.005, 0.005, "not_identified")
    found = feedforward("wheel", exact(WHEEL) | {"viscous_friction": unknown})
    assert found.kV.std < 0.05 * found.kV.value
    assert found.kV.verdict == "identified"
    prior = Known(1.8, 0.01, "not_identified")
    assert feedforward("wheel", exact(WHEEL) | {"resistance": prior}).kA.verdict == prior.verdict


def test_an_interval_of_a_positive_gain_stays_positive():
    low, high = Gain.of(0.1, 0.2, "V", "weak").interval90
    assert 0 < low < 0.1 < high
    assert Gain.of(-0.1, 0.2, "V", "weak").interval90[0] < -0.1
