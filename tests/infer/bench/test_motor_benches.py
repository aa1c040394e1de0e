"""The made motor benches themselves: physics of their simulation, their logs and their mix."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.signal import step

from tests.helpers import motor_benches as made
from tests.helpers.compiled_c import NEEDS_COMPILER
from tests.helpers.motor_physics import Drop, Motor, States, Supply, simulate, substeps

pytestmark = NEEDS_COMPILER

PLAIN = Motor(
    voltage=12.0,
    resistance=1.5,
    back_emf=0.03,
    inductance=1e-3,
    inertia=3e-5,
    coulomb=0.008,
    viscous=8e-6,
)
DROPPING = replace(PLAIN, drop_shape=Drop.EXPONENTIAL, drop=0.8, drop_current=0.4)
ANY = replace(
    DROPPING,
    film=0.6,
    film_current=2.0,
    stribeck=0.5,
    stribeck_speed=10.0,
    cogging=0.004,
    cogging_order=10.0,
    ripple=0.04,
    ripple_order=14.0,
)
"""A motor that has every effect but heat."""
FINE = Supply(row=20e-6, substeps=1)


def volts(*levels: tuple[float, float], row: float = FINE.row) -> np.ndarray:
    """Voltages, each held for a time [V], [s]."""
    return np.concatenate([np.full(round(time / row), level) for level, time in levels])


def held(motor: Motor, level: float, time: float = 2.0) -> States:
    """The last tenth of the states at a constant voltage."""
    states = simulate(motor, Supply(1e-3, 50), volts((level, time), row=1e-3))
    last = round(time * 1e3 / 10)
    return States(*(getattr(states, name)[-last:] for name in vars(states)))


@pytest.mark.parametrize("motor", [PLAIN, DROPPING, ANY], ids=["plain", "drop", "any"])
def test_energy_from_the_supply_is_stored_or_lost(motor):
    command = volts((9, 0.1), (0, 0.1), (-7, 0.2), (9, 0.1))
    states = simulate(motor, FINE, command)
    current = (states.current[1:] + states.current[:-1]) / 2
    speed = (states.speed[1:] + states.speed[:-1]) / 2
    dry = motor.coulomb * (1 + motor.stribeck * np.exp(-((speed / motor.stribeck_speed) ** 2)))
    lost = (
        motor.resistance_at(current) * current**2
        + motor.drop_at(current) * current
        + dry * np.abs(speed)
        + motor.viscous * speed**2
    )
    order = motor.cogging_order
    stored = (
        motor.inductance * states.current[-1] ** 2 / 2
        + motor.inertia * states.speed[-1] ** 2 / 2
        + motor.cogging * (1 - np.cos(order * states.angle[-1])) / order
    )
    taken = np.sum(command[:-1] * current) * FINE.row
    assert np.sum(lost) * FINE.row + stored == pytest.approx(taken, rel=3e-4)
    assert stored > 0.05 * taken


@pytest.mark.parametrize("shape", Drop)
@pytest.mark.parametrize("level", [10.0, -6.0])
def test_steady_speed_and_current_follow_from_algebra(shape, level):
    motor = replace(PLAIN, drop_shape=shape, drop=0.3, drop_current=0.2, film=0.5)

    def speed_at(current: float) -> float:
        i = np.array(current)
        return (abs(level) - motor.resistance_at(i) * i - motor.drop_at(i)) / motor.back_emf

    def torque_left(current: float) -> float:
        return motor.back_emf * current - motor.coulomb - motor.viscous * speed_at(current)

    current = brentq(torque_left, 0, 8)
    states, sign = held(motor, level), np.sign(level)
    np.testing.assert_allclose(states.current, sign * current, rtol=1e-5)
    np.testing.assert_allclose(states.speed, sign * speed_at(current), rtol=1e-5)


def test_blocked_rotor_has_the_currents_of_a_winding():
    blocked = replace(PLAIN, coulomb=1.0)
    states = simulate(blocked, FINE, volts((6, 4e-3)))
    time = np.arange(len(states.current)) * FINE.row
    wanted = 4 * (1 - np.exp(-time * blocked.resistance / blocked.inductance))
    np.testing.assert_allclose(states.current, wanted, atol=1e-3)
    assert not states.angle.any()


def test_free_rotor_starts_like_the_linear_motor():
    free = replace(PLAIN, coulomb=0.0, viscous=0.0)
    states = simulate(free, FINE, volts((6, 0.2)))
    inertia, coupling = free.inertia, free.back_emf
    poles = [inertia * free.inductance, inertia * free.resistance, coupling**2]
    times = np.arange(len(states.speed)) * FINE.row
    for found, zeros in ((states.speed, [6 * coupling]), (states.current, [6 * inertia, 0])):
        _, wanted = step((zeros, poles), T=times)
        np.testing.assert_allclose(found, wanted, atol=5e-5 * wanted.max())


def test_cogging_holds_a_turned_rotor_like_a_spring():
    sprung = replace(PLAIN, coulomb=0.0, viscous=1e-3, cogging=0.01, cogging_order=8.0)
    states = held(sprung, 0.3)
    wanted = np.arcsin(sprung.back_emf * 0.2 / 0.01) / 8
    np.testing.assert_allclose(states.angle, wanted, rtol=1e-4)


def test_dry_friction_holds_up_to_the_breakaway_torque():
    rested = replace(ANY, cogging=0.0, ripple=0.0)
    current = np.array(ANY.coulomb * (1 + ANY.stribeck) / ANY.back_emf)
    needed = float(current * rested.resistance_at(current) + rested.drop_at(current))
    assert not held(rested, 0.98 * needed).angle.any()
    assert held(rested, 1.02 * needed).speed.min() > 0.5


def test_pulses_drive_like_their_mean_and_ripple_by_bus_over_inductance():
    blocked, duty, frequency = replace(PLAIN, coulomb=1.0), 0.4, 20e3
    supply = Supply(1 / (100 * frequency), 1, pwm_frequency=frequency, bus=12.0)
    states = simulate(blocked, supply, volts((12 * duty, 20e-3), row=supply.row))
    period = states.current[-100:]
    ripple = 12 * duty * (1 - duty) / (blocked.inductance * frequency)
    assert np.ptp(period) == pytest.approx(ripple, rel=0.02)
    assert period.mean() == pytest.approx(12 * duty / blocked.resistance, rel=1e-3)


def test_logged_mean_is_that_of_the_period_before_the_row():
    blocked = replace(PLAIN, coulomb=1.0)
    often = Supply(row=1e-6, substeps=1, pwm_frequency=20e3, bus=12.0)
    fine = simulate(blocked, often, np.full(4001, 5.0)).current
    states = simulate(blocked, replace(often, row=1e-3, substeps=1000), np.full(5, 5.0))
    wanted = [fine[k - 49 : k + 1].mean() for k in (1000, 2000, 3000, 4000)]
    np.testing.assert_allclose(states.mean_current[1:], wanted, rtol=1e-9)
    np.testing.assert_allclose(states.current, fine[::1000], rtol=1e-9)


def test_ramps_reach_each_row_in_a_straight_line():
    blocked = replace(PLAIN, coulomb=1.0, inductance=1e-5)
    supply = Supply(row=0.1, substeps=20000, ramp=True)
    command = np.array([0.0, 3.0, 3.0, -3.0])
    states = simulate(blocked, supply, command)
    slopes = np.array([0, 30, 0, -60])
    lag = slopes * blocked.inductance / blocked.resistance
    np.testing.assert_allclose(states.current, (command - lag) / blocked.resistance, atol=1e-6)


def test_heat_raises_winding_and_magnets_to_the_balance_of_losses():
    warm = replace(
        PLAIN,
        coulomb=1.0,
        copper_slope=0.0039,
        magnet_slope=-0.002,
        thermal_resistance=2.0,
        winding_time=0.1,
        magnet_time=0.2,
    )
    states = held(warm, 6.0, 3.0)

    def missing(rise: float) -> float:
        return warm.thermal_resistance * 36 / float(warm.resistance_at(np.array(0), rise)) - rise

    rise = brentq(missing, 0, 100)
    np.testing.assert_allclose(states.winding_rise, rise, rtol=1e-3)
    np.testing.assert_allclose(states.magnet_rise, rise / 2, rtol=1e-3)
    np.testing.assert_allclose(states.current, 6 / warm.resistance / (1 + 0.0039 * rise), rtol=1e-3)


def test_half_the_step_changes_nothing():
    experiment = made.drawn(np.random.default_rng(3))
    experiment = replace(experiment, command=experiment.command[:1500])
    finer = replace(experiment.supply, substeps=2 * experiment.supply.substeps)
    coarse, fine = experiment.run(), replace(experiment, supply=finer).run()
    for name in ("current", "speed"):
        values = getattr(fine, name)
        np.testing.assert_allclose(getattr(coarse, name), values, atol=2e-4 * values.max())


def test_a_seed_makes_one_bench():
    first, second, other = made.bench(12), made.bench(12), made.bench(8)
    for name in ("time", "voltage", "current", "speed"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
    assert first.truth == second.truth
    assert other.truth.motor != first.truth.motor


def test_a_late_channel_shows_the_row_before():
    rng = np.random.default_rng(8)
    experiment = made.drawn(rng)
    states, state = experiment.run(), rng.bit_generator.state
    logs = {}
    for late in made.LATE:
        rng.bit_generator.state = state
        kind = replace(experiment.kind, late=late)
        logs[late] = made.logged(rng, replace(experiment, kind=kind), states)
    for late in set(made.LATE) - {"none"}:
        for name in set(made.LATE) - {"none"}:
            shown, there = getattr(logs[late], name), getattr(logs["none"], name)
            np.testing.assert_array_equal(shown[1:], there[:-1] if name == late else there[1:])


def test_kinds_come_in_the_stated_fractions():
    count = 6000
    kinds = [made.drawn_kind(np.random.default_rng([9, seed])) for seed in range(count)]
    others = 1 - made.PLAIN
    stated = {
        "film": {True: made.FILM * others},
        "heat": {True: made.HEAT * others},
        "cogging": {True: made.COGGING * others},
        "stribeck": {True: made.STRIBECK * others},
        "ripple": {True: made.RIPPLE * others},
        "drop": {
            name: made.PLAIN * made.PLAIN_DROPS.get(name, 0) + others * fraction
            for name, fraction in made.DROPS.items()
        },
        "pwm": made.PWM,
        "late": made.LATE,
        "excitation": made.EXCITATIONS,
        "ramp": {True: made.RAMP},
        "ammeter_bits": {8: made.COARSE_AMMETER},
        "encoder": {True: made.ENCODER},
        "both_directions": {True: made.BOTH_DIRECTIONS},
        "plain": {True: 0.37},
    }
    for name, fractions in stated.items():
        found = Counter(getattr(kind, name) for kind in kinds)
        for value, fraction in fractions.items():
            assert found[value] / count == pytest.approx(fraction, abs=0.02), (name, value)


@pytest.fixture(scope="module")
def benches():
    return [made.bench(seed) for seed in range(10)]


@pytest.mark.slow
def test_benches_stay_within_what_motors_and_people_do(benches):
    for bench in benches:
        true, rows = bench.truth, len(bench.time)
        assert 1000 <= rows <= 20000
        assert bench.time[-1] < 60.1
        assert true.largest_current < 1.05 * true.motor.stall_current
        assert 0.3 * true.motor.top_speed < true.largest_speed < 2500
        assert true.largest_rise < 60
        assert true.drop <= min(2.0, 0.15 * true.motor.voltage)
        assert np.ptp(bench.speed) > 0.5 * true.motor.top_speed or not true.kind.both_directions
        assert (bench.speed.min() < -0.2 * true.largest_speed) == true.kind.both_directions
        assert np.mean(np.abs(bench.voltage) < 0.05 * true.motor.voltage) > 0.04


@pytest.mark.slow
def test_ranges_in_the_truth_are_points_where_nothing_changes(benches):
    for true in (bench.truth for bench in benches):
        kind = true.kind
        assert true.resistance_low <= true.resistance * (1 + 1e-12)
        assert true.resistance * (1 - 1e-12) <= true.resistance_high
        constant = not (kind.film or kind.heat)
        assert (true.resistance_high / true.resistance_low < 1 + 1e-9) == constant
        assert (true.back_emf_high / true.back_emf_low < 1 + 1e-9) == (not kind.heat)


def spread(experiment: made.Experiment) -> dict[str, float]:
    """Relative stds of R and C_e for whoever knows the rest: the Cramér-Rao bound.

    Unknown are all numbers of the motor and the ammeter's offset. Rounding and the ripple of
    sampled currents count as noise.
    """
    motor, supply, meters = experiment.motor, experiment.supply, experiment.meters
    kind, command = experiment.kind, experiment.command
    duty = np.abs(command) / supply.bus if kind.pwm == "sampled" else 0 * command
    ripple = supply.bus * duty * (1 - duty) / motor.inductance / max(supply.pwm_frequency, 1)
    rounding = 2 * meters.current_range / 2**kind.ammeter_bits
    current_std = np.sqrt(meters.current_noise**2 + (rounding**2 + ripple**2) / 12)
    tick = 2 * np.pi / meters.counts / supply.row
    speed_std = tick / np.sqrt(6) if kind.encoder else meters.speed_noise
    steady = replace(supply, pwm_frequency=0.0, substeps=substeps(motor, supply.row))

    def whitened(changed: Motor) -> np.ndarray:
        states = simulate(changed, steady, command)
        speed = np.diff(states.angle, prepend=0) / supply.row if kind.encoder else states.speed
        return np.concatenate([states.current / current_std, speed / speed_std])

    names = ["resistance", "back_emf", "inductance", "inertia", "coulomb", "viscous"]
    names += ["drop", "drop_current"] if motor.drop else []
    change = 2e-3
    slopes = [
        whitened(replace(motor, **{name: getattr(motor, name) * (1 + change)}))
        - whitened(replace(motor, **{name: getattr(motor, name) * (1 - change)}))
        for name in names
    ]
    offset = np.concatenate([np.ones(len(command)) / current_std, np.zeros(len(command))])
    slopes = np.array([*slopes, offset])
    size = np.linalg.norm(slopes, axis=1, keepdims=True)
    covariance = np.linalg.pinv(slopes / size @ (slopes / size).T)
    stds = np.sqrt(np.diag(covariance)) / size[:, 0] * 2 * change
    return dict(zip(names[:2], stds[:2], strict=True))


@pytest.mark.slow
def test_resistance_and_back_emf_of_plain_motors_are_in_their_logs():
    experiments = (made.drawn(np.random.default_rng(seed)) for seed in range(6))
    plain = [experiment for experiment in experiments if experiment.kind.plain]
    assert len(plain) > 1
    for experiment in plain:
        assert max(spread(experiment).values()) < 0.02
