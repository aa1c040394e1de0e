"""What may be said of every number: interval, verdict, flat directions."""

from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any

import numpy as np
from jaxtyping import Float

from slipid.parameter import Choice, Entry, Space

IDENTIFIED, WEAK = 0.3, 0.8
"""Largest std(posterior) / std(prior) of the verdicts, in the search space."""
TAIL, SMALL = 4.0, 0.05
"""A positive number counts as being at 0 when it is so many prior stds below its prior mean, and
below this part of it: a tight prior that the data contradict is something else."""
NEEDS_VOLTAGE = ("motor.resistance", "motor.back_emf")
"""Without a voltage nothing sets the scale of these; a prior elsewhere must not lend them one."""
_Z95 = 1.6448536269514722


@dataclass(frozen=True)
class Estimate:
    """One fitted or fixed number (or short vector) as people and files get it.

    Attributes:
        path: its name.
        value, std: [unit], a float or one per label; std is None where it was fixed.
        interval90: equal-tailed, (low, high), or one such pair per label.
        labels: of a vector's entries, () for a scalar.
        verdict: identified, weak, not_identified, at_bound or fixed; of a vector the verdict of its
            worst direction.
        provenance: measured (data decide), borrowed (a prior decides), override (a choice
            fixed it: the user's, or slipid's where one speed cannot tell).
        ratio: std(posterior) / std(prior) in the search space, None where it was fixed.
        pull: (estimate - prior mean) / std(prior), of a vector the largest, None where fixed.
        prior_mean, prior_std: [unit], None where it was fixed.
    """

    path: str
    unit: str
    doc: str
    labels: tuple[str, ...]
    value: Any
    std: Any
    interval90: Any
    verdict: str
    provenance: str
    ratio: float | None
    pull: float | None
    prior_mean: Any
    prior_std: Any
    source: str = "laplace"


@dataclass(frozen=True)
class Flat:
    """A direction in which the data do not hold the parameters.

    Attributes:
        paths: of the parameters that move together.
        powers: each is multiplied by t to this power, for any t.
        text: the formula, and which channel would fix it.
    """

    paths: tuple[str, ...]
    powers: tuple[float, ...]
    text: str


def estimates(
    space: Space,
    choices: Sequence[Choice],
    z: Float[np.ndarray, " free"],
    covariance: Float[np.ndarray, "free free"],
    has_voltage: bool,
) -> tuple[Estimate, ...]:
    """Every declared number with its interval and verdict, in order of declaration."""
    tree = space.tree(_jax(z))
    return tuple(
        _free(space, e, tree, z, covariance, has_voltage)
        if e.path in space.place
        else _fixed(e, tree, choices)
        for e in space.all
    )


def _labels(entry: Entry) -> tuple[str, ...]:
    if entry.size == 1:
        return ()
    if entry.size == 2:
        return ("x", "y")
    return tuple(f"wheel {k + 1}" for k in range(entry.size))


def _plain(x: Any) -> Any:
    """A float, or a tuple of floats."""
    x = np.asarray(x, float)
    return float(x.reshape(())) if x.size == 1 else tuple(float(v) for v in x)


def _fixed(entry: Entry, tree: Any, choices: Sequence[Choice]) -> Estimate:
    chosen = any(
        fnmatchcase(entry.path, c.pattern) and (c.fixed is not None or c.start is not None)
        for c in choices
    )
    return Estimate(
        path=entry.path,
        unit=entry.declaration.unit,
        doc=entry.declaration.doc,
        labels=_labels(entry),
        value=_plain(entry.get(tree)),
        std=None,
        interval90=None,
        verdict="fixed",
        provenance="override" if chosen else "borrowed",
        ratio=None,
        pull=None,
        prior_mean=None,
        prior_std=None,
    )


def _free(
    space: Space,
    entry: Entry,
    tree: Any,
    z: np.ndarray,
    covariance: np.ndarray,
    has_voltage: bool,
) -> Estimate:
    at, d = space.place[entry.path], entry.declaration
    mean, block = np.asarray(z)[at], covariance[at, at]
    prior_mean, prior_std = space.prior_mean[at], space.prior_std[at]
    value = np.atleast_1d(np.asarray(entry.get(tree), float))
    std_z = np.sqrt(np.diag(block))
    if d.shares:
        rng = np.random.default_rng(0)
        spread = rng.multivariate_normal(mean, block, size=4000, method="cholesky")
        draws = np.stack([np.asarray(d.to_si(s)) for s in _jax(spread)])
        low, high = np.quantile(draws, [0.05, 0.95], axis=0)
        std = draws.std(axis=0)
        center = np.asarray(d.to_si(_jax(prior_mean)))
        wide = np.full(entry.size, prior_std.mean() / entry.size)
    else:
        low, high = (np.asarray(d.to_si(_jax(mean + k * std_z))) for k in (-_Z95, _Z95))
        std = np.array([d.slope(float(v)) for v in value]) * std_z
        center = np.asarray(d.to_si(_jax(prior_mean)))
        wide = np.array([d.slope(float(v)) for v in center]) * prior_std
    scaled = block / prior_std[:, None] / prior_std[None, :]
    ratio = float(np.sqrt(np.linalg.eigvalsh(scaled)[-1]))
    pull = (mean - prior_mean) / prior_std
    verdict = _verdict(entry, value, pull, prior_std, ratio, has_voltage)
    return Estimate(
        path=entry.path,
        unit=d.unit,
        doc=d.doc,
        labels=_labels(entry),
        value=_plain(value),
        std=_plain(std),
        interval90=_pairs(low, high),
        verdict=verdict,
        # below 1/sqrt(2) the data hold more information than the prior
        provenance="measured"
        if verdict != "not_identified" and ratio < np.sqrt(0.5)
        else "borrowed",
        ratio=ratio,
        pull=float(pull[np.argmax(np.abs(pull))]),
        prior_mean=_plain(center),
        prior_std=_plain(wide),
    )


def _jax(x: np.ndarray) -> Any:
    import jax.numpy as jnp

    return jnp.asarray(x)


def _pairs(low: np.ndarray, high: np.ndarray) -> Any:
    pairs = tuple((float(a), float(b)) for a, b in zip(low, high, strict=True))
    return pairs[0] if len(pairs) == 1 else pairs


def _verdict(
    entry: Entry,
    value: np.ndarray,
    place: np.ndarray,
    prior_std: np.ndarray,
    ratio: float,
    has_voltage: bool,
) -> str:
    d = entry.declaration
    if entry.path in NEEDS_VOLTAGE and not has_voltage:
        return "not_identified"
    if np.isfinite(d.upper) and np.isfinite(d.lower) and not d.shares:
        part = (value - d.lower) / (d.upper - d.lower)
        if (part < 0.01).any() or (part > 0.99).any():
            return "at_bound"
    elif np.isfinite(d.lower) and not d.shares:
        below = place * prior_std
        if ((place < -TAIL) & (below < np.log(SMALL))).any():
            return "at_bound"
    return by_ratio("", ratio)


def by_ratio(before: str, ratio: float) -> str:
    """Verdict of std(posterior) / std(prior), where another reason has not decided it before."""
    if before in ("at_bound", "fixed"):
        return before
    if ratio < IDENTIFIED:
        return "identified"
    return "weak" if ratio < WEAK else "not_identified"


def flat_directions(
    space: Space,
    covariance: Float[np.ndarray, "free free"],
    has_current: bool,
    has_voltage: bool,
) -> tuple[Flat, ...]:
    """Directions in motor numbers, friction and mass that the data leave as wide as the prior.

    Eigenvectors of the prior-scaled posterior covariance S^-1 C S^-1 of these numbers, given the
    others, with sqrt(eigenvalue) > 0.8: what more data of the same kind could not narrow. Numbers
    that no datum touches come first, each by itself: they would mix into the directions of others.
    """
    names = [
        e.path
        for e in space.free
        if e.coordinates == 1
        and (e.path.startswith("motor.") or e.path.endswith(".friction") or e.path == "robot.mass")
    ]
    if not names:
        return ()
    index = np.array([space.place[n].start for n in names])
    std = space.prior_std[index]
    precision = np.linalg.inv(covariance)[np.ix_(index, index)]
    scaled = np.linalg.inv(precision * std[:, None] * std[None, :])
    alone = np.diag(scaled) - np.abs(scaled - np.diag(np.diag(scaled))).max(axis=1, initial=0.0)
    alone_flat = (np.diag(scaled) > 0.98) & (alone > 0.97)
    found = [
        Flat((names[k],), (1.0,), _text((names[k],), (1.0,), has_current, has_voltage))
        for k in np.flatnonzero(alone_flat)
    ]
    rest = np.flatnonzero(~alone_flat)
    if len(rest) > 1:
        values, vectors = np.linalg.eigh(scaled[np.ix_(rest, rest)])
        for value, vector in zip(values, vectors.T, strict=True):
            if np.sqrt(max(value, 0.0)) <= WEAK:
                continue
            moved = vector * std[rest]
            moved = moved / moved[np.argmax(np.abs(moved))]
            pick = np.flatnonzero(np.abs(moved) > 0.2)
            if len(pick) > 1:
                paths = tuple(names[rest[k]] for k in pick)
                powers = tuple(round(float(moved[k]), 2) for k in pick)
                text = _text(paths, powers, has_current, has_voltage)
                found.append(Flat(paths, powers, text))
    return tuple(found)


def _text(
    paths: tuple[str, ...], powers: tuple[float, ...], has_current: bool, has_voltage: bool
) -> str:
    electric = any(p.startswith("motor.") for p in paths)
    if not has_current:
        remedy = "log the motor currents, and the motor voltage (or duty and bus voltage)"
    elif electric and not has_voltage:
        remedy = "log the motor voltage (or duty and bus voltage)"
    else:
        remedy = "drive with other loads and speeds, or weigh the robot"
    if len(paths) == 1:
        return f"the data say next to nothing of {paths[0]}: {remedy}"
    if all(abs(k - 1) < 0.05 for k in powers):
        short = _short(paths)
        last = NEEDS_VOLTAGE[1] if NEEDS_VOLTAGE[1] in short else short[0]
        ratios = ", ".join(f"{p}/{last}" for p in short if p != last)
        return f"{', '.join(short)} only as {ratios}: {remedy}"
    parts = [p if abs(k - 1) < 0.05 else f"{p}^{k:g}" for p, k in zip(paths, powers, strict=True)]
    return f"{', '.join(parts)} (each times t to the power shown, any t): {remedy}"


def _short(paths: tuple[str, ...]) -> list[str]:
    """The paths, with one pattern in place of the frictions of several floors."""
    floors = [p for p in paths if p.startswith("surface.")]
    if len(floors) < 2:
        return list(paths)
    return [p for p in paths if p not in floors] + ["surface.*.friction"]
