"""Predictive density of every run given all other runs of a posterior, in closed form.

Runs share effects (`slipid.fitting.shared_effects`), so that the likelihood of a run given all
shared effects, which were estimated with this very run, would be too high. Leave-one-out
cross-validation needs the density of each run given the other runs, for each draw of the parameters
(Buerkner, Gabry and Vehtari 2021, Computational Statistics 36).

Residuals r_i less the mean shared effects are r_i - E_i e_i, with the mean e and the covariance K
of the effects given all runs. They know r_i with the information M_i = E_i^T W_i^T W_i E_i of the
whitening matrix W_i, which contains the weight of the run at the fit. Without a run,

    K' = (1 - K M)^-1 K,    e' = e - K' E^T W^T W (r - E e)

with the rows and columns of this run; these are the leave-one-out formulas of Gaussian processes
(Sundararajan and Keerthi 2001, Neural Computation 13(5)) for effects of low rank. The density of
the run is then that of Student's t around E e' with the scale matrix V + E K' E^T: its own noise
has the tail that it has in the fit, and the uncertainty of the shared effects widens the scale. All
other runs count with their weights at the fit, which stand for their tails.

A run of several segments is predicted segment by segment: each is left out together with the later
segments of its run, but its earlier ones are given, so that the product of the densities is that of
the run. Currents and voltages share no effects.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float, Int

from slipid.fitting import likelihood as lk
from slipid.fitting.shared_effects import EffectPosterior
from slipid.fitting.variances import inverse_root
from slipid.infer.posterior.coordinates import Anchor
from slipid.infer.posterior.density import Density, HeldMotion

_AXES = 3


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Effects of the segments without their runs, and covariances of their residuals.

    Attributes:
        together: indices of the segments that are left out with each segment, itself first; rows
            are filled up with the segment itself.
        covariance: covariance K' of each segment's effects with those of these segments, which are
            left out; zero where rows are filled up.
        effect: change of each segment's residuals per unit of an effect.
        weight: matrix W^T W of each segment.
        root, log_det: whitening matrix and log determinant of V + E K' E^T.
    """

    together: Int[np.ndarray, "segment most"]
    covariance: Float[np.ndarray, "segment most 3 3"]
    effect: Float[np.ndarray, "segment m 3"]
    weight: Float[np.ndarray, "segment m m"]
    root: Float[np.ndarray, "segment m m"]
    log_det: Float[np.ndarray, " segment"]

    @classmethod
    def of(cls, anchor: Anchor, run: Int[np.ndarray, " segment"]) -> "LeftOut":
        """Return the effects without each run; `run` is the index of each segment's run."""
        white = (
            np.asarray(anchor.root["motion"]) * np.asarray(anchor.scale["motion"])[:, None, None]
        )
        count, m, _ = white.shape
        most = max(np.unique(run, return_counts=True)[1])
        together = np.repeat(np.arange(count)[:, None], most, axis=1)
        covariance = np.zeros((count, most, _AXES, _AXES))
        effect = np.zeros((count, m, _AXES))
        for of, shared in zip(anchor.effects, anchor.shared, strict=True):
            effect[np.asarray(of.segments)] = shared.effect
            for mine, rows in _runs(of, run):
                later = _in_turn(rows.T @ rows, np.asarray(of.span)[mine])
                for k, row in enumerate(later):
                    segment, left = of.segments[mine[k]], len(mine) - k
                    together[segment, :left] = of.segments[mine[k:]]
                    covariance[segment, :left] = row
        own = np.linalg.inv(np.asarray(anchor.root["motion"]))
        wide = own @ np.swapaxes(own, 1, 2)
        wide += np.einsum("nma,nab,nlb->nml", effect, covariance[:, 0], effect)
        root = np.asarray(inverse_root(jnp.asarray(wide)))
        log_det = np.linalg.slogdet(wide)[1]
        weight = np.swapaxes(white, 1, 2) @ white
        return cls(together, covariance, effect, weight, root, log_det)

    def residuals(self, rest: Float[Array, "draw segment m"]) -> Float[Array, "draw segment m"]:
        """Return residuals less the effects expected from other runs.

        `rest` holds residuals less the mean effects given all runs.
        """
        score = jnp.einsum("nma,nml,dnl->dna", self.effect, self.weight, rest)
        change = jnp.einsum("nkab,dnkb->dna", self.covariance, score[:, self.together])
        return rest + jnp.einsum("nma,dna->dnm", self.effect, change)


def _runs(
    of: EffectPosterior, run: Int[np.ndarray, " segment"]
) -> Iterator[tuple[Int[np.ndarray, " some"], Float[np.ndarray, "coefs effect"]]]:
    """Yield the segments of every run on a floor, and a root of the covariance of their effects.

    Segments are counted among those of the floor. The transposed root times the root is the
    covariance K, in which the three effects of each segment follow each other.
    """
    axes, count, _ = of.root.shape
    rows = jnp.einsum("ab,anq->nabq", jnp.eye(axes), of.root).reshape(count * axes, -1)
    half = np.asarray(solve_triangular(of.factor, rows.T, lower=True)).reshape(-1, count, axes)
    of_segment = run[np.asarray(of.segments)]
    for one in np.unique(of_segment):
        mine = np.flatnonzero(of_segment == one)
        yield mine, half[:, mine].reshape(len(half), -1)


def _in_turn(
    covariance: Float[np.ndarray, "effect effect"], span: Float[np.ndarray, "some m 3"]
) -> Iterator[Float[np.ndarray, "later 3 3"]]:
    """Yield rows of K' for each segment of a run: itself and the later ones, given the others.

    `covariance` is K of the whole run.
    """
    count, size = len(span), len(covariance)
    known = np.zeros((count, _AXES, count, _AXES))
    known[np.arange(count), :, np.arange(count)] = np.swapaxes(span, 1, 2) @ span
    information = known.reshape(size, size)
    left = np.linalg.solve(np.eye(size) - covariance @ information, covariance)
    for k in range(0, size, _AXES):
        at = slice(k, k + _AXES)
        yield np.swapaxes(left[at, k:].reshape(_AXES, -1, _AXES), 0, 1)
        given = information[at, at] @ np.linalg.inv(
            np.eye(_AXES) + left[at, at] @ information[at, at]
        )
        left = left - left[:, at] @ given @ left[at]


def log_likelihoods(
    density: Density, x: Float[np.ndarray, "ensemble draw size"], run: Int[np.ndarray, " segment"]
) -> dict[str, Float[np.ndarray, "ensemble draw segment"]]:
    """Return the log density of every segment given other runs, for every draw, by residual block.

    `run` is the index of each segment's run; the sum over the segments of a run is the log density
    of the run.
    """
    anchor = density.anchor
    left = LeftOut.of(anchor, run)
    wide = replace(
        anchor,
        root=anchor.root | {"motion": jnp.asarray(left.root)},
        log_det=anchor.log_det | {"motion": jnp.asarray(left.log_det)},
    )
    out: dict[str, list[np.ndarray]] = {}
    for draws in x:
        rest = density.mapped(Density.residual_blocks, draws, None)
        more = density.mapped(_log_jacobians, draws, None)
        rest = rest | {"motion": left.residuals(rest["motion"])}
        for k, r in rest.items():
            logs = jax.vmap(partial(wide.log_student, k))(r) + more.get(k, 0.0)
            out.setdefault(k, []).append(np.asarray(logs))
    return {k: np.stack(v) for k, v in out.items()}


def _log_jacobians(
    density: Density, anchor: Anchor, x: Array, _: HeldMotion | None
) -> dict[str, Array]:
    """Return log |d residuals / d data| of every segment, by residual block."""
    robot = density.problem.space.tree(density.full(anchor, x))
    camera, spread = lk.log_jacobians(robot, anchor.batch, anchor.noise(robot))
    return {"motion": camera, "voltage": spread}
