"""An extended Kalman filter on a robot's dynamics, with a law of traction for its wheels.

The state is the body's twist v, the coefficient rho of the resistive force and the gyro's bias b;
wheel speeds are inputs. With q = (vx, vy, L W), J_i the rim speed of drive i per q, N = m g / n the
load of each of n drives, M = diag(m, m, m/2), p = (vx, vy) and q_t = L W:

    u_i    = r w_i - J_i q                                              sliding speed
    T_i    = N (C1 sgn(u_i) (1 - exp(-A |u_i|)) + C2 u_i)               traction
    F      = - m g rho (1 / sqrt(|p|^2 + v_s^2) + c) p                  resistive force on travel
             - m g rho_t q_t / sqrt(|q_t|^2 + v_s^2)                    and on turning
    M dq/dt = sum_i J_i^T T_i + F + m W (vy, -vx, 0)

Where wheels do not determine the twist (skid steer) they grip sideways, and slide sideways as soon
as the robot turns: then p = vx and q_t = (vy, L W). A step is one of backward Euler, solved by
Newton's method with the analytic Jacobian. Measurements: gyro = W + b; and in
`ward_iagnemma_current` of every wheel that drives n C_e I_i / r = k sgn(w_i) T_i + f. Weak
constraint: where rho is below 0, so that the force would push, or above C1 / (1 + c |p|), so that
no traction could overcome it, a measurement with a tenth of rho's spread pulls it to that bound.

A robot is called immobilised where |v| < 0.2 of what its wheels say, for 0.4 s; the score of
slipping is 1 - |v| / |v by the wheels|, turning weighted by the base radius.

Fitted on at most 40 runs: A, rho, rho_t and c, by least squares of twists of half a second, each
as if it had always driven like that; then, from what is left, how rho scatters between runs, the
process noise (white noise of the twist that explains where training runs end), noise and bias of
the gyro, and k, f and noise of the currents. Tuned: whether resistance grows with speed (c), and
whether rho wanders within a run, by half its scatter between runs in a second.

Liberties:
- The original measures acceleration and, where there is one, GPS; neither is logged here. It has
  one axis of travel and pitch; here the body moves in a plane, and the ground is level.
- The state is the coefficient of the resistive force, not the force. The force fades out within
  v_s = 2 cm/s of rest, and may grow with speed (c); turning has a coefficient of its own.
- The original takes parameters from experiments and shows that their values matter little; here
  they are fitted. At steady speed motion tells forces only in ratio to C1, so C1 = 0.6 throughout;
  C2 = 0.1 s/m, which windows cannot tell from the end of the exponential. A weak prior holds the
  others where motion does not tell them.
- Every drive carries the same load, traction acts along the drive direction only (rollers are
  free), and the inertia is m L^2 / 2.
- Forces by currents are scaled and offset by least squares (k, f): gear losses are not known, and
  often not even the motor. What they err is mostly the same all along a run, so their noise is
  that of the mean of a run. They correct rho, and through it the twist, but not the twist itself:
  what a twist scatters by is mostly no sliding, and the steep law would take it for that. Of
  unsigned ammeters all driving wheels are taken to push; wheels below 0.3 of the fastest rim speed
  are not heard.
- A run starts as if nothing had slipped.
- The score is the ratio itself, without waiting for 0.4 s.
- The pose is not corrected by later measurements: the path is that of the filtered twists, and
  its covariance is of that (a Kalman filter whose gain for the pose is zero).

Source: Ward & Iagnemma 2008, "A dynamic-model-based wheel slip detector for mobile robots on
outdoor terrain", IEEE Transactions on Robotics 24(4).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import final

import numpy as np
from jaxtyping import Bool, Float, Int

from slipid.baselines.interface import (
    WINDOW_S,
    Heard,
    Machine,
    Method,
    Run,
    Said,
    path_of,
)

Drives = Float[np.ndarray, "run drive"]
Speeds = Float[np.ndarray, "run 3"]
"""q: body twist times (1, 1, base radius) [m/s]."""
Each = Float[np.ndarray, " run"]
Spread = Float[np.ndarray, "run 8 8"]
Row = Float[np.ndarray, "run 8"]
GRAVITY = 9.81
REST = 0.02
"""v_s: speed within which resistance fades out [m/s]."""
_DRIVING = 0.3
"""Share of the fastest rim speed from which on a wheel counts as driving."""
_OVER_MASS = np.array([1.0, 1.0, 2.0])
"""m / M: what a force over the mass accelerates; the inertia is m L^2 / 2."""
_STEADY = 10.0
"""Time after which speeds are taken for steady [s]."""
_MOST_STEPS = 25
"""Newton steps after which an equation that is still not solved is left as it is."""
_SOLVED = 1e-7
"""Residual at which an equation counts as solved [m/s]."""
_FIT_RUNS, _FIT_WINDOWS = 40, 300
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


@dataclass(frozen=True)
class Law:
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


@dataclass(frozen=True)
class Noise:
    """What the law leaves.

    Attributes:
        rolling: standard deviation of rho between runs.
        drift: standard deviation of place and turn after a second [m], (ahead, left, turn times L).
        gyro, bias: standard deviation of the gyro over a window, and between runs [rad/s]; the
            former is nan where training had no gyro, and then none is heard.
        gain, offset: k, and f [N].
        force: standard deviation of the force by a current over a window [N]; nan like that.
    """

    rolling: float = 0.01
    drift: tuple[float, float, float] = (0.01, 0.01, 0.01)
    gyro: float = np.nan
    bias: float = 0.0
    gain: float = 1.0
    offset: float = 0.0
    force: float = np.nan


@dataclass(frozen=True, eq=False)
class Push:
    """Accelerations [m/s^2], and their derivatives by the speeds [1/s] and by rho [m/s^2]."""

    rate: Speeds
    slope: Float[np.ndarray, "run 3 3"]
    by_rolling: Speeds


@dataclass(frozen=True, eq=False)
class Step:
    """Speeds after a step of the dynamics, and their derivatives by those before and by rho."""

    speeds: Speeds
    by_speeds: Float[np.ndarray, "run 3 3"]
    by_rolling: Speeds


@dataclass(frozen=True, eq=False)
class Nearer:
    """Speeds nearer to the solution of a step, and whether they solve it."""

    speeds: Speeds
    done: Bool[np.ndarray, " run"]


@dataclass(frozen=True, eq=False)
class Dynamics:
    """A robot on a floor.

    Attributes:
        law: of the floor.
        rims: rim speed of each drive per q.
        turning: 1 for the speeds that count as turning, 0 for those along which the robot rolls.
        base_radius: L [m].
    """

    law: Law
    rims: Float[np.ndarray, "drive 3"]
    turning: Float[np.ndarray, "3"]
    base_radius: float

    @classmethod
    def of(cls, machine: Machine, law: Law) -> "Dynamics":
        """Of a robot."""
        turning = np.array([0.0, 0.0 if machine.determines_twist else 1.0, 1.0])
        rims = np.asarray(machine.forward / machine.size, dtype=float)
        return cls(law, rims, turning, float(machine.base_radius))

    def traction(self, slide: Drives) -> Drives:
        """Traction of each drive over the robot's mass [m/s^2], by sliding speeds [m/s]."""
        law, load = self.law, GRAVITY / len(self.rims)
        rising = -np.expm1(-law.rise * np.abs(slide))
        return np.asarray(load * (law.grip * np.sign(slide) * rising + law.viscous * slide))

    def stiffness(self, slide: Drives) -> Drives:
        """Derivative of `traction` [1/s]."""
        law, load = self.law, GRAVITY / len(self.rims)
        rising = law.rise * np.exp(-law.rise * np.abs(slide))
        return np.asarray(load * (law.grip * rising + law.viscous))

    def push(self, q: Speeds, rolling: Each, rim: Drives, secant: bool = False) -> Push:
        """Accelerations at speeds q; with `secant`, slopes of the chords to where no force acts."""
        law, slide = self.law, rim - q @ self.rims.T
        traction, stiff = self.traction(slide), self.stiffness(slide)
        if secant:
            still = np.abs(slide) < 1e-9
            stiff = np.where(still, stiff, traction / np.where(still, 1.0, slide))
        straight = 1.0 - self.turning
        alike = np.outer(self.turning, self.turning) + np.outer(straight, straight)
        size = np.sqrt(q**2 @ alike + REST**2)
        along, share = (
            q / size,
            GRAVITY * (rolling[:, None] * straight + law.turning * self.turning),
        )
        linear = share * (1.0 / size + law.drag * straight)
        squares = (self.rims[:, :, None] * self.rims[:, None, :]).reshape(-1, 9)
        slope = -(stiff @ squares).reshape(-1, 3, 3)
        if not secant:
            slope += (share / size * along)[:, :, None] * along[:, None, :] * alike
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
        return Push(rate, slope, -GRAVITY * straight * (along + law.drag * q))

    def step(self, speeds: Speeds, rolling: Each, rim: Drives, dt: Each) -> Step:
        """Backward Euler: q' = q + dt a(q'), by Newton's method, run by run until it is solved."""
        solution, todo = speeds.copy(), np.arange(len(speeds))
        for _ in range(_MOST_STEPS):
            nearer = self._nearer(solution[todo], speeds[todo], rolling[todo], rim[todo], dt[todo])
            solution[todo], todo = nearer.speeds, todo[~nearer.done]
            if len(todo) == 0:
                break
        at, wait = self.push(solution, rolling, rim), dt[:, None]
        inverse = np.linalg.inv(np.eye(3) - wait[..., None] * at.slope)
        return Step(solution, inverse, (inverse @ (wait * at.by_rolling)[..., None])[..., 0])

    def _nearer(self, q: Speeds, start: Speeds, rolling: Each, rim: Drives, dt: Each) -> "Nearer":
        """One step of Newton's method from q.

        Traction and resistance flatten out, so that the step may overshoot. Where it does not come
        nearer, that of the secants is taken instead: but for the turning axes, the forces have a
        potential that is concave in squares of speeds, on which the secants' step descends.
        """
        here, wait = self.push(q, rolling, rim), dt[:, None]
        left = q - start - wait * here.rate
        trial = q - solved(wait, here.slope, left)
        left_there = trial - start - wait * self.push(trial, rolling, rim).rate
        before, after = ((x**2 / _OVER_MASS).sum(axis=1) for x in (left, left_there))
        done = after < _SOLVED**2
        worse = ~done & ~(after < before)
        if worse.any():
            secants = self.push(q, rolling, rim, secant=True).slope
            trial = np.where(worse[:, None], q - solved(wait, secants, left), trial)
        return Nearer(trial, done)


def solved(
    wait: Float[np.ndarray, "run 1"], slope: Float[np.ndarray, "run 3 3"], right: Speeds
) -> Speeds:
    """What I - dt slope makes the right-hand side."""
    return np.linalg.solve(np.eye(3) - wait[..., None] * slope, right[..., None])[..., 0]


@dataclass(frozen=True, eq=False)
class Padded:
    """Runs side by side, padded to the same number of steps with steps of no time.

    Attributes:
        dt: [s], 0 in padding.
        rim: rim speed of each drive [m/s].
        rolling: q if nothing slipped [m/s].
        gyro: [rad/s], nan where there is none.
        pull: force of each motor at the rim by its current [N], nan where it tells nothing.
    """

    dt: Float[np.ndarray, "run step"]
    rim: Float[np.ndarray, "run step drive"]
    rolling: Float[np.ndarray, "run step 3"]
    gyro: Float[np.ndarray, "run step"]
    pull: Float[np.ndarray, "run step drive"]

    @classmethod
    def of(cls, runs: Sequence[Heard], machine: Machine) -> "Padded":
        """Of runs of any lengths."""
        shape, drives = (len(runs), max(len(run) for run in runs)), len(machine.forward)
        padded = cls(
            dt=np.zeros(shape),
            rim=np.zeros((*shape, drives)),
            rolling=np.zeros((*shape, 3)),
            gyro=np.full(shape, np.nan),
            pull=np.full((*shape, drives), np.nan),
        )
        for k, run in enumerate(runs):
            steps = slice(len(run))
            padded.dt[k, steps] = run.dt
            padded.rim[k, steps] = run.speed * machine.wheel_radius
            padded.rolling[k, steps] = run.rolling(machine) * machine.size
            padded.gyro[k, steps] = np.nan if run.gyro is None else run.gyro
            padded.pull[k, steps] = pulls(run, machine)
        return padded


@dataclass(frozen=True, eq=False)
class State:
    """Mean and covariance of q (3), rho, the gyro's bias, and the error of the pose (3).

    The pose rides along without being corrected: its error is that of a path of filtered twists.
    The mean of its error is 0 and left out.
    """

    mean: Float[np.ndarray, "run 5"]
    spread: Spread

    def moved(self, mean: Float[np.ndarray, "run 5"], by: Spread) -> "State":
        """At another mean, the covariance carried along by the derivatives."""
        return State(mean, by @ self.spread @ by.transpose(0, 2, 1))

    def corrected(self, row: Row, news: Each, variance: Each, of: slice = slice(5)) -> "State":
        """By a measurement with these derivatives; nan news is none.

        Joseph's form, right for any gain: P - K h P - P h' K' + K s K' with s = h P h' + variance.
        """
        heard = np.isfinite(news + variance)
        if not heard.any():
            return self
        shared = (self.spread @ row[..., None])[..., 0]
        size = ((shared * row).sum(axis=1) + np.where(heard, variance, 1.0))[:, None]
        gain = shared / size * heard[:, None]
        gain[:, : of.start or 0] = 0.0
        gain[:, of.stop :] = 0.0
        less = gain[:, :, None] * (shared - 0.5 * size * gain)[:, None, :]
        mean = self.mean + gain[:, :5] * np.where(heard, news, 0.0)[:, None]
        return State(mean, self.spread - less - less.transpose(0, 2, 1))


@dataclass(frozen=True, eq=False)
class Tracked:
    """What the filter says of padded runs: q in every step, and the covariance of the last pose."""

    speeds: Float[np.ndarray, "run step 3"]
    covariance: Float[np.ndarray, "run 3 3"]


@dataclass(frozen=True, eq=False)
class Filter:
    """The extended Kalman filter.

    Attributes:
        dynamics, noise: fitted.
        mass: of the robot [kg].
        hears_current: whether forces by currents are measurements.
        wander: standard deviation by which rho moves in a second.
    """

    dynamics: Dynamics
    noise: Noise
    mass: float
    hears_current: bool
    wander: float

    def track(self, runs: Padded) -> Tracked:
        """All runs at once."""
        count, steps = runs.dt.shape
        rolling = np.full((count, 1), self.dynamics.law.rolling)
        mean = np.concatenate([runs.rolling[:, 0], rolling, np.zeros((count, 1))], axis=1)
        variances = [0.0, 0.0, 0.0, self.noise.rolling**2, self.noise.bias**2, 0.0, 0.0, 0.0]
        state = State(mean, np.tile(np.diag(variances), (count, 1, 1)))
        heading, speeds = np.zeros(count), np.zeros((count, steps, 3))
        for k in range(steps):
            dt = runs.dt[:, k]
            state = self._bounded(self._heard(self._driven(state, runs.rim[:, k], dt), runs, k))
            speeds[:, k] = state.mean[:, :3]
            turn = state.mean[:, 2] / self.dynamics.base_radius * dt
            state = self._travelled(state, heading + 0.5 * turn, dt)
            heading = heading + turn
        return Tracked(speeds, state.spread[:, 5:, 5:])

    def _driven(self, state: State, rim: Drives, dt: Each) -> State:
        """A step of the dynamics, and what drifts meanwhile."""
        step = self.dynamics.step(state.mean[:, :3], state.mean[:, 3], rim, dt)
        by = np.tile(np.eye(8), (len(dt), 1, 1))
        by[:, :3, :3], by[:, :3, 3] = step.by_speeds, step.by_rolling
        after = state.moved(np.concatenate([step.speeds, state.mean[:, 3:]], axis=1), by)
        # white noise of the twist whose integral grows as the squares of the drift
        rate = np.where(dt > 0.0, 1.0 / np.where(dt > 0.0, dt, 1.0), 0.0)[:, None]
        after.spread[:, range(3), range(3)] += np.square(self.noise.drift) * rate
        after.spread[:, 3, 3] += self.wander**2 * dt
        return after

    def _heard(self, state: State, runs: Padded, k: int) -> State:
        """The gyro and the currents of a step taken in."""
        longer = WINDOW_S / np.where(runs.dt[:, k] > 0.0, runs.dt[:, k], WINDOW_S)
        radius = self.dynamics.base_radius
        row = np.zeros((len(longer), 8))
        row[:, 2], row[:, 4] = 1.0 / radius, 1.0
        told = state.mean[:, 2] / radius + state.mean[:, 4]
        state = state.corrected(row, runs.gyro[:, k] - told, self.noise.gyro**2 * longer)
        if not self.hears_current:
            return state
        for drive, rims in enumerate(self.dynamics.rims):
            rim, pull = runs.rim[:, k, drive], runs.pull[:, k, drive]
            slide = rim[:, None] - state.mean[:, :3] @ rims[:, None]
            scale = self.noise.gain * self.mass * np.sign(rim)
            told = self.noise.offset + scale * self.dynamics.traction(slide)[:, 0]
            row = np.zeros((len(longer), 8))
            row[:, :3] = -scale[:, None] * self.dynamics.stiffness(slide) * rims
            state = state.corrected(row, pull - told, self.noise.force**2 * longer, slice(3, 4))
        return state

    def _bounded(self, state: State) -> State:
        """The weak constraint on rho."""
        law, straight = self.dynamics.law, 1.0 - self.dynamics.turning
        speed = np.linalg.norm(state.mean[:, :3] * straight, axis=1)
        rolling = state.mean[:, 3]
        beyond = np.clip(rolling, 0.0, law.grip / (1.0 + law.drag * speed)) - rolling
        row = np.zeros((len(rolling), 8))
        row[:, 3] = 1.0
        variance = np.full(len(rolling), (0.1 * self.noise.rolling) ** 2)
        return state.corrected(row, np.where(beyond == 0.0, np.nan, beyond), variance)

    def _travelled(self, state: State, heading: Each, dt: Each) -> State:
        """A step added to the error of the pose; the heading is that in its middle."""
        radius = self.dynamics.base_radius
        turning = np.stack([np.cos(heading), np.sin(heading)], axis=1)
        aside = turning[:, ::-1] * [-1.0, 1.0]
        x, y, yaw = state.mean[:, 0:1], state.mean[:, 1:2], state.mean[:, 2:3] / radius
        along, across = x * turning + y * aside, x * aside - y * turning
        # the chord of the step's arc, as of `path_of`, and how it shortens with the turn
        wait = dt[:, None]
        reach, less = np.sinc(yaw * wait / (2 * np.pi)) * wait, yaw * wait**3 / 12
        by = np.tile(np.eye(8), (len(dt), 1, 1))
        by[:, 5:7, 0], by[:, 5:7, 1] = turning * reach, aside * reach
        by[:, 5:7, 2] = (0.5 * wait * reach * across - less * along) / radius
        by[:, 7, 2] = dt / radius
        by[:, 5:7, 7] = across * reach
        return state.moved(state.mean, by)


def pulls(run: Heard, machine: Machine) -> Float[np.ndarray, "step drive"]:
    """Force n C_e I / r along each drive's motion [N]; nan where it tells nothing."""
    rim = np.abs(run.speed * machine.wheel_radius)
    if run.current is None:
        return np.full(rim.shape, np.nan)
    drives = (rim >= _DRIVING * rim.max(axis=1, keepdims=True)) & (rim > REST)
    scale = machine.gear_ratio * machine.back_emf / machine.wheel_radius
    return np.where(drives, scale * run.along(machine), np.nan)


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
        max_nfev=20,
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


@final
@dataclass(frozen=True)
class WardIagnemma(Method):
    """The filter, with or without currents.

    Attributes:
        with_drag: whether resistance grows with speed.
        wander: by how much of its scatter between runs rho moves in a second of a run.
        law, noise: fitted.
    """

    name: str = "ward_iagnemma"
    with_drag: bool = True
    wander: float = 0.0
    law: Law = field(default_factory=Law)
    noise: Noise = field(default_factory=Noise)

    @classmethod
    def with_current(cls) -> "WardIagnemma":
        """The variant that measures traction by the currents."""
        return cls("ward_iagnemma_current", needs=frozenset({"current"}))

    def candidates(self) -> Sequence["WardIagnemma"]:
        return [replace(self, with_drag=d, wander=w) for d in (False, True) for w in (0.0, 0.5)]

    def fit(self, runs: Sequence[Run], machine: Machine) -> "WardIagnemma":
        windows = Windows.of(runs, machine)
        law = fitted_law(windows, machine, self.with_drag)
        noise = fitted_noise(windows, Dynamics.of(machine, law), machine.mass)
        return replace(self, law=law, noise=noise)

    def predict(self, runs: Sequence[Heard], machine: Machine) -> list[Said]:
        padded = Padded.of(runs, machine)
        tracked = self.filter(machine).track(padded)
        size, fastest = (np.linalg.norm(q, axis=2) for q in (tracked.speeds, padded.rolling))
        kept = np.where(fastest > REST, size / np.where(fastest > REST, fastest, 1.0), 1.0)
        slipping = np.clip(1.0 - kept, 0.0, 1.0)
        return [
            Said(
                path_of(tracked.speeds[k, : len(run)] / machine.size, run.dt),
                end_covariance=tracked.covariance[k, :2, :2],
                slipping=slipping[k, : len(run)],
            )
            for k, run in enumerate(runs)
        ]

    def filter(self, machine: Machine) -> Filter:
        """The filter as fitted, for a robot."""
        return Filter(
            dynamics=Dynamics.of(machine, self.law),
            noise=self.noise,
            mass=machine.mass,
            hears_current="current" in self.needs,
            wander=self.wander * self.noise.rolling,
        )

    @property
    def numbers(self) -> int:
        heard = 2 * np.isfinite(self.noise.gyro) + 3 * ("current" in self.needs)
        return 3 + self.with_drag + 4 + int(heard)
