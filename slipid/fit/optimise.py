"""Maximum a posteriori over trajectories: weights, structure, variances in turn until all rest."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from slipid.fit import likelihood as lk
from slipid.fit.hierarchy import effect_variances, pooled
from slipid.fit.multi_floor import MULTI_FLOOR_MOTION, MultiFloorBatch
from slipid.fit.noise import SHARED
from slipid.fit.problem import (
    CREEPS,
    FitState,
    Problem,
    effects_given,
    linear,
    log_jacobian,
    without_effects,
)
from slipid.fit.shared_effects import EffectPosterior, marginal_residuals
from slipid.fit.variances import Blocks, Objective, Search, Square, fitted_covariance, scoring_step
from slipid.model.robot import Robot

_REFUSED = 12
"""Steps of the solver that may be refused in a round."""


@dataclass(frozen=True, eq=False)
class Optimum:
    """End of a fit: Laplace covariance, why it stopped, for people, and the loss of every round."""

    state: FitState
    covariance: Square
    converged: bool
    reason: str
    history: tuple[float, ...]


def optimise(
    problem: Problem,
    keep: np.ndarray | None = None,
    start: FitState | None = None,
    most_rounds: int = 30,
    tolerance: float = 0.02,
    tell: Callable[[FitState], None] = lambda state: None,
    free: np.ndarray | None = None,
    variances: bool = True,
) -> Optimum:
    """Maximum a posteriori from a staged start, or going on from a state.

    Args:
        keep: weight of each piece, 1 or 0, as `Problem.every` has them (piece,); all by default.
            Folds of a cross-validation differ in this only, so they share one compiled function.
        start: goes on from here instead of the staged start.
        most_rounds: of weights, structure and variances.
        tolerance: it stops when no number moves more posterior stds than this in a round.
        tell: called after every round, for progress and checkpoints.
        free: 1 for coordinates that may move from the start, 0 for those held there (free,).
        variances: whether to fit those of the noise, too.
    """
    keep = problem.full_weight if keep is None else np.asarray(keep, float)
    state = staged_start(problem, keep, tell) if start is None else replace(start, stage="joint")
    mask = np.ones(problem.space.size) if free is None else np.asarray(free, float)
    history: list[float] = []
    while state.round < most_rounds:
        early = state.round < 3
        scoring = (2 if early else 4) if variances else 0
        state = one_round(problem, state, keep, mask, steps=8 if early else 4, scoring=scoring)
        history.append(state.loss)
        tell(state)
        if state.moved < tolerance:
            break
    covariance = problem.laplace(state.z, state.log_variance, keep)
    reason = f"{most_rounds} rounds without settling"
    if settled := state.moved < tolerance:
        reason = f"no number moved {tolerance:g} of its std in round {state.round}"
    return Optimum(state, covariance, settled, reason, tuple(history))


def one_round(
    problem: Problem,
    state: FitState,
    keep: Float[np.ndarray, " piece"],
    mask: Search,
    steps: int,
    scoring: int,
) -> FitState:
    """Weights, structure, variances: one turn of each.

    At most so many steps of the structure, and so many scoring steps of the variances; the mask is
    1 for coordinates that may move, 0 for those held.
    """
    objective, log_v = problem.objective, jnp.asarray(state.log_variance)
    electric = problem.electric(state.z, log_v)
    residual, _, motor_force = linear(objective, jnp.asarray(state.z), electric)
    before = state.shared(len(problem.windows))
    seen = problem.weighed(residual, log_v, keep, before)
    held = LeastSquaresInputs(
        objective=objective,
        z=jnp.asarray(state.z),
        mask=jnp.asarray(mask),
        root=seen.whitening.root,
        effects=seen.effects,
        prior_std=objective.prior_std(log_v),
        electric=electric,
        motor_force=motor_force,
        slope=log_jacobian(objective, state.z, electric, keep)[1],
    )
    z = np.asarray(levenberg(held, LimitedLevenberg(steps)))
    electric = problem.electric(z, log_v)
    whole, jacobian, motor_force = linear(objective, jnp.asarray(z), electric)
    effect = effects_given(seen.effects, seen.whitening.root["motion"], whole["motion"])
    # weights follow effects and effects follow weights: half way, or they can swing for ever
    effect = 0.5 * (effect + before) if state.round else effect
    residual, told = (
        without_effects(objective, whole, effect),
        problem.voltage_information(z, log_v, motor_force),
    )
    if scoring:
        spread = fitted_covariance(objective, jacobian, log_v, jnp.asarray(keep))
    for _ in range(scoring):
        log_v = scoring_step(objective, residual, spread, log_v, jnp.asarray(keep), told)
        last, told = told, problem.voltage_information(z, log_v, motor_force)
        if last is not None and told is not None:  # in units of the noise just found
            scale = jnp.sqrt(told.share / last.share)
            residual = residual | {"voltage": told.residual}
            both = scale[:, :, None] * scale[:, None, :]
            spread = spread | {"voltage": spread["voltage"] * both}
    if told is not None and scoring:  # the Jacobian by R changes by more than its scale
        electric = problem.electric(z, log_v)
        whole, jacobian = problem.linear(z, electric)
    information = np.asarray(problem.precision(jacobian, log_v, keep))
    covariance = np.linalg.inv(information)
    if scoring:
        weight, motion = seen.whitening.weight["motion"], (whole["motion"], jacobian["motion"])
        found = effect_variances(objective, motion, weight, covariance, np.asarray(log_v))
        found[objective.pooled] = pooled(information, z, objective, np.asarray(log_v))
        log_v = jnp.asarray(found)
    std = np.sqrt(np.diag(covariance))
    moved = float(np.max(np.abs(z - state.z) / std, initial=0.0))
    moved = max(moved, float(np.max(np.abs(np.asarray(log_v) - state.log_variance)) / 3))
    return FitState(
        z=z,
        log_variance=np.asarray(log_v),
        round=state.round + 1,
        loss=problem.loss(z, log_v, keep, problem.weighed(whole, log_v, keep, effect), electric),
        moved=moved,
        stage=state.stage,
        effect=np.asarray(effect),
    )


def staged_start(problem: Problem, keep: np.ndarray, tell: Callable[[FitState], None]) -> FitState:
    """Motor by regression, then every floor by itself from several starts, best start per floor.

    Floors share nothing while the shared numbers are held, so one masked fit of all floors is a fit
    of each by itself.
    """
    space, labels = problem.space, problem.robot.surfaces.labels
    mask = space.where(lambda e: e.surface is not None).astype(float)
    creep = space.where(lambda e: e.quantity == "surface.creep")
    # far from the optimum every run is an outlier
    usual = {"camera": 1.0, "pooled": 1.0} | dict.fromkeys(SHARED, 0.1)
    wide = [usual.get(c.kind, 3.0) for c in problem.noise.components]
    log_v = 2 * np.log(problem.noise.typical) + 2 * np.log(wide)
    first = _motor_start(problem, keep)
    independent = problem.without_shared_effects()
    best, z = np.full(len(labels), np.inf), first.copy()
    floors = np.asarray(problem.batch.surface)
    of_floor = np.repeat([e.surface or "" for e in space.free], [e.coordinates for e in space.free])
    for attempt, value in enumerate(CREEPS):
        stage = f"floor by floor, start {attempt + 1} of {len(CREEPS)}"
        start = np.where(creep, np.log(value), first)
        state = FitState(start, log_v, 0, np.inf, np.inf, stage)
        for steps in (15, 6, 6):  # the damping has to grow from 1 to the size of the problem first
            state = one_round(independent, state, keep, mask, steps=steps, scoring=0)
            tell(state)
        residual, _ = independent.linear(state.z, problem.electric(state.z, state.log_variance))
        weight = problem.whitening(residual, state.log_variance, problem.full_weight).weight[
            "motion"
        ]
        cost = -np.log(np.asarray(weight))  # as good as the loss, but for factor and constant
        for number, label in enumerate(labels):
            mine = float(np.sum(cost[(floors == number) & (keep[: len(floors)] > 0)]))
            if mine < best[number]:
                best[number] = mine
                z = np.where(of_floor == label, state.z, z)
    return FitState(z, log_v, 0, np.inf, np.inf, "joint")


def _motor_start(problem: Problem, keep: np.ndarray) -> np.ndarray:
    """Search vector with R and C_e by regression of the voltage where it is logged."""
    z = problem.space.start.copy()
    w = problem.windows.segments(np.flatnonzero(keep > 0))
    if not (w.has_voltage and w.has_current):
        return z
    speed = (w.turn / w.dt[..., None]).ravel()
    amps = w.current.ravel() if w.current_is_signed else (w.current.ravel() * np.sign(speed))
    wm = speed * float(problem.robot.motor.gear_ratio)
    a, *_ = np.linalg.lstsq(np.stack([amps, wm], -1), w.voltage.ravel(), rcond=None)
    place = problem.space.slices
    for path, value in (("motor.resistance", a[0]), ("motor.back_emf", a[1])):
        if path in place and value > 0:
            z[place[path]] = np.log(value)
    return z


class LeastSquaresInputs(eqx.Module):
    """What is held while the structural numbers move from z.

    The mask is 1 for coordinates that may move; root whitens residuals, tied is what runs share
    given these; prior_std is of every coordinate, electric what voltages are predicted with, felt
    what motors work against at z, which currents and voltages are predicted from, and
    slope that of log |d residuals / d data| by the search vector.
    """

    objective: Objective
    z: Float[Array, " free"]
    mask: Float[Array, " free"]
    root: Blocks
    effects: tuple[EffectPosterior, ...]
    prior_std: Float[Array, " free"]
    electric: lk.ElectricNoise
    motor_force: lk.MotorForce
    slope: Float[Array, " free"]


class LimitedLevenberg(optx.LevenbergMarquardt):
    """Levenberg-Marquardt that ends after so many steps that were taken.

    One that is refused shrinks the next, and to stop among refused ones would look like having
    arrived. The solver counts its look at the start as a step that was taken.
    """

    most: Array

    def __init__(self, most: int):
        super().__init__(rtol=1e-6, atol=1e-8, linear_solver=lx.Normal(lx.Cholesky()))
        self.most = jnp.asarray(most)

    def terminate(
        self,
        fn: Any,
        y: Array,
        args: LeastSquaresInputs,
        options: Any,
        state: Any,
        tags: frozenset[object],
    ) -> tuple[Array, optx.RESULTS]:
        done, result = super().terminate(fn, y, args, options, state, tags)
        taken = state.num_accepted_steps - 1 >= self.most
        return done | taken | (state.num_steps >= self.most + _REFUSED), result


@eqx.filter_jit
def levenberg(held: LeastSquaresInputs, solver: LimitedLevenberg) -> Float[Array, " free"]:
    """Search vector after the solver's steps with fixed whitening."""
    start = jnp.zeros_like(held.z)
    found = optx.least_squares(_stacked, solver, start, held, max_steps=None, throw=False)
    return _at(held, found.value)


def _multi_floor_residuals(of: MultiFloorBatch, robot: Robot, given: Robot) -> Blocks:
    """Residuals of runs over several floors: their currents move electric numbers only.

    Friction moves the equilibrium that currents come from, so that it is found for them, too.
    """
    motion = {
        MULTI_FLOOR_MOTION: of.residuals(robot, lk.predict(robot, of.batch))[MULTI_FLOOR_MOTION]
    }
    return of.residuals(given, lk.predict(given, of.batch)) | motion


def _at(held: LeastSquaresInputs, y: Array) -> Array:
    """Search vector of a step in prior stds."""
    return held.z + held.mask * held.prior_std * y


def _stacked(y: Array, held: LeastSquaresInputs) -> Array:
    """Whitened residuals of all blocks and of the prior."""
    objective, space = held.objective, held.objective.space
    z = _at(held, y)
    robot, given = space.tree(z), space.tree(jnp.where(space.electric, z, held.z))
    motion = lk.motion_residual(robot, objective.batch, lk.predict(robot, objective.batch))
    # currents and voltages given the motion of the round's start
    electric = lk.electric_residuals(given, objective.batch, held.motor_force, held.electric)
    blocks = {"motion": motion} | electric
    if objective.multi_floor is not None:
        blocks |= _multi_floor_residuals(objective.multi_floor, robot, given)
    white = {k: jnp.einsum("nij,nj->ni", held.root[k], r) for k, r in blocks.items()}
    parts = [
        marginal_residuals(held.effects, w) if k == "motion" else w.ravel()
        for k, w in white.items()
    ]
    # the slope of the log Jacobian adds slope . z to the log posterior
    mean = space.prior_mean + held.prior_std**2 * held.slope
    return jnp.concatenate([*parts, (z - mean) / held.prior_std])
