"""Extended Kalman filter that tracks the states of many runs at once.

Every step propagates the state by the dynamics, corrects it by the gyro and the currents, and keeps
the coefficient of resistance within its bounds. Symbols and measurements are those in the docstring
of `ward_iagnemma.py`. The error of the pose is part of the state, which gives the covariance of the
end of every path.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from slipid.lab.systems.motion.ward_iagnemma_dynamics import Drives, Dynamics, Each, PaddedRuns
from slipid.predict.slip_model import WINDOW_S

Covariance = Float[np.ndarray, "run 8 8"]
Row = Float[np.ndarray, "run 8"]


@dataclass(frozen=True)
class FilterNoise:
    """Noise of the process and of the measurements, from the residuals of the force law.

    Attributes:
        rolling: standard deviation of rho between runs.
        drift: standard deviation of the displacement after one second, by process noise: forward,
            left, and turn times L [m].
        gyro: standard deviation of the gyro over a window [rad/s]; NaN if training runs had no
            gyro, which is then not used.
        bias: standard deviation of the gyro's bias between runs [rad/s].
        gain: scale k of forces from currents.
        offset: offset f of forces from currents [N].
        force: standard deviation of a force from a current over a window [N]; NaN if training runs
            had no currents.
    """

    rolling: float = 0.01
    drift: tuple[float, float, float] = (0.01, 0.01, 0.01)
    gyro: float = np.nan
    bias: float = 0.0
    gain: float = 1.0
    offset: float = 0.0
    force: float = np.nan


@dataclass(frozen=True, eq=False)
class FilterState:
    """Mean and covariance of the state: q (3), rho, the gyro's bias, and the pose error (3).

    The pose error is that of a path integrated from filtered twists, since the pose is not
    corrected. Its mean is 0 and not stored.
    """

    mean: Float[np.ndarray, "run 5"]
    covariance: Covariance

    def moved(self, mean: Float[np.ndarray, "run 5"], by: Covariance) -> "FilterState":
        """Return the state with a new mean, and the covariance propagated by the Jacobian `by`."""
        return FilterState(mean, by @ self.covariance @ by.transpose(0, 2, 1))

    def corrected(
        self, row: Row, innovation: Each, variance: Each, of: slice = slice(5)
    ) -> "FilterState":
        """Return the state corrected by a scalar measurement; a NaN innovation means there is none.

        The covariance is updated in Joseph's form, which holds for any gain K:
        P - K h P - P h' K' + K s K' with s = h P h' + variance.

        Args:
            row: derivatives h of the measurement with respect to the state.
            innovation: measured less expected value.
            variance: variance of the measurement noise.
            of: part of the state that is corrected; the gain of the rest is zero.
        """
        measured = np.isfinite(innovation + variance)
        if not measured.any():
            return self
        shared = (self.covariance @ row[..., None])[..., 0]
        size = ((shared * row).sum(axis=1) + np.where(measured, variance, 1.0))[:, None]
        gain = shared / size * measured[:, None]
        gain[:, : of.start or 0] = 0.0
        gain[:, of.stop :] = 0.0
        less = gain[:, :, None] * (shared - 0.5 * size * gain)[:, None, :]
        mean = self.mean + gain[:, :5] * np.where(measured, innovation, 0.0)[:, None]
        return FilterState(mean, self.covariance - less - less.transpose(0, 2, 1))


@dataclass(frozen=True, eq=False)
class SlipFilter:
    """The extended Kalman filter, with its fitted model.

    Attributes:
        dynamics: fitted dynamics.
        noise: fitted noise.
        mass: mass of the robot [kg].
        uses_current: True if forces from currents are used as measurements.
        wander: standard deviation of the random walk of rho after one second [1].
    """

    dynamics: Dynamics
    noise: FilterNoise
    mass: float
    uses_current: bool
    wander: float

    def track(
        self, runs: PaddedRuns
    ) -> tuple[Float[np.ndarray, "run step 3"], Float[np.ndarray, "run 3 3"]]:
        """Return filtered speeds q of all runs, and covariances of the poses at their ends.

        Speeds are in m/s, covariances in products of [m, m, rad].
        """
        count, steps = runs.dt.shape
        rolling = np.full((count, 1), self.dynamics.law.rolling)
        mean = np.concatenate([runs.rolling[:, 0], rolling, np.zeros((count, 1))], axis=1)
        variances = [0.0, 0.0, 0.0, self.noise.rolling**2, self.noise.bias**2, 0.0, 0.0, 0.0]
        state = FilterState(mean, np.tile(np.diag(variances), (count, 1, 1)))
        heading, speeds = np.zeros(count), np.zeros((count, steps, 3))
        for k in range(steps):
            dt = runs.dt[:, k]
            predicted = self._predicted(state, runs.rim[:, k], dt)
            state = self._bounded(self._measured(predicted, runs, k))
            speeds[:, k] = state.mean[:, :3]
            turn = state.mean[:, 2] / self.dynamics.base_radius * dt
            state = self._with_pose_error(state, heading + 0.5 * turn, dt)
            heading = heading + turn
        return speeds, state.covariance[:, 5:, 5:]

    def _predicted(self, state: FilterState, rim: Drives, dt: Each) -> FilterState:
        """Return the state predicted by a step of the dynamics, with process noise."""
        step = self.dynamics.step(state.mean[:, :3], state.mean[:, 3], rim, dt)
        by = np.tile(np.eye(8), (len(dt), 1, 1))
        by[:, :3, :3], by[:, :3, 3] = step.by_speeds, step.by_rolling
        after = state.moved(np.concatenate([step.speeds, state.mean[:, 3:]], axis=1), by)
        # add noise to the twist, white over steps, whose integral over a second has the std `drift`
        rate = np.where(dt > 0.0, 1.0 / np.where(dt > 0.0, dt, 1.0), 0.0)[:, None]
        after.covariance[:, range(3), range(3)] += np.square(self.noise.drift) * rate
        after.covariance[:, 3, 3] += self.wander**2 * dt
        return after

    def _measured(self, state: FilterState, runs: PaddedRuns, k: int) -> FilterState:
        """Return the state corrected by the gyro and the currents of step `k`."""
        longer = WINDOW_S / np.where(runs.dt[:, k] > 0.0, runs.dt[:, k], WINDOW_S)
        radius = self.dynamics.base_radius
        row = np.zeros((len(longer), 8))
        row[:, 2], row[:, 4] = 1.0 / radius, 1.0
        expected = state.mean[:, 2] / radius + state.mean[:, 4]
        state = state.corrected(row, runs.gyro[:, k] - expected, self.noise.gyro**2 * longer)
        if not self.uses_current:
            return state
        for drive, rims in enumerate(self.dynamics.rims):
            rim, force = runs.rim[:, k, drive], runs.force[:, k, drive]
            slide = rim[:, None] - state.mean[:, :3] @ rims[:, None]
            scale = self.noise.gain * self.mass * np.sign(rim)
            expected = self.noise.offset + scale * self.dynamics.traction(slide)[:, 0]
            row = np.zeros((len(longer), 8))
            row[:, :3] = -scale[:, None] * self.dynamics.stiffness(slide) * rims
            state = state.corrected(
                row, force - expected, self.noise.force**2 * longer, slice(3, 4)
            )
        return state

    def _bounded(self, state: FilterState) -> FilterState:
        """Return the state corrected by the weak constraint on rho, where rho is out of range."""
        law, straight = self.dynamics.law, 1.0 - self.dynamics.turning
        speed = np.linalg.norm(state.mean[:, :3] * straight, axis=1)
        rolling = state.mean[:, 3]
        beyond = np.clip(rolling, 0.0, law.grip / (1.0 + law.drag * speed)) - rolling
        row = np.zeros((len(rolling), 8))
        row[:, 3] = 1.0
        variance = np.full(len(rolling), (0.1 * self.noise.rolling) ** 2)
        return state.corrected(row, np.where(beyond == 0.0, np.nan, beyond), variance)

    def _with_pose_error(self, state: FilterState, heading: Each, dt: Each) -> FilterState:
        """Return the state with the pose error propagated over a step.

        `heading` is the heading in the middle of the step [rad].
        """
        radius = self.dynamics.base_radius
        turning = np.stack([np.cos(heading), np.sin(heading)], axis=1)
        aside = turning[:, ::-1] * [-1.0, 1.0]
        x, y, yaw = state.mean[:, 0:1], state.mean[:, 1:2], state.mean[:, 2:3] / radius
        along, across = x * turning + y * aside, x * aside - y * turning
        # `reach`: chord of the step's arc over the speed, as in `path_of`; `less`: minus its
        # derivative with respect to the yaw rate, to first order
        wait = dt[:, None]
        reach, less = np.sinc(yaw * wait / (2 * np.pi)) * wait, yaw * wait**3 / 12
        by = np.tile(np.eye(8), (len(dt), 1, 1))
        by[:, 5:7, 0], by[:, 5:7, 1] = turning * reach, aside * reach
        by[:, 5:7, 2] = (0.5 * wait * reach * across - less * along) / radius
        by[:, 7, 2] = dt / radius
        by[:, 5:7, 7] = across * reach
        return state.moved(state.mean, by)
