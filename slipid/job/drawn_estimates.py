"""Numbers of a robot from draws of its posterior: means, intervals, verdicts."""

from collections.abc import Mapping
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from slipid.identify import slip_curves as curves_of
from slipid.identify.fit.problem import Problem
from slipid.identify.fit_file import curves_json, identified_json, number_json
from slipid.identify.posterior.diagnosis import Posterior
from slipid.identify.result import Fit
from slipid.identify.verdicts.estimates import (
    NEEDS_VOLTAGE,
    Estimate,
    by_ratio,
    derived,
    from_zero,
    provenance,
)
from slipid.support.content import Content


def estimates(fit: Fit, found: Posterior) -> dict[str, Estimate]:
    """Every number with mean, interval and verdict from the draws.

    Means are taken in the search space, so that shares sum to one and positive numbers have their
    geometric mean.
    """
    flat = found.z.reshape(-1, fit.space.size)
    out = dict(fit.parameters)
    for e in fit.space.free:
        at, d, old = fit.space.place[e.path], e.declaration, fit.parameters[e.path]
        z = flat[:, at]
        values = np.asarray(jax.vmap(d.to_si)(jnp.asarray(z)))
        low, high = np.quantile(values, [0.05, 0.95], axis=0)
        scaled = np.cov((z / fit.space.prior_std[at]).T).reshape(e.coordinates, e.coordinates)
        ratio = float(np.sqrt(np.linalg.eigvalsh(scaled)[-1]))
        pairs = tuple(zip(low.tolist(), high.tolist(), strict=True))
        mean = np.asarray(d.to_si(jnp.asarray(z.mean(axis=0)))).tolist()
        std = values.std(axis=0).tolist()
        single = len(pairs) == 1
        kept = old.verdict == "at_bound" or (e.path in NEEDS_VOLTAGE and not fit.channels.voltage)
        verdict = old.verdict if kept else by_ratio(ratio, from_zero(d, z.std(axis=0)))
        pull = (z.mean(axis=0) - fit.space.prior_mean[at]) / fit.space.prior_std[at]
        out[e.path] = replace(
            old,
            value=mean[0] if single else tuple(mean),
            std=std[0] if single else tuple(std),
            interval90=pairs[0] if single else pairs,
            ratio=ratio,
            verdict=verdict,
            provenance=provenance(verdict, ratio),
            pull=float(pull[np.argmax(np.abs(pull))]),
            source="posterior",
        )
    return out


def identified(
    fit: Fit, found: Posterior, numbers: Mapping[str, Estimate], problem: Problem
) -> Content:
    """Content of identified.json with what the posterior says, `numbers` being its estimates."""
    content = identified_json(fit)
    for path, e in numbers.items():
        content["parameters"][path] = number_json(e)
    flat = found.z.reshape(-1, fit.space.size)
    ratios = derived(fit.space, flat.mean(axis=0), np.cov(flat.T), fit.channels.voltage)
    content["derived"] = {e.path: number_json(_drawn(e, fit, flat)) for e in ratios}
    some = flat[:: max(1, len(flat) // 400)]
    curves = curves_of.curves(fit.space, flat.mean(axis=0), some, problem.batch)
    content["curves"] = curves_json(curves)
    if not found.converged:
        content["messages"].append(f"the posterior did not converge: {found.reason}")
    return content


def _drawn(ratio: Estimate, fit: Fit, flat: np.ndarray) -> Estimate:
    """A quotient with the interval and the std of its draws."""
    over, under = (fit.space.place[path] for path in ratio.path.rsplit("/", 1))
    draws = np.exp(flat[:, over] - flat[:, under])
    low, high = np.quantile(draws, [0.05, 0.95]).tolist()
    std = float(draws.std())
    return replace(ratio, std=std, interval90=(low, high), source="posterior")
