"""Likelihood of log variances given residuals that are linear in all else, and its derivative.

The residuals of a segment are Student t with the covariance V of `slipid.fitting.noise` as scale
matrix, as in the fit. The arrays are those of numpy, since its batched inverses take less time than
compiled ones, and have a first axis for chains.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from slipid.fitting import likelihood as lk
from slipid.fitting.noise import Components, electric_noise
from slipid.fitting.problem import Problem, linear, log_jacobian
from slipid.fitting.shared_effects import SharedEffects
from slipid.fitting.variances import (
    DEGREES,
    VARIANCE_SPREAD,
    Noises,
    Search,
    Square,
    Variances,
)
from slipid.infer.posterior.coordinates import Fitted
from slipid.infer.posterior.moves import Chains, SlopedDensity

_RANGE = (-50.0, 10.0)
"""Range of log variances; beyond it, where leapfrog steps may end, residuals do not change."""
Rows = dict[str, Float[np.ndarray, "segment m column"]]
"""Derivatives of residuals with respect to the search vector, then the residuals, by block."""


class Voltages(eqx.Module):
    """Quantities that make voltage residuals depend on the variances of currents and voltages.

    Attributes:
        batch: the windows.
        electric: noise that predictions of voltages depend on, at the fit.
        more: rows predicted from the measured current, less those from the predicted current [V].
    """

    batch: lk.Batch
    electric: lk.ElectricNoise
    more: Float[Array, "segment m column"]

    def share_and_spread(self, noises: Noises, log_v: Array) -> tuple[Array, Array]:
        """Return the share of `more` in the prediction, and `likelihood.voltage_spread`."""
        noise = electric_noise(noises, log_v, jnp.asarray(self.electric.resistance))
        variance = self.batch.current_var.reshape(noise.scatter.shape)
        share = noise.scatter / (noise.scatter + variance)
        return share, lk.voltage_spread(self.batch, noise)


@dataclass(frozen=True, eq=False)
class PooledPrior:
    """Prior of the load biases, whose variance is one of those that are drawn.

    Attributes:
        number: index of this variance.
        at: indices of the load biases in the search vector.
        change: prior mean less fitted value of each load bias.
        typical: scale of the half-normal prior of the std.
    """

    number: int
    at: Int[np.ndarray, " bias"]
    change: Float[np.ndarray, " bias"]
    typical: float

    def add(self, precision: Square, pull: Search, log_v: Variances) -> None:
        """Add this prior to a precision and a pull, in place."""
        own = np.exp(-log_v[self.number])
        precision[self.at, self.at] += own
        pull[self.at] += own * self.change


@dataclass(frozen=True, eq=False)
class LinearPart:
    """Residuals that are linear in the search vector, and the variances that they depend on.

    Attributes:
        noises: covariance components of every block.
        rows: derivatives and residuals at the fit. The residuals of voltages are predicted from the
            predicted current and not divided by their spread.
        precision: prior precision of the change of the search vector.
        pull: prior precision times the prior mean of this change.
        given: root of the covariance of changes that these residuals do not inform about, zero for
            all other coordinates.
        shared: effects that the runs on each floor share.
        typical: centre of the prior of every log variance.
        pooled: prior of the load biases, which `precision` and `pull` lack; None for residuals
            that do not inform about them.
        voltages: as in `Voltages`; None without voltages.
        degrees: degrees of freedom of the Student t of a segment's residuals.
    """

    noises: Noises
    rows: Rows
    precision: Square
    pull: Search
    given: Square
    shared: tuple[SharedEffects, ...]
    typical: Variances
    pooled: PooledPrior | None = None
    voltages: Voltages | None = None
    degrees: float = DEGREES

    @cached_property
    def member(self) -> Bool[np.ndarray, "variance segment"]:
        """True where the covariance V of a segment depends on a variance."""
        segments = len(next(iter(self.rows.values())))
        out = np.zeros((len(self.typical), segments), bool)
        for noise in self.noises.values():
            out[np.asarray(noise.which).T, np.arange(segments)] = True
        return out

    @cached_property
    def numbers(self) -> Int[np.ndarray, " drawn"]:
        """Indices of the variances that are drawn."""
        of_effects = [np.asarray(of.numbers)[1:].ravel() for of in self.shared]
        pooled = np.array([] if self.pooled is None else [self.pooled.number], int)
        of_segments = np.flatnonzero(self.member.any(axis=1))
        found = np.unique(np.concatenate([*of_effects, pooled, of_segments]))
        return found[found >= 0]

    @property
    def elements(self) -> int:
        """Number of elements of the covariances of all segments."""
        return sum(r.shape[0] * r.shape[1] ** 2 for r in self.rows.values())

    def log_prior(self, log_v: np.ndarray) -> np.ndarray:
        """Return the log prior of each log variance, up to a constant."""
        return np.asarray(-0.5 * ((log_v - self.typical) / VARIANCE_SPREAD) ** 2)

    def rows_at(self, log_v: Variances) -> Rows:
        """Return derivatives and residuals as in the likelihood, at given variances."""
        if self.voltages is None:
            return self.rows
        share, spread = (x[..., None] for x in self.share_and_spread(log_v))
        volts = (self.rows["voltage"] + share * np.asarray(self.voltages.more)) / spread
        return self.rows | {"voltage": volts}

    def share_and_spread(self, log_v: Variances) -> tuple[np.ndarray, np.ndarray]:
        """Return `Voltages.share_and_spread` at given variances."""
        assert self.voltages is not None
        share, spread = _share_and_spread(self.voltages, self.noises, jnp.asarray(log_v))
        return np.asarray(share), np.asarray(spread)


@jax.jit
def _share_and_spread(voltages: Voltages, noises: Noises, log_v: Array) -> tuple[Array, Array]:
    return voltages.share_and_spread(noises, log_v)


def linear_parts(problem: Problem, fitted: Fitted) -> tuple[LinearPart, ...]:
    """Return the part of motion residuals, and that of currents and voltages if they are logged.

    As in the fit, currents do not inform about parameters of the motion. In their part, these are
    drawn from the posterior given the motion. In the part of the motion, runs over several floors
    are a Gaussian of the parameters, with the variances as fitted; that of currents lacks them.
    """
    objective, z, log_v = problem.objective, fitted.z, fitted.log_variance
    noises, electric = problem.noise.blocks, problem.electric(fitted.z, fitted.log_variance)
    residual, jacobian, *_ = linear(objective, z, electric)
    rows = {k: _augmented(jacobian[k], r) for k, r in residual.items()}
    precision = np.diag(np.asarray(objective.prior_std(log_v)) ** -2)
    slope = np.asarray(log_jacobian(objective, z, electric, problem.full_weight)[1])
    e = problem.space.electric
    pull = precision @ (problem.space.prior_mean - z) + slope
    whole, whole_pull, several = precision.copy(), pull.copy(), fitted.multi_floor
    pooled = _pooled_prior(problem, fitted)
    whole[pooled.at, pooled.at], whole_pull[pooled.at] = 0.0, slope[pooled.at]
    if several is not None:
        linked = np.asarray(several.friction)
        whole[linked, linked], whole_pull[linked] = 0.0, 0.0
        whole += np.asarray(several.information)
        whole_pull += np.asarray(several.pull)
    motion = LinearPart(
        {"motion": noises["motion"]},
        {"motion": rows["motion"]},
        whole,
        whole_pull,
        np.zeros_like(precision),
        objective.shared,
        np.asarray(objective.typical),
        pooled,
    )
    if "current" not in noises:
        return (motion,)
    given, known = np.zeros_like(precision), np.ix_(~e, ~e)
    given[known] = np.linalg.cholesky(fitted.covariance[known])
    currents = replace(
        motion,
        noises={k: noises[k] for k in rows if k != "motion"},
        rows={k: rows[k] for k in rows if k != "motion"},
        precision=precision,
        pull=np.where(e, pull, 0.0),
        given=given,
        shared=(),
        pooled=None,
    )
    return motion, _with_voltages(currents, problem, z) if "voltage" in rows else currents


def _pooled_prior(problem: Problem, fitted: Fitted) -> PooledPrior:
    objective = problem.objective
    at = np.flatnonzero(problem.space.pooled)
    return PooledPrior(
        number=objective.pooled,
        at=at,
        change=(problem.space.prior_mean - fitted.z)[at],
        typical=float(np.exp(0.5 * objective.typical[objective.pooled])),
    )


def _augmented(jacobian: Array, residual: Array) -> np.ndarray:
    return np.concatenate([jacobian, np.asarray(residual)[..., None]], axis=-1)


def _with_voltages(part: LinearPart, problem: Problem, z: Search) -> LinearPart:
    """Return the part with rows of voltages predicted from predicted and from measured currents."""
    electric = problem.electric(z, np.asarray(part.typical))
    found = []
    for scatter in (1e-12, 1e12):  # the difference between the currents is all noise; all current
        noise = replace(electric, scatter=jnp.full_like(electric.scatter, scatter))
        residual, jacobian, *_ = linear(problem.objective, z, noise)
        spread = np.asarray(lk.voltage_spread(problem.batch, noise))
        found.append(_augmented(jacobian["voltage"], residual["voltage"]) * spread[..., None])
    of_predicted, of_measured = found
    return replace(
        part,
        rows=part.rows | {"voltage": of_predicted},
        voltages=Voltages(problem.batch, electric, jnp.asarray(of_measured - of_predicted)),
    )


class Residuals(NamedTuple):
    """Residuals of every chain, less shared effects.

    Attributes:
        blocks: residuals (chain, segment, m), keyed by block; of voltages as in `LinearPart.rows`.
        more: residuals by `Voltages.more`; None without voltages.
    """

    blocks: dict[str, np.ndarray]
    more: Float[np.ndarray, "chain segment m"] | None


@dataclass(frozen=True, eq=False)
class SegmentNoise:
    """Covariance components of a block, as arrays of numpy.

    Attributes:
        base: covariance of every segment and component at unit variance, flattened.
        which, known: as in `Components`.
        count: number of residuals of each segment that are used in the likelihood.
        degrees: degrees of freedom of the Student t of a segment's residuals.
    """

    base: Float[np.ndarray, "segment component square"]
    which: Int[np.ndarray, "segment component"]
    known: Float[np.ndarray, "segment m"]
    count: Float[np.ndarray, " segment"]
    degrees: float

    @staticmethod
    def of(noise: Components, degrees: float) -> "SegmentNoise":
        """Return the components of a block."""
        base = np.asarray(noise.base)
        which, known, count = (np.asarray(x) for x in (noise.which, noise.known, noise.count))
        return SegmentNoise(base.reshape(*base.shape[:2], -1), which, known, count, degrees)

    def covariance(self, log_v: Chains) -> Float[np.ndarray, "segment chain m m"]:
        """Return the covariance of every segment's residuals for every chain."""
        v, m = np.exp(np.clip(log_v, *_RANGE))[:, self.which].swapaxes(0, 1), self.known.shape[1]
        out = (v @ self.base).reshape(len(v), len(log_v), m, m)
        np.einsum("ncii->nci", out)[...] += self.known[:, None]
        return np.asarray(out)

    def log_likelihood(
        self, residual: Float[np.ndarray, "chain segment m"], log_v: Chains
    ) -> Float[np.ndarray, " chain"]:
        """Return the Student t log likelihood of every chain, up to a constant."""
        factor = np.linalg.cholesky(self.covariance(log_v))
        white = np.linalg.solve(factor, residual.swapaxes(0, 1)[..., None])[..., 0]
        tail = np.log1p(np.sum(white**2, axis=-1) / self.degrees)
        log_det = 2 * np.log(np.einsum("ncii->nci", factor)).sum(axis=-1)
        return -0.5 * (log_det + (self.degrees + self.count[:, None]) * tail).sum(axis=0)

    def slope(self, residual: Float[np.ndarray, "chain segment m"], log_v: Chains) -> Chains:
        """Return the derivative of `log_likelihood` with respect to the log variances."""
        inverse, r = np.linalg.inv(self.covariance(log_v)), residual.swapaxes(0, 1)
        white = (inverse @ r[..., None])[..., 0]
        square = np.sum(r * white, axis=-1)
        weight = (self.degrees + self.count[:, None]) / (self.degrees + square)
        inverse -= weight[..., None, None] * white[..., None] * white[..., None, :]
        each = inverse.reshape(*square.shape, -1) @ self.base.swapaxes(1, 2)
        out = np.zeros_like(log_v)
        for which, part in zip(self.which.T, np.moveaxis(each, -1, 0), strict=True):
            for chain, values in zip(out, part.T, strict=True):
                chain += np.bincount(which, values, len(chain))
        return np.asarray(-0.5 * np.exp(np.clip(log_v, *_RANGE)) * out)


@jax.jit
def _of_voltages(
    voltages: Voltages, noises: Noises, degrees: float | Array, r: Array, more: Array, log_v: Array
) -> tuple[Array, Array]:
    """Return the log likelihood of every chain's voltages, and its derivative by log variances."""

    def log_likelihood(r: Array, more: Array, log_v: Array) -> Array:
        share, spread = voltages.share_and_spread(noises, log_v)
        variance = jnp.diagonal(noises["voltage"].covariance(log_v), axis1=-2, axis2=-1)
        square = jnp.sum(((r + share * more) / spread) ** 2 / variance, axis=1)
        tail = (degrees + noises["voltage"].count) * jnp.log1p(square / degrees)
        return -jnp.sum(jnp.log(spread) + 0.5 * jnp.log(variance)) - 0.5 * jnp.sum(tail)

    return jax.vmap(jax.value_and_grad(log_likelihood, argnums=2))(r, more, log_v)


def target(part: LinearPart, noises: dict[str, SegmentNoise], at: Residuals) -> SlopedDensity:
    """Return the density of the log variances given residuals, with the weights integrated out."""

    def of_voltages(log_v: Chains) -> tuple[np.ndarray, Chains]:
        if part.voltages is None or at.more is None:
            return np.zeros(len(log_v)), np.zeros_like(log_v)
        of = (jnp.asarray(x) for x in (at.blocks["voltage"], at.more, log_v))
        value, slope = _of_voltages(part.voltages, part.noises, part.degrees, *of)
        return np.asarray(value), np.asarray(slope)

    def log_density(log_v: Chains) -> np.ndarray:
        out = part.log_prior(log_v).sum(axis=1) + of_voltages(log_v)[0]
        for k, n in noises.items():
            out += n.log_likelihood(at.blocks[k], log_v) if k != "voltage" else 0.0
        return out

    def slope(log_v: Chains) -> np.ndarray:
        out = (part.typical - log_v) / VARIANCE_SPREAD**2 + of_voltages(log_v)[1]
        for k, n in noises.items():
            out += n.slope(at.blocks[k], log_v) if k != "voltage" else 0.0
        return out

    return SlopedDensity(log_density, slope)


def divided(part: LinearPart, at: Residuals, log_v: Chains) -> dict[str, np.ndarray]:
    """Return residuals (chain, segment, m) as in the likelihood, voltages divided by the spread."""
    if at.more is None:
        return at.blocks
    found = [part.share_and_spread(one) for one in log_v]
    share, spread = (np.array(x) for x in zip(*found, strict=True))
    return at.blocks | {"voltage": (at.blocks["voltage"] + share * at.more) / spread}
