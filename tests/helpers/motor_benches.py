"""Motors on benches, drawn at random, and their logs as a competent person would record them.

`bench(seed)` draws a motor, a supply, meters and an experiment. Sizes are logarithmically uniform,
from a toy of 3 V to a servo of 48 V: R .05 to 10 ohm, C_e .003 to .2 V s/rad, J R / C_e^2 5 to
400 ms with its flywheel, L / R .05 to 3 ms; combinations are drawn again until speed, current and
torque are those of real motors (`_size`). The fractions of the benches in the long run:

- 37 % *plain*: R, L, C_e, dry and viscous friction, and a brush drop of no, tanh or exponential
  shape. The others have any of the effects below.
- brush drop: none 13 %, tanh 22 %, 1 - exp(-s) 29 %, s / (1 + s) 20 %, log(1 + s) 16 %, with
  s = |I| / I_0; 1 to 15 % of the supply and at most 2 V; I_0 is 2 to 30 % of the stall current.
- 16 % contact film (R falls by 15 to 50 % over 15 to 50 % of the stall current); 23 % copper and
  magnets that heat (copper by 10 to 50 K); 26 % cogging; 20 % Stribeck friction; 26 % ripple of
  torque and induced voltage.
- 40 % PWM of 10 to 25 kHz, half of it with currents sampled anywhere in the period, half with
  the mean over a period; 30 % ramps between rows, the others hold each row's voltage.
- 20 % one of voltage, current, speed a row late; 35 % an ammeter of 8 bits, the others 12;
  60 % an encoder (ticks in a row), the others a tachometer.
- steps 40 %, pseudo-random 25 %, sine sweeps 15 %, quasi-static ramps and steps 20 %, each after
  starts from rest and stops; 92 % in both directions.

Rows come with 50 Hz to 5 kHz, at least five within J R / C_e^2; there are 1 000 to 20 000 of them
in 10 to 60 s, in less where they come faster than 2 kHz.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator

from slipid.infer.bench.motor import BenchRecord
from tests.helpers.motor_experiments import EXCITATIONS, Plan
from tests.helpers.motor_physics import COPPER, Drop, Motor, States, Supply, simulate, substeps

PLAIN = 0.35
"""Fraction of motors without any effect; among the others some have none by chance."""
PLAIN_DROPS = {"none": 0.2, "tanh": 0.35, "exponential": 0.45}
DROPS = {"none": 0.1, "tanh": 0.15, "exponential": 0.2, "ratio": 0.3, "logarithm": 0.25}
"""Fractions of the shapes among motors without any effect, and among the others."""
FILM, HEAT, COGGING, STRIBECK, RIPPLE = 0.25, 0.35, 0.4, 0.3, 0.4
"""Fractions of the effects among motors that may have them."""
PWM = {"none": 0.6, "sampled": 0.2, "averaged": 0.2}
LATE = {"none": 0.79, "voltage": 0.07, "current": 0.07, "speed": 0.07}
RAMP, COARSE_AMMETER, ENCODER, BOTH_DIRECTIONS = 0.3, 0.35, 0.6, 0.92
"""Fractions among all benches."""
COUNTS = np.array([48, 64, 256, 400, 1024, 2000, 4096, 8192])
"""Counts of encoders in a turn."""


@dataclass(frozen=True)
class Kind:
    """Properties of a bench.

    Attributes:
        drop: shape of the brush drop, as in `DROPS`.
        film, heat, cogging, stribeck, ripple: whether the motor has this effect.
        pwm: "none", or which current is logged, "sampled" or "averaged".
        ramp: whether the voltage goes straight from row to row instead of being held.
        late: the channel that is a row late, or "none".
        ammeter_bits: resolution of the ammeter.
        encoder: whether speeds are ticks in a row; otherwise a tachometer's.
        excitation: the experiment, as in `EXCITATIONS`.
        both_directions: whether the motor runs backward too.
    """

    drop: str
    film: bool
    heat: bool
    cogging: bool
    stribeck: bool
    ripple: bool
    pwm: str
    ramp: bool
    late: str
    ammeter_bits: int
    encoder: bool
    excitation: str
    both_directions: bool

    @property
    def plain(self) -> bool:
        """True if the motor has no effect; supply and meters may have any of theirs."""
        effects = (self.film, self.heat, self.cogging, self.stribeck, self.ripple)
        return self.drop in PLAIN_DROPS and not any(effects)


@dataclass(frozen=True)
class Truth:
    """Numbers that a fit ought to find.

    Attributes:
        resistance: mean over the heat in the winding, ∫ R I^2 / ∫ I^2 [ohm].
        resistance_low, resistance_high: range at currents from a tenth of the largest one on.
        slope_low, slope_high: range of dV/dI of winding and brushes, cold to warm, at currents
            from a quarter of the largest one on [ohm].
        back_emf: mean over squared speeds [V s/rad].
        back_emf_low, back_emf_high: range during the log.
        inductance, inertia, coulomb, viscous: as in `Motor`.
        drop: voltage across the brushes at the largest current [V].
        largest_current, largest_speed, largest_rise: [A], [rad/s], of the winding [K].
        plain: as in `Kind`.
        kind: what the bench has.
        motor: all constants of the motor.
    """

    resistance: float
    resistance_low: float
    resistance_high: float
    slope_low: float
    slope_high: float
    back_emf: float
    back_emf_low: float
    back_emf_high: float
    inductance: float
    inertia: float
    coulomb: float
    viscous: float
    drop: float
    largest_current: float
    largest_speed: float
    largest_rise: float
    plain: bool
    kind: Kind
    motor: Motor


@dataclass(frozen=True)
class Meters:
    """Instruments that log a bench.

    Attributes:
        current_range, current_noise, current_offset: [A].
        voltage_quantum, voltage_noise: [V].
        counts: of the encoder in a turn.
        speed_noise: of the tachometer [rad/s].
    """

    current_range: float
    current_noise: float
    current_offset: float
    voltage_quantum: float
    voltage_noise: float
    counts: int
    speed_noise: float


@dataclass(frozen=True)
class Experiment:
    """A bench before it runs; the command is the voltage of each row [V]."""

    kind: Kind
    motor: Motor
    supply: Supply
    command: np.ndarray
    meters: Meters

    def run(self) -> States:
        """Return the states at the rows."""
        return simulate(self.motor, self.supply, self.command)


@dataclass(frozen=True)
class MadeBench:
    """A log with its truth; current and speed of a row are those when its voltage begins.

    Attributes:
        time, voltage, current, speed: of each row [s], [V], [A], [rad/s].
        truth: what made it.
    """

    time: np.ndarray
    voltage: np.ndarray
    current: np.ndarray
    speed: np.ndarray
    truth: Truth


def bench(seed: int) -> MadeBench:
    """Return the bench of a seed."""
    rng = np.random.default_rng(seed)
    experiment = drawn(rng)
    states = experiment.run()
    return logged(rng, experiment, states)


def recorded(log: MadeBench) -> BenchRecord:
    """Return a log as what a fit reads."""
    return BenchRecord(
        name="made",
        sha256="",
        time=log.time,
        voltage=log.voltage,
        current=log.current,
        speed=log.speed,
    )


def drawn(rng: Generator) -> Experiment:
    """Draw an experiment."""
    kind = drawn_kind(rng)
    motor = _with_effects(rng, _size(rng, kind), kind)
    tau = motor.mechanical_time
    fastest = min(5000, max(200, 100 / tau), 20000 / max(4, 30 * tau))
    rate = _log_uniform(rng, max(50, 5 / tau), fastest)
    longest = min(60, 20000 / rate)
    duration = rng.uniform(min(max(10, 30 * tau, 1000 / rate), longest), longest)
    plan = Plan(int(rate * duration), tau * rate, kind.both_directions)
    command = motor.voltage * plan.command(rng, kind.excitation)
    supply = _supply(rng, motor, kind, 1 / rate)
    experiment = Experiment(kind, motor, supply, command, _meters(rng, motor, 1 / rate))
    return _heated(rng, experiment) if kind.heat else experiment


def logged(rng: Generator, experiment: Experiment, states: States) -> MadeBench:
    """Return what the meters log of an experiment."""
    meters, kind, row = experiment.meters, experiment.kind, experiment.supply.row
    rows = len(experiment.command)
    current = states.mean_current if kind.pwm == "averaged" else states.current
    current = current + meters.current_offset + meters.current_noise * rng.standard_normal(rows)
    reach, levels = meters.current_range, 2**kind.ammeter_bits
    current = np.clip(_rounded(current, 2 * reach / levels), -reach, reach)
    voltage = experiment.command + meters.voltage_noise * rng.standard_normal(rows)
    if kind.encoder:
        ticks = np.floor(states.angle * meters.counts / (2 * np.pi) + rng.random())
        speed = np.diff(ticks, prepend=ticks[0]) * 2 * np.pi / (meters.counts * row)
    else:
        speed = states.speed + meters.speed_noise * rng.standard_normal(rows)
    channels = {
        "voltage": _rounded(voltage, meters.voltage_quantum),
        "current": current,
        "speed": speed,
    }
    if kind.late != "none":
        late = channels[kind.late]
        channels[kind.late] = np.concatenate([late[:1], late[:-1]])
    return MadeBench(np.arange(rows) * row, **channels, truth=truth(experiment, states))


def truth(experiment: Experiment, states: States) -> Truth:
    """Return what a fit of the log ought to find."""
    motor, current = experiment.motor, states.current
    size = np.abs(current)
    largest = float(size.max())
    resistance = motor.resistance_at(current, states.winding_rise)
    occurring = resistance[size >= 0.1 * largest]
    line = np.linspace(0.25, 1, 301) * largest
    rises = (0.0, float(states.winding_rise.max()))
    volts = [line * motor.resistance_at(line, rise) + motor.drop_at(line) for rise in rises]
    slopes = np.gradient(np.array(volts), line, axis=1)
    back_emf = motor.back_emf * (1 + motor.magnet_slope * states.magnet_rise)
    return Truth(
        resistance=float(np.average(resistance, weights=current**2)),
        resistance_low=float(occurring.min()),
        resistance_high=float(occurring.max()),
        slope_low=float(slopes.min()),
        slope_high=float(slopes.max()),
        back_emf=float(np.average(back_emf, weights=states.speed**2)),
        back_emf_low=float(back_emf.min()),
        back_emf_high=float(back_emf.max()),
        inductance=motor.inductance,
        inertia=motor.inertia,
        coulomb=motor.coulomb,
        viscous=motor.viscous,
        drop=float(motor.drop_at(np.array(largest))),
        largest_current=largest,
        largest_speed=float(np.abs(states.speed).max()),
        largest_rise=rises[1],
        plain=experiment.kind.plain,
        kind=experiment.kind,
        motor=motor,
    )


def _rounded(values: np.ndarray, quantum: float) -> np.ndarray:
    return quantum * np.round(values / quantum)


def _log_uniform(rng: Generator, low: float, high: float) -> float:
    return math.exp(rng.uniform(math.log(low), math.log(high)))


def _chance(rng: Generator, fraction: float) -> bool:
    return bool(rng.random() < fraction)


def _choice(rng: Generator, fractions: dict[str, float]) -> str:
    return str(rng.choice(list(fractions), p=list(fractions.values())))


def drawn_kind(rng: Generator) -> Kind:
    """Draw what a bench has."""
    others = not _chance(rng, PLAIN)
    return Kind(
        drop=_choice(rng, DROPS if others else PLAIN_DROPS),
        film=_chance(rng, FILM) and others,
        heat=_chance(rng, HEAT) and others,
        cogging=_chance(rng, COGGING) and others,
        stribeck=_chance(rng, STRIBECK) and others,
        ripple=_chance(rng, RIPPLE) and others,
        pwm=_choice(rng, PWM),
        ramp=_chance(rng, RAMP),
        late=_choice(rng, LATE),
        ammeter_bits=8 if _chance(rng, COARSE_AMMETER) else 12,
        encoder=_chance(rng, ENCODER),
        excitation=_choice(rng, EXCITATIONS),
        both_directions=_chance(rng, BOTH_DIRECTIONS),
    )


def _size(rng: Generator, kind: Kind) -> Motor:
    """Draw a motor without effects, until speed, current and torque are those of real ones."""
    stall, top, torque = 0.0, 0.0, 0.0
    while not (0.4 <= stall <= 60 and 80 <= top <= 2500 and torque <= 10):
        voltage = _log_uniform(rng, 3, 48)
        resistance, back_emf = _log_uniform(rng, 0.05, 10), _log_uniform(rng, 0.003, 0.2)
        stall, top = voltage / resistance, voltage / back_emf
        torque = stall * back_emf
    fastest = 0.05e-3 if kind.pwm == "none" else 0.15e-3
    return Motor(
        voltage=voltage,
        resistance=resistance,
        back_emf=back_emf,
        inductance=resistance * _log_uniform(rng, fastest, 3e-3),
        inertia=_log_uniform(rng, 5e-3, 400e-3) * back_emf**2 / resistance,
        coulomb=torque * rng.uniform(0.01, 0.08),
        viscous=torque / top * rng.uniform(0, 0.06),
    )


def _with_effects(rng: Generator, motor: Motor, kind: Kind) -> Motor:
    """Draw the sizes of the effects that a motor has."""
    stall = motor.stall_current
    effects: dict[str, float] = {}
    if kind.drop != "none":
        scale = stall * _log_uniform(rng, 0.02, 0.3)
        largest = min(motor.voltage * rng.uniform(0.01, 0.15), 2.0)
        factor = largest / math.log1p(stall / scale) if kind.drop == "logarithm" else largest
        effects |= {"drop_shape": Drop[kind.drop.upper()], "drop": factor, "drop_current": scale}
    if kind.film:
        film = motor.resistance * rng.uniform(0.18, 1.0)
        effects |= {"film": film, "film_current": stall * rng.uniform(0.15, 0.5)}
    if kind.heat:
        effects |= {"copper_slope": COPPER, "magnet_slope": -rng.uniform(0.001, 0.002)}
        effects |= {"winding_time": _log_uniform(rng, 20, 100)}
        effects |= {"magnet_time": _log_uniform(rng, 50, 200)}
    if kind.cogging:
        size, order = motor.coulomb * rng.uniform(0.1, 0.7), float(rng.integers(6, 25))
        effects |= {"cogging": size, "cogging_order": order}
    if kind.stribeck:
        speed = motor.top_speed * _log_uniform(rng, 0.01, 0.06)
        effects |= {"stribeck": rng.uniform(0.2, 1.0), "stribeck_speed": speed}
    if kind.ripple:
        size, order = rng.uniform(0.01, 0.05), 2.0 * rng.integers(3, 14)
        effects |= {"ripple": size, "ripple_order": order}
    return replace(motor, **effects)


def _supply(rng: Generator, motor: Motor, kind: Kind, row: float) -> Supply:
    """Draw a supply; at least three pulses come within L / R."""
    if kind.pwm == "none":
        return Supply(row, substeps(motor, row), kind.ramp)
    slowest = max(10e3, 3 * motor.resistance / motor.inductance)
    frequency = rng.uniform(slowest, 25e3)
    bus = motor.voltage * rng.uniform(1, 1.3)
    return Supply(row, substeps(motor, row, frequency), kind.ramp, frequency, bus)


def _meters(rng: Generator, motor: Motor, row: float) -> Meters:
    """Draw meters; an encoder gives at least 15 ticks in a row at top speed."""
    enough = COUNTS[motor.top_speed * row * COUNTS / (2 * np.pi) >= 15][:3]
    reach = motor.stall_current * rng.uniform(1.15, 1.6)
    return Meters(
        current_range=reach,
        current_noise=reach * _log_uniform(rng, 0.0005, 0.005),
        current_offset=reach * rng.uniform(-0.005, 0.005),
        voltage_quantum=2.4 * motor.voltage / 2 ** int(rng.choice([10, 12])),
        voltage_noise=motor.voltage * _log_uniform(rng, 0.0005, 0.005),
        counts=int(rng.choice(enough)),
        speed_noise=motor.top_speed * _log_uniform(rng, 0.001, 0.01),
    )


def _heated(rng: Generator, experiment: Experiment) -> Experiment:
    """Return the experiment with a thermal resistance, from the heat of the cold motor.

    The winding ends near the drawn rise, apart from when its heat comes and how R grows.
    """
    motor, states = experiment.motor, experiment.run()
    heat = np.mean(motor.resistance_at(states.current) * states.current**2)
    duration = len(experiment.command) * experiment.supply.row
    reached = -math.expm1(-duration / motor.winding_time)
    resistance = rng.uniform(10, 40) / (heat * reached)
    return replace(experiment, motor=replace(motor, thermal_resistance=float(resistance)))
