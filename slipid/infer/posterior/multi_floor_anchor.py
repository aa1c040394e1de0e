"""Runs over several floors in the density of the motion, with the friction that moves them.

Their motion depends on the ratios of friction coefficients, which currents determine given the
motion. The distribution of the friction f given the other parameters of the motion m and currents
is a Gaussian,

    f ~ N(c + F (m - m_fit), C),

with F from `slipid.fitting.variances.following` and the covariance C of the friction given m. With
it, the friction is sampled together with the motion. c is where currents alone would have it: at
the fit, the slope of the likelihood of the motion with respect to friction is minus that of the
currents, which is zero at c. All other electric parameters are then drawn given both, from the
exact density.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from slipid.fitting import likelihood as lk
from slipid.fitting.multi_floor import MULTI_FLOOR_CURRENT, MULTI_FLOOR_MOTION, MultiFloorBatch
from slipid.fitting.problem import Problem, twists
from slipid.fitting.variances import (
    MOTION_BLOCKS,
    Search,
    Square,
    Variances,
    expected,
    following,
    inverse_root,
    whitened,
)
from slipid.model.robot import Robot


class MultiFloorAnchor(eqx.Module):
    """Runs over several floors and the values that stay fixed in a density.

    Attributes:
        runs: windows of the runs.
        root: whitening matrix of every segment, keyed by block; its weight at the fit is contained.
        factor: ratio f of a Student t's information to a Gaussian's for each segment's motion.
        twist: twist of every window at the fit.
        twist_slope: derivative of the twists with respect to the search vector.
        friction: index of each coordinate of friction that moves the runs.
        moved: True for coordinates that the motion of the runs depends on.
        link: whitened residuals of the friction per change of the search vector.
        link_centre: search vector at which these residuals are zero.
        information: information of the motion of the runs and of `link`.
        pull: information times estimate of the change of the search vector at the fit.
    """

    runs: MultiFloorBatch
    root: dict[str, Array]
    factor: Float[Array, " segment"]
    twist: Float[Array, "segment window 3"]
    twist_slope: Float[Array, "segment window 3 free"]
    friction: Int[np.ndarray, " friction"]
    moved: Bool[np.ndarray, " free"]
    link: Float[np.ndarray, "friction free"]
    link_centre: Float[np.ndarray, " free"]
    information: Square
    pull: Search

    @staticmethod
    def at(problem: Problem, z: Search, log_v: Variances) -> "MultiFloorAnchor":
        """Return the runs over several floors of a problem, at fitted values."""
        objective = problem.objective
        runs, blocks = objective.multi_floor, problem.noise.blocks
        assert runs is not None, "the problem has runs over several floors"
        residual, jacobian = problem.linear(z, problem.electric(z, log_v))
        own = {k: r for k, r in residual.items() if k in (MULTI_FLOOR_MOTION, MULTI_FLOOR_CURRENT)}
        keep = problem.full_weight
        weight = problem.whitening(own, log_v, keep).weight
        root = {
            k: inverse_root(blocks[k].covariance(log_v))
            * jnp.sqrt(w * expected(blocks[k].count))[:, None, None]
            for k, w in weight.items()
        }
        slopes = np.asarray(jacobian[MULTI_FLOOR_MOTION])
        half = np.einsum("nij,njp->nip", root[MULTI_FLOOR_MOTION], slopes).reshape(-1, len(z))
        white = np.einsum("nij,nj->ni", root[MULTI_FLOOR_MOTION], residual[MULTI_FLOOR_MOTION])
        score = -half.T @ white.ravel()
        moved = np.abs(half).max(axis=0) > 0
        electric = problem.space.electric & (not objective.joint)
        friction = np.flatnonzero(moved & electric)
        rows = [
            np.asarray(h).reshape(-1, len(z))
            for k, h in whitened(blocks, jacobian, log_v, keep).items()
            if k not in MOTION_BLOCKS
        ]
        of_currents = sum((h.T @ h for h in rows), np.zeros((len(z), len(z))))
        prior = np.diag(np.asarray(objective.prior_std(log_v)) ** -2.0)
        centre = z.copy()
        link: Float[np.ndarray, "friction free"] = np.zeros((0, len(z)))
        if len(friction):
            follows = np.asarray(following(*map(jnp.asarray, (of_currents, prior, electric))))
            e = np.flatnonzero(electric)
            given_motion = np.linalg.inv((of_currents + prior)[np.ix_(e, e)])
            centre[e] -= given_motion @ score[e]
            mine = np.searchsorted(e, friction)
            precision = np.linalg.inv(given_motion[np.ix_(mine, mine)])
            change = -np.where(electric, 0.0, follows[friction])
            change[np.arange(len(friction)), friction] = 1.0
            link = np.linalg.cholesky(precision).T @ change
        off = link @ (z - centre)
        factor = jnp.asarray(expected(blocks[MULTI_FLOOR_MOTION].count))

        def log_jacobian(x: Array) -> Array:
            return jnp.sum(factor * runs.log_jacobian(problem.space.tree(x)))

        of_data = np.asarray(jax.grad(log_jacobian)(jnp.asarray(z)))
        twist, slope = twists(problem.space, runs.batch, z)
        return MultiFloorAnchor(
            runs=runs,
            root=root,
            factor=factor,
            twist=twist,
            twist_slope=slope,
            friction=friction,
            moved=moved,
            link=link,
            link_centre=centre,
            information=half.T @ half + link.T @ link,
            pull=score + of_data - link.T @ off,
        )

    def predict(self, robot: Robot, change: Float[Array, " free"]) -> lk.Predicted:
        """Return the prediction for a robot whose search vector is the fit's plus `change`."""
        return lk.predict(robot, self.runs.batch, self.twist + self.twist_slope @ change)

    def white(self, block: str, r: Float[Array, "segment m"]) -> Float[Array, "segment m"]:
        """Return the residuals of a block, whitened and weighted."""
        return jnp.einsum("nij,nj->ni", self.root[block], r)
