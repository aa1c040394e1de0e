"""Log posterior of many walkers at a time, for samplers: what the fit maximises, as a density.

A coordinate is a free number of the search space, the log of a variance component, or what the
runs of a session share along, across or in yaw, in stds that are held. Floors share some of them
and have the others to themselves, so that the log posterior is a sum

    log p(x | data) = sum_floor l_floor(x_shared, x_floor) + l_shared(x_shared)

and numbers of several floors can be moved, and accepted or not, in one evaluation.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaln
from jaxtyping import Array, Float, Int

from slipid.identify import likelihood as lk
from slipid.identify.linear import squares
from slipid.identify.problem import DEGREES, VARIANCE_SPREAD, Problem
from slipid.identify.sessions import AXES, by_axis, pairs

MOTION, ELECTRIC, EVERYTHING = "motion", "electric", "everything"


@dataclass(frozen=True, eq=False)
class Fitted:
    """Where a fit ended.

    Attributes:
        z, log_variance: search vector, log variances of the components.
        covariance: Laplace, of the search vector, as if sessions shared nothing; where currents do
            not inform motion it is that of p(electric | motion, data) p(motion | motion data).
        session: variances of what the runs of a session share, `session.<floor>.<axis>`.
    """

    z: np.ndarray
    log_variance: np.ndarray
    covariance: Float[np.ndarray, "free free"]
    session: Mapping[str, float] = field(default_factory=dict)


class Anchor(eqx.Module):
    """Where a density is anchored, and the windows; arguments of what is compiled.

    Attributes:
        batch: measured windows.
        base: covariance pieces of every block, pieces last (component, m, m, piece).
        which: variance each belongs to (component, piece).
        z, log_variance: at the fit.
        twist: of every window there, and its derivative by the search vector.
        typical: centre of the prior of the log variances.
        shares: what effects of one std move in the residuals of a piece (piece, m, 3).
        session: place of the piece's session among those that have effects.
    """

    batch: lk.Batch
    base: dict[str, Array]
    which: dict[str, Array]
    z: Array
    log_variance: Array
    twist: Float[Array, "piece window 3"]
    twist_slope: Float[Array, "piece window 3 free"]
    typical: Array
    shares: Float[Array, "piece m 3"]
    session: Int[Array, " piece"]


@dataclass(frozen=True, eq=False)
class Coordinates:
    """Which coordinates a density has.

    Attributes:
        names: of the chain's coordinates.
        structure: places in the search vector of the first of them.
        variance: numbers of the variance components that follow.
        sessions: floor and session of the effects that come last, along, across, yaw of each.
        group: floor each belongs to, -1 where several floors share it.
    """

    names: tuple[str, ...]
    structure: np.ndarray
    variance: np.ndarray
    sessions: tuple[tuple[str, str], ...]
    group: np.ndarray

    def parts(self, x: Any) -> tuple[Any, Any, Any]:
        """Structure, log variances and effects of coordinates (..., size)."""
        n = len(self.structure)
        end = n + len(self.variance)
        return x[..., :n], x[..., n:end], x[..., end:]


class Density:
    """Log posterior of a part of a problem's numbers, the others held.

    Args:
        problem: windows, robot, priors.
        fitted: what the chain starts around and takes effects of sessions from.
        part: "motion", "electric" or "everything"; where currents do not inform motion the last is
            no posterior, but has the likelihoods.
    """

    def __init__(self, problem: Problem, fitted: Fitted, part: str):
        self.problem, self.part = problem, part
        self.floors = problem.robot.surfaces.labels
        self.coordinates = _coordinates(problem, fitted, part)
        self.anchor = _anchor(problem, fitted, self.coordinates.sessions)
        # the first of its form compiles for all
        form = part, self.coordinates.names, self.coordinates.group.tobytes()
        self._form: Density = problem.compiled.setdefault(form, self)
        at = self.coordinates
        effects = np.zeros(len(at.sessions) * len(AXES))
        z, log_v = np.asarray(fitted.z), np.asarray(fitted.log_variance)
        self.centre = np.concatenate([z[at.structure], log_v[at.variance], effects])
        self.covariance = self._laplace(fitted)

    def _laplace(self, fitted: Fitted) -> np.ndarray:
        """Covariance of all coordinates near the fit; variances are apart from the others."""
        problem, at = self.problem, self.coordinates
        n, v = len(at.structure), len(at.variance)
        out = np.zeros((self.size, self.size))
        z, log_v = jnp.asarray(fitted.z), jnp.asarray(fitted.log_variance)
        keep = np.ones(len(problem.windows))
        of_variance = np.linalg.inv(np.asarray(problem.variance_precision(log_v, keep, z)))
        out[n : n + v, n : n + v] = of_variance[np.ix_(at.variance, at.variance)]
        own = np.asarray(fitted.covariance)[np.ix_(at.structure, at.structure)]
        mean = np.concatenate([np.arange(n), np.arange(n + v, self.size)])
        precision = np.zeros((len(mean), len(mean)))
        precision[:n, :n] = np.linalg.inv(own)
        if at.sessions:
            _, jacobian = problem.linear(z, problem.volt(log_v))
            shares = np.asarray(self.anchor.shares)
            member = np.eye(len(at.sessions))[np.asarray(self.anchor.session)]
            moved = -shares[:, :, None, :] * member[:, None, :, None]
            both = [jacobian["motion"][..., at.structure], moved.reshape(*shares.shape[:2], -1)]
            half = problem.whitened({"motion": jnp.concatenate(both, axis=-1)}, log_v)["motion"]
            flat = np.asarray(half).reshape(-1, len(mean))
            told = flat.T @ flat
            told[:n, :n] = 0.0  # is in the Laplace covariance already
            precision += told
            precision[n:, n:] += np.eye(len(mean) - n)
        out[np.ix_(mean, mean)] = np.linalg.inv(precision)
        return out

    @property
    def names(self) -> tuple[str, ...]:
        """Of the coordinates."""
        return self.coordinates.names

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return len(self.coordinates.names)

    @property
    def kind(self) -> np.ndarray:
        """0 for structure and effects, 1 for variances."""
        at = self.coordinates
        n, v = len(at.structure), len(at.variance)
        return np.repeat([0, 1, 0], [n, v, self.size - n - v])

    def full(self, x: Array | np.ndarray) -> tuple[Array, Array]:
        """Search vector and log variances of chain coordinates, the others as at the fit."""
        return self._full(self.anchor, jnp.asarray(x))

    def _full(self, anchor: Anchor, x: Array) -> tuple[Array, Array]:
        at = self.coordinates
        structure, variance, _ = at.parts(x)
        z = anchor.z.at[at.structure].set(structure)
        return z, anchor.log_variance.at[at.variance].set(variance)

    def terms(
        self, x: Float[np.ndarray, "walker size"], held: Any = None
    ) -> Float[np.ndarray, "walker term"]:
        """Terms of the log posterior of every walker: one per floor, then what floors share.

        Args:
            x: coordinates.
            held: of each walker, what the electric part holds of the motion: the search vector
                (walker, free) and the traction (walker, piece, window, wheel), as `hold` gives.
        """
        out = np.array(self._form._terms(self.anchor, jnp.asarray(x), held))
        out[~np.isfinite(out)] = -np.inf
        return out

    @partial(jax.jit, static_argnums=0)
    def _terms(self, anchor: Anchor, x: Array, held: Any) -> Array:
        def one(args: Any) -> Array:
            x, held = args
            return self._sums(anchor, x, held)

        return jax.lax.map(one, (x, held))

    def slope(
        self, x: Float[np.ndarray, "walker size"], held: Any = None
    ) -> Float[np.ndarray, "walker size"]:
        """Derivative of the log posterior of every walker, arguments as of `terms`."""
        return np.array(self._form._slope(self.anchor, jnp.asarray(x), held))

    @partial(jax.jit, static_argnums=0)
    def _slope(self, anchor: Anchor, x: Array, held: Any) -> Array:
        def one(args: Any) -> Array:
            x, held = args
            return jax.grad(lambda x: jnp.sum(self._sums(anchor, x, held)))(x)

        return jax.lax.map(one, (x, held))

    def logpdf(self, x: Float[Array, " size"]) -> Float[Array, ""]:
        """Log posterior of one vector, differentiable, for samplers that want gradients."""
        return jnp.sum(self._sums(self.anchor, x, None))

    def _sums(self, anchor: Anchor, x: Array, held: Any) -> Array:
        likelihood = sum(self._pieces(anchor, x, held).values())
        at = self.coordinates
        space = self.problem.space
        n, v = len(at.structure), len(at.variance)
        unit = np.ones(self.size - n - v)
        mean = jnp.concatenate(
            [space.prior_mean[at.structure], anchor.typical[at.variance], 0 * unit]
        )
        std = np.concatenate([space.prior_std[at.structure], np.full(v, VARIANCE_SPREAD), unit])
        prior = -0.5 * ((x - mean) / std) ** 2 - np.log(std) - 0.5 * np.log(2 * np.pi)
        count = len(self.floors)
        out = jnp.zeros(count + 1).at[anchor.batch.surface].add(likelihood)
        return out.at[np.where(at.group < 0, count, at.group)].add(prior)

    def pointwise(
        self, x: Float[np.ndarray, "draw size"], held: Any = None
    ) -> dict[str, Float[np.ndarray, "draw piece"]]:
        """Log likelihood of every piece, by block of residuals."""
        out = self._form._pointwise(self.anchor, jnp.asarray(x), held)
        return {k: np.asarray(v) for k, v in out.items()}

    @partial(jax.jit, static_argnums=0)
    def _pointwise(self, anchor: Anchor, x: Array, held: Any) -> dict[str, Array]:
        return jax.lax.map(lambda a: self._pieces(anchor, *a), (x, held))

    def _pieces(self, anchor: Anchor, x: Array, held: Any) -> dict[str, Array]:
        z, log_v = self._full(anchor, x)
        effects = self.coordinates.parts(x)[2]
        residuals, robot, volt = self._residuals(anchor, z, log_v, effects, held)
        out = {k: _student(anchor, k, r, log_v) for k, r in residuals.items()}
        camera, spread = lk.log_jacobians(robot, anchor.batch, volt)
        if "motion" in out:
            out["motion"] += camera
        if "voltage" in out:
            out["voltage"] += spread
        return out

    def residuals(self, x: Float[np.ndarray, "draw size"]) -> dict[str, Array]:
        """Blocks of residuals of many vectors (draw, piece, m)."""
        return self._form._many_residuals(self.anchor, jnp.asarray(x))

    @partial(jax.jit, static_argnums=0)
    def _many_residuals(self, anchor: Anchor, x: Array) -> dict[str, Array]:
        def one(x: Array) -> dict[str, Array]:
            effects = self.coordinates.parts(x)[2]
            return self._residuals(anchor, *self._full(anchor, x), effects, None)[0]

        return jax.lax.map(one, x)

    def _residuals(self, anchor: Anchor, z: Array, log_v: Array, effects: Array, held: Any) -> Any:
        b, at = anchor.batch, self.coordinates
        volt = lk.voltage_std(log_v[-1]) if b.has_current and b.has_voltage else jnp.asarray(1.0)
        if self.part == ELECTRIC:
            motion, felt = held
            robot = self.problem.space.tree(motion.at[at.structure].set(z[at.structure]))
            return lk.electric_residuals(robot, b, felt, volt), robot, volt
        robot = self.problem.space.tree(z)
        p = _predict(robot, anchor, z)
        out = {"motion": lk.motion_residual(robot, b, p)}
        if at.sessions:
            shared = effects.reshape(-1, len(AXES))[anchor.session]
            out["motion"] -= jnp.sum(anchor.shares * shared[:, None], axis=-1)
        if self.part == EVERYTHING:
            out |= lk.electric_residuals(robot, b, p.felt, volt)
        # or the root finder is computed again for every consumer
        return jax.lax.optimization_barrier(out), robot, volt

    def hold(self, x: Float[np.ndarray, "walker size"]) -> tuple[Array, Array]:
        """What the electric part needs of walkers of the motion part, see `terms`."""
        return self._form._hold(self.anchor, jnp.asarray(x))

    @partial(jax.jit, static_argnums=0)
    def _hold(self, anchor: Anchor, x: Array) -> tuple[Array, Array]:
        def one(x: Array) -> tuple[Array, Array]:
            z, _ = self._full(anchor, x)
            return z, _predict(self.problem.space.tree(z), anchor, z).felt

        return jax.lax.map(one, x)


def _predict(robot: Any, anchor: Anchor, z: Array) -> lk.Predicted:
    """`lk.predict` from the twists at the fit, from scratch where they are too far away."""
    b = anchor.batch
    start = anchor.twist + anchor.twist_slope @ (z - anchor.z)
    p = lk.predict(robot, b, jax.lax.stop_gradient(start))
    arrived = jnp.all(jnp.isfinite(p.twist))
    return jax.lax.cond(arrived, lambda: p, lambda: lk.predict(robot, b))


def _student(anchor: Anchor, k: str, r: Array, log_v: Array) -> Array:
    """Log density of a Student t with scale matrix V for every piece."""
    base, which = anchor.base[k], anchor.which[k]
    m = base.shape[1]
    v = jnp.exp(log_v)[which]
    floor = lk.FLOOR[k] * jnp.eye(m)[:, :, None]
    cov = sum((v[c] * base[c] for c in range(len(base))), floor)
    log_det, q = squares(jax.lax.optimization_barrier(cov), r.T)
    constant = gammaln(0.5 * (DEGREES + m)) - gammaln(0.5 * DEGREES)
    constant -= 0.5 * m * np.log(DEGREES * np.pi)
    return constant - 0.5 * log_det - 0.5 * (DEGREES + m) * jnp.log1p(q / DEGREES)


def _anchor(problem: Problem, fitted: Fitted, sessions: tuple[tuple[str, str], ...]) -> Anchor:
    twist, slope = problem.twists(jnp.asarray(fitted.z))
    data, w = problem.data, problem.windows
    shares = lk.effects(w, problem.robot) * np.sqrt(by_axis(fitted.session, "session", w))[:, None]
    place = {pair: k for k, pair in enumerate(sessions)}
    return Anchor(
        batch=data.batch,
        base={k: jnp.moveaxis(b, 0, -1) for k, b in data.base.items()},
        which={k: w.T for k, w in data.which.items()},
        z=jnp.asarray(fitted.z),
        log_variance=jnp.asarray(fitted.log_variance),
        twist=twist,
        twist_slope=slope,
        typical=jnp.asarray(2 * np.log(problem.noise.typical)),
        shares=jnp.asarray(shares),
        session=jnp.asarray([place.get(pair, 0) for pair in pairs(w)]),
    )


def _coordinates(problem: Problem, fitted: Fitted, part: str) -> Coordinates:
    """Coordinates of a part; the floors each touches are read off the Jacobian at the fit."""
    volt = problem.volt(jnp.asarray(fitted.log_variance))
    _, jacobian = problem.linear(jnp.asarray(fitted.z), volt)
    blocks = {
        MOTION: ["motion"],
        ELECTRIC: [k for k in jacobian if k != "motion"],
        EVERYTHING: list(jacobian),
    }[part]
    surface, floors = np.asarray(problem.batch.surface), len(problem.robot.surfaces.labels)
    touched = np.zeros((problem.space.size, floors), bool)
    seen = np.zeros((len(problem.noise.names), floors), bool)
    for k in blocks:
        moved = np.abs(np.asarray(jacobian[k])).sum(axis=1) > 0
        for floor in range(floors):
            touched[:, floor] |= moved[surface == floor].any(axis=0)
            seen[np.unique(problem.noise.blocks[k].which[surface == floor]), floor] = True
    mine = {MOTION: ~problem.electric, ELECTRIC: problem.electric}
    structure = np.flatnonzero(mine.get(part, np.ones(problem.space.size, bool)))
    variance = np.flatnonzero(seen.any(axis=1))
    shared = by_axis(fitted.session, "session", problem.windows)
    found = {pair for pair, v in zip(pairs(problem.windows), shared, strict=True) if v.any()}
    sessions = tuple(sorted(found)) if part != ELECTRIC else ()
    labels = problem.robot.surfaces.labels
    on = [[label == floor for label in labels] for floor, _ in sessions for _ in AXES]
    names = [problem.space.names[k] for k in structure]
    names += [f"noise.{problem.noise.names[k]}" for k in variance]
    names += [f"session.{floor}.{axis}@{name}" for floor, name in sessions for axis in AXES]
    return Coordinates(
        names=tuple(names),
        structure=structure,
        variance=variance,
        sessions=sessions,
        group=_groups(np.array([*touched[structure], *seen[variance], *on])),
    )


def _groups(touched: np.ndarray) -> np.ndarray:
    """The one floor a coordinate touches, else -1; all in one group where no floor is apart."""
    group = np.where(touched.sum(axis=1) == 1, touched.argmax(axis=1), -1)
    return np.zeros_like(group) if touched.shape[1] == 1 else group
