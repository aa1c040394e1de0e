"""Structural numbers by Levenberg-Marquardt on whitened residuals (optimistix)."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jaxtyping import Array, Float

from slipid.identify.fit import likelihood as lk
from slipid.identify.fit.variances import Blocks, Target

_REFUSED = 12
"""Steps of the solver that may be refused in a round."""


class Held(eqx.Module):
    """What is held while the structural numbers move from z.

    The mask is 1 for coordinates that may move; root whitens residuals, volt is the std of the
    voltage noise [V], felt the traction at z, which currents and voltages are predicted from, and
    slope that of log |d residuals / d data| by the search vector.
    """

    target: Target
    z: Float[Array, " free"]
    mask: Float[Array, " free"]
    root: Blocks
    volt: Float[Array, ""]
    felt: Float[Array, "piece window wheel"]
    slope: Float[Array, " free"]


class Steps(optx.LevenbergMarquardt):
    """Levenberg-Marquardt that ends after so many steps that were taken.

    One that is refused shrinks the next, and to stop among refused ones would look like having
    arrived. The solver counts its look at the start as a step that was taken.
    """

    most: Array

    def __init__(self, most: int):
        super().__init__(rtol=1e-6, atol=1e-8, linear_solver=lx.Normal(lx.Cholesky()))
        self.most = jnp.asarray(most)

    def terminate(
        self, fn: Any, y: Array, args: Held, options: Any, state: Any, tags: frozenset[object]
    ) -> tuple[Array, optx.RESULTS]:
        done, result = super().terminate(fn, y, args, options, state, tags)
        taken = state.num_accepted_steps - 1 >= self.most
        return done | taken | (state.num_steps >= self.most + _REFUSED), result


@eqx.filter_jit
def levenberg(held: Held, solver: Steps) -> Float[Array, " free"]:
    """Search vector after the solver's steps with fixed whitening."""
    start = jnp.zeros_like(held.z)
    found = optx.least_squares(_stacked, solver, start, held, max_steps=None, throw=False)
    return _at(held, found.value)


def _at(held: Held, y: Array) -> Array:
    """Search vector of a step in prior stds."""
    return held.z + held.mask * held.target.space.prior_std * y


def _stacked(y: Array, held: Held) -> Array:
    """Whitened residuals of all blocks and of the prior."""
    target, space = held.target, held.target.space
    z = _at(held, y)
    robot = given = space.tree(z)
    p = lk.predict(robot, target.batch)
    felt = p.felt
    if not target.joint:  # currents and voltages given the motion of the round's start
        given, felt = space.tree(jnp.where(space.electric, z, held.z)), held.felt
    blocks = {"motion": lk.motion_residual(robot, target.batch, p)}
    blocks |= lk.electric_residuals(given, target.batch, felt, held.volt)
    parts = [jnp.einsum("nij,nj->ni", held.root[k], r).ravel() for k, r in blocks.items()]
    # the slope of the log Jacobian adds slope . z to the log posterior
    mean = space.prior_mean + space.prior_std**2 * held.slope
    return jnp.concatenate([*parts, (z - mean) / space.prior_std])
