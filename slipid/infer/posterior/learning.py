"""Learning of the surrogate that Hamiltonian moves follow, in turns.

In every turn the surrogate is fitted to exact rows, and Hamiltonian trajectories on it then give
vectors whose exact rows are added for the next turn. Where a surrogate claims a density that is not
there, its trajectories go there and the next one is corrected.
"""

import os
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property

import jax
import numpy as np
from jaxtyping import Float

from slipid.infer.posterior.blocks import LEAST_ROWS, Chain, Learnt, LogDensity, Plan
from slipid.infer.posterior.proposals import TEMPERATURE, families, wander
from slipid.infer.posterior.surrogate import (
    GroupSurrogate,
    Matrix,
    ResidualRows,
    Surrogate,
    gaussian_root,
    group_surrogate,
    term_count,
)

TARGET_FOLLOWED = 0.96
"""Target fraction of trajectories that the surrogate accepts, to which their step is adapted.

With a usual target of 0.8, walkers stay for long where the density is steep: on the logs of four
floors the slowest parameter had a seventh of the effective draws."""
FIRST_STEP, LEAST_STEP, MOST_STEP = 0.07, 0.01, 0.6
"""First, smallest and largest leapfrog step, in standard coordinates."""
ADAPTION = 2.0
"""Change of the logarithm of a step per excess of the accepted fraction."""
ROUNDS = 3
"""Number of times that step and Gaussian are adapted to a new surrogate."""
KEPT_TURNS = 4
"""The surrogate is fitted to at most this many times the first number of rows, the latest ones."""
FROM_CHAIN = 1 / 3
"""Largest fraction of new rows that are positions of the chain."""
NEAR, WIDE_SHARE = (0.05, 1.2), 0.15
"""Range of the squared scale of the first rows [std^2], and fraction of rows with other scales."""
PER_TERM, FEW = 2.0, 500
"""Number of rows per term of the polynomials with the most terms, and least number of rows, both
limited by `Plan.rows`."""
CLAIMED = 3.0
"""Excess of the surrogate's log density, beyond its median, above which walkers seldom start."""
STRETCHED, STRETCH = 0.2, 3.0
"""Fraction of new rows that are moved along weak coordinates, and largest distance [std]."""
CHUNK = LEAST_ROWS
"""Number of vectors whose rows are evaluated and stored together."""
LAPLACE_WEIGHT = 1e-3
"""Weight of the Laplace covariance that is added to the covariance of draws."""


class Learner:
    """Learns surrogates of a target, and keeps the exact rows that it has evaluated.

    Attributes:
        target: the log density.
        plan: settings of the sampler.
    """

    def __init__(self, target: LogDensity, plan: Plan):
        self.target, self.plan = target, plan
        self._kept: dict[bytes, list[ResidualRows]] = {}
        most = max(term_count(target.inputs(g), target.positive) for g in range(target.groups))
        self._rows = min(plan.rows, max(round(PER_TERM * most), FEW))

    @cached_property
    def first(self) -> Learnt:
        """The surrogate learnt around the Laplace approximation.

        Most rows are where it is plausible, others further away, where there may be other modes.
        """
        target, random = self.target, np.random.default_rng((self.plan.seed, 1, 0))
        root, rows = gaussian_root(target.covariance, target.group), _whole(self._rows)
        wide = random.uniform(size=rows) < WIDE_SHARE
        near, far = np.sqrt(random.uniform(*NEAR, rows)), random.uniform(0, self.plan.spread, rows)
        standard = random.standard_normal((rows, target.size))
        design = target.centre + np.where(wide, far, near)[:, None] * standard @ root.T
        shape = self.plan.ensembles, self.plan.walkers
        scale = self.plan.spread * np.geomspace(0.25, 1.0, shape[1])[:, None]
        start = target.centre + scale * random.standard_normal((*shape, target.size)) @ root.T
        steps = np.full(len(families(target)), FIRST_STEP)
        return self._turn(design, start, (target.centre, root), steps, random)

    def next(self, known: Learnt, chain: Chain, number: int) -> Learnt:
        """Return the surrogate learnt from that before and new positions of the chain.

        `number` is the number of the block after which the surrogate is learnt.
        """
        random = np.random.default_rng((self.plan.seed, 1, number))
        places = chain.reshape(-1, self.target.size)
        count = _whole(min(int(FROM_CHAIN * self._rows), len(places)))
        some = places[random.choice(len(places), count, replace=False)]
        design = np.concatenate([known.design, some])[-_whole(KEPT_TURNS * self._rows) :]
        frame = known.surrogate.centre, known.surrogate.root
        return self._turn(design, chain[:, -1], frame, known.step, random)

    def _turn(
        self,
        design: Matrix,
        start: Float[np.ndarray, "ensemble walker size"],
        frame: tuple[Float[np.ndarray, " size"], Matrix],
        step: Float[np.ndarray, " family"],
        random: np.random.Generator,
    ) -> Learnt:
        """Return the surrogate fitted to a design, to which draws of the surrogate are added."""
        target = self.target
        prior = target.prior_mean, target.prior_std, target.link, target.link_centre
        surrogate = Surrogate(self._fitted(design), target.group, *prior, *frame)
        x, step, drawn = start.reshape(-1, target.size), step.copy(), []
        calls = -(-self._rows // (ROUNDS * len(x)))
        of_family = families(target)
        for _ in range(ROUNDS):
            # all coordinates last, whose draws spread furthest
            turns = [k for k in range(1, len(of_family)) for _ in range(max(2, calls // 4))]
            for k in [*turns, *[0] * calls]:
                key = jax.random.key(random.integers(2**31))
                found = wander(surrogate, x, of_family[k], float(step[k]), key, learning=1.0)
                x = np.asarray(found.x)
                drawn.append(x)
                off = float(found.followed) - TARGET_FOLLOWED
                step[k] = np.clip(step[k] * np.exp(ADAPTION * off), LEAST_STEP, MOST_STEP)
            last = np.concatenate(drawn[-calls:])
            spread = np.cov(last.T) / TEMPERATURE + LAPLACE_WEIGHT * target.covariance
            root = gaussian_root(np.atleast_2d(spread), target.group)
            surrogate = surrogate._replace(centre=last.mean(axis=0), root=root)
        more = np.concatenate(drawn)
        count = _whole(min(self._rows, len(more)))
        more = more[random.choice(len(more), count, replace=False)]
        self._stretch(more, surrogate, random)
        places = self._plausible(x, surrogate, random).reshape(start.shape)
        return Learnt(surrogate, step, np.concatenate([design, more]), places)

    def _plausible(self, x: Matrix, surrogate: Surrogate, random: np.random.Generator) -> Matrix:
        """Return draws of the surrogate, some replaced by others.

        Those are replaced where the surrogate claims a density that is not there. From there,
        Hamiltonian moves on it would not return.
        """
        excess = self.target.terms(x).sum(axis=1) - surrogate.value(x)
        finite = excess[np.isfinite(excess)]
        usual = np.median(finite) if len(finite) else 0.0
        good = np.flatnonzero(np.log(random.uniform(size=len(x))) < excess - usual + CLAIMED)
        if not len(good):
            return x
        out = x[random.choice(good, len(x))]
        out[good] = x[good]
        return out

    def _stretch(self, rows: Matrix, surrogate: Surrogate, random: np.random.Generator) -> None:
        """Move some rows, in place, along the inputs of the surrogate that are known worst.

        The other coordinates follow by regression. Without such rows, the tail of a density that a
        surrogate misses would not be found, since no trajectory on it goes there.
        """
        covariance = surrogate.root @ surrogate.root.T
        worst = [of.inputs.at[k] for of in surrogate.groups for k in np.unique(of.inputs.wide)]
        if not worst:
            return
        count = int(STRETCHED * len(rows))
        which = random.choice(np.unique(worst), count)
        along = covariance[which] / np.sqrt(np.diag(covariance)[which])[:, None]
        rows[:count] += random.uniform(-STRETCH, STRETCH, (count, 1)) * along

    def _fitted(self, design: Matrix) -> tuple[GroupSurrogate, ...]:
        """Return the surrogate of every group, fitted to the exact rows of a design."""
        target = self.target
        chunks = np.split(design, len(design) // CHUNK)
        new = {c.tobytes(): c for c in chunks if c.tobytes() not in self._kept}

        def evaluated(x: Matrix) -> list[ResidualRows]:
            return [ResidualRows(x, *target.rows(x, g)) for g in range(target.groups)]

        def fitted(g: int) -> GroupSurrogate:
            parts = zip(*(rows[g] for rows in self._kept.values()), strict=True)
            rows = ResidualRows(*(np.concatenate(part) for part in parts))
            own = int((target.group == g).sum())
            return group_surrogate(rows, target.inputs(g), target.positive, own)

        with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            found = dict(zip(new, pool.map(evaluated, new.values()), strict=True))
            known = self._kept | found
            self._kept = {c.tobytes(): known[c.tobytes()] for c in chunks}
            return tuple(pool.map(fitted, range(target.groups)))


def _whole(count: int) -> int:
    """Return the largest number of vectors up to `count` that fill whole chunks."""
    return count - count % CHUNK
