"""Intervals and verdicts of every parameter and of ratios of parameters.

Before a fit they are computed from the expected information, after it from the Laplace
approximation, or from draws of a chain.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from typing import Any

import numpy as np
from jaxtyping import Float

from slipid.fitting.variances import Search, Square
from slipid.infer.verdicts.draws import Z95, Draws
from slipid.parameter import Declaration
from slipid.search_space import Choice, Space

IDENTIFIED, WEAK = 0.3, 0.8
"""Largest std(posterior) / std(prior), in the search space, for `identified` and for `weak`."""
FROM_ZERO = 3.0
"""Smallest ratio of a positive parameter to its std at which it can be identified.

The likelihood of a parameter closer to 0 is flat towards 0, even if its logarithm has a narrow
interval."""
AT_ZERO_STDS, AT_ZERO_RATIO = 4.0, 0.05
"""Limits at which a positive parameter counts as being at its bound 0.

The parameter must be more than `AT_ZERO_STDS` prior stds below its prior mean and less than
`AT_ZERO_RATIO` times that mean. The second condition excludes parameters with a narrow prior that
the data contradict.
"""
NEEDS_VOLTAGE = ("motor.resistance", "motor.back_emf")
"""Parameters that are not identified without voltages.

Without voltages their scale is determined only by the priors of other parameters."""
LARGEST_LOG = 600.0
"""Largest logarithm at an end of an interval; exp of a larger one could overflow."""


def _ratio(unit: str, doc: str) -> Declaration:
    return Declaration(unit=unit, symbol="", start=1.0, lower=0.0, doc=doc)


RATIOS: Mapping[tuple[str, str], Declaration] = {
    ("motor.resistance", "motor.back_emf"): _ratio(
        "ohm*rad/(V*s)", "needs logged voltages, as do the resistance and the back-EMF"
    ),
    ("surface.friction", "motor.back_emf"): _ratio("rad/(V*s)", "torque scale, from currents"),
    ("motor.coulomb_friction", "motor.back_emf"): _ratio("A", "current at crawling speed"),
    ("motor.viscous_friction", "motor.back_emf"): _ratio("A*s/rad", "current per wheel speed"),
    ("camera.scale", "robot.wheel_radius"): _ratio(
        "1/m", "the only ratio that motion without slip determines"
    ),
}
"""Pairs of numerator and denominator whose quotient gets its own verdict if both are free.

A quotient may be identified even if neither parameter is. If the numerator has a value for each
floor, there is a quotient for every floor.

The resistance occurs in the voltage equation only: contact forces determine the motion of the body,
and with the torque constant they determine the currents. Without voltages not even R / C_e is
identified, in contrast to models that compute slip from R I^2 + C_e I wm."""


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """One fitted or fixed parameter (or short vector) with its uncertainty and verdict.

    Attributes:
        path: name of the parameter.
        unit: unit of the parameter.
        doc: meaning of the parameter.
        labels: labels of a vector's elements, () for a scalar.
        value: a float, or one per label [unit]; that of a fit is its mode, which is not in the
            middle of the interval of a skewed posterior.
        std: a float, or one per label, None for a fixed parameter [unit].
        interval90: equal-tailed interval (low, high), or one such pair per label [unit].
        verdict: identified, weak, disputed, not_identified, at_bound or fixed; a vector has the
            verdict of its least determined direction.
        provenance: measured (determined by data), borrowed (by a prior or a default) or override
            (fixed by a choice: the user's, or slipid's if all runs have one speed).
        ratio: std(posterior) / std(prior) in the search space, the largest over the directions of a
            vector, None for a fixed parameter.
        pull: (estimate - prior mean) / std(prior) in the search space, the largest in magnitude of
            a vector, None for a fixed parameter.
        prior_mean: mean of the prior, None for a fixed parameter [unit].
        prior_std: std of the prior, None for a fixed parameter [unit].
        source: origin of std and interval: `laplace` approximation, draws of a `short_chain` that
            contradict it, or draws of the `posterior`.
    """

    path: str
    unit: str
    doc: str
    labels: tuple[str, ...] = ()
    value: Any
    std: Any = None
    interval90: Any = None
    verdict: str = "fixed"
    provenance: str = "borrowed"
    ratio: float | None = None
    pull: float | None = None
    prior_mean: Any = None
    prior_std: Any = None
    source: str = "laplace"


def estimates(
    space: Space,
    choices: Sequence[Choice],
    z: Search,
    covariance: Square,
    has_voltage: bool,
    flat: Collection[str],
    chain: Draws | None = None,
) -> tuple[Estimate, ...]:
    """Return every declared parameter with its interval and verdict, in order of declaration.

    Std and interval of a parameter are those of the Laplace approximation, or those of the draws of
    a short chain where both contradict each other.

    Args:
        space: free and fixed parameters.
        choices: user's choices.
        z: search vector of the estimate.
        covariance: covariance of the search vector.
        has_voltage: True if voltages were logged.
        flat: paths of the parameters that change along flat directions.
        chain: draws of the short chain.
    """
    tree, slices, out = space.tree(z), space.slices, []
    for e in space.all:
        d, value = e.declaration, np.atleast_1d(np.asarray(e.get(tree), float))
        base = Estimate(path=e.path, unit=d.unit, doc=d.doc, labels=e.labels, value=plain(value))
        if e.path not in slices:
            chosen = [c for c in choices if fnmatchcase(e.path, c.pattern)]
            is_override = any(c.fixed is not None or c.start is not None for c in chosen)
            out.append(replace(base, provenance="override") if is_override else base)
            continue
        at, forced = slices[e.path], None
        mean, prior = np.asarray(z)[at], (space.prior_mean[at], space.prior_std[at])
        if e.path in NEEDS_VOLTAGE and not has_voltage:
            forced = "not_identified"
        elif _at_bound(d, value, (mean - prior[0]) / prior[1], prior[1]):
            forced = "at_bound"
        drawn, block, is_flat = None, covariance[at, at], e.path in flat
        if chain is not None:
            drawn, block = _contradicting(Draws(chain.z[..., at]), mean, block)
        found = judged(base, d, mean, block, prior, forced, is_flat, drawn)
        out.append(found if drawn is None else replace(found, source="short_chain"))
    return tuple(out)


def _contradicting(
    draws: Draws,
    mean: Float[np.ndarray, " coordinate"],
    block: Float[np.ndarray, "coordinate coordinate"],
) -> tuple[Float[np.ndarray, "draw coordinate"] | None, Float[np.ndarray, "coordinate coordinate"]]:
    """Return draws and their covariance if they contradict a Gaussian, else its covariance."""
    if not draws.contradict(mean, block):
        return None, block
    return draws.flat, np.atleast_2d(np.cov(draws.flat.T))


def plain(x: Any) -> Any:
    """Return a float for a single number, else a tuple of floats."""
    x = np.asarray(x, float)
    return float(x.reshape(())) if x.size == 1 else tuple(float(v) for v in x)


def judged(
    base: Estimate,
    d: Declaration,
    mean: Float[np.ndarray, " coordinate"],
    block: Float[np.ndarray, "coordinate coordinate"],
    prior: tuple[Float[np.ndarray, " coordinate"], Float[np.ndarray, " coordinate"]],
    forced: str | None,
    is_flat: bool,
    drawn: Float[np.ndarray, "draw coordinate"] | None = None,
) -> Estimate:
    """Return an estimate with its interval and verdict.

    The interval is that of the draws if there are any, else of the Gaussian approximation.

    Args:
        base: path, unit, meaning and value of the parameter.
        d: declaration of the parameter, with the map from the search space to SI units.
        mean: value in the search space.
        block: covariance in the search space.
        prior: mean and std of the prior in the search space.
        forced: verdict that replaces the one from the ratio of stds, None to replace nothing.
        is_flat: True if the parameter changes along a flat direction.
        drawn: draws of a posterior in the search space.
    """
    value = np.atleast_1d(np.asarray(base.value, float))
    prior_mean, prior_std = prior
    std_z, center = np.sqrt(np.diag(block)), np.asarray(d.to_si(prior_mean))
    draws = drawn
    if d.constrained:
        wide = np.full(len(value), prior_std.mean() / len(value))
        if draws is None:
            rng = np.random.default_rng(0)
            draws = rng.multivariate_normal(mean, block, size=4000, method="cholesky")
    else:
        wide = d.slope(center) * prior_std
    if draws is None:
        most = LARGEST_LOG if d.logarithmic else np.inf
        ends = (np.minimum(mean + k * std_z, most) for k in (-Z95, Z95))
        low, high = (np.asarray(d.to_si(end)) for end in ends)
        std = d.slope(value) * std_z
    else:
        values = np.asarray(d.to_si(draws))
        (low, high), std = np.quantile(values, [0.05, 0.95], axis=0), values.std(axis=0)
    scaled = block / prior_std[:, None] / prior_std[None, :]
    ratio = float(np.sqrt(np.linalg.eigvalsh(scaled)[-1]))
    pull = (mean - prior_mean) / prior_std
    pairs = tuple(zip(low.tolist(), high.tolist(), strict=True))
    verdict, provenance = verdict_of(ratio, from_zero(d, std_z), forced, is_flat)
    if d.relative and verdict == "identified":
        verdict = "weak"  # a warmer motor between two set-ups has the same effect
    return replace(
        base,
        std=plain(std),
        interval90=pairs[0] if len(pairs) == 1 else pairs,
        verdict=verdict,
        provenance=provenance,
        ratio=ratio,
        pull=float(pull[np.argmax(np.abs(pull))]),
        prior_mean=plain(center),
        prior_std=plain(wide),
        source="laplace" if drawn is None else "posterior",
    )


def _at_bound(d: Declaration, value: np.ndarray, pull: np.ndarray, prior_std: np.ndarray) -> bool:
    if d.shares or not np.isfinite(d.lower):
        return False
    if np.isfinite(d.upper):
        part = (value - d.lower) / (d.upper - d.lower)
        return bool(((part < 0.01) | (part > 0.99)).any())
    return bool(((pull < -AT_ZERO_STDS) & (pull * prior_std < np.log(AT_ZERO_RATIO))).any())


def from_zero(declaration: Declaration, std_z: Float[np.ndarray, " coordinate"]) -> float:
    """Return the ratio of a positive parameter to its std, infinity for any other parameter."""
    positive = np.isfinite(declaration.lower) and not np.isfinite(declaration.upper)
    return float(1 / std_z.max()) if positive and not declaration.shares else np.inf


def by_ratio(ratio: float, from_zero: float = np.inf) -> str:
    """Return the verdict for std(posterior) / std(prior) and the value's distance from 0 [std]."""
    if ratio < IDENTIFIED and from_zero >= FROM_ZERO:
        return "identified"
    return "weak" if ratio < WEAK else "not_identified"


def verdict_of(
    ratio: float, from_zero: float, forced: str | None, is_flat: bool
) -> tuple[str, str]:
    """Return verdict and provenance of a parameter, after a fit or after sampling.

    At a ratio below 1/sqrt(2) the data have more information than the prior. A parameter that
    changes along a flat direction is at most weak and is borrowed: only its ratio to other
    parameters can be identified, and its scale, however narrow its interval, comes from a prior.

    Args:
        ratio: std(posterior) / std(prior).
        from_zero: distance of a positive parameter from 0 [std].
        forced: verdict that replaces the one from `ratio`, None to replace nothing.
        is_flat: True if the parameter changes along a flat direction.
    """
    verdict = forced or by_ratio(ratio, from_zero)
    if is_flat and verdict == "identified":
        verdict = "weak"
    measured = verdict != "not_identified" and ratio < np.sqrt(0.5) and not is_flat
    return verdict, "measured" if measured else "borrowed"


def derived(
    space: Space,
    z: Search,
    covariance: Square,
    has_voltage: bool,
    draws: Float[np.ndarray, "draw free"] | None = None,
    chain: Draws | None = None,
) -> tuple[Estimate, ...]:
    """Return the quotients `RATIOS` with intervals and verdicts.

    The logarithm of a quotient is a difference of two coordinates. The verdict follows from the
    ratio of the posterior std of this difference, sqrt(c^T C c) with c = (.., 1, .., -1, ..), to
    its prior std. If draws of a posterior are given, z and `covariance` must be their mean and
    covariance; the intervals are then those of the draws. Draws of a short chain are used as in
    `estimates`.
    """
    slices = space.slices
    pairs = [
        (over.path, under, d)
        for (quantity, under), d in RATIOS.items()
        for over in space.free
        if over.quantity == quantity and under in slices
    ]
    out = []
    for over, under, d in pairs:
        c = np.zeros(len(z))
        c[slices[over]], c[slices[under]] = 1.0, -1.0
        mean, block = np.atleast_1d(c @ z), np.atleast_2d(c @ covariance @ c)
        prior_std = np.atleast_1d(np.sqrt(np.sum((c * space.prior_std) ** 2)))
        base = Estimate(path=f"{over}/{under}", unit=d.unit, doc=d.doc, value=float(np.exp(c @ z)))
        forced = "not_identified" if over == NEEDS_VOLTAGE[0] and not has_voltage else None
        prior, drawn = (np.atleast_1d(c @ space.prior_mean), prior_std), None
        if draws is not None:
            drawn = (draws @ c)[:, None]
        elif chain is not None:
            drawn, block = _contradicting(Draws(chain.z @ c[:, None]), mean, block)
        found = judged(base, d, mean, block, prior, forced, False, drawn)
        by_chain = chain is not None and drawn is not None
        out.append(replace(found, source="short_chain") if by_chain else found)
    return tuple(out)
