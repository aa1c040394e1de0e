"""Usual fits of a linear motor with dry friction to a log: scipy and CasADi.

    L dI/dt = U - R I - C_e w        J dw/dt = C_e I - b w - tau_c sign(w)

Both minimize the errors of a simulation from the first row by the voltage alone, each channel
divided by its std in the log, over the logarithms of the parameters.
"""

import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from slipid.infer.bench.motor import BenchMotor, BenchRecord

SOFT = 0.5
"""Speed over which the friction of CasADi, which has to be smooth, changes its sign [rad/s]."""

WIDE = math.log(1000.0)
"""Logarithm of the largest factor between a parameter and its start."""


@dataclass(frozen=True)
class LinearMotor:
    """Parameters of the motor [SI]."""

    resistance: float
    back_emf: float
    inertia: float
    viscous: float
    coulomb: float
    inductance: float

    @classmethod
    def near(cls, motor: BenchMotor) -> "LinearMotor":
        """Return the usual start: least squares, and an electrical time constant of 1 ms."""
        resistance = float(motor.resistance)
        return cls(
            resistance,
            float(motor.back_emf),
            float(motor.rotor_inertia),
            float(motor.viscous_friction),
            float(motor.coulomb_friction),
            1e-3 * resistance,
        )

    def simulated(self, record: BenchRecord) -> Float[np.ndarray, "2 row"]:
        """Return current and speed of each row, from the first row's and the voltage alone."""
        assert record.voltage is not None
        assert record.current is not None
        r, c, j, b, tau, inductance = astuple(self)
        rate = b / j
        i, w = float(record.current[0]), float(record.speed[0])
        out = [(i, w)]
        for u, h in zip(record.voltage.tolist(), np.diff(record.time).tolist(), strict=False):
            lag = math.exp(-h * r / inductance)
            steady = (u - c * w) / r
            i = steady + lag * (i - steady)
            gain = -math.expm1(-rate * h) / b
            free = w * math.exp(-rate * h) + gain * c * i
            w = math.copysign(max(abs(free) - gain * tau, 0.0), free)
            out.append((i, w))
        return np.array(out).T


def by_scipy(records: Sequence[BenchRecord], start: LinearMotor) -> LinearMotor:
    """Return the motor of `scipy.optimize.least_squares`."""
    scales = _scales(records)

    def residuals(z: np.ndarray) -> np.ndarray:
        motor = LinearMotor(*np.exp(z).tolist())
        errors = [(motor.simulated(r) - _measured(r)) / scales for r in records]
        return np.nan_to_num(np.concatenate(errors, axis=1).ravel(), nan=1e3, posinf=1e3)

    z = np.log(astuple(start))
    found = least_squares(residuals, z, bounds=(z - WIDE, z + WIDE))
    return LinearMotor(*np.exp(found.x).tolist())


def by_casadi(records: Sequence[BenchRecord], start: LinearMotor) -> LinearMotor:
    """Return the motor of CasADi's Ipopt with the Gauss-Newton Hessian, by single shooting."""
    import casadi as ca

    z, state, inputs = ca.SX.sym("z", 6), ca.SX.sym("x", 2), ca.SX.sym("u", 2)
    r, c, j, b, tau, inductance = ca.vertsplit(ca.exp(z))
    i, w = ca.vertsplit(state)
    u, h = ca.vertsplit(inputs)
    steady = (u - c * w) / r
    i = steady + ca.exp(-h * r / inductance) * (i - steady)
    w += -ca.expm1(-h * b / j) / b * (c * i - b * w - tau * ca.tanh(w / SOFT))
    step = ca.Function("step", [state, inputs, z], [ca.vertcat(i, w)])
    free, errors, scales = ca.MX.sym("z", 6), [], _scales(records)
    for one in records:
        assert one.voltage is not None
        measured, h = _measured(one), np.diff(one.time)
        voltage = np.stack([one.voltage[:-1], h])
        chain = step.mapaccum("chain", len(h))
        states = chain(measured[:, 0], voltage, ca.repmat(free, 1, len(h)))
        errors.append(ca.vec((states - measured[:, 1:]) / ca.DM(np.tile(scales, (1, len(h))))))
    error = ca.vertcat(*errors)
    slope, sigma = ca.jacobian(error, free), ca.MX.sym("s")
    hessian = ca.Function(
        "hessian",
        {
            "x": free,
            "p": ca.MX(0, 0),
            "lam_f": sigma,
            "lam_g": ca.MX(0, 0),
            "triu_hess_gamma_x_x": sigma * ca.triu(slope.T @ slope),
        },
        ["x", "p", "lam_f", "lam_g"],
        ["triu_hess_gamma_x_x"],
    )
    loss = {"x": free, "f": 0.5 * ca.sumsqr(error)}
    quiet = {"print_time": False, "ipopt": {"print_level": 0, "max_iter": 100, "sb": "yes"}}
    solver = ca.nlpsol("solver", "ipopt", loss, {"hess_lag": hessian, **quiet})
    first = np.log(astuple(start))
    found = solver(x0=first, lbx=first - WIDE, ubx=first + WIDE)["x"]
    return LinearMotor(*np.exp(np.array(found).ravel()).tolist())


def _measured(record: BenchRecord) -> Float[np.ndarray, "2 row"]:
    return np.stack([record.current, record.speed])


def _scales(records: Sequence[BenchRecord]) -> Float[np.ndarray, "2 1"]:
    """Return the std of current and speed."""
    return np.concatenate([_measured(r) for r in records], axis=1).std(axis=1, keepdims=True)
