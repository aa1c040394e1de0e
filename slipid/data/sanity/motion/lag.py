"""How far the poses lag behind the encoders, whatever wheels and axes mean."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from slipid.data.sanity.motion.evidence import left_by_linear, usable
from slipid.data.sanity.motion.headings import FRAMES, Frame, body_motion
from slipid.data.sanity.motion.recorded import Recorded
from slipid.data.sanity.motion.steps import Edges, turns

LONGEST_S = 8.0
"""Largest lag that is looked for, either way [s]."""
STEP_S = 0.5
"""Coarse grid of lags [s]; a fifth of it is the fine one."""
SAMPLES = 1500
"""Steps that lags are compared on."""
CLIPPED = 5.0
"""Steps of the body beyond so many usual ones are shortened to that."""
ENOUGH = 0.3
"""Part of the steps, and of all motion, that must be there at both lags."""
GAIN, DROP = 0.6, 0.02
"""A lag is believed where it leaves less than this part of what no lag leaves unexplained, and so
much less of the body's motion."""
_LINEAR = tuple(f for f in FRAMES if f.heading != "turned_round")
"""Frames whose steps differ by more than a linear map: mirrored ones do not."""


@dataclass(frozen=True)
class Lag:
    """Delay of the poses behind the encoders.

    Attributes:
        seconds: that explains the motion best [s]; 0 where none is decisively better.
        unexplained: share of the body's motion that wheels do not explain there.
        without: the same at no lag, for the same steps.
    """

    seconds: float
    unexplained: float
    without: float


def find_lag(data: Recorded, at: Edges, base: float) -> Lag:
    """Lag at which a linear map of turns explains the body's steps best, in any frame."""
    every = max(1, len(at.run) // SAMPLES)
    some = Edges(*(getattr(at, name)[::every] for name in Edges.__dataclass_fields__))
    bodies = {frame: _clipped(body_motion(some, frame) * [1, 1, base]) for frame in _LINEAR}
    here = turns(data, some, 0.0)
    coarse = np.arange(-LONGEST_S, LONGEST_S + 0.1, STEP_S)
    best = _best(data, some, here, bodies, coarse)
    less = 0.0 if best is None else best.without - best.unexplained
    if best is None or best.unexplained >= GAIN * best.without or less <= DROP:
        return Lag(0.0, 0.0, 0.0)
    fine = best.seconds + np.arange(-STEP_S, STEP_S + 1e-9, STEP_S / 5)
    return _best(data, some, here, bodies, fine) or best


def _best(
    data: Recorded,
    at: Edges,
    here: Float[np.ndarray, "step wheel"],
    bodies: Mapping[Frame, Float[np.ndarray, "step 3"]],
    lags: Iterable[float],
) -> Lag | None:
    """The lag of some that leaves the smallest part of what no lag leaves."""
    found: list[Lag] = []
    for lag in lags:
        there = turns(data, at, float(lag))
        pairs = [_unexplained(there, here, body) for body in bodies.values()]
        mine, without = (min(pair[k] for pair in pairs) for k in (0, 1))
        found.append(Lag(float(lag), mine, without))
    return min(found, key=lambda of: of.unexplained / max(of.without, 1e-12), default=None)


def _unexplained(there: np.ndarray, here: np.ndarray, body: np.ndarray) -> tuple[float, float]:
    """Unexplained shares at a lag and at none, of the steps that both have."""
    known = usable(there, here, body)
    if known.mean() < ENOUGH or known.sum() < 4 * here.shape[1]:
        return 1.0, 1.0
    # steps in which poses or wheels stand still are explained by anything
    for of in (body, here):
        if (of[known] ** 2).sum() < ENOUGH * np.nansum(of**2):
            return 1.0, 1.0
    return left_by_linear(there[known], body[known]), left_by_linear(here[known], body[known])


def _clipped(body: Float[np.ndarray, "step 3"]) -> Float[np.ndarray, "step 3"]:
    """Steps no longer than a few usual ones: a jump must not outweigh the run."""
    far = np.linalg.norm(body, axis=1)
    moving = far[far > 0]
    most = CLIPPED * float(np.nanmedian(moving)) if len(moving) else 1.0
    return body * np.minimum(1.0, most / np.maximum(far, 1e-300))[:, None]
