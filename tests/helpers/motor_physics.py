"""A brushed DC motor in fine fixed steps, in C; it shares nothing with the models that it judges.

v = L di/dt + (R (1 + a T) + film exp(-|i| / I_f)) i + drop(i) + c w
J dw/dt = c i - cogging sin(n angle) - (coulomb (1 + s exp(-(w / w_s)^2)) sgn w + viscous w)
c = C_e (1 + m T_magnet) (1 + ripple cos(n angle))
"""

from __future__ import annotations

import ctypes
import math
import subprocess
import tempfile
from dataclasses import astuple, dataclass, fields
from enum import IntEnum
from functools import cache
from pathlib import Path

import numpy as np

COPPER = 0.0039
"""Temperature coefficient of copper [1/K]."""
LONGEST_STEP = 50e-6
"""Step of the simulation [s]; fast motors and PWM get shorter ones."""


class Drop(IntEnum):
    """Shape of the voltage across the brushes, over s = |I| / I_0."""

    NONE = 0
    TANH = 1
    EXPONENTIAL = 2
    """1 - exp(-s)"""
    RATIO = 3
    """s / (1 + s)"""
    LOGARITHM = 4
    """log(1 + s), which has no largest value"""


@dataclass(frozen=True)
class Motor:
    """Constants of a motor, in the order of the C struct.

    Attributes:
        voltage: largest voltage that it is driven with [V].
        resistance: of the cold winding, without contact film [ohm].
        back_emf: of the cold magnets [V s/rad].
        inductance: [H].
        inertia: of rotor and flywheel [kg m2].
        coulomb, viscous: dry friction [N m]; viscous friction [N m s/rad].
        drop_shape, drop, drop_current: brush drop: shape; factor [V]; I_0 [A].
        film, film_current: contact film, film exp(-|I| / film_current) [ohm], [A].
        stribeck, stribeck_speed: rise of dry friction at rest over `coulomb`; its speed [rad/s].
        cogging, cogging_order: amplitude [N m]; periods in a turn.
        ripple, ripple_order: relative amplitude of the coupling; periods in a turn.
        copper_slope, magnet_slope: relative change of resistance and coupling [1/K].
        thermal_resistance: rise of the winding over its heat [K/W]; 0 keeps it cold. The magnets
            follow half of the winding's rise.
        winding_time, magnet_time: thermal time constants [s].
    """

    voltage: float
    resistance: float
    back_emf: float
    inductance: float
    inertia: float
    coulomb: float
    viscous: float
    drop_shape: int = Drop.NONE
    drop: float = 0.0
    drop_current: float = 1.0
    film: float = 0.0
    film_current: float = 1.0
    stribeck: float = 0.0
    stribeck_speed: float = 1.0
    cogging: float = 0.0
    cogging_order: float = 1.0
    ripple: float = 0.0
    ripple_order: float = 1.0
    copper_slope: float = 0.0
    magnet_slope: float = 0.0
    thermal_resistance: float = 0.0
    winding_time: float = 60.0
    magnet_time: float = 120.0

    @property
    def stall_current(self) -> float:
        """Largest voltage over cold resistance [A]."""
        return self.voltage / self.resistance

    @property
    def top_speed(self) -> float:
        """Speed without load at the largest voltage [rad/s]."""
        return self.voltage / self.back_emf

    @property
    def mechanical_time(self) -> float:
        """Time constant of the speed, J R / C_e^2 [s]."""
        return self.inertia * self.resistance / self.back_emf**2

    def resistance_at(self, current: np.ndarray, rise: np.ndarray | float = 0.0) -> np.ndarray:
        """Ohmic voltage over current [ohm] at a temperature rise of the winding [K]."""
        film = self.film * np.exp(-np.abs(current) / self.film_current)
        return self.resistance * (1 + self.copper_slope * rise) + film

    def drop_at(self, current: np.ndarray) -> np.ndarray:
        """Voltage across the brushes [V]."""
        s = np.abs(current) / self.drop_current
        shapes = {
            Drop.NONE: 0 * s,
            Drop.TANH: np.tanh(s),
            Drop.EXPONENTIAL: 1 - np.exp(-s),
            Drop.RATIO: s / (1 + s),
            Drop.LOGARITHM: np.log1p(s),
        }
        return self.drop * np.sign(current) * shapes[Drop(self.drop_shape)]


@dataclass(frozen=True)
class Supply:
    """Voltage between two rows, in the order of the C struct.

    Attributes:
        row: time between two rows [s].
        substeps: number of simulated steps between two rows.
        ramp: whether the voltage goes straight from row to row; otherwise a row's voltage is held.
        pwm_frequency, bus: frequency [Hz] and height [V] of pulses; 0 Hz is a linear amplifier.
    """

    row: float
    substeps: int
    ramp: bool = False
    pwm_frequency: float = 0.0
    bus: float = 0.0


@dataclass(frozen=True)
class States:
    """Motion and temperatures at the times of the rows.

    Attributes:
        current, mean_current: at this instant; over the PWM period before it [A].
        speed, angle: [rad/s]; [rad].
        winding_rise, magnet_rise: temperatures over those at the start [K].
    """

    current: np.ndarray
    mean_current: np.ndarray
    speed: np.ndarray
    angle: np.ndarray
    winding_rise: np.ndarray
    magnet_rise: np.ndarray


def substeps(motor: Motor, row: float, pwm_frequency: float = 0.0) -> int:
    """Number of steps between rows that resolves winding, ripple, cogging and pulses."""
    order = max(motor.cogging_order, motor.ripple_order)
    longest = [
        LONGEST_STEP,
        motor.inductance / motor.resistance / 4,
        0.5 / (order * motor.top_speed),
        *([1 / (16 * pwm_frequency)] if pwm_frequency else []),
    ]
    return math.ceil(row / min(longest))


@cache
def _library() -> ctypes.CDLL:
    """The compiled simulation, built once in a process."""
    source = Path(__file__).with_suffix(".c")
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "motor_physics.so"
        flags = ["-std=c99", "-O2", "-ffp-contract=off", "-fno-math-errno", "-shared", "-fPIC"]
        subprocess.run(["cc", *flags, "-o", library, source, "-lm"], check=True)
        return ctypes.CDLL(str(library))


def _struct(of: Motor | Supply) -> ctypes.Array[ctypes.c_double]:
    """The C struct of a dataclass of numbers."""
    return (ctypes.c_double * len(fields(of)))(*(float(x) for x in astuple(of)))


def simulate(motor: Motor, supply: Supply, command: np.ndarray) -> States:
    """Return the states at the rows of a motor that starts cold, at rest.

    Args:
        motor: its constants.
        supply: what happens between the rows.
        command: voltage of each row, mean of the pulses where there are any [V].
    """
    command = np.ascontiguousarray(command, dtype=np.float64)
    out = np.empty((len(command), len(fields(States))))
    _library().simulate(
        _struct(motor),
        _struct(supply),
        ctypes.c_long(len(command)),
        ctypes.c_void_p(command.ctypes.data),
        ctypes.c_void_p(out.ctypes.data),
    )
    return States(*out.T.copy())
