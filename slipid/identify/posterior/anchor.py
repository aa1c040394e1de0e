"""What a density holds of the data and of the fit: windows, covariance pieces, nearby twists."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaln
from jaxtyping import Array, Float, Int

from slipid.identify.fit import likelihood as lk
from slipid.identify.fit.linear import squares
from slipid.identify.fit.noise import effects
from slipid.identify.fit.problem import Problem, twists
from slipid.identify.fit.sessions import by_axis, pairs
from slipid.identify.fit.variances import DEGREES
from slipid.identify.posterior.coordinates import Fitted
from slipid.model.robot import Robot


class Anchor(eqx.Module):
    """Windows and the fit that a density is anchored at; an argument of what is compiled.

    Covariance pieces of every block, pieces last, go with the number of the variance of each.
    Twists are those at the fit, with their derivative by the search vector; `typical` is the centre
    of the prior of the log variances. Shares are how far session effects of one std move residuals,
    session is the place among those that have effects.
    """

    batch: lk.Batch
    base: dict[str, Array]
    which: dict[str, Array]
    z: Array
    log_variance: Array
    twist: Float[Array, "piece window 3"]
    twist_slope: Float[Array, "piece window 3 free"]
    typical: Array
    shares: Float[Array, "piece m 3"]
    session: Int[Array, " piece"]


def anchor_at(problem: Problem, fitted: Fitted, sessions: tuple[tuple[str, str], ...]) -> Anchor:
    """Anchor at a fit, for sessions that have effects of their own."""
    twist, slope = twists(problem.space, problem.batch, fitted.z)
    w = problem.windows
    shares = effects(w, problem.robot) * np.sqrt(by_axis(fitted.session, "session", w))[:, None]
    place = {pair: k for k, pair in enumerate(sessions)}
    return Anchor(
        batch=problem.batch,
        base={k: jnp.moveaxis(c.base, 0, -1) for k, c in problem.noise.blocks.items()},
        which={k: c.which.T for k, c in problem.noise.blocks.items()},
        z=jnp.asarray(fitted.z),
        log_variance=jnp.asarray(fitted.log_variance),
        twist=twist,
        twist_slope=slope,
        typical=problem.target.typical,
        shares=jnp.asarray(shares),
        session=jnp.asarray([place.get(pair, 0) for pair in pairs(w)]),
    )


def predict(robot: Robot, anchor: Anchor, z: Array) -> lk.Predicted:
    """What the robot predicts, searched from the twists at the fit and, if that fails, afresh."""
    b = anchor.batch
    start = anchor.twist + anchor.twist_slope @ (z - anchor.z)
    p = lk.predict(robot, b, jax.lax.stop_gradient(start))
    arrived = jnp.all(jnp.isfinite(p.twist))
    return jax.lax.cond(arrived, lambda: p, lambda: lk.predict(robot, b))


def log_student(
    anchor: Anchor, k: str, r: Float[Array, "piece m"], log_v: Float[Array, " variance"]
) -> Float[Array, " piece"]:
    """Log density of residuals of block `k` by a Student t with scale matrix V, for every piece."""
    base, which = anchor.base[k], anchor.which[k]
    m = base.shape[1]
    v = jnp.exp(log_v)[which]
    floor = lk.FLOOR[k] * jnp.eye(m)[:, :, None]
    cov = sum((v[c] * base[c] for c in range(len(base))), floor)
    log_det, q = squares(jax.lax.optimization_barrier(cov), r.T)
    constant = gammaln(0.5 * (DEGREES + m)) - gammaln(0.5 * DEGREES)
    constant -= 0.5 * m * np.log(DEGREES * np.pi)
    return constant - 0.5 * log_det - 0.5 * (DEGREES + m) * jnp.log1p(q / DEGREES)
