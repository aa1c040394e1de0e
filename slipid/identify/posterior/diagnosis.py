"""Draws of a posterior, and whether its chains may be believed; needs nothing that samples."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from slipid.identify.posterior.blocks import Chain, Plan
from slipid.identify.posterior.coordinates import Fitted


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
    """Draws, and whether and why they may be believed.

    Effects are what runs of a session share, in stds. Log density, names and diagnosis are of the
    first stage; accepted is the part of the moves that moved something, by stage. Of the second
    stage's walkers, still is the part with a group that never moved, unsettled the worst drift or
    memory, 1 where it is just enough.
    """

    z: Float[np.ndarray, "ensemble draw free"]
    log_variance: Float[np.ndarray, "ensemble draw variance"]
    effects: Float[np.ndarray, "ensemble draw effect"]
    fitted: Fitted
    log_prob: Float[np.ndarray, "ensemble draw"]
    names: tuple[str, ...]
    diagnosis: Diagnosis
    accepted: dict[str, float]
    still: float
    unsettled: float
    converged: bool
    reason: str


def diagnose(chain: Chain, plan: Plan) -> Diagnosis:
    """Diagnosis of chains without their warm-up.

    Raises:
        ImportError: arviz-stats is not installed.
    """
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
