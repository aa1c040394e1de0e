"""What neighbouring runs, and runs of one session, share beyond the model.

Runs in nearly one direction at nearly one speed err alike, and so do runs of one time. The effect
of a run along, across and in yaw is

    e = d(direction, speed, load) + s(session) + own

d is a Gaussian process per floor and axis, with a kernel that is periodic in the direction of
travel relative to the body, and s one number per floor, axis and session; `own` is in the noise of
the run. A robot whose wheels are their own mirror image errs alike to either side, along its way by
as much, and across it and in yaw by as much the other way: k(a, b) = k0(a - b) +- h k0(a + b), with
angles from the axis of the mirror.

With r the residuals of a floor's runs, whitened by roots W of their own noise, and coefs u of unit
variance, e = S u, the effects are marginalised:

    min over u of |W (r - E S u)|^2 + |u|^2,    u^ = C^-1 (W E S)^T W r,    C = 1 + (W E S)^T W E S

(E moves residuals by an effect). Source: Rasmussen and Williams 2006, section 2.7.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_solve
from jaxtyping import Array, Float, Int
from scipy.special import ive

from slipid.data.windows import Windows
from slipid.fit.noise import NoiseModel, effects, encoder_increments, sessions_on, travel
from slipid.model.robot import Robot

AXES = ("along", "across", "yaw")
LENGTH = np.radians(10.0)
"""Length of the kernel over directions [rad]."""
SPEED_LENGTH = 0.5
"""Length of the kernel over logarithms of speed."""
OTHER_LOAD = 0.5
"""Correlation of effects with different load set-ups."""
OTHER_SIDE = 0.7
"""Correlation of effects in mirrored directions, h."""
_HARMONICS = 15
"""Of the kernel over directions; those beyond hold 1 % of its variance."""
_SPEED = 0.25
"""Logarithms of speed are taken in steps of this."""


@dataclass(frozen=True)
class SpeedAndLoad:
    """A speed, as the rounded logarithm of m/s, and a load set-up, driven on a floor."""

    log_speed: float
    load: str

    def near(self, other: "SpeedAndLoad") -> float:
        """Correlation of effects in the same direction."""
        apart = (self.log_speed - other.log_speed) / SPEED_LENGTH
        return float(np.exp(-0.5 * apart**2) * (1.0 if self.load == other.load else OTHER_LOAD))


@dataclass(frozen=True, eq=False)
class TravelConditions:
    """Direction of travel of every piece relative to the body [rad], and its pace.

    The direction is nan where a robot turns on the spot; `mirror` is the axis of `Geometry.mirror`.
    """

    direction: Float[np.ndarray, " piece"]
    speed_and_load: tuple[SpeedAndLoad, ...]
    mirror: float | None

    @staticmethod
    def of(w: Windows, robot: Robot) -> "TravelConditions":
        """As the encoders have it."""
        far = travel(w, robot)[0]
        moved = encoder_increments(w, robot)[..., :2].sum(axis=1)
        straight = np.hypot(*moved.T)
        moves = straight > 0.2 * far.sum(axis=1)
        speed = np.log(np.maximum(straight / w.dt.sum(axis=1), 1e-3))
        rounded = np.round(speed / _SPEED) * _SPEED
        return TravelConditions(
            np.where(moves, np.arctan2(moved[:, 1], moved[:, 0]), np.nan),
            tuple(SpeedAndLoad(float(s), load) for s, load in zip(rounded, w.load, strict=True)),
            robot.geometry.mirror(),
        )

    def subset(self, mine: Int[np.ndarray, " some"]) -> "TravelConditions":
        """Those of some pieces."""
        return TravelConditions(
            self.direction[mine], tuple(self.speed_and_load[k] for k in mine), self.mirror
        )

    def around(self) -> Float[np.ndarray, "3 piece harmonic"]:
        """Root of the kernel over directions, along, across and in yaw; zero on the spot."""
        alike = 0.0 if self.mirror is None else OTHER_SIDE
        wave = 1 / LENGTH**2
        k = np.arange(1, _HARMONICS + 1)
        angle = np.nan_to_num(self.direction - (self.mirror or 0.0))[:, None] * k
        size = np.sqrt(2 * ive(k, wave))
        constant = np.full((len(angle), 1), np.sqrt(ive(0, wave)))
        even = np.concatenate([constant, size * np.cos(angle)], axis=1)
        odd = size * np.sin(angle)
        more, less = np.sqrt(1 + alike), np.sqrt(1 - alike)
        of_even, of_odd = (more, less, less), (less, more, more)
        root = [
            np.concatenate([a * even, b * odd], axis=1)
            for a, b in zip(of_even, of_odd, strict=True)
        ]
        return np.stack(root) * np.isfinite(self.direction)[:, None]

    def basis(
        self, speeds_and_loads: tuple[SpeedAndLoad, ...]
    ) -> Float[np.ndarray, "3 piece coef"]:
        """Root of the kernel: effects of unit coefs, from paces that were seen.

        Its rows are as long as those of `around`, less where the pace is another.
        """
        if not speeds_and_loads:
            return np.zeros((len(AXES), len(self.speed_and_load), 0))
        seen = np.array([[a.near(b) for b in speeds_and_loads] for a in speeds_and_loads])
        root = np.linalg.cholesky(seen + 1e-9 * np.eye(len(speeds_and_loads)))
        met = {
            speed_and_load: np.array([speed_and_load.near(b) for b in speeds_and_loads])
            for speed_and_load in set(self.speed_and_load)
        }
        share = {speed_and_load: np.linalg.solve(root, row) for speed_and_load, row in met.items()}
        of_pace = np.array(
            [share[speed_and_load] for speed_and_load in self.speed_and_load]
        ).reshape(-1, len(speeds_and_loads))
        whole = np.einsum("pc,apd->apcd", of_pace, self.around())
        return np.asarray(whole.reshape(len(AXES), len(self.speed_and_load), -1))


class SharedEffects(eqx.Module):
    """What the runs on a floor share, as arrays.

    Attributes:
        pieces: their numbers.
        effect: what one unit along, across and in yaw moves in their residuals.
        near: root of the kernel by axis and piece; session: 1 for the session of each piece.
        numbers: of the variances of own, neighbours' and session's effects, -1 where there is none.
    """

    segments: Int[Array, " run"]
    effect: Float[Array, "run m 3"]
    near: Float[Array, "3 run condition"]
    session: Float[Array, "run session"]
    numbers: Int[Array, "3 3"]

    def root(self, log_v: Float[Array, " variance"]) -> Float[Array, "3 run coef"]:
        """S, by which unit coefs make effects along, across and in yaw."""
        std = jnp.where(self.numbers < 0, 0.0, jnp.exp(0.5 * log_v)[self.numbers])
        parts = [std[k, :, None, None] * x for k, x in ((1, self.near), (2, self.session[None]))]
        return jnp.concatenate(parts, axis=-1)


SpeedsAndLoads = dict[str, tuple[SpeedAndLoad, ...]]
"""Those that each floor was driven at."""


def effects_by_floor(
    w: Windows, robot: Robot, noise: NoiseModel
) -> tuple[tuple[SharedEffects, ...], SpeedsAndLoads]:
    """What runs share on every floor, and the paces it was driven at."""
    conditions, moved, place = TravelConditions.of(w, robot), effects(w, robot), noise.names.index
    floors, found, speeds_and_loads = np.asarray(w.surface), [], {}
    for floor in robot.surfaces.labels:
        mine = np.flatnonzero(floors == floor)
        here = conditions.subset(mine)
        speeds_and_loads[floor] = tuple(dict.fromkeys(here.speed_and_load))
        names = sessions_on(w, floor)
        session = np.array([w.session[k] for k in mine])[:, None] == np.asarray(names)
        kinds = [
            [f"{kind}.{floor}.{axis}" for axis in AXES] for kind in ("run", "neighbours", "session")
        ]
        number = [[place(n) if n in noise.names else -1 for n in row] for row in kinds]
        found.append(
            SharedEffects(
                segments=jnp.asarray(mine),
                effect=jnp.asarray(moved[mine]),
                near=jnp.asarray(here.basis(speeds_and_loads[floor])),
                session=jnp.asarray(session[:, : len(names) if len(names) > 1 else 0], float),
                numbers=jnp.asarray(number),
            )
        )
    return tuple(found), speeds_and_loads


class EffectPosterior(eqx.Module):
    """Shared effects of a floor given whitened residuals of its runs.

    Attributes:
        pieces: numbers of its runs; span: W E, what effects move in whitened residuals.
        root: S; factor: Cholesky factor of C.
    """

    segments: Int[Array, " run"]
    span: Float[Array, "run m 3"]
    root: Float[Array, "3 run coef"]
    factor: Float[Array, "coefs coefs"]

    def coefs(self, white: Float[Array, "piece m"]) -> Float[Array, " coefs"]:
        """Conditional mean u^ of the coefs given whitened residuals of all pieces."""
        told = jnp.einsum("nma,nm->an", self.span, white[self.segments])
        return cho_solve((self.factor, True), jnp.einsum("anq,an->aq", self.root, told).ravel())

    def effects(self, coefs: Float[Array, " coefs"]) -> Float[Array, "run 3"]:
        """Effects S u along, across and in yaw."""
        return jnp.einsum("anq,aq->na", self.root, coefs.reshape(3, -1))


@eqx.filter_jit
def effect_posteriors(
    shared: tuple[SharedEffects, ...],
    log_v: Float[Array, " variance"],
    white: Float[Array, "piece m m"],
) -> tuple[EffectPosterior, ...]:
    """Shared effects of every floor for given whitening roots of all pieces."""

    def tie(of: SharedEffects) -> EffectPosterior:
        span = jnp.einsum("nij,nja->nia", white[of.segments], of.effect)
        gram = jnp.einsum("nia,nib->abn", span, span)
        root = of.root(log_v)
        weighed = jnp.einsum("abn,bnk->abnk", gram, root)
        size = root.shape[0] * root.shape[2]
        inner = jnp.einsum("anq,abnk->aqbk", root, weighed).reshape(size, size)
        return EffectPosterior(of.segments, span, root, jnp.linalg.cholesky(jnp.eye(size) + inner))

    return tuple(tie(of) for of in shared)


def marginal_residuals(
    posteriors: tuple[EffectPosterior, ...], white: Float[Array, "piece m"]
) -> Float[Array, " rows"]:
    """Whitened residuals less shared effects at their conditional mean, and the coefs' own.

    Its square is the quadratic form of the marginal likelihood.
    """
    coefs = [tie.coefs(white) for tie in posteriors]
    for tie, u in zip(posteriors, coefs, strict=True):
        moved = jnp.einsum("nma,na->nm", tie.span, tie.effects(u))
        white = white.at[tie.segments].add(-moved)
    return jnp.concatenate([white.ravel(), *coefs])


@eqx.filter_jit
def mean_effects(
    posteriors: tuple[EffectPosterior, ...], white: Float[Array, "piece m"]
) -> Float[Array, "piece 3"]:
    """Conditional mean of the effects that runs share, for every piece."""
    out = jnp.zeros((len(white), len(AXES)))
    for tie in posteriors:
        out = out.at[tie.segments].set(tie.effects(tie.coefs(white)))
    return out


@eqx.filter_jit
def effect_covariances(
    posteriors: tuple[EffectPosterior, ...], count: int
) -> Float[Array, "piece 3 3"]:
    """Covariance of the shared effects of every piece, given the numbers of the model."""
    out = jnp.zeros((count, len(AXES), len(AXES)))
    for tie in posteriors:
        axes, runs, _ = tie.root.shape
        rows = jnp.einsum("ab,anq->nabq", jnp.eye(axes), tie.root).reshape(runs * axes, -1)
        half = jax.scipy.linalg.solve_triangular(tie.factor, rows.T, lower=True)
        half = half.reshape(-1, runs, axes)
        out = out.at[tie.segments].set(jnp.einsum("kna,knb->nab", half, half))
    return out


def marginal_slopes(
    posteriors: tuple[EffectPosterior, ...], white: Float[Array, "piece m free"]
) -> Float[Array, "rows free"]:
    """`marginal_residuals` of every column."""
    return jax.vmap(lambda column: marginal_residuals(posteriors, column), in_axes=-1, out_axes=-1)(
        white
    )


def mean_effect_slopes(
    posteriors: tuple[EffectPosterior, ...], white: Float[Array, "piece m free"]
) -> Float[Array, "piece 3 free"]:
    """`mean_effects` of every column."""
    return jax.vmap(lambda column: mean_effects(posteriors, column), in_axes=-1, out_axes=-1)(white)


class EffectForecast(NamedTuple):
    """What shared effects add to the motion of pieces: mean, slope by numbers, and covariance."""

    mean: Float[np.ndarray, "piece 3"]
    slope: Float[np.ndarray, "piece 3 free"]
    covariance: Float[np.ndarray, "piece 3 3"]


@dataclass(frozen=True, eq=False)
class EffectTable:
    """What neighbouring runs on a floor were found to share.

    Attributes:
        paces: they were driven at.
        std: of the process along, across and in yaw.
        coefs: mean of its unit coefs at the fit; by_number: their slope by the search vector.
        covariance: of the coefs given the numbers.
    """

    speeds_and_loads: tuple[SpeedAndLoad, ...]
    std: Float[np.ndarray, "3"]
    coefs: Float[np.ndarray, "3 coef"]
    by_number: Float[np.ndarray, "3 coef free"]
    covariance: Float[np.ndarray, "3 coef 3 coef"]

    def forecast(self, way: TravelConditions) -> EffectForecast:
        """Of new runs on this floor."""
        basis, around = way.basis(self.speeds_and_loads), way.around()
        of = self.std[:, None, None] * basis
        whole = np.where(np.isfinite(way.direction), (around**2).sum(axis=-1), 1.0)
        rest = (self.std[:, None] ** 2 * np.maximum(whole - (basis**2).sum(axis=-1), 0.0)).T
        known = np.einsum("anq,aqbr->nabr", of, self.covariance)
        return EffectForecast(
            np.einsum("anq,aq->na", of, self.coefs),
            np.einsum("anq,aqp->nap", of, self.by_number),
            np.einsum("nabr,bnr->nab", known, of) + rest[:, :, None] * np.eye(len(AXES)),
        )


def forecast_effects(
    found: Mapping[str, EffectTable], w: Windows, robot: Robot, free: int
) -> EffectForecast:
    """What neighbours tell of runs, on every floor; nothing where no floor was found to share."""
    n, axes = len(w), len(AXES)
    out = EffectForecast(np.zeros((n, axes)), np.zeros((n, axes, free)), np.zeros((n, axes, axes)))
    if not found:
        return out
    conditions, floors = TravelConditions.of(w, robot), np.asarray(w.surface)
    for floor, one in found.items():
        mine = np.flatnonzero(floors == floor)
        if not len(mine):
            continue
        here = conditions.subset(mine)
        for whole, part in zip(out, one.forecast(here), strict=True):
            whole[mine] = part
    return out
