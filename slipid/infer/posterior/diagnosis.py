"""Draws of a posterior, the estimates from them, and the convergence of its chains.

The module does not import the sampler; modules for showing, deploying and writing a posterior are
loaded by the methods that need them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from slipid.infer import slip_curves as curves_of
from slipid.infer.fit_file import curves_json, identified_json, number_json
from slipid.infer.held_out import doubted
from slipid.infer.posterior.blocks import Chain, Plan, require_packages
from slipid.infer.result import Fit, required
from slipid.infer.verdicts import estimates as verdicts
from slipid.infer.verdicts.disputed import marked
from slipid.infer.verdicts.unidentified import members
from slipid.support.content import Content

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from xarray import DataTree

    from slipid.robot.deployed import DeployedRobot


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """Convergence of chains, by coordinate and overall.

    Attributes:
        r_hat: rank-normalised split R-hat over ensembles (Vehtari et al. 2021).
        tau: integrated autocorrelation time [step].
        bulk, tail: effective number of draws for the bulk, and for the 5 % and 95 % quantiles.
        steps: number of steps of every walker after the warm-up.
        converged: True if every coordinate meets the criteria of the plan.
        worst: index of the coordinate that is furthest from meeting a criterion.
        reason: value of that criterion for this coordinate, as a string.
        excess: ratio of the steps that this criterion needs to those that were made.
    """

    r_hat: Float[np.ndarray, " size"]
    tau: Float[np.ndarray, " size"]
    bulk: Float[np.ndarray, " size"]
    tail: Float[np.ndarray, " size"]
    steps: int
    converged: bool
    worst: int
    reason: str
    excess: float

    @property
    def ess(self) -> Float[np.ndarray, " size"]:
        """Effective number of draws: the smaller of `bulk` and `tail`."""
        return np.minimum(self.bulk, self.tail)

    def against(self, plan: Plan, names: Sequence[str]) -> str:
        """Return the values of the worst coordinates and those that the plan asks for."""
        least = int(np.argmin(self.ess))
        return (
            f"R-hat {self.r_hat.max():.4f} (< {plan.r_hat}), {names[least]}: "
            f"{self.bulk[least]:.0f} effective draws of its bulk and {self.tail[least]:.0f} of its "
            f"tails (> {plan.least_draws:.0f})"
        )


@dataclass(frozen=True, eq=False)
class Posterior:
    """Posterior of a fit; `print` shows its parameters and the convergence of its chains.

    Attributes:
        fit: fit around which the chains were started.
        z: draws of the search vector, widened by what uncertain variances add.
        log_variance: draws of the log variances.
        log_prob: log density of the parameters that were sampled by chains: all parameters, or the
            motion parameters if currents were logged, at the positions of the chains, before the
            draws are widened.
        names: names of the coordinates that were sampled by chains.
        diagnosis: convergence of the chains.
        accepted: fraction of accepted moves, keyed by part of the posterior.
        converged: True if the chains converged and few electric draws refused nearly all
            proposals.
        reason: value of the criterion that is furthest from being met, as a string.
    """

    fit: Fit
    z: Float[np.ndarray, "ensemble draw free"]
    log_variance: Float[np.ndarray, "ensemble draw variance"]
    log_prob: Float[np.ndarray, "ensemble draw"]
    names: tuple[str, ...]
    diagnosis: Diagnosis
    accepted: dict[str, float]
    converged: bool
    reason: str

    def __str__(self) -> str:
        from slipid.report.estimates import show_posterior
        from slipid.report.page import text_of

        return text_of(show_posterior, self)

    @cached_property
    def parameters(self) -> dict[str, verdicts.Estimate]:
        """Parameters, keyed by path, with mean, interval and verdict from the draws."""
        return estimates(self.fit, self.z)

    @property
    def flat(self) -> Float[np.ndarray, "draw free"]:
        """Draws of all ensembles in one array."""
        return self.z.reshape(-1, self.fit.space.size)

    @property
    def messages(self) -> tuple[str, ...]:
        """Warnings about the convergence of the chains and the fit, one sentence each."""
        warning = f"the posterior did not converge: {self.reason}"
        return (() if self.converged else (warning,)) + self.fit.messages

    def draws(self, path: str) -> Float[np.ndarray, "ensemble draw *number"]:
        """Return draws of a free parameter [SI], one row per ensemble, early steps first.

        Raises:
            KeyError: the parameter does not exist or is fixed; the message lists all free ones.
        """
        space = self.fit.space
        if path not in space.slices:
            raise KeyError(f"no draws of '{path}'; there are {', '.join(space.slices)}")
        d = next(e.declaration for e in space.free if e.path == path)
        found = jax.vmap(jax.vmap(d.to_si))(jnp.asarray(self.z[..., space.slices[path]]))
        return np.asarray(found if d.constrained else found[..., 0])

    @cached_property
    def tree(self) -> "DataTree":
        """ArviZ DataTree of draws, likelihoods and replicated data."""
        require_packages()
        from slipid.infer.posterior import sample as netcdf

        return netcdf.tree(self)

    def plot(self, name: str = "intervals") -> "Figure":
        """Draw one of the posterior's figures.

        Args:
            name: `intervals` of every parameter, or `pairs` with the most curved dependence.

        Raises:
            ValueError: there is no such figure.
        """
        from slipid.plots.posterior import FIGURES

        if name not in FIGURES:
            raise ValueError(f"no figure '{name}'; there are {', '.join(FIGURES)}")
        return FIGURES[name](self)

    def deploy(self) -> "DeployedRobot":
        """Return the model for the robot, with the intervals of the draws.

        Raises:
            ValueError: the wheels' kinematics have rank below 3.
        """
        from slipid.deploy.deploy import deploy

        return deploy(self)

    def save(self, path: Path | str) -> None:
        """Write posterior.nc completely or not at all."""
        require_packages()
        from slipid.infer.posterior import sample as netcdf

        netcdf.write(self.tree, Path(path))


def diagnose(chain: Chain, plan: Plan) -> Diagnosis:
    """Return the convergence of chains whose warm-up was removed; requires arviz-stats."""
    from arviz_stats.base import array_stats

    ensembles, steps, walkers, size = chain.shape
    tau = autocorrelation_time(chain)
    by_ensemble = chain.reshape(ensembles, steps * walkers, size)
    by_walker = chain.transpose(0, 2, 1, 3).reshape(ensembles * walkers, steps, size)
    r_hat = array_stats.rhat(by_ensemble, chain_axis=0, draw_axis=1, method="rank")
    bulk = array_stats.ess(by_walker, chain_axis=0, draw_axis=1, method="bulk")
    tail = array_stats.ess(by_walker, chain_axis=0, draw_axis=1, method="tail", prob=(0.05, 0.95))
    ess = np.minimum(bulk, tail)
    criteria = [
        (np.nan_to_num(r_hat - 1, nan=np.inf) / (plan.r_hat - 1), r_hat, "R-hat {:.4f}"),
        (plan.steps_per_tau * tau / steps, steps / tau, "{:.0f} steps per autocorrelation time"),
        (plan.least_draws / ess, ess, "{:.0f} effective draws"),
    ]
    excess, values, text = max(criteria, key=lambda criterion: float(np.max(criterion[0])))
    worst = int(np.argmax(excess))
    converged = bool(excess[worst] < 1)
    reason = text.format(values[worst])
    return Diagnosis(
        r_hat=np.asarray(r_hat),
        tau=tau,
        bulk=np.asarray(bulk),
        tail=np.asarray(tail),
        steps=steps,
        converged=converged,
        worst=worst,
        reason=reason,
        excess=float(excess[worst]),
    )


def autocorrelation_time(chain: Chain) -> Float[np.ndarray, " size"]:
    """Return the integrated autocorrelation time of every coordinate [step].

    Autocovariances are relative to the mean of all walkers, so that a walker at rest lengthens the
    time; their sum ends at the first lag M with M >= 5 tau (Sokal 1996).
    """
    steps = chain.shape[1]
    about = chain - chain.mean(axis=(0, 1, 2))
    spectrum = np.abs(np.fft.rfft(about, 2 * steps, axis=1)) ** 2
    covariance = np.fft.irfft(spectrum.mean(axis=(0, 2)), axis=0)[:steps]
    # The sum at a lag has as many terms as pairs of steps, which decrease with the lag.
    correlation = covariance / np.arange(steps, 0, -1)[:, None]
    sums = 2 * np.cumsum(correlation / correlation[0], axis=0) - 1
    enough = np.arange(steps)[:, None] >= 5 * sums
    window = np.where(enough.any(axis=0), enough.argmax(axis=0), steps - 1)
    return np.asarray(np.maximum(sums[window, np.arange(sums.shape[1])], 1e-3))


def estimates(
    fit: Fit, draws: Float[np.ndarray, "ensemble draw free"]
) -> dict[str, verdicts.Estimate]:
    """Return every parameter with mean, interval and verdict from the draws of a posterior.

    Means are taken in the search space, so that load fractions sum to one and means of positive
    parameters are geometric. Flat directions are those of the fit.
    """
    every, flat = draws.reshape(-1, fit.space.size), members(fit.flat)
    out, space = dict(fit.parameters), fit.verdict_space
    for e in space.free:
        at, d, old = space.slices[e.path], e.declaration, fit.parameters[e.path]
        z = every[:, at]
        mean, block = z.mean(axis=0), np.cov(z.T).reshape(e.coordinates, e.coordinates)
        no_scale = e.path in verdicts.NEEDS_VOLTAGE and not fit.channels.voltage
        forced = old.verdict if no_scale or old.verdict == "at_bound" else None
        prior = space.prior_mean[at], space.prior_std[at]
        base = replace(old, value=verdicts.plain(d.to_si(mean)))
        is_flat = e.path in flat
        out[e.path] = verdicts.judged(base, d, mean, block, prior, forced, is_flat, z)
    return doubted(marked(out, fit.disputes), fit.held_out)


def identified(found: Posterior) -> Content:
    """Return the content of identified.json with the estimates of the posterior."""
    fit, flat = found.fit, found.flat
    content = identified_json(fit)
    for path, e in found.parameters.items():
        content["parameters"][path] = number_json(e)
    z, covariance, volts = flat.mean(axis=0), np.cov(flat.T), fit.channels.voltage
    ratios = verdicts.derived(fit.space, z, covariance, volts, flat)
    judged = doubted({e.path: e for e in ratios}, fit.held_out)
    content["derived"] = {path: number_json(e) for path, e in judged.items()}
    some = flat[:: max(1, len(flat) // 400)]
    curves = curves_of.curves(fit.space, z, some, required(fit.problem).batch)
    return content | {"curves": curves_json(curves), "messages": list(found.messages)}
