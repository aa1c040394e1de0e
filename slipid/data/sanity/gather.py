"""From recorded channels to the evidence that readings are compared with, and the lag before it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from slipid.data.sanity.evidence import Products, products, usable
from slipid.data.sanity.headings import HEADINGS, Frame, body_motion
from slipid.data.sanity.reading import Commanded, Evidence
from slipid.data.sanity.recorded import LONGEST_LAG_S, Recorded
from slipid.data.sanity.steps import Edges, Steps, steps

FRAMES = tuple(Frame(heading, down) for heading in HEADINGS for down in (False, True))
"""Every frame whose steps of the body differ by more than a rotation."""
LAG_STEP_S = 0.5
"""Coarse grid of lags [s]; a fifth of it is the fine one."""
LAG_SAMPLES = 1500
"""Steps that lags are compared on."""
CLIPPED = 5.0
"""Steps of the body beyond so many usual ones are shortened to that, where lags are compared."""
LAG_GAIN = 0.6
"""Another lag is believed where it leaves less than this part of what no lag leaves unexplained."""
LAG_DROP = 0.02
"""And this much less of the body's motion."""


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
    every = max(1, len(at.run) // LAG_SAMPLES)
    some = Edges(*(getattr(at, name)[::every] for name in Edges.__dataclass_fields__))
    bodies = {f: _clipped(body_motion(some, f) * [1, 1, base]) for f in FRAMES}
    here = steps(data, some, 0.0)
    found = Lag(0.0, *[min(_unexplained(here, here, body)[0] for body in bodies.values())] * 2)
    coarse = np.arange(-LONGEST_LAG_S, LONGEST_LAG_S + 0.1, LAG_STEP_S)
    best = _best(data, some, here, bodies, coarse)
    if best is None or not _better(best):
        return found
    fine = best.seconds + np.arange(-LAG_STEP_S, LAG_STEP_S + 1e-9, LAG_STEP_S / 5)
    return _best(data, some, here, bodies, fine) or best


def _best(
    data: Recorded, at: Edges, here: Steps, bodies: dict[Frame, np.ndarray], lags: np.ndarray
) -> Lag | None:
    """The lag of some that leaves the smallest part of what no lag leaves."""
    found: list[Lag] = []
    for lag in lags:
        moved = steps(data, at, float(lag))
        if moved.inside.mean() < 0.3:
            continue
        pairs = [_unexplained(moved, here, body) for body in bodies.values()]
        mine, without = (min(pair[k] for pair in pairs) for k in (0, 1))
        found.append(Lag(float(lag), mine, without))
    return min(found, key=lambda of: of.unexplained / max(of.without, 1e-12), default=None)


def _better(lag: Lag) -> bool:
    less = lag.without - lag.unexplained
    return lag.unexplained < LAG_GAIN * lag.without and less > LAG_DROP


def _clipped(body: Float[np.ndarray, "step 3"]) -> Float[np.ndarray, "step 3"]:
    """Steps no longer than a few usual ones: a jump must not outweigh the run."""
    far = np.linalg.norm(body, axis=1)
    moving = far[far > 0]
    most = CLIPPED * float(np.nanmedian(moving)) if len(moving) else 1.0
    return body * np.minimum(1.0, most / np.maximum(far, 1e-300))[:, None]


def _unexplained(moved: Steps, here: Steps, body: np.ndarray) -> tuple[float, float]:
    """Unexplained shares at a lag and at none, of the steps that both have."""
    known = usable(moved.wheels, here.wheels, body)
    if known.sum() < 4 * moved.wheels.shape[1]:
        return 1.0, 1.0
    shares = []
    for turns in (moved.wheels, here.wheels):
        found = products(turns[known], body[known], 1.0, rounds=0)
        shares.append(1.0 if found is None else found.unexplained)
    return shares[0], shares[1]


def gather(rolling: Float[np.ndarray, "wheel 3"], at: Edges, moved: Steps, base: float) -> Evidence:
    """Products of all channels.

    Args:
        rolling: J / r, heading in metres at the base radius [rad/m].
        base: base radius [m].
    """
    pose: dict[Frame, Products] = {}
    gyro: dict[Frame, float] = {}
    for frame in FRAMES:
        body = body_motion(at, frame)
        found = products(moved.wheels, body, base)
        if found is None:
            continue
        pose[frame] = found
        if moved.gyro is not None:
            gyro[frame] = _alike(moved.gyro, body, found)
    twist = None if moved.twist is None else products(moved.wheels, moved.twist, base, rounds=0)
    if twist is not None and not np.trace(twist.body) > 0:
        twist = None
    return Evidence(rolling, pose, twist, _commanded(moved), gyro if any(gyro.values()) else None)


def _alike(gyro: np.ndarray, body: np.ndarray, found: Products) -> float:
    """Covariance of gyro and heading over the product of their spreads; 0 where none turns."""
    turned = np.stack([gyro[found.known, 0], body[found.known, 2]])
    (own, both), (_, other) = (turned * found.weight) @ turned.T
    return float(both / np.sqrt(own * other)) if own * other > 0 else 0.0


def _commanded(moved: Steps) -> Commanded | None:
    """Products of turns with commanded ones."""
    if moved.commanded is None:
        return None
    known = usable(moved.wheels, moved.commanded)
    turns, said = moved.wheels[known], moved.commanded[known]
    if not (said**2).sum() > 0:
        return None
    return Commanded(turns.T @ said, float((turns**2).sum()), float((said**2).sum()))

