"""What this very experiment can recover: made with known truth, fitted, compared, again and again.

A replicate draws true numbers from what is plausible before the logs, fills the windows of the
experiment with what a robot of these numbers would have shown, noise included, and fits them from
the usual start. The noise is the likelihood's own at typical variances: the test tells what the
experiment can tell if the model is right, not whether it is.

Source: simulation-based calibration in small (Talts et al. 2018, arXiv:1804.06788).
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from slipid.app import files
from slipid.app.config import Config, one_floor
from slipid.app.job import Job, Tell, job_of, layout_of, shape_of
from slipid.app.synthetic_windows import measure
from slipid.data.dataset import Windows, collect
from slipid.data.log import DataError
from slipid.identify import likelihood as lk
from slipid.identify.curves import curves, slip_on
from slipid.identify.fit import Options, optimise
from slipid.identify.identifiability import Estimate, derived, estimates
from slipid.identify.ladder import as_increments
from slipid.identify.problem import Problem
from slipid.identify.replay import chain, contact_increments
from slipid.identify.result import draws
from slipid.model.robot import Robot, build
from slipid.parameter import Choice, Space

SCATTER, MOST = 0.5, 0.5
"""True numbers scatter by this part of their prior's std, which counts up to `MOST` [search]."""
Row = dict[str, Any]


def planned(config: Config, line: Tell) -> Job:
    """Job of an experiment that nobody has driven yet: the grid of the config's `[selftest]`.

    Channels are those that the config's layouts name; every load set-up of the config is driven on
    every floor.

    Raises:
        DataError: a config that cannot be driven.
    """
    from slipid.app.synthetic import Sensors, grid, make_logs

    wanted, shape = config.content.selftest, shape_of(config)
    sections = one_floor(config.content.logs)
    loads = list(dict.fromkeys(section.load for section in sections))
    drives = [
        replace(d, distance=wanted.distance_m)
        for d in grid(
            [(floor, load) for floor in wanted.surfaces for load in loads],
            wanted.headings,
            wanted.speeds_m_s,
            wanted.turns,
        )
    ]
    robot = build(shape, wanted.surfaces, loads, sorted({d.session for d in drives}))
    layouts = [layout_of(config, section) for section in sections]
    channels = [set(layout.channels) for layout in layouts]
    has_current = all("current" in c for c in channels)
    has_voltage = all("voltage" in c or {"duty", "bus_voltage"} <= c for c in channels)
    is_signed = all(layout.current_is_signed for layout in layouts)
    logs = [
        replace(
            log,
            current=log.current if has_current else None,
            current_is_signed=is_signed,
        )
        for log in make_logs(robot, drives, 0, Sensors(has_voltage=has_voltage))
    ]
    line(f"no logs given: {len(logs)} runs of [selftest] on {', '.join(wanted.surfaces)}")
    return job_of(config, collect(logs), [], line)


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


def key_of(job: Job, seed: int) -> str:
    """Hash of everything a replicate depends on."""
    same = [job.config.hash, job.data_hash, str(seed), *map(str, files.versions().items())]
    return hashlib.sha256("\n".join(same).encode()).hexdigest()


def replicates(
    config: Config,
    choices: Sequence[Choice],
    problem: Problem,
    count: int,
    seed: int,
    done: list[Row],
    tell: Callable[[list[Row]], None],
    each: Callable[[Any], None],
) -> list[Row]:
    """Replicates until there are so many; those done are not repeated.

    Args:
        config: of the experiment.
        choices: as the problem was given.
        problem: of its windows; what is compiled for it serves every replicate.
        count: how many there shall be.
        seed: with the replicate's number the seed of truth and noise.
        done: finished before.
        tell: called with all of them after each.
        each: called after every round of a fit.
    """
    center, scatter = plausible(config, choices, problem)
    std = dict(zip(problem.noise.names, problem.noise.typical.tolist(), strict=True))
    fit = config.content.fit
    options = Options(most_rounds=fit.rounds, tolerance=fit.tolerance)
    rows = list(done[:count])
    for k in range(len(rows), count):
        rng = np.random.default_rng([seed, k])
        z = center + scatter * rng.standard_normal(len(center))
        made = measure(problem.space.tree(jnp.asarray(z)), problem.windows, rng, std)
        this = problem.of(made)
        end = optimise(this, options=options, tell=each)
        row = compared(this, choices, z, end.state.z, end.covariance)
        rows.append(row | {"converged": bool(end.converged), "reason": end.reason})
        tell(rows)
    return rows


def compared(
    problem: Problem,
    choices: Sequence[Choice],
    true: Float[np.ndarray, " free"],
    z: Float[np.ndarray, " free"],
    covariance: Float[np.ndarray, "free free"],
) -> Row:
    """A fit beside its truth: every free number, every ratio, curves and predictions."""
    space, volt = problem.space, problem.windows.has_voltage
    truth = space.tree(jnp.asarray(true))
    off = (z - true) / np.sqrt(np.diag(covariance))
    values = {e.path: np.atleast_1d(np.asarray(e.get(truth), float)) for e in space.free}
    numbers = {
        e.path: _number(e, values[e.path], off[space.place[e.path]])
        for e in estimates(space, choices, z, covariance, volt)
        if e.path in space.place and "session_yaw" not in e.path
    }
    known = {e.path: e.value for e in derived(space, true, covariance, volt)}
    for e in derived(space, z, covariance, volt):
        score = np.log(e.value / known[e.path]) / (e.std / e.value)
        numbers[e.path] = _number(e, np.array([known[e.path]]), np.array([score]))
    found = space.tree(jnp.asarray(z))
    return {
        "parameters": numbers,
        "curves": _curves(problem, truth, z, covariance),
        "predictions": _predictions(problem.windows, truth, found),
    }


def _number(e: Estimate, truth: np.ndarray, score: np.ndarray) -> Row:
    pairs = e.interval90 if e.labels else [e.interval90]
    values = e.value if e.labels else [e.value]
    return {
        "unit": e.unit,
        "labels": list(e.labels),
        "truth": truth.tolist(),
        "value": list(values),
        "inside": [bool(a <= t <= b) for t, (a, b) in zip(truth, pairs, strict=True)],
        "z": score.tolist(),
        "ratio": e.ratio,
        "verdict": e.verdict,
    }


def _curves(
    problem: Problem, truth: Robot, z: np.ndarray, covariance: np.ndarray
) -> dict[str, Row]:
    """Largest gap in slip to the true curve, and how much of it lies in the 90 % band."""
    found = curves(problem.space, z, draws(z, covariance, 200, 0), problem.batch)
    out = {}
    for floor, curve in found.items():
        true = slip_on(truth, floor, curve)
        low, high = np.asarray(curve["slip_lo"]), np.asarray(curve["slip_hi"])
        inside = (low - 1e-9 <= true) & (true <= high + 1e-9)
        out[floor] = {
            "gap": float(np.abs(true - np.asarray(curve["slip"])).max()),
            "inside": float(inside[1:].mean()),
        }
    return out


def _predictions(w: Windows, truth: Robot, found: Robot) -> dict[str, Row]:
    """Distance of predicted ends from the true one over the true chord, mean per floor.

    Of the experiment's own pieces without any noise: what the numbers' errors alone cost.
    """
    start = jnp.zeros((len(w), 3))

    def ends(increment: Any) -> np.ndarray:
        return np.asarray(chain(start, jnp.asarray(increment)))[:, -1, :2]

    true = ends(contact_increments(truth, lk.batch(w, truth)))
    back = np.linalg.pinv(np.asarray(truth.geometry.forward()))
    twist = (w.turn / w.dt[..., None]) @ (back * float(truth.geometry.wheel_radius)).T
    said = {
        "identified": ends(contact_increments(found, lk.batch(w, found))),
        "encoder": ends(as_increments(twist, w, truth)),
    }
    chord, floor = np.linalg.norm(true, axis=1), np.asarray(w.surface)
    far = chord > 0.1 * np.median(chord)  # those that turn on the spot have none
    return {
        str(name): {
            model: float(
                np.mean((np.linalg.norm(end - true, axis=1) / chord)[far & (floor == name)])
            )
            for model, end in said.items()
        }
        for name in dict.fromkeys(w.surface)
        if (far & (floor == name)).any()
    }
