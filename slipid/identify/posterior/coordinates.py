"""Which numbers of a problem a density is over, and what it holds of the data and of the fit."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaln
from jaxtyping import Array, Bool, Float, Int

from slipid.identify.fit import likelihood as lk
from slipid.identify.fit.noise import effects
from slipid.identify.fit.problem import Problem, twists
from slipid.identify.fit.sessions import AXES, by_axis, pairs
from slipid.identify.fit.variances import DEGREES, Square
from slipid.model.robot import Robot

MOTION, ELECTRIC, EVERYTHING = "motion", "electric", "everything"
"""Parts of a posterior that a density can be of."""
A = TypeVar("A", Array, np.ndarray)


@dataclass(frozen=True, eq=False)
class Fitted:
    """Where a fit ended, and the variances of what the runs of a session share.

    The Laplace covariance is as if sessions shared nothing; where currents were logged it
    is that of p(electric | motion, data) p(motion | motion data).
    """

    z: np.ndarray
    log_variance: np.ndarray
    covariance: Square
    session: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Coordinates:
    """Which coordinates a density has: structure first, then log variances, then session effects.

    Structure are places in the search vector, variances numbers of components; a session has
    effects along, across and in yaw. The group is the floor of each coordinate, -1 where several
    share it.
    """

    names: tuple[str, ...]
    structure: Int[np.ndarray, " structure"]
    variance: Int[np.ndarray, " variance"]
    sessions: tuple[tuple[str, str], ...]
    group: Int[np.ndarray, " size"]

    @property
    def kind(self) -> Int[np.ndarray, " size"]:
        """0 for structure and effects, 1 for variances."""
        n, v = len(self.structure), len(self.variance)
        return np.repeat([0, 1, 0], [n, v, len(self.names) - n - v])

    def parts(self, x: A) -> tuple[A, A, A]:
        """Structure, log variances and effects of coordinates (..., size)."""
        n = len(self.structure)
        end = n + len(self.variance)
        return x[..., :n], x[..., n:end], x[..., end:]

    @staticmethod
    def of(problem: Problem, fitted: Fitted, part: str) -> "Coordinates":
        """Coordinates of a part; the floors that each touches are those of the fit's Jacobian."""
        _, jacobian = problem.linear(fitted.z, problem.electric(fitted.z, fitted.log_variance))
        blocks = {
            MOTION: ["motion"],
            ELECTRIC: [k for k in jacobian if k != "motion"],
            EVERYTHING: list(jacobian),
        }[part]
        labels = problem.robot.surfaces.labels
        surface, floors = np.asarray(problem.batch.surface), len(labels)
        touched = np.zeros((problem.space.size, floors), bool)
        seen = np.zeros((len(problem.noise.names), floors), bool)
        for k in blocks:
            moved = np.abs(np.asarray(jacobian[k])).sum(axis=1) > 0
            for floor in range(floors):
                touched[:, floor] |= moved[surface == floor].any(axis=0)
                number = np.asarray(problem.noise.blocks[k].which)[surface == floor]
                seen[np.unique(number), floor] = True
        electric = problem.space.electric
        mine = {MOTION: ~electric, ELECTRIC: electric}
        structure = np.flatnonzero(mine.get(part, np.ones(problem.space.size, bool)))
        variance = np.flatnonzero(seen.any(axis=1))
        shared = by_axis(fitted.session, "session", problem.windows)
        found = {pair for pair, v in zip(pairs(problem.windows), shared, strict=True) if v.any()}
        sessions = tuple(sorted(found)) if part != ELECTRIC else ()
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


def _groups(touched: Bool[np.ndarray, "size floor"]) -> Int[np.ndarray, " size"]:
    """The one floor that a coordinate touches, else -1; a single floor is a single group."""
    alone = (touched.sum(axis=1) == 1) | (touched.shape[1] == 1)
    return np.where(alone, touched.argmax(axis=1), -1)


class Anchor(eqx.Module):
    """Windows and the fit that a density is anchored at; an argument of what is compiled.

    Covariance pieces of every block, pieces last, go with the number of the variance of each, and
    with the variances that are known beside them.
    Twists are those at the fit, with their derivative by the search vector; `typical` is the centre
    of the prior of the log variances. Shares are how far session effects of one std move residuals,
    session is the place among those that have effects.
    """

    batch: lk.Batch
    base: dict[str, Array]
    which: dict[str, Array]
    known: dict[str, Float[Array, "m piece"]]
    z: Array
    log_variance: Array
    twist: Float[Array, "piece window 3"]
    twist_slope: Float[Array, "piece window 3 free"]
    typical: Array
    shares: Float[Array, "piece m 3"]
    session: Int[Array, " piece"]

    @staticmethod
    def at(problem: Problem, fitted: Fitted, sessions: tuple[tuple[str, str], ...]) -> "Anchor":
        """Anchor at a fit, for sessions that have effects of their own."""
        twist, slope = twists(problem.space, problem.batch, fitted.z)
        w = problem.windows
        shares = effects(w, problem.robot) * np.sqrt(by_axis(fitted.session, "session", w))[:, None]
        place = {pair: k for k, pair in enumerate(sessions)}
        return Anchor(
            batch=problem.batch,
            base={k: jnp.moveaxis(c.base, 0, -1) for k, c in problem.noise.blocks.items()},
            which={k: c.which.T for k, c in problem.noise.blocks.items()},
            known={k: c.known.T for k, c in problem.noise.blocks.items()},
            z=jnp.asarray(fitted.z),
            log_variance=jnp.asarray(fitted.log_variance),
            twist=twist,
            twist_slope=slope,
            typical=problem.target.typical,
            shares=jnp.asarray(shares),
            session=jnp.asarray([place.get(pair, 0) for pair in pairs(w)]),
        )

    def predict(self, robot: Robot, z: Array) -> lk.Predicted:
        """What the robot predicts, searched from twists at the fit and, if that fails, afresh."""
        b = self.batch
        start = self.twist + self.twist_slope @ (z - self.z)
        p = lk.predict(robot, b, jax.lax.stop_gradient(start))
        arrived = jnp.all(jnp.isfinite(p.twist))
        return jax.lax.cond(arrived, lambda: p, lambda: lk.predict(robot, b))

    def electric_noise(
        self, log_v: Float[Array, " variance"], resistance: Array
    ) -> lk.ElectricNoise:
        """What voltages are predicted with, as `fit.noise` has it for pieces that come first."""
        if "voltage" not in self.base:
            return lk.ElectricNoise(jnp.ones(()), jnp.ones((1, 1)), resistance)
        v = jnp.exp(log_v)[self.which["current"]]
        scatter = jnp.einsum("cn,ciin->ni", v, self.base["current"])
        return lk.ElectricNoise(
            lk.voltage_std(log_v[-1]), scatter + lk.FLOOR["current"], resistance
        )

    def log_student(
        self, k: str, r: Float[Array, "piece m"], log_v: Float[Array, " variance"]
    ) -> Float[Array, " piece"]:
        """Log density of residuals of block `k` of every piece, a Student t with scale matrix V."""
        base, which = self.base[k], self.which[k]
        m = base.shape[1]
        v = jnp.exp(log_v)[which]
        known = self.known[k] * jnp.eye(m)[:, :, None]
        cov = sum((v[c] * base[c] for c in range(len(base))), known)
        log_det, q = squares(jax.lax.optimization_barrier(cov), r.T)
        constant = gammaln(0.5 * (DEGREES + m)) - gammaln(0.5 * DEGREES)
        constant -= 0.5 * m * np.log(DEGREES * np.pi)
        return constant - 0.5 * log_det - 0.5 * (DEGREES + m) * jnp.log1p(q / DEGREES)


@jax.custom_vjp
def squares(
    v: Float[Array, "m m piece"], r: Float[Array, "m piece"]
) -> tuple[Float[Array, " piece"], Float[Array, " piece"]]:
    """Log |V| and r^T V^-1 r of many small matrices, pieces last.

    Columns of L and of L^-1 r, one after the other; the columns are few enough to be written out.
    The derivative backwards is V^-1 and -V^-1 r r^T V^-1 (reverse mode only): going back through
    the columns takes longer.
    """
    columns = _columns(jnp.concatenate([v, r[None]]))
    log_det = jnp.sum(jnp.stack([2 * jnp.log(c[0]) for c in columns]), axis=0)
    return log_det, jnp.sum(jnp.stack([c[-1] ** 2 for c in columns]), axis=0)


def _columns(rows: Float[Array, "row m piece"]) -> list[Array]:
    """Columns of L from the diagonal on; rows after the m-th are L^-1 times what they were."""
    columns: list[Array] = []
    for j in range(rows.shape[1]):
        c = rows[j:, j]
        if columns:
            known = jnp.stack([old[j - k :] for k, old in enumerate(columns)], axis=1)
            c = c - jnp.sum(known * known[:1], axis=1)
        columns.append(jax.lax.optimization_barrier(c * jax.lax.rsqrt(c[0])))
    return columns


def _squares_backward(kept: tuple[Array, Array], slope: tuple[Array, Array]) -> tuple[Array, Array]:
    v, r = kept
    low, inverse = _columns(v), []
    for i in range(len(low)):  # rows of L^-1
        row = jnp.zeros_like(v[0]).at[i].set(1.0)
        for k in range(i):
            row = row.at[: k + 1].add(-low[k][i - k] * inverse[k][: k + 1])
        inverse.append(jax.lax.optimization_barrier(row / low[i][0]))
    root = jnp.stack(inverse)
    precision = jnp.einsum("iap,ibp->abp", root, root)
    w = jnp.sum(precision * r, axis=1)
    return slope[0] * precision - slope[1] * w[:, None] * w, 2 * slope[1] * w


squares.defvjp(lambda v, r: (squares(v, r), (v, r)), _squares_backward)
