"""Scores of predicted runs, the same for every slip model."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.special import fdtr

from slipid.fitting.variances import DEGREES

CLUSTER_DEG = 30.0
"""Width of the sectors of headings over which standard errors are clustered [deg].

The errors of runs in neighbouring headings are correlated: by 0.5 at 5 degrees and not at all at
30 degrees.
"""


@dataclass(frozen=True)
class Score:
    """Errors of a model's prediction of a run.

    Attributes:
        predicted_end: predicted pose at the end, x, y [m] and yaw [rad].
        endpoint_error: distance between predicted and measured end point, divided by the measured
            chord (straight-line displacement).
        endpoint_error_over_path: distance between predicted and measured end point, divided by the
            measured path length; unlike `endpoint_error` it is meaningful on closed paths, too.
        length_error: relative error of the chord.
        heading_error_deg: error of the final heading, at most 180 [deg].
        level: probability of the predicted region on whose boundary the measured end point lies,
            None for a model without regions.
        covered90: True if the level is at most 0.9, None for a model without regions.
        energy_score: energy score of the predicted distribution of the end point, a proper score
            (Gneiting and Raftery 2007); for a single predicted point it is the distance [m].
        log_density: log density of the logged poses [nats], None if it was not computed.
    """

    predicted_end: Sequence[float]
    endpoint_error: float
    endpoint_error_over_path: float
    length_error: float
    heading_error_deg: float
    level: float | None
    covered90: bool | None
    energy_score: float
    log_density: float | None = None


def scores(
    predicted: Float[np.ndarray, "run edge 3"],
    measured: Float[np.ndarray, "run edge 3"],
    cov: Float[np.ndarray, "run 2 2"] | None,
    freedom: float = DEGREES,
) -> list[Score]:
    """Return the score of every predicted path; paths begin at the measured start.

    Args:
        predicted, measured: poses x, y [m] and yaw [rad] in one frame.
        cov: scale matrices of the end points' Student t [m^2], None for a model without
            uncertainty.
        freedom: degrees of freedom of the Student t, infinite for a Gaussian.
    """
    gap = predicted[:, -1] - measured[:, -1]
    off = np.linalg.norm(gap[:, :2], axis=1)
    turn = np.abs(np.degrees(np.angle(np.exp(1j * gap[:, 2]))))
    level, energy = forecast(gap[:, :2], cov, freedom)
    whole, ahead = chords(measured), chords(predicted)
    return [
        Score(
            predicted_end=predicted[n, -1].tolist(),
            endpoint_error=float(off[n]) / max(whole[n], 1e-9),
            endpoint_error_over_path=float(off[n]) / max(length, 1e-9),
            length_error=abs(ahead[n] / max(whole[n], 1e-9) - 1.0),
            heading_error_deg=float(turn[n]),
            level=None if level is None else float(level[n]),
            covered90=None if level is None else bool(level[n] <= 0.9),
            energy_score=float(energy[n]),
        )
        for n, length in enumerate(lengths(measured))
    ]


def chords(path: Float[np.ndarray, "run edge 3"]) -> list[float]:
    """Return the straight-line displacement of every path [m]."""
    return list(np.linalg.norm((path[:, -1] - path[:, 0])[:, :2], axis=1).tolist())


def lengths(path: Float[np.ndarray, "run edge 3"]) -> list[float]:
    """Return the length of every path, as the sum over its steps [m]."""
    return list(np.linalg.norm(np.diff(path[..., :2], axis=1), axis=2).sum(axis=1).tolist())


def forecast(
    gap: Float[np.ndarray, "run 2"],
    cov: Float[np.ndarray, "run 2 2"] | None,
    freedom: float = DEGREES,
) -> tuple[np.ndarray | None, np.ndarray]:
    """Return the level of every measured end point, and its energy score [m].

    The level is the probability of the predicted region on whose boundary the end point lies; an
    end point lies in the 90 % region if the level is at most 0.9. The predictive distribution is a
    Student t with scale matrix `cov` and `freedom` degrees of freedom. If `cov` is None, there is
    no level, and the energy score is the distance itself, as for a point forecast. Source: Gneiting
    and Raftery 2007, JASA 102, eq. 22.
    """
    if cov is None:
        return None, np.linalg.norm(gap, axis=1)
    q = np.einsum("ni,nij,nj->n", gap, np.linalg.inv(cov), gap)
    rng = np.random.default_rng(0)
    normal = rng.normal(size=(500, 2))
    if np.isfinite(freedom):
        level = fdtr(2, freedom, q / 2)
        normal /= np.sqrt(rng.chisquare(freedom, (500, 1)) / freedom)
    else:
        level = -np.expm1(-q / 2)
    draws = np.einsum("nij,kj->nki", np.linalg.cholesky(cov), normal)
    near = np.linalg.norm(draws - gap[:, None], axis=2).mean(axis=1)
    apart = np.linalg.norm(draws[:, :250] - draws[:, 250:], axis=2).mean(axis=1)
    return level, near - 0.5 * apart


def clusters(heading_deg: Sequence[float | None]) -> Int[np.ndarray, " run"]:
    """Return the index of each run's sector of headings.

    Every run without a heading is a separate sector, with a negative index.
    """
    return np.array(
        [
            -1 - k if h is None or not np.isfinite(h) else int((h % 360.0 + 1e-6) // CLUSTER_DEG)
            for k, h in enumerate(heading_deg)
        ]
    )


def mean_error(
    value: Float[np.ndarray, " run"], cluster: Int[np.ndarray, " run"]
) -> tuple[float, float, float]:
    """Return the mean, its standard error over runs, and its standard error over clusters.

        se^2 = G / (G - 1) sum_g (sum_{i in g} (x_i - mean))^2 / n^2

    G is the number of clusters g; for the error over runs, every run is a cluster. Source: Cameron
    and Miller 2015, J. Human Resources 50, for a regression on a constant. With one run, or one
    cluster, the error cannot be estimated and is nan.
    """
    n = len(value)
    gap = value - value.mean()
    sums = np.bincount(np.unique(cluster, return_inverse=True)[1], weights=gap)

    def error(parts: np.ndarray) -> float:
        g = len(parts)
        return float(np.sqrt(g / (g - 1) * np.sum(parts**2)) / n) if g > 1 else float("nan")

    return float(value.mean()), error(gap), error(sums)


def main_load(loads: Sequence[str]) -> str:
    """Return the load set-up `as_built` if it occurs, else the most common one."""
    return "as_built" if "as_built" in loads else max(sorted(set(loads)), key=loads.count)


def setups(floors: Sequence[str], loads: Sequence[str]) -> list[str]:
    """Return the floor of each run, or `floor@load` if its load set-up is not the main one."""
    main = main_load(loads)
    return [f if load == main else f"{f}@{load}" for f, load in zip(floors, loads, strict=True)]
