"""The fit finds the law of a floor in windows of training runs, and then the noise that is left.

The law is that whose steady speeds come nearest to the true ones. The noise is then taken from what
the law leaves: how resistance scatters between runs, how twists scatter within a run, and what gyro
and currents are off.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Int

from slipid.baselines.motion.ward_iagnemma.dynamics import (
    REST,
    Drives,
    Dynamics,
    Each,
    Law,
    Speeds,
    Step,
)
from slipid.baselines.motion.ward_iagnemma.filter import Noise
from slipid.baselines.motion.ward_iagnemma.padded import Padded
from slipid.identify.compare.slip_model import Machine, Run

_STEADY = 10.0
"""Time after which speeds are taken for steady [s]."""
_FIT_RUNS, _FIT_WINDOWS = 40, 100
"""Largest numbers of runs, and of windows for the law, that are fitted to."""
_BOUNDS = {
    "rise": (0.5, 500.0),
    "rolling": (1e-3, 1.0),
    "turning": (1e-3, 1.0),
    "drag": (0.1, 500.0),
}
_GRID = ((0.3, 1.0), (0.3, 6.0), (3.0, 1.0), (3.0, 6.0))
"""Starts of A and rho, times the middles of their bounds."""
_PRIOR = 1e-3
"""Slip, over that of the wheels, that as much as a factor e of a parameter costs."""
_MEDIAN_OF_SQUARES = 0.4549
"""Of a standard normal number: what a median of squares is divided by to be a variance."""


@dataclass(frozen=True, eq=False)
class Windows:
    """Windows of training runs.

    Attributes:
        run: number of the run of each.
        rolling, true: q if nothing slipped, and by the pose [m/s].
        rim, pull: as of `Padded`.
        gyro: less the true yaw rate [rad/s]; nan where there is none.
        dt: [s].
    """

    run: Int[np.ndarray, " run"]
    rolling: Speeds
    true: Speeds
    rim: Drives
    pull: Drives
    gyro: Each
    dt: Each

    @classmethod
    def of(cls, runs: Sequence[Run], machine: Machine) -> "Windows":
        """Of at most `_FIT_RUNS` runs, drawn with a fixed seed."""
        drawn = np.random.default_rng(0).permutation(len(runs))[:_FIT_RUNS]
        joined = [runs[k].windowed() for k in np.sort(drawn)]
        padded = Padded.of([run.heard for run in joined], machine)
        run, step = np.nonzero(padded.dt > 0.0)
        true = np.concatenate([run.twist * machine.size for run in joined])
        return cls(
            run=run,
            rolling=padded.rolling[run, step],
            true=true,
            rim=padded.rim[run, step],
            pull=padded.pull[run, step],
            gyro=padded.gyro[run, step] - true[:, 2] / machine.base_radius,
            dt=padded.dt[run, step],
        )

    def thinned(self, most: int) -> "Windows":
        """At most so many of them, evenly spaced."""
        every = slice(None, None, -(-len(self.dt) // most))
        return replace(self, **{f.name: getattr(self, f.name)[every] for f in fields(self)})

    def steady(self, dynamics: Dynamics) -> Step:
        """Every window as if it had always driven like that."""
        rolling = np.full(len(self.dt), dynamics.law.rolling)
        return dynamics.step(self.rolling, rolling, self.rim, np.full(len(self.dt), _STEADY))


def fitted_law(windows: Windows, machine: Machine, with_drag: bool) -> Law:
    """The law whose speeds come nearest to the true ones, relative to those of the wheels."""
    from scipy.optimize import least_squares

    names = [name for name in _BOUNDS if with_drag or name != "drag"]
    low, high = np.log([_BOUNDS[name] for name in names]).T
    middle = 0.5 * (low + high)
    some = windows.thinned(_FIT_WINDOWS)
    size = np.maximum(np.linalg.norm(some.rolling, axis=1), REST)[:, None]

    def law(logs: np.ndarray) -> Law:
        return Law(**dict(zip(names, np.exp(logs).tolist(), strict=True)))

    def left(logs: np.ndarray) -> np.ndarray:
        gap = (some.steady(Dynamics.of(machine, law(logs))).speeds - some.true) / size
        return np.append(gap.ravel(), _PRIOR * np.sqrt(len(gap)) * (logs - middle))

    starts = [middle + np.log([*times, 1.0, 1.0][: len(names)]) for times in _GRID]
    found = least_squares(
        left,
        min(starts, key=lambda logs: float(np.abs(left(logs)).sum())),
        bounds=(low, high),
        loss="soft_l1",
        f_scale=0.1,
        diff_step=1e-3,
        max_nfev=12,
        ftol=1e-4,
        xtol=1e-3,
    )
    return law(found.x)


def fitted_noise(windows: Windows, dynamics: Dynamics, mass: float) -> Noise:
    """What the law leaves in the windows."""
    step = windows.steady(dynamics)
    gap = windows.true - step.speeds
    at = np.unique(windows.run, return_index=True)[1]
    push = np.add.reduceat((gap * step.by_rolling).sum(axis=1), at)
    shift = push / np.maximum(np.add.reduceat((step.by_rolling**2).sum(axis=1), at), 1e-12)
    gap = gap - step.by_rolling * np.repeat(shift, np.diff(at, append=len(gap)))[:, None]
    ends = np.add.reduceat(gap * windows.dt[:, None], at)
    density = np.median(ends**2 / np.add.reduceat(windows.dt, at)[:, None], axis=0)
    drift = np.maximum(np.sqrt(density / _MEDIAN_OF_SQUARES), 1e-4)
    noise = replace(
        Noise(),
        rolling=max(float(np.sqrt(np.median(shift**2) / _MEDIAN_OF_SQUARES)), 1e-5),
        drift=(float(drift[0]), float(drift[1]), float(drift[2])),
    )
    slide = windows.rim - step.speeds @ dynamics.rims.T
    force = mass * np.sign(windows.rim) * dynamics.traction(slide)
    return with_currents(with_gyro(noise, windows), windows, force)


def with_gyro(noise: Noise, windows: Windows) -> Noise:
    """Noise and bias of the gyro, where there is one."""
    told = np.isfinite(windows.gyro)
    if not told.any():
        return noise
    of = np.unique(windows.run[told], return_inverse=True)[1]
    means = np.bincount(of, windows.gyro[told]) / np.bincount(of)
    scatter = float(np.std(windows.gyro[told] - means[of]))
    bias = float(np.sqrt(np.mean(means**2)))
    return replace(noise, gyro=max(scatter, 1e-5), bias=max(bias, 1e-5))


def with_currents(noise: Noise, windows: Windows, force: Drives) -> Noise:
    """Scale, offset and noise of the forces by currents, where there are any."""
    told = np.isfinite(windows.pull)
    if not told.any():
        return noise
    pull, pushed = windows.pull[told], force[told]
    shared = float(np.mean((pushed - pushed.mean()) * (pull - pull.mean())))
    gain = max(shared / max(float(np.var(pushed)), 1e-12), 0.0)
    offset = float(pull.mean() - gain * pushed.mean())
    left = np.where(told, windows.pull - offset - gain * force, 0.0)
    at = np.unique(windows.run, return_index=True)[1]
    sums, counts = np.add.reduceat(left, at), np.add.reduceat(told.astype(float), at)
    # white noise with the same error of the mean of a run
    variance = float((sums**2).sum() / counts.sum())
    return replace(noise, gain=gain, offset=offset, force=max(variance**0.5, 1e-6))
