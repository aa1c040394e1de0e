"""Ward and Iagnemma: slip detection by an extended Kalman filter on the robot's dynamics.

The state is the body's twist v, the coefficient rho of the resistive force and the gyro's bias b.
Wheel speeds are inputs. Let q = (vx, vy, L W), let J_i be the rim speed of drive i per q, let
N = m g / n be the load of each of n drives, and let M = diag(m, m, m/2), p = (vx, vy) and
q_t = L W. Then the forces and the equation of motion are

    u_i    = r w_i - J_i q                                              sliding speed
    T_i    = N (C1 sgn(u_i) (1 - exp(-A |u_i|)) + C2 u_i)               traction
    F      = - m g rho (1 / sqrt(|p|^2 + v_s^2) + c) p                  resistive force on travel
             - m g rho_t q_t / sqrt(|q_t|^2 + v_s^2)                    and on turning
    M dq/dt = sum_i J_i^T T_i + F + m W (vy, -vx, 0)

Wheels that do not determine the twist (skid steer) grip sideways, and they slide sideways as soon
as the robot turns; then p = vx and q_t = (vy, L W). A step is one of backward Euler, solved by
Newton's method with the analytic Jacobian. The filter measures gyro = W + b, and in
`ward_iagnemma_current` also n C_e I_i / r = k sgn(w_i) T_i + f of every wheel that drives. A weak
constraint keeps rho in its range: where rho is below 0, so that the force would push, or above
C1 / (1 + c |p|), so that no traction could overcome it, a measurement with a tenth of rho's spread
moves it to that bound.

A robot counts as immobilised where |v| < 0.2 of its wheels' twist, for 0.4 s. The score of
slipping is 1 - |v| / |v by the wheels|, where turning is weighted by the base radius.

The fit uses at most 40 runs. It finds A, rho, rho_t and c by least squares of the twists of windows
of half a second, each taken as steady motion. The residuals then give the scatter of rho between
runs, the process noise (white noise of the twist that explains the ends of training runs), the
noise and bias of the gyro, and k, f and the noise of the currents. Two settings are tuned: whether
resistance grows with speed (c), and whether rho is a random walk within a run, by half its scatter
between runs in a second.

Liberties:
- The original measures acceleration and, where there is one, GPS; neither is logged here. It has
  one axis of travel and pitch; here the body moves in a plane, and the ground is level.
- The state is the coefficient of the resistive force, not the force. The force fades out below
  v_s = 2 cm/s, and may grow with speed (c); turning has a coefficient of its own.
- The original takes parameters from experiments and shows that their values matter little; here
  they are fitted. Steady motion identifies forces only in ratio to C1, so C1 is 0.6 throughout. C2
  is 0.1 s/m, since windows cannot separate it from the end of the exponential. A weak prior holds
  the other parameters where motion does not identify them.
- Every drive carries the same load, traction acts along the drive direction only (rollers are
  free), and the inertia is m L^2 / 2.
- Forces by currents are scaled and offset by least squares (k, f), because gear losses are not
  known, and often not even the motor. Their errors are mostly the same all along a run, so their
  noise is that of the mean of a run. They correct rho, and through it the twist, but they do not
  correct the twist itself: most of its scatter is no sliding, which the steep law would infer from
  it. Where ammeters have no sign, all driving wheels are taken to push. Currents of wheels below
  0.3 of the fastest rim speed are not used.
- A run starts with the twist without slip.
- The score is the ratio itself, without waiting for 0.4 s.
- The pose is not corrected by later measurements: the path is that of the filtered twists, and
  its covariance is of that path (a Kalman filter whose gain for the pose is zero).

Source: Ward & Iagnemma 2008, "A dynamic-model-based wheel slip detector for mobile robots on
outdoor terrain", IEEE Transactions on Robotics 24(4).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import final

import numpy as np
from jaxtyping import Int

from slipid.lab.systems.motion.ward_iagnemma_dynamics import (
    REST,
    Drives,
    Dynamics,
    DynamicsStep,
    Each,
    ForceLaw,
    PaddedRuns,
    Speeds,
)
from slipid.lab.systems.motion.ward_iagnemma_filter import FilterNoise, SlipFilter
from slipid.predict.slip_model import PredictedRun, RobotSpec, Run, RunSignals, SlipModel, path_of

_STEADY = 10.0
"""Time after which speeds count as steady [s]."""
_FIT_RUNS, _FIT_WINDOWS = 40, 100
"""Largest numbers of runs, and of windows for the law, in a fit."""
_BOUNDS = {
    "rise": (0.5, 500.0),
    "rolling": (1e-3, 1.0),
    "turning": (1e-3, 1.0),
    "drag": (0.1, 500.0),
}
_GRID = ((0.3, 1.0), (0.3, 6.0), (3.0, 1.0), (3.0, 6.0))
"""Start values of A and rho, relative to the middles of their bounds."""
_PRIOR = 1e-3
"""Relative slip whose cost equals that of a factor e in a parameter."""
_MEDIAN_OF_SQUARES = 0.4549
"""Median of the square of a standard normal number: a median of squares over it is a variance."""


@dataclass(frozen=True, eq=False)
class PosedWindows:
    """Windows of training runs.

    Attributes:
        run: index of the run of each window.
        rolling: q without slip [m/s].
        true: q by the pose [m/s].
        rim: rim speed of each drive [m/s].
        force: force of each motor at the rim by its current [N], NaN where it is unknown.
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
        padded = PaddedRuns.of([run.signals for run in joined], spec)
        run, step = np.nonzero(padded.dt > 0.0)
        true = np.concatenate([run.twist * spec.size for run in joined])
        return cls(
            run=run,
            rolling=padded.rolling[run, step],
            true=true,
            rim=padded.rim[run, step],
            force=padded.force[run, step],
            gyro=padded.gyro[run, step] - true[:, 2] / spec.base_radius,
            dt=padded.dt[run, step],
        )

    def thinned(self, most: int) -> "PosedWindows":
        """Return at most so many of the windows, evenly spaced."""
        every = slice(None, None, -(-len(self.dt) // most))
        return replace(self, **{f.name: getattr(self, f.name)[every] for f in fields(self)})

    def steady(self, dynamics: Dynamics) -> DynamicsStep:
        """Return the steady speeds at the inputs of every window."""
        rolling = np.full(len(self.dt), dynamics.law.rolling)
        return dynamics.step(self.rolling, rolling, self.rim, np.full(len(self.dt), _STEADY))


def fitted_law(windows: PosedWindows, spec: RobotSpec, with_drag: bool) -> ForceLaw:
    """Return the law with the least error of steady speeds, relative to those of the wheels."""
    from scipy.optimize import least_squares

    names = [name for name in _BOUNDS if with_drag or name != "drag"]
    low, high = np.log([_BOUNDS[name] for name in names]).T
    middle = 0.5 * (low + high)
    some = windows.thinned(_FIT_WINDOWS)
    size = np.maximum(np.linalg.norm(some.rolling, axis=1), REST)[:, None]

    def law(logs: np.ndarray) -> ForceLaw:
        return ForceLaw(**dict(zip(names, np.exp(logs).tolist(), strict=True)))

    def residuals(logs: np.ndarray) -> np.ndarray:
        gap = (some.steady(Dynamics.of(spec, law(logs))).speeds - some.true) / size
        return np.append(gap.ravel(), _PRIOR * np.sqrt(len(gap)) * (logs - middle))

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
    """Return the noise by the residuals of the law in the windows."""
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
    """Return the noise with that of the gyro and of its bias, if there is a gyro."""
    known = np.isfinite(windows.gyro)
    if not known.any():
        return noise
    of = np.unique(windows.run[known], return_inverse=True)[1]
    means = np.bincount(of, windows.gyro[known]) / np.bincount(of)
    scatter = float(np.std(windows.gyro[known] - means[of]))
    bias = float(np.sqrt(np.mean(means**2)))
    return replace(noise, gyro=max(scatter, 1e-5), bias=max(bias, 1e-5))


def with_currents(noise: FilterNoise, windows: PosedWindows, force: Drives) -> FilterNoise:
    """Return the noise with scale, offset and noise of the forces by currents, if there are any."""
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
    # variance of white noise with the same error of a run's mean
    variance = float((sums**2).sum() / counts.sum())
    return replace(noise, gain=gain, offset=offset, force=max(variance**0.5, 1e-6))


@final
@dataclass(frozen=True)
class WardIagnemma(SlipModel):
    """The filter, with or without currents.

    Attributes:
        with_drag: resistance grows with speed.
        wander: random walk of rho after a second of a run, relative to its scatter between runs.
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
        """Return the variant that measures traction by the currents."""
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
        tracked = self.filter(spec).track(padded)
        size, fastest = (np.linalg.norm(q, axis=2) for q in (tracked.speeds, padded.rolling))
        kept = np.where(fastest > REST, size / np.where(fastest > REST, fastest, 1.0), 1.0)
        slipping = np.clip(1.0 - kept, 0.0, 1.0)
        return [
            PredictedRun(
                path_of(tracked.speeds[k, : len(run)] / spec.size, run.dt),
                end_covariance=tracked.covariance[k, :2, :2],
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
