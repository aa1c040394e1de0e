"""Least squares for a motor's parameters: the rivals of a fit, and its start values.

    U = R I + C_e w [+ U_0]        C_e I = J dw/dt + b w + tau_c sign(w) [+ C_e I_0]

Accelerations are central differences of the speed.
"""

from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from slipid.infer.bench.motor import BenchMotor
from slipid.infer.bench.rows import Rows

RIVALS = {"least_squares": False, "least_squares_with_offset": True}
"""Names of the rivals, and whether they estimate the zeros of the meters."""
SIGN_PASSES = 10
"""Number of least squares in which the signs of magnitudes of currents settle."""
LEAST = 1e-3
"""Smallest estimate of a positive parameter, relative to its scale."""


class Winding(NamedTuple):
    """Constants of U = R I + C_e w + U_0.

    Attributes:
        resistance: R [ohm].
        back_emf: C_e [V s/rad].
        offset: U_0 [V].
    """

    resistance: float
    back_emf: float
    offset: float = 0.0

    def current(self, voltage: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """Return the current [A] at a voltage [V] and a speed of the shaft [rad/s]."""
        return (voltage - self.offset - self.back_emf * speed) / self.resistance


def fitted_winding(
    current: Float[np.ndarray, " row"],
    speed: Float[np.ndarray, " row"],
    voltage: Float[np.ndarray, " row"],
    with_offset: bool,
) -> Winding:
    """Return the constants of least squares, those of resistance and back-EMF positive."""
    one = [np.ones_like(speed)] if with_offset else []
    r, c, *zero = _solved([current, speed, *one], voltage)
    positive = _at_least(r, voltage, current), _at_least(c, voltage, speed)
    return Winding(*positive, *zero)


def _at_least(value: float, over: np.ndarray, per: np.ndarray) -> float:
    """Return a quotient of two channels, or almost 0 if it is not positive."""
    return max(value, LEAST * float(np.abs(over).max() / max(np.abs(per).max(), 1e-9)))


def least_squares(
    rows: Rows, with_offset: bool, use: Bool[np.ndarray, "segment step"] | None = None
) -> BenchMotor:
    """Return a motor whose positive parameters are those of least squares, or else almost 0.

    Without a current, R is 1 ohm: the parameters are then those of the voltage.

    Args:
        rows: rows.
        with_offset: True to estimate the zeros of both meters.
        use: rows that are used, all by default.
    """
    inner = rows.used.copy() if use is None else rows.used & use
    inner[:, [0, -1]] = False
    step = rows.inputs.step
    speed, voltage = rows.speed, rows.voltage
    slope = np.zeros_like(speed)
    span = step[:, 1:-1] + step[:, 2:]
    slope[:, 1:-1] = (speed[:, 2:] - speed[:, :-2]) / np.where(span > 0, span, 1.0)
    a, w, u = slope[inner], speed[inner], voltage[inner]
    one = [np.ones_like(w)] if with_offset else []
    if rows.has_current:
        i = rows.current[inner] if rows.signed else _with_signs(rows.current[inner], w, u)
        winding = fitted_winding(i, w, u, with_offset)
    else:
        winding = Winding(1.0, _at_least(_solved([w, np.sign(w), a, *one], u)[0], u, w))
    r, c, zero = winding
    if not rows.has_current:
        i = u - c * w
    j, b, dry, *i_zero = _solved([a, w, np.sign(w), *one], c * i)
    most = c * float(np.abs(i).max())
    fastest, hardest = max(float(np.abs(w).max()), 1e-9), max(float(np.abs(a).max()), 1e-9)
    return _motor(
        resistance=r,
        back_emf=c,
        voltage_offset=zero,
        rotor_inertia=max(j, LEAST * most / hardest),
        viscous_friction=max(b, LEAST**2 * most / fastest),
        coulomb_friction=max(dry, LEAST * most),
        current_offset=i_zero[0] / c if i_zero and rows.has_current else 0.0,
    )


def _with_signs(
    size: Float[np.ndarray, " row"], w: Float[np.ndarray, " row"], u: Float[np.ndarray, " row"]
) -> Float[np.ndarray, " row"]:
    """Return currents with the signs of U - C_e w, which are found together with C_e.

    A motor that brakes has a current against its speed.
    """
    i, one = np.copysign(size, w), np.ones_like(w)
    for _ in range(SIGN_PASSES):
        _, c, zero = _solved([i, w, one], u)
        i = np.copysign(size, u - c * w - zero)
    return i


def _solved(
    columns: list[Float[np.ndarray, " row"]], right: Float[np.ndarray, " row"]
) -> list[float]:
    """Return the coefficients of least squares."""
    table = np.stack(columns, 1)
    size = np.maximum(np.sqrt((table**2).mean(axis=0)), 1e-300)
    found = np.linalg.lstsq(table / size, right, rcond=1e-9)[0] / size
    return [float(x) for x in found]


def _motor(**values: float) -> BenchMotor:
    """Return a motor without inductance, contacts and delays, but with some given parameters."""
    nothing = {
        "inductance": 1e-9 * values["resistance"],
        "brush_drop": 1e-9,
        "stribeck_friction": 1e-9 * values["coulomb_friction"],
    }
    motor = BenchMotor()
    given = nothing | values
    return eqx.tree_at(
        lambda m: [getattr(m, k) for k in given],
        motor,
        [np.asarray(float(v)) for v in given.values()],
    )
