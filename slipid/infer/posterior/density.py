"""Log posterior of many walkers at once for samplers, with the same objective as the fit.

A coordinate is a free parameter of the search space. Variances and the weights of runs keep their
fitted values, and shared effects are marginalised, so that the density is that of nonlinear least
squares,

    log p(x | data) = -1/2 |y(x)|^2 - 1/2 |(x - mean) / std|^2 + f log |d residuals / d data|

with y from `slipid.fitting.shared_effects.marginal_residuals`. The factor f is the ratio of a
Student t's information about its centre to a Gaussian's; the weights in y contain it, too. Floors
share some coordinates and have others of their own, so that the log posterior is a sum

    log p(x | data) = sum_floor l_floor(x_shared, x_floor) + l_shared(x_shared)

and moves of the parameters of several floors can be proposed in one evaluation and accepted floor
by floor.

Electric numbers are drawn for every draw of the motion. Gauss-Newton steps find their most likely
values given the motion, and proposals come from a Student t around them, whose tails cover those
of a skewed density. Each proposal is accepted or rejected by the exact density (Metropolis-Hastings
with independent proposals; Tierney 1994, Annals of Statistics 22(4)).
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from slipid.fitting import likelihood as lk
from slipid.fitting.problem import Problem
from slipid.fitting.shared_effects import marginal_residuals, mean_effects
from slipid.fitting.variances import Square, expected
from slipid.infer.posterior.blocks import LogDensity
from slipid.infer.posterior.coordinates import ELECTRIC, EVERYTHING, Anchor, Fitted, coordinates
from slipid.model.robot import Robot

Result = TypeVar("Result")


class HeldMotion(NamedTuple):
    """Motion of each walker, given which its electric parameters are drawn.

    Attributes:
        z: search vector with the walker's parameters of the motion.
        motor_force: contact forces that the motors work against [mu m g].
    """

    z: Float[Array, "*walker free"]
    motor_force: Float[Array, "*walker segment window wheel 2"]


class WhitenedResiduals(NamedTuple):
    """Residuals of which a log likelihood is `remainder` - |rows|^2 / 2.

    Attributes:
        rows: whitened residuals less the shared effects, and the coefficients of these.
        remainder: log |d residuals / d data| times the factors f.
    """

    rows: Float[Array, "*walker row"]
    remainder: Float[Array, "*walker"]


class _Residuals(NamedTuple):
    """Blocks of residuals (segment, m), and the robot that predicts them."""

    residuals: dict[str, Array]
    robot: Robot


class Density:
    """Log posterior of a part of a problem's parameters, with the other parameters as fitted.

    If currents are logged, the part EVERYTHING has the likelihoods of all residuals but is not the
    posterior, in which currents do not change the parameters of the motion.

    Attributes:
        structure: index of each coordinate in the search vector.
        group: index of the only floor whose residuals depend on the coordinate, -1 if there are
            several.
        touched: True where the residuals of a floor depend on a coordinate (floor, size).
        names: name of each coordinate.
        centre, covariance: mean and covariance of the Laplace approximation.
    """

    def __init__(self, problem: Problem, fitted: Fitted, part: str):
        self.problem, self.part = problem, part
        self.floors = problem.robot.surfaces.labels
        self.structure, self.group, self.touched = coordinates(problem, fitted, part)
        self.names = tuple(problem.space.names[k] for k in self.structure)
        self.anchor = Anchor.at(problem, fitted)
        self._on_floor = [self.anchor.on_floor(k) for k in range(len(self.floors))]
        # The first density with these coordinates compiles the functions for all later ones.
        form = part, self.names, self.group.tobytes()
        self._each: dict[Callable[..., object], Callable[..., Any]] = {}
        self._form: Density = problem.compiled.setdefault(form, self)
        self.centre = fitted.z[self.structure]
        self.covariance = fitted.covariance[np.ix_(self.structure, self.structure)]

    @property
    def size(self) -> int:
        return len(self.names)

    def full(self, anchor: Anchor, x: Array) -> Array:
        """Return the search vector with the coordinates x of the density and all others fitted."""
        return anchor.z.at[self.structure].set(x)

    def mapped(self, of: Callable[..., Result], *many: Any, floor: int | None = None) -> Result:
        """Return the results of a function of (density, anchor, element) for many elements.

        The function is compiled once for all densities with the same coordinates.

        Args:
            of: the function.
            many: arrays of the elements, or None, one for each further argument of the function.
            floor: floor to whose runs the anchor is restricted.
        """
        form = self._form
        if of not in form._each:

            def each(anchor: Anchor, many: tuple[Any, ...]) -> Result:
                return jax.lax.map(lambda one: of(form, anchor, *one), many)

            # Stored here, since the cache of JAX for compiled functions would never free it.
            form._each[of] = jax.jit(each)
        anchor = self.anchor if floor is None else self._on_floor[floor]
        found: Result = form._each[of](anchor, many)
        return found

    def target(self) -> LogDensity:
        """Return the density as the sampler needs it."""
        space, at = self.problem.space, self.structure
        floors = np.arange(len(self.floors))[:, None]
        return LogDensity(
            names=self.names,
            terms=self.terms,
            rows=self.rows,
            depends=self.touched | (self.group == floors),
            group=self.group,
            positive=space.where(lambda e: e.declaration.logarithmic)[at],
            prior_mean=space.prior_mean[at],
            prior_std=np.asarray(self.anchor.prior_std)[at],
            centre=self.centre,
            covariance=self.covariance,
        )

    def terms(self, x: Float[np.ndarray, "walker size"]) -> Float[np.ndarray, "walker term"]:
        """Return the terms of every walker's log posterior: one per floor, then the shared term.

        The electric part has no terms, since it depends on the motion of each walker (`log_prob`).
        """
        out = np.zeros((len(x), len(self.floors) + 1))
        prior = -0.5 * np.asarray(self._pull(self.anchor, x)) ** 2
        np.add.at(out.T, self.group, prior.T)  # group -1 is the last term
        for floor in range(len(self.floors)):
            y, remainder = self.rows(x, floor)
            out[:, floor] += remainder - 0.5 * (y**2).sum(axis=1)
        out[~np.isfinite(out)] = -np.inf
        return out

    def rows(
        self, x: Float[np.ndarray, "walker size"], floor: int
    ) -> tuple[Float[np.ndarray, "walker row"], Float[np.ndarray, " walker"]]:
        """Return whitened residuals y of a floor and the remainder c of its log likelihood.

        The log likelihood is c - |y|^2 / 2.
        """
        y, c = [], []
        # Batches of one size only, so that one compiled function serves any number of walkers.
        for k in range(0, len(x), _BATCH):
            some = np.minimum(np.arange(k, k + _BATCH), len(x) - 1)
            found = self.mapped(Density.whitened, x[some], None, floor=floor)
            y.append(np.asarray(found.rows)[: len(x) - k])
            c.append(np.asarray(found.remainder)[: len(x) - k])
        return np.concatenate(y), np.concatenate(c)

    def log_prob(self, anchor: Anchor, x: Array, held: HeldMotion | None) -> Array:
        """Return the log posterior of one vector x, for all floors of the anchor."""
        found = self.whitened(anchor, x, held)
        squares = jnp.sum(found.rows**2) + jnp.sum(self._pull(anchor, x) ** 2)
        return found.remainder - 0.5 * squares

    def whitened(self, anchor: Anchor, x: Array, held: HeldMotion | None) -> WhitenedResiduals:
        """Return whitened residuals of one vector, shared effects marginalised."""
        found, b = self._residuals(anchor, x, held), anchor.batch
        camera, spread = lk.log_jacobians(found.robot, b, anchor.noise(found.robot))
        rows, remainder = [], jnp.zeros(())
        for k, r in found.residuals.items():
            white = anchor.white(k, r)
            # The factor f makes the mode equal to that of the fit.
            f = expected(r.shape[-1])
            if k == "motion":
                rows.append(marginal_residuals(anchor.effects, white))
                remainder += f * jnp.sum(camera)
            else:
                rows.append(white.ravel())
                remainder += f * jnp.sum(spread) if k == "voltage" else 0.0
        return WhitenedResiduals(jnp.concatenate(rows), remainder)

    def _pull(self, anchor: Anchor, x: Array | np.ndarray) -> Float[Array, "*walker size"]:
        """Return the residuals of the prior [prior std]."""
        at = self.structure
        return (x - self.problem.space.prior_mean[at]) / anchor.prior_std[at]

    def residual_blocks(
        self, anchor: Anchor, x: Array, held: HeldMotion | None
    ) -> dict[str, Array]:
        """Return residuals less the mean shared effects, by block, for one vector x."""
        return self.without_effects(anchor, x, held).residuals

    def without_effects(self, anchor: Anchor, x: Array, held: HeldMotion | None) -> _Residuals:
        """Return residuals less the conditional mean of shared effects, for one vector."""
        found = self._residuals(anchor, x, held)
        if "motion" not in found.residuals:
            return found
        motion = found.residuals["motion"]
        effect = mean_effects(anchor.effects, anchor.white("motion", motion))
        for of in anchor.shared:
            off = jnp.einsum("nma,na->nm", of.effect, effect[of.segments])
            motion = motion.at[of.segments].add(-off)
        return _Residuals(found.residuals | {"motion": motion}, found.robot)

    def _residuals(self, anchor: Anchor, x: Array, held: HeldMotion | None) -> _Residuals:
        b = anchor.batch
        if self.part == ELECTRIC:
            assert held is not None, "the electric part needs the motion of each walker"
            robot = self.problem.space.tree(held.z.at[self.structure].set(x))
            return _Residuals(
                lk.electric_residuals(robot, b, held.motor_force, anchor.noise(robot)), robot
            )
        z = self.full(anchor, x)
        robot = self.problem.space.tree(z)
        p = anchor.predict(robot, z)
        out = {"motion": lk.motion_residual(robot, b, p)}
        if self.part == EVERYTHING:
            out |= lk.electric_residuals(robot, b, p.motor_force, anchor.noise(robot))
        # Without the barrier, XLA would repeat the root finder for every use of the residuals.
        return _Residuals(jax.lax.optimization_barrier(out), robot)

    def hold(self, x: Float[np.ndarray, "walker size"]) -> HeldMotion:
        """Return the motion of the walkers of a motion density, for use with the electric part."""
        return self.mapped(Density._held, x, None)

    def _held(self, anchor: Anchor, x: Array, _: None) -> HeldMotion:
        z = self.full(anchor, x)
        return HeldMotion(z, anchor.predict(self.problem.space.tree(z), z).motor_force)


_BATCH = 4
"""Number of vectors that are evaluated together."""
_STEPS, _PROPOSALS = 4, 256
"""Numbers of Gauss-Newton steps and of proposals for every draw of the motion."""
_DEGREES = 5.0
"""Degrees of freedom of the Student t from which electric parameters are proposed."""
_SCALE_RATIO = 1.15
"""Ratio of the scale of the proposals to that of the Gaussian around the most likely values."""


def electric_given_motion(
    first: Density,
    second: Density,
    covariance: Square,
    x: Float[np.ndarray, "ensemble draw motion"],
    seed: int,
) -> tuple[Float[np.ndarray, "ensemble draw electric"], Bool[np.ndarray, "each proposal"]]:
    """Return draws of the electric parameters, one for every draw of the motion.

    The second result is a mask of the accepted proposals of every draw, ensemble by ensemble.

    Args:
        first: density of the motion.
        second: density of the electric parameters given the motion.
        covariance: Laplace covariance of the search vector; Gauss-Newton steps start at its
            regression of electric parameters on those of the motion.
        x: draws of the motion.
        seed: seed of the proposals.
    """
    motion, electric = first.structure, second.structure
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
    drawn, moved = second.mapped(_draw, *many)
    return np.asarray(drawn).reshape(*x.shape[:2], -1), np.asarray(moved)


def _draw(
    density: Density, anchor: Anchor, held: HeldMotion, start: Array, student: Array, chance: Array
) -> tuple[Array, Array]:
    """Return the last accepted proposal, and a mask of the accepted proposals.

    `start` is the start of the Gauss-Newton steps, `student` has standard draws of a Student t, and
    `chance` has logarithms of uniform random numbers.
    """

    def log_prob(x: Array) -> Array:
        return density.log_prob(anchor, x, held)

    def information(x: Array) -> Array:
        slope = jax.jacfwd(lambda x: density.whitened(anchor, x, held).rows)(x)
        return slope.T @ slope + jnp.diag(1 / anchor.prior_std[density.structure] ** 2)

    def step(x: Array, _: None) -> tuple[Array, None]:
        return x + jnp.linalg.solve(information(x), jax.grad(log_prob)(x)), None

    found, _ = jax.lax.scan(step, start, None, length=_STEPS)
    # Divergent steps end in nan; proposals are then made around the start, and few are accepted.
    centre = jnp.where(jnp.all(jnp.isfinite(found)), found, start)
    root = jnp.linalg.cholesky(jnp.linalg.inv(information(centre)))
    at = centre + _SCALE_RATIO * student @ root.T
    tail = 0.5 * (_DEGREES + len(start)) * jnp.log1p(jnp.sum(student**2, axis=1) / _DEGREES)
    log_ratio = jax.vmap(log_prob)(at) + tail
    log_ratio = jnp.where(jnp.isfinite(log_ratio), log_ratio, -jnp.inf)

    def choose(now: Array, k: Array) -> tuple[Array, Array]:
        took = chance[k - 1] < log_ratio[k] - log_ratio[now]
        return jnp.where(took, k, now), took

    last, took = jax.lax.scan(choose, jnp.zeros((), int), jnp.arange(1, len(at)))
    return at[last], took
