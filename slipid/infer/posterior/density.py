"""Log posterior of many walkers at a time, for samplers: what the fit maximises, as a density.

A coordinate is a free number of the search space. Variances and the weights of runs are held as
the fit found them, and what runs share is marginalised, so that the density is that of nonlinear
least squares,

    log p(x | data) = -1/2 |y(x)|^2 - 1/2 |(x - mean) / std|^2 + f log |d residuals / d data|

with |y|^2 that of `slipid.fit.shared_effects.marginal_residuals`, and f what a Student t tells of
its centre over what a Gaussian does, as it is in y. Floors share some coordinates and have the
others to themselves, so that the log posterior is a sum

    log p(x | data) = sum_floor l_floor(x_shared, x_floor) + l_shared(x_shared)

and numbers of several floors can be moved, and accepted or not, in one evaluation.

A draw of the electric numbers for every draw of the motion.

Given the motion their most likely values are found by Gauss-Newton steps, and proposals are drawn
from a Student t there, whose tails reach where a skewed density does. Each is accepted or not by
the exact density (Metropolis-Hastings with independent proposals; Tierney 1994, Annals of
Statistics 22(4)).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float

from slipid.fit import likelihood as lk
from slipid.fit.problem import Problem
from slipid.fit.shared_effects import EffectPosterior, mean_effects
from slipid.fit.variances import Square, expected
from slipid.infer.posterior.coordinates import ELECTRIC, EVERYTHING, Anchor, Coordinates, Fitted
from slipid.model.robot import Robot

Result = TypeVar("Result")


class HeldMotion(NamedTuple):
    """What the electric part holds of the motion of each walker: search vector and traction."""

    z: Float[Array, "*walker free"]
    motor_force: Float[Array, "*walker piece window wheel 2"]


class _Residuals(NamedTuple):
    """Blocks of residuals (piece, m), and the robot they are of."""

    residuals: dict[str, Array]
    robot: Robot


class Density:
    """Log posterior of a part of a problem's numbers, the others held.

    The fit is what a chain starts around. Where currents do not inform motion, the part EVERYTHING
    is no posterior, but has the likelihoods.
    """

    def __init__(self, problem: Problem, fitted: Fitted, part: str):
        self.problem, self.part = problem, part
        self.floors = problem.robot.surfaces.labels
        self.coordinates = Coordinates.of(problem, fitted, part)
        self.anchor = Anchor.at(problem, fitted)
        # the first of its form compiles for all
        form = part, self.coordinates.names, self.coordinates.group.tobytes()
        self._each: dict[Callable[..., object], Callable[..., Any]] = {}
        self._form: Density = problem.compiled.setdefault(form, self)
        at = self.coordinates.structure
        self.centre = fitted.z[at]
        self.covariance = fitted.covariance[np.ix_(at, at)]

    @property
    def names(self) -> tuple[str, ...]:
        return self.coordinates.names

    @property
    def size(self) -> int:
        return len(self.names)

    def full(self, anchor: Anchor, x: Array) -> Array:
        """Search vector of chain coordinates, the others as at the fit."""
        return anchor.z.at[self.coordinates.structure].set(x)

    def of_all(
        self, of: Callable[..., Result], x: np.ndarray | Array, held: HeldMotion | None = None
    ) -> Result:
        """A method of one vector for many, by the density of this form that compiles for all."""
        return self.mapped(of, (jnp.asarray(x), held))

    def mapped(self, of: Callable[..., Result], many: tuple[Any, ...]) -> Result:
        """The same of a function of the density, its anchor and one of each of many."""
        form = self._form
        if of not in form._each:

            def each(anchor: Anchor, many: tuple[Any, ...]) -> Result:
                return jax.lax.map(lambda one: of(form, anchor, *one), many)

            # belongs to the density: one that JAX held by its arguments would never be forgotten
            form._each[of] = jax.jit(each)
        compiled: Callable[..., Result] = form._each[of]
        return compiled(self.anchor, many)

    def terms(
        self, x: Float[np.ndarray, "walker size"], held: HeldMotion | None = None
    ) -> Float[np.ndarray, "walker term"]:
        """Terms of the log posterior of every walker: one per floor, then what floors share.

        The electric part needs what it holds of the motion of each walker, as `hold` gives it.
        """
        out = np.array(self.of_all(Density.sums, x, held))
        out[~np.isfinite(out)] = -np.inf
        return out

    def slope(
        self, x: Float[np.ndarray, "walker size"], held: HeldMotion | None = None
    ) -> Float[np.ndarray, "walker size"]:
        """Derivative of the log posterior of every walker; the arguments are those of `terms`."""
        return np.array(self.of_all(Density._gradient, x, held))

    def _gradient(self, anchor: Anchor, x: Array, held: HeldMotion | None) -> Array:
        return jax.grad(lambda x: jnp.sum(self.sums(anchor, x, held)))(x)

    def sums(self, anchor: Anchor, x: Array, held: HeldMotion | None) -> Array:
        """Terms of one vector."""
        seen, count, b = self._residuals(anchor, x, held), len(self.floors), anchor.batch
        out = jnp.zeros(count + 1)
        camera, spread = lk.log_jacobians(seen.robot, b, anchor.noise(seen.robot))
        for k, r in seen.residuals.items():
            white, more = anchor.white(k, r), jnp.zeros(len(r))
            less = expected(r.shape[-1])  # residuals weigh less by as much, or the summit moves
            if k == "motion":
                more = less * camera
                for floor, tie in enumerate(anchor.tied):
                    out = out.at[floor].add(0.5 * _explained(tie, white))
            elif k == "voltage":
                more = less * spread
            out = out.at[b.surface].add(more - 0.5 * jnp.sum(white**2, axis=1))
        at = self.coordinates
        pull = (x - self.problem.space.prior_mean[at.structure]) / anchor.prior_std[at.structure]
        return out.at[np.where(at.group < 0, count, at.group)].add(-0.5 * pull**2)

    def whitened(self, anchor: Anchor, x: Array, held: HeldMotion | None) -> Array:
        """Whitened residuals of the electric part and of the prior, of one vector."""
        seen, at = self._residuals(anchor, x, held), self.coordinates.structure
        pull = (x - self.problem.space.prior_mean[at]) / anchor.prior_std[at]
        return jnp.concatenate(
            [*(anchor.white(k, r).ravel() for k, r in seen.residuals.items()), pull]
        )

    def pointwise(self, x: Float[np.ndarray, "draw size"]) -> dict[str, Array]:
        """Log likelihood of every piece given what runs share, by block of residuals."""
        return self.of_all(Density._pieces, x)

    def _pieces(self, anchor: Anchor, x: Array, held: HeldMotion | None) -> dict[str, Array]:
        left, robot = self.left(anchor, x, held)
        out = {k: anchor.log_student(k, r) for k, r in left.items()}
        camera, spread = lk.log_jacobians(robot, anchor.batch, anchor.noise(robot))
        if "motion" in out:
            out["motion"] += camera
        if "voltage" in out:
            out["voltage"] += spread
        return out

    def residuals(self, x: Float[np.ndarray, "draw size"]) -> dict[str, Array]:
        """Blocks of residuals less what runs share, of many vectors (draw, piece, m)."""
        return self.of_all(Density._rest, x)

    def _rest(self, anchor: Anchor, x: Array, held: HeldMotion | None) -> dict[str, Array]:
        return self.left(anchor, x, held).residuals

    def left(self, anchor: Anchor, x: Array, held: HeldMotion | None) -> _Residuals:
        """Residuals less what runs share at its conditional mean, of one vector."""
        seen = self._residuals(anchor, x, held)
        if "motion" not in seen.residuals:
            return seen
        motion = seen.residuals["motion"]
        effect = mean_effects(anchor.tied, anchor.white("motion", motion))
        for of in anchor.shared:
            off = jnp.einsum("nma,na->nm", of.effect, effect[of.segments])
            motion = motion.at[of.segments].add(-off)
        return _Residuals(seen.residuals | {"motion": motion}, seen.robot)

    def _residuals(self, anchor: Anchor, x: Array, held: HeldMotion | None) -> _Residuals:
        b, at = anchor.batch, self.coordinates
        if self.part == ELECTRIC:
            assert held is not None, "what the electric part holds of the motion"
            robot = self.problem.space.tree(held.z.at[at.structure].set(x))
            return _Residuals(
                lk.electric_residuals(robot, b, held.motor_force, anchor.noise(robot)), robot
            )
        z = self.full(anchor, x)
        robot = self.problem.space.tree(z)
        p = anchor.predict(robot, z)
        out = {"motion": lk.motion_residual(robot, b, p)}
        if self.part == EVERYTHING:
            out |= lk.electric_residuals(robot, b, p.motor_force, anchor.noise(robot))
        # or the root finder is computed again for every consumer
        return _Residuals(jax.lax.optimization_barrier(out), robot)

    def hold(self, x: Float[np.ndarray, "walker size"]) -> HeldMotion:
        """What the electric part holds of walkers of the motion part."""
        return self.of_all(Density._held, x)

    def _held(self, anchor: Anchor, x: Array, _: None) -> HeldMotion:
        z = self.full(anchor, x)
        return HeldMotion(z, anchor.predict(self.problem.space.tree(z), z).motor_force)


def _explained(tie: EffectPosterior, white: Float[Array, "piece m"]) -> Array:
    """How much smaller |y|^2 is than that of whitened residuals, by shared effects of a floor."""
    told = jnp.einsum("nma,nm->an", tie.span, white[tie.segments])
    along = jnp.einsum("anq,an->aq", tie.root, told).ravel()
    return jnp.sum(solve_triangular(tie.factor, along, lower=True) ** 2)


_STEPS, _PROPOSALS = 4, 16
"""Gauss-Newton steps, and proposals of every draw."""
_DEGREES = 5.0
"""Degrees of freedom of proposals."""
_WIDER = 1.15
"""Scale of proposals over that of the Gaussian at the most likely values."""


@dataclass(frozen=True, eq=False)
class ElectricDraws:
    """Electric numbers for every draw of the motion, and how they were found.

    Accepted is the part of the proposals that were, still that of draws that never moved.
    """

    x: Float[np.ndarray, "ensemble draw size"]
    accepted: float
    still: float


def electric_given_motion(
    first: Density,
    second: Density,
    covariance: Square,
    x: Float[np.ndarray, "ensemble draw size"],
    seed: int,
) -> ElectricDraws:
    """Draws of the second density given draws of the first.

    The covariance is Laplace's of the search vector: its regression of electric numbers on those of
    the motion is where Gauss-Newton steps start.
    """
    motion, electric = first.coordinates.structure, second.coordinates.structure
    slope = np.linalg.solve(
        covariance[np.ix_(motion, motion)], covariance[np.ix_(motion, electric)]
    )
    flat = x.reshape(-1, x.shape[-1])
    start = second.centre + (flat - first.centre) @ slope
    rng = np.random.default_rng(seed)
    student = rng.standard_normal((len(flat), _PROPOSALS + 1, second.size))
    student *= np.sqrt(_DEGREES / rng.chisquare(_DEGREES, student.shape[:2]))[..., None]
    chance = np.log(rng.uniform(size=(len(flat), _PROPOSALS)))
    many = (first.hold(flat), *map(jnp.asarray, (start, student, chance)))
    drawn, moves = second.mapped(_draw, many)
    moved = np.asarray(moves)
    return ElectricDraws(
        x=np.asarray(drawn).reshape(*x.shape[:2], -1),
        accepted=float(moved.mean()),
        still=float((~moved.any(axis=1)).mean()),
    )


def _draw(
    density: Density, anchor: Anchor, held: HeldMotion, start: Array, student: Array, chance: Array
) -> tuple[Array, Array]:
    """The last of the proposals that were accepted, and which were."""

    def log_prob(x: Array) -> Array:
        return jnp.sum(density.sums(anchor, x, held))

    def information(x: Array) -> Array:
        slope = jax.jacfwd(lambda x: density.whitened(anchor, x, held))(x)
        return slope.T @ slope

    def step(x: Array, _: None) -> tuple[Array, None]:
        return x + jnp.linalg.solve(information(x), jax.grad(log_prob)(x)), None

    found, _ = jax.lax.scan(step, start, None, length=_STEPS)
    # steps that run away end in nan; proposals from the start are poor, and seen to be by `still`
    centre = jnp.where(jnp.all(jnp.isfinite(found)), found, start)
    root = jnp.linalg.cholesky(jnp.linalg.inv(information(centre)))
    at = centre + _WIDER * student @ root.T
    tail = 0.5 * (_DEGREES + len(start)) * jnp.log1p(jnp.sum(student**2, axis=1) / _DEGREES)
    log_ratio = jax.vmap(log_prob)(at) + tail
    log_ratio = jnp.where(jnp.isfinite(log_ratio), log_ratio, -jnp.inf)

    def choose(now: Array, k: Array) -> tuple[Array, Array]:
        took = chance[k - 1] < log_ratio[k] - log_ratio[now]
        return jnp.where(took, k, now), took

    last, took = jax.lax.scan(choose, jnp.zeros((), int), jnp.arange(1, len(at)))
    return at[last], took
