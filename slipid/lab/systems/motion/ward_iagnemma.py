"""Ward and Iagnemma: slip detection by an extended Kalman filter on the robot's dynamics.

The state is the body's twist (vx, vy, W), the coefficient rho of the resistive force and the gyro's
bias b. Wheel speeds w_i are inputs. Let L be the base radius, q = (vx, vy, L W), J_i the row vector
that maps q to the rim speed of drive i, r the wheel radius, N = m g / n the load of each of n
drives, M = diag(m, m, m/2), p = (vx, vy) and q_t = L W. Then the forces and the equation of motion
are

    u_i    = r w_i - J_i q                                              sliding speed
    T_i    = N (C1 sgn(u_i) (1 - exp(-A |u_i|)) + C2 u_i)               traction
    F      = - m g rho (1 / sqrt(|p|^2 + v_s^2) + c) p                  resistive force on travel
             - m g rho_t q_t / sqrt(|q_t|^2 + v_s^2)                    and on turning
    M dq/dt = sum_i J_i^T T_i + F + m W (vy, -vx, 0)

Wheels that do not determine the twist (skid steer) grip sideways, and they slide sideways as soon
as the robot turns; then p = vx and q_t = (vy, L W). Each time step is a step of backward Euler,
solved by Newton's method with the analytic Jacobian. The measurements are gyro = W + b and, in
`ward_iagnemma_current`, the motor force n_g C_e I_i / r = k sgn(w_i) T_i + f of every wheel that
drives, with the gear ratio n_g, the back-EMF constant C_e and the current I_i. A weak constraint
keeps rho in its range. If rho is below 0, so that the force would push, or above C1 / (1 + c |p|),
so that no traction could overcome it, a pseudo-measurement at the bound corrects it, whose std is a
tenth of rho's std between runs.

In the original, a robot counts as immobilised if the norm of its twist is below 0.2 of that of its
wheels' twist for 0.4 s. The slip score here is 1 - |q| / |q of the rolling wheels|.

The fit uses at most 40 runs. It finds A, rho, rho_t and c by least squares of the twists of windows
of half a second, each taken as steady motion. The residuals then give the std of rho between runs,
the process noise (white noise of the twist that explains the end-point errors of training runs),
the noise and bias of the gyro, and k, f and the noise of the currents. Two settings are tuned:
whether resistance grows with speed (c), and whether rho is a random walk within a run, whose std
after a second is half of the std of rho between runs.

Liberties:
- The original measures acceleration and, if available, GPS; neither is logged here. It models
  motion along one axis and pitch; here the body moves in a plane, and the floor is level.
- The state includes the coefficient of the resistive force, not the force itself. The force fades
  out below v_s = 2 cm/s and may grow with speed (c); turning has its own coefficient.
- The original takes parameters from experiments and shows that their values matter little; here
  they are fitted. Steady motion identifies forces only relative to C1, so C1 is fixed at 0.6. C2 is
  fixed at 0.1 s/m, since windows cannot separate it from the tail of the exponential. A weak prior
  determines the other parameters where motion does not identify them.
- Every drive carries the same load, traction acts along the drive direction only (rollers are
  free), and the inertia is m L^2 / 2.
- Forces from currents have a scale k and an offset f, fitted by least squares, because gear losses
  are not known, and often the constants of the motor are not known either. The errors of these
  forces are nearly constant within a run, so their noise is chosen to give the right variance of a
  run's mean. The forces correct rho directly, and the twist only through rho: the steep traction
  law would attribute all scatter of the forces to sliding, which causes only a small part of it. If
  currents have no sign, all driving wheels are assumed to push. Currents of wheels below 0.3 of the
  fastest rim speed are not used.
- A run starts with the twist without slip.
- The score is the ratio itself, without waiting for 0.4 s.
- The pose is not corrected by later measurements: the path is integrated from the filtered twists,
  and its covariance is that of this path (a Kalman filter whose gain for the pose is zero).

Source: Ward & Iagnemma 2008, "A dynamic-model-based wheel slip detector for mobile robots on
outdoor terrain", IEEE Transactions on Robotics 24(4).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import final

import numpy as np
from jaxtyping import Int

from slipid.lab.systems.motion.ward_iagnemma_dynamics import (
    V_S,
    Drives,
    Dynamics,
    DynamicsStep,
    Each,
    ForceLaw,
    PaddedRuns,
    Speeds,
    measurements,
)
from slipid.lab.systems.motion.ward_iagnemma_filter import FilterNoise, SlipFilter
from slipid.predict.slip_model import PredictedRun, RobotSpec, Run, RunSignals, SlipModel, path_of

_STEADY_STEP_S = 10.0
"""Duration of the backward Euler step whose end counts as steady motion [s]."""
_FIT_RUNS, _FIT_WINDOWS = 40, 100
"""Largest number of runs in a fit, and of windows in the fit of the force law."""
_BOUNDS = {
    "rise": (0.5, 500.0),
    "rolling": (1e-3, 1.0),
    "turning": (1e-3, 1.0),
    "drag": (0.1, 500.0),
}
_GRID = ((0.3, 1.0), (0.3, 6.0), (3.0, 1.0), (3.0, 6.0))
"""Start values of A and rho, as factors of the geometric middles of their bounds."""
_PRIOR_WEIGHT = 1e-3
"""Weight of the prior: a parameter that differs from the middle of its bounds by a factor e adds as
much to the loss as this relative slip in every window."""
_MEDIAN_OF_SQUARES = 0.4549
"""Median of the square of a standard normal variable; a median of squares divided by it is a robust
variance."""


@dataclass(frozen=True, eq=False)
class PosedWindows:
    """Windows of training runs with true speeds.

    Attributes:
        run: index of the run of each window.
        rolling: q without slip [m/s].
        true: q from the poses [m/s].
        rim: rim speed of each drive [m/s].
        force: force of each motor at the rim from its current [N], NaN where it is unknown.
        gyro: yaw rate by the gyro less the true one [rad/s]; NaN without a gyro.
        dt: duration of each window [s].
    """

    run: Int[np.ndarray, " run"]
    rolling: Speeds
    true: Speeds
    rim: Drives
    force: Drives
    gyro: Each
    dt: Each

    @classmethod
    def of(cls, runs: Sequence[Run], spec: RobotSpec) -> "PosedWindows":
        """Return the windows of at most `_FIT_RUNS` runs, drawn with a fixed seed."""
        drawn = np.random.default_rng(0).permutation(len(runs))[:_FIT_RUNS]
        joined = [runs[k].windowed() for k in np.sort(drawn)]
        run = np.repeat(np.arange(len(joined)), [len(one.signals) for one in joined])
        columns = zip(*(measurements(one.signals, spec) for one in joined), strict=True)
        dt, rim, rolling, gyro, force = map(np.concatenate, columns)
        true = np.concatenate([one.twist * spec.size for one in joined])
        return cls(run, rolling, true, rim, force, gyro - true[:, 2] / spec.base_radius, dt)

    def thinned(self, most: int) -> "PosedWindows":
        """Return at most `most` of the windows, evenly spaced."""
        every = slice(None, None, -(-len(self.dt) // most))
        return replace(self, **{f.name: getattr(self, f.name)[every] for f in fields(self)})

    def steady(self, dynamics: Dynamics) -> DynamicsStep:
        """Return the steady speeds that the dynamics give for the rim speeds of every window."""
        rolling = np.full(len(self.dt), dynamics.law.rolling)
        return dynamics.step(self.rolling, rolling, self.rim, np.full(len(self.dt), _STEADY_STEP_S))


def fitted_law(windows: PosedWindows, spec: RobotSpec, with_drag: bool) -> ForceLaw:
    """Return the force law whose steady speeds are closest to the true speeds of windows.

    Errors are relative to the speeds of the rolling wheels; `with_drag` also fits c.
    """
    from scipy.optimize import least_squares

    names = [name for name in _BOUNDS if with_drag or name != "drag"]
    low, high = np.log([_BOUNDS[name] for name in names]).T
    middle = 0.5 * (low + high)
    some = windows.thinned(_FIT_WINDOWS)
    size = np.maximum(np.linalg.norm(some.rolling, axis=1), V_S)[:, None]

    def law(logs: np.ndarray) -> ForceLaw:
        return ForceLaw(**dict(zip(names, np.exp(logs).tolist(), strict=True)))

    def residuals(logs: np.ndarray) -> np.ndarray:
        gap = (some.steady(Dynamics.of(spec, law(logs))).speeds - some.true) / size
        return np.append(gap.ravel(), _PRIOR_WEIGHT * np.sqrt(len(gap)) * (logs - middle))

    starts = [middle + np.log([*times, 1.0, 1.0][: len(names)]) for times in _GRID]
    found = least_squares(
        residuals,
        min(starts, key=lambda logs: float(np.abs(residuals(logs)).sum())),
        bounds=(low, high),
        loss="soft_l1",
        f_scale=0.1,
        diff_step=1e-3,
        max_nfev=12,
        ftol=1e-4,
        xtol=1e-3,
    )
    return law(found.x)


def fitted_noise(windows: PosedWindows, dynamics: Dynamics, mass: float) -> FilterNoise:
    """Return the noise of process and measurements, from the dynamics' residuals in windows."""
    step = windows.steady(dynamics)
    gap = windows.true - step.speeds
    at = np.unique(windows.run, return_index=True)[1]
    moment = np.add.reduceat((gap * step.by_rolling).sum(axis=1), at)
    shift = moment / np.maximum(np.add.reduceat((step.by_rolling**2).sum(axis=1), at), 1e-12)
    gap = gap - step.by_rolling * np.repeat(shift, np.diff(at, append=len(gap)))[:, None]
    ends = np.add.reduceat(gap * windows.dt[:, None], at)
    density = np.median(ends**2 / np.add.reduceat(windows.dt, at)[:, None], axis=0)
    drift = np.maximum(np.sqrt(density / _MEDIAN_OF_SQUARES), 1e-4)
    noise = replace(
        FilterNoise(),
        rolling=max(float(np.sqrt(np.median(shift**2) / _MEDIAN_OF_SQUARES)), 1e-5),
        drift=(float(drift[0]), float(drift[1]), float(drift[2])),
    )
    slide = windows.rim - step.speeds @ dynamics.rims.T
    force = mass * np.sign(windows.rim) * dynamics.traction(slide)
    return with_currents(with_gyro(noise, windows), windows, force)


def with_gyro(noise: FilterNoise, windows: PosedWindows) -> FilterNoise:
    """Return `noise` with the stds of the gyro and of its bias added, if there is a gyro."""
    known = np.isfinite(windows.gyro)
    if not known.any():
        return noise
    of = np.unique(windows.run[known], return_inverse=True)[1]
    means = np.bincount(of, windows.gyro[known]) / np.bincount(of)
    scatter = float(np.std(windows.gyro[known] - means[of]))
    bias = float(np.sqrt(np.mean(means**2)))
    return replace(noise, gyro=max(scatter, 1e-5), bias=max(bias, 1e-5))


def with_currents(noise: FilterNoise, windows: PosedWindows, force: Drives) -> FilterNoise:
    """Return `noise` with scale k, offset f and std of forces from currents, if there are currents.

    `force` has the modelled force of each drive along its motion [N].
    """
    known = np.isfinite(windows.force)
    if not known.any():
        return noise
    measured, modelled = windows.force[known], force[known]
    shared = float(np.mean((modelled - modelled.mean()) * (measured - measured.mean())))
    gain = max(shared / max(float(np.var(modelled)), 1e-12), 0.0)
    offset = float(measured.mean() - gain * modelled.mean())
    residual = np.where(known, windows.force - offset - gain * force, 0.0)
    at = np.unique(windows.run, return_index=True)[1]
    sums, counts = np.add.reduceat(residual, at), np.add.reduceat(known.astype(float), at)
    # white noise of this variance gives a run's mean the same variance as the residuals
    variance = float((sums**2).sum() / counts.sum())
    return replace(noise, gain=gain, offset=offset, force=max(variance**0.5, 1e-6))


@final
@dataclass(frozen=True)
class WardIagnemma(SlipModel):
    """Slip model by the extended Kalman filter, with or without currents.

    Attributes:
        with_drag: True if resistance may grow with speed.
        wander: std of the random walk of rho after one second, relative to its std between runs.
        law: fitted force law.
        noise: fitted noise.
    """

    name: str = "ward_iagnemma"
    with_drag: bool = True
    wander: float = 0.0
    law: ForceLaw = field(default_factory=ForceLaw)
    noise: FilterNoise = field(default_factory=FilterNoise)

    @classmethod
    def with_current(cls) -> "WardIagnemma":
        """Return the variant that also uses currents, as measurements of traction."""
        return cls("ward_iagnemma_current", needs=frozenset({"current"}))

    def candidates(self) -> Sequence["WardIagnemma"]:
        return [replace(self, with_drag=d, wander=w) for d in (False, True) for w in (0.0, 0.5)]

    def fit(self, runs: Sequence[Run], spec: RobotSpec) -> "WardIagnemma":
        windows = PosedWindows.of(runs, spec)
        law = fitted_law(windows, spec, self.with_drag)
        noise = fitted_noise(windows, Dynamics.of(spec, law), spec.mass)
        return replace(self, law=law, noise=noise)

    def predict(self, runs: Sequence[RunSignals], spec: RobotSpec) -> list[PredictedRun]:
        padded = PaddedRuns.of(runs, spec)
        speeds, covariance = self.filter(spec).track(padded)
        size, fastest = (np.linalg.norm(q, axis=2) for q in (speeds, padded.rolling))
        kept = np.where(fastest > V_S, size / np.where(fastest > V_S, fastest, 1.0), 1.0)
        slipping = np.clip(1.0 - kept, 0.0, 1.0)
        return [
            PredictedRun(
                path_of(speeds[k, : len(run)] / spec.size, run.dt),
                end_covariance=covariance[k, :2, :2],
                slipping=slipping[k, : len(run)],
            )
            for k, run in enumerate(runs)
        ]

    def filter(self, spec: RobotSpec) -> SlipFilter:
        """Return the fitted filter for a robot."""
        return SlipFilter(
            dynamics=Dynamics.of(spec, self.law),
            noise=self.noise,
            mass=spec.mass,
            uses_current="current" in self.needs,
            wander=self.wander * self.noise.rolling,
        )

    @property
    def numbers(self) -> int:
        measured = 2 * np.isfinite(self.noise.gyro) + 3 * ("current" in self.needs)
        return 3 + self.with_drag + 4 + int(measured)
