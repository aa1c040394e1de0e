"""Simulate an experiment with known truth and fit it, again and again, to see what it recovers.

A replicate draws true numbers from what is plausible before the logs, fills the windows of the
experiment with the readings that a robot of these numbers would give, noise included, and fits them
from the usual start. Wheel motion, floors, loads, sessions and sampling are those of the given
windows. The noise is the likelihood's own at typical variances: the test shows what the experiment
can recover if the model is right, and cannot show an error of the model itself.

Source: simulation-based calibration in small (Talts et al. 2018, arXiv:1804.06788).
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from fnmatch import fnmatchcase

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from pydantic import TypeAdapter

from slipid.app.config import Config
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
from slipid.model.robot import Robot
from slipid.predict.open_loop import chain, contact_increments, corrected
from slipid.predict.slip_model import as_increments
from slipid.search_space import Choice, Space
from slipid.support.checkpoint import Checkpoint
from slipid.support.errors import DataError
from slipid.support.progress import Reporter


def simulate_windows(
    truth: Robot, w: Windows, rng: np.random.Generator, std: Mapping[str, float]
) -> Windows:
    """Return the windows with simulated poses, currents and voltages, noise included.

    Every segment starts at the pose it has. The current's scatter is in the current that flows, and
    voltages follow it; `current_var` comes on top as the ammeter's noise, which no voltage shows.

    Args:
        truth: robot with the floors, loads and sessions of the windows.
        w: windows that were driven; channels that they lack are not simulated.
        rng: random numbers of the noise.
        std: std of the variance components by name (`fit.noise`); a name without its floor stands
            for every floor, and missing ones are zero.
    """
    b = lk.batch(w, truth)
    increment, amps, start = (np.asarray(x) for x in _predicted(truth, b, jnp.asarray(w.pose)))
    steps = increment + _process(truth, w, rng, std)
    pose = np.array(_logged(truth, chain(jnp.asarray(start), jnp.asarray(steps))))
    pose[..., :2] += rng.normal(size=(*pose.shape[:2], 2)) * std.get("camera.place", 0.0)
    pose[..., 2] += rng.normal(size=pose.shape[:2]) * std.get("camera.heading", 0.0)
    each = _component_std(std, w, "current", "window")[:, None, None]
    of_run = rng.normal(size=(len(w), 1, amps.shape[2]))
    same = _component_std(std, w, "current", "run")[:, None, None] * of_run
    flowing = amps + same + each * rng.normal(size=amps.shape)
    speed = w.turn / w.dt[..., None]
    signed = flowing - float(truth.motor.current_offset)
    signed = signed if w.current_is_signed else signed * np.tanh(speed / 0.2)
    volts = np.asarray(truth.motor.voltage(jnp.asarray(signed), jnp.asarray(speed)))
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
    return p.increment, lk.predicted_current(robot, b, p.motor_force), corrected(robot, pose)[:, 0]


@jax.jit
def _logged(robot: Robot, pose: Float[Array, "segment edge 3"]) -> Float[Array, "segment edge 3"]:
    return jax.vmap(jax.vmap(robot.camera.logged))(pose)


def _component_std(std: Mapping[str, float], w: Windows, kind: str, part: str) -> np.ndarray:
    """Return the std of a variance component for every segment, by its floor (segment,)."""
    usual = std.get(f"{kind}.{part}", 0.0)
    return np.array([std.get(f"{kind}.{floor}.{part}", usual) for floor in w.surface])


def _process(
    truth: Robot, w: Windows, rng: np.random.Generator, std: Mapping[str, float]
) -> Float[np.ndarray, "segment window 3"]:
    """Return random displacements beyond the model, which grow with distance."""
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
    """Return random effects that neighbouring runs, and runs of one session, share."""
    components = noise(w, truth)
    named = [
        std.get(c.name, std.get(f"{c.kind}.{c.what}", 0.0) if c.kind in SHARED else 0.0)
        for c in components.components
    ]
    log_v = jnp.asarray(2 * np.log(np.maximum(named, 1e-30)))
    out = np.zeros((len(w), len(AXES)))
    for of in effects_by_floor(w, truth, components)[0]:
        root = np.asarray(of.root(log_v))
        drawn = np.einsum("anq,aq->na", root, rng.normal(size=root.shape[::2]))
        out[np.asarray(of.segments)] = drawn
    return out


FILE = "replicates"
"""File of finished replicates, from which a later call continues."""
SCATTER, MOST = 0.5, 0.5
"""True numbers scatter by `SCATTER` times their prior's std, which counts up to `MOST` [search]."""


@dataclass(frozen=True)
class NumberRecovery:
    """One number of a replicate, or a short vector: truth against estimate, entry by entry.

    Attributes:
        unit, labels: as in `Estimate`.
        truth, value: true and estimated values [unit].
        inside: whether the 90 % interval holds the truth.
        z: estimate less truth, in stds of the estimate, in the search space.
        verdict: verdict of the fit.
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
    """Largest gap in slip to the true curve, and the share of that curve in the 90 % band."""

    gap: float
    inside: float


@dataclass(frozen=True)
class Replicate:
    """One simulated experiment and its fit.

    Attributes:
        parameters: numbers and ratios by path.
        curves: slip curves by floor.
        predictions: distance of predicted ends over the true chord, by floor and slip model.
        converged, reason: how the fit ended.
    """

    parameters: dict[str, NumberRecovery]
    curves: dict[str, CurveRecovery]
    predictions: dict[str, dict[str, float]]
    converged: bool
    reason: str


_FILE = TypeAdapter(list[Replicate])


def plausible(
    config: Config, choices: Sequence[Choice], problem: Problem
) -> tuple[np.ndarray, np.ndarray]:
    """Return centre and scatter of the true numbers, in the search space.

    The centre is the prior's and the scatter half its std. Numbers in `[selftest.truth]` have
    exactly the value given there.

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
            at = space.slices[e.path]
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
    """Return `count` replicates; those in the checkpoint are not simulated again.

    Args:
        choices: choices of the problem.
        problem: problem of the experiment; its compiled functions serve every replicate.
        seed: seed of truth and noise, together with the replicate's number.
        kept: checkpoint with the finished replicates, to which every new one is added.
    """
    center, scatter = plausible(config, choices, problem)
    std = dict(zip(problem.noise.names, problem.noise.typical.tolist(), strict=True))
    fit = config.content.fit
    found = _FILE.validate_python(kept.load_json(FILE) or [])[:count]
    if found:
        report.line(f"{len(found)} of {count} replicates are in {kept.folder / FILE}.json already")
    report.stage("replicates")

    def tell(state: FitState) -> None:
        report.note(f"{state.stage}, round {state.round}")

    for k in range(len(found), count):
        rng = np.random.default_rng([seed, k])
        z = center + scatter * rng.standard_normal(len(center))
        windows = simulate_windows(problem.space.tree(jnp.asarray(z)), problem.windows, rng, std)
        this = problem.of(windows)
        end = optimise(this, most_rounds=fit.rounds, tolerance=fit.tolerance, tell=tell)
        found.append(recovery(this, choices, z, end))
        kept.save_json(FILE, [asdict(one) for one in found])
        report.advance(len(found), count)
    return found


def recovery(
    problem: Problem, choices: Sequence[Choice], true: Float[np.ndarray, " free"], end: Optimum
) -> Replicate:
    """Compare the end of a fit with its truth: numbers, ratios, curves, predictions."""
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
        reason=end.reason,
    )


def _number(e: Estimate, truth: np.ndarray, score: np.ndarray) -> NumberRecovery:
    pairs = e.interval90 if e.labels else [e.interval90]
    values = e.value if e.labels else [e.value]
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
    """Return how well the slip curve of every floor was recovered."""
    found = curves(problem.space, z, draws(z, covariance, 200, 0), problem.batch)
    out = {}
    for floor, curve in found.items():
        true = slip_on(truth, floor, curve)
        inside = (curve.slip_lo - 1e-9 <= true) & (true <= curve.slip_hi + 1e-9)
        out[floor] = CurveRecovery(float(np.abs(true - curve.slip).max()), float(inside[1:].mean()))
    return out


def _predictions(w: Windows, truth: Robot, found: Robot) -> dict[str, dict[str, float]]:
    """Return the mean distance of predicted ends from the true ones over the true chord, per floor.

    The runs are those of the experiment without any noise, so that only the errors of the numbers
    count.
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
    travels = chord > 0.1 * np.median(chord)  # turns on the spot have no chord
    out: dict[str, dict[str, float]] = {}
    for name in dict.fromkeys(w.surface):
        if (mine := travels & (floor == name)).any():
            gaps = {
                model: np.linalg.norm(end - true, axis=1) for model, end in predicted_ends.items()
            }
            out[name] = {m: float(np.mean((gap / chord)[mine])) for m, gap in gaps.items()}
    return out
