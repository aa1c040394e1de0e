"""What this very experiment can recover: made with known truth, fitted, compared, again and again.

A replicate draws true numbers from what is plausible before the logs, fills the windows of the
experiment with what a robot of these numbers would have shown, noise included, and fits them from
the usual start. The noise is the likelihood's own at typical variances: the test tells what the
experiment can tell if the model is right, not whether it is.

Source: simulation-based calibration in small (Talts et al. 2018, arXiv:1804.06788).
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from fnmatch import fnmatchcase

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from pydantic import TypeAdapter

from slipid.data.windows import Windows
from slipid.identify.compare.marker import as_increments
from slipid.identify.compare.open_loop import chain, contact_increments
from slipid.identify.fit import likelihood as lk
from slipid.identify.fit.optimise import Optimum, optimise
from slipid.identify.fit.problem import Problem, State
from slipid.identify.result import draws
from slipid.identify.slip_curves import curves, slip_on
from slipid.identify.verdicts.estimates import Estimate, derived, estimates
from slipid.identify.verdicts.unidentified import flat_directions, members
from slipid.job.config import Config
from slipid.model.robot import Robot
from slipid.search_space import Choice, Space
from slipid.selftest.windows import measure
from slipid.support.checkpoint import Checkpoint
from slipid.support.errors import DataError
from slipid.support.progress import Reporter

KEPT = "replicates"
"""File of the replicates that are done, which a later call goes on from."""
SCATTER, MOST = 0.5, 0.5
"""True numbers scatter by this part of their prior's std, which counts up to `MOST` [search]."""


@dataclass(frozen=True)
class Number:
    """One number of a replicate, or a short vector: truth against estimate, entry by entry.

    Attributes:
        unit, labels: as of `Estimate`.
        truth, value: [unit].
        inside: whether the 90 % interval holds the truth.
        z: estimate less truth, in stds of the estimate, in the search space.
        verdict: of the fit.
    """

    unit: str
    labels: list[str]
    truth: list[float]
    value: list[float]
    inside: list[bool]
    z: list[float]
    verdict: str


@dataclass(frozen=True)
class Curve:
    """Largest gap in slip to the true curve, and how much of that lies in the 90 % band."""

    gap: float
    inside: float


@dataclass(frozen=True)
class Replicate:
    """One made experiment and what its fit found.

    Attributes:
        parameters: numbers and ratios by path.
        curves: by floor.
        predictions: by floor and model, distance of predicted ends over the true chord.
        converged, reason: how the fit ended.
    """

    parameters: dict[str, Number]
    curves: dict[str, Curve]
    predictions: dict[str, dict[str, float]]
    converged: bool
    reason: str


_FILE = TypeAdapter(list[Replicate])


def plausible(
    config: Config, choices: Sequence[Choice], problem: Problem
) -> tuple[np.ndarray, np.ndarray]:
    """Centre and scatter of the true numbers, in the search space.

    The centre is the prior's, the scatter half its std; what `[selftest.truth]` gives is exactly
    that.

    Raises:
        DataError: a truth for a number that does not exist, is fixed, or cannot have it.
    """
    space, given = problem.space, config.content.selftest.truth
    center = space.prior_mean.copy()
    scatter = SCATTER * np.minimum(space.prior_std, MOST)
    for pattern, value in given.items():
        where = f"{config.path}: selftest.truth.'{pattern}'"
        mine = [e for e in space.free if fnmatchcase(e.path, pattern)]
        if not mine:
            free = ", ".join(e.path for e in space.free)
            raise DataError(f"{where}: no such free parameter; expected one of {free}")
        try:
            start = Space(problem.robot, [*choices, Choice(pattern, start=value)]).start
        except ValueError as error:
            raise DataError(f"{where}: {error}") from error
        for e in mine:
            at = space.place[e.path]
            center[at], scatter[at] = start[at], 0.0
    return center, scatter


def replicates(
    config: Config,
    choices: Sequence[Choice],
    problem: Problem,
    count: int,
    seed: int,
    kept: Checkpoint,
    report: Reporter,
) -> list[Replicate]:
    """Replicates until there are `count`; those that are kept are not repeated.

    Args:
        choices: as the problem was given.
        problem: of its windows; what is compiled for it serves every replicate.
        seed: with the replicate's number the seed of truth and noise.
        kept: those that are done; every new one is added.
    """
    center, scatter = plausible(config, choices, problem)
    std = dict(zip(problem.noise.names, problem.noise.typical.tolist(), strict=True))
    fit = config.content.fit
    found = _FILE.validate_python(kept.load_json(KEPT) or [])[:count]
    if found:
        report.line(f"{len(found)} of {count} replicates are in {kept.folder / KEPT}.json already")
    report.stage("replicates")

    def tell(state: State) -> None:
        report.note(f"{state.stage}, round {state.round}")

    for k in range(len(found), count):
        rng = np.random.default_rng([seed, k])
        z = center + scatter * rng.standard_normal(len(center))
        made = measure(problem.space.tree(jnp.asarray(z)), problem.windows, rng, std)
        this = problem.of(made)
        end = optimise(this, most_rounds=fit.rounds, tolerance=fit.tolerance, tell=tell)
        found.append(compared(this, choices, z, end))
        kept.save_json(KEPT, [asdict(one) for one in found])
        report.advance(len(found), count)
    return found


def compared(
    problem: Problem, choices: Sequence[Choice], true: Float[np.ndarray, " free"], end: Optimum
) -> Replicate:
    """The end of a fit beside its truth: every free number, every ratio, curves, predictions."""
    space, volt = problem.space, problem.windows.has_voltage
    z, covariance = end.state.z, end.covariance
    truth = space.tree(jnp.asarray(true))
    off = (z - true) / np.sqrt(np.diag(covariance))
    values = {e.path: np.atleast_1d(np.asarray(e.get(truth), float)) for e in space.free}
    flat = members(flat_directions(space, covariance, problem.windows.has_current, volt))
    judged = {e.path for e in space.free if e.session is None}
    numbers = {
        e.path: _number(e, values[e.path], off[space.place[e.path]])
        for e in estimates(space, choices, z, covariance, volt, flat)
        if e.path in judged
    }
    known = {e.path: e.value for e in derived(space, true, covariance, volt)}
    for e in derived(space, z, covariance, volt):
        score = np.log(e.value / known[e.path]) / (e.std / e.value)
        numbers[e.path] = _number(e, np.array([known[e.path]]), np.array([score]))
    found = space.tree(jnp.asarray(z))
    return Replicate(
        parameters=numbers,
        curves=_curves(problem, truth, z, covariance),
        predictions=_predictions(problem.windows, truth, found),
        converged=bool(end.converged),
        reason=end.reason,
    )


def _number(e: Estimate, truth: np.ndarray, score: np.ndarray) -> Number:
    pairs = e.interval90 if e.labels else [e.interval90]
    values = e.value if e.labels else [e.value]
    return Number(
        unit=e.unit,
        labels=list(e.labels),
        truth=truth.tolist(),
        value=list(values),
        inside=[bool(a <= t <= b) for t, (a, b) in zip(truth, pairs, strict=True)],
        z=score.tolist(),
        verdict=e.verdict,
    )


def _curves(
    problem: Problem, truth: Robot, z: np.ndarray, covariance: np.ndarray
) -> dict[str, Curve]:
    """Largest gap in slip to the true curve of every floor, and how much lies in the band."""
    found = curves(problem.space, z, draws(z, covariance, 200, 0), problem.batch)
    out = {}
    for floor, curve in found.items():
        true = slip_on(truth, floor, curve)
        inside = (curve.slip_lo - 1e-9 <= true) & (true <= curve.slip_hi + 1e-9)
        out[floor] = Curve(float(np.abs(true - curve.slip).max()), float(inside[1:].mean()))
    return out


def _predictions(w: Windows, truth: Robot, found: Robot) -> dict[str, dict[str, float]]:
    """Distance of predicted ends from the true one over the true chord, mean per floor.

    Of the experiment's own pieces without any noise: what the numbers' errors alone cost.
    """
    start = jnp.zeros((len(w), 3))

    def ends(increment: np.ndarray | Array) -> np.ndarray:
        return np.asarray(chain(start, jnp.asarray(increment)))[:, -1, :2]

    true = ends(contact_increments(truth, lk.batch(w, truth)))
    back = np.asarray(truth.geometry.least())
    twist = (w.turn / w.dt[..., None]) @ (back * float(truth.geometry.wheel_radius)).T
    said = {
        "identified": ends(contact_increments(found, lk.batch(w, found))),
        "encoder": ends(as_increments(twist, w, truth)),
    }
    chord, floor = np.linalg.norm(true, axis=1), np.asarray(w.surface)
    far = chord > 0.1 * np.median(chord)  # those that turn on the spot have none
    out: dict[str, dict[str, float]] = {}
    for name in dict.fromkeys(w.surface):
        if (mine := far & (floor == name)).any():
            gaps = {model: np.linalg.norm(end - true, axis=1) for model, end in said.items()}
            out[name] = {m: float(np.mean((gap / chord)[mine])) for m, gap in gaps.items()}
    return out
