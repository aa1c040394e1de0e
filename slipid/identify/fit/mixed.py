"""Runs over several floors, as a second stage after a fit of runs that each kept to one.

How hard a floor grips is not to be seen where all wheels stand on it: the forces balance whatever
they are in units of. Where wheels stand on different floors the ratio of their frictions turns the
robot. The first fit is the prior, a Gaussian of its search vector, whose flat directions these runs
inform; with J the slope of the residuals r of short windows,

    information = C^-1 + sum_c J_c^T W J_c / (f_c v_c)

over along, across, yaw and currents. Variances v and Student-t weights W are those of the
residuals. Neighbouring windows err alike (a floor that is uneven, a body that still speeds up), so
each channel counts for its windows over f, what the residuals' correlation makes of their number:
without it the intervals would be too narrow. It knows correlation within runs, no bias that all
runs share. The camera keeps what the first fit knew of it, its uncertainty carried along: what the
contact law lacks would bend a length sooner than a lens does.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from slipid.identify.fit import likelihood as lk
from slipid.identify.fit.crossing import Crossing
from slipid.identify.fit.noise import travel
from slipid.identify.fit.scatter import CHANNELS, Pieces, Scatter, scatter
from slipid.model.robot import Robot
from slipid.search_space import Space

TOLERANCE = 0.02
"""Settled when a step is at most so many posterior stds."""
_GAIN, _IDLE = 0.1, 6
"""Or when so many steps on end have gained less than this in log density."""
_MOST_STEPS, _FACTOR_STEPS, _TRIES = 40, 4, 8
_TOGETHER = 256


@dataclass(frozen=True, eq=False)
class Update:
    """What runs over several floors make of a fit.

    Attributes:
        z: search vector.
        covariance: of it.
        information: what was added to the inverse covariance.
        variance, unit: of the residuals by channel, `mixed.yaw` and so on; unit of the std.
        runs: (name, sha256) of the runs.
        settled: whether the last step was within `TOLERANCE`.
        about: runs, windows, root mean square errors before and after, correlation factors.
    """

    z: Float[np.ndarray, " free"]
    covariance: Float[np.ndarray, "free free"]
    information: Float[np.ndarray, "free free"]
    variance: Mapping[str, float]
    unit: Mapping[str, str]
    runs: tuple[tuple[str, str], ...]
    settled: bool
    about: Mapping[str, Any]


class _Evidence:
    """Residuals of all windows, and how they scatter.

    Rows are windows, columns along, across [m/s], yaw [rad/s] and the current of each wheel [A];
    a set without currents has none there.
    """

    def __init__(self, space: Space, sets: Sequence[Crossing]):
        self.space, self.sets = space, sets
        first = np.cumsum([0, *(len(s.runs) for s in sets)])
        self.pieces = Pieces(
            run=np.concatenate([s.windows.run + k for s, k in zip(sets, first, strict=False)]),
            place=np.concatenate([s.place for s in sets]),
            has_current=np.concatenate(
                [np.full(len(s.windows), s.windows.has_current) for s in sets]
            ),
        )
        self.chunks = [chunk for s in sets for chunk in _chunks(s, space.template)]

    def linear(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residuals (window, channel) and their slope by the search vector (.., free)."""
        parts = [_linear(self.space, jnp.asarray(z), b, u) for b, u, _ in self.chunks]
        return self._joined(0, parts), self._joined(1, parts)

    def residual(self, z: np.ndarray) -> np.ndarray:
        """Residuals alone."""
        return self._joined(
            0, [(_residual(self.space, jnp.asarray(z), b, u),) for b, u, _ in self.chunks]
        )

    def _joined(self, k: int, parts: Sequence[Sequence[Array]]) -> np.ndarray:
        kept = [np.asarray(p[k])[:count] for p, (*_, count) in zip(parts, self.chunks, strict=True)]
        return np.concatenate(kept)


def _chunks(s: Crossing, robot: Robot) -> list[tuple[lk.Batch, Array, int]]:
    """Batches of one size, with directions of travel and how many of their windows count."""
    out = []
    for first in range(0, len(s.windows), _TOGETHER):
        index = np.arange(first, first + _TOGETHER)
        some = np.minimum(index, len(s.windows) - 1)
        w = s.windows.pieces(some)
        u = travel(w, robot)[1][:, 0]
        count = int((index < len(s.windows)).sum())
        out.append((lk.batch(w, robot, s.floor[some]), jnp.asarray(u), count))
    return out


@eqx.filter_jit
def _residual(space: Space, z: Array, b: lk.Batch, u: Array) -> Float[Array, "piece channel"]:
    """Predicted less measured speeds along and across the way, yaw rates and currents."""
    robot = space.tree(z)
    p = lk.predict(robot, b)
    rate = lk.motion_residual(robot, b, p) / b.dt
    along = u[:, 0] * rate[:, 0] + u[:, 1] * rate[:, 1]
    across = u[:, 0] * rate[:, 1] - u[:, 1] * rate[:, 0]
    amps = jnp.zeros_like(b.current)
    if b.has_current:
        amps = lk.predicted_current(robot, b, p.felt) - b.current
    return jnp.concatenate([jnp.stack([along, across, rate[:, 2]], axis=1), amps[:, 0]], axis=1)


@eqx.filter_jit
def _linear(space: Space, z: Array, b: lk.Batch, u: Array) -> tuple[Array, Array]:
    def both(x: Array) -> tuple[Array, Array]:
        r = _residual(space, x, b, u)
        return r, r

    slope, r = jax.jacfwd(both, has_aux=True)(z)
    return r, slope


@dataclass(frozen=True, eq=False)
class _Found:
    """End of the steps: where, what the data added, how residuals scatter there."""

    z: np.ndarray
    information: np.ndarray
    scatter: Scatter
    settled: bool


def _maximise(e: _Evidence, mean: np.ndarray, covariance: np.ndarray) -> _Found:
    """Levenberg-Marquardt steps from the prior mean; scatter anew at each."""
    prior, z, settled = np.linalg.inv(covariance), np.asarray(mean, float), False
    moving = ~held(e.space)
    factor: np.ndarray | None = None
    damping, idle = 0.0, 0
    for turn in range(_MOST_STEPS):
        r, slope = e.linear(z)
        found = scatter(r, e.pieces, factor)
        factor = found.factor if turn >= _FACTOR_STEPS else None
        count = found.counted(found.weight)
        gradient = (np.einsum("nc,nc,ncp->p", count, r, slope) + prior @ (z - mean))[moving]
        hessian = (_gram(slope, count) + prior)[np.ix_(moving, moving)]
        std = np.sqrt(np.diag(np.linalg.inv(hessian)))
        settled = bool((np.abs(np.linalg.solve(hessian, gradient)) <= TOLERANCE * std).all())
        settled |= idle >= _IDLE  # on a bent ridge no whole step is small, yet none gains
        if settled:
            break

        def loss(x: np.ndarray, count: np.ndarray = count) -> float:
            away = x - mean
            return float(0.5 * (count * e.residual(x) ** 2).sum() + 0.5 * away @ prior @ away)

        now = loss(z)
        for _ in range(_TRIES):
            step = np.zeros_like(z)
            damped = hessian + damping * np.diag(np.diag(hessian))
            step[moving] = -np.linalg.solve(damped, gradient)
            step *= min(
                1.0, 2.0 / np.abs(step).max()
            )  # beyond two in a logarithm nothing is linear
            expected = -(gradient @ step[moving] + 0.5 * step[moving] @ hessian @ step[moving])
            gained = (now - loss(z + step)) / max(expected, 1e-12)
            damping = (
                damping / 4 if gained > 0.7 else max(4 * damping, 0.01) if gained < 0.3 else damping
            )
            if gained > 0:
                z = z + step
                idle = idle + 1 if gained * expected < _GAIN else 0
                break
        else:
            idle += 1
    information = _gram(slope, found.counted(found.expected))
    return _Found(z, information, found, settled)


def _gram(slope: np.ndarray, count: np.ndarray) -> Float[np.ndarray, "free free"]:
    flat = (np.sqrt(count)[..., None] * slope).reshape(-1, slope.shape[-1])
    return np.asarray(flat.T @ flat)


def held(space: Space) -> Bool[np.ndarray, " free"]:
    """Coordinates that keep what the first fit knew of them."""
    return space.where(lambda e: e.part == "camera")


def informed(
    space: Space,
    covariance: Float[np.ndarray, "free free"],
    information: Float[np.ndarray, "free free"],
) -> Float[np.ndarray, "free free"]:
    """Covariance after more information on all numbers but those held, given these.

    With h held and m the others, H = C^-1 + information: C_hh stays, z_m = -H_mm^-1 H_mh z_h + e.
    """
    h = held(space)
    total = np.linalg.inv(covariance) + information
    own = np.linalg.inv(total[np.ix_(~h, ~h)])
    carried = -own @ total[np.ix_(~h, h)]
    kept = covariance[np.ix_(h, h)]
    out = np.empty_like(covariance)
    out[np.ix_(h, h)] = kept
    out[np.ix_(~h, h)] = carried @ kept
    out[np.ix_(h, ~h)] = (carried @ kept).T
    out[np.ix_(~h, ~h)] = own + carried @ kept @ carried.T
    return out


def update(
    space: Space,
    mean: Float[np.ndarray, " free"],
    covariance: Float[np.ndarray, "free free"],
    sets: Sequence[Crossing],
) -> Update:
    """Posterior of the search vector given windows over several floors.

    Errors `before` and `after` are of runs left out: each half of the runs is judged by what the
    other half made of the fit. A single run has no `after`.

    Args:
        space: free numbers.
        mean, covariance: of the fit without these runs.
        sets: of every map.
    """
    e = _Evidence(space, sets)
    found = _maximise(e, mean, covariance)
    before, after = _left_out(space, mean, covariance, sets)
    names = [*CHANNELS, *(["current"] if e.pieces.has_current.any() else [])]
    column = [*range(len(CHANNELS)), len(CHANNELS)][: len(names)]
    scatter = found.scatter
    unit = dict(zip(names, ("m/s", "m/s", "rad/s", "A"), strict=False))
    runs = tuple(run for s in sets for run in s.runs)
    return Update(
        z=found.z,
        covariance=informed(space, covariance, found.information),
        information=found.information,
        variance={
            f"mixed.{n}": float(scatter.variance[k]) for n, k in zip(names, column, strict=True)
        },
        unit={f"mixed.{n}": unit[n] for n in names},
        runs=runs,
        settled=found.settled,
        about={
            "runs": len(runs),
            "windows": len(e.pieces.run),
            "before": before,
            "after": after,
            "correlation": {
                n: float(scatter.factor[k]) for n, k in zip(names, column, strict=True)
            },
        },
    )


def _left_out(
    space: Space, mean: np.ndarray, covariance: np.ndarray, sets: Sequence[Crossing]
) -> tuple[dict[str, float], dict[str, float] | None]:
    """Errors before, and after learning from the other half of the runs of each set."""
    halves = [[s.of((s.windows.run + j) % 2 == k) for j, s in enumerate(sets)] for k in range(2)]
    ends = [_Evidence(space, h) for h in halves if sum(len(s.windows) for s in h)]
    has = np.concatenate([e.pieces.has_current for e in ends])
    before = errors(np.concatenate([e.residual(mean) for e in ends]), has)
    if len(ends) < 2:
        return before, None
    learnt = [_maximise(e, mean, covariance).z for e in ends]
    after = [e.residual(z) for e, z in zip(ends, learnt[::-1], strict=True)]
    return before, errors(np.concatenate(after), has)


def errors(r: Float[np.ndarray, "window channel"], has_current: np.ndarray) -> dict[str, float]:
    """Root mean squares: `speed` [m/s], `yaw_rate` [rad/s] and, where logged, `current` [A]."""
    found = {
        "speed": float(np.sqrt((r[:, :2] ** 2).sum(axis=1).mean())),
        "yaw_rate": float(np.sqrt((r[:, 2] ** 2).mean())),
    }
    if has_current.any():
        found["current"] = float(np.sqrt((r[has_current, len(CHANNELS) :] ** 2).mean()))
    return found
