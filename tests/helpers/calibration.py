"""Made experiments whose truths come from the fit's own prior: do intervals hold what they say?

The noise is what the likelihood says it is, effects that runs share and heavy tails included, so
that draws of a right posterior have ranks of the truth that are uniform (Talts et al. 2018,
arXiv:1804.06788).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import binom, norm, truncnorm

from slipid.fitting import likelihood as lk
from slipid.fitting.hierarchy import POOLED_RANGE
from slipid.fitting.optimise import Optimum, optimise
from slipid.fitting.problem import Problem
from slipid.fitting.variances import DEGREES, VARIANCE_SPREAD
from slipid.infer.posterior import sample as posterior
from slipid.infer.posterior.blocks import Plan
from slipid.infer.posterior.coordinates import Fitted
from slipid.infer.posterior.variance_draws import drawn_variances
from slipid.infer.result import Channels, Fit
from slipid.predict.open_loop import chain
from slipid.search_space import Choice
from slipid.support.progress import Reporter
from tests.helpers.made_windows import made, robot

REPEATED = {"firm.straight": 0, "firm.turning": 4, "soft.straight": 1, "soft.turning": 9}
"""Segments whose motion is predicted, were the experiment done again."""
PREDICTED = [f"repeated.{name}.{axis}" for name in REPEATED for axis in ("x", "y", "heading")]
PLAN = Plan(ensembles=2, walkers=16, block=10, warm_up=(1, 2, 4, 6), most=12, rows=600)
DRAWS = 50
"""Of each of the plan's ensembles."""
CENTRE = {
    "surface.*.creep": 0.2,
    "surface.*.roller_drag": 0.2,
    "surface.*.friction": 0.3,
    "motor.resistance": 5.0,
    "motor.back_emf": 0.05,
}
CHOICES = [
    Choice("*", free=False),
    *(Choice(path, prior_mean=x, prior_std=0.4 * x) for path, x in CENTRE.items()),
    Choice("robot.load_share@*", free=True),
    Choice("robot.mass_ratio@*", free=True),
    Choice("surface.*.load_bias", free=True),
    Choice("camera.scale", prior_mean=1.1, prior_std=0.01),
    Choice("camera.marker_yaw", prior_mean=0.0, prior_std=0.05),
]


@dataclass(frozen=True)
class Replicate:
    """One made experiment.

    Attributes:
        names: of the numbers, then of the log variances, then of what a repetition shows.
        truth: of them.
        draws: of them (ensemble, draw, number).
        ratio: std of the draws over that of the prior; NaN for what a repetition shows.
        r_hat: largest of the first stage.
    """

    names: tuple[str, ...]
    truth: np.ndarray
    draws: np.ndarray
    ratio: np.ndarray
    r_hat: float

    @property
    def rank(self) -> np.ndarray:
        """Part of the draws below the truth."""
        return (self.draws < self.truth).mean(axis=(0, 1))

    @property
    def inside(self) -> np.ndarray:
        """Whether the 90 % interval of the draws holds the truth: 91 of 101 ranks."""
        return (self.rank >= 0.05) & (self.rank <= 0.95)


@functools.cache
def problem() -> Problem:
    """What every replicate has in common; its windows say what was driven."""
    blank = robot()
    windows = replace(made(blank, runs=48, count=2), current_var=np.full((48, 2, 3), 1e-3))
    return Problem(windows, blank, CHOICES)


def experiment(seed: int) -> tuple[Fit, np.ndarray]:
    """A truth drawn, windows filled and fitted; the truth of numbers and log variances."""
    rng, common = np.random.default_rng(seed), problem()
    space, typical = common.space, 2 * np.log(common.noise.typical)
    normal = rng.standard_normal(len(typical))
    log_v = typical + VARIANCE_SPREAD * normal
    pooled = common.objective.pooled  # the prior of its root is half-normal
    part = truncnorm.ppf(norm.cdf(normal[pooled]), *POOLED_RANGE)
    log_v[pooled] = typical[pooled] + 2 * np.log(part)
    prior_std = np.asarray(common.objective.prior_std(log_v))
    z = space.prior_mean + prior_std * rng.standard_normal(space.size)
    this = common.of(filled(common, z, log_v, rng))
    optimum = optimise(this)
    return bare_fit(this, optimum), np.concatenate([z, log_v])


def bare_fit(this: Problem, optimum: Optimum) -> Fit:
    """The end of an optimisation as a fit, without curves and what floors were seen with."""
    names, variance = this.noise.names, np.exp(np.asarray(optimum.state.log_variance))
    return Fit(
        space=this.space,
        choices=tuple(CHOICES),
        z=np.asarray(optimum.state.z),
        covariance=optimum.covariance,
        laplace=optimum.covariance,
        variance=dict(zip(names, variance.tolist(), strict=True)),
        variance_unit={},
        runs=(),
        channels=Channels(voltage=True),
        curves={},
        validity={},
        converged=optimum.converged,
        reason=optimum.reason,
        rounds=0,
        remaining=0.0,
        history=(),
        lag=0.0,
        seed=0,
        problem=this,
        optimum=optimum,
    )


def names() -> tuple[str, ...]:
    """Names of the coordinates of a replicate."""
    common = problem()
    noise = (f"noise.{name}" for name in common.noise.names)
    return (*common.space.names, *noise, *PREDICTED)


def replicate(seed: int, plan: Plan = PLAN) -> Replicate:
    """An experiment and draws of its posterior."""
    fit, truth = experiment(seed)
    found = posterior.sampled(fit, replace(plan, seed=seed), DRAWS, None, Reporter(quiet=True))
    draws = np.concatenate([found.z, found.log_variance], axis=-1)
    rng = np.random.default_rng([seed, 3])
    driven = repetition(truth, rng)
    again = np.apply_along_axis(repetition, -1, draws, rng)
    spread = np.full(found.log_variance.shape[-1], VARIANCE_SPREAD)
    prior_std = np.concatenate([fit.space.prior_std, spread, np.full(len(driven), np.nan)])
    draws = np.concatenate([draws, again], axis=-1)
    return Replicate(
        names=names(),
        truth=np.append(truth, driven),
        draws=draws,
        ratio=draws.std(axis=(0, 1)) / prior_std,
        r_hat=float(found.diagnosis.r_hat.max()),
    )


def variance_ranks(seed: int, draws: int = 400) -> np.ndarray:
    """Return the part of the draws of every variance below its truth, in one made experiment."""
    fit, truth = experiment(seed)
    fitted = Fitted.of(fit)
    drawn = drawn_variances(fit.problem, fitted, (PLAN.ensembles, draws), seed)
    return (drawn < truth[fit.space.size :]).mean(axis=(0, 1))


def repetition(numbers: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Motion over some segments if the experiment is done again, with all its noise (prediction,).

    Args:
        numbers: search vector, then log variances.
    """
    common = problem()
    z, log_v = np.split(numbers, [common.space.size])
    increment = np.asarray(_increment(common.space.tree(jnp.asarray(z)), common.batch))
    off = noise(common, "motion", log_v, rng) + shared(common, log_v, rng)
    return (increment - off.reshape(increment.shape))[list(REPEATED.values())].sum(axis=1).ravel()


def filled(common: Problem, z: np.ndarray, log_v: np.ndarray, rng: np.random.Generator):
    """The windows as a robot with these numbers gives them, with the likelihood's own noise."""
    truth, w = common.space.tree(jnp.asarray(z)), common.windows
    clean, start, amps = (np.asarray(x) for x in _predicted(truth, common.batch))
    w = replace(w, pose=_logged(truth, start, clean))
    this = common.of(w)
    gap = noise(this, "motion", log_v, rng) + shared(this, log_v, rng)
    gap = gap.reshape(clean.shape)
    w = replace(w, pose=_logged(truth, start, clean - gap))
    this = common.of(w)
    gap, ammeter = currents(this, log_v, rng)
    flowing = amps + gap.reshape(amps.shape)
    speed = w.turn / w.dt[..., None]
    amps_of_motor = jnp.asarray(flowing - float(truth.motor.current_offset))
    volts = np.asarray(truth.motor.voltage(amps_of_motor, jnp.asarray(speed)))
    return replace(
        w,
        current=flowing + ammeter.reshape(amps.shape),
        voltage=volts + noise(this, "voltage", log_v, rng).reshape(amps.shape),
    )


def currents(
    this: Problem, log_v: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """What flows beside the predicted current, and what the ammeter adds to it (piece, m).

    Pieces differ in how wide both are, so that what is measured is Student t.
    """
    known = np.asarray(this.noise.blocks["current"].known)
    wide = this.covariance("current", jnp.asarray(log_v)) - jax.vmap(jnp.diag)(known)
    heavy = np.sqrt(DEGREES / rng.chisquare(DEGREES, (len(known), 1)))
    root = np.linalg.cholesky(np.asarray(wide))
    gap = np.einsum("nij,nj->ni", root, rng.standard_normal(known.shape))
    return heavy * gap, heavy * np.sqrt(known) * rng.standard_normal(known.shape)


def noise(this: Problem, block: str, log_v: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Residuals of every piece, Student t (piece, m)."""
    root = np.linalg.cholesky(np.asarray(this.covariance(block, jnp.asarray(log_v))))
    normal = rng.standard_normal(root.shape[:2])
    normal *= np.sqrt(DEGREES / rng.chisquare(DEGREES, (len(root), 1)))
    return np.einsum("nij,nj->ni", root, normal)


def shared(this: Problem, log_v: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """What effects that runs share move in the motion residuals of every piece (piece, m)."""
    out = np.zeros(np.asarray(this.noise.blocks["motion"].known).shape)
    for of in this.objective.shared:
        root = np.asarray(of.root(jnp.asarray(log_v)))
        effect = np.einsum("anq,aq->na", root, rng.standard_normal(root.shape[::2]))
        out[np.asarray(of.segments)] = np.einsum("nma,na->nm", np.asarray(of.effect), effect)
    return out


@jax.jit
def _predicted(truth, b):
    p = lk.predict(truth, b)
    return (
        p.increment,
        lk.corrected(truth, b.pose)[:, 0],
        lk.predicted_current(truth, b, p.motor_force),
    )


@jax.jit
def _increment(truth, b):
    return lk.predict(truth, b).increment


@jax.jit
def _logged_of(truth, pose):
    return jax.jit(jax.vmap(jax.vmap(truth.camera.logged)))(pose)


def _logged(truth, start, increment):
    return np.asarray(_logged_of(truth, chain(jnp.asarray(start), jnp.asarray(increment))))


def row(found: Replicate) -> dict[str, object]:
    """What is kept of a replicate, as JSON holds it."""
    return {
        "names": list(found.names),
        "rank": found.rank.tolist(),
        "inside": found.inside.tolist(),
        "ratio": found.ratio.tolist(),
        "r_hat": found.r_hat,
    }


def band(count: int, numbers: int, inside: float = 0.9, sure: float = 0.99) -> tuple[float, float]:
    """Shares of intervals that hold the truth, in which all of so many numbers are, so surely."""
    alpha = (1 - sure) / numbers
    low, high = binom.ppf((alpha / 2, 1 - alpha / 2), count, inside)
    return float(low) / count, float(high) / count
