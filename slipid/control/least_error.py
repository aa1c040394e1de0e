"""Wheel speeds that bring the body nearest to a wanted twist, over all that is believed of floors.

    w = argmin  sum_c p_c |D (xi_c(w) - xi)|^2 + a |r (w - w_plain)|^2 + b |r (w - w_last)|^2

with xi_c(w) the contact equilibrium of hypothesis c, D = diag(1, 1, base radius), w_plain the
speeds of wheels that do not slip and w_last the last command. A mean over what is believed changes
gradually where beliefs do. The minimum is neared by a fixed number of Gauss-Newton steps from
w_plain; derivatives of the equilibrium come from the implicit function theorem.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from slipid.control.deployed import DeployedRobot
from slipid.control.filter.effects import Course
from slipid.control.filter.floor_filter import hypotheses_of, told_of
from slipid.control.interface import Believed
from slipid.model.contact import settle, steered
from slipid.model.contact_balance import stand
from slipid.model.se2 import Planar

PASSES = 3
"""Gauss-Newton steps."""
PLAIN, LAST = 0.02, 0.02
"""Weights of what a command differs by from wheels that do not slip, and from the last command."""
FARTHEST = 0.15
"""Rim speed that a pass may change [m/s]."""
STEEPEST = 1.5
"""Bound of the change of the body's speed over that of a rim speed."""


def wheel_speeds(
    robot: DeployedRobot,
    asked: Float[Array, "3"],
    believed: Believed,
    last: Float[Array, " wheel"],
) -> Float[Array, " wheel"]:
    """Wheel speeds [rad/s] for a wanted twist; the more is unknown, the nearer to no slip.

    Args:
        robot: as it is known; asked: twist [m/s, m/s, rad/s].
        believed: of the floors; last: wheel speeds commanded last [rad/s].
    """
    f, radius = robot, robot.frame.radius
    p = believed.probability[:-1]
    sure = jnp.sum(p)
    p = p / jnp.maximum(sure, 1e-12)
    on = stand(f.frame, f.floors.at(hypotheses_of(f).T), f.rest)
    scale = jnp.stack([jnp.ones(()), jnp.ones(()), f.frame.base])
    plain = f.forward @ asked  # rim speeds

    def nearer(carry: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
        rim, near = carry
        near = settle(near, rim, on, f.inverse)[0]
        course = Course.of(f.inverse @ rim, f.frame.base)
        told = course.speed * f.told.at(course)[0] @ course.axes.T
        gap = scale * (near.T + told_of(f, told) - asked)  # (hypothesis, 3)
        slope = scale[None, :, None] * steered(Planar(*near), rim, on, STEEPEST / scale)
        cost = jnp.einsum("c,wac,vac->wv", p, slope, slope) + (PLAIN + LAST) * jnp.eye(len(rim))
        down = jnp.einsum("c,wac,ca->w", p, slope, gap)
        down = down + PLAIN * (rim - plain) + LAST * (rim - radius * last)
        step = -jnp.linalg.solve(cost, down)
        size = jnp.max(jnp.abs(step))
        return (rim + step * jnp.minimum(1.0, FARTHEST / jnp.maximum(size, 1e-9)), near), None

    begin = jnp.where(jnp.isfinite(believed.twist), believed.twist, 0.0).T
    rim = jax.lax.scan(nearer, (plain, begin), None, length=PASSES)[0][0]
    moves = jnp.clip(jnp.max(jnp.abs(plain)) / 0.02 - 0.25, 0.0, 1.0)
    extra = sure * moves * (rim - plain)
    return (plain + jnp.where(jnp.isfinite(extra), extra, 0.0)) / radius
