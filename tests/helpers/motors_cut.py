"""Robots whose motors are cut or that are held by hand, and what their controllers may do then."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

DT = 0.05
"""Time step of the control loop [s]."""
ASKED = np.array([0.2, 0.0, 0.2])
"""Demanded twist [m/s, m/s, rad/s]."""
MOST = 1.3
"""Largest speed and yaw rate after a release, over those demanded."""
FREE, CUT, HELD, STALLED = range(4)
"""Wheels turn as commanded; motors are cut, so that wheels stand; held by hand while wheels turn as
commanded, or while they stand."""
CUTS_S = (1, 3, 12, 20, 60)
"""Durations for which motors are cut once [s]."""
STEPS = 1500


def patterns(kinds: tuple[int, ...] = (CUT,)) -> Int[np.ndarray, "pattern step"]:
    """What happens at each time: one cut of each of `CUTS_S`, then ten random patterns.

    The random ones alternate between free and any of `kinds`; they end free for five seconds.
    """
    rng, since = np.random.default_rng(0), np.arange(STEPS) - 100
    rows = [np.where((since >= 0) & (since < seconds / DT), CUT, FREE) for seconds in CUTS_S]
    for _ in range(10):
        times = np.cumsum(rng.uniform(0.1, 6.0, 40)) / DT
        which = np.searchsorted(times, np.arange(STEPS))
        row = np.where(which % 2 == 1, rng.choice(kinds, 41)[which], FREE)
        row[-100:] = FREE
        rows.append(row)
    return np.array(rows)


@dataclass(frozen=True)
class Driven:
    """What a control loop did in one pattern, a row for each step.

    Attributes:
        twist: of the body [m/s, m/s, rad/s].
        estimated: the same as the estimator says it.
        command: wheel speeds [rad/s].
        drives_off, gave_up: of the controller.
    """

    twist: Float[np.ndarray, "step 3"]
    estimated: Float[np.ndarray, "step 3"]
    command: Float[np.ndarray, "step drive"]
    drives_off: Bool[np.ndarray, " step"]
    gave_up: Bool[np.ndarray, " step"]


def share(twist: Float[np.ndarray, "step 3"]) -> Float[np.ndarray, " step"]:
    """Speed or yaw rate over that demanded, the larger of both."""
    speed = np.hypot(twist[:, 0], twist[:, 1]) / np.hypot(*ASKED[:2])
    return np.maximum(speed, np.abs(twist[:, 2]) / ASKED[2])


def after_release(pattern: Int[np.ndarray, " step"]) -> Bool[np.ndarray, " step"]:
    """Free steps in the two seconds after a release."""
    out, since = np.zeros(len(pattern), bool), np.inf
    for k in range(1, len(pattern)):
        since = since + DT if pattern[k] == FREE else np.inf
        if pattern[k] == FREE and pattern[k - 1] != FREE:
            since = 0.0
        out[k] = since <= 2.0
    return out


def judge(run: Driven, pattern: Int[np.ndarray, " step"], radius: float, limit: float) -> None:
    """Assert what must hold for a robot with wheels of a radius [m] and a limit [m/s^2].

    A robot that was held learns a wrong bias of its gyro, so that its own estimate counts only
    where nobody held it.
    """
    late = after_release(pattern)
    assert np.isfinite(run.command).all()
    assert share(run.twist[late]).max(initial=0.0) <= MOST
    if not np.isin(pattern, (HELD, STALLED)).any():
        assert share(run.estimated[late]).max(initial=0.0) <= MOST
    assert np.abs(np.diff(run.command, axis=0)).max() * radius <= limit * DT + 1e-9
    if (pattern[-100:] == FREE).all():
        assert not run.drives_off[-20:].any()
        assert not run.gave_up[-20:].any()
        assert share(run.twist[-20:]).min() > 0.8
