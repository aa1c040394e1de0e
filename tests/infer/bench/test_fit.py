"""Fits of motors on a bench: recovery of made motors, theorems, and what a log does not show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slipid.infer.bench.fit import MotorFit, fit_motor
from slipid.infer.bench.motor import BenchRecord, noise
from slipid.infer.bench.open_loop import fit_open_loop
from slipid.infer.bench.rows import Between, excerpt
from slipid.infer.bench.signals import fitted_signals
from slipid.infer.bench.uncertainty import mixture_quantiles
from slipid.infer.bench.verdict import BenchFit, bench_fit
from slipid.infer.verdicts.estimates import Estimate
from tests.helpers import made_bench as made

SILENT = (1e-4, 1e-4, 1e-3)
RATE = int(made.RATE)
"""Rows per second of most logs, so that they share what is compiled."""
PAIR = ("motor.resistance", "motor.back_emf")


@pytest.fixture(scope="module")
def record() -> BenchRecord:
    """A log whose voltage jumps between rows."""
    return made.logged(made.driven(made.FLYWHEEL), RATE, seed=3)


@pytest.fixture(scope="module")
def motor_fit(record) -> MotorFit:
    return fit_motor([record], between="jumps")


@pytest.fixture(scope="module")
def found(motor_fit) -> BenchFit:
    return bench_fit([motor_fit])


@pytest.fixture(scope="module")
def held() -> BenchRecord:
    """A log whose voltage is held from row to row."""
    rows = made.driven(made.FLYWHEEL, profile=made.held)
    return made.logged(rows, RATE, seed=1, at_changes=True)


@pytest.fixture(scope="module")
def held_fit(held) -> MotorFit:
    return fit_motor([held])


def fitted(record: BenchRecord, between: Between | None = None) -> BenchFit:
    return bench_fit([fit_motor([record], between=between)])


def least_squares_of(record: BenchRecord) -> float:
    """Resistance from U = R I + C_e w + U_0 [ohm]."""
    columns = np.stack([record.current, record.speed, np.ones_like(record.time)], 1)
    return float(np.linalg.lstsq(columns, record.voltage, rcond=None)[0][0])


def holds(e: Estimate, true: float) -> bool:
    return e.interval90[0] <= true <= e.interval90[1]


# recovery ----------------------------------------------------------------------------------------


def assert_recovered(found: BenchFit, truth: dict[str, float]) -> None:
    """Assert that values are near the truth, and intervals neither too narrow nor too wide."""
    assert found.good
    for path in PAIR:
        e = found.parameters[path]
        assert holds(e, truth[path]), path
        assert e.value == pytest.approx(truth[path], rel=0.012)
        assert e.std < 0.015 * e.value
    for name in ("coulomb_friction", "viscous_friction", "rotor_inertia", "back_emf", "resistance"):
        e = found.parameters[f"motor.{name}"]
        assert e.verdict == "identified", name
        assert abs(e.value - truth[e.path]) < 3 * e.std < 0.2 * e.value, name
    for name in ("current_offset", "voltage_offset"):
        e = found.parameters[f"motor.{name}"]
        assert abs(e.value - truth[e.path]) < 3 * e.std, name


def test_a_motor_is_recovered_from_jumps_between_rows(found):
    assert_recovered(found, made.truth(made.FLYWHEEL))


def test_a_motor_is_recovered_from_held_voltages(held_fit):
    assert_recovered(bench_fit([held_fit]), made.truth(made.FLYWHEEL))


@pytest.mark.slow
def test_a_bare_rotor_needs_rows_in_its_time_constant():
    """Its time constant is 15 ms."""
    rows = made.driven(made.ROTOR, 5.0, 0.0, made.quick_steps)
    fast, slow = (fitted(made.logged(rows, rate)) for rate in (500, RATE))
    e = fast.parameters["motor.rotor_inertia"]
    assert e.verdict == "identified"
    assert e.value == pytest.approx(made.ROTOR, rel=0.03)
    assert slow.parameters["motor.rotor_inertia"].verdict == "not_identified"


@pytest.mark.slow
def test_inductance_needs_rows_in_its_time_constant(found):
    """Its time constant is 1.6 ms."""
    quick = made.driven(made.FLYWHEEL, 1.2, 0.0, made.quick_steps)
    fast = fitted(made.logged(quick, 2000), "jumps")
    e = fast.parameters["motor.inductance"]
    assert e.verdict == "identified"
    assert e.value == pytest.approx(8.9e-3, rel=0.03)
    assert found.parameters["motor.inductance"].verdict == "not_identified"
    assert any("motor.inductance is not identified at this sampling" in t for t in found.messages)


@pytest.mark.slow
def test_a_brush_drop_does_not_pass_for_resistance():
    rows = made.driven(made.FLYWHEEL, drop=0.6, profile=made.held)
    record = made.logged(rows, RATE, 1, at_changes=True)
    found = fitted(record).parameters
    assert least_squares_of(record) > 1.05 * 5.5
    # An inductance and a short delay of the speed have almost the same effect, but another R.
    assert found["motor.resistance"].value == pytest.approx(5.5, rel=0.02)
    assert found["motor.resistance"].std < 0.02 * 5.5
    assert found["motor.brush_drop"].value == pytest.approx(0.6, abs=0.05)


@pytest.mark.slow
def test_a_noisy_ammeter_does_not_make_the_resistance_small(held):
    """Least squares find a resistance of 4.9 ohm from 0.5 A of noise."""
    rng = np.random.default_rng(5)
    noisy = replace(held, current=held.current + 0.5 * rng.normal(size=len(held.time)))
    e = fitted(noisy, "held").parameters["motor.resistance"]
    assert least_squares_of(noisy) < 0.92 * 5.5
    assert e.value == pytest.approx(5.5, rel=0.04)
    assert holds(e, 5.5)


@pytest.mark.slow
def test_a_winding_that_warms_has_a_drift_and_a_range_of_resistances():
    rows = made.driven(made.FLYWHEEL, profile=made.held, warming=0.004)
    fit = fit_motor([made.logged(rows, RATE, 1, at_changes=True)], between="held")
    middle = 1 + 0.004 * 12.5
    e = bench_fit([fit]).parameters["motor.resistance_drift"]
    # The drift is relative to the resistance in the middle of the log.
    assert e.value == pytest.approx(0.004 / middle, rel=0.05)
    low, high = fit.ranges["motor.resistance"]
    assert low < 5.5 < 5.5 * 1.1 < high
    assert low > 0.93 * 5.5
    assert high < 1.18 * 5.5


def test_no_drift_is_fitted_to_a_winding_that_stays_cool(motor_fit, held_fit):
    for fit in (motor_fit, held_fit):
        assert "motor.resistance_drift" not in fit.space.slices


POSITIVE = (
    *("resistance", "back_emf", "inductance", "brush_drop", "coulomb_friction"),
    *("stribeck_friction", "viscous_friction", "rotor_inertia"),
)


@pytest.mark.slow
def test_what_cannot_be_negative_is_not(record):
    """The terminals have a voltage that rises with the current's sign: no brushes do this."""
    odd = replace(record, voltage=record.voltage - 0.5 * np.sign(record.current - 0.08))
    columns = [odd.current, odd.speed, np.sign(odd.current - 0.08), np.gradient(odd.current)]
    signs = np.linalg.lstsq(np.stack(columns, 1), odd.voltage, rcond=None)[0]
    assert signs[2] < -0.2
    motor = fit_motor([odd], between="jumps").motor
    for name in POSITIVE:
        assert float(getattr(motor, name)) > 0, name


# the voltage between rows ------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("form", ["held", "straight"])
def test_the_form_of_the_voltage_that_is_given_is_the_one_that_is_found(form, held, held_fit):
    record, fit = held, held_fit
    if form == "straight":
        rows = made.driven(made.FLYWHEEL, profile=made.straight)
        record = made.logged(rows, RATE, seed=1, at_changes=True)
        fit = fit_motor([record])
    given = fit_motor([record], between=form)
    assert fit.between == given.between == form
    for path in PAIR:
        (at,) = given.z[given.space.slices[path]]
        (same,) = fit.z[fit.space.slices[path]]
        assert at == pytest.approx(same, abs=2e-3)


def test_a_wrong_form_of_the_voltage_is_less_likely(held, held_fit):
    wrong = fit_motor([held], between="straight")
    assert wrong.between == "straight"
    assert wrong.fit.loss > held_fit.fit.loss + 10


@pytest.mark.slow
def test_a_log_that_hides_the_form_of_its_voltage_has_the_numbers_of_every_likely_one():
    """Steps between rows, of which there are few: the likeliest form has too small a resistance."""
    fit = fit_motor([made.logged(made.driven(made.FLYWHEEL), 100, seed=1)])
    assert fit.other_forms
    low, high = fit.ranges["motor.resistance"]
    true = made.truth(made.FLYWHEEL)["motor.resistance"]
    assert low < true < high < 1.02 * true
    at = fit.space.slices["motor.resistance"].start
    alone = np.exp(fit.z[at] + 1.65 * np.sqrt(fit.covariance[at, at]))
    assert high > alone


@pytest.mark.slow
@pytest.mark.parametrize(
    ("late", "rows"),
    [
        (("voltage",), (-1, 0)),
        (("current",), (1, -1)),
        (("speed",), (0, 1)),
        (("voltage", "speed"), (-1, 1)),
    ],
)
def test_channels_that_are_a_row_late_do_not_change_the_motor(held, held_fit, late, rows):
    """With voltage and speed late, a current follows the voltage of its own row."""
    shifted = {name: getattr(held, name)[[0, *range(len(held.time) - 1)]] for name in late}
    fit = fit_motor([replace(held, **shifted)])
    for path in PAIR:
        (at,) = fit.z[fit.space.slices[path]]
        (known,) = held_fit.z[held_fit.space.slices[path]]
        assert at == pytest.approx(known, abs=0.015), path
    delays = [float(fit.motor.voltage_delay), float(fit.motor.speed_delay)]
    assert np.multiply(delays, RATE) == pytest.approx(rows, abs=0.2)


@pytest.mark.slow
def test_a_fit_that_starts_at_its_optimum_has_the_same_loss(held_fit):
    """Losses are compared between fits, whatever the number of their steps."""
    one = held_fit.fit
    again = fit_open_loop(one.rows, one.space, one.z)
    assert again.rounds < held_fit.rounds
    assert again.loss == pytest.approx(one.loss, abs=0.05)


def test_an_excerpt_is_where_the_voltage_varies_most():
    step = np.where(np.arange(10_000) % 2000 < 1700, 0.0, 6.0)
    time = 0.01 * np.arange(len(step))
    one = BenchRecord(name="", sha256="", time=time, voltage=step, current=step, speed=step)
    some = excerpt([one], 500)
    assert [len(part.time) for part in some] == [100] * 5
    for k, part in enumerate(some):
        assert np.ptp(part.voltage) == 6.0
        assert 20 * k < part.time[0] < part.time[-1] < 20 * (k + 1)


# theorems ----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_units_scale_what_they_are_units_of(held, held_fit):
    """In half volts and in units of 2 A, R is 4 times and C_e twice as large at the same torque."""
    one = bench_fit([held_fit]).parameters
    scaled = replace(held, voltage=2 * held.voltage, current=held.current / 2)
    two = fitted(scaled, "held").parameters
    for name, factor in (("resistance", 4.0), ("back_emf", 2.0), ("rotor_inertia", 1.0)):
        path = f"motor.{name}"
        assert two[path].value / one[path].value == pytest.approx(factor, rel=0.01), name
    zero = "motor.current_offset"
    assert two[zero].value == pytest.approx(one[zero].value / 2, rel=0.05)


def test_energy_is_balanced(record, motor_fit):
    """Energy at the terminals becomes heat and friction, as the motor rests at the end."""
    m = motor_fit.motor
    volts = record.voltage - float(m.voltage_offset)
    amps = record.current - float(m.current_offset)
    step, w = np.gradient(record.time), record.speed
    friction = float(m.coulomb_friction) * np.abs(w) + float(m.viscous_friction) * w**2
    heat = float(m.resistance) * (amps**2 - noise([amps]) ** 2)
    assert np.sum(volts * amps * step) == pytest.approx(np.sum((heat + friction) * step), rel=0.05)


@pytest.mark.slow
def test_a_reversed_motor_has_the_same_numbers(held, held_fit):
    one = bench_fit([held_fit]).parameters
    flipped = replace(held, **{k: -getattr(held, k) for k in ("voltage", "current", "speed")})
    two = fitted(flipped, "held").parameters
    for path, e in one.items():
        sign = -1.0 if path.endswith("offset") else 1.0
        assert two[path].value == pytest.approx(sign * e.value, rel=1e-3, abs=1e-5), path


def test_signals_are_those_of_the_simulation(motor_fit):
    current, speed = fitted_signals(motor_fit)
    assert (current.channel, speed.channel) == ("current", "speed")
    assert len(current.time) == len(motor_fit.records[0].time) - 1
    assert np.sqrt(np.mean(current.residual**2)) == pytest.approx(0.0504, rel=0.05)
    assert np.sqrt(np.mean(speed.residual**2)) == pytest.approx(1.04, rel=0.05)


# missing channels --------------------------------------------------------------------------------


def test_without_a_current_the_gains_of_the_voltage_are_known(record):
    found = fitted(replace(record, current=None))
    t = made.TRUTH
    volts = t["resistance"] / t["back_emf"]
    truth = {
        "kS": volts * t["coulomb_friction"],
        "kV": t["back_emf"] + volts * t["viscous_friction"],
        "kA": volts * made.FLYWHEEL,
        "kG": t["voltage_offset"],
    }
    for name, true in truth.items():
        e = found.parameters[f"motor.{name}"]
        assert e.verdict == "identified", name
        assert e.value == pytest.approx(true, rel=0.05), name
    assert "motor.resistance" not in found.parameters
    assert any("log the motor current" in text for text in found.messages)
    assert found.to_json()["held_out"]["current_rmse_a"] is None


def test_without_a_voltage_friction_is_known_over_back_emf(record):
    found = fitted(replace(record, voltage=None))
    for name in ("resistance", "back_emf", "inductance", "brush_drop"):
        assert found.parameters[f"motor.{name}"].verdict == "not_identified"
    amps = found.derived["motor.coulomb_friction/motor.back_emf"]
    assert amps.verdict == "identified"
    assert amps.value == pytest.approx(0.004 / 0.0514, rel=0.15)
    assert any("log the motor voltage" in text for text in found.messages)
    assert "held_out" not in found.to_json()


@pytest.mark.slow
def test_magnitudes_of_the_current_are_enough_for_the_back_emf(held):
    size = np.abs(held.current - 0.08) + 0.08
    record = replace(held, current=np.copysign(size, held.speed), signed=False)
    fit = fit_motor([record], between="held")
    found = bench_fit([fit])
    assert found.parameters["motor.back_emf"].value == pytest.approx(0.0514, rel=0.02)
    assert holds(found.parameters["motor.resistance"], 5.5)
    # Simulated readings are magnitudes.
    current, _ = fitted_signals(fit)
    assert current.measured.min() > -0.2
    assert any("currents are magnitudes" in text for text in found.messages)


def test_at_one_speed_nothing_is_identified(record):
    rng, n = np.random.default_rng(0), len(record.time)
    still = replace(
        record,
        voltage=12 + 0.05 * rng.normal(size=n),
        current=0.15 + 0.05 * rng.normal(size=n),
        speed=225 + rng.normal(size=n),
    )
    found = fitted(still)
    assert {e.verdict for e in found.parameters.values()} <= {"fixed", "not_identified"}
    assert any("speed and voltage are constant" in text for text in found.messages)


def test_an_interval_of_a_mixture_leaves_out_a_twentieth_of_it_on_either_side():
    centres, stds = np.array([0.0, 10.0]), np.array([1.0, 2.0])
    one = mixture_quantiles(centres[:1], stds[:1], np.ones(1))
    assert one == pytest.approx([-1.6449, 1.6449], abs=1e-3)
    ignored = mixture_quantiles(centres, stds, np.array([1.0, 0.0]))
    assert ignored == pytest.approx(one, abs=1e-3)
    # Far apart, each of both has a tenth of its own outside: 1.2816 standard deviations.
    both = mixture_quantiles(centres, stds, np.ones(2))
    assert both == pytest.approx([-1.2816, 10 + 2 * 1.2816], abs=1e-3)


@pytest.mark.slow
def test_all_rows_decide_between_forms_that_few_rows_leave_open():
    """Steps between rows, of which there are few in each part of this log."""
    fit = fit_motor([made.logged(made.driven(made.ROTOR), 1000, seed=11)])
    assert fit.between == "jumps"
    assert float(fit.motor.rotor_inertia) == pytest.approx(made.ROTOR, rel=0.02)
