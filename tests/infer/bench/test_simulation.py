"""Open-loop simulation of a motor against references that share nothing with it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import StateSpace, lsim

from slipid.infer.bench.motor import BenchMotor, BenchRecord, BenchRoot
from slipid.infer.bench.open_loop import fit_open_loop, open_loop, values_of
from slipid.infer.bench.rows import Between, rows_of
from slipid.search_space import Choice, Space
from tests.helpers import motor_benches
from tests.helpers.compiled_c import NEEDS_COMPILER
from tests.helpers.motor_physics import Drop

ROW, ROWS = 2e-3, 600
"""Time between rows [s], and their number."""
FINE = 100
"""Number of steps of the reference in a row."""
LINEAR = {
    "resistance": 1.5,
    "back_emf": 0.03,
    "inductance": 1.2e-3,
    "rotor_inertia": 3e-5,
    "viscous_friction": 8e-6,
    "brush_drop": 0.0,
    "coulomb_friction": 0.0,
    "stribeck_friction": 0.0,
}
"""Parameters of a linear motor [SI], whose time constants are 0.8 ms and 50 ms."""
FULL = LINEAR | {
    "brush_drop": 0.6,
    "brush_current": 0.3,
    "brush_tail": 1e-9,
    "coulomb_friction": 0.006,
    "stribeck_friction": 0.003,
    "stribeck_speed": 12.0,
    "resistance_drift": 0.2,
    "voltage_offset": 0.15,
}
"""A motor with drop, dry friction and a winding that warms."""


def motor(**values: float) -> BenchMotor:
    return BenchMotor(**{name: np.asarray(float(value)) for name, value in values.items()})


def levels() -> np.ndarray:
    """Voltages of the rows: steps and ramps that reverse the motor, and rest [V]."""
    corners = [0, 9, 9, -4, -4, -9, 0, 0, 0, 6, -6, 0]
    ramps = np.interp(np.arange(ROWS) / ROWS * 11, np.arange(12), corners)
    return np.where(np.arange(ROWS) < ROWS // 3, np.repeat(corners, ROWS // 12), ramps)


def record(voltage: np.ndarray) -> BenchRecord:
    """A log of a motor that rests at its start."""
    rest = np.zeros(len(voltage))
    return BenchRecord(
        name="made",
        sha256="",
        time=ROW * np.arange(len(voltage)),
        voltage=voltage,
        current=rest,
        speed=rest,
    )


def simulated(form: Between, values: dict[str, float], voltage: np.ndarray) -> np.ndarray:
    """Current and speed of every row but the first, from the simulation that fits use."""
    rows = rows_of([record(voltage)]).between(form)
    found = open_loop(rows, values_of(motor(**values)), rows.start)
    return found.states[rows.used].T


def voltage_of(form: Between, voltage: np.ndarray, delay: float) -> Callable[[float], float]:
    """Voltage over time [V]; `delay` counts in rows, and jumps are later than their row by it."""
    last = len(voltage) - 1

    def row(k: float) -> float:
        return float(voltage[min(max(int(k), 0), last)])

    def held(time: float) -> float:
        return row(np.floor(time / ROW - delay + 1e-9))

    def straight(time: float) -> float:
        return float(np.interp(time / ROW - delay, np.arange(last + 1), voltage))

    def jumping(time: float) -> float:
        k, part = divmod(time / ROW + 1e-9, 1.0)
        before, after = row(k), row(k + 1)
        if abs(after - before) < 0.5:
            return before + part * (after - before)
        return after if part >= 1 + delay else before

    return {"held": held, "straight": straight, "jumps": jumping}[form]


@dataclass
class Reference:
    """Motor that is integrated by Euler's method in many steps a row."""

    values: dict[str, float]
    drop: Callable[[float], float]

    def run(self, volts: Callable[[float], float], rows: int) -> np.ndarray:
        """Current and speed of every row but the first, from rest."""
        v, step, middle = self.values, ROW / FINE, ROW * (rows - 1) / 2
        inertia, emf = v["rotor_inertia"], v["back_emf"]
        i, w, out = 0.0, 0.0, []
        for k in range((rows - 1) * FINE):
            time = (k + 0.5) * step
            r = v["resistance"] * (1 + v["resistance_drift"] * (time - middle))
            u = volts(time) - v["voltage_offset"]
            rise = u - r * i - emf * w - np.sign(i) * self.drop(abs(i))
            torque = emf * i - v["viscous_friction"] * w
            falling = v["stribeck_friction"] * np.exp(-((w / v["stribeck_speed"]) ** 2))
            held = (v["coulomb_friction"] + falling) * step / inertia
            new = i + step * rise / v["inductance"]
            # The drop of the brushes holds the current at zero, as friction holds the shaft.
            i = 0.0 if i * new < 0 and abs(u - emf * w) < self.drop(1e-6) else new
            free = w + step * torque / inertia
            w = 0.0 if abs(free) <= held else free - np.sign(free) * held
            if (k + 1) % FINE == 0:
                out.append((i, w))
        return np.array(out).T


@pytest.mark.parametrize("form", ["held", "straight"])
def test_a_linear_motor_is_exact(form):
    v, voltage = LINEAR, levels()
    r, slow, c, j = v["resistance"], v["inductance"], v["back_emf"], v["rotor_inertia"]
    matrix = [[-r / slow, -c / slow], [c / j, -v["viscous_friction"] / j]]
    system = StateSpace(matrix, [[1 / slow], [0]], np.eye(2), np.zeros((2, 1)))
    time = ROW * np.arange(ROWS)
    _, _, states = lsim(system, voltage, time, interp=form == "straight")
    found = simulated(form, v, voltage)
    for one, wanted in zip(found, states[1:].T, strict=True):
        np.testing.assert_allclose(one, wanted, atol=1e-6 * np.abs(wanted).max())


@pytest.mark.parametrize(
    ("form", "delay", "kappa", "tail"),
    [
        ("held", 0.0, 1.0, 1e-9),
        ("held", 1.0, 1e-6, 0.9),
        ("held", 0.4, 1.0, 0.3),
        ("straight", 0.0, 1e-6, 1e-9),
        ("straight", -0.5, 1.0, 0.5),
        ("jumps", -0.3, 1.0, 1e-9),
    ],
)
def test_drop_friction_and_warming_are_those_of_fine_steps(form, delay, kappa, tail):
    voltage, scale, most = levels(), FULL["brush_current"], FULL["brush_drop"]

    def drop(size: float) -> float:
        part = np.tanh(size / (2 * scale)) if kappa == 1 else 1 - np.exp(-size / scale)
        return float(most * ((1 - tail) * part + tail * np.log1p(size / scale)))

    reference = Reference(FULL, drop)
    wanted = reference.run(voltage_of(form, voltage, delay), ROWS)
    shape = {"brush_shape": kappa, "brush_tail": tail}
    values = FULL | shape | {"voltage_delay": delay * ROW}
    found = simulated(form, values, voltage)
    for one, known in zip(found, wanted, strict=True):
        size = np.abs(known).max()
        assert np.sqrt(np.mean((one - known) ** 2)) < 0.003 * size
        # Only in the row of a reversal is the mean drop of a step not that of its fine steps.
        assert np.quantile(np.abs(one - known), 0.98) < 0.005 * size
        assert np.abs(one - known).max() < 0.06 * size


@pytest.mark.parametrize(
    ("inductance", "largest", "ratio"), [(4e-4, 5e-4, 0.8), (1.2e-2, 2e-3, 0.35)]
)
def test_errors_of_a_reversing_motor_fall_with_the_rows(inductance, largest, ratio):
    """The motor stops within rows; its electrical time constant is shorter or longer than rows."""
    voltage = 9 * np.interp(np.arange(ROWS), np.arange(-6, ROWS + 12, 12), np.resize([-1, 1], 52))

    def error(parts: int) -> np.ndarray:
        found, fine = (finely(voltage, inductance, n) for n in (parts, 16))
        return np.sqrt(np.mean((found - fine) ** 2, axis=1)) / np.abs(fine).max(axis=1)

    coarse, half = error(1), error(2)
    assert (coarse < largest).all()
    assert (half < ratio * coarse).all()


def finely(voltage: np.ndarray, inductance: float, parts: int) -> np.ndarray:
    """Current and speed at the rows, from simulated rows that are parts of them."""
    fine = np.repeat(voltage, parts)
    one = replace(record(fine), time=ROW / parts * np.arange(len(fine)))
    rows = rows_of([one]).between("held")
    values = FULL | {"resistance_drift": 0.0, "inductance": inductance, "brush_shape": 0.3}
    found = open_loop(rows, values_of(motor(**values)), rows.start)
    return found.states[rows.used].T[:, parts - 1 :: parts]


@NEEDS_COMPILER
@pytest.mark.parametrize("seed", [46, 102, 177, 215, 1016])
def test_true_parameters_simulate_what_made_benches_do(seed):
    """The benches have no effect but those of the model; their steps share no code with it."""
    experiment = motor_benches.drawn(np.random.default_rng(seed))
    made, row = experiment.motor, experiment.supply.row
    supply = replace(experiment.supply, pwm_frequency=0.0)
    experiment = replace(experiment, supply=supply, command=experiment.command[-ROWS:])
    states, tanh = experiment.run(), made.drop_shape == Drop.TANH
    one = replace(record(experiment.command), time=row * np.arange(ROWS))
    rows = rows_of([one]).between("straight" if supply.ramp else "held")
    true = motor(
        resistance=made.resistance,
        back_emf=made.back_emf,
        inductance=made.inductance,
        rotor_inertia=made.inertia,
        viscous_friction=made.viscous,
        coulomb_friction=made.coulomb,
        stribeck_friction=made.coulomb * made.stribeck,
        stribeck_speed=made.stribeck_speed or 1.0,
        brush_drop=made.drop,
        brush_current=made.drop_current / (2 if tanh else 1) or 1.0,
        brush_shape=1.0 if tanh else 1e-9,
        brush_tail=0.0,
    )
    found = open_loop(rows, values_of(true), rows.start).states[rows.used].T
    for one, known in zip(found, (states.current, states.speed), strict=True):
        off = np.sqrt(np.mean((one - known[1:]) ** 2)) / np.abs(known).max()
        assert off < 1.5e-3


def test_voltage_slope_and_mean_of_the_contacts_agree():
    shape = {"brush_shape": 0.4, "brush_tail": 0.3, "resistance_fall": 0.5, "fall_current": 2.0}
    m, size = motor(**(FULL | shape)), np.linspace(0.01, 6.0, 40)
    winding = jnp.asarray(1.5)
    _, slope = m.contact_voltage(size, winding)
    wanted = jax.vmap(jax.grad(lambda i: m.contact_voltage(i, winding)[0]))(size)
    np.testing.assert_allclose(slope, wanted, rtol=1e-9)
    for start, end in ((-1.0, 4.0), (0.5, 3.0), (-2.0, -0.1), (1.0, 1.0 + 1e-6)):
        middles = start + (end - start) * (np.arange(20_000) + 0.5) / 20_000
        volts = np.sign(middles) * m.contact_voltage(np.abs(middles), winding)[0]
        mean = m.mean_contact_voltage(jnp.asarray(start), jnp.asarray(end), winding)
        assert float(mean) == pytest.approx(float(volts.mean()), rel=1e-5)


def test_dry_friction_holds_a_motor_below_its_breakaway_voltage():
    friction = FULL["coulomb_friction"] + FULL["stribeck_friction"]
    needed = LINEAR["resistance"] * friction / LINEAR["back_emf"]
    values = FULL | {"brush_drop": 0.0, "voltage_offset": 0.0, "resistance_drift": 0.0}
    still, moving = (
        simulated("held", values, np.full(ROWS, part * needed))[1] for part in (0.98, 1.02)
    )
    np.testing.assert_allclose(still, 0.0, atol=1e-6)
    assert moving[-1] > 0.2


def test_slow_rows_do_not_make_a_simulation_unstable():
    """Rows of 2 ms are 20 times as long as the electrical time constant."""
    values = FULL | {"inductance": 1.5e-4, "resistance_drift": 0.0}
    current, speed = simulated("held", values, np.repeat([9.0, -9.0, 9.0], ROWS // 3))
    assert np.abs(current).max() < 2.2 * 9.0 / values["resistance"]
    assert np.abs(speed).max() < 9.0 / values["back_emf"]


def test_currents_far_below_a_steep_drop_are_finite():
    """The drop is as steep as 100 windings, and a logarithm, so that Newton's method overshoots."""
    values = FULL | {"brush_current": 4e-3, "brush_tail": 0.99, "resistance": 0.04}
    still = 6.0 + 0.05 * np.random.default_rng(0).normal(size=ROWS)
    assert np.isfinite(simulated("held", values, still)).all()
    assert np.isfinite(simulated("held", values, levels())).all()


def test_segments_of_a_log_continue_each_other():
    """The first half of a log, in segments of another length, is that of the whole log."""
    voltage, values = levels(), FULL | {"resistance_drift": 0.0}
    whole = simulated("held", values, voltage)
    early = simulated("held", values, voltage[:300])
    size = np.abs(whole).max(axis=1, keepdims=True)
    np.testing.assert_allclose(early / size, whole[:, :299] / size, atol=1e-5)


@pytest.mark.parametrize("signed", [True, False])
def test_derivatives_are_those_of_finite_differences(signed):
    one = replace(record(levels()), signed=signed)
    rows = rows_of([one]).between("jumps")
    # Delays of whole rows are corners of the simulation.
    delays = {"motor.voltage_delay": -6e-4, "motor.speed_delay": 7e-4}
    free = [Choice(path, start=start) for path, start in delays.items()]
    free.append(Choice("motor.resistance_drift", free=True))
    space = Space(BenchRoot(motor(**(FULL | {"brush_shape": 0.4, "brush_tail": 0.2}))), free)
    z = space.start
    exact = fit_open_loop(rows, space, z, rounds=0).slopes

    def readings(z: np.ndarray) -> np.ndarray:
        return open_loop(rows, values_of(space.tree(z).motor), rows.start).readings

    scale = np.abs(readings(z)).max(axis=(1, 2))
    for k, name in enumerate(space.names):
        step = 1e-5 * np.eye(len(z))[k]
        slope = (readings(z + step) - readings(z - step)) / 2e-5
        off = np.sqrt(np.mean((exact[k] - slope) ** 2, axis=(1, 2)))
        size = np.sqrt(np.mean(slope**2, axis=(1, 2)))
        assert (off < 1e-3 * size + 1e-6 * scale).all(), name
