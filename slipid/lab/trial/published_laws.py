"""Published control laws that a trial compares with slipid's: Goswami and Padhy, and Indiveri.

Goswami and Padhy 2018: a tracking law with a Lyapunov function, and gains by particle swarm.

For a robot that can drive sideways, with the position error (e_x, e_y) in the robot's own axes, the
heading error e_th, the path's position p_d and turn rate W_d, and the heading th, the law commands

    v = R(th)^T p_d' + (k1 e_x, k2 e_y),   W = W_d + k3 sin e_th
    V = (e_x^2 + e_y^2) / 2 + 1 - cos e_th,   V' = -k1 e_x^2 - k2 e_y^2 - k3 sin^2 e_th

so that the Lyapunov function V falls for all positive gains, if the robot follows commands at once.
The gains are tuned by simulation of a robot without slip, but with delay and lag: they are the
gains in [0, 5] that minimise the integral of V over time, from start poses off the reference path.
For the delay and lag of the twin, k1 and k2 end at the upper bound, 5, and k3 at 4.67.

- row `goswami_padhy`: by a swarm of 30 particles in 50 iterations, inertia 0.7, c1 = c2 = 1.5.
- row `goswami_padhy_gradient`: the same integral is minimised by a quasi-Newton method with bounds
  (L-BFGS-B of scipy), which shows how close the swarm comes to the optimum.

In a particle swarm the particles at x are drawn to the best points found so far:

    v <- w v + c1 r1 (own best - x) + c2 r2 (best of all - x),   x <- x + v

with r1, r2 uniform in [0, 1], drawn anew for every particle, coordinate and iteration. The settings
of the swarm are those of Goswami and Padhy 2018 and are not tuned.

Liberties:
- The law is the form for robots that can drive sideways, as other papers quote it; the text of the
  paper itself was not available.
- The tuned cost is the integral of V along the path of the trial, from several start poses off the
  path, for a robot without slip whose twist follows commands with the twin's delay and lag. The
  paper's own robot, path and cost are not reproduced.
- In the tuning, all wheels have the same delay and lag, so that the twist has this delay and lag,
  too; speed, acceleration and voltage are not limited, the pose is known, and the path does not
  wait for the robot.
- As in all rows of the trial, the law is evaluated once per period with the pose by the encoders,
  and its commands are subject to the same limits.
- Particles start at rest at uniformly random points of the box. A coordinate that would leave the
  box stays on its edge with zero velocity; it moves by at most half of the box per iteration.

Source: Goswami and Padhy 2018, a trajectory tracking law for a mobile robot with slip, its gains by
particle swarm; known here only from quotations. Kennedy and Eberhart 1995, "Particle swarm
optimization", ICNN, with the inertia of Shi and Eberhart 1998.

Indiveri 2009: any Swedish wheels, a proportional pose loop, and limits that keep the direction.

A wheel at the position b, with radius r and speed w, drives along the unit vector u. Its rollers
run freely along a line at the angle gamma from u; n is the unit vector across that line. The speed
of the wheel follows from the velocity of its centre along n,

    r w (n . u) = n . (v + W z x b),   n . u = sin gamma

which is one row of w = A xi, for any number of wheels (Gfrerrer 2008 derives the same
geometrically). With the path's pose (p_d, th_d) and turn rate W_d, and the robot's pose (p, th),
the pose loop commands the twist xi = (v, W),

    v = R(th)^T (p_d' + k_p (p_d - p)),   W = W_d + k_th (th_d - th),   th_d - th in (-pi, pi]
    xi <- xi / max(1, max_i |A xi|_i / w_max)

so that a robot whose wheels reach their limit w_max still moves in the commanded direction, only
slower: while the path rests, position errors fall along the same straight line for any limit.

Nothing is tuned: the gains are the hand-set gains of slipid's pose loop.

Liberties:

- The law is implemented from its equations in other papers; the text of the paper itself was not
  available. Its other treatments of wheels at their limit are not included; here one factor scales
  translation and turning together.
- The gains are not those of the paper, but those of the row `encoder`. That row uses the sine of
  the heading error and lacks the scaling above. After the scaling, the limits that all rows share
  apply as well. While no wheel is at its limit, the two rows are nearly the same.
- w_max is the wheel speed limit that all rows share, not that of the actual robot.
- As in all rows, the path waits for a robot that lags behind, and limits of body speed, wheel
  acceleration and voltage apply in addition to w_max.
- The pose is that estimated by the encoders.

Source: Indiveri 2009, "Swedish wheeled omnidirectional mobile robots: kinematics analysis and
control", IEEE T-RO 25(1), and Gfrerrer 2008, both as quoted in other papers.
"""

from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Places = Float[np.ndarray, "particle n"]
Cost = Callable[[Places], Float[np.ndarray, " particle"]]
"""Function that returns the cost of all particles at once; NaN counts as infinite."""


@dataclass(frozen=True)
class Swarm:
    """Size of a swarm, its number of iterations, and its settings.

    Attributes:
        particles: number of particles.
        iterations: number of iterations.
        inertia: fraction w of its velocity that a particle keeps.
        own: weight c1 of a particle's own best point.
        others: weight c2 of the best point of all particles.
    """

    particles: int = 30
    iterations: int = 50
    inertia: float = 0.7
    own: float = 1.5
    others: float = 1.5


def minimise(
    cost: Cost,
    low: Float[np.ndarray, " n"],
    high: Float[np.ndarray, " n"],
    swarm: Swarm,
    seed: int = 0,
) -> tuple[Float[np.ndarray, " n"], list[float]]:
    """Return the best point that a swarm finds in a box, and the history of the smallest cost.

    The history has the smallest cost found so far, at the start and after each iteration. The same
    seed gives the same results.

    Args:
        cost: function to minimise.
        low, high: edges of the box.
        swarm: settings of the swarm.
        seed: seed of all random numbers.
    """
    rng, most = np.random.default_rng(seed), 0.5 * (high - low)
    x = rng.uniform(low, high, (swarm.particles, len(low)))
    v, own, value = np.zeros_like(x), x, _finite(cost(x))
    history = [float(value.min())]
    for _ in range(swarm.iterations):
        to_own, to_best = own - x, own[np.argmin(value)] - x
        one, two = rng.uniform(size=(2, *x.shape))
        v = swarm.inertia * v + swarm.own * one * to_own + swarm.others * two * to_best
        v = np.clip(v, -most, most)
        inside = np.clip(x + v, low, high)
        v = np.where(inside == x + v, v, 0.0)
        x = inside
        now = _finite(cost(x))
        better = now < value
        own, value = np.where(better[:, None], x, own), np.where(better, now, value)
        history.append(float(value.min()))
    return own[np.argmin(value)], history


def _finite(cost: Float[np.ndarray, " particle"]) -> Float[np.ndarray, " particle"]:
    return np.where(np.isfinite(cost), cost, np.inf)


Numbers = Array | np.ndarray
"""Arrays in the control law: jax arrays when the law drives a robot, numpy arrays when many gains
are evaluated at once. Poses, errors, rates, twists and gains have x, y and yaw on the first axis.
"""
LOW_GAINS, HIGH_GAINS = np.zeros(3), np.full(3, 5.0)
"""Bounds of the gains [1/s]."""
GAIN_STEP = 1e-4
"""Step of a gain in central differences [1/s]."""


def in_body(v: Numbers, heading: Numbers) -> Numbers:
    """Return vectors (x, y, yaw), given in world axes, in the axes of bodies at headings [rad]."""
    of = heading.__array_namespace__()
    c, s = of.cos(heading), of.sin(heading)
    return of.stack([c * v[0] + s * v[1], c * v[1] - s * v[0], v[2]])


def tracking_error(wanted: Numbers, pose: Numbers) -> Numbers:
    """Return the reference pose less the actual one: body axes x, y [m, m] and heading [rad]."""
    return in_body(wanted - pose, pose[2])


def lyapunov(e: Numbers) -> Numbers:
    """Return the Lyapunov function V of the errors; terms in m^2 and rad are added unweighted."""
    return 0.5 * (e[0] * e[0] + e[1] * e[1]) + 1.0 - e.__array_namespace__().cos(e[2])


def twist(gains: Numbers, e: Numbers, rates: Numbers, heading: Numbers) -> Numbers:
    """Return the commanded twist [m/s, m/s, rad/s].

    Args:
        gains: k1, k2, k3 [1/s].
        e: errors of the pose [m, m, rad].
        rates: rates of the path in the world [m/s, m/s, rad/s].
        heading: heading of the body [rad].
    """
    of = e.__array_namespace__()
    return in_body(rates, heading) + gains * of.stack([e[0], e[1], of.sin(e[2])])


class GoswamiPadhy(eqx.Module):
    """Goswami and Padhy's control law with its gains k1, k2, k3 [1/s]."""

    gains: Float[Array, "3"]

    def __call__(self, reference: Float[Array, "6"], pose: Float[Array, "3"]) -> Float[Array, "3"]:
        """Return the commanded twist [m/s, m/s, rad/s].

        Args:
            reference: pose and rates of the path in the world [m, m, rad, m/s, m/s, rad/s].
            pose: estimated pose [m, m, rad].
        """
        error = tracking_error(reference[:3], pose)
        return jnp.asarray(twist(self.gains, error, reference[3:], pose[2]))


@dataclass(frozen=True, eq=False)
class TuningTask:
    """Simulation with which gains are tuned: a robot with delay and lag, without slip, on a path.

    Attributes:
        reference: pose and rates of the path [m, m, rad, m/s, m/s, rad/s], one row per period.
        begin: start poses of the robot, off the path [m, m, rad].
        delay_weights: weight of each of the last commands, newest first, in the delayed command of
            each substep of a period.
        lag_gain: fraction of the difference between the delayed command and the twist by which the
            twist changes in a substep (first-order lag).
        period: time between commands [s].
    """

    reference: Float[np.ndarray, "step 6"]
    begin: Float[np.ndarray, "start 3"]
    delay_weights: Float[np.ndarray, "substep command"]
    lag_gain: float
    period: float

    def integrals(self, gains: Places) -> Float[np.ndarray, " particle"]:
        """Return, for each set of gains, the integral of V over time, averaged over the starts."""
        k, h = gains.T[..., None], self.period / len(self.delay_weights)
        pose = np.repeat(self.begin.T[:, None], len(gains), axis=1)
        velocity, total = np.zeros(pose.shape), np.zeros(pose.shape[1:])
        recent = np.zeros((self.delay_weights.shape[1], *pose.shape))
        for row in self.reference:
            wanted, rates = np.broadcast_to(row.reshape(2, 3, 1, 1), (2, *pose.shape))
            e = tracking_error(wanted, pose)
            total += lyapunov(e)
            recent[1:] = recent[:-1]
            recent[0] = twist(k, e, rates, pose[2])
            commands = self.delay_weights @ recent.reshape(len(recent), -1)
            for delayed in commands.reshape(-1, *pose.shape):
                velocity = velocity + self.lag_gain * (delayed - velocity)
                pose = _next_pose(pose, velocity, h)
        return self.period * total.mean(axis=1)

    def slope(self, gains: Float[np.ndarray, "3"]) -> tuple[float, Float[np.ndarray, "3"]]:
        """Return the mean integral of V, and its derivative with respect to the gains.

        The derivative is computed by central differences.
        """
        off = GAIN_STEP * np.eye(3)
        value = self.integrals(gains + np.concatenate([np.zeros((1, 3)), off, -off]))
        return float(value[0]), (value[1:4] - value[4:]) / (2 * GAIN_STEP)


def _next_pose(
    pose: Float[np.ndarray, "3 *batch"], velocity: Float[np.ndarray, "3 *batch"], h: float
) -> Float[np.ndarray, "3 *batch"]:
    """Return poses after a short time `h` [s] at constant twists, by the midpoint rule."""
    x, y, turn = velocity
    middle = pose[2] + 0.5 * h * turn
    c, s = np.cos(middle), np.sin(middle)
    return pose + h * np.array([c * x - s * y, s * x + c * y, turn])


def by_swarm(task: TuningTask, seed: int = 0) -> Float[np.ndarray, "3"]:
    """Return the gains that a particle swarm finds [1/s]."""
    return minimise(task.integrals, LOW_GAINS, HIGH_GAINS, Swarm(), seed)[0]


def by_gradient(task: TuningTask) -> Float[np.ndarray, "3"]:
    """Return the gains that L-BFGS-B finds from the middle of the box [1/s]."""
    from scipy.optimize import Bounds, minimize

    box, middle = Bounds(LOW_GAINS, HIGH_GAINS), 0.5 * (LOW_GAINS + HIGH_GAINS)
    exact = {"ftol": 1e-14, "gtol": 1e-10}
    found = minimize(task.slope, middle, jac=True, bounds=box, options=exact)
    return np.asarray(found.x)


LEAST_SINE = 0.05
"""Smallest sine of the angle between drive direction and free rolling line of a usable wheel."""


def inverse_kinematics(
    place: Float[np.ndarray, "wheel 2"],
    drive_angle: Float[np.ndarray, " wheel"],
    roller_angle: Float[np.ndarray, " wheel"],
    radius: Float[np.ndarray, " wheel"],
) -> Float[np.ndarray, "wheel 3"]:
    """Return the matrix A from body twist [m/s, m/s, rad/s] to wheel speeds without slip [rad/s].

    Args:
        place: centres of the wheels [m].
        drive_angle: direction of travel at a positive speed [rad].
        roller_angle: angle from the line along which rollers run freely to the drive direction
            [rad].
        radius: radius of each wheel [m].

    Raises:
        ValueError: rollers run freely along the drive direction, or the wheels do not determine the
            motion of the body.
    """
    across = np.sin(roller_angle)
    if np.abs(across).min() < LEAST_SINE:
        wheel = int(np.abs(across).argmin())
        raise ValueError(
            f"wheel {wheel + 1}: rollers at {np.degrees(roller_angle[wheel]):g} deg to the drive "
            "direction, so that the wheel cannot drive; expected an angle not near 0 or 180"
        )
    normal = drive_angle - roller_angle + 0.5 * np.pi
    n = np.stack([np.cos(normal), np.sin(normal)], axis=1)
    lever = place[:, 0] * n[:, 1] - place[:, 1] * n[:, 0]
    matrix = np.column_stack([n, lever]) / (radius * across)[:, None]
    if np.linalg.matrix_rank(matrix, tol=1e-6 * np.abs(matrix).max()) < 3:
        raise ValueError(
            "the wheel speeds do not determine the motion of the body; expected wheels that push "
            "in x, y and yaw"
        )
    return matrix


def pose_loop(
    gains: Float[Array, "2"], reference: Float[Array, "6"], pose: Float[Array, "3"]
) -> Float[Array, "3"]:
    """Return the twist that the pose loop commands [m/s, m/s, rad/s].

    Args:
        gains: gains of position and heading [1/s].
        reference: pose and rates of the path in the world [m, m, rad, m/s, m/s, rad/s].
        pose: estimated pose [m, m, rad].
    """
    vx, vy = reference[3:5] + gains[0] * (reference[:2] - pose[:2])
    off = reference[2] - pose[2]
    turn = reference[5] + gains[1] * jnp.arctan2(jnp.sin(off), jnp.cos(off))
    c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
    return jnp.stack([c * vx + s * vy, c * vy - s * vx, turn])


def within_limit(
    twist: Float[Array, "3"], matrix: Float[Array, "wheel 3"], limit: Float[Array, ""]
) -> Float[Array, "3"]:
    """Return the twist, scaled down if a wheel would be faster than `limit` [rad/s]."""
    over = jnp.max(jnp.abs(matrix @ twist)) / limit
    return twist / jnp.maximum(over, 1.0)


class Indiveri(eqx.Module):
    """Indiveri's control law with its parameters.

    Attributes:
        matrix: matrix A of `inverse_kinematics`.
        gains: gains of position and heading [1/s].
        limit: highest speed of the wheels [rad/s].
    """

    matrix: Float[Array, "wheel 3"]
    gains: Float[Array, "2"]
    limit: Float[Array, ""]

    def __call__(self, reference: Float[Array, "6"], pose: Float[Array, "3"]) -> Float[Array, "3"]:
        """Return the commanded twist; arguments as in `pose_loop`."""
        return within_limit(pose_loop(self.gains, reference, pose), self.matrix, self.limit)
