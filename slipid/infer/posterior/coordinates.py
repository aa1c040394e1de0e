"""Which numbers of a problem a density is over, and what it holds of the data and of the fit."""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaln
from jaxtyping import Array, Bool, Float, Int

from slipid.fit import likelihood as lk
from slipid.fit.problem import Problem, effects_given, twists
from slipid.fit.shared_effects import EffectPosterior, SharedEffects
from slipid.fit.variances import DEGREES, Blocks, Square, Vector, expected, inverse_root
from slipid.infer.result import Fit, required
from slipid.model.robot import Robot

MOTION, ELECTRIC, EVERYTHING = "motion", "electric", "everything"
"""Parts of a posterior that a density can be of."""
_TURNS = 3
"""Of the weights of runs and of what runs share, at the fit."""


@dataclass(frozen=True, eq=False)
class Fitted:
    """Where a fit ended.

    The Laplace covariance has what runs share marginalised; where currents were logged it is that
    of p(electric | motion, data) p(motion | motion data).
    """

    z: np.ndarray
    log_variance: np.ndarray
    covariance: Square

    @classmethod
    def of(cls, fit: Fit) -> "Fitted":
        """The end of a fit, with the variances in the order of its problem."""
        names = required(fit.problem).noise.names
        return cls(fit.z, np.log([fit.variance[name] for name in names]), fit.covariance)


@dataclass(frozen=True, eq=False)
class Coordinates:
    """Which coordinates a density has: places in the search vector.

    The group is the floor of each coordinate, -1 where several share it.
    """

    names: tuple[str, ...]
    structure: Int[np.ndarray, " size"]
    group: Int[np.ndarray, " size"]

    @staticmethod
    def of(problem: Problem, fitted: Fitted, part: str) -> "Coordinates":
        """Coordinates of a part; the floors that each touches are those of the fit's Jacobian."""
        _, jacobian = problem.linear(fitted.z, problem.electric(fitted.z, fitted.log_variance))
        blocks = {
            MOTION: ["motion"],
            ELECTRIC: [k for k in jacobian if k != "motion"],
            EVERYTHING: list(jacobian),
        }[part]
        surface = np.asarray(problem.batch.surface)
        floors = len(problem.robot.surfaces.labels)
        touched = np.zeros((problem.space.size, floors), bool)
        for k in blocks:
            moved = np.abs(np.asarray(jacobian[k])).sum(axis=1) > 0
            for floor in range(floors):
                touched[:, floor] |= moved[surface == floor].any(axis=0)
        electric = problem.space.electric
        mine = {MOTION: ~electric, ELECTRIC: electric}
        structure = np.flatnonzero(mine.get(part, np.ones(problem.space.size, bool)))
        names = tuple(problem.space.names[k] for k in structure)
        return Coordinates(names, structure, _groups(touched[structure]))


def _groups(touched: Bool[np.ndarray, "size floor"]) -> Int[np.ndarray, " size"]:
    """The one floor that a coordinate touches, else -1; a single floor is a single group."""
    alone = (touched.sum(axis=1) == 1) | (touched.shape[1] == 1)
    return np.where(alone, touched.argmax(axis=1), -1)


def effects_at(problem: Problem, residual: Blocks, log_v: Vector) -> Float[np.ndarray, "piece 3"]:
    """Effects that runs share at a fit, in turns with the weights of runs that they leave."""
    keep = np.ones(len(problem.windows))
    effect = np.zeros((len(keep), 3))
    for _ in range(_TURNS):
        seen = problem.weighed(residual, log_v, keep, effect)
        root = seen.whitening.root["motion"]
        effect = np.asarray(effects_given(seen.effects, root, residual["motion"]))
    return effect


class Anchor(eqx.Module):
    """Windows and the fit that a density is anchored at; an argument of what is compiled.

    Attributes:
        batch: the windows.
        z: search vector of the fit; prior_std: of every coordinate.
        root: whitens every block by the noise of the fit; scale: root of the weight of each piece
            in it, that of an outlier being small.
        log_det: log determinant of each piece's noise.
        shared, tied: what runs share, given residuals whitened by root and scale.
        twist, twist_slope: at the fit, and by the search vector.
        electric: what voltages are predicted with, but for the resistance.
    """

    batch: lk.Batch
    z: Array
    prior_std: Array
    root: dict[str, Array]
    scale: dict[str, Array]
    log_det: dict[str, Array]
    shared: tuple[SharedEffects, ...]
    tied: tuple[EffectPosterior, ...]
    twist: Float[Array, "piece window 3"]
    twist_slope: Float[Array, "piece window 3 free"]
    electric: lk.ElectricNoise

    @staticmethod
    def at(problem: Problem, fitted: Fitted) -> "Anchor":
        """Anchor at a fit.

        Weights are those at the fit, less what a Student t tells less of its centre than a
        Gaussian: the information is then the one that Laplace's covariance has.
        """
        log_v, keep = jnp.asarray(fitted.log_variance), np.ones(len(problem.windows))
        electric = problem.electric(fitted.z, log_v)
        residual, _ = problem.linear(fitted.z, electric)
        effect = effects_at(problem, residual, log_v)
        part = {k: expected(r.shape[-1]) for k, r in residual.items()}
        seen = problem.weighed(residual, log_v, keep * part["motion"], effect)
        plain = {k: inverse_root(c.covariance(log_v)) for k, c in problem.noise.blocks.items()}
        diagonal = {k: jnp.diagonal(r, axis1=-2, axis2=-1) for k, r in plain.items()}
        twist, slope = twists(problem.space, problem.batch, fitted.z)
        weight = seen.whitening.weight
        return Anchor(
            batch=problem.batch,
            z=jnp.asarray(fitted.z),
            prior_std=problem.objective.prior_std(log_v),
            root=plain,
            scale={k: jnp.sqrt(w * part[k] / part["motion"]) for k, w in weight.items()},
            log_det={k: -2 * jnp.sum(jnp.log(d), axis=-1) for k, d in diagonal.items()},
            shared=problem.objective.shared,
            tied=seen.effects,
            twist=twist,
            twist_slope=slope,
            electric=electric,
        )

    def predict(self, robot: Robot, z: Array) -> lk.Predicted:
        """What the robot predicts, searched from twists at the fit and, if that fails, afresh."""
        b = self.batch
        start = self.twist + self.twist_slope @ (z - self.z)
        p = lk.predict(robot, b, jax.lax.stop_gradient(start))
        arrived = jnp.all(jnp.isfinite(p.twist))
        return jax.lax.cond(arrived, lambda: p, lambda: lk.predict(robot, b))

    def noise(self, robot: Robot) -> lk.ElectricNoise:
        """What voltages are predicted with at the resistance of a robot."""
        held = self.electric
        return lk.ElectricNoise(held.voltage_std, held.scatter, robot.motor.resistance)

    def white(self, k: str, r: Float[Array, "piece m"]) -> Float[Array, "piece m"]:
        """Residuals of a block, whitened and weighed."""
        return jnp.einsum("nij,nj->ni", self.root[k], r) * self.scale[k][:, None]

    def log_student(self, k: str, r: Float[Array, "piece m"]) -> Float[Array, " piece"]:
        """Log density of residuals of block `k` of every piece, a Student t with scale matrix V."""
        m = r.shape[1]
        q = jnp.sum(jnp.einsum("nij,nj->ni", self.root[k], r) ** 2, axis=1)
        constant = gammaln(0.5 * (DEGREES + m)) - gammaln(0.5 * DEGREES)
        constant -= 0.5 * m * np.log(DEGREES * np.pi)
        tail = 0.5 * (DEGREES + m) * jnp.log1p(q / DEGREES)
        return constant - 0.5 * self.log_det[k] - tail
