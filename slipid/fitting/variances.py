"""Student-t weights of residuals at given variances, and variances estimated by Fisher scoring.

The residuals of a segment have a multivariate Student-t distribution with the scale matrix V of
`noise`. The restricted likelihood of the variances accounts for the fact that the parameters were
fitted to the same residuals (Patterson and Thompson 1971, Biometrika 58(3)).
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from slipid.fitting import likelihood as lk
from slipid.fitting.multi_floor import MULTI_FLOOR_CURRENT, MULTI_FLOOR_MOTION, MultiFloorBatch
from slipid.fitting.noise import Components, electric_noise
from slipid.fitting.shared_effects import (
    Posteriors,
    SharedEffects,
    effect_covariances,
    effect_posteriors,
    marginal_slopes,
    mean_effect_slopes,
)
from slipid.search_space import Space

Vector = Array | np.ndarray
"""One-dimensional array of jax or numpy."""
Search = Float[np.ndarray, " free"]
"""A search vector, or one value for each of its coordinates."""
Variances = Float[np.ndarray, " variance"]
"""One value for each variance component, usually its log variance."""
Square = Float[np.ndarray, "free free"]
"""Covariance or information of the search vector."""
Blocks = dict[str, Array]
"""Arrays of residual blocks, keyed by name: `motion`, `current`, `voltage`, `crossing.*`."""
Noises = dict[str, Components]
"""Covariance components of every block."""
MOTION_BLOCKS = ("motion", MULTI_FLOOR_MOTION)
"""Blocks of motion residuals; those of currents and voltages are conditional on the motion."""
DEGREES = 8.0
"""Degrees of freedom of the Student-t distribution of a segment's residuals."""
VARIANCE_SPREAD = 3.0
"""Std of the prior of every log variance around its typical value."""


class Objective(eqx.Module):
    """Data and priors of a fit, as an argument of compiled functions.

    Attributes:
        space: free parameters and their prior.
        batch: runs on one floor each.
        multi_floor: runs over several floors, None if there are none.
        blocks: covariance components of every block.
        shared: effects that the runs on each floor share.
        typical: centre of the prior of the log variances.
        scored: True for variances that `scoring_step` estimates; those of run, shared and session
            effects and of load biases are estimated in `slipid.fitting.hierarchy`.
        pooled: index of the variance that is the prior variance of the space's pooled coordinates.
        joint: True if no currents are logged, so that all parameters are estimated from motion.
    """

    space: Space
    batch: lk.Batch
    multi_floor: MultiFloorBatch | None
    blocks: dict[str, Components]
    shared: tuple[SharedEffects, ...]
    typical: Float[Array, " variance"]
    scored: Bool[np.ndarray, " variance"]
    pooled: int = eqx.field(static=True)
    joint: bool = eqx.field(static=True)

    @eqx.filter_jit
    def prior_std(self, log_v: Vector) -> Array:
        """Return each coordinate's prior std; pooled coordinates have one common, fitted std."""
        pooled = jnp.exp(0.5 * jnp.asarray(log_v)[self.pooled])
        return jnp.where(self.space.pooled, pooled, jnp.asarray(self.space.prior_std))


class Whitening(NamedTuple):
    """Weighted inverse roots of the covariance of every segment.

    Attributes:
        root: matrix W for which W^T W = w V^-1.
        weight: Student-t weight w, small for an outlier.
        loss: minus log likelihood, less constants.
    """

    root: Blocks
    weight: Blocks
    loss: Array


class VoltageInformation(NamedTuple):
    """Information that voltages contain about variances; every array is (segment, m).

    Attributes:
        residual: voltage residual, divided by `likelihood.voltage_spread` [V].
        share: ratio of the voltmeter's variance to the whole variance of the undivided residual.
        slope: derivative of the log likelihood with respect to the scatter of the true current.
        information: expected information about that scatter.
        steeper: curvature of the loss with respect to the log variance of the voltage noise, less
            its expected value; large where other variances explain the residuals.
    """

    residual: Array
    share: Array
    slope: Array
    information: Array
    steeper: Array


@eqx.filter_jit
def voltage_information(
    objective: Objective, z: Vector, log_v: Vector, motor_force: Array
) -> VoltageInformation:
    """Return what voltages tell about variances, given the contact forces of every motor."""
    robot, b = objective.space.tree(z), objective.batch
    noise = electric_noise(objective.blocks, log_v, robot.motor.resistance)

    def scaled(scatter: Array) -> tuple[Array, Array]:
        at = lk.ElectricNoise(noise.voltage_std, scatter, noise.resistance)
        return lk.electric_residuals(robot, b, motor_force, at)["voltage"], lk.voltage_spread(b, at)

    # A residual depends only on the scatter of its window, so one jvp gives all derivatives.
    (r, spread), (more, wider) = jax.jvp(scaled, (noise.scatter,), (jnp.ones_like(noise.scatter),))
    variance, m, wider = noise.voltage_std**2, r.shape[1], wider / spread
    weight = (DEGREES + m) / (DEGREES + jnp.sum(r**2, axis=1, keepdims=True) / variance)
    moved = (more + r * wider) ** 2 / variance * (DEGREES + m) / (DEGREES + m + 2)
    slope = -wider - weight * r * more / variance
    share = 1 / spread**2
    steeper = 0.5 * share * (2 * share - 1) * (weight * r**2 / variance - 1)
    return VoltageInformation(r, share, slope, moved + 2 * wider**2, steeper)


@eqx.filter_jit
def whitening(noises: Noises, residual: Blocks, log_v: Vector, keep: Vector) -> Whitening:
    """Return weights and whitening roots of residuals; `keep` is 1 for segments that are used."""
    roots, weights, loss = {}, {}, jnp.zeros(())
    for k, r in residual.items():
        inverse = inverse_root(noises[k].covariance(log_v))
        m, kept = noises[k].count, jnp.asarray(keep)[noises[k].segments]
        q = jnp.sum(jnp.einsum("nij,nj->ni", inverse, r) ** 2, axis=-1)
        weights[k] = (DEGREES + m) / (DEGREES + q) * kept
        roots[k] = jnp.sqrt(weights[k])[:, None, None] * inverse
        log_det = -jnp.sum(jnp.log(jnp.diagonal(inverse, axis1=-2, axis2=-1)), axis=-1)
        loss += jnp.sum(kept * (log_det + 0.5 * (DEGREES + m) * jnp.log1p(q / DEGREES)))
    return Whitening(roots, weights, loss)


@eqx.filter_jit
def whitened(noises: Noises, jacobian: Blocks, log_v: Vector, keep: Vector) -> Blocks:
    """Return whitened Jacobians H (segment, m, free); H^T H is a segment's expected information."""
    out = {}
    for k, jac in jacobian.items():
        factor = jnp.asarray(keep)[noises[k].segments] * expected(noises[k].count)
        root = inverse_root(noises[k].covariance(log_v)) * jnp.sqrt(factor)[:, None, None]
        out[k] = jnp.einsum("nij,njp->nip", root, jac)
    return out


@eqx.filter_jit
def precision(
    objective: Objective, jacobian: Blocks, log_v: Vector, keep: Vector, alone: bool = False
) -> Array:
    """Return the expected information of the search vector, prior included (free, free).

    Shared effects are marginalised; if `alone`, every run is treated as if it shared no effects.
    """
    prior = jnp.diag(1 / objective.prior_std(log_v) ** 2)
    motion, electric = jnp.zeros_like(prior), jnp.zeros_like(prior)
    for k, half in whitened(objective.blocks, jacobian, log_v, keep).items():
        flat = half.reshape(-1, half.shape[-1])
        if k == "motion" and not alone:
            flat = marginal_slopes(expected_posteriors(objective, log_v, keep), half)
        if k in MOTION_BLOCKS:
            motion += flat.T @ flat
        else:
            electric += flat.T @ flat
    if objective.joint:
        return prior + motion + electric
    return _cut(motion, electric, prior, jnp.asarray(objective.space.electric))


def expected_posteriors(objective: Objective, log_v: Vector, keep: Vector) -> Posteriors:
    """Return the posteriors of shared effects, given residuals whitened by `whitened`."""
    block, log_v = objective.blocks["motion"], jnp.asarray(log_v)
    factor = expected(block.count) * jnp.asarray(keep)[block.segments]
    roots = inverse_root(block.covariance(log_v)) * jnp.sqrt(factor)[:, None, None]
    return effect_posteriors(objective.shared, log_v, roots)


def expected(m: Array | float | int) -> Any:
    """Return the ratio of a Student t's Fisher information about its location to a Gaussian's.

    The distribution has m dimensions, and the Gaussian has the same scale matrix.
    """
    return (DEGREES + m) / (DEGREES + m + 2)


def _cut(motion: Array, electric: Array, prior: Array, e: Array) -> Array:
    """Return the information of p(motion data | all) p(electric | others, electric data).

    The second factor is the conditional distribution of the electric parameters `e` given currents,
    voltages and all other parameters. It contains their prior, and is a prior of the friction that
    moves a robot whose wheels stand on several floors. Without such runs, the others have the
    distribution that motion alone gives them.

    Args:
        motion: information of the motion residuals (free, free).
        electric: information of currents and voltages (free, free).
        prior: information of the prior, diagonal (free, free).
        e: True for electric parameters (free,).
    """
    own = jnp.where(e[:, None] & e[None, :], electric + prior, 0.0)
    apart = jnp.diag(jnp.where(e, 1.0, 0.0)) - following(electric, prior, e)
    return motion + jnp.where(~e[:, None] & ~e[None, :], prior, 0.0) + apart.T @ own @ apart


def following(electric: Array, prior: Array, e: Array) -> Array:
    """Return how electric parameters follow the others, given currents and voltages (free, free).

    They are most likely to change by this matrix times a small change of the other parameters: for
    the information A of the electric parameters and the part B between these and the others, it is
    -A^-1 B. Arguments as in `_cut`.
    """
    own = jnp.where(e[:, None] & e[None, :], electric + prior, jnp.diag(jnp.where(e, 0.0, 1.0)))
    cross = jnp.where(e[:, None] & ~e[None, :], electric, 0.0)
    return -jnp.linalg.solve(own, cross)


@eqx.filter_jit
def electric_following(
    objective: Objective, jacobian: Blocks, root: Blocks, log_v: Vector
) -> Array:
    """Return how electric parameters follow those of the motion in a fit (free, free).

    Currents are predicted from the motion at the start of a round. Without this change, a step of
    the motion would contradict the currents by an amount that the next round finds again, and
    parameters could drift from round to round. Residuals of currents and the prior of the electric
    parameters are those of the parameters less what followed. It matters only to runs over several
    floors, whose motion depends on friction; without them it is zero.

    Args:
        objective: the objective of the fit.
        jacobian: derivatives of the residuals (segment, m, free), keyed by block.
        root: whitening roots of the residuals, keyed by block.
        log_v: log variances.
    """
    space = objective.space
    none = jnp.zeros((space.size, space.size))
    if objective.multi_floor is None or objective.joint:
        return none
    halves = [
        jnp.einsum("nij,njp->nip", root[k], slopes).reshape(-1, space.size)
        for k, slopes in jacobian.items()
        if k not in MOTION_BLOCKS
    ]
    electric = sum((half.T @ half for half in halves), none)
    prior = jnp.diag(1 / objective.prior_std(log_v) ** 2)
    return following(electric, prior, jnp.asarray(space.electric))


@eqx.filter_jit
def fitted_covariance(objective: Objective, jacobian: Blocks, log_v: Array, keep: Array) -> Blocks:
    """Return the residuals' covariance due to fitted parameters and shared effects (segment, m, m).

    The Jacobian is with respect to the search vector while shared effects stay fixed; the
    dependence of shared effects on the search vector is added here.
    """
    cov = jnp.linalg.inv(precision(objective, jacobian, log_v, keep))
    posteriors = expected_posteriors(objective, log_v, keep)
    half = whitened(objective.blocks, jacobian, log_v, keep)["motion"]
    followed = mean_effect_slopes(posteriors, half)
    motion = jacobian["motion"]
    for of in objective.shared:
        off = jnp.einsum("nma,nap->nmp", of.effect, followed[of.segments])
        motion = motion.at[of.segments].add(-off)
    slopes = jacobian | {"motion": motion}
    spread = {k: jnp.einsum("nip,pq,njq->nij", jac, cov, jac) for k, jac in slopes.items()}
    around = effect_covariances(posteriors, len(motion))
    for of in objective.shared:
        more = jnp.einsum("nma,nab,nlb->nml", of.effect, around[of.segments], of.effect)
        spread["motion"] = spread["motion"].at[of.segments].add(more)
    return spread


@eqx.filter_jit
def scoring_step(
    objective: Objective,
    residual: Blocks,
    spread: Blocks,
    log_v: Array,
    keep: Array,
    voltage: VoltageInformation | None,
) -> Array:
    """Return the log variances after one Fisher-scoring step of the restricted likelihood.

    `residual` holds the residuals of any model, less shared effects. `spread` is their covariance
    due to the parameters and effects that were fitted to them (segment, m, m); it corrects the
    variances for the degrees of freedom that the fit has used.
    """
    _, weights, _ = whitening(objective.blocks, residual, log_v, keep)
    score, steeper = jnp.zeros(log_v.shape[0]), jnp.zeros(log_v.shape[0])
    for k, r in residual.items():
        noise = objective.blocks[k]
        root = inverse_root(noise.covariance(log_v))
        inverse = jnp.einsum("nji,njk->nik", root, root)
        base, which = _scaled_base(noise, k, voltage), noise.which
        v = jnp.exp(log_v)[which]
        vr, kept = jnp.einsum("nij,nj->ni", inverse, r), keep[noise.segments]
        fit = jnp.einsum("ni,ncij,nj->nc", vr, base, vr) * weights[k][:, None]
        trace = jnp.einsum("nij,ncij->nc", inverse, base)
        spent = jnp.einsum("nij,njk,nkl->nil", inverse, spread[k], inverse)
        lost = jnp.einsum("nij,ncij->nc", spent, base)
        slope = 0.5 * v * (fit + kept[:, None] * (lost - trace))
        if voltage is not None and k == "current":
            slope += v * kept[:, None] * jnp.einsum("ni,nci->nc", voltage.slope, noise.single)
        score = score.at[which].add(slope)
        if voltage is not None and k == "voltage":
            steeper = steeper.at[which].add((kept * jnp.sum(voltage.steeper, axis=1))[:, None])
        others = () if voltage is None else ("current",)
        if k in (MULTI_FLOOR_MOTION, MULTI_FLOOR_CURRENT, *others):
            # Where log variances decrease, the curvature of the loss exceeds the expected one by
            # |slope|: without this term the step would be too long.
            steeper = steeper.at[which].add(-slope)
    score -= (log_v - objective.typical) / VARIANCE_SPREAD**2
    info = information(objective.blocks, log_v, keep, voltage)
    info += jnp.diag(jnp.maximum(steeper, 0.0))
    step = jnp.clip(jnp.linalg.solve(info, score), -1.5, 1.5)
    return log_v + jnp.where(objective.scored, step, 0.0)


@eqx.filter_jit
def information(
    noises: Noises, log_v: Vector, keep: Vector, voltage: VoltageInformation | None
) -> Array:
    """Return the expected information of the log variances, prior included (variance, variance)."""
    info = jnp.eye(log_v.shape[0]) / VARIANCE_SPREAD**2
    for k, noise in noises.items():
        base, which = _scaled_base(noise, k, voltage), noise.which
        root = inverse_root(noise.covariance(log_v))
        vb = jnp.einsum("nji,njk,nckl->ncil", root, root, base)
        v = jnp.exp(log_v)[which]
        cross = 0.5 * jnp.einsum("ncij,ndji->ncd", vb, vb)
        cross *= v[:, :, None] * v[:, None, :]
        kept = jnp.asarray(keep)[noise.segments, None, None]
        info = info.at[which[:, :, None], which[:, None, :]].add(kept * cross)
    if voltage is None:
        return info
    # The variance of voltage residuals also depends on the scatter of the true currents, whose
    # components are those of the block `current`.
    noise = noises["current"]
    grown = jnp.exp(log_v)[noise.which][..., None] * noise.single
    kept = jnp.asarray(keep)[noise.segments]
    cross = jnp.einsum("n,ni,nci,ndi->ncd", kept, voltage.information, grown, grown)
    through = jnp.zeros_like(info)
    return info + through.at[noise.which[:, :, None], noise.which[:, None, :]].add(cross)


def _scaled_base(noise: Components, block: str, voltage: VoltageInformation | None) -> Array:
    """Return a block's covariance components; those of voltages times `VoltageInformation.share`.

    Voltage residuals have been divided by their spread, and so must be their components.
    """
    if voltage is None or block != "voltage":
        return noise.base
    root = jnp.sqrt(voltage.share)
    return noise.base * root[:, None, :, None] * root[:, None, None, :]


@jax.jit
def inverse_root(v: Float[Array, "segment m m"]) -> Float[Array, "segment m m"]:
    """Return the inverse Cholesky factor L^-1 of V = L L^T for many small matrices at once.

    The algorithm is written out, column by column, because batched LAPACK calls that run in
    parallel inside one compiled function can deadlock on a computer with two cores (jax 0.10).
    """
    a = jnp.moveaxis(v, 0, -1)
    m = a.shape[0]
    rows = jnp.arange(m)[:, None]

    def column(j: Array, low: Array) -> Array:
        rest = a[:, j] - jnp.sum(low * low[j], axis=1)
        return low.at[:, j].set(jnp.where(rows >= j, rest / jnp.sqrt(rest[j]), 0.0))

    low = jax.lax.fori_loop(0, m, column, jnp.zeros_like(a))

    def row(i: Array, inverse: Array) -> Array:
        known = jnp.sum(low[i][:, None] * inverse, axis=0)
        return inverse.at[i].set(((rows == i) - known) / low[i, i])

    inverse = jax.lax.fori_loop(0, m, row, jnp.zeros_like(a))
    return jnp.moveaxis(inverse, -1, 0)
