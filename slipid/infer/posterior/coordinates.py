"""Coordinates of a density, and the data and fitted values from which it is computed."""

from dataclasses import dataclass, replace
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaln
from jaxtyping import Array, Bool, Float, Int

from slipid.fitting import likelihood as lk
from slipid.fitting.problem import Problem, effects_given, twists
from slipid.fitting.shared_effects import EffectPosterior, SharedEffects
from slipid.fitting.variances import DEGREES, Blocks, Square, Vector, expected, inverse_root
from slipid.infer.posterior.multi_floor_anchor import MultiFloorAnchor
from slipid.infer.result import Fit, required
from slipid.model.robot import Robot

MOTION, ELECTRIC, EVERYTHING = "motion", "electric", "everything"
"""Parts of a posterior: motion parameters, electric ones given the motion, all parameters."""
Part = TypeVar("Part")
OfFloor = TypeVar("OfFloor", SharedEffects, EffectPosterior)

_ROUNDS = 3
"""Number of alternations between weights of runs and shared effects at the fit."""


@dataclass(frozen=True, eq=False)
class Fitted:
    """Fitted values around which a posterior is sampled.

    Attributes:
        z: search vector.
        log_variance: log variances in the order of the problem's components.
        covariance: Laplace covariance with shared effects marginalised; if currents were logged,
            the covariance of p(electric | motion, data) p(motion | motion data).
        multi_floor: runs over several floors; None without such runs.
    """

    z: np.ndarray
    log_variance: np.ndarray
    covariance: Square
    multi_floor: MultiFloorAnchor | None = None

    @classmethod
    def of(cls, fit: Fit) -> "Fitted":
        """Return the fitted values, with the variances in the order of the fit's problem."""
        names = required(fit.problem).noise.names
        return cls(fit.z, np.log([fit.variance[name] for name in names]), fit.covariance)


def around(problem: Problem, fitted: Fitted) -> tuple[Problem, Fitted]:
    """Return the problem of the runs on one floor each, and the fitted values for it.

    The runs over several floors, if the problem has some, are in `Fitted.multi_floor`.
    """
    if problem.multi_floor is None:
        return problem, fitted
    several = MultiFloorAnchor.at(problem, fitted.z, fitted.log_variance)
    alone, found = on_one_floor(problem, fitted)
    return alone, replace(found, multi_floor=several)


def on_one_floor(problem: Problem, fitted: Fitted) -> tuple[Problem, Fitted]:
    """Return the problem without runs over several floors, and the fitted values for it."""
    alone = problem.with_multi_floor(None)
    # Currents of the runs left out may be the only ones.
    alone.objective = replace(alone.objective, joint=problem.objective.joint)
    kept = [problem.noise.names.index(name) for name in alone.noise.names]
    return alone, replace(fitted, log_variance=fitted.log_variance[kept])


class Coordinates(NamedTuple):
    """Coordinates of a part of the posterior.

    Attributes:
        structure: index of each coordinate in the search vector.
        group: index of the only floor whose residuals depend on it, -1 if there are several.
        touched: True where the residuals of a floor depend on a coordinate; with runs over several
            floors, the last row is that of these runs.
    """

    structure: Int[np.ndarray, " size"]
    group: Int[np.ndarray, " size"]
    touched: Bool[np.ndarray, "group size"]


def coordinates(problem: Problem, fitted: Fitted, part: str) -> Coordinates:
    """Return the coordinates of a part of the posterior.

    The group is the index of the only floor whose residuals depend on the coordinate, -1 if several
    floors or none depend on it; if the robot has one floor only, all coordinates are in group 0.
    With runs over several floors no coordinate has a group, and the friction that moves these runs
    belongs to the motion.
    The Jacobian at the fit shows which floors each coordinate affects.
    """
    _, jacobian = problem.linear(fitted.z, problem.electric(fitted.z, fitted.log_variance))
    surface = np.asarray(problem.batch.surface)
    touched = np.zeros((problem.space.size, len(problem.robot.surfaces.labels)), bool)
    for k, block in jacobian.items():
        if part == EVERYTHING or (part == MOTION) == (k == "motion"):
            moved = np.abs(np.asarray(block)).sum(axis=1) > 0
            for floor in range(touched.shape[1]):
                touched[:, floor] |= moved[surface == floor].any(axis=0)
    electric = problem.space.electric
    if fitted.multi_floor is not None:
        electric = electric.copy()
        electric[np.asarray(fitted.multi_floor.friction)] = False
    mine = {MOTION: ~electric, ELECTRIC: electric, EVERYTHING: np.ones_like(electric)}[part]
    if fitted.multi_floor is not None and part != ELECTRIC:
        touched = np.column_stack([touched, np.asarray(fitted.multi_floor.moved)])
        none = np.full(mine.sum(), -1)
        return Coordinates(np.flatnonzero(mine), none, touched[mine].T)
    alone = (touched.sum(axis=1) == 1) | (touched.shape[1] == 1)
    group = np.where(alone, touched.argmax(axis=1), -1)[mine]
    return Coordinates(np.flatnonzero(mine), group, touched[mine].T)


def effects_at(problem: Problem, residual: Blocks, log_v: Vector) -> Float[np.ndarray, "segment 3"]:
    """Return the shared effects at a fit, estimated alternately with the weights of runs."""
    keep = np.ones(len(problem.windows))
    effect = np.zeros((len(keep), 3))
    for _ in range(_ROUNDS):
        weighed = problem.weighed(residual, log_v, keep, effect)
        root = weighed.whitening.root["motion"]
        effect = np.asarray(effects_given(weighed.effects, root, residual["motion"]))
    return effect


class Anchor(eqx.Module):
    """Windows and fitted values that stay fixed in a density; an argument of compiled functions.

    Attributes:
        batch: the windows.
        z: search vector of the fit.
        prior_std: prior std of every coordinate; infinite for friction that `multi_floor` links to
            the motion.
        root: whitening matrices of every block, for the noise variances of the fit.
        scale: square root of the weight of each segment, small for an outlier.
        log_det: log determinant of each segment's noise covariance.
        shared: shared effects of each floor.
        effects: posterior of the shared effects, given residuals whitened by root and scale.
        twist: twist of every window at the fit.
        twist_slope: derivative of the twists with respect to the search vector.
        electric: noise that predictions of voltages depend on, with the fitted resistance.
        multi_floor: runs over several floors; None without such runs.
    """

    batch: lk.Batch
    z: Array
    prior_std: Array
    root: dict[str, Array]
    scale: dict[str, Array]
    log_det: dict[str, Array]
    shared: tuple[SharedEffects, ...]
    effects: tuple[EffectPosterior, ...]
    twist: Float[Array, "segment window 3"]
    twist_slope: Float[Array, "segment window 3 free"]
    electric: lk.ElectricNoise
    multi_floor: MultiFloorAnchor | None

    @staticmethod
    def at(problem: Problem, fitted: Fitted) -> "Anchor":
        """Return the anchor for the fitted values.

        Weights are those at the fit times `expected`, the ratio of a Student t's information about
        its centre to a Gaussian's, so that the density has the information of the Laplace
        covariance.
        """
        log_v, keep = jnp.asarray(fitted.log_variance), np.ones(len(problem.windows))
        electric = problem.electric(fitted.z, log_v)
        residual, _ = problem.linear(fitted.z, electric)
        effect = effects_at(problem, residual, log_v)
        part = {k: expected(r.shape[-1]) for k, r in residual.items()}
        weighed = problem.weighed(residual, log_v, keep * part["motion"], effect)
        plain = {k: inverse_root(c.covariance(log_v)) for k, c in problem.noise.blocks.items()}
        diagonal = {k: jnp.diagonal(r, axis1=-2, axis2=-1) for k, r in plain.items()}
        twist, slope = twists(problem.space, problem.batch, fitted.z)
        prior_std = problem.objective.prior_std(log_v)
        if fitted.multi_floor is not None:  # its link to the motion contains the prior of friction
            prior_std = prior_std.at[fitted.multi_floor.friction].set(jnp.inf)
        weight = weighed.whitening.weight
        return Anchor(
            batch=problem.batch,
            z=jnp.asarray(fitted.z),
            prior_std=prior_std,
            root=plain,
            scale={k: jnp.sqrt(w * part[k] / part["motion"]) for k, w in weight.items()},
            log_det={k: -2 * jnp.sum(jnp.log(d), axis=-1) for k, d in diagonal.items()},
            shared=problem.objective.shared,
            effects=weighed.effects,
            twist=twist,
            twist_slope=slope,
            electric=electric,
            multi_floor=fitted.multi_floor,
        )

    def on_floor(self, floor: int) -> "Anchor":
        """Return the part of the anchor that belongs to the runs on one floor."""
        segments = len(self.batch.surface)
        mine = np.flatnonzero(np.asarray(self.batch.surface) == floor)

        def rows(tree: Part) -> Part:
            def own(x: Array) -> Array:
                # The lag of the camera and the scatter without currents are common to all segments.
                if x.shape[:1] != (segments,):
                    return x
                return jnp.asarray(np.asarray(x)[mine])  # NumPy has nothing to compile

            return jax.tree.map(own, tree)

        def of_floor(of: tuple[OfFloor, ...]) -> tuple[OfFloor, ...]:
            return tuple(replace(one, segments=jnp.arange(len(mine))) for one in of[floor:][:1])

        return replace(
            self,
            batch=rows(self.batch),
            root=rows(self.root),
            scale=rows(self.scale),
            log_det=rows(self.log_det),
            shared=of_floor(self.shared),
            effects=of_floor(self.effects),
            twist=rows(self.twist),
            twist_slope=rows(self.twist_slope),
            electric=replace(self.electric, scatter=rows(self.electric.scatter)),
            multi_floor=None,
        )

    def predict(self, robot: Robot, z: Array) -> lk.Predicted:
        """Return the prediction for a robot, whose search vector is `z`.

        The root finder for the twists starts from those of the fit, extrapolated linearly to `z`.
        """
        return lk.predict(robot, self.batch, self.twist + self.twist_slope @ (z - self.z))

    def noise(self, robot: Robot) -> lk.ElectricNoise:
        """Return the noise that predictions of voltages depend on, with a robot's resistance."""
        return replace(self.electric, resistance=robot.motor.resistance)

    def white(self, k: str, r: Float[Array, "segment m"]) -> Float[Array, "segment m"]:
        """Return the residuals of a block, whitened and weighted."""
        return jnp.einsum("nij,nj->ni", self.root[k], r) * self.scale[k][:, None]

    def log_student(self, k: str, r: Float[Array, "segment m"]) -> Float[Array, " segment"]:
        """Return the Student t log density of every segment's residuals of block `k`.

        The scale matrix is V, the covariance that `root` whitens.
        """
        m = r.shape[1]
        q = jnp.sum(jnp.einsum("nij,nj->ni", self.root[k], r) ** 2, axis=1)
        constant = gammaln(0.5 * (DEGREES + m)) - gammaln(0.5 * DEGREES)
        constant -= 0.5 * m * np.log(DEGREES * np.pi)
        tail = 0.5 * (DEGREES + m) * jnp.log1p(q / DEGREES)
        return constant - 0.5 * self.log_det[k] - tail
