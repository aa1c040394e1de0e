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
by floor. Runs over several floors are one more term, which depends on the parameters of all floors
and on friction (`multi_floor_anchor.py`); all coordinates are accepted together then.

Electric numbers are drawn for every draw of the motion. Damped Gauss-Newton steps (Levenberg and
Marquardt) find their most likely values given the motion, and proposals come from a Student t
around them, whose tails cover those of a skewed density. Each proposal is accepted or rejected by
the exact density (Metropolis-Hastings with independent proposals; Tierney 1994, Annals of
Statistics 22(4)).
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from slipid.fitting import likelihood as lk
from slipid.fitting.multi_floor import MULTI_FLOOR_CURRENT, MULTI_FLOOR_MOTION
from slipid.fitting.problem import Problem
from slipid.fitting.shared_effects import marginal_residuals, mean_effects
from slipid.fitting.variances import Square, expected
from slipid.infer.posterior.blocks import LogDensity
from slipid.infer.posterior.coordinates import (
    ELECTRIC,
    EVERYTHING,
    MOTION,
    Anchor,
    Fitted,
    coordinates,
)
from slipid.infer.posterior.surrogate import Numbers
from slipid.model.robot import Robot

Result = TypeVar("Result")


class HeldMotion(NamedTuple):
    """Motion of each walker, given which its electric parameters are drawn.

    Attributes:
        z: search vector with the walker's parameters of the motion.
        motor_force: contact forces that the motors work against [mu m g].
        multi_floor: these forces in runs over several floors; None without such runs.
    """

    z: Float[Array, "*walker free"]
    motor_force: Float[Array, "*walker segment window wheel 2"]
    multi_floor: Float[Array, "*walker run time wheel 2"] | None


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
            several, or if there are runs over several floors.
        touched: True where the residuals of a floor depend on a coordinate (floor, size); the last
            row is that of runs over several floors, if there are any.
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
        self._link, self._link_centre = np.zeros((0, self.size)), np.zeros(self.size)
        if fitted.multi_floor is not None and part == MOTION:
            self._link = np.asarray(fitted.multi_floor.link)[:, self.structure]
            self._link_centre = np.asarray(fitted.multi_floor.link_centre)[self.structure]
        self.centre = fitted.z[self.structure]
        self.covariance = fitted.covariance[np.ix_(self.structure, self.structure)]

    @property
    def size(self) -> int:
        return len(self.names)

    def full(self, anchor: Anchor, x: Array) -> Array:
        """Return the search vector with the coordinates x of the density and all others fitted."""
        return anchor.z.at[self.structure].set(x)

    def mapped(
        self,
        of: Callable[..., Result],
        *many: Any,
        floor: int | None = None,
        first: int | None = None,
    ) -> Result:
        """Return the results of a function of (density, anchor, element) for many elements.

        The function is compiled once for all densities with the same coordinates. Chunks of many
        elements are evaluated in parallel unless `first` is given.

        Args:
            of: the function.
            many: arrays of the elements, at least one, or None, for each further argument of the
                function.
            floor: floor to whose runs the anchor is restricted.
            first: number of elements that are evaluated, if not all; results of those after them
                are zero.
        """
        form = self._form
        if of not in form._each:
            # Stored here, since the cache of JAX for compiled functions would never free it.
            form._each[of] = jax.jit(_in_turn(lambda anchor, one: of(form, anchor, *one)))
        anchor = self.anchor if floor is None else self._on_floor[floor]
        mapped = partial(form._each[of], anchor)
        count = len(jax.tree.leaves(many)[0])
        if first is not None or count < _PARALLEL:
            found: Result = mapped(many, count if first is None else first)
            return found
        size = -(-count // _CHUNKS)
        place = np.minimum(np.arange(_CHUNKS * size), count - 1).reshape(_CHUNKS, size)
        chunks = [jax.tree.map(lambda x, at=at: x[at], many) for at in place]
        start = mapped(chunks[0], size)  # compiles
        with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            rest = list(pool.map(lambda chunk: mapped(chunk, size), chunks[1:]))
        whole: Result = jax.tree.map(lambda *x: jnp.concatenate(x)[:count], start, *rest)
        return whole

    def target(self) -> LogDensity:
        """Return the density as the sampler needs it."""
        space, at = self.problem.space, self.structure
        groups = np.arange(len(self.touched))[:, None]
        return LogDensity(
            names=self.names,
            terms=self.terms,
            rows=self.rows,
            depends=self.touched | (self.group == groups),
            group=self.group,
            positive=space.where(lambda e: e.declaration.logarithmic)[at],
            prior_mean=space.prior_mean[at],
            prior_std=np.asarray(self.anchor.prior_std)[at],
            centre=self.centre,
            covariance=self.covariance,
            link=self._link,
            link_centre=self._link_centre,
            quotients=self._quotients(),
        )

    def _quotients(self) -> tuple[tuple[int, int], ...]:
        """Return the drag of rollers over their creep, which alone matters if both are large."""
        place = {name: k for k, name in enumerate(self.names)}
        partner = {name: name.replace(".roller_drag", ".roller_creep") for name in place}
        pairs = [(name, other) for name, other in partner.items() if name != other]
        return tuple((place[a], place[b]) for a, b in pairs if b in place)

    def terms(self, x: Float[np.ndarray, "walker size"]) -> Float[np.ndarray, "walker term"]:
        """Return the terms of every walker's log posterior: one per group, then the shared term.

        A group is a floor, or all runs over several floors. The electric part has no terms, since
        it depends on the motion of each walker (`log_prob`).
        """
        out = np.zeros((len(x), len(self.touched) + 1))
        prior = -0.5 * self._pull(np.asarray(self.anchor.prior_std), x) ** 2
        np.add.at(out.T, self.group, prior.T)  # group -1 is the last term
        out[:, -1] -= 0.5 * (((x - self._link_centre) @ self._link.T) ** 2).sum(axis=1)
        for group in range(len(self.touched)):
            y, remainder = self.rows(x, group)
            out[:, group] += remainder - 0.5 * (y**2).sum(axis=1)
        out[~np.isfinite(out)] = -np.inf
        return out

    def rows(
        self, x: Float[np.ndarray, "walker size"], group: int
    ) -> tuple[Float[np.ndarray, "walker row"], Float[np.ndarray, " walker"]]:
        """Return whitened residuals y of a group and the remainder c of its log likelihood.

        The log likelihood is c - |y|^2 / 2.
        """
        of_floor = group < len(self.floors)
        of, floor = (Density.whitened, group) if of_floor else (Density.over_several, None)
        y, c = [], []
        # Batches of one size only, so that one compiled function serves any number of walkers.
        for k in range(0, len(x), _BATCH):
            count, some = len(x) - k, np.minimum(np.arange(k, k + _BATCH), len(x) - 1)
            found = self.mapped(of, x[some], None, floor=floor, first=min(count, _BATCH))
            y.append(np.asarray(found.rows)[:count])
            c.append(np.asarray(found.remainder)[:count])
        return np.concatenate(y), np.concatenate(c)

    def log_prob(self, anchor: Anchor, x: Array, held: HeldMotion | None) -> Array:
        """Return the log posterior of one vector x, for all floors of the anchor."""
        found = self.whitened(anchor, x, held)
        squares = jnp.sum(found.rows**2) + jnp.sum(self._pull(anchor.prior_std, x) ** 2)
        return found.remainder - 0.5 * squares

    def whitened(self, anchor: Anchor, x: Array, held: HeldMotion | None) -> WhitenedResiduals:
        """Return whitened residuals of one vector, shared effects marginalised."""
        found, b = self._residuals(anchor, x, held), anchor.batch
        camera, spread = lk.log_jacobians(found.robot, b, anchor.noise(found.robot))
        rows, remainder = [], jnp.zeros(())
        for k, r in found.residuals.items():
            if k == MULTI_FLOOR_CURRENT and anchor.multi_floor is not None:
                rows.append(anchor.multi_floor.white(k, r).ravel())
                continue
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

    def over_several(self, anchor: Anchor, x: Array, _: HeldMotion | None) -> WhitenedResiduals:
        """Return whitened motion residuals of runs over several floors, for one vector."""
        z, runs = self.full(anchor, x), anchor.multi_floor
        assert runs is not None, "the density has runs over several floors"
        robot = self.problem.space.tree(z)
        r = runs.runs.residuals(robot, runs.predict(robot, z - anchor.z))[MULTI_FLOOR_MOTION]
        remainder = jnp.sum(runs.factor * runs.runs.log_jacobian(robot))
        return WhitenedResiduals(runs.white(MULTI_FLOOR_MOTION, r).ravel(), remainder)

    def _pull(self, prior_std: Numbers, x: Numbers) -> Numbers:
        """Return the residuals of the prior [prior std], with NumPy or with JAX."""
        at = self.structure
        return (x - self.problem.space.prior_mean[at]) / prior_std[at]

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
            out = lk.electric_residuals(robot, b, held.motor_force, anchor.noise(robot))
            if anchor.multi_floor is not None and held.multi_floor is not None:
                out |= anchor.multi_floor.runs.currents(robot, held.multi_floor)
            return _Residuals(out, robot)
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
        z, runs = self.full(anchor, x), anchor.multi_floor
        robot, more = self.problem.space.tree(z), None
        if runs is not None:
            more = runs.predict(robot, z - anchor.z).motor_force
        return HeldMotion(z, anchor.predict(robot, z).motor_force, more)


def _in_turn(of: Callable[[Anchor, Any], Result]) -> Callable[[Anchor, Any, int | Array], Result]:
    """Return a function that applies another one to the first `count` of many elements in turn."""
    of = jax.jit(of)  # traced once for the shapes of its results and for its use

    def each(anchor: Anchor, many: Any, count: int | Array) -> Result:
        def put(k: int | Array, out: Result) -> Result:
            found = of(anchor, jax.tree.map(lambda x: x[k], many))
            return jax.tree.map(lambda whole, one: whole.at[k].set(one), out, found)

        size = len(jax.tree.leaves(many)[0])
        shapes = jax.eval_shape(of, anchor, jax.tree.map(lambda x: x[0], many))
        zeros = jax.tree.map(lambda leaf: jnp.zeros((size, *leaf.shape), leaf.dtype), shapes)
        return jax.lax.fori_loop(0, count, put, zeros)

    return each


_PARALLEL, _CHUNKS = 64, 8
"""Least number of elements that are evaluated in parallel, and number of chunks of them."""
_BATCH = 20
"""Number of vectors in each call of a compiled function, of which the last call evaluates fewer."""
_STEPS = 10
"""Number of Levenberg-Marquardt steps for every draw of the motion."""
PROPOSALS = 96
"""Usual number of proposals for every draw of the motion."""
_FIRST_DAMPING, _DAMPING_RATIO = 1e-3, 10.0
"""Damping of the first step, relative to the information, and its ratio from step to step.

Undamped, steps along the logarithm of a small parameter overshoot, and proposals around their end
miss most of the density."""
LEAST_ACCEPTED, MOST_REFUSED = 0.05, 0.1
"""Smallest accepted fraction of the proposals for the electric parameters of one draw, and largest
tolerated fraction of draws that accept fewer.

Where few are accepted, proposals miss a part of the density, however many are made."""
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
    proposals: int = PROPOSALS,
) -> tuple[Float[np.ndarray, "ensemble draw electric"], Bool[np.ndarray, "each proposal"]]:
    """Return draws of the electric parameters, one for every draw of the motion.

    The second result is a mask of the accepted proposals of every draw, ensemble by ensemble.

    Args:
        first: density of the motion.
        second: density of the electric parameters given the motion.
        covariance: Laplace covariance of the search vector; the steps start at its
            regression of electric parameters on those of the motion.
        x: draws of the motion.
        seed: seed of the proposals.
        proposals: number of proposals for every draw.
    """
    motion, electric = first.structure, second.structure
    slope = np.linalg.solve(
        covariance[np.ix_(motion, motion)], covariance[np.ix_(motion, electric)]
    )
    flat = x.reshape(-1, x.shape[-1])
    start = second.centre + (flat - first.centre) @ slope
    rng = np.random.default_rng(seed)
    student = rng.standard_normal((len(flat), proposals + 1, second.size))
    student *= np.sqrt(_DEGREES / rng.chisquare(_DEGREES, student.shape[:2]))[..., None]
    chance = np.log(rng.uniform(size=(len(flat), proposals)))
    many = (first.hold(flat), *map(jnp.asarray, (start, student, chance)))
    drawn, moved = second.mapped(_draw, *many)
    return np.asarray(drawn).reshape(*x.shape[:2], -1), np.asarray(moved)


def refused(moved: Bool[np.ndarray, "each proposal"]) -> float:
    """Return the fraction of draws that accepted less than `LEAST_ACCEPTED` of their proposals."""
    return float((moved.mean(axis=1) < LEAST_ACCEPTED).mean())


class _Climb(NamedTuple):
    """Electric parameters on the way to their most likely values, their density and the damping."""

    x: Float[Array, " electric"]
    value: Float[Array, ""]
    damping: float | Float[Array, ""]


def _draw(
    density: Density, anchor: Anchor, held: HeldMotion, start: Array, student: Array, chance: Array
) -> tuple[Array, Array]:
    """Return the last accepted proposal, and a mask of the accepted proposals.

    `start` is the start of the Levenberg-Marquardt steps, `student` has standard draws of a Student
    t, and `chance` has logarithms of uniform random numbers.
    """

    def log_prob(x: Array) -> Array:
        return density.log_prob(anchor, x, held)

    def information(x: Array) -> Array:
        slope = jax.jacfwd(lambda x: density.whitened(anchor, x, held).rows)(x)
        return slope.T @ slope + jnp.diag(1 / anchor.prior_std[density.structure] ** 2)

    def step(now: _Climb, _: None) -> tuple[_Climb, None]:
        x, value, damping = now
        of_x = information(x)
        damped = of_x + damping * jnp.diag(jnp.diag(of_x))
        new = x + jnp.linalg.solve(damped, jax.grad(log_prob)(x))
        better = (above := log_prob(new)) > value  # False for nan
        damping = jnp.where(better, damping / _DAMPING_RATIO, damping * _DAMPING_RATIO)
        return _Climb(jnp.where(better, new, x), jnp.where(better, above, value), damping), None

    at_start = log_prob(start)
    first = _Climb(start, jnp.where(jnp.isfinite(at_start), at_start, -jnp.inf), _FIRST_DAMPING)
    centre = jax.lax.scan(step, first, None, length=_STEPS)[0].x
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
