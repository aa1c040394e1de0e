"""Profile likelihood of one parameter: the loss as a function of it, all other parameters refitted.

With f minus the log posterior, theta the parameter and eta all other parameters,

    F(theta) = min over eta of f(theta, eta),    D(theta) = F(theta) - F at its minimum

D is half the squared distance from the estimate in stds if the Laplace approximation holds. The
90 % interval of the likelihood is the range in which D, without the term of the parameter's own
prior, is below chi2_1(0.9) / 2 = 1.353. A profile that remains level shows that the parameter is
not identifiable.

Source: Venzon and Moolgavkar 1988 (Applied Statistics 37(1)); Raue et al. 2009 (Bioinformatics
25(15)).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.stats import chi2

from slipid.fitting.optimise import Optimum, optimise
from slipid.fitting.problem import FitState, Problem
from slipid.fitting.variances import MOTION_BLOCKS
from slipid.infer.verdicts.estimates import NEEDS_VOLTAGE
from slipid.parameter import Entry
from slipid.search_space import Space

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RISE = float(chi2.ppf(0.9, 1)) / 2
"""Rise of minus log likelihood, above its minimum, at the ends of the 90 % interval."""
_COMPLETE_RISE, _LARGEST_RISE = 1.5 * RISE, 3 * RISE
"""Rise at which one side of a profile is complete, and largest rise of its last point: if the last
point exceeds this rise and the point before lies within the interval, the last step is halved."""
_FARTHEST = 3.0
"""A side is computed up to this distance from the prior mean [prior std] or from the estimate
[Laplace std], whichever reaches farther."""
_SHORTEST_STEP, _MOST_POINTS = 0.1, 24
"""Shortest step that is still halved [Laplace std], and largest number of points on a side."""


@dataclass(frozen=True)
class Profile:
    """Profile likelihood of one parameter; `print` shows its result in one sentence.

    Attributes:
        path: name of the parameter.
        unit: unit of the parameter.
        value: values at which the parameter was fixed, in rising order [unit].
        posterior: D at each value, with the parameter's own prior.
        likelihood: D at each value without the parameter's own prior, 0 at its minimum.
        laplace: D at each value in the Laplace approximation, conditional on `given`.
        estimate: value of the fit [unit].
        interval90: 90 % interval of the likelihood, None for the end of an open side [unit].
        ends: kind of each side: `closed`, `open` (the likelihood does not fall to the level of the
            interval's end within the computed range) or `at_bound` (open, but the parameter's bound
            ends the interval).
        given: what was held at the fit's values, in words; empty if all parameters were refitted.
        settled: True if every refit converged.
        sentence: result in one sentence for people.
    """

    path: str
    unit: str
    value: tuple[float, ...]
    posterior: tuple[float, ...]
    likelihood: tuple[float, ...]
    laplace: tuple[float, ...]
    estimate: float
    interval90: tuple[float | None, float | None]
    ends: tuple[str, str]
    given: str
    settled: bool
    sentence: str

    def __str__(self) -> str:
        return self.sentence

    def plot(self) -> "Figure":
        """Draw the rise of the loss over the values of the parameter."""
        from slipid.plots.posterior import profile_figure

        return profile_figure([self])


def profiled(space: Space, path: str) -> Entry:
    """Return the entry of the parameter `path`, which must be free and a scalar.

    Raises:
        ValueError: the parameter does not exist, is fixed, or is a vector; the message lists the
            free scalars.
    """
    can = {e.path: e for e in space.free if e.size == 1}
    if path not in can:
        why = {e.path: f"{path} is fixed" for e in space.all}
        why |= {e.path: f"{path} is a vector of {e.size} numbers" for e in space.free}
        reason = why.get(path, f"no parameter '{path}'")
        raise ValueError(f"{reason}; expected one of the free scalars {', '.join(can)}")
    return can[path]


def profile(
    problem: Problem,
    optimum: Optimum,
    path: str,
    progress: Callable[[int, float], None] = lambda points, rise: None,
) -> Profile:
    """Return the profile of a parameter around a fit, all other parameters refitted at each point.

    The variances are those of the fit. Where currents were logged, an electric parameter is
    profiled with the motion as fitted, and a motion parameter with the likelihood of motion data
    only. The Laplace approximation in the result, for comparison, is made in the same way.
    `progress` is called after every point with the number of points so far and the rise there.
    """
    entry = profiled(problem.space, path)
    at = problem.space.slices[path].start
    refits = _Refits(problem, optimum, at, progress)
    points = sorted([*refits.side(-1.0), *refits.side(1.0), (refits.start, refits.lowest)])
    z = np.array([p[0] for p in points])
    posterior = np.array([p[1] for p in points])
    own = 0.5 * ((z - problem.space.prior_mean[at]) / problem.space.prior_std[at]) ** 2
    likelihood = posterior - own
    posterior, likelihood = posterior - posterior.min(), likelihood - likelihood.min()
    d = entry.declaration

    def si(x: float) -> float:
        return float(np.asarray(d.to_si(jnp.atleast_1d(jnp.asarray(float(x))))).reshape(()))

    low = int(np.argmin(likelihood))
    sides = (slice(low, None, -1), slice(low, None))
    cross = [_crossing(z[side], likelihood[side]) for side in sides]
    ends = ["open" if x is None else "closed" for x in cross]
    interval = [None if x is None else si(x) for x in cross]
    for k, bound in enumerate((d.lower, d.upper)):
        if ends[k] == "open" and ends[1 - k] == "closed" and np.isfinite(bound):
            ends[k], interval[k] = "at_bound", float(bound)
    return Profile(
        path=entry.path,
        unit=d.unit,
        value=tuple(si(x) for x in z),
        posterior=tuple(posterior.tolist()),
        likelihood=tuple(likelihood.tolist()),
        laplace=tuple((0.5 * ((z - refits.start) / refits.std) ** 2).tolist()),
        estimate=si(refits.start),
        interval90=(interval[0], interval[1]),
        ends=(ends[0], ends[1]),
        given="" if problem.objective.joint or refits.of_motion else "the motion as fitted",
        settled=refits.settled,
        sentence=_sentence(entry, interval, ends, problem.windows.has_voltage)
        + ("" if refits.settled else "; some refits did not converge: the interval may be wider"),
    )


class _Refits:
    """Refits along one coordinate, each started at the result of the neighbouring point."""

    def __init__(
        self, problem: Problem, optimum: Optimum, at: int, progress: Callable[[int, float], None]
    ):
        self.problem, self.at, self.progress = problem, at, progress
        self.free, self.of_motion = np.ones(problem.space.size), False
        covariance = optimum.covariance
        if not problem.objective.joint:
            electric = problem.space.electric
            self.of_motion = not electric[at]
            mine = electric == electric[at]
            self.free = mine.astype(float)
            if not self.of_motion:
                # The covariance with the motion held is the inverse of the electric block of the
                # information.
                held = np.where(mine[:, None] & mine, np.linalg.inv(covariance), np.eye(len(mine)))
                covariance = np.linalg.inv(held)
        self.free[at] = 0.0
        self.std = float(np.sqrt(covariance[at, at]))
        self.start, self.state = float(optimum.state.z[at]), optimum.state
        self.count, self.settled = 0, True
        self.electric = problem.electric(optimum.state.z, optimum.state.log_variance)
        self.lowest = self.loss(optimum.state)

    def loss(self, state: FitState) -> float:
        """Return minus the log posterior at fixed noise; if `of_motion`, of motion data only."""
        problem, log_v = self.problem, state.log_variance
        blocks, _ = problem.linear(jnp.asarray(state.z), self.electric)
        if self.of_motion:
            blocks = {k: r for k, r in blocks.items() if k in MOTION_BLOCKS}
        keep = problem.full_weight
        moving = problem.objective.joint or self.of_motion
        effect = (state if moving else self.state).shared(len(problem.windows))
        weighed = problem.weighed(blocks, log_v, keep, effect)
        return problem.loss(state.z, log_v, keep, weighed, self.electric)

    def side(self, sign: float) -> list[tuple[float, float]]:
        """Return points (coordinate, loss) outward from the estimate; sign -1 means downward.

        A side ends where the loss without the parameter's own prior has risen by `_COMPLETE_RISE`,
        or at the distance `_FARTHEST`.
        """
        points: list[tuple[float, float]] = []
        state, step, before = self.state, 0.5 * self.std, 0.0
        mean, prior_std = (
            self.problem.space.prior_mean[self.at],
            self.problem.space.prior_std[self.at],
        )
        base = self.lowest - 0.5 * ((self.start - mean) / prior_std) ** 2
        reach = max(sign * mean + _FARTHEST * prior_std, sign * self.start + _FARTHEST * self.std)
        growth = 1.5
        while len(points) < _MOST_POINTS:
            z = np.array(state.z)
            z[self.at] += sign * step
            if sign * z[self.at] > reach:
                break
            held = replace(state, z=z, round=0)
            end = optimise(
                self.problem, start=held, most_rounds=12, free=self.free, variances=False
            )
            loss = self.loss(end.state)
            points.append((float(z[self.at]), loss))
            self.settled &= end.converged
            rise = loss - 0.5 * ((z[self.at] - mean) / prior_std) ** 2 - base
            self.count += 1
            self.progress(self.count, rise)
            if rise > _LARGEST_RISE and before < RISE and step > _SHORTEST_STEP * self.std:
                step, growth = 0.5 * step, 1.0
                continue
            if rise > _COMPLETE_RISE:
                break
            if rise - before < 0.2 * RISE:
                step *= growth
            state, before = end.state, rise
        return points


def _crossing(z: np.ndarray, rise: np.ndarray) -> float | None:
    """Return the first value outward at which the rise is `RISE`, None if it stays below.

    The rise is interpolated by a monotone cubic.
    """
    above = np.flatnonzero(rise >= RISE)
    if not above.size:
        return None
    k = int(above[0])
    away = np.abs(z[: k + 1] - z[0])
    [*_, place] = PchipInterpolator(away, rise[: k + 1] - RISE).roots(extrapolate=False)
    return float(z[0] + np.sign(z[k] - z[0]) * place)


def _sentence(
    entry: Entry, interval: list[float | None], ends: list[str], has_voltage: bool
) -> str:
    unit = "" if entry.declaration.unit == "1" else f" {entry.declaration.unit}"
    low, high = (None if x is None else f"{x:.4g}{unit}" for x in interval)
    if "at_bound" in ends:
        side = f"below {high}" if ends[0] == "at_bound" else f"above {low}"
        return f"{entry.path} is at its bound: the data only show that it is {side} (90 %)"
    if low is None and high is None:
        return (
            f"{entry.path}: the data do not determine it; the likelihood is nearly constant over "
            "the prior"
        )
    if entry.path in NEEDS_VOLTAGE and not has_voltage:
        return (
            f"{entry.path}: no voltage is logged, so its limits come from the priors of other "
            "parameters"
        )
    if low is None or high is None:
        side = f"below {high}" if low is None else f"above {low}"
        return (
            f"{entry.path}: the data only show that it is {side} (90 %); the likelihood has no "
            "other limit"
        )
    return f"{entry.path}: between {low} and {high} by the data (90 %)"
