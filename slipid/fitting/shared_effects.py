"""Effects that neighbouring runs, and runs of one session, share beyond the model.

Runs in similar directions at similar speeds have similar errors, and so have runs of one session.
The effect of a run along, across and in yaw is

    e = d(direction, speed, load) + s(session) + own

d is a Gaussian process per floor and axis, with a kernel that is periodic in the direction of
travel relative to the body; s is one number per floor, axis and session; `own` is part of the noise
of the run. A robot whose wheels are symmetric about an axis has symmetric errors in directions that
mirror each other: of the same sign along the direction of travel, of opposite sign across it and in
yaw. The kernel is therefore k(a, b) = k0(a - b) +- h k0(a + b), with angles a, b from the mirror
axis; + holds along, - across and in yaw.

The effects of a floor's runs are e = S u with coefficients u of unit variance. With the residuals r
of these runs, the matrix W that whitens r without shared effects, and the change E of r per unit of
an effect, the coefficients are marginalised:

    min over u of |W (r - E S u)|^2 + |u|^2,    u^ = C^-1 (W E S)^T W r,    C = 1 + (W E S)^T W E S

Source: Rasmussen and Williams 2006, section 2.7.
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
from slipid.fitting.noise import NoiseModel, effects, encoder_increments, sessions_on, travel
from slipid.model.robot import Robot

AXES = ("along", "across", "yaw")
"""Names of the axes of an effect."""
DIRECTION_LENGTH = np.radians(10.0)
"""Length scale of the kernel over directions [rad]."""
SPEED_LENGTH = 0.5
"""Length scale of the kernel over the natural logarithm of speed."""
OTHER_LOAD_CORRELATION = 0.5
"""Correlation of effects with different load set-ups."""
MIRROR_CORRELATION = 0.7
"""Correlation h of effects in mirrored directions."""
_HARMONICS = 15
"""Number of harmonics of the kernel over directions; higher ones hold 1 % of its variance."""
_SPEED_STEP = 0.25
"""Natural logarithms of speeds are rounded to multiples of this."""


@dataclass(frozen=True)
class SpeedAndLoad:
    """A speed and a load set-up that were driven on a floor.

    Attributes:
        log_speed: natural logarithm of the speed in m/s, rounded to a multiple of `_SPEED_STEP`.
        load: load set-up.
    """

    log_speed: float
    load: str

    def near(self, other: "SpeedAndLoad") -> float:
        """Return the correlation of effects in the same direction at another speed and load."""
        apart = (self.log_speed - other.log_speed) / SPEED_LENGTH
        return float(
            np.exp(-0.5 * apart**2) * (1.0 if self.load == other.load else OTHER_LOAD_CORRELATION)
        )


@dataclass(frozen=True, eq=False)
class TravelConditions:
    """Direction, speed and load of every segment, on which effects depend.

    Attributes:
        direction: direction of travel relative to the body [rad], nan if a robot turns on the spot.
        speed_and_load: speed and load set-up.
        mirror: angle of the axis about which the wheels are symmetric [rad], or None.
    """

    direction: Float[np.ndarray, " segment"]
    speed_and_load: tuple[SpeedAndLoad, ...]
    mirror: float | None

    @staticmethod
    def of(w: Windows, robot: Robot) -> "TravelConditions":
        """Return the conditions of windows, with directions and speeds from the encoders."""
        displacement = encoder_increments(w, robot)[..., :2].sum(axis=1)
        chord = np.hypot(*displacement.T)
        moves = chord > 0.2 * travel(w, robot)[0].sum(axis=1)
        speed = np.log(np.maximum(chord / w.dt.sum(axis=1), 1e-3))
        rounded = np.round(speed / _SPEED_STEP) * _SPEED_STEP
        return TravelConditions(
            np.where(moves, np.arctan2(displacement[:, 1], displacement[:, 0]), np.nan),
            tuple(SpeedAndLoad(float(s), load) for s, load in zip(rounded, w.load, strict=True)),
            robot.geometry.mirror(),
        )

    def subset(self, mine: Int[np.ndarray, " some"]) -> "TravelConditions":
        """Return the conditions of some segments."""
        return TravelConditions(
            self.direction[mine], tuple(self.speed_and_load[k] for k in mine), self.mirror
        )

    def around(self) -> Float[np.ndarray, "3 segment harmonic"]:
        """Return a root of the kernel over directions for each axis: root root^T is the kernel.

        Rows of segments in which the robot turns on the spot are zero.
        """
        mirrored = 0.0 if self.mirror is None else MIRROR_CORRELATION
        wave = 1 / DIRECTION_LENGTH**2
        k = np.arange(1, _HARMONICS + 1)
        angle = np.nan_to_num(self.direction - (self.mirror or 0.0))[:, None] * k
        size = np.sqrt(2 * ive(k, wave))
        constant = np.full((len(angle), 1), np.sqrt(ive(0, wave)))
        even = np.concatenate([constant, size * np.cos(angle)], axis=1)
        odd = size * np.sin(angle)
        more, less = np.sqrt(1 + mirrored), np.sqrt(1 - mirrored)
        of_even, of_odd = (more, less, less), (less, more, more)
        scales = zip(of_even, of_odd, strict=True)
        root = [np.concatenate([a * even, b * odd], axis=1) for a, b in scales]
        return np.stack(root) * np.isfinite(self.direction)[:, None]

    def basis(self, known: tuple[SpeedAndLoad, ...]) -> Float[np.ndarray, "3 segment coef"]:
        """Return a root of the kernel over directions, speeds and loads: effects per coefficient.

        `known` are the fitted speeds and loads, for which there are coefficients. The row of a
        segment has the norm of its row of `around` if `known` contains the segment's speed and
        load, else a smaller norm.
        """
        if not known:
            return np.zeros((len(AXES), len(self.speed_and_load), 0))

        def correlation(one: SpeedAndLoad) -> np.ndarray:
            return np.array([one.near(other) for other in known])

        whole = np.array([correlation(one) for one in known])
        root = np.linalg.cholesky(whole + 1e-9 * np.eye(len(known)))
        share = {one: np.linalg.solve(root, correlation(one)) for one in set(self.speed_and_load)}
        of_segment = np.array([share[one] for one in self.speed_and_load]).reshape(-1, len(known))
        basis = np.einsum("pc,apd->apcd", of_segment, self.around())
        return np.asarray(basis.reshape(len(AXES), len(self.speed_and_load), -1))


class SharedEffects(eqx.Module):
    """The effects that the runs on a floor share, as arrays.

    Attributes:
        segments: indices of the floor's segments.
        effect: change of these segments' residuals per unit of an effect along, across and in yaw.
        near: root of the kernel over driving conditions (`TravelConditions.basis`).
        session: 1 in the column of each segment's session, else 0.
        numbers: indices of the variances; rows are run, neighbours' and session effects, columns
            the axes; -1 if there is no such variance.
    """

    segments: Int[Array, " run"]
    effect: Float[Array, "run m 3"]
    near: Float[Array, "3 run condition"]
    session: Float[Array, "run session"]
    numbers: Int[Array, "3 3"]

    @eqx.filter_jit
    def root(
        self, log_v: Float[Array, " variance"] | Float[np.ndarray, " variance"]
    ) -> Float[Array, "3 run coef"]:
        """Return the matrix S of e = S u: effects along, across and in yaw per unit coefficient."""
        std = jnp.where(self.numbers < 0, 0.0, jnp.exp(0.5 * log_v)[self.numbers])
        parts = [std[k, :, None, None] * x for k, x in ((1, self.near), (2, self.session[None]))]
        return jnp.concatenate(parts, axis=-1)


SpeedsAndLoads = dict[str, tuple[SpeedAndLoad, ...]]
"""Speeds and loads of the runs on each floor, keyed by floor."""


def effects_by_floor(
    w: Windows, robot: Robot, noise: NoiseModel
) -> tuple[tuple[SharedEffects, ...], SpeedsAndLoads]:
    """Return the shared effects of every floor, and the speeds and loads of its runs."""
    conditions, moved = TravelConditions.of(w, robot), effects(w, robot)
    number = {name: k for k, name in enumerate(noise.names)}
    floors, found, speeds_and_loads = np.asarray(w.surface), [], {}
    for floor in robot.surfaces.labels:
        mine = np.flatnonzero(floors == floor)
        here = conditions.subset(mine)
        speeds_and_loads[floor] = tuple(dict.fromkeys(here.speed_and_load))
        names = sessions_on(w, floor)
        session = np.array([w.session[k] for k in mine])[:, None] == np.asarray(names)
        numbers = [
            [number.get(f"{kind}.{floor}.{axis}", -1) for axis in AXES]
            for kind in ("run", "neighbours", "session")
        ]
        arrays = {
            "segments": mine,
            "effect": moved[mine],
            "near": here.basis(speeds_and_loads[floor]),
            "session": session[:, : len(names) if len(names) > 1 else 0].astype(float),
            "numbers": np.array(numbers),
        }
        found.append(SharedEffects(**jax.device_put(arrays)))
    return tuple(found), speeds_and_loads


class EffectPosterior(eqx.Module):
    """Posterior of a floor's shared effects given whitened residuals of its runs.

    Attributes:
        segments: indices of the floor's segments.
        span: matrix W E, the change of the whitened residuals per unit of an effect.
        root: matrix S, the effects per unit coefficient.
        factor: lower Cholesky factor of the coefficients' precision C.
    """

    segments: Int[Array, " run"]
    span: Float[Array, "run m 3"]
    root: Float[Array, "3 run coef"]
    factor: Float[Array, "coefs coefs"]

    def coefs(self, white: Float[Array, "segment m"]) -> Float[Array, " coefs"]:
        """Return the mean coefficients u^ given whitened residuals of all segments."""
        effect = jnp.einsum("nma,nm->an", self.span, white[self.segments])
        return cho_solve((self.factor, True), jnp.einsum("anq,an->aq", self.root, effect).ravel())

    def effects(self, coefs: Float[Array, " coefs"]) -> Float[Array, "run 3"]:
        """Return the effects S u along, across and in yaw."""
        return jnp.einsum("anq,aq->na", self.root, coefs.reshape(3, -1))


Posteriors = tuple[EffectPosterior, ...]
"""Posteriors of the shared effects of every floor."""


@eqx.filter_jit
def effect_posteriors(
    shared: tuple[SharedEffects, ...],
    log_v: Float[Array, " variance"],
    white: Float[Array, "segment m m"],
) -> Posteriors:
    """Return the posterior of every floor's effects; `white` holds each segment's matrix W."""

    def posterior(of: SharedEffects) -> EffectPosterior:
        span = jnp.einsum("nij,nja->nia", white[of.segments], of.effect)
        gram = jnp.einsum("nia,nib->abn", span, span)
        root = of.root(log_v)
        weighed = jnp.einsum("abn,bnk->abnk", gram, root)
        size = root.shape[0] * root.shape[2]
        inner = jnp.einsum("anq,abnk->aqbk", root, weighed).reshape(size, size)
        return EffectPosterior(of.segments, span, root, jnp.linalg.cholesky(jnp.eye(size) + inner))

    return tuple(posterior(of) for of in shared)


def marginal_residuals(
    posteriors: Posteriors, white: Float[Array, "segment m"]
) -> Float[Array, " rows"]:
    """Return whitened residuals less the mean shared effects, followed by the mean coefficients.

    The sum of their squares is the quadratic form of the marginal likelihood.
    """
    coefs = [p.coefs(white) for p in posteriors]
    for p, u in zip(posteriors, coefs, strict=True):
        white = white.at[p.segments].add(-jnp.einsum("nma,na->nm", p.span, p.effects(u)))
    return jnp.concatenate([white.ravel(), *coefs])


@eqx.filter_jit
def mean_effects(
    posteriors: Posteriors, white: Float[Array, "segment m"]
) -> Float[Array, "segment 3"]:
    """Return the conditional mean of the shared effects of every segment."""
    out = jnp.zeros((len(white), len(AXES)))
    for p in posteriors:
        out = out.at[p.segments].set(p.effects(p.coefs(white)))
    return out


@eqx.filter_jit
def effect_covariances(posteriors: Posteriors, count: int) -> Float[Array, "segment 3 3"]:
    """Return the covariance of every segment's shared effects, given the model's parameters."""
    out = jnp.zeros((count, len(AXES), len(AXES)))
    for p in posteriors:
        axes, runs, _ = p.root.shape
        rows = jnp.einsum("ab,anq->nabq", jnp.eye(axes), p.root).reshape(runs * axes, -1)
        half = jax.scipy.linalg.solve_triangular(p.factor, rows.T, lower=True)
        half = half.reshape(-1, runs, axes)
        out = out.at[p.segments].set(jnp.einsum("kna,knb->nab", half, half))
    return out


marginal_slopes = jax.vmap(marginal_residuals, in_axes=(None, -1), out_axes=-1)
"""Function that applies `marginal_residuals` to each column of a Jacobian (segment, m, free)."""
mean_effect_slopes = jax.vmap(mean_effects, in_axes=(None, -1), out_axes=-1)
"""Function that applies `mean_effects` to each column of a Jacobian (segment, m, free)."""


class EffectForecast(NamedTuple):
    """Forecast of the shared effects of segments along, across and in yaw.

    Attributes:
        mean: posterior means of the effects.
        slope: derivative of the mean with respect to the search vector.
        covariance: covariance of the effects, given the fitted parameters.
    """

    mean: Float[np.ndarray, "segment 3"]
    slope: Float[np.ndarray, "segment 3 free"]
    covariance: Float[np.ndarray, "segment 3 3"]


@dataclass(frozen=True, eq=False)
class FittedEffects:
    """Fitted effects that neighbouring runs on a floor share (the Gaussian process d).

    Attributes:
        speeds_and_loads: speeds and loads of the fitted runs on the floor.
        std: std of the process along, across and in yaw.
        coefs: posterior mean of the coefficients of the process; their prior variance is 1.
        by_number: derivative of `coefs` with respect to the search vector.
        covariance: covariance of the coefficients, given the fitted parameters.
    """

    speeds_and_loads: tuple[SpeedAndLoad, ...]
    std: Float[np.ndarray, "3"]
    coefs: Float[np.ndarray, "3 coef"]
    by_number: Float[np.ndarray, "3 coef free"]
    covariance: Float[np.ndarray, "3 coef 3 coef"]

    def forecast(self, conditions: TravelConditions) -> EffectForecast:
        """Return the effects expected in new runs on this floor."""
        basis, around = conditions.basis(self.speeds_and_loads), conditions.around()
        of = self.std[:, None, None] * basis
        whole = np.where(np.isfinite(conditions.direction), (around**2).sum(axis=-1), 1.0)
        rest = (self.std[:, None] ** 2 * np.maximum(whole - (basis**2).sum(axis=-1), 0.0)).T
        known = np.einsum("anq,aqbr->nabr", of, self.covariance)
        return EffectForecast(
            np.einsum("anq,aq->na", of, self.coefs),
            np.einsum("anq,aqp->nap", of, self.by_number),
            np.einsum("nabr,bnr->nab", known, of) + rest[:, :, None] * np.eye(len(AXES)),
        )


def forecast_effects(
    found: Mapping[str, FittedEffects], w: Windows, robot: Robot, free: int
) -> EffectForecast:
    """Return the effects expected in runs on any floor; zero on floors without fitted effects.

    `free` is the length of the search vector.
    """
    n, axes = len(w), len(AXES)
    out = EffectForecast(np.zeros((n, axes)), np.zeros((n, axes, free)), np.zeros((n, axes, axes)))
    if not found:
        return out
    conditions, floors = TravelConditions.of(w, robot), np.asarray(w.surface)
    for floor, one in found.items():
        mine = np.flatnonzero(floors == floor)
        if len(mine):
            for whole, part in zip(out, one.forecast(conditions.subset(mine)), strict=True):
                whole[mine] = part
    return out
