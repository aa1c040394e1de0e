"""Maximum a posteriori fit, which alternates Student-t weights, parameters and noise variances."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from slipid.fitting import likelihood as lk
from slipid.fitting.hierarchy import axis_effects, effect_variances, pooled
from slipid.fitting.noise import SHARED
from slipid.fitting.problem import (
    CREEPS,
    FitState,
    GivenMotion,
    Problem,
    Twists,
    effects_given,
    linear,
    linear_given,
    log_jacobian,
    without_effects,
)
from slipid.fitting.shared_effects import Posteriors, marginal_residuals
from slipid.fitting.variances import (
    Blocks,
    Objective,
    Search,
    Square,
    Vector,
    electric_following,
    fitted_covariance,
    scoring_step,
)
from slipid.search_space import Space

LENGTHS = ("robot.wheel_radius", "robot.radius_deviation", "robot.base_radius")
"""Paths of the lengths of the robot that slip can imitate."""
HELD_ROUNDS = 2
"""Number of rounds of the staged start in which all parameters but these lengths move."""
FLOOR_STEPS = (15, 6, 6)
"""Largest numbers of solver steps in the rounds that fit each floor, from each start."""
SAME_LENGTHS = 0.02
"""Largest difference between lengths that are taken for the same, over the lengths [1]."""
_MOST_REFUSED = 12
"""Largest number of steps that the solver may refuse in a round."""


@dataclass(frozen=True, eq=False)
class Optimum:
    """Result of a fit: its last state, the covariance there, and whether it converged.

    Attributes:
        state: state after the last round.
        covariance: Laplace covariance of the search vector.
        converged: True if the last round changed less than the tolerance.
        reason: reason why the fit stopped, as a sentence.
        history: loss after every round, minus log posterior up to a constant.
    """

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
    """Return the maximum a posteriori, searched from `staged_start` or from a given state.

    Args:
        keep: 1 for segments that are fitted, 0 for held-out ones, in the order of
            `Problem.full_weight`; all 1 by default. Folds of a cross-validation differ in this
            argument only, so that they share compiled functions.
        start: state to continue from instead of the staged start.
        most_rounds: largest number of rounds.
        tolerance: the fit stops after a round in which every fitted parameter changed by less than
            this many posterior stds, and every log variance by less than three times as much.
        tell: function called after every round, for progress and checkpoints.
        free: 1 for coordinates that may change from the start, 0 for fixed ones (free,).
        variances: True if the variances of the noise are fitted, too.
    """
    keep = problem.full_weight if keep is None else np.asarray(keep, float)
    state = staged_start(problem, keep, tell) if start is None else replace(start, stage="joint")
    mask = np.ones(problem.space.size) if free is None else np.asarray(free, float)
    history: list[float] = []
    while state.round < most_rounds:
        early = state.round < 3
        scoring = (2 if early else 4) if variances else 0
        steps = 8 if early else 4
        if problem.multi_floor is not None:
            steps = 1  # the electric parameters follow the motion to first order only
        state = one_round(problem, state, keep, mask, steps=steps, scoring=scoring)
        history.append(state.loss)
        tell(state)
        if state.moved < tolerance:
            break
    covariance = problem.laplace(state.z, state.log_variance, keep)
    reason = f"{most_rounds} rounds without convergence"
    if settled := state.moved < tolerance:
        reason = f"no parameter changed by {100 * tolerance:g} % of its std in round {state.round}"
    return Optimum(state, covariance, settled, reason, tuple(history))


def one_round(
    problem: Problem,
    state: FitState,
    keep: Float[np.ndarray, " segment"],
    mask: Search,
    steps: int,
    scoring: int,
) -> FitState:
    """Return the state after one round: weights, then parameters, then variances.

    Args:
        mask: 1 for coordinates that may move, 0 for fixed ones.
        steps: largest number of solver steps of the parameters.
        scoring: number of scoring steps of the variances.
    """
    objective, log_v = problem.objective, jnp.asarray(state.log_variance)
    electric = problem.electric(state.z, log_v)
    start = linear(objective, jnp.asarray(state.z), electric)
    before = state.shared(len(problem.windows))
    weighed = problem.weighed(start.residual, log_v, keep, before)
    root = weighed.whitening.root
    fixed = RoundInputs(
        objective=objective,
        z=jnp.asarray(state.z),
        mask=jnp.asarray(mask),
        root=root,
        effects=weighed.effects,
        prior_std=objective.prior_std(log_v),
        electric=electric,
        motor_force=start.motor_force,
        slope=log_jacobian(objective, state.z, electric, keep)[1],
        following=electric_following(objective, start.jacobian, root, log_v) * mask[:, None],
    )
    y, near = levenberg(partial(linearised, fixed), len(state.z), start.twists, steps)
    z = np.asarray(_at(fixed, y))
    electric = problem.electric(z, log_v)
    whole, jacobian, motor_force, near = linear(objective, jnp.asarray(z), electric, near)
    effect = effects_given(weighed.effects, root["motion"], whole["motion"])
    # Weights and effects depend on each other: full steps of both could oscillate forever, so the
    # effects change by half a step.
    effect = 0.5 * (effect + before) if state.round else effect
    residual = without_effects(objective, whole, effect)
    voltage = problem.voltage_information(z, log_v, motor_force)
    if scoring:
        spread = fitted_covariance(objective, jacobian, log_v, jnp.asarray(keep))
    for _ in range(scoring):
        log_v = scoring_step(objective, residual, spread, log_v, jnp.asarray(keep), voltage)
        last, voltage = voltage, problem.voltage_information(z, log_v, motor_force)
        # The spread that divides voltage residuals depends on log_v, which has just changed.
        if last is not None and voltage is not None:
            scale = jnp.sqrt(voltage.share / last.share)
            residual = residual | {"voltage": voltage.residual}
            both = scale[:, :, None] * scale[:, None, :]
            spread = spread | {"voltage": spread["voltage"] * both}
    # A changed noise does more than rescale the derivative with respect to R: it is computed anew.
    if voltage is not None and scoring:
        electric = problem.electric(z, log_v)
        whole, jacobian, *_ = linear(objective, jnp.asarray(z), electric, near)
    information = np.asarray(problem.precision(jacobian, log_v, keep))
    covariance = np.linalg.inv(information)
    if scoring:
        weight, motion = weighed.whitening.weight["motion"], (whole["motion"], jacobian["motion"])
        axes = axis_effects(objective, motion, weight, covariance, np.asarray(log_v))
        found = effect_variances(axes, np.asarray(log_v))
        spread_of_loads = pooled(information, z, objective, np.asarray(log_v))
        if problem.multi_floor is not None:
            # With one step in a round, the loads follow their variance late: full changes of both
            # could oscillate for ever, so the variance changes by half of it.
            spread_of_loads = 0.5 * (spread_of_loads + state.log_variance[objective.pooled])
        found[objective.pooled] = spread_of_loads
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


def start_rounds(space: Space) -> int:
    """Return the number of rounds of `staged_start`."""
    apart = np.abs(space.start - space.prior_mean)[_lengths(space)].max(initial=0.0) > SAME_LENGTHS
    return len(CREEPS) * len(FLOOR_STEPS) * (2 if apart else 1) + HELD_ROUNDS


def staged_start(problem: Problem, keep: np.ndarray, tell: Callable[[FitState], None]) -> FitState:
    """Return a start for the joint fit: motor by regression, then each floor from several starts.

    While all other parameters are fixed, floors have no parameter in common, so that one fit in
    which only the floors' parameters may move fits each floor independently. The start with the
    least loss is chosen floor by floor. Lengths may start from a calibration, which slip has made
    shorter; if they differ from the means of their priors, all is repeated from those means, and
    the better of the two is chosen. Last, all parameters but the lengths are fitted in a few
    rounds: with outliers and variances of the noise still unknown, lengths that move at once can
    end in an optimum where they stand for slip.
    """
    space = problem.space
    first, lengths = _motor_start(problem, keep), _lengths(space)
    found, loss = _floors_fitted(problem, keep, tell, first, "")
    if np.abs(first - space.prior_mean)[lengths].max(initial=0.0) > SAME_LENGTHS:
        again = np.where(lengths, space.prior_mean, first)
        other, loss_of_other = _floors_fitted(problem, keep, tell, again, ", lengths of the config")
        found = other if loss_of_other < loss else found
    state = replace(found, stage="all but the lengths")
    for _ in range(HELD_ROUNDS):
        state = one_round(problem, state, keep, (~lengths).astype(float), steps=8, scoring=2)
        tell(state)
    return replace(state, round=0, moved=np.inf, stage="joint")


def _floors_fitted(
    problem: Problem,
    keep: np.ndarray,
    tell: Callable[[FitState], None],
    first: np.ndarray,
    remark: str,
) -> tuple[FitState, float]:
    """Return a start vector with each floor fitted, and its loss but for a factor and an offset.

    `first` is the vector before; `remark` is appended to the name of the stage.
    """
    space, labels = problem.space, problem.robot.surfaces.labels
    mask = space.where(lambda e: e.surface is not None).astype(float)
    creep = space.where(lambda e: e.quantity == "surface.creep")
    # Far from the optimum every run would be an outlier, so start with large variances.
    usual = {"camera": 1.0, "pooled": 1.0} | dict.fromkeys(SHARED, 0.1)
    wide = [usual.get(c.kind, 3.0) for c in problem.noise.components]
    log_v = 2 * np.log(problem.noise.typical) + 2 * np.log(wide)
    independent = problem.without_shared_effects()
    best, z = np.full(len(labels), np.inf), first.copy()
    floors = np.asarray(problem.batch.surface)
    of_floor = np.repeat([e.surface or "" for e in space.free], [e.coordinates for e in space.free])
    for attempt, value in enumerate(CREEPS):
        stage = f"floor by floor, start {attempt + 1} of {len(CREEPS)}{remark}"
        start = np.where(creep, np.log(value), first)
        state = FitState(start, log_v, 0, np.inf, np.inf, stage)
        # Many steps at first, since the damping starts at 1, far below the scale of the problem.
        for steps in FLOOR_STEPS:
            state = one_round(independent, state, keep, mask, steps=steps, scoring=0)
            tell(state)
        residual, _ = independent.linear(state.z, problem.electric(state.z, state.log_variance))
        found = problem.whitening(residual, state.log_variance, problem.full_weight)
        # the loss of each segment, up to a factor and an offset
        cost = -np.log(np.asarray(found.weight["motion"]))
        for number, label in enumerate(labels):
            mine = float(np.sum(cost[(floors == number) & (keep[: len(floors)] > 0)]))
            if mine < best[number]:
                best[number] = mine
                z = np.where(of_floor == label, state.z, z)
    return FitState(z, log_v, 0, np.inf, np.inf, "joint"), float(best.sum())


def _lengths(space: Space) -> Bool[np.ndarray, " free"]:
    """Return True for the coordinates of the lengths of the robot."""
    return space.where(lambda e: e.path in LENGTHS)


def _motor_start(problem: Problem, keep: np.ndarray) -> np.ndarray:
    """Return the start vector with resistance R and back-EMF C_e regressed from logged voltages."""
    z = problem.space.start.copy()
    w = problem.windows.segments(np.flatnonzero(keep > 0))
    if not (w.has_voltage and w.has_current):
        return z
    speed = (w.turn / w.dt[..., None]).ravel()
    amps = w.current.ravel() if w.current_is_signed else (w.current.ravel() * np.sign(speed))
    wm = speed * float(problem.robot.motor.gear_ratio)
    a, *_ = np.linalg.lstsq(np.stack([amps, wm], -1), w.voltage.ravel(), rcond=None)
    slices = problem.space.slices
    for path, value in (("motor.resistance", a[0]), ("motor.back_emf", a[1])):
        if path in slices and value > 0:
            z[slices[path]] = np.log(value)
    return z


class RoundInputs(eqx.Module):
    """Quantities that stay fixed during a round while the solver changes the search vector from z.

    Attributes:
        objective: the objective of the fit.
        z: search vector at the start.
        mask: 1 for coordinates that may move.
        root: whitening roots of the residuals.
        effects: posterior of the shared effects given these roots.
        prior_std: prior std of every coordinate.
        electric: noise that predictions of voltages depend on.
        motor_force: motor forces at z [mu m g], from which currents and voltages are predicted.
        slope: derivative of log |d residuals / d data| with respect to the search vector.
        following: how electric parameters follow the others, see `electric_following`.
    """

    objective: Objective
    z: Float[Array, " free"]
    mask: Float[Array, " free"]
    root: Blocks
    effects: Posteriors
    prior_std: Float[Array, " free"]
    electric: lk.ElectricNoise
    motor_force: lk.MotorForce
    slope: Float[Array, " free"]
    following: Float[Array, "free free"]


class LinearisedResiduals(NamedTuple):
    """Whitened residuals of all blocks and of the prior after a step of the solver.

    Attributes:
        residual: whitened residuals.
        jacobian: their derivatives with respect to the step.
        twists: body twists of all windows.
    """

    residual: Float[np.ndarray, " row"]
    jacobian: Float[np.ndarray, "row free"]
    twists: Twists

    @property
    def loss(self) -> float:
        return 0.5 * float(self.residual @ self.residual)


def levenberg(
    linearised: Callable[[Search, Twists], LinearisedResiduals], size: int, near: Twists, steps: int
) -> tuple[Search, Twists]:
    """Return the vector after steps of the Levenberg-Marquardt method from zero, and its twists.

    A step is accepted if it lowers the loss by at least 1 % of what the linear model predicts, and
    the damping then falls if the model is right to 1 %; it rises after a refused step. Refused
    steps do not count: each makes the next one smaller, so that a round that stopped after refused
    steps would look like convergence.

    The loop is not compiled: it takes little time compared with the Jacobians, while its
    compilation would take as long as that of the model. Source: Gould et al. 2005, 4OR 3(3), for
    the constants.

    Args:
        linearised: function that returns the residuals at a vector, given twists near its own.
        size: number of coordinates of the vector.
        near: twists near those at zero.
        steps: largest number of accepted steps.
    """
    y = np.zeros(size)
    at, length, accepted = linearised(y, near), 1.0, 0
    for _ in range(steps + _MOST_REFUSED - 1):
        a = at.jacobian.T @ at.jacobian + np.eye(len(y)) / length
        step = -np.linalg.solve(a, at.jacobian.T @ at.residual)
        predicted = at._replace(residual=at.residual + at.jacobian @ step).loss - at.loss
        new = linearised(y + step, at.twists)
        if not new.loss - at.loss <= 0.01 * predicted:
            length *= 0.25
            continue
        length *= 3.5 if new.loss - at.loss < 0.99 * predicted else 1.0
        settled = _alike(y + step, y) and _alike(new.residual, at.residual)
        y, at, accepted = y + step, new, accepted + 1
        if settled or accepted >= steps:
            break
    return y, at.twists


def _alike(new: np.ndarray, old: np.ndarray) -> bool:
    """Return True if no element has changed by more than the solver's tolerance."""
    return bool((np.abs(new - old) < 1e-8 + 1e-6 * np.abs(new)).all())


def _at(fixed: RoundInputs, y: Vector) -> Vector:
    """Return the search vector after a step `y`, which is in units of the prior stds."""
    return fixed.z + fixed.mask * fixed.prior_std * y


def linearised(fixed: RoundInputs, y: Search, near: Twists) -> LinearisedResiduals:
    """Return whitened residuals and their derivative after a step `y` from the start.

    `near` holds the twists of all windows after a similar step.
    """
    z = _at(fixed, y)
    given = GivenMotion(np.array(True), fixed.z, fixed.motor_force, fixed.following)
    found = linear_given(fixed.objective, z, fixed.electric, given, near)
    rows, slopes = _stacked(fixed, found.residual, found.jacobian, z)
    return LinearisedResiduals(np.asarray(rows), np.asarray(slopes), found.twists)


@eqx.filter_jit
def _stacked(
    fixed: RoundInputs, residual: Blocks, jacobian: Blocks, z: Vector
) -> tuple[Array, Array]:
    """Return the whitened residuals of all blocks and of the prior, and their derivative."""

    def rows(blocks: Blocks) -> Array:
        white = {k: jnp.einsum("nij,nj->ni", fixed.root[k], r) for k, r in blocks.items()}
        rest = [w.ravel() for k, w in white.items() if k != "motion"]
        return jnp.concatenate([marginal_residuals(fixed.effects, white["motion"]), *rest])

    scale = fixed.mask * fixed.prior_std
    # the log Jacobian adds slope . z to the log posterior: to first order it shifts the prior mean
    mean = fixed.objective.space.prior_mean + fixed.prior_std**2 * fixed.slope
    slopes = jax.vmap(rows, -1, -1)(jacobian) * scale
    own = z - fixed.following @ (z - fixed.z)
    of_prior = (jnp.eye(len(scale)) - fixed.following) * scale / fixed.prior_std[:, None]
    return (
        jnp.concatenate([rows(residual), (own - mean) / fixed.prior_std]),
        jnp.concatenate([slopes, of_prior]),
    )
