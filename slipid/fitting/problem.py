"""Posterior of a robot's parameters given windows of its runs, compiled once for each shape."""

import copy
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from glob import escape
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from slipid.data.runs import Runs
from slipid.data.windows import Windows
from slipid.fitting import likelihood as lk
from slipid.fitting import variances
from slipid.fitting.multi_floor import (
    MULTI_FLOOR_CURRENT,
    MULTI_FLOOR_MOTION,
    MultiFloorBatch,
    MultiFloorRuns,
)
from slipid.fitting.noise import POOLED, SHARED, electric_noise, noise
from slipid.fitting.shared_effects import (
    Posteriors,
    effect_posteriors,
    effects_by_floor,
    marginal_residuals,
    mean_effects,
)
from slipid.fitting.variances import (
    VARIANCE_SPREAD,
    Blocks,
    Objective,
    Search,
    Vector,
    VoltageInformation,
    Whitening,
    voltage_information,
)
from slipid.model.robot import Robot
from slipid.search_space import HELD, Choice, Space

CREEPS = (0.05, 0.4, 1.0)
"""Start values of the creep (slip ratio of full traction) of every floor.

Fits from other start values have ended in poor local minima.
"""
_NEAR_ZERO = 1e-4
"""Value of a viscous term that cannot be determined."""
MOST_FOR_ZERO_EFFECTS = 200
"""Largest number of segments for which `without_shared_effects` keeps the effects with zero
variance.

Up to this number the extra arithmetic costs less time than compiling a fit without effects."""


@dataclass(frozen=True)
class FitState:
    """State of a fit, sufficient to continue it.

    Attributes:
        z: search vector.
        log_variance: log variances of the noise.
        round: number of finished rounds.
        loss: minus log posterior up to a constant.
        moved: largest change in the last round: of a number in posterior stds, or a third of the
            change of a log variance.
        stage: current stage of the fit, as a string for progress reports.
        effect: mean shared effects along, across [m/m] and in yaw [rad/m]; None before the first
            estimate.
    """

    z: Search
    log_variance: Float[np.ndarray, " variance"]
    round: int
    loss: float
    moved: float
    stage: str
    effect: Float[np.ndarray, "segment 3"] | None = None

    def shared(self, segments: int) -> Float[np.ndarray, "segment 3"]:
        """Return the shared effects of `segments` segments; zero before the first estimate."""
        return np.zeros((segments, 3)) if self.effect is None else self.effect

    @property
    def arrays(self) -> dict[str, Any]:
        """Values that a checkpoint stores, keyed by name."""
        return {name: value for name, value in vars(self).items() if value is not None}

    @classmethod
    def of(cls, kept: Mapping[str, np.ndarray]) -> "FitState":
        """Return the state whose `arrays` a checkpoint has stored."""
        plain: dict[str, Any] = {k: v if v.ndim else v.item() for k, v in kept.items()}
        return cls(**plain)


class Problem:
    """Likelihood of a set of windows as functions of the search vector.

    Currents and voltages do not change the parameters that motion determines (a "cut" posterior):
    the torque scale is estimated from currents given the motion, and the errors of the motion are
    propagated. Otherwise a motor friction model that is accurate to 5 % of the current would
    overrule forces that motion determines to 1 %.

    The argument `keep` of the methods is 1 for segments that are used and 0 for others. `compiled`
    holds functions that other modules have compiled for windows of these shapes; each module
    chooses keys that no other module uses.
    """

    def __init__(self, windows: Windows, robot: Robot, choices: Sequence[Choice]):
        self.space = Space(robot, choices)
        self.robot: Robot = self.space.template
        self.compiled: dict[Any, Any] = {}
        self._read(windows, None)

    def of(self, windows: Windows) -> "Problem":
        """Return the same problem for other windows; equal shapes share compiled functions."""
        other = copy.copy(self)
        other._read(windows, self.multi_floor)
        return other

    def with_multi_floor(self, multi_floor: MultiFloorRuns | None) -> "Problem":
        """Return the same problem with other runs over several floors, or without any."""
        other = copy.copy(self)
        other.compiled = {}
        other._read(self.windows, multi_floor)
        return other

    def holding(self, fixed: Sequence[Choice], choices: Sequence[Choice]) -> "Problem":
        """Return the same problem with some parameters fixed, unless `choices` override this.

        The priors of these parameters are so narrow that their values cannot change. The search
        vector keeps its coordinates, so that nothing is compiled anew.
        """
        narrow = [
            Choice(c.pattern, start=c.fixed, prior_mean=c.fixed, prior_std=HELD * c.fixed)
            for c in fixed
        ]
        other = copy.copy(self)
        other.space = Space(self.robot, [*narrow, *choices])
        other._read(self.windows, self.multi_floor)
        return other

    def _read(self, windows: Windows, multi_floor: MultiFloorRuns | None) -> None:
        self.windows, self.multi_floor = windows, multi_floor
        self.noise = noise(windows, self.robot, multi_floor)
        shared, self.speeds_and_loads = effects_by_floor(windows, self.robot, self.noise)
        kinds = np.array([c.kind for c in self.noise.components])
        batch = None if multi_floor is None else MultiFloorBatch.of(multi_floor, self.robot)
        self.objective = Objective(
            space=self.space,
            batch=lk.batch(windows, self.robot),
            multi_floor=batch,
            blocks=self.noise.blocks,
            shared=shared,
            typical=jax.device_put(2 * np.log(self.noise.typical)),
            scored=~np.isin(kinds, ("run", "pooled", *SHARED)),
            pooled=self.noise.names.index(POOLED),
            joint=not windows.has_current and MULTI_FLOOR_CURRENT not in self.noise.blocks,
        )

    @property
    def full_weight(self) -> Float[np.ndarray, " segment"]:
        """Array of weight 1 for every segment; segments of runs over several floors come last."""
        more = () if self.multi_floor is None else self.multi_floor.counts
        return np.ones(len(self.windows) + len(more))

    def carried_over(self, state: FitState, of: "Problem") -> FitState:
        """Return a state of another problem as a state of this one.

        Both problems have the same fitted parameters. Variances are matched by name; those that the
        other problem does not have start at their typical values.
        """
        known = dict(zip(of.noise.names, state.log_variance, strict=True))
        log_v = [known.get(c.name, 2 * np.log(c.typical)) for c in self.noise.components]
        return replace(state, log_variance=np.array(log_v), moved=np.inf)

    def without_shared_effects(self) -> "Problem":
        """Return the same problem as if runs shared no effects.

        Up to `MOST_FOR_ZERO_EFFECTS` segments, the effects stay in the problem with variance zero,
        so that the same compiled fit serves both problems.
        """
        other, shared = copy.copy(self), self.objective.shared
        none = tuple(replace(of, numbers=jnp.full_like(of.numbers, -1)) for of in shared)
        other.objective = replace(
            self.objective, shared=none if len(self.windows) <= MOST_FOR_ZERO_EFFECTS else ()
        )
        return other

    @property
    def batch(self) -> lk.Batch:
        return self.objective.batch

    def linear(self, z: Vector, electric: lk.ElectricNoise) -> tuple[Blocks, Blocks]:
        """Return residual blocks (segment, m) and their Jacobians (segment, m, free) at z."""
        return linear(self.objective, z, electric)[:2]

    def covariance(self, block: str, log_v: Vector) -> Array:
        """Return the covariance of the residuals of a block (segment, m, m)."""
        return self.noise.blocks[block].covariance(log_v)

    def whitening(self, residual: Blocks, log_v: Vector, keep: Vector) -> Whitening:
        return variances.whitening(self.noise.blocks, residual, log_v, keep)

    def precision(self, jacobian: Blocks, log_v: Vector, keep: Vector) -> Array:
        return variances.precision(self.objective, jacobian, log_v, keep)

    def laplace(
        self, z: Vector, log_v: Vector, keep: Vector, alone: bool = False
    ) -> Float[np.ndarray, "free free"]:
        """Return the covariance of the search vector: inverse information, prior included.

        If `alone`, every run is treated as if it shared no effects with others.
        """
        jacobian = self.linear(z, self.electric(z, log_v))[1]
        information = variances.precision(self.objective, jacobian, log_v, keep, alone)
        return np.linalg.inv(np.asarray(information))

    def laplaces(
        self, z: Vector, log_v: Sequence[Vector], keep: Vector
    ) -> Iterator[Float[np.ndarray, "free free"]]:
        """Yield the covariance of the search vector for each of several sizes of the noise.

        The Jacobian is shared, so that predictions of voltages assume the first size of the noise.
        """
        jacobian = self.linear(z, self.electric(z, log_v[0]))[1]
        for one in log_v:
            information = variances.precision(self.objective, jacobian, one, keep)
            yield np.linalg.inv(np.asarray(information))

    def weighed(
        self, residual: Blocks, log_v: Vector, keep: Vector, effect: Vector
    ) -> "WeighedResiduals":
        """Return weighted residuals; the weights come from residuals less the shared effects.

        `effect` holds the latest estimate of the shared effects (segment, 3).
        """
        where = jax.device_put((np.asarray(log_v), np.asarray(keep), np.asarray(effect)))
        return _weighed(self.objective, residual, *where)

    def loss(
        self, z: Vector, log_v: Vector, keep: Vector, at: "WeighedResiduals", e: lk.ElectricNoise
    ) -> float:
        """Return minus the log posterior of parameters and variances, up to a constant.

        Args:
            at: weighted residuals at z and log_v.
            e: noise that predictions of voltages depend on.
        """
        nll = float(at.loss) - float(log_jacobian(self.objective, z, e, keep)[0])
        prior_std = np.asarray(self.objective.prior_std(log_v))
        deviation = (np.asarray(z) - self.space.prior_mean) / prior_std
        nll += float(np.log(prior_std).sum())
        spread = (np.asarray(log_v) - np.asarray(self.objective.typical)) / VARIANCE_SPREAD
        return nll + 0.5 * float(np.sum(deviation**2)) + 0.5 * float(np.sum(spread**2))

    def electric(self, z: Vector, log_v: Vector) -> lk.ElectricNoise:
        """Return the noise that predictions of voltages depend on, at given values."""
        return _electric(self.objective, z, log_v)

    def voltage_information(
        self, z: Vector, log_v: Vector, motor_force: Array
    ) -> VoltageInformation | None:
        """Return what voltages tell about variances; None if no voltages are logged."""
        if "voltage" not in self.noise.blocks:
            return None
        return voltage_information(self.objective, z, log_v, motor_force)


class WeighedResiduals(NamedTuple):
    """Weights of residuals at given variances, and the posterior of the effects that runs share.

    Attributes:
        whitening: weights and whitening roots, from residuals less the shared effects.
        effects: posterior of the shared effects, given residuals whitened by these roots.
        loss: minus log likelihood of the residuals, shared effects marginalised, up to a constant.
    """

    whitening: Whitening
    effects: Posteriors
    loss: Array


@eqx.filter_jit
def _weighed(
    objective: Objective, residual: Blocks, log_v: Array, keep: Array, effect: Array
) -> WeighedResiduals:
    own, motion = without_effects(objective, residual, effect), residual["motion"]
    found = variances.whitening(objective.blocks, own, log_v, keep)
    root = found.root["motion"]
    posteriors = effect_posteriors(objective.shared, log_v, root)
    rows = marginal_residuals(posteriors, jnp.einsum("nij,nj->ni", root, motion))
    coefs = rows[motion.size :]
    log_det = sum(jnp.sum(jnp.log(jnp.diagonal(p.factor))) for p in posteriors)
    return WeighedResiduals(found, posteriors, found.loss + 0.5 * jnp.sum(coefs**2) + log_det)


@eqx.filter_jit
def without_effects(objective: Objective, residual: Blocks, effect: Array) -> Blocks:
    """Return residual blocks less shared effects (segment, 3)."""
    motion = residual["motion"]
    for of in objective.shared:
        off = jnp.einsum("nma,na->nm", of.effect, effect[of.segments])
        motion = motion.at[of.segments].add(-off)
    return residual | {"motion": motion}


@eqx.filter_jit
def effects_given(posteriors: Posteriors, root: Array, motion: Array) -> Array:
    """Return the conditional mean of the shared effects (segment, 3) given motion residuals."""
    return mean_effects(posteriors, jnp.einsum("nij,nj->ni", root, motion))


class GivenMotion(eqx.Module):
    """Motion from which currents and voltages are predicted while the search vector changes.

    Attributes:
        applies: True if electric residuals depend on electric parameters alone, given this motion;
            False if they depend on all parameters at once.
        z: search vector from which the other parameters are taken.
        motor_force: motor forces at z [mu m g].
        following: how electric parameters follow the others (free, free), see
            `electric_following`. Only what they do not follow changes electric residuals. It is
            used if there are runs over several floors.
    """

    applies: Bool[np.ndarray, ""]
    z: Vector
    motor_force: lk.MotorForce | Float[np.ndarray, "segment window drive 2"]
    following: Array | Float[np.ndarray, "free free"]


class Twists(NamedTuple):
    """Body twists of all windows, from which the root finder starts at the next search vector.

    NaN stands for twists that are not known.

    Attributes:
        steady: twists of the windows on one floor.
        multi_floor: twists of the windows of runs over several floors, None without such runs.
        electric: the same twists for the robot from which currents are predicted.
    """

    steady: lk.NearTwists
    multi_floor: lk.NearTwists | None
    electric: lk.NearTwists | None

    @classmethod
    def unknown(cls, objective: Objective) -> "Twists":
        """Return NaN for all windows of an objective."""
        none, of = np.full((*objective.batch.dt.shape, 3), np.nan), objective.multi_floor
        more = None if of is None else np.full((*of.batch.dt.shape, 3), np.nan)
        return cls(none, more, more)


class ResidualsAt(NamedTuple):
    """Residuals at a search vector.

    Attributes:
        residual: residual blocks (segment, m).
        jacobian: their derivatives with respect to the search vector (segment, m, free).
        motor_force: forces of every motor [mu m g].
        twists: body twists of all windows.
    """

    residual: Blocks
    jacobian: Blocks
    motor_force: Array
    twists: Twists


def linear(
    objective: Objective, z: Vector, electric: lk.ElectricNoise, near: Twists | None = None
) -> ResidualsAt:
    """Return the residuals at a search vector, with electric residuals that depend on all of it.

    `near` holds the twists at a search vector close to z, which make the root finder faster.
    """
    no_force = np.zeros((*objective.batch.turn.shape, 2))
    none = np.zeros((len(z), len(z)))
    given = GivenMotion(np.array(False), np.zeros(len(z)), no_force, none)
    return linear_given(objective, z, electric, given, near or Twists.unknown(objective))


@eqx.filter_jit
def linear_given(
    objective: Objective, z: Vector, electric: lk.ElectricNoise, given: GivenMotion, near: Twists
) -> ResidualsAt:
    """Return the residuals at a search vector, given the motion that electric residuals assume.

    Both kinds of electric residuals are compiled together: to compile them apart would take longer
    than a whole fit to few runs.
    """
    space, batch = objective.space, objective.batch

    def blocks(x: Array) -> tuple[Blocks, ResidualsAt]:
        robot = space.tree(x)
        own = x
        if objective.multi_floor is not None:
            own -= jnp.where(given.applies, given.following @ (x - given.z), 0.0)
        electrical = space.tree(jnp.where(given.applies & ~space.electric, given.z, own))
        p = lk.predict(robot, batch, near.steady)
        force = jax.lax.cond(
            given.applies,
            lambda: jnp.asarray(given.motor_force),
            lambda: lk.motor_forces(robot, batch, p.twist),
        )
        out = {"motion": lk.motion_residual(robot, batch, p)}
        out |= lk.electric_residuals(electrical, batch, force, electric)
        twists = Twists(p.twist, None, None)
        if (of := objective.multi_floor) is not None:
            # friction is an electric parameter that changes the motion of runs over several floors,
            # so that their currents need a prediction of their own
            mine = lk.predict(robot, of.batch, near.multi_floor)
            theirs = lk.predict(electrical, of.batch, near.electric)
            out |= of.residuals(electrical, theirs)
            out[MULTI_FLOOR_MOTION] = of.residuals(robot, mine)[MULTI_FLOOR_MOTION]
            twists = Twists(p.twist, mine.twist, theirs.twist)
        return out, ResidualsAt(out, {}, force, twists)

    tangent = np.arange(space.size) if objective.multi_floor else _tangents(space)

    def changed(change: Array) -> tuple[Blocks, ResidualsAt]:
        return jax.jvp(blocks, (jnp.asarray(z),), (change,), has_aux=True)[1:]

    changes = (np.arange(tangent.max(initial=-1) + 1)[:, None] == tangent).astype(float)
    slopes, found = jax.vmap(changed, out_axes=(-1, None))(changes)
    if not objective.multi_floor:
        depends = _dependence(space, batch)[:, None]
        slopes = {k: jnp.where(depends, s[..., tangent], 0.0) for k, s in slopes.items()}
    return found._replace(jacobian=slopes)


def _tangents(space: Space) -> Int[np.ndarray, " free"]:
    """Return, for each coordinate, the number of the tangent that differentiates it.

    Coordinates of one quantity on different floors, load set-ups or sessions share a tangent: every
    segment depends on one of them only, so that one derivative gives all their columns of the
    Jacobian. Source: Curtis, Powell and Reid 1974, IMA J. Appl. Math. 13(1).
    """
    of = [(e.quantity, k) for e in space.free for k in range(e.coordinates)]
    index = {key: number for number, key in enumerate(dict.fromkeys(of))}
    return np.array([index[key] for key in of], int)


def _dependence(space: Space, batch: lk.Batch) -> Bool[Array, "segment free"]:
    """Return True where the residuals of a segment may depend on a coordinate."""
    tree = space.template
    out = jnp.ones((len(batch.surface), space.size), bool)
    for label, names, of in (
        ("surface", tree.surfaces.labels, batch.surface),
        ("load", tree.body.loads, batch.load),
        ("session", tree.camera.sessions, batch.session),
    ):
        mine = np.repeat(
            [names.index(getattr(e, label)) if getattr(e, label) else -2 for e in space.free],
            [e.coordinates for e in space.free],
        )
        out &= (mine == -2) | (mine == of[:, None])
    return out


@eqx.filter_jit
def _electric(objective: Objective, z: Vector, log_v: Vector) -> lk.ElectricNoise:
    return electric_noise(objective.blocks, log_v, objective.space.tree(z).motor.resistance)


@eqx.filter_jit
def log_jacobian(
    objective: Objective, z: Vector, electric: lk.ElectricNoise, keep: Vector
) -> tuple[Array, Array]:
    """Return log |d residuals / d data| of all segments, and its gradient by the search vector."""

    def total(x: Array) -> Array:
        robot = objective.space.tree(x)
        each = sum(lk.log_jacobians(robot, objective.batch, electric))
        if objective.multi_floor is not None:
            each = jnp.concatenate([each, objective.multi_floor.log_jacobian(robot)])
        return jnp.asarray(keep) @ each

    return jax.value_and_grad(total)(z)


@eqx.filter_jit
def twists(space: Space, batch: lk.Batch, z: Vector) -> tuple[Array, Array]:
    """Return every window's body twist (segment, window, 3) and its derivatives (.., free)."""
    return lk.with_slope(lambda x: lk.predict(space.tree(x), batch).twist, z)


def fixed_viscosities(data: Runs, runs: Iterable[int] | np.ndarray | None = None) -> list[Choice]:
    """Return choices that fix the viscous terms near zero on floors driven at one speed only.

    At one speed, viscous terms cannot be distinguished from creep, and a wrong division between the
    two makes wrong predictions at every other speed.
    """
    driven: dict[str, list[float]] = {}
    for k in range(len(data)) if runs is None else runs:
        driven.setdefault(data.logs[k].surface or "unknown", []).append(float(data.speed[k]))
    out = []
    for floor, speeds in driven.items():
        known = np.asarray(speeds)[np.isfinite(speeds)]
        if len(known) == len(speeds) and known.max() < 1.3 * max(known.min(), 1e-3):
            names = (f"surface.{floor}.{name}" for name in ("slide_viscosity", "roller_viscosity"))
            out += [Choice(escape(path), fixed=_NEAR_ZERO) for path in names]
    return out
