"""Dynamics of a robot on a floor with a law of traction and resistance, and padded runs.

Symbols and equations are those in the docstring of `ward_iagnemma.py`. Speeds are components of q,
and forces are divided by the robot's mass. A step solves the equation of motion for many runs at
once and also returns derivatives of the speeds after it.

Runs of different lengths are padded to one array with the inputs of the filter, which tracks all of
them at once: rim speeds, the gyro, and the forces from motor currents.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from slipid.lab.systems.padded import padded
from slipid.model.robot import GRAVITY
from slipid.predict.slip_model import RobotSpec, RunSignals

Drives = Float[np.ndarray, "run drive"]
Speeds = Float[np.ndarray, "run 3"]
"""Speeds q of each run: the body twist times (1, 1, base radius) [m/s]."""
Each = Float[np.ndarray, " run"]
V_S = 0.02
"""Speed v_s below which resistance fades out [m/s]."""
_OVER_MASS = np.array([1.0, 1.0, 2.0])
"""Diagonal of m M^-1: acceleration of q per force divided by mass; the inertia is m L^2 / 2."""
_MOST_STEPS = 25
"""Largest number of Newton steps in a time step."""
_SOLVED = 1e-7
"""Residual below which an equation of a time step counts as solved [m/s]."""


@dataclass(frozen=True)
class ForceLaw:
    """Coefficients of the forces between wheels and floor, relative to the robot's weight.

    Attributes:
        grip: C1, traction coefficient of a wheel that slides fast [1].
        rise: A, rate at which traction approaches C1 with the sliding speed [s/m].
        viscous: C2, increase of traction per sliding speed [s/m].
        rolling: rho, coefficient of resistance to travel [1].
        turning: rho_t, coefficient of resistance to turning [1].
        drag: c, increase of the resistance to travel with speed [s/m].
    """

    grip: float = 0.6
    rise: float = 20.0
    viscous: float = 0.1
    rolling: float = 0.05
    turning: float = 0.05
    drag: float = 0.0


@dataclass(frozen=True, eq=False)
class Acceleration:
    """Accelerations of q and their derivatives.

    Attributes:
        rate: accelerations [m/s^2].
        slope: derivatives with respect to q [1/s].
        by_rolling: derivatives with respect to rho [m/s^2].
    """

    rate: Speeds
    slope: Float[np.ndarray, "run 3 3"]
    by_rolling: Speeds


@dataclass(frozen=True, eq=False)
class DynamicsStep:
    """Speeds after a step of the dynamics and their derivatives.

    Attributes:
        speeds: q after the step [m/s].
        by_speeds: derivatives with respect to q before the step [1].
        by_rolling: derivatives with respect to rho [m/s].
    """

    speeds: Speeds
    by_speeds: Float[np.ndarray, "run 3 3"]
    by_rolling: Speeds


@dataclass(frozen=True, eq=False)
class Dynamics:
    """Equation of motion of a robot on a floor.

    Attributes:
        law: force law of the floor.
        rims: matrix that maps q to the rim speeds of the drives; its rows are J_i.
        turning: 1 for components of q that belong to q_t (turning), 0 for those of p (travel).
        base_radius: L [m].
    """

    law: ForceLaw
    rims: Float[np.ndarray, "drive 3"]
    turning: Float[np.ndarray, "3"]
    base_radius: float

    @classmethod
    def of(cls, spec: RobotSpec, law: ForceLaw) -> "Dynamics":
        """Return the dynamics of a robot with a force law."""
        turning = np.array([0.0, 0.0 if spec.determines_twist else 1.0, 1.0])
        rims = np.asarray(spec.forward / spec.size, dtype=float)
        return cls(law, rims, turning, float(spec.base_radius))

    def traction(self, slide: Drives) -> Drives:
        """Return each drive's traction divided by the mass [m/s^2] at sliding speeds [m/s]."""
        law, load = self.law, GRAVITY / len(self.rims)
        rising = -np.expm1(-law.rise * np.abs(slide))
        return np.asarray(load * (law.grip * np.sign(slide) * rising + law.viscous * slide))

    def stiffness(self, slide: Drives) -> Drives:
        """Return the derivative of `traction` with respect to the sliding speeds [1/s]."""
        law, load = self.law, GRAVITY / len(self.rims)
        rising = law.rise * np.exp(-law.rise * np.abs(slide))
        return np.asarray(load * (law.grip * rising + law.viscous))

    def acceleration(
        self, q: Speeds, rolling: Each, rim: Drives, secant: bool = False
    ) -> Acceleration:
        """Return accelerations at speeds q.

        With `secant`, the slope of each force is that of its chord through zero, instead of that of
        its tangent.
        """
        law, slide = self.law, rim - q @ self.rims.T
        traction, stiff = self.traction(slide), self.stiffness(slide)
        if secant:
            zero = np.abs(slide) < 1e-9
            stiff = np.where(zero, stiff, traction / np.where(zero, 1.0, slide))
        straight = 1.0 - self.turning
        coupled = np.outer(self.turning, self.turning) + np.outer(straight, straight)
        size = np.sqrt(q**2 @ coupled + V_S**2)
        along = q / size
        share = GRAVITY * (rolling[:, None] * straight + law.turning * self.turning)
        linear = share * (1.0 / size + law.drag * straight)
        squares = (self.rims[:, :, None] * self.rims[:, None, :]).reshape(-1, 9)
        slope = -(stiff @ squares).reshape(-1, 3, 3)
        if not secant:
            slope += (share / size * along)[:, :, None] * along[:, None, :] * coupled
        slope[:, range(3), range(3)] -= linear
        rate = (traction @ self.rims - linear * q) * _OVER_MASS
        slope *= _OVER_MASS[:, None]
        # add the term W (vy, -vx), since the axes of q turn with the body
        yaw = q[:, 2] / self.base_radius
        rate[:, 0] += yaw * q[:, 1]
        rate[:, 1] -= yaw * q[:, 0]
        slope[:, 0, 1] += yaw
        slope[:, 1, 0] -= yaw
        if not secant:
            slope[:, 0, 2] += q[:, 1] / self.base_radius
            slope[:, 1, 2] -= q[:, 0] / self.base_radius
        return Acceleration(rate, slope, -GRAVITY * straight * (along + law.drag * q))

    def step(self, speeds: Speeds, rolling: Each, rim: Drives, dt: Each) -> DynamicsStep:
        """Return the speeds q' after a time step, q' = q + dt a(q') (backward Euler).

        The equation is solved by Newton's method for each run.
        """
        solution, todo = speeds.copy(), np.arange(len(speeds))
        for _ in range(_MOST_STEPS):
            args = speeds[todo], rolling[todo], rim[todo], dt[todo]
            solution[todo], done = self._newton(solution[todo], *args)
            todo = todo[~done]
            if len(todo) == 0:
                break
        at, wait = self.acceleration(solution, rolling, rim), dt[:, None]
        inverse = np.linalg.inv(np.eye(3) - wait[..., None] * at.slope)
        by_rolling = (inverse @ (wait * at.by_rolling)[..., None])[..., 0]
        return DynamicsStep(solution, inverse, by_rolling)

    def _newton(
        self, q: Speeds, start: Speeds, rolling: Each, rim: Drives, dt: Each
    ) -> tuple[Speeds, Bool[np.ndarray, " run"]]:
        """Return speeds after one Newton step from q, and True for runs that are solved then.

        Traction and resistance saturate, so that the step may overshoot. If the residual does not
        fall, a step with secants in place of tangents is used. Apart from the term of the turning
        axes, the forces have a potential that is concave in squares of speeds, and a secant step
        always descends on it.
        """
        here, wait = self.acceleration(q, rolling, rim), dt[:, None]
        residual = q - start - wait * here.rate
        trial = q - solved(wait, here.slope, residual)
        residual_after = trial - start - wait * self.acceleration(trial, rolling, rim).rate
        before, after = ((x**2 / _OVER_MASS).sum(axis=1) for x in (residual, residual_after))
        done = after < _SOLVED**2
        worse = ~done & ~(after < before)
        if worse.any():
            secants = self.acceleration(q, rolling, rim, secant=True).slope
            trial = np.where(worse[:, None], q - solved(wait, secants, residual), trial)
        return trial, done


def solved(
    wait: Float[np.ndarray, "run 1"], slope: Float[np.ndarray, "run 3 3"], right: Speeds
) -> Speeds:
    """Return the solution x of (I - dt slope) x = right."""
    return np.linalg.solve(np.eye(3) - wait[..., None] * slope, right[..., None])[..., 0]


_DRIVING = 0.3
"""Smallest rim speed, relative to the fastest wheel's, at which a wheel counts as driving."""


@dataclass(frozen=True, eq=False)
class PaddedRuns:
    """Several runs in one array, padded to the same number of steps with steps of zero duration.

    Attributes:
        dt: duration of each step [s], 0 in padding.
        rim: rim speed of each drive [m/s].
        rolling: q without slip [m/s].
        gyro: yaw rate [rad/s], NaN without a gyro.
        force: force of each motor at the rim from its current [N], NaN where it is unknown.
    """

    dt: Float[np.ndarray, "run step"]
    rim: Float[np.ndarray, "run step drive"]
    rolling: Float[np.ndarray, "run step 3"]
    gyro: Float[np.ndarray, "run step"]
    force: Float[np.ndarray, "run step drive"]

    @classmethod
    def of(cls, runs: Sequence[RunSignals], spec: RobotSpec) -> "PaddedRuns":
        """Return runs of any lengths, padded to the longest."""
        shape, nan = (len(runs), max(map(len, runs))), np.nan
        columns = zip(*(measurements(run, spec) for run in runs), strict=True)
        fills = 0.0, 0.0, 0.0, nan, nan
        return cls(*(padded(x, shape, fill) for x, fill in zip(columns, fills, strict=True)))


def measurements(run: RunSignals, spec: RobotSpec) -> tuple[np.ndarray, ...]:
    """Return the fields of `PaddedRuns` for one run, without padding, in the same order."""
    gyro = np.full(len(run), np.nan) if run.gyro is None else run.gyro
    rim, rolling = run.speed * spec.wheel_radius, run.rolling(spec) * spec.size
    return run.dt, rim, rolling, gyro, motor_forces(run, spec)


def motor_forces(run: RunSignals, spec: RobotSpec) -> Float[np.ndarray, "step drive"]:
    """Return the motor force along each drive's motion from its current [N].

    The force is the gear ratio times C_e I / r. It is NaN for wheels that do not drive, and for all
    wheels if there are no currents.
    """
    rim = np.abs(run.speed * spec.wheel_radius)
    if run.current is None:
        return np.full(rim.shape, np.nan)
    drives = (rim >= _DRIVING * rim.max(axis=1, keepdims=True)) & (rim > V_S)
    scale = spec.gear_ratio * spec.back_emf / spec.wheel_radius
    return np.where(drives, scale * run.along(spec), np.nan)
