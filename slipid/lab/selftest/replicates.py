"""Replicates of an experiment: simulations with known true parameters, and their fits.

A replicate draws true parameters near the centre of their priors, fills the windows of the
experiment with the measurements that a robot with these parameters would give, including noise, and
fits them from the default start values. Wheel motion, floors, loads, sessions and sampling are
those of the given windows. The noise is that of the likelihood at typical variances. Replicates
therefore show what the experiment can recover if the model is right, but no error of the model.

Source: a small version of simulation-based calibration (Talts et al. 2018, arXiv:1804.06788).
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from fnmatch import fnmatchcase
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from pydantic import TypeAdapter

from slipid.app.problem import ConfigFitTask
from slipid.data.windows import Windows
from slipid.fitting import likelihood as lk
from slipid.fitting.noise import SHARED, axes, noise, travel
from slipid.fitting.optimise import Optimum, optimise
from slipid.fitting.problem import FitState, Problem
from slipid.fitting.shared_effects import AXES, effects_by_floor
from slipid.infer.result import draws
from slipid.infer.slip_curves import curves, slip_on
from slipid.infer.verdicts.estimates import Estimate, derived, estimates
from slipid.infer.verdicts.unidentified import flat_directions, members
from slipid.model.camera import Camera
from slipid.model.motor import Motor, sign_of_motion
from slipid.model.robot import Robot
from slipid.predict.open_loop import chain, contact_increments
from slipid.predict.slip_model import as_increments
from slipid.search_space import Choice, Space
from slipid.support.blocks import in_blocks
from slipid.support.checkpoint import Checkpoint
from slipid.support.errors import DataError
from slipid.support.progress import Reporter


def simulate_windows(
    truth: Robot, w: Windows, rng: np.random.Generator, std: Mapping[str, float]
) -> Windows:
    """Return the windows with simulated poses, currents and voltages, noise included.

    Every segment starts at its first pose in `w`. The random effects of the current components are
    part of the true current, which determines the voltage. The noise of variance `w.current_var` is
    that of the ammeter and is added to measured currents only.

    Args:
        truth: robot with the true parameters, and the floors, loads, sessions of the windows.
        w: windows that were driven; channels that they lack are not simulated.
        rng: generator of the random numbers of the noise.
        std: std of each variance component, keyed by its name (as in `fit.noise`); a key without a
            floor holds for every floor without an entry, and missing components are zero.
    """

    def predicted(which: Int[np.ndarray, " segment"]) -> tuple[Array, Array, Array]:
        return _predicted(truth, lk.batch(w.segments(which), truth), w.pose[which])

    increment, amps, start = in_blocks(predicted, np.arange(len(w)), block=32)
    steps = increment + _process(truth, w, rng, std)
    path = np.asarray(chain(start, steps))
    pose = in_blocks(partial(_logged, truth.camera), path.reshape(-1, 3)).reshape(path.shape)
    pose[..., :2] += rng.normal(size=(*pose.shape[:2], 2)) * std.get("camera.place", 0.0)
    pose[..., 2] += rng.normal(size=pose.shape[:2]) * std.get("camera.heading", 0.0)
    each = _component_std(std, w, "current", "window")[:, None, None]
    of_run = rng.normal(size=(len(w), 1, amps.shape[2]))
    same = _component_std(std, w, "current", "run")[:, None, None] * of_run
    flowing = amps + same + each * rng.normal(size=amps.shape)
    speed = w.turn / w.dt[..., None]
    signed = flowing - float(truth.motor.current_offset)
    signed = signed if w.current_is_signed else signed * np.asarray(sign_of_motion(speed))
    volts = np.asarray(_voltage(truth.motor, signed, speed, w.direction))
    current = flowing + np.sqrt(w.current_var) * rng.normal(size=amps.shape)
    voltage = volts + rng.normal(size=amps.shape) * std.get("voltage.window", 0.0)
    return replace(
        w,
        pose=pose,
        current=current if w.has_current else np.zeros_like(current),
        voltage=voltage if w.has_voltage else np.zeros_like(voltage),
    )


@jax.jit
def _predicted(robot: Robot, b: lk.Batch, pose: Array) -> tuple[Array, Array, Array]:
    p = lk.predict(robot, b)
    start = lk.corrected(robot, pose)[:, 0]
    return p.increment, lk.predicted_current(robot, b, p.motor_force), start


_logged = jax.jit(jax.vmap(Camera.logged, (None, 0)))
_voltage = jax.jit(Motor.voltage)


def _component_std(std: Mapping[str, float], w: Windows, kind: str, part: str) -> np.ndarray:
    """Return the std of a variance component on the floor of each segment, shape (segment,)."""
    usual = std.get(f"{kind}.{part}", 0.0)
    return np.array([std.get(f"{kind}.{floor}.{part}", usual) for floor in w.surface])


def _process(
    truth: Robot, w: Windows, rng: np.random.Generator, std: Mapping[str, float]
) -> Float[np.ndarray, "segment window 3"]:
    """Return the random part of each window's displacement, whose std grows with distance."""
    distance, u = travel(w, truth)
    total, shared = np.zeros((*distance.shape, 3)), _shared(truth, w, rng, std)
    for k, (axis, name) in enumerate(zip(axes(u), AXES, strict=True)):
        grown = _component_std(std, w, "process", name)[:, None] * np.sqrt(distance)
        own = _component_std(std, w, "run", name) * rng.normal(size=len(w)) + shared[:, k]
        step = grown * rng.normal(size=distance.shape) + own[:, None] * distance
        total += (axis @ step[..., None]).reshape(total.shape)
    return total


def _shared(
    truth: Robot, w: Windows, rng: np.random.Generator, std: Mapping[str, float]
) -> Float[np.ndarray, "segment 3"]:
    """Return the sum of shared effects (neighbouring runs) and session effects of each segment."""
    components = noise(w, truth)
    named = [
        std.get(c.name, std.get(f"{c.kind}.{c.what}", 0.0) if c.kind in SHARED else 0.0)
        for c in components.components
    ]
    log_v = 2 * np.log(np.maximum(named, 1e-30))
    out = np.zeros((len(w), len(AXES)))
    for of in effects_by_floor(w, truth, components)[0]:
        root = np.asarray(of.root(log_v))
        drawn = np.einsum("anq,aq->na", root, rng.normal(size=root.shape[::2]))
        out[np.asarray(of.segments)] = drawn
    return out


FILE = "replicates"
"""Name of the checkpoint's file of finished replicates, from which a later call continues."""
TRUTH_STD_RATIO, MOST_PRIOR_STD = 0.5, 0.5
"""True parameters are drawn with a std of `TRUTH_STD_RATIO` times the prior std, at most
`MOST_PRIOR_STD`.

Both stds are in the search space."""


@dataclass(frozen=True)
class NumberRecovery:
    """True and estimated value of one parameter in a replicate; lists have one item per entry.

    Attributes:
        unit, labels: as in `Estimate`.
        truth, value: true and estimated values [unit].
        inside: True if the 90 % interval contains the truth.
        z: estimate less truth in the search space, divided by the estimate's std there.
        verdict: verdict of the fit, see `Estimate`.
    """

    unit: str
    labels: list[str]
    truth: list[float]
    value: list[float]
    inside: list[bool]
    z: list[float]
    verdict: str


@dataclass(frozen=True)
class CurveRecovery:
    """Agreement of a floor's fitted slip curve with the true one.

    Attributes:
        gap: largest difference in slip between fitted and true curve [-].
        inside: fraction of the points of the true curve that lie in the fit's 90 % band.
    """

    gap: float
    inside: float


@dataclass(frozen=True)
class Replicate:
    """One simulated experiment and its fit.

    Attributes:
        parameters: recovery of parameters and of ratios of parameters, keyed by path.
        curves: recovery of the slip curve of each floor.
        predictions: mean distance between predicted and true end of a run, divided by the true
            chord, keyed by floor and slip model.
        converged: True if the fit converged.
    """

    parameters: dict[str, NumberRecovery]
    curves: dict[str, CurveRecovery]
    predictions: dict[str, dict[str, float]]
    converged: bool


_FILE = TypeAdapter(list[Replicate])


def plausible(task: ConfigFitTask, problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and std, in the search space, from which true parameters are drawn.

    The mean is the prior mean; `TRUTH_STD_RATIO` defines the std. A parameter in `[selftest.truth]`
    has the value given there as its mean, and a std of 0.

    Raises:
        DataError: `[selftest.truth]` names a parameter that does not exist or is fixed, or gives
            a value that the parameter cannot have.
    """
    space, config = problem.space, task.config
    center = space.prior_mean.copy()
    scatter = TRUTH_STD_RATIO * np.minimum(space.prior_std, MOST_PRIOR_STD)
    for pattern, value in config.content.selftest.truth.items():
        where = f"{config.path}: selftest.truth.'{pattern}'"
        mine = [e for e in space.free if fnmatchcase(e.path, pattern)]
        if not mine:
            free = ", ".join(e.path for e in space.free)
            raise DataError(f"{where}: no such free parameter; expected one of {free}")
        try:
            start = Space(problem.robot, [*task.choices, Choice(pattern, start=value)]).start
        except ValueError as error:
            raise DataError(f"{where}: {error}") from error
        for e in mine:
            at = space.slices[e.path]
            center[at], scatter[at] = start[at], 0.0
    return center, scatter


def replicates(
    task: ConfigFitTask, problem: Problem, count: int, seed: int, kept: Checkpoint, report: Reporter
) -> list[Replicate]:
    """Return `count` replicates; replicates in the checkpoint are not simulated again.

    Args:
        task: fit task of the experiment.
        problem: fitting problem of the task, whose compiled functions are used for every replicate.
        count: number of replicates.
        seed: seed of true parameters and noise, together with the replicate's number.
        kept: checkpoint with the finished replicates, to which every new one is added.
        report: receives messages about progress.
    """
    center, scatter = plausible(task, problem)
    std = dict(zip(problem.noise.names, problem.noise.typical.tolist(), strict=True))
    fit = task.config.content.fit
    found = _FILE.validate_python(kept.load_json(FILE) or [])[:count]
    if found:
        report.line(f"{len(found)} of {count} replicates are already in {kept.folder / FILE}.json")
    report.stage("replicates")

    def tell(state: FitState) -> None:
        report.note(f"{state.stage}, round {state.round}")

    for k in range(len(found), count):
        rng = np.random.default_rng([seed, k])
        z = center + scatter * rng.standard_normal(len(center))
        windows = simulate_windows(problem.space.tree(jnp.asarray(z)), problem.windows, rng, std)
        this = problem.of(windows)
        end = optimise(this, most_rounds=fit.rounds, tolerance=fit.tolerance, tell=tell)
        found.append(recovery(this, task.choices, z, end))
        kept.save_json(FILE, [asdict(one) for one in found])
        report.advance(len(found), count)
    return found


def recovery(
    problem: Problem, choices: Sequence[Choice], true: Float[np.ndarray, " free"], end: Optimum
) -> Replicate:
    """Return the comparison of a fit with its truth: parameters, ratios, curves, predictions.

    `true` has the true free parameters in the search space, and `end` is the result of the fit.
    """
    space, volt = problem.space, problem.windows.has_voltage
    z, covariance = end.state.z, end.covariance
    truth = space.tree(jnp.asarray(true))
    off = (z - true) / np.sqrt(np.diag(covariance))
    values = {e.path: np.atleast_1d(np.asarray(e.get(truth), float)) for e in space.free}
    flat = members(flat_directions(space, covariance, problem.windows.has_current, volt))
    shared = {e.path for e in space.free if e.session is None}
    numbers = {
        e.path: _number(e, values[e.path], off[space.slices[e.path]])
        for e in estimates(space, choices, z, covariance, volt, flat)
        if e.path in shared
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
    )


def _number(e: Estimate, truth: np.ndarray, score: np.ndarray) -> NumberRecovery:
    pairs, values = (x if e.labels else [x] for x in (e.interval90, e.value))
    return NumberRecovery(
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
) -> dict[str, CurveRecovery]:
    """Return the agreement of the fitted slip curve with the true one on every floor."""
    found = curves(problem.space, z, draws(z, covariance, 200, 0), problem.batch)
    out = {}
    for floor, curve in found.items():
        true = slip_on(truth, floor, curve)
        inside = (curve.slip_lo - 1e-9 <= true) & (true <= curve.slip_hi + 1e-9)
        out[floor] = CurveRecovery(float(np.abs(true - curve.slip).max()), float(inside[1:].mean()))
    return out


def _predictions(w: Windows, truth: Robot, found: Robot) -> dict[str, dict[str, float]]:
    """Return the mean end-point errors relative to the true chord, by floor and slip model.

    The runs are those of the experiment, simulated without noise, so that only errors of the fitted
    parameters contribute.
    """
    start = jnp.zeros((len(w), 3))

    def ends(increment: np.ndarray | Array) -> np.ndarray:
        return np.asarray(chain(start, jnp.asarray(increment)))[:, -1, :2]

    true = ends(contact_increments(truth, lk.batch(w, truth)))
    back = np.asarray(truth.geometry.pseudo_inverse())
    twist = (w.turn / w.dt[..., None]) @ (back * float(truth.geometry.wheel_radius)).T
    predicted_ends = {
        "identified": ends(contact_increments(found, lk.batch(w, found))),
        "encoder": ends(as_increments(twist, w, truth)),
    }
    chord, floor = np.linalg.norm(true, axis=1), np.asarray(w.surface)
    # turns on the spot have no chord by which an error could be divided
    travels = chord > 0.1 * np.median(chord)
    error = {m: np.linalg.norm(end - true, axis=1) / chord for m, end in predicted_ends.items()}
    return {
        name: {model: float(np.mean(of_model[mine])) for model, of_model in error.items()}
        for name in dict.fromkeys(w.surface)
        if (mine := travels & (floor == name)).any()
    }
