"""Sanity before fitting: do encoders, commands, gyro and poses tell of the same robot?"""

from collections.abc import Iterator

import numpy as np

from slipid.data.runs import Runs
from slipid.data.sanity.causes import explained
from slipid.data.sanity.electric import constant, electric
from slipid.data.sanity.evidence import usable
from slipid.data.sanity.exchanged import exchanged
from slipid.data.sanity.finding import Finding, worst_first
from slipid.data.sanity.gather import Lag, find_lag, gather
from slipid.data.sanity.ratios import FORWARD, TURNS, Ratios, ratios
from slipid.data.sanity.reading import Evidence, Reading, misfits, to_body
from slipid.data.sanity.recorded import Recorded, recorded
from slipid.data.sanity.shape import mistakes
from slipid.data.sanity.single_runs import likeness, single_runs, standing
from slipid.data.sanity.steps import Edges, Steps, edges, steps
from slipid.data.sanity.wording import of_causes, of_mistake
from slipid.model.geometry import Geometry

FEW = 20
"""Steps below which nothing is compared."""
FOREIGN = 0.5
"""Share of the poses' motion that wheels leave unexplained in any reading, from which it is said."""
LATE_S = 1.0
"""Lag of the poses from which it is said [s]."""
TOO_LATE_S = 1.9
"""Lag beyond which a fit of it would not be near enough at its start [s]."""
SLOW_M_S, SLOW_ROW_S = 0.01, 2.0
"""Rim speeds below and times between rows above which time is in a smaller unit than declared."""
FAST_M_S, FAST_ROW_S = 50.0, 1e-3
"""The reverse."""
SHORT = 0.62
"""Body over wheels below which, without commands to vouch for the wheels, it is said."""


def findings(
    data: Runs, geometry: Geometry, mass_kg: float | None = None
) -> tuple[Finding, ...]:
    """What is wrong with runs or with what was declared, the worst first, then what was not checked.

    Args:
        data: runs.
        geometry: as it was declared.
        mass_kg: of the robot, None where it is not known.
    """
    base, radius = float(geometry.base_radius), float(geometry.wheel_radius)
    rolling = np.asarray(geometry.forward()) / radius / np.array([1.0, 1.0, base])
    channels = recorded(data)
    at = edges(channels)
    return worst_first(_all(channels, at, rolling, geometry.gear_ratio, base, radius, mass_kg))


def _all(
    data: Recorded,
    at: Edges,
    rolling: np.ndarray,
    gear_ratio: float,
    base: float,
    radius: float,
    mass_kg: float | None,
) -> Iterator[Finding]:
    lag = find_lag(data, at, base)
    moved = steps(data, at, lag.seconds)
    if usable(moved.wheels).sum() < FEW:
        yield _not_checked(f"the runs are too short: {len(at.run)} steps, at least {FEW} needed")
        return
    evidence = gather(rolling, at, moved, base)
    alone = likeness(at, moved, evidence, Reading(), base, len(data.names))
    still = standing(data, alone)
    reading = Reading()
    if not still.all():
        yield from _of_lag(lag)
        reading, found = mistakes(evidence)
        for mistake in found:
            yield of_mistake(mistake)
        alone = likeness(at, moved, evidence, reading, base, len(data.names))
        yield from _foreign(evidence, reading)
    yield from single_runs(data, alone)
    seen = ratios(data, at, moved, evidence, reading)
    if still.all():
        seen = Ratios({k: r for k, r in seen.known.items() if k not in ("travel", "turning")}, seen.speed_is_angle)
    row = float(np.median(data.row))
    fitting, single = explained(seen, row, gear_ratio)
    factors = of_causes(fitting, single, _said(seen), gear_ratio)
    yield from factors
    if not fitting and not all(r.natural for r in seen.known.values()):
        yield Finding(
            "scales",
            f"the channels disagree about how far the robot went, and no single number explains it: {_said(seen)}",
            "check the units of all channels, gear_ratio, wheel_radius_m and base_radius_m",
            "wrong",
        )
    if not any(f.kind == "time_unit" for f in factors):
        yield from _of_time(data, moved, at, row, radius)
    yield from electric(data, reading, radius, mass_kg)
    yield from exchanged(data)
    yield from _suspicious(seen)
    yield from _notes(data, evidence, reading, seen)


def _of_lag(lag: Lag) -> Iterator[Finding]:
    if abs(lag.seconds) < LATE_S:
        return
    late = lag.seconds > 0
    yield Finding(
        "lag",
        f"the poses come {abs(lag.seconds):.1f} s {'after' if late else 'before'} the encoders: so "
        f"{lag.unexplained:.2f} of the motion is left unexplained, without {lag.without:.2f}",
        f"set offset = {-lag.seconds:.1f} s on the poses' time when they are merged with the robot's "
        f"log, or start 'camera.lag' there ({lag.seconds:.1f} s)",
        "wrong" if abs(lag.seconds) > TOO_LATE_S else "suspicious",
    )


def _foreign(evidence: Evidence, reading: Reading) -> Iterator[Finding]:
    left = misfits(evidence, reading)["pose"]
    if left > FOREIGN:
        yield Finding(
            "pose_unexplained",
            f"the poses do not follow the wheels: {left:.2f} of their motion is left unexplained, "
            "in any order, with any signs and axes",
            "check whether poses and encoders are of the same runs and of the same time, and "
            "whether the wheels were on the ground",
            "wrong",
        )


def _said(seen: Ratios) -> str:
    """The ratios that are not natural."""
    words = {
        "travel": "the body moves {:.3g} times as far as the wheels say",
        "turning": "the body turns {:.3g} times as far as the wheels say",
        "drive": "the commanded motion is {:.3g} times what the wheels did",
        "steer": "the commanded turn is {:.3g} times what the wheels did",
        "command": "the commanded wheel speeds are {:.3g} times the measured ones",
        "report": "the reported wheel speeds are {:.3g} times what the encoders say",
        "gyro": "the gyro turns {:.3g} times as far as the poses",
    }
    return ", ".join(words[k].format(r.value) for k, r in seen.known.items() if not r.natural)


def _of_time(
    data: Recorded, moved: Steps, at: Edges, row: float, radius: float
) -> Iterator[Finding]:
    """Time in another unit, where only its size tells it."""
    speed = np.abs(moved.wheels) / (at.after - at.before)[:, None] * radius
    top = float(np.nanquantile(speed, 0.95))
    slow = row > SLOW_ROW_S and top < SLOW_M_S
    if slow or (row < FAST_ROW_S and top > FAST_M_S):
        unit = "ms" if slow else "s"
        yield Finding(
            "time_unit",
            f"rows are {row:.3g} s apart and wheels reach {top:.2g} m/s",
            f"set unit = '{unit}' for the channel time",
            "wrong",
        )


def _suspicious(seen: Ratios) -> Iterator[Finding]:
    travel = seen.known.get("travel")
    if travel is None or "drive" in seen.known or "command" in seen.known:
        return
    if travel.natural and travel.value < SHORT:
        yield Finding(
            "travel",
            f"the body moves {travel.value:.2f} times as far as the wheels say, and no command is "
            "logged that could vouch for the wheels",
            "check wheel_radius_m, gear_ratio, ticks_per_revolution and the unit of the poses, "
            "unless the wheels slip so much",
            "suspicious",
        )


def _notes(
    data: Recorded, evidence: Evidence, reading: Reading, seen: Ratios
) -> Iterator[Finding]:
    """What could not be checked."""
    predict = to_body(evidence, reading)
    pose = next(iter(evidence.pose.values()), None)
    if pose is not None:
        share = np.einsum("aw,wv,av->a", predict, pose.turns, predict)
        share = share / max(float(share.sum()), 1e-300)
        free = np.linalg.matrix_rank(evidence.rolling, tol=1e-6) == 3
        if share[2] < TURNS:
            yield _not_checked(
                "no run turns: base radius, unit of the heading and gyro could not be checked"
            )
        if share[0] < FORWARD:
            yield _not_checked("no run drives ahead: its lengths and signs could not be checked")
        if free and share[1] < FORWARD:
            yield _not_checked(
                "no run drives sideways: order and signs of the wheels could only be checked in part"
            )
    if evidence.twist is None and evidence.command is None:
        yield _not_checked(
            "no command is logged: wheels that turn too far could not be told from wheels that slip"
        )
    if data.current is not None and not data.current_is_signed:
        yield _not_checked("currents are magnitudes: their signs could not be checked")
    if constant(data.gyro):
        yield _not_checked("the gyro never changes: it could not be checked")


def _not_checked(what: str) -> Finding:
    return Finding("not_checked", what, None, "note")
