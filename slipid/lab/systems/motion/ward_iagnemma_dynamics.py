"""Dynamics of a robot on a floor with a law of traction and resistance, and padded runs.

Speeds are those of q, and forces are divided by the robot's mass. A step solves the equation of
motion, whose symbols and formulas are at the top of `ward_iagnemma.py`, for many runs at once, and
returns the derivatives of the speeds after it.

Runs of any lengths are padded to one array with the inputs of the filter, which tracks all of them
at once: speeds of the wheels, the gyro, and the forces by the motors' currents.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from slipid.predict.slip_model import RobotSpec, RunSignals

Drives = Float[np.ndarray, "run drive"]
Speeds = Float[np.ndarray, "run 3"]
"""q: body twist times (1, 1, base radius) [m/s]."""
Each = Float[np.ndarray, " run"]
GRAVITY = 9.81
REST = 0.02
"""v_s: speed below which resistance fades out [m/s]."""
_OVER_MASS = np.array([1.0, 1.0, 2.0])
"""m / M: acceleration of q by a force over the mass; the inertia is m L^2 / 2."""
_MOST_STEPS = 25
"""Largest number of Newton steps."""
_SOLVED = 1e-7
"""Largest residual of a solved equation [m/s]."""


@dataclass(frozen=True)
class ForceLaw:
    """Forces between wheels and floor, as shares of the weight.

    Attributes:
        grip: C1.
        rise: A [s/m].
        viscous: C2 [s/m].
        rolling: rho.
        turning: rho_t.
        drag: c [s/m].
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
        slope: derivatives by the speeds [1/s].
        by_rolling: derivatives by rho [m/s^2].
    """

    rate: Speeds
    slope: Float[np.ndarray, "run 3 3"]
    by_rolling: Speeds


@dataclass(frozen=True, eq=False)
class DynamicsStep:
    """Speeds after a step of the dynamics and their derivatives.

    Attributes:
        speeds: q after the step [m/s].
        by_speeds: derivatives by the speeds before the step.
        by_rolling: derivatives by rho [m/s].
    """

    speeds: Speeds
    by_speeds: Float[np.ndarray, "run 3 3"]
    by_rolling: Speeds


@dataclass(frozen=True, eq=False)
class Dynamics:
    """A robot on a floor.

    Attributes:
        law: force law of the floor.
        rims: rim speed of each drive per q.
        turning: 1 for the speeds that count as turning, 0 for those along which the robot rolls.
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
        """Return traction of each drive over the robot's mass [m/s^2] at sliding speeds [m/s]."""
        law, load = self.law, GRAVITY / len(self.rims)
        rising = -np.expm1(-law.rise * np.abs(slide))
        return np.asarray(load * (law.grip * np.sign(slide) * rising + law.viscous * slide))

    def stiffness(self, slide: Drives) -> Drives:
        """Return the derivative of `traction` [1/s]."""
        law, load = self.law, GRAVITY / len(self.rims)
        rising = law.rise * np.exp(-law.rise * np.abs(slide))
        return np.asarray(load * (law.grip * rising + law.viscous))

    def acceleration(
        self, q: Speeds, rolling: Each, rim: Drives, secant: bool = False
    ) -> Acceleration:
        """Return accelerations at speeds q; `secant` slopes are chords to points without force."""
        law, slide = self.law, rim - q @ self.rims.T
        traction, stiff = self.traction(slide), self.stiffness(slide)
        if secant:
            zero = np.abs(slide) < 1e-9
            stiff = np.where(zero, stiff, traction / np.where(zero, 1.0, slide))
        straight = 1.0 - self.turning
        coupled = np.outer(self.turning, self.turning) + np.outer(straight, straight)
        size = np.sqrt(q**2 @ coupled + REST**2)
        along, share = (
            q / size,
            GRAVITY * (rolling[:, None] * straight + law.turning * self.turning),
        )
        linear = share * (1.0 / size + law.drag * straight)
        squares = (self.rims[:, :, None] * self.rims[:, None, :]).reshape(-1, 9)
        slope = -(stiff @ squares).reshape(-1, 3, 3)
        if not secant:
            slope += (share / size * along)[:, :, None] * along[:, None, :] * coupled
        slope[:, range(3), range(3)] -= linear
        rate = (traction @ self.rims - linear * q) * _OVER_MASS
        slope *= _OVER_MASS[:, None]
        # the axes turn with the body: W (vy, -vx)
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
        """Return q' of backward Euler, q' = q + dt a(q'), by Newton's method for each run."""
        solution, todo = speeds.copy(), np.arange(len(speeds))
        for _ in range(_MOST_STEPS):
            args = speeds[todo], rolling[todo], rim[todo], dt[todo]
            solution[todo], done = self._newton(solution[todo], *args)
            todo = todo[~done]
            if len(todo) == 0:
                break
        at, wait = self.acceleration(solution, rolling, rim), dt[:, None]
        inverse = np.linalg.inv(np.eye(3) - wait[..., None] * at.slope)
        return DynamicsStep(
            solution, inverse, (inverse @ (wait * at.by_rolling)[..., None])[..., 0]
        )

    def _newton(
        self, q: Speeds, start: Speeds, rolling: Each, rim: Drives, dt: Each
    ) -> tuple[Speeds, Bool[np.ndarray, " run"]]:
        """Return speeds after one step of Newton's method from q, and the runs that are solved.

        Traction and resistance flatten out, so that the step may overshoot. Where the residual does
        not fall, the secants' step is used instead: apart from the turning axes, the forces have a
        potential that is concave in squares of speeds, on which the secants' step descends.
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
"""Smallest rim speed of a driving wheel, relative to the fastest wheel."""


@dataclass(frozen=True, eq=False)
class PaddedRuns:
    """Runs side by side, padded to the same number of steps with steps of zero duration.

    Attributes:
        dt: duration of each step [s], 0 in padding.
        rim: rim speed of each drive [m/s].
        rolling: q without slip [m/s].
        gyro: yaw rate [rad/s], NaN without a gyro.
        force: force of each motor at the rim by its current [N], NaN where it is unknown.
    """

    dt: Float[np.ndarray, "run step"]
    rim: Float[np.ndarray, "run step drive"]
    rolling: Float[np.ndarray, "run step 3"]
    gyro: Float[np.ndarray, "run step"]
    force: Float[np.ndarray, "run step drive"]

    @classmethod
    def of(cls, runs: Sequence[RunSignals], spec: RobotSpec) -> "PaddedRuns":
        """Return padded runs of any lengths."""
        shape, drives = (len(runs), max(len(run) for run in runs)), len(spec.forward)
        padded = cls(
            dt=np.zeros(shape),
            rim=np.zeros((*shape, drives)),
            rolling=np.zeros((*shape, 3)),
            gyro=np.full(shape, np.nan),
            force=np.full((*shape, drives), np.nan),
        )
        for k, run in enumerate(runs):
            steps = slice(len(run))
            padded.dt[k, steps] = run.dt
            padded.rim[k, steps] = run.speed * spec.wheel_radius
            padded.rolling[k, steps] = run.rolling(spec) * spec.size
            padded.gyro[k, steps] = np.nan if run.gyro is None else run.gyro
            padded.force[k, steps] = motor_forces(run, spec)
        return padded


def motor_forces(run: RunSignals, spec: RobotSpec) -> Float[np.ndarray, "step drive"]:
    """Return the force n C_e I / r along each drive's motion [N]; NaN if it does not drive."""
    rim = np.abs(run.speed * spec.wheel_radius)
    if run.current is None:
        return np.full(rim.shape, np.nan)
    drives = (rim >= _DRIVING * rim.max(axis=1, keepdims=True)) & (rim > REST)
    scale = spec.gear_ratio * spec.back_emf / spec.wheel_radius
    return np.where(drives, scale * run.along(spec), np.nan)
