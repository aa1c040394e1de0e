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
    """Return events over time: one cut of each of `CUTS_S`, then ten random patterns.

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
    """Outputs of a control loop in one pattern, a row for each step.

    Attributes:
        twist: velocity of the body [m/s, m/s, rad/s].
        estimated: estimate of it.
        command: wheel speeds [rad/s].
        drives_off, gave_up: flags of the controller.
    """

    twist: Float[np.ndarray, "step 3"]
    estimated: Float[np.ndarray, "step 3"]
    command: Float[np.ndarray, "step drive"]
    drives_off: Bool[np.ndarray, " step"]
    gave_up: Bool[np.ndarray, " step"]


def share(twist: Float[np.ndarray, "step 3"]) -> Float[np.ndarray, " step"]:
    """Return speed or yaw rate over that demanded, the larger of both."""
    speed = np.hypot(twist[:, 0], twist[:, 1]) / np.hypot(*ASKED[:2])
    return np.maximum(speed, np.abs(twist[:, 2]) / ASKED[2])


def after_release(pattern: Int[np.ndarray, " step"]) -> Bool[np.ndarray, " step"]:
    """Return whether each step is free and in the two seconds after a release."""
    out, since = np.zeros(len(pattern), bool), np.inf
    for k in range(1, len(pattern)):
        since = since + DT if pattern[k] == FREE else np.inf
        if pattern[k] == FREE and pattern[k - 1] != FREE:
            since = 0.0
        out[k] = since <= 2.0
    return out


def faults(
    run: Driven, pattern: Int[np.ndarray, " step"], radius: float, limit: float
) -> list[str]:
    """Return what a robot did wrong, with wheels of a radius [m] and a limit [m/s^2].

    Its own estimate counts only where nobody held it: a gyro that shows no motion while wheels turn
    contradicts the model.
    """
    late, end = after_release(pattern), run.twist[-20:]
    speed, yaw = np.hypot(end[:, 0], end[:, 1]).min(), end[:, 2].min()
    held = np.isin(pattern, (HELD, STALLED)).any()
    free = (pattern[-100:] == FREE).all()
    change = np.abs(np.diff(run.command, axis=0)).max() * radius
    found = {
        "commands that are not finite": not np.isfinite(run.command).all(),
        "faster than asked after a release": share(run.twist[late]).max(initial=0.0) > MOST,
        "estimated faster than asked": not held
        and share(run.estimated[late]).max(initial=0.0) > MOST,
        "acceleration above its limit": change > limit * DT + 1e-9,
        "drives still off": free and run.drives_off[-20:].any(),
        "gave up and was not armed again": free and run.gave_up[-20:].any(),
        f"slow at the end, {speed:.3f} m/s": free and speed < 0.8 * ASKED[0],
        f"turns slowly at the end, {yaw:.3f} rad/s": free and yaw < 0.5 * ASKED[2],
    }
    return [name for name, wrong in found.items() if wrong]
