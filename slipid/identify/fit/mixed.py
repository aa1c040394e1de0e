"""Runs over several floors, as a second stage after a fit of runs that each kept to one.

How hard a floor grips is not to be seen where all wheels stand on it: the forces balance whatever
they are in units of. Where wheels stand on different floors the ratio of their frictions turns the
robot. The first fit is the prior, a Gaussian of its search vector, whose flat directions these runs
inform; with J the slope of the residuals r of short windows,

    information = C^-1 + sum_c J_c^T W J_c / (f_c v_c)

over along, across, yaw and currents. Variances v and Student-t weights W are those of the
residuals. Neighbouring windows err alike (a floor that is uneven, a body that still speeds up), so
each channel counts for its windows over f, what the residuals' correlation makes of their number:
without it the intervals would be too narrow. It knows correlation within runs, no bias that all
runs share. The camera keeps what the first fit knew of it, its uncertainty carried along: what the
contact law lacks would bend a length sooner than a lens does.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from slipid.identify.fit.crossing import CHANNELS, Crossing, Evidence, Scatter, scatter
from slipid.identify.fit.variances import Search, Square
from slipid.search_space import Space

TOLERANCE = 0.02
"""Settled when a step is at most so many posterior stds."""
_GAIN, _IDLE = 0.1, 6
"""Or when so many steps on end have gained less than this in log density."""
_MOST_STEPS, _FACTOR_STEPS, _TRIES = 40, 4, 8
UNITS = ("m/s", "m/s", "rad/s", "A")
"""Of the channels of `crossing` and of currents."""


@dataclass(frozen=True, eq=False)
class Update:
    """What runs over several floors make of a fit.

    Information is what was added to the inverse covariance; variances are of the residuals by
    channel, `mixed.yaw` and so on, units of their stds. `about` tells runs, windows, root mean
    square errors before and after, correlation factors.
    """

    z: Search
    covariance: Square
    information: Square
    variance: Mapping[str, float]
    unit: Mapping[str, str]
    runs: tuple[tuple[str, str], ...]
    settled: bool
    about: Mapping[str, Any]


class _Found(NamedTuple):
    """End of the steps: where, what the data added, how residuals scatter there."""

    z: np.ndarray
    information: np.ndarray
    scatter: Scatter
    settled: bool


def _maximise(e: Evidence, mean: np.ndarray, covariance: np.ndarray) -> _Found:
    """Levenberg-Marquardt steps from the prior mean; scatter anew at each."""
    prior, z, settled = np.linalg.inv(covariance), np.asarray(mean, float), False
    moving = ~held(e.space)
    factor: np.ndarray | None = None
    damping, idle = 0.0, 0
    for turn in range(_MOST_STEPS):
        r, slope = e.linear(z)
        found = scatter(r, e.pieces, factor)
        factor = found.factor if turn >= _FACTOR_STEPS else None
        count = found.counted(found.weight)
        gradient = (np.einsum("nc,nc,ncp->p", count, r, slope) + prior @ (z - mean))[moving]
        hessian = (_gram(slope, count) + prior)[np.ix_(moving, moving)]
        std = np.sqrt(np.diag(np.linalg.inv(hessian)))
        settled = bool((np.abs(np.linalg.solve(hessian, gradient)) <= TOLERANCE * std).all())
        settled |= idle >= _IDLE  # on a bent ridge no whole step is small, yet none gains
        if settled:
            break

        def loss(x: np.ndarray, count: np.ndarray = count) -> float:
            away = x - mean
            return float(0.5 * (count * e.residual(x) ** 2).sum() + 0.5 * away @ prior @ away)

        now = loss(z)
        for _ in range(_TRIES):
            step = np.zeros_like(z)
            damped = hessian + damping * np.diag(np.diag(hessian))
            step[moving] = -np.linalg.solve(damped, gradient)
            # beyond two in a logarithm nothing is linear
            step *= min(1.0, 2.0 / np.abs(step).max())
            expected = -(gradient @ step[moving] + 0.5 * step[moving] @ hessian @ step[moving])
            gained = (now - loss(z + step)) / max(expected, 1e-12)
            if gained > 0.7:
                damping /= 4
            elif gained < 0.3:
                damping = max(4 * damping, 0.01)
            if gained > 0:
                z = z + step
                idle = idle + 1 if gained * expected < _GAIN else 0
                break
        else:
            idle += 1
    return _Found(z, _gram(slope, found.counted(found.expected)), found, settled)


def _gram(slope: np.ndarray, count: np.ndarray) -> Square:
    flat = (np.sqrt(count)[..., None] * slope).reshape(-1, slope.shape[-1])
    return np.asarray(flat.T @ flat)


def held(space: Space) -> Bool[np.ndarray, " free"]:
    """Coordinates that keep what the first fit knew of them."""
    return space.where(lambda e: e.part == "camera")


def informed(space: Space, covariance: np.ndarray, information: np.ndarray) -> Square:
    """Covariance after more information on all numbers but the camera's, given these.

    With h held and m the others, H = C^-1 + information: C_hh stays, z_m = -H_mm^-1 H_mh z_h + e.
    """
    h = held(space)
    total = np.linalg.inv(covariance) + information
    own = np.linalg.inv(total[np.ix_(~h, ~h)])
    carried = -own @ total[np.ix_(~h, h)]
    both = carried @ covariance[np.ix_(h, h)]
    out = covariance.copy()
    out[np.ix_(~h, h)], out[np.ix_(h, ~h)] = both, both.T
    out[np.ix_(~h, ~h)] = own + both @ carried.T
    return out


def update(
    space: Space, mean: np.ndarray, covariance: np.ndarray, sets: Sequence[Crossing]
) -> Update:
    """Posterior of the search vector given windows over several floors.

    Errors `before` and `after` are of runs left out: each half of the runs is judged by what the
    other half made of the fit. A single run has no `after`. Mean and covariance are of the fit
    without these runs, sets of every map.
    """
    e = Evidence(space, sets)
    found = _maximise(e, mean, covariance)
    before, after = _left_out(space, mean, covariance, sets)
    names = [*CHANNELS, "current"][: len(CHANNELS) + bool(e.pieces.has_current.any())]
    runs = tuple(run for s in sets for run in s.runs)
    return Update(
        z=found.z,
        covariance=informed(space, covariance, found.information),
        information=found.information,
        variance={f"mixed.{n}": float(found.scatter.variance[k]) for k, n in enumerate(names)},
        unit={f"mixed.{n}": unit for n, unit in zip(names, UNITS, strict=False)},
        runs=runs,
        settled=found.settled,
        about={
            "runs": len(runs),
            "windows": len(e.pieces.run),
            "before": before,
            "after": after,
            "correlation": {n: float(found.scatter.factor[k]) for k, n in enumerate(names)},
        },
    )


def _left_out(
    space: Space, mean: np.ndarray, covariance: np.ndarray, sets: Sequence[Crossing]
) -> tuple[dict[str, float], dict[str, float] | None]:
    """Errors before, and after learning from the other half of the runs of each set."""
    halves = [[s.of((s.windows.run + j) % 2 == k) for j, s in enumerate(sets)] for k in range(2)]
    ends = [Evidence(space, h) for h in halves if sum(len(s.windows) for s in h)]
    has = np.concatenate([e.pieces.has_current for e in ends])
    before = errors(np.concatenate([e.residual(mean) for e in ends]), has)
    if len(ends) < 2:
        return before, None
    learnt = [_maximise(e, mean, covariance).z for e in ends]
    after = [e.residual(z) for e, z in zip(ends, learnt[::-1], strict=True)]
    return before, errors(np.concatenate(after), has)


def errors(r: Float[np.ndarray, "window channel"], has_current: np.ndarray) -> dict[str, float]:
    """Root mean squares: `speed` [m/s], `yaw_rate` [rad/s] and, where logged, `current` [A]."""
    found = {
        "speed": float(np.sqrt((r[:, :2] ** 2).sum(axis=1).mean())),
        "yaw_rate": float(np.sqrt((r[:, 2] ** 2).mean())),
    }
    if has_current.any():
        found["current"] = float(np.sqrt((r[has_current, len(CHANNELS) :] ** 2).mean()))
    return found
