"""Products of increments of wheels, commands and poses, by which interpretations are compared.

A robust fit of the body's steps on the wheels' turns finds outliers, whatever wheels and axes mean:

    body = K turn,    weight = (1 + (|residual| / s)^2)^-2,    s = 2 median |residual|

since a linear map of turns swallows order, signs, radius, azimuths and heading offset alike.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

ROUNDS = 8
"""Rounds of reweighting."""
RIDGE = 1e-4
"""Ridge over the mean product of turns: wheels of one side turn alike."""


@dataclass(frozen=True, eq=False)
class Products:
    """Weighted sums of products over steps.

    Attributes:
        turns: of turns with turns (wheel, wheel) [rad^2].
        across: of turns with steps of the body (wheel, 3); heading in metres at the base radius.
        body: of steps of the body with each other (3, 3) [m^2].
        known: steps in which wheels and body are known (every step,).
        weight: of these (step,).
    """

    turns: Float[np.ndarray, "wheel wheel"]
    across: Float[np.ndarray, "wheel 3"]
    body: Float[np.ndarray, "3 3"]
    known: Bool[np.ndarray, " every"]
    weight: Float[np.ndarray, " step"]


def usable(*parts: Float[np.ndarray, "step _"]) -> Bool[np.ndarray, " step"]:
    """Steps in which all parts are known."""
    return np.all([np.isfinite(part).all(axis=1) for part in parts], axis=0)


def products(
    turns: Float[np.ndarray, "step wheel"],
    body: Float[np.ndarray, "step 3"],
    base: float,
    rounds: int = ROUNDS,
) -> Products | None:
    """Products of steps that are known; None where these are fewer than twice the wheels.

    Args:
        base: base radius, at which headings become metres [m].
        rounds: of reweighting; none for commands, which have no outliers.
    """
    known = usable(turns, body)
    if known.sum() < 2 * turns.shape[1]:
        return None
    turns, body = turns[known], body[known] * [1.0, 1.0, base]
    weight = np.ones(len(turns))
    for _ in range(rounds):
        off = np.linalg.norm(body - turns @ _linear(turns, body, weight), axis=1)
        weight = (1 + (off / (2 * float(np.median(off)) + 1e-12)) ** 2) ** -2
    weighted = turns * weight[:, None]
    own = (body * weight[:, None]).T @ body
    return Products(weighted.T @ turns, weighted.T @ body, own, known, weight)


def _linear(turns: np.ndarray, body: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Map from turns to steps of the body (wheel, 3), by least squares with a little ridge."""
    weighted = turns * weight[:, None]
    gram = weighted.T @ turns
    ridge = RIDGE * np.trace(gram) / len(gram) + 1e-300
    return np.asarray(np.linalg.solve(gram + ridge * np.eye(len(gram)), weighted.T @ body))
