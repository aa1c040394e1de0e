"""Sanity before fitting: do encoders, commands, gyro and poses tell of the same robot?

Kinds of findings: `wheel_sign`, `wheel_order`, `wheel_azimuths`, `wheel_scale`, `wheel_speed_unit`,
`heading_sign`, `heading_unit`, `heading_offset`, `heading_quaternion`, `pose_axis`, `pose_swapped`,
`pose_mirrored`, `pose_length`, `pose_constant`, `pose_of_another_run`, `pose_unexplained`, `lag`,
`base_radius`, `time_unit`, `current_sign`, `current_order`, `current_unit`, `current_of_supply`,
`voltage_sign`, `voltage_order`, `voltage_unit`, `gyro_sign`, `gyro_unit`, `command_sign`,
`command_order`, `command_unit`, `command_exchanged`, `wheel_columns`, `scales`, `travel`,
`not_checked`.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from slipid.data.runs import Runs
from slipid.data.sanity.axes.gather import gather
from slipid.data.sanity.axes.reading import Evidence, Reading, misfits
from slipid.data.sanity.axes.shape import mistakes
from slipid.data.sanity.axes.words import of_mistake
from slipid.data.sanity.columns import BROUGHT, SAME, misordered
from slipid.data.sanity.electric import electric
from slipid.data.sanity.exchanged import exchanged
from slipid.data.sanity.finding import Finding, worst_first
from slipid.data.sanity.motion.evidence import usable
from slipid.data.sanity.motion.lag import Lag, find_lag
from slipid.data.sanity.motion.recorded import Recorded, recorded
from slipid.data.sanity.motion.steps import Edges, Steps, edges, steps
from slipid.data.sanity.notes import not_checked, notes
from slipid.data.sanity.scales.causes import explained
from slipid.data.sanity.scales.ratios import Ratios, ratios
from slipid.data.sanity.scales.words import of_causes, of_ratios
from slipid.data.sanity.single_runs import likeness, single_runs, standing
from slipid.model.geometry import Geometry

FEW = 20
"""Steps below which nothing is compared."""
FOREIGN = 0.4
"""Share of the poses' motion, left unexplained in any reading, from which it is said."""
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


@dataclass(frozen=True, eq=False)
class _Declared:
    """Numbers of the declared robot; `rolling` is J / r with the heading at the base radius."""

    rolling: Float[np.ndarray, "wheel 3"]
    base: float
    radius: float
    gear_ratio: float
    mass_kg: float | None


@dataclass(frozen=True, eq=False)
class _Compared:
    """What poses and wheels say of each other.

    `findings` are about lag, order, signs and axes, and about single runs; `reading` is how they
    are right; `poses` says whether the poses can be compared any further.
    """

    findings: tuple[Finding, ...]
    moved: Steps
    evidence: Evidence
    reading: Reading
    poses: bool


def findings(data: Runs, geometry: Geometry, mass_kg: float | None = None) -> tuple[Finding, ...]:
    """What is wrong with runs or with what was declared, the worst first, then what is not known.

    Args:
        data: runs.
        geometry: as it was declared.
        mass_kg: of the robot, None where it is not known.
    """
    base, radius = float(geometry.base_radius), float(geometry.wheel_radius)
    rolling = np.asarray(geometry.forward()) / radius / np.array([1.0, 1.0, base])
    robot = _Declared(rolling, base, radius, float(geometry.gear_ratio), mass_kg)
    channels = recorded(data)
    said = tuple(_all(channels, edges(channels), robot))
    if not {finding.kind for finding in said} & {*SAME}:
        columns = tuple(misordered(data.logs))
        said = tuple(f for f in said if not columns or f.kind not in BROUGHT) + columns
    return worst_first(said)


def _all(data: Recorded, at: Edges, robot: _Declared) -> Iterator[Finding]:
    """Findings in no order."""
    found = _compared(data, at, robot)
    if found is None:
        yield not_checked(f"the runs are too short: {len(at.run)} steps, {FEW} are needed")
        return
    yield from found.findings
    seen = ratios(data, at, found.moved, found.evidence, found.reading)
    if not found.poses:
        known = {k: r for k, r in seen.known.items() if k not in ("travel", "turning", "gyro")}
        seen = Ratios(known, seen.speed_is_angle)
    factors = tuple(_factors(seen, data, robot)) or tuple(_of_time(data, found.moved, at, robot))
    yield from factors
    yield from electric(data, found.reading, robot.radius, robot.mass_kg, not factors)
    yield from exchanged(data)
    yield from _suspicious(seen)
    yield from notes(data, found.evidence, found.reading)


def _compared(data: Recorded, at: Edges, robot: _Declared) -> _Compared | None:
    """Comparison of poses and wheels; None where there are too few steps."""
    lag = find_lag(data, at, robot.base)
    moved = steps(data, at, lag.seconds)
    if usable(moved.wheels).sum() < FEW:
        return None
    evidence = gather(robot.rolling, at, moved, robot.base)
    declared = likeness(at, moved, evidence, Reading(), robot.base, len(data.names))
    if standing(data, declared).all():
        return _Compared(tuple(single_runs(data, declared)), moved, evidence, Reading(), False)
    reading, found = mistakes(evidence)
    left = misfits(evidence, reading)["pose"]
    if left > FOREIGN:
        return _Compared((_foreign(left),), moved, evidence, Reading(), False)
    alike = likeness(at, moved, evidence, reading, robot.base, len(data.names))
    # a half sine turns back at half a turn, which puts single runs out of step
    alone = () if reading.frame.heading == "half_sine" else tuple(single_runs(data, alike))
    said = (*_of_lag(lag), *map(of_mistake, found), *alone)
    return _Compared(said, moved, evidence, reading, True)


def _of_lag(lag: Lag) -> Iterator[Finding]:
    """Poses that come much later or earlier than encoders."""
    if abs(lag.seconds) < LATE_S:
        return
    late = "after" if lag.seconds > 0 else "before"
    yield Finding(
        "lag",
        f"the poses come {abs(lag.seconds):.1f} s {late} the encoders: so {lag.unexplained:.2f} of "
        f"the motion is left unexplained, without {lag.without:.2f}",
        f"shift the poses' times by {-lag.seconds:+.1f} s, or start 'camera.lag' in [parameters] "
        f"at {lag.seconds:.1f}",
        "wrong" if abs(lag.seconds) > TOO_LATE_S else "suspicious",
    )


def _foreign(left: float) -> Finding:
    return Finding(
        "pose_unexplained",
        f"the poses do not follow the wheels: {left:.2f} of their motion is left unexplained, in "
        "any order, with any signs and axes",
        "check whether poses and encoders are of the same runs and of the same time, and whether "
        "the wheels were on the ground",
        "wrong",
    )


def _factors(seen: Ratios, data: Recorded, robot: _Declared) -> Iterator[Finding]:
    """Units and sizes that are wrong."""
    fitting, single = explained(seen, float(np.median(data.row)), robot.gear_ratio)
    yield from of_causes(fitting, single, of_ratios(seen), robot.gear_ratio)
    if not fitting and not all(r.natural for r in seen.known.values()):
        yield Finding(
            "scales",
            "the channels disagree about how far the robot went, and no single number explains "
            f"it: {of_ratios(seen)}",
            "check the units of all channels, gear_ratio, wheel_radius_m and base_radius_m",
            "wrong",
        )


def _of_time(data: Recorded, moved: Steps, at: Edges, robot: _Declared) -> Iterator[Finding]:
    """Time in another unit, where only its size tells it."""
    row = float(np.median(data.row))
    speed = np.abs(moved.wheels) / (at.after - at.before)[:, None] * robot.radius
    top = float(np.nanquantile(speed, 0.95))
    slow = row > SLOW_ROW_S and top < SLOW_M_S
    if slow or (row < FAST_ROW_S and top > FAST_M_S):
        yield Finding(
            "time_unit",
            f"rows are {row:.3g} s apart and wheels reach {top:.2g} m/s",
            f"set unit = '{'ms' if slow else 's'}' for the channel time",
            "wrong",
        )


def _suspicious(seen: Ratios) -> Iterator[Finding]:
    """Wheels that go much further than the body, with nothing to vouch for them."""
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
