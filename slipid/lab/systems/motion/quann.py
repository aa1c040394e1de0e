"""Quann and others: energy by a linear law and a map of residuals, slip by a Gaussian process.

In `quann_energy` the energy per metre  y = P / max(|v|, 0.02)  [J/m] is a linear function of
(1, |v|, |v|^2, |W|) plus a Gaussian process over the position. P is the electric power [W], v the
velocity [m/s] and W the yaw rate [rad/s] of the rolling wheels. Power is predicted only from
encoders, as y max(|v|, 0.02).

One setting is tuned by the energy error of whole runs: the length scale of the map.

Liberties of the energy:
    - The papers map energy over positions in a site that a robot team shares. Here the map is over
      positions relative to the pose at a run's start, since no absolute position is given.
    - The process uses a thousand windows drawn at random, slow ones less often, instead of all.
    - The linear law is found by least squares weighted by max(|v|, 0.02)^2, which is least squares
      of power. The process is then fitted to the residuals: its length scale is the tuned setting,
      its variances maximise the marginal likelihood.
    - In the law, speeds and yaw rates are clipped to the largest of the training runs: a law fitted
      at a single speed is wrong by a factor of a hundred at twice that speed.
    - Power is that of the motors from currents and datasheet, not of the whole robot.
    - The predicted path is that of the encoders.

In `quann_slip` the body's slip ratio in windows of half a second (see `features`) is a Gaussian
process of |I| and |w| of each drive and of the direction of travel; its components are forward, to
the left and turning. Within a run, the error of a component is assumed to be the same multiple of
its standard deviation in all windows, so that the end of the path has the covariance

    C = inflation S S^T,   S = sum_k [R_k e_x s_x, R_k e_y s_y, J (p_end - p_k) s_W]_k dt_k

where R_k is the rotation by the heading and p_k the position in step k of duration dt_k, s_x, s_y
and s_W are the standard deviations as velocities, e_x and e_y unit vectors, and J is a rotation by
90 degrees. The inflation is the mean of e^T (S S^T)^-1 e / 2 over runs, where e is the end-point
error of a run that the process was not fitted to: each quarter of the runs is predicted by a fit to
the others.

One setting is tuned: whether each input has its own length scale.

Liberties of the slip:
    - The papers map slip over positions in a site that a robot team shares; here slip depends on
      the robot's own measurements.
    - The direction of travel is a unit vector with a turning component instead of a heading, and
      slip is a ratio.
    - The process uses a thousand windows drawn at random, slow ones less often, instead of all, and
      inputs are clipped to the training range.
    - The covariance of the end point and its inflation are ours, and include a std of 1 mm in each
      direction for the camera.

Both Gaussian processes have a Matern-3/2 kernel and at most a thousand windows (scikit-learn):

    k(x, x') = variance (1 + sqrt(3) d) exp(-sqrt(3) d),    d^2 = sum_i ((x_i - x'_i) / length_i)^2
    mean(x) = k(x, X) (K + noise I)^-1 y
    var(x) = k(x, x) + noise - k(x, X) (K + noise I)^-1 k(X, x)

X are the training inputs, y their outputs and K = k(X, X). All outputs, each divided by its
standard deviation, share one kernel. Hyperparameters maximise the marginal likelihood of
`MOST_TUNING_WINDOWS` windows, in at most `OPTIMISER_STEPS` steps from one start point; the
posterior is conditioned on `MOST_WINDOWS` windows. Windows are drawn in proportion to their weight,
with a fixed seed.

Sources: Quann, Ojeda, Smith, Rizzo, Castanier, Barton 2017, An energy-efficient method for
multi-robot reconnaissance in an unknown environment, American Control Conference; the same 2020,
Power prediction for heterogeneous ground robots through spatial mapping and sharing of terrain
data, IEEE Robotics and Automation Letters 5(2). Rasmussen, Williams 2006, Gaussian Processes for
Machine Learning, MIT Press, equations 2.25, 2.26, 4.17 and 5.8.
"""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, final

import numpy as np
from jaxtyping import Bool, Float, Int

from slipid.lab.systems.motion.features import (
    Inputs,
    Scale,
    SignalWindows,
    SlipExamples,
    at_steps,
    with_slip,
)
from slipid.lab.systems.one_thread import one_thread
from slipid.predict.slip_model import (
    Aim,
    Channel,
    PredictedRun,
    RobotSpec,
    Run,
    RunSignals,
    SlipModel,
    Twists,
    path_of,
)

if TYPE_CHECKING:
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import Kernel

LEAST_SPEED = 0.02
"""Lower limit of |v| by which power is divided to get the energy per metre [m/s]."""


@final
@dataclass(frozen=True, eq=False)
class QuannEnergy(SlipModel):
    """Energy per metre as a linear function of the motion plus a Gaussian process of the position.

    Attributes:
        length: length scale of the map [m].
        law: coefficients of (1, |v|, |v|^2, |W|).
        fastest: largest |v| and |W| of the training runs [m/s], [rad/s].
        process: process of the law's residuals over positions relative to a run's start [m].
    """

    name: str = "quann_energy"
    needs: frozenset[Channel] = field(default=frozenset({"current"}), kw_only=True)
    aim: Aim = field(default="energy", kw_only=True)
    length: float = 0.2
    law: Float[np.ndarray, "4"] | None = None
    fastest: Float[np.ndarray, "2"] | None = None
    process: "GaussianProcessRegressor | None" = None

    def candidates(self) -> Sequence["QuannEnergy"]:
        return [replace(self, length=length) for length in (0.1, 0.2, 0.5)]

    def fit(self, runs: Sequence[Run], spec: RobotSpec) -> "QuannEnergy":
        windows = SignalWindows.of([run.signals for run in runs], spec)
        speed, motion = rate(windows.rolling), motions(windows.rolling)
        energy = np.concatenate([run.power(spec) for run in windows.signals]) / speed
        terms = law_terms(motion)
        law = np.linalg.lstsq(terms * speed[:, None], energy * speed, rcond=1e-6)[0]
        rows = ProcessRows(places(windows, spec), (energy - terms @ law)[:, None], speed**2)
        process = rows.process(rows.tuned(untuned_kernel(self.length, free=False)))
        return replace(self, law=law, fastest=motion.max(axis=0), process=process)

    def predict(self, runs: Sequence[RunSignals], spec: RobotSpec) -> list[PredictedRun]:
        if self.process is None or self.law is None or self.fastest is None:
            raise ValueError(f"{self.name} was not fitted; expected a call of fit before predict")
        windows = SignalWindows.of(runs, spec)
        residual = self.process.predict(places(windows, spec))
        motion = np.minimum(motions(windows.rolling), self.fastest)
        energy = law_terms(motion) @ self.law + residual.ravel()
        rolling = [run.rolling(spec) for run in runs]
        of_steps = at_steps(energy[:, None], windows, runs)
        return [
            PredictedRun(path_of(twist, run.dt), power=energy_of_run[:, 0] * rate(twist))
            for run, twist, energy_of_run in zip(runs, rolling, of_steps, strict=True)
        ]

    @property
    def numbers(self) -> int:
        return 0 if self.process is None else 4 + fitted_numbers(self.process)


def rate(twist: Twists) -> Float[np.ndarray, " row"]:
    """Return the larger of |v| and `LEAST_SPEED` in each row [m/s]."""
    return motions(twist)[:, 0].clip(min=LEAST_SPEED)


def motions(twist: Twists) -> Float[np.ndarray, "row 2"]:
    """Return |v| [m/s] and |W| [rad/s] of twists."""
    return np.stack([np.hypot(twist[:, 0], twist[:, 1]), np.abs(twist[:, 2])], axis=1)


def law_terms(motion: Float[np.ndarray, "row 2"]) -> Float[np.ndarray, "row 4"]:
    """Return the terms (1, |v|, |v|^2, |W|) of the linear law in each row."""
    speed, turning = motion.T
    return np.stack([np.ones_like(speed), speed, speed**2, turning], axis=1)


def places(windows: SignalWindows, spec: RobotSpec) -> Float[np.ndarray, "window 2"]:
    """Return the position in the middle of each window by encoders, relative to the start [m]."""
    paths = [path_of(run.rolling(spec), run.dt)[:, :2] for run in windows.signals]
    return np.concatenate([0.5 * (path[1:] + path[:-1]) for path in paths])


INFLATION_PARTS = 4
"""Number of parts into which runs are divided to find the inflation: each part is predicted by a
fit to the other parts."""
START_LENGTH = 2.0
"""Initial length scale of every input, in standard deviations of the input."""
CAMERA_STD = 1e-3
"""Assumed standard deviation of a camera's position, whichever camera was used [m]."""
SEED = 0


@final
@dataclass(frozen=True, eq=False)
class QuannSlip(SlipModel):
    """Slip as a Gaussian process of currents, wheel speeds and direction of travel.

    Attributes:
        anisotropic: True if each input has its own length scale.
        scale: standardisation of the inputs.
        process: process of the slip ratio's three components.
        inflation: factor of the covariance of the end of a path.
    """

    name: str = "quann_slip"
    needs: frozenset[Channel] = field(default=frozenset({"current"}), kw_only=True)
    anisotropic: bool = True
    scale: Scale | None = None
    process: "GaussianProcessRegressor | None" = None
    inflation: float = 1.0

    def candidates(self) -> Sequence["QuannSlip"]:
        return [replace(self, anisotropic=each) for each in (True, False)]

    def fit(self, runs: Sequence[Run], spec: RobotSpec) -> "QuannSlip":
        examples = SlipExamples.of(runs, spec)
        inputs = slip_inputs(examples.windows, spec)[examples.windows.moving]
        scale = Scale.of(inputs)
        rows = ProcessRows(scale.scaled(inputs), examples.ratio, examples.weight)
        lengths = np.full(inputs.shape[1], START_LENGTH) if self.anisotropic else START_LENGTH
        kernel = rows.tuned(untuned_kernel(lengths, free=True))
        squares = []
        for part in parts(np.unique(examples.run)):
            mine = np.isin(examples.run, part)
            # if there is only one run, it is predicted by a fit to itself
            others = (rows if mine.all() else rows.only(~mine)).process(kernel)
            known = replace(self, scale=scale, process=others, inflation=1.0)
            squares.append(end_squares(known, [runs[k] for k in part], spec))
        inflation = float(np.concatenate(squares).mean())
        return replace(self, scale=scale, process=rows.process(kernel), inflation=inflation)

    def predict(self, runs: Sequence[RunSignals], spec: RobotSpec) -> list[PredictedRun]:
        if self.process is None or self.scale is None:
            raise ValueError(f"{self.name} was not fitted; expected a call of fit before predict")
        windows = SignalWindows.of(runs, spec)
        inputs = self.scale.scaled(slip_inputs(windows, spec))
        ratio, ratio_std = self.process.predict(inputs, return_std=True)
        predicted = with_slip(runs, windows, ratio, spec)
        std = at_steps(ratio_std * windows.size[:, None] / spec.size, windows, runs)
        return [
            replace(of_run, end_covariance=self.inflation * spread + CAMERA_STD**2 * np.eye(2))
            for of_run, run, of_step in zip(predicted, runs, std, strict=True)
            for spread in [end_spread(of_run.path, of_step, run.dt)]
        ]

    @property
    def numbers(self) -> int:
        return 0 if self.process is None else 1 + fitted_numbers(self.process)


def slip_inputs(windows: SignalWindows, spec: RobotSpec) -> Inputs:
    """Return the inputs of the process: |I| and |w| of each drive, and the direction of travel."""
    columns = [windows.amperes(), np.abs(windows.speed()), windows.direction(spec)]
    return np.concatenate(columns, axis=1)


def parts(numbers: Int[np.ndarray, " run"]) -> list[Int[np.ndarray, " _"]]:
    """Return the run indices split at random into `INFLATION_PARTS` parts, or one part per run."""
    drawn = np.random.default_rng(SEED).permutation(numbers)
    return list(np.array_split(drawn, min(INFLATION_PARTS, len(numbers))))


def end_spread(
    path: Float[np.ndarray, "edge 3"], std: Twists, dt: Float[np.ndarray, " step"]
) -> Float[np.ndarray, "2 2"]:
    """Return the covariance S S^T of the end position without inflation [m^2].

    The errors of each component are the same multiple of its `std` in all steps.
    """
    middle = 0.5 * (path[1:] + path[:-1])
    c, s = np.cos(middle[:, 2]), np.sin(middle[:, 2])
    ahead, left = np.stack([c, s]), np.stack([-s, c])
    rest = path[-1, :2] - middle[:, :2]
    turned = np.stack([-rest[:, 1], rest[:, 0]])
    each = std * dt[:, None]
    root = np.stack([ahead @ each[:, 0], left @ each[:, 1], turned @ each[:, 2]], axis=1)
    return np.asarray(root @ root.T)


def end_squares(
    fitted: QuannSlip, runs: Sequence[Run], spec: RobotSpec
) -> Float[np.ndarray, " run"]:
    """Return e^T C^-1 e / 2 for each run, with the end-point error e and its covariance C."""
    predicted = fitted.predict([run.signals for run in runs], spec)
    error = np.stack(
        [
            (of_run.path - path_of(run.twist, run.signals.dt))[-1, :2]
            for of_run, run in zip(predicted, runs, strict=True)
        ]
    )
    known = [one.end_covariance for one in predicted if one.end_covariance is not None]
    return (error * np.linalg.solve(np.stack(known), error[..., None])[..., 0]).sum(axis=1) / 2


MOST_WINDOWS = 1000
"""Largest number of windows in the posterior."""
MOST_TUNING_WINDOWS = 150
"""Largest number of windows to which hyperparameters are fitted."""
OPTIMISER_STEPS = 20
"""Largest number of optimiser steps in the fit of hyperparameters."""
LENGTH_BOUNDS = (0.1, 100.0)
"""Bounds of the length scales, in units of the inputs."""
VARIANCE_BOUNDS = (1e-2, 1e2)
"""Bounds of the variance of the process, relative to the variance of the outputs."""
NOISE_BOUNDS = (1e-4, 2.0)
"""Bounds of the variance of the noise, relative to the variance of the outputs."""


def untuned_kernel(lengths: float | Float[np.ndarray, " input"], free: bool) -> "Kernel":
    """Return the kernel with which a fit of the hyperparameters starts.

    Args:
        lengths: length scale of each input, or a single one for all inputs.
        free: True if the length scales are fitted.
    """
    from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel

    matern = Matern(lengths, LENGTH_BOUNDS if free else "fixed", nu=1.5)
    return ConstantKernel(1.0, VARIANCE_BOUNDS) * matern + WhiteKernel(0.1, NOISE_BOUNDS)


@dataclass(frozen=True, eq=False)
class ProcessRows:
    """Training data of a Gaussian process.

    Attributes:
        x: inputs.
        y: outputs.
        weight: weight of each row.
    """

    x: Float[np.ndarray, "row input"]
    y: Float[np.ndarray, "row output"]
    weight: Float[np.ndarray, " row"]

    def only(self, take: Bool[np.ndarray, " row"] | Int[np.ndarray, " some"]) -> "ProcessRows":
        """Return the rows that `take` selects: by True values, or by indices."""
        return ProcessRows(self.x[take], self.y[take], self.weight[take])

    def drawn(self, most: int) -> "ProcessRows":
        """Return at most `most` rows, drawn at random in proportion to their weight."""
        share, rng = self.weight / self.weight.sum(), np.random.default_rng(SEED)
        count = min(most, int(np.count_nonzero(share)))
        return self.only(rng.choice(len(share), count, replace=False, p=share))

    def tuned(self, kernel: "Kernel") -> "Kernel":
        """Return the kernel of largest marginal likelihood for a sample of the rows.

        The search starts from the given kernel.
        """
        from sklearn.exceptions import ConvergenceWarning

        with warnings.catch_warnings():
            # do not warn of a length scale at its upper bound: its input is merely irrelevant
            warnings.simplefilter("ignore", ConvergenceWarning)
            return self._fitted(kernel, MOST_TUNING_WINDOWS, _few_steps).kernel_

    def process(self, kernel: "Kernel") -> "GaussianProcessRegressor":
        """Return the posterior of the process given a sample of at most `MOST_WINDOWS` rows."""
        return self._fitted(kernel, MOST_WINDOWS, None)

    def _fitted(
        self, kernel: "Kernel", most: int, optimizer: Callable | None
    ) -> "GaussianProcessRegressor":
        from sklearn.gaussian_process import GaussianProcessRegressor

        some = self.drawn(most)
        process = GaussianProcessRegressor(kernel, optimizer=optimizer, normalize_y=True)
        with one_thread():
            return process.fit(some.x, some.y)


def fitted_numbers(process: "GaussianProcessRegressor") -> int:
    """Return the count of hyperparameters and of the entries of (K + noise I)^-1 y."""
    return process.kernel_.n_dims + process.alpha_.size


def _few_steps(
    loss: Callable, start: Float[np.ndarray, " log"], bounds: Float[np.ndarray, "log 2"]
) -> tuple[Float[np.ndarray, " log"], float]:
    """Return the minimiser and the loss after at most `OPTIMISER_STEPS` steps of L-BFGS-B.

    The function has the signature that scikit-learn expects of an optimiser. Its variables are
    logarithms of hyperparameters.
    """
    from scipy.optimize import minimize

    most = {"maxiter": OPTIMISER_STEPS}
    found = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds, options=most)
    return found.x, float(found.fun)
