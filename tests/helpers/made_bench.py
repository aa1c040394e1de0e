"""Logs of a motor on a bench, from the test site's motor, which shares nothing with the model."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np

from slipid.infer.bench.motor import BenchRecord
from slipid.lab.testsite.motors import MotorBuild, SpeedLoop, WheelDrives

FLYWHEEL, ROTOR = 1e-4, 7.1e-6
STEPS = (0, 6, 0, -6, 12, 3, -12, -3, 0, 18, 9, -18, 8, -8, 0)
TRUTH = {
    "resistance": 5.5,
    "back_emf": 0.0514,
    "inductance": 8.9e-3,
    "brush_drop": 0.0,
    "coulomb_friction": 0.004,
    "viscous_friction": 2e-5,
    "current_offset": 0.08,
    "voltage_offset": 0.1,
}


class OpenLoop(WheelDrives):
    """A drive that puts on the voltage it is asked for."""

    def _voltage(self, k: int, wanted: float, measured: float) -> float:
        return wanted


def steps_and_ramps(t: float) -> float:
    """Fifteen steps of a second, two ramps, and coasting with the terminals shorted [V]."""
    if t < 15:
        return STEPS[int(t)]
    if t < 20:
        return (t - 15) * 18 / 5
    return 18 - (t - 20) * 9 if t < 24 else 0.0


def quick_steps(t: float) -> float:
    """Steps of a tenth of a second [V]."""
    return (6.0, -6.0, 12.0, 0.0, -12.0, 9.0)[int(t / 0.1) % 6]


RATE = 100.0
"""Rows per second of logs whose voltage changes at rows [1/s]."""


def at_row(k: int) -> float:
    """Voltage of a row: steps of .3 s, with a sine on them [V]."""
    return 0.8 * STEPS[k // 30 % len(STEPS)] + 3.0 * np.sin(0.11 * k)


def held(t: float) -> float:
    """The voltage of the last row, held until the next one [V]."""
    return at_row(int(t * RATE + 1e-6))


def straight(t: float) -> float:
    """A voltage that is straight from row to row [V]."""
    k, part = divmod(t * RATE + 1e-9, 1.0)
    return at_row(int(k)) * (1 - part) + at_row(int(k) + 1) * part


@lru_cache
def driven(
    inertia: float,
    seconds: float = 25.0,
    drop: float = 0.0,
    profile: Callable[[float], float] = steps_and_ramps,
    dt: float = 1e-4,
    turn: float = 0.05,
    warming: float = 0.0,
) -> np.ndarray:
    """Time, voltage, current, speed, step by step; dry friction holds what it can hold.

    The drop of the brushes turns over the current `turn` [A]; the resistance rises by the part
    `warming` of it in a second, from the start [1/s].
    """
    drive = OpenLoop(
        MotorBuild(supply_v=48.0, supply_ohm=0.0, efficiency=1.0), SpeedLoop(), 1.0, 1, dt
    )
    held = TRUTH["coulomb_friction"] * dt / inertia
    rows, speed = np.empty((round(seconds / dt), 4)), 0.0
    for k in range(len(rows)):
        volts, amps = profile(k * dt), drive.current[0]
        rows[k] = k * dt, volts, amps, speed
        lost = drop * np.tanh(amps / turn) + warming * k * dt * TRUTH["resistance"] * amps
        (torque,) = drive.step([volts - lost], [0.0], [speed])
        free = speed + dt * (torque - TRUTH["viscous_friction"] * speed) / inertia
        speed = 0.0 if abs(free) <= held else free - np.sign(free) * held
    return rows


def logged(
    rows: np.ndarray,
    rate: float,
    seed: int = 0,
    noise: tuple[float, float, float] = (0.05, 0.05, 1.0),
    quantum: tuple[float, float, float] = (0.02, 0.02, 1.0),
    at_changes: bool = False,
) -> BenchRecord:
    """Rows at a rate, with noise, offsets and rounding of voltage, current and speed.

    The first row is at any of the first steps, or at time 0 if `at_changes` is true.
    """
    rng = np.random.default_rng(seed)
    step = round(1 / rate / (rows[1, 0] - rows[0, 0]))
    first = int(rng.integers(step))
    rows = rows[0 if at_changes else first :: step]
    offset = TRUTH["voltage_offset"], TRUTH["current_offset"], 0.0
    seen = rows[:, 1:] + offset + np.array(noise) * rng.normal(size=(len(rows), 3))
    q = np.array(quantum)
    seen = np.where(q > 0, np.round(seen / np.where(q > 0, q, 1)) * q, seen)
    return BenchRecord(
        name="made",
        sha256="",
        time=rows[:, 0],
        voltage=seen[:, 0],
        current=seen[:, 1],
        speed=seen[:, 2],
    )


def truth(inertia: float, drop: float = 0.0) -> dict[str, float]:
    """Every number by its path."""
    known = TRUTH | {"rotor_inertia": inertia, "brush_drop": drop}
    return {f"motor.{name}": value for name, value in known.items()}


def write(record: BenchRecord, path: Path, header: str = "t,U,I,w") -> Path:
    """The record as a CSV file in SI units."""
    table = np.stack([record.time, record.voltage, record.current, record.speed], axis=1)
    np.savetxt(path, table, delimiter=",", header=header, comments="", fmt="%.7g")
    return path
