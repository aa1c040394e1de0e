"""Wheel speeds that bring the body nearest to a wanted twist, over all that is believed of floors.

    w = argmin  sum_c p_c |D (xi_c(w) - xi)|^2 + a |r (w - w_plain)|^2 + b |r (w - w_last)|^2

with xi_c(w) the contact equilibrium of hypothesis c beside what runs told of its floor, D = diag(1,
1, base radius), w_plain the speeds of wheels that do not slip and w_last the last command. A mean
over what is believed changes gradually where beliefs do. Each control period takes one Gauss-Newton
step from the speeds at which the wheels turn, where the estimator has just found the equilibria, so
that over the periods commands come close to the minimum (real-time iteration: Diehl, Bock and
Schlöder 2005). Derivatives of the equilibria come from the implicit function theorem; what runs
told is held where it is.

What differs from w_plain is held below `FARTHEST`, counts by the probability that floors are known,
and fades out where wheels hardly turn.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from slipid.control.deployed import RobotArrays
from slipid.control.filter.effects import Course
from slipid.control.filter.floor_filter import told_of
from slipid.control.filter.hypotheses import hypotheses_of
from slipid.control.interface import Believed
from slipid.model.contact import steered
from slipid.model.contact_balance import stand
from slipid.model.se2 import Planar

PLAIN, LAST = 0.02, 0.02
"""Weights of what a command differs by from wheels that do not slip, and from the last command."""
FARTHEST = 0.15
"""Rim speed by which a command may differ from wheels that do not slip [m/s]."""
STEEPEST = 1.5
"""Bound of the change of the body's speed over that of a rim speed."""


def solved(m: Float[Array, "wheel wheel"], b: Float[Array, " wheel"]) -> Float[Array, " wheel"]:
    """Solution x of m x = b for a positive definite matrix, by Cholesky's factors written out.

    A call of a library would have no form in the code that is exported to robots.
    """
    count = len(b)
    root = [[jnp.zeros(())] * count for _ in range(count)]
    for i in range(count):
        for j in range(i + 1):
            rest = m[i, j] - sum(root[i][k] * root[j][k] for k in range(j))
            root[i][j] = jnp.sqrt(rest) if i == j else rest / root[j][j]
    y: list[Array] = []
    for i in range(count):
        y.append((b[i] - sum(root[i][k] * y[k] for k in range(i))) / root[i][i])
    x = [jnp.zeros(())] * count
    for i in reversed(range(count)):
        x[i] = (y[i] - sum(root[k][i] * x[k] for k in range(i + 1, count))) / root[i][i]
    return jnp.stack(x)


def wheel_speeds(
    robot: RobotArrays,
    asked: Float[Array, "3"],
    believed: Believed,
    turning: Float[Array, " wheel"],
    last: Float[Array, " wheel"],
) -> Float[Array, " wheel"]:
    """Wheel speeds [rad/s] for a wanted twist; the more is unknown, the nearer to no slip.

    Args:
        robot: as it is known; asked: twist [m/s, m/s, rad/s].
        believed: of the floors, and what the body does on each at the wheels' speeds.
        turning: wheel speeds now; last: those commanded last [rad/s].
    """
    f, radius = robot, robot.frame.radius
    p = believed.probability[:-1]
    sure = jnp.sum(p)
    p = p / jnp.maximum(sure, 1e-12)
    scale = jnp.stack([jnp.ones(()), jnp.ones(()), f.frame.base])
    plain, rim = f.forward @ asked, radius * turning  # rim speeds
    course = Course.of(f.inverse @ rim, f.frame.base)
    told = course.speed * f.told.at(course)[0] @ course.axes.T
    gap = scale * (believed.twist + told_of(f, told) - asked)  # (hypothesis, 3)
    on = stand(f.frame, f.floors.at(hypotheses_of(f).under.T), f.rest)
    slope = scale[None, :, None] * steered(Planar(*believed.twist.T), rim, on, STEEPEST / scale)
    cost = jnp.einsum("c,wac,vac->wv", p, slope, slope) + (PLAIN + LAST) * jnp.eye(f.wheels)
    down = jnp.einsum("c,wac,ca->w", p, slope, gap)
    down = down + PLAIN * (rim - plain) + LAST * (rim - radius * last)
    extra = rim - plain - solved(cost, down)
    far = jnp.max(jnp.abs(extra))
    extra = extra * jnp.minimum(1.0, FARTHEST / jnp.maximum(far, 1e-9))
    # wheels that hardly turn tell nothing of how floors answer
    slow = jnp.minimum(jnp.max(jnp.abs(plain)), jnp.max(jnp.abs(rim)))
    extra = extra * sure * jnp.clip(slow / 0.02 - 0.25, 0.0, 1.0)
    return (plain + jnp.where(jnp.isfinite(extra), extra, 0.0)) / radius
