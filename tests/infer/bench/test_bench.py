"""Motors on a bench: recovery, theorems, and refused logs."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from slipid.infer.bench.fit import check_records, fit_motor
from slipid.infer.bench.motor import BenchMotor, BenchRoot, noise
from slipid.infer.bench.verdict import BenchFit, bench_fit, misfits
from slipid.infer.bench.windows import electrical, mechanical
from slipid.search_space import Choice, Space
from slipid.support.errors import DataError
from tests.helpers import made_bench as made

SILENT = (0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def rows():
    return made.driven(made.FLYWHEEL)


@pytest.fixture(scope="module")
def record(rows):
    return made.logged(rows, 200, seed=1)


def fitted(*records, choices=()) -> BenchFit:
    check_records(records, "")
    return bench_fit([fit_motor(records, choices)])


def off(found: BenchFit, path: str, true: float) -> float:
    return abs(found.parameters[path].value / true - 1)


# recovery ----------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("rate", [100, 200, 1000])
def test_a_motor_is_recovered(rows, rate):
    found = fitted(made.logged(rows, rate, seed=2))
    assert found.good
    assert off(found, "motor.resistance", 5.5) < 0.01
    assert off(found, "motor.back_emf", 0.0514) < 0.01
    for path, true in made.truth(made.FLYWHEEL).items():
        e = found.parameters[path]
        if e.verdict == "identified":
            assert abs(e.value - true) < 3.0 * e.std, path
    for name in ("coulomb_friction", "viscous_friction", "rotor_inertia", "back_emf", "resistance"):
        assert found.parameters[f"motor.{name}"].verdict == "identified"


@pytest.mark.slow
def test_without_noise_it_is_exact(rows):
    found = fitted(made.logged(rows, 1000, 0, SILENT, SILENT))
    for path, true in made.truth(made.FLYWHEEL).items():
        if path != "motor.inductance":  # of the simulation's own steps, some percent
            assert found.parameters[path].value == pytest.approx(true, rel=1e-5, abs=1e-6), path


@pytest.mark.slow
def test_inductance_needs_rows_in_its_time_constant():
    quick = made.driven(made.FLYWHEEL, 3.0, 0.0, made.quick_steps)
    fast = fitted(made.logged(quick, 10_000))
    e = fast.parameters["motor.inductance"]
    assert e.verdict == "identified"
    assert e.value == pytest.approx(8.9e-3, rel=0.03)
    slow = fitted(made.logged(made.driven(made.FLYWHEEL), 50))
    assert slow.parameters["motor.inductance"].verdict == "not_identified"
    assert any("not identified at this sampling rate" in text for text in slow.messages)


@pytest.mark.slow
def test_a_bare_rotor_is_too_quick_for_slow_rows():
    found = fitted(made.logged(made.driven(made.ROTOR), 100))
    assert found.parameters["motor.rotor_inertia"].verdict == "not_identified"


@pytest.mark.slow
def test_a_brush_drop_does_not_pass_for_resistance():
    record = made.logged(made.driven(made.FLYWHEEL, drop=0.6), 200, 1, noise=(0.05, 0.1, 1.0))
    plain = np.stack([record.current, record.speed], axis=1)
    least_squares = np.linalg.lstsq(plain, record.voltage, rcond=None)[0][0]
    found = fitted(record).parameters
    r = found["motor.resistance"]
    assert abs(least_squares / 5.5 - 1) > 0.05
    assert abs(r.value - 5.5) < 2.5 * r.std < 0.15 * 5.5
    assert found["motor.brush_drop"].value == pytest.approx(0.6, abs=0.12)


@pytest.mark.slow
def test_a_noisy_ammeter_does_not_make_the_resistance_small():
    quick = made.driven(made.FLYWHEEL, 25.0)
    found = [fitted(made.logged(quick, 500, k, noise=(0.05, 0.3, 1.0))) for k in range(4)]
    values = [f.parameters["motor.resistance"].value for f in found]
    record = made.logged(quick, 500, 0, noise=(0.05, 0.3, 1.0))
    columns = [record.current, record.speed, np.ones(len(record.time))]
    least = np.linalg.lstsq(np.stack(columns, 1), record.voltage, rcond=None)[0][0]
    assert least < 0.9 * 5.5
    assert np.mean(values) == pytest.approx(5.5, rel=0.04)


# theorems ----------------------------------------------------------------------------------------


def test_units_scale_what_they_are_units_of(record):
    """In half volts and in units of 2 A, R is 4 times and C_e twice as large at the same torque."""
    one = fitted(record).parameters
    scaled = replace(record, voltage=2 * record.voltage, current=record.current / 2)
    two = fitted(scaled).parameters
    for name, factor in (("resistance", 4.0), ("back_emf", 2.0), ("rotor_inertia", 1.0)):
        path = f"motor.{name}"
        assert two[path].value / one[path].value == pytest.approx(factor, rel=0.01), name
    assert two["motor.current_offset"].value == pytest.approx(
        one["motor.current_offset"].value / 2, rel=0.05
    )


def test_energy_is_balanced(record):
    """Energy at the terminals becomes heat and friction, as the motor rests at the end."""
    m = bench_fit([fit_motor([record])]).fits[0].motor
    volts = record.voltage - float(m.voltage_offset)
    amps = record.current - float(m.current_offset)
    step, w = np.gradient(record.time), record.speed
    friction = float(m.coulomb_friction) * np.abs(w) + float(m.viscous_friction) * w**2
    heat = float(m.resistance) * (amps**2 - noise([amps]) ** 2)
    assert np.sum(volts * amps * step) == pytest.approx(np.sum((heat + friction) * step), rel=0.05)


def test_a_reversed_motor_has_the_same_numbers(record):
    flipped = replace(record, **{k: -getattr(record, k) for k in ("voltage", "current", "speed")})
    one, two = fitted(record).parameters, fitted(flipped).parameters
    for path, e in one.items():
        sign = -1.0 if path.endswith("offset") else 1.0
        assert two[path].value == pytest.approx(sign * e.value, rel=1e-5, abs=1e-7), path


def test_time_does_not_run_backwards(record):
    back = {k: getattr(record, k)[::-1] for k in ("voltage", "current", "speed")}
    with pytest.raises(DataError, match="accelerates against its current"):
        fitted(replace(record, **back))


def test_derivatives_are_those_of_finite_differences():
    space = Space(BenchRoot(BenchMotor()))
    z = jnp.asarray(space.start) + 0.1

    def coefficients(z):
        m = space.tree(z).motor
        return jnp.concatenate([m.volts(), m.amps()])

    exact = jax.jacfwd(coefficients)(z)
    for k in range(space.size):
        step = jnp.zeros(space.size).at[k].set(1e-6)
        slope = (coefficients(z + step) - coefficients(z - step)) / 2e-6
        np.testing.assert_allclose(exact[:, k], slope, rtol=1e-6, atol=1e-9)


def test_windows_are_exact_for_straight_lines(record):
    """Both equations hold in every window where signals are straight lines between rows."""
    rng = np.random.default_rng(0)
    walk = np.cumsum(rng.normal(size=(2, len(record.time))), axis=1)
    volts = 2.0 * walk[0] + 0.3 * walk[1] + 1.5
    made_up = replace(record, current=walk[0], speed=walk[1], voltage=volts)
    w = electrical([made_up], 0.0)
    residual = w.measured - w.signals @ [2.0, 0.3, 0.0, 0.0, 1.5, 0.0]
    assert np.abs(residual).max() < 1e-9
    line = replace(record, speed=3.0 + 7.0 * record.time)
    assert mechanical([line]).signals[..., 0].ravel() == pytest.approx(7.0)


# what it does not know ---------------------------------------------------------------------------


def test_without_voltage_friction_is_known_over_back_emf(record):
    found = fitted(replace(record, voltage=None))
    for name in ("resistance", "back_emf", "inductance", "brush_drop"):
        assert found.parameters[f"motor.{name}"].verdict == "not_identified"
    amps = found.derived["motor.coulomb_friction/motor.back_emf"]
    assert amps.verdict == "identified"
    assert amps.value == pytest.approx(0.004 / 0.0514, rel=0.15)
    assert any("log the motor voltage" in text for text in found.messages)


def test_at_one_speed_nothing_is_identified(record):
    rng, n = np.random.default_rng(0), len(record.time)
    still = replace(
        record,
        voltage=12 + 0.05 * rng.normal(size=n),
        current=0.15 + 0.05 * rng.normal(size=n),
        speed=225 + rng.normal(size=n),
    )
    found = fitted(still)
    assert {e.verdict for e in found.parameters.values()} == {"not_identified"}
    assert any("speed and voltage are constant" in text for text in found.messages)


@pytest.mark.slow
def test_a_misfit_is_named_and_lowers_verdicts(record):
    """The model has no friction that falls with speed."""
    odd = 0.15 * np.sin(record.speed / 60.0)
    found = fitted(replace(record, current=record.current + odd))
    assert misfits(found.fits[0])
    assert not found.good
    assert any("the model does not include" in text for text in found.messages)
    assert found.parameters["motor.coulomb_friction"].verdict != "identified"


@pytest.mark.slow
def test_a_fixed_number_stays(record):
    found = fitted(record, choices=[Choice("motor.brush_drop", fixed=0.1)])
    e = found.parameters["motor.brush_drop"]
    assert (e.value, e.verdict, e.provenance) == (0.1, "fixed", "override")


# wrong logs --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda r: {"current": 1000 * r.current}, "unit of the current"),
        (lambda r: {"current": r.voltage, "voltage": r.current}, "exchanged"),
        (lambda r: {"current": -r.current}, "current has the wrong sign"),
        (lambda r: {"speed": -r.speed}, "speed has the wrong sign"),
        (lambda r: {"voltage": -r.voltage}, "voltage has the wrong sign"),
        (lambda r: {"current": np.abs(r.current)}, "--unsigned"),
        (lambda r: {"speed": 0.3 * np.sin(r.time)}, "does not turn"),
        (lambda r: {"speed": 30 * r.speed}, "rpm"),
        (lambda r: {"current": np.zeros_like(r.current)}, "in every row"),
    ],
)
def test_a_wrong_log_is_refused_with_a_next_step(record, change, message):
    with pytest.raises(DataError, match=message) as error:
        check_records([replace(record, **change(record))], "")
    assert "expected" in str(error.value)
