"""Draws of a posterior, what they say of a robot, and whether its chains may be believed.

Needs nothing that samples; what shows, deploys or writes a posterior is loaded by its methods.
"""

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
from slipid.infer.posterior.blocks import Chain, Plan
from slipid.infer.result import Fit, required
from slipid.infer.verdicts import estimates as verdicts
from slipid.infer.verdicts.disputed import marked
from slipid.infer.verdicts.unidentified import members
from slipid.support.files import Content

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from xarray import DataTree

    from slipid.robot.deployed import DeployedRobot


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """Whether chains may be believed, per coordinate; the worst is furthest from the plan's bars.

    R-hat is rank-normalised and split, over ensembles (Vehtari et al. 2021), tau the integrated
    autocorrelation time [steps], ess the effective draws, the fewer of bulk and tails. Steps are
    those of every walker after the warm-up.
    """

    r_hat: Float[np.ndarray, " size"]
    tau: Float[np.ndarray, " size"]
    ess: Float[np.ndarray, " size"]
    steps: int
    converged: bool
    worst: int
    reason: str


@dataclass(frozen=True, eq=False)
class Posterior:
    """Posterior of a fit; `print` shows its numbers and whether the chains agree.

    Log density, names and diagnosis are of the numbers that are sampled first; accepted is the part
    of the moves that moved something, by stage.

    Attributes:
        fit: that was sampled around.
        z, log_variance: draws of the search vector and of the noise.
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
        """Every number by path, with mean, interval and verdict from the draws."""
        return estimates(self.fit, self.z)

    @property
    def flat(self) -> Float[np.ndarray, "draw free"]:
        """The draws of all ensembles."""
        return self.z.reshape(-1, self.fit.space.size)

    @property
    def messages(self) -> tuple[str, ...]:
        """What a reader of the numbers must know, one sentence each."""
        doubt = f"the posterior did not converge: {self.reason}"
        return self.fit.messages + (() if self.converged else (doubt,))

    def draws(self, path: str) -> Float[np.ndarray, "ensemble draw *number"]:
        """Draws of a free number [SI], a row per ensemble, early steps first.

        Raises:
            KeyError: no such number, or fixed; names those there are.
        """
        space = self.fit.space
        if path not in space.slices:
            raise KeyError(f"no draws of '{path}'; there are {', '.join(space.slices)}")
        d = next(e.declaration for e in space.free if e.path == path)
        found = jax.vmap(jax.vmap(d.to_si))(jnp.asarray(self.z[..., space.slices[path]]))
        return np.asarray(found if d.constrained else found[..., 0])

    @cached_property
    def tree(self) -> "DataTree":
        """Draws, likelihoods and replicated data as an ArviZ DataTree."""
        from slipid.infer.posterior import sample as netcdf

        return netcdf.tree(self)

    def plot(self, name: str = "intervals") -> "Figure":
        """One of the posterior's pictures.

        Args:
            name: `intervals` of every number, or `pairs` that are bent the most.

        Raises:
            ValueError: no such picture.
        """
        from slipid.plots.posterior import PICTURES

        if name not in PICTURES:
            raise ValueError(f"no picture '{name}'; there are {', '.join(PICTURES)}")
        return PICTURES[name](self)

    def deploy(self) -> "DeployedRobot":
        """What runs on the robot, with the intervals of the draws.

        Raises:
            ValueError: the wheels' kinematics have rank below 3.
        """
        from slipid.deploy.deploy import deploy

        return deploy(self)

    def save(self, path: Path | str) -> None:
        """Write posterior.nc, whole or not at all."""
        from slipid.infer.posterior import sample as netcdf

        netcdf.write(self.tree, Path(path))


def diagnose(chain: Chain, plan: Plan) -> Diagnosis:
    """Diagnosis of chains without their warm-up; ImportError where arviz-stats is missing."""
    from arviz_stats.base import array_stats

    ensembles, steps, walkers, size = chain.shape
    tau = autocorrelation_time(chain)
    by_ensemble = chain.reshape(ensembles, steps * walkers, size)
    by_walker = chain.transpose(0, 2, 1, 3).reshape(ensembles * walkers, steps, size)
    r_hat = array_stats.rhat(by_ensemble, chain_axis=0, draw_axis=1, method="rank")
    ess = np.minimum(
        array_stats.ess(by_walker, chain_axis=0, draw_axis=1, method="bulk"),
        array_stats.ess(by_walker, chain_axis=0, draw_axis=1, method="tail", prob=(0.05, 0.95)),
    )
    bars = [
        (np.nan_to_num(r_hat - 1, nan=np.inf) / (plan.r_hat - 1), r_hat, "R-hat {:.4f}"),
        (plan.steps_per_tau * tau / steps, steps / tau, "{:.0f} steps per autocorrelation time"),
        (plan.least_draws / ess, ess, "{:.0f} effective draws"),
    ]
    short, values, said = max(bars, key=lambda bar: float(np.max(bar[0])))
    worst = int(np.argmax(short))
    converged = bool(short[worst] < 1)
    reason = said.format(values[worst])
    return Diagnosis(np.asarray(r_hat), tau, np.asarray(ess), steps, converged, worst, reason)


def autocorrelation_time(chain: Chain) -> Float[np.ndarray, " size"]:
    """Integrated autocorrelation time of every coordinate [steps].

    Autocovariances are about the mean of all walkers, so that one that stands still counts as what
    it is; the window is the first with M >= 5 tau (Sokal 1996).
    """
    steps = chain.shape[1]
    about = chain - chain.mean(axis=(0, 1, 2))
    spectrum = np.abs(np.fft.rfft(about, 2 * steps, axis=1)) ** 2
    covariance = np.fft.irfft(spectrum.mean(axis=(0, 2)), axis=0)[:steps]
    # each lag has its own number of pairs
    correlation = covariance / np.arange(steps, 0, -1)[:, None]
    sums = 2 * np.cumsum(correlation / correlation[0], axis=0) - 1
    enough = np.arange(steps)[:, None] >= 5 * sums
    window = np.where(enough.any(axis=0), enough.argmax(axis=0), steps - 1)
    return np.asarray(np.maximum(sums[window, np.arange(sums.shape[1])], 1e-3))


def estimates(
    fit: Fit, draws: Float[np.ndarray, "ensemble draw free"]
) -> dict[str, verdicts.Estimate]:
    """Every number with mean, interval and verdict from the draws of a posterior.

    Means are taken in the search space, so that shares sum to one and positive numbers have their
    geometric mean. Directions that the fit found open stay so.
    """
    flat, open_ = draws.reshape(-1, fit.space.size), members(fit.flat)
    out, prior_std = dict(fit.parameters), fit.verdict_space.prior_std
    for e in fit.space.free:
        at, d, old = fit.space.slices[e.path], e.declaration, fit.parameters[e.path]
        z = flat[:, at]
        values = np.asarray(jax.vmap(d.to_si)(jnp.asarray(z)))
        low, high = np.quantile(values, [0.05, 0.95], axis=0)
        scaled = np.cov((z / prior_std[at]).T).reshape(e.coordinates, e.coordinates)
        ratio = float(np.sqrt(np.linalg.eigvalsh(scaled)[-1]))
        pairs = tuple(zip(low.tolist(), high.tolist(), strict=True))
        unsaid = e.path in verdicts.NEEDS_VOLTAGE and not fit.channels.voltage
        forced = old.verdict if unsaid or old.verdict == "at_bound" else None
        from_zero = verdicts.from_zero(d, z.std(axis=0))
        verdict, provenance = verdicts.verdict_of(ratio, from_zero, forced, e.path in open_)
        pull = (z.mean(axis=0) - fit.space.prior_mean[at]) / prior_std[at]
        out[e.path] = replace(
            old,
            value=verdicts.plain(d.to_si(jnp.asarray(z.mean(axis=0)))),
            std=verdicts.plain(values.std(axis=0)),
            interval90=pairs[0] if len(pairs) == 1 else pairs,
            ratio=ratio,
            verdict=verdict,
            provenance=provenance,
            pull=float(pull[np.argmax(np.abs(pull))]),
            source="posterior",
        )
    return marked(out, fit.disputes)


def identified(found: Posterior) -> Content:
    """Content of identified.json with what the posterior says."""
    fit, flat = found.fit, found.flat
    content = identified_json(fit)
    for path, e in found.parameters.items():
        content["parameters"][path] = number_json(e)
    ratios = verdicts.derived(fit.space, flat.mean(axis=0), np.cov(flat.T), fit.channels.voltage)
    content["derived"] = {e.path: number_json(_drawn(e, fit, flat)) for e in ratios}
    some = flat[:: max(1, len(flat) // 400)]
    curves = curves_of.curves(fit.space, flat.mean(axis=0), some, required(fit.problem).batch)
    return content | {"curves": curves_json(curves), "messages": list(found.messages)}


def _drawn(ratio: verdicts.Estimate, fit: Fit, flat: np.ndarray) -> verdicts.Estimate:
    """A quotient with the interval and the std of its draws."""
    over, under = (fit.space.slices[path] for path in ratio.path.rsplit("/", 1))
    draws = np.exp(flat[:, over] - flat[:, under])
    low, high = np.quantile(draws, [0.05, 0.95]).tolist()
    std = float(draws.std())
    return replace(ratio, std=std, interval90=(low, high), source="posterior")
