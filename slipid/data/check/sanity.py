"""The sanity check of runs before a fit.

Encoders, commands, gyro, currents and poses must agree with each other and with the geometry in the
config. Single runs are searched for constant wheels and poses, for exchanged columns, and for poses
of another run.

Kinds of findings: `wheel_sign`, `wheel_order`, `wheel_azimuths`, `wheel_scale`, `wheel_ticks`,
`wheel_speed_unit`, `wheel_constant`, `no_motion`, `heading_constant`, `heading_sign`,
`heading_unit`, `heading_offset`, `heading_quaternion`, `pose_axis`, `pose_swapped`,
`pose_mirrored`, `pose_length`, `pose_constant`, `position_constant`, `pose_of_another_run`,
`pose_unexplained`, `lag`, `base_radius`, `time_unit`, `current_sign`, `current_order`,
`current_unit`, `current_of_supply`, `voltage_sign`, `voltage_order`, `voltage_unit`, `gyro_sign`,
`gyro_unit`, `command_sign`, `command_order`, `command_unit`, `command_exchanged`, `wheel_columns`,
`wheels_exchanged`, `scales`, `travel`, `steering_sign`, `steering_scale`, `not_checked`.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float

from slipid.data.align.lag import PoseLag, pose_lag
from slipid.data.check.columns import (
    CAUSED_BY_ORDER,
    MADE_REDUNDANT_BY,
    electric,
    exchanged,
    misordered,
)
from slipid.data.check.exchanged_wheels import exchanged_wheels
from slipid.data.check.findings import (
    LEAST_PATH_M,
    LEAST_TURN_RAD,
    ROUNDING_M,
    ROUNDING_RAD,
    Finding,
    cause_findings,
    heading_constant,
    mistake_finding,
    ticks_finding,
    worst_first,
)
from slipid.data.check.interpretation import Evidence, Interpretation, gather, misfits, to_body
from slipid.data.check.joined import (
    ChannelIncrements,
    JoinedRuns,
    StepEdges,
    body_motion,
    edges,
    increments,
    joined,
    rotation,
    usable,
)
from slipid.data.check.mistakes import mistakes
from slipid.data.check.ratios import (
    LEAST_TRANSLATION,
    LEAST_TURNING,
    QUANTITIES,
    ScaleRatio,
    ratios,
    single_causes,
    ticks_per_radian,
    without_factor,
)
from slipid.data.check.steered import steered_findings
from slipid.data.check.stuck import stuck_channels
from slipid.data.runs import Runs
from slipid.data.wheel_signals import MOVED_M
from slipid.model.geometry import Geometry

FEWEST_STEPS = 20
"""Least number of steps with known wheel rotations for a comparison of poses with wheels."""
UNEXPLAINED_IF_FOREIGN = 0.4
"""If the best interpretation leaves more than this fraction of the poses' motion unexplained, poses
and wheels do not belong together [1]."""
LATE_S = 1.0
"""Smallest magnitude of the lag of the poses that is a finding [s]."""
TOO_LATE_S = 1.9
"""Magnitude of the lag above which its finding is `wrong`, because a fit would start too far from
it [s]."""
SLOW_M_S, SLOW_ROW_S = 0.01, 2.0
"""If the rim speed [m/s] is below and the time between rows [s] above these values, the unit of
time is smaller than declared."""
FAST_M_S, FAST_ROW_S = 50.0, 1e-3
"""If the rim speed [m/s] is above and the time between rows [s] below these values, the unit of
time is larger than declared."""
STILL_RAD = 1.0
"""Wheels do not turn if no angle changes by this angle [rad], nor any rim moves by `MOVED_M`; the
radius alone does not tell, since it may be in a wrong unit."""
SHORT_TRAVEL = 0.62
"""Ratio of the body's path length to that of the wheels below which there is a finding if no
command confirms the wheels [1]."""


@dataclass(frozen=True, eq=False)
class _Compared:
    """Result of the comparison of poses with wheels.

    Attributes:
        findings: findings about lag, order, signs, axes and single runs.
        moved: increments of the robot's channels, shifted by the lag of the poses.
        evidence: sums of products of these increments with the body increments.
        meant: the interpretation of the columns that agrees best with the logs.
        poses: True if the poses are usable for further comparisons.
    """

    findings: tuple[Finding, ...]
    moved: ChannelIncrements
    evidence: Evidence
    meant: Interpretation = field(default_factory=Interpretation)
    poses: bool = False


def findings(data: Runs, geometry: Geometry, mass_kg: float | None = None) -> tuple[Finding, ...]:
    """Return the findings about runs and their config, the worst first, notes last.

    Args:
        data: runs.
        geometry: declared geometry of the robot.
        mass_kg: mass of the robot [kg], or None if it is unknown.
    """
    still = tuple(_no_motion(data, float(geometry.wheel_radius)))
    if still and not still[0].runs:
        return still
    unmoved, useless = stuck_channels(data, geometry)
    in_some_runs = [f for f in unmoved if f.kind == "wheel_constant" and f.runs]
    # Runs with stuck encoders would spoil the comparison of the others. But if several wheels seem
    # stuck, each in other runs, the config may have the wheels in wrong places instead.
    subsets = [np.flatnonzero(~useless)] if useless.any() and not useless.all() else []
    subsets += [np.arange(len(data))] if len(in_some_runs) > 1 else []
    for subset in subsets if geometry.driven is None else ():
        found = _of_subset(data.subset(subset), geometry, mass_kg)
        if in_some_runs and _KINDS_OF_WHEELS & {finding.kind for finding in found}:
            return worst_first([*still, *(f for f in unmoved if f not in in_some_runs), *found])
    still += unmoved
    if useless.all():
        return worst_first(still)
    if useless.any():
        data = data.subset(np.flatnonzero(~useless))
    if geometry.driven is not None:
        return worst_first([*still, *steered_findings(data, geometry)])
    return worst_first([*still, *_of_subset(data, geometry, mass_kg)])


_KINDS_OF_WHEELS = {"wheel_order", "wheel_azimuths", "wheel_sign", "wheel_columns"}
"""Kinds of findings about signs and places of the wheels, with which other wheels rightly stand
still than with those of the config."""


def _of_subset(data: Runs, geometry: Geometry, mass_kg: float | None) -> tuple[Finding, ...]:
    """Return the findings from the comparison of all channels of runs."""
    found = tuple(_all(data, geometry, mass_kg))
    if not {finding.kind for finding in found} & {*MADE_REDUNDANT_BY}:
        columns = tuple(misordered(data.logs))
        found = tuple(f for f in found if not columns or f.kind not in CAUSED_BY_ORDER) + columns
    return found


def _no_motion(runs: Runs, radius: float) -> Iterator[Finding]:
    """Yield the finding that no wheel turns in any run, or in runs whose poses move.

    `radius` is that of the wheels [m].
    """
    turned = np.array([np.ptp(log.wheel_angle, axis=0).max(initial=0.0) for log in runs.logs])
    still = (turned < STILL_RAD) & (radius * turned < MOVED_M)
    moved = np.zeros(len(runs))
    for run in np.flatnonzero(still).tolist():
        place = runs.pose[runs.rows(run), :2]
        place = place[np.isfinite(place).all(axis=1)]
        moved[run] = np.hypot(*np.ptp(place, axis=0)) if len(place) else 0.0
    every = bool(still.all())
    if not every:
        still &= moved > LEAST_PATH_M
    if not still.any():
        return
    names = () if every else tuple(runs.logs[k].name for k in np.flatnonzero(still))
    most = float(moved[still].max())
    poses = f", although the poses move by up to {most:.2g} m" if most > MOVED_M else ""
    where = "these runs" if every else f"{len(names)} of {len(runs)} runs"
    channel = runs.logs[0].wheel_reading.channel or "of the wheels"
    yield Finding(
        "no_motion",
        f"no wheel turns in {where}{poses}",
        f"check that the channel {channel} names the columns of the encoders and that these count, "
        + ("or log runs in which the robot drives" if every else "or exclude these runs"),
        runs=names,
    )


def _all(runs: Runs, geometry: Geometry, mass_kg: float | None) -> Iterator[Finding]:
    """Yield all findings but `wheel_columns`, in no particular order."""
    data = joined(runs)
    at = edges(data)
    found = _compared(data, at, geometry, pose_lag(runs))
    if found is None:
        yield _not_checked(
            f"the runs are too short: {len(at.run)} steps, {FEWEST_STEPS} are needed"
        )
        return
    yield from found.findings
    scales, speed_is_angle = ratios(data, at, found.moved, found.evidence, found.meant)
    if not found.poses:
        scales = {k: r for k, r in scales.items() if k not in ("travel", "turning", "gyro")}
    radius, gear_ratio = float(geometry.wheel_radius), float(geometry.gear_ratio)
    reading, ticks = data.reading, ticks_per_radian(scales)
    if reading.whole and (ticks is not None or not scales.keys() - {"report", "gyro"}):
        yield ticks_finding(ticks, scales, reading)
        scales = without_factor(scales, QUANTITIES["wheel_turns"].powers, ticks or 1.0)
    row = float(np.median(data.row))
    causes = single_causes(scales, speed_is_angle, row, gear_ratio, reading)
    factors = cause_findings(*causes, scales, gear_ratio, reading)
    factors = factors or tuple(_of_time(data, found.moved, at, radius))
    yield from factors
    yield from electric(data, found.meant, radius, mass_kg, not factors)
    yield from exchanged(data)
    yield from _suspicious(scales)
    yield from _notes(data, found.evidence, found.meant)


def _compared(
    data: JoinedRuns, at: StepEdges, geometry: Geometry, lag: PoseLag | None
) -> _Compared | None:
    """Return the comparison of poses with wheels, or None if there are too few steps."""
    lag = lag if lag is not None and lag.decisive else PoseLag(0.0, 1.0, 1.0)
    moved = increments(data, at, lag.seconds)
    if usable(moved.wheels).sum() < FEWEST_STEPS:
        return None
    evidence = gather(geometry, at, moved)
    if not evidence.pose:
        note = _not_checked(
            "the poses have positions alone, headings alone or the ends of runs alone: order, "
            "signs and sizes of the wheels are not compared with them"
        )
        return _Compared((*_of_lag(lag), note), moved, evidence)
    declared = agreement(data, at, moved, evidence, Interpretation())
    if declared.still.all():
        return _Compared(tuple(single_runs(data, declared)), moved, evidence)
    meant, found = mistakes(evidence)
    agreeing = agreement(data, at, moved, evidence, meant)
    fixed = agreeing.heading_fixed
    if fixed.any() and fixed.mean() >= SHARE_IF_ALL:  # without it, order and axes cannot be judged
        return _Compared((_heading_constant(data, agreeing),), moved, evidence)
    left = misfits(evidence, meant)["pose"]
    if left > UNEXPLAINED_IF_FOREIGN:
        return _Compared((_foreign(left),), moved, evidence)
    # Findings about single runs are omitted if the logged heading is sin(heading / 2): it does not
    # determine the heading beyond half a turn, so that correct runs may seem to disagree.
    half_sine = meant.convention.heading == "half_sine"
    alone = () if half_sine else tuple(single_runs(data, agreeing))
    swapped = None if found else exchanged_wheels(data.names, at, moved, evidence, geometry)
    if swapped is not None:
        others = replace(agreeing, judged=agreeing.judged & ~swapped[1])
        alone = (swapped[0], *single_runs(data, others))
    listed = (*_of_lag(lag), *map(mistake_finding, found), *alone)
    return _Compared(listed, moved, evidence, meant, True)


def _of_lag(lag: PoseLag) -> Iterator[Finding]:
    """Yield the finding that the poses are much later or earlier than the encoders, if they are."""
    if abs(lag.seconds) < LATE_S:
        return
    late = "after" if lag.seconds > 0 else "before"
    yield Finding(
        "lag",
        f"the poses come {abs(lag.seconds):.1f} s {late} the encoders: with this lag "
        f"{lag.unexplained:.2f} of the motion is unexplained, without it "
        f"{lag.unexplained_at_zero:.2f}",
        f"shift the poses' times by {-lag.seconds:+.1f} s, or start 'camera.lag' in [parameters] "
        f"at {lag.seconds:.1f}",
        "wrong" if abs(lag.seconds) > TOO_LATE_S else "suspicious",
    )


def _foreign(left: float) -> Finding:
    """Return the finding that poses and wheels do not belong together.

    `left` is the fraction of the poses' motion that stays unexplained [1].
    """
    return Finding(
        "pose_unexplained",
        "the poses do not follow the wheels: for every order, sign and axis tried, at least "
        f"{left:.2f} of their motion is unexplained",
        "check that poses and encoders come from the same runs and times, and that the wheels "
        "were on the ground",
    )


def _of_time(
    data: JoinedRuns, moved: ChannelIncrements, at: StepEdges, radius: float
) -> Iterator[Finding]:
    """Yield the finding that time is in another unit than declared.

    The evidence is an implausible rim speed and time between rows, because the ratios of channels
    may not show a wrong unit of time.
    """
    row = float(np.median(data.row))
    speed = np.abs(moved.wheels) / (at.after - at.before)[:, None] * radius
    top = float(np.nanquantile(speed, 0.95))
    slow = row > SLOW_ROW_S and top < SLOW_M_S
    if slow or (row < FAST_ROW_S and top > FAST_M_S):
        yield Finding(
            "time_unit",
            f"rows are {row:.3g} s apart and wheels reach {top:.2g} m/s, which is implausible",
            f"set unit = '{'ms' if slow else 's'}' for the channel time",
        )


def _suspicious(scales: Mapping[str, ScaleRatio]) -> Iterator[Finding]:
    """Yield the finding that the wheels travel much further than the body, if no command is known.

    A logged command would tell whether the wheels or the poses are wrong.
    """
    travel = scales.get("travel")
    if travel is None or "drive" in scales or "command" in scales:
        return
    if travel.natural and travel.value < SHORT_TRAVEL:
        yield Finding(
            "travel",
            f"the path of the body is {travel.value:.2f} times as long as that of the wheels, and "
            "no command is logged that could confirm the wheels",
            "check wheel_radius_m, gear_ratio, ticks_per_revolution and the unit of the poses, "
            "unless the wheels really slip that much",
            "suspicious",
        )


def _notes(data: JoinedRuns, evidence: Evidence, meant: Interpretation) -> Iterator[Finding]:
    """Yield notes about what could not be checked."""
    pose = next(iter(evidence.pose.values()), None)
    if pose is not None:
        share = pose.predicted(to_body(evidence, meant))
        share = share / max(float(share.sum()), 1e-300)
        if share[2] < LEAST_TURNING:
            yield _not_checked(
                "no run turns: base radius, unit of the heading and gyro are unchecked"
            )
        if share[0] < LEAST_TRANSLATION:
            yield _not_checked("no run drives ahead: order and signs are only partly checked")
        if evidence.free and share[1] < LEAST_TRANSLATION:
            yield _not_checked("no run drives sideways: order and signs are only partly checked")
    if evidence.twist is None and evidence.command is None:
        yield _not_checked(
            "no command is logged, so logged wheel rotations that are too large cannot be "
            "distinguished from slip"
        )
    if "current" in data.channels and not data.current_is_signed:
        yield _not_checked("currents are magnitudes: their signs cannot be checked")
    gyro = data.channels.get("gyro")
    if gyro is not None and not np.nanmax(np.abs(np.diff(gyro.value, axis=0))) > 0:
        yield _not_checked("the gyro channel is constant and cannot be checked")


def _not_checked(what: str) -> Finding:
    """Return the note that something was not checked."""
    return Finding("not_checked", what, None, "note")


LEAST_ROWS = 20
"""Runs with fewer rows are not judged."""
ODD_DISAGREEMENT, ODD_RATIO, USUAL_COSINE = 0.3, 10.0, 0.9
"""A run has poses of another run if its disagreement, 1 - cosine, exceeds both `ODD_DISAGREEMENT`
and `ODD_RATIO` times that of the median run. No run is judged if the median run's cosine is below
`USUAL_COSINE`."""
LONGEST_RATIO = 4.0
"""Multiple of the median length of the body increments to which longer increments are
shortened [1]."""
SHARE_IF_ALL = 0.5
"""If at least this fraction of the runs has constant poses, the finding is about all runs [1]."""


@dataclass(frozen=True, eq=False)
class RunAgreement:
    """Agreement of poses with wheels in each run.

    Path lengths include rotation, as an arc at the base radius.

    Attributes:
        wheels_m: path length of the body predicted from the wheels (run,) [m].
        poses_m: path length of the poses (run,) [m].
        cosine: normalised scalar product of the body increments from the poses and from the wheels
            (run,) [1].
        judged: True if the run has enough rows, and its wheels travel far enough, to be judged
            (run,).
        wheels_rad: range of the heading predicted from the wheels (run,) [rad].
        poses_rad: range of the heading of the poses (run,) [rad].
    """

    wheels_m: Float[np.ndarray, " run"]
    poses_m: Float[np.ndarray, " run"]
    cosine: Float[np.ndarray, " run"]
    judged: Bool[np.ndarray, " run"]
    wheels_rad: Float[np.ndarray, " run"]
    poses_rad: Float[np.ndarray, " run"]

    @property
    def still(self) -> Bool[np.ndarray, " run"]:
        """Return, for each run, whether its poses are constant although its wheels turn."""
        return self.judged & (self.poses_m < ROUNDING_M)

    @property
    def heading_fixed(self) -> Bool[np.ndarray, " run"]:
        """Return, for each run, whether its heading is constant although its wheels turn it."""
        turns = self.judged & ~self.still & (self.wheels_rad > LEAST_TURN_RAD)
        return turns & (self.poses_rad < ROUNDING_RAD)


def agreement(
    data: JoinedRuns,
    at: StepEdges,
    moved: ChannelIncrements,
    evidence: Evidence,
    meant: Interpretation,
) -> RunAgreement:
    """Return the agreement of poses with wheels in every run, under an interpretation."""
    convention = meant.convention
    # Not shifted by the lag of the poses, which a constant heading does not show.
    turned = increments(data, at, 0.0).wheels @ to_body(evidence, meant)[2] / evidence.base
    wheels_rad, poses_rad = (
        np.array([_range(of[at.run == k]) for k in range(len(data.names))])
        for of in (turned, at.pose_after[:, 2] - at.pose_before[:, 2])
    )
    body = body_motion(at, convention.bare) * [1.0, 1.0, evidence.base]
    body = body @ rotation(-convention.offset).T
    predicted = moved.wheels @ to_body(evidence, meant).T
    known = usable(body, predicted)
    body, predicted, run = body[known], predicted[known], at.run[known]
    length = np.linalg.norm(body, axis=1)
    most = LONGEST_RATIO * float(np.median(length[length > 0])) if (length > 0).any() else 1.0
    body = body * np.minimum(1.0, most / np.maximum(length, 1e-300))[:, None]
    # The prediction is scaled along each axis, because slip shortens the motion by a different
    # factor along each.
    squares = (predicted**2).sum(axis=0)
    factor = (predicted * body).sum(axis=0) / np.where(squares > 0, squares, 1.0)
    scaled = predicted * np.where(factor > 0, factor, 0.0)

    def total(values: np.ndarray) -> np.ndarray:
        return np.bincount(run, values, minlength=len(data.names))

    size = np.sqrt(total((body**2).sum(axis=1)) * total((scaled**2).sum(axis=1)))
    both = total((body * scaled).sum(axis=1))
    wheels_m = total(np.linalg.norm(predicted, axis=1))
    rows = (data.end - data.begin) / data.row
    return RunAgreement(
        wheels_m,
        total(np.linalg.norm(body, axis=1)),
        np.where(size > 0, both / np.where(size > 0, size, 1.0), 0.0),
        (rows >= LEAST_ROWS) & (wheels_m > LEAST_PATH_M),
        wheels_rad,
        poses_rad,
    )


def _range(increments: Float[np.ndarray, " step"]) -> float:
    """Return the range of the sum of increments, 0 if there are none."""
    return float(np.ptp(np.nancumsum(increments))) if len(increments) else 0.0


def _heading_constant(data: JoinedRuns, compared: RunAgreement) -> Finding:
    """Return the finding about the runs whose heading is constant although they turn."""
    fixed = compared.heading_fixed
    turned = float(np.median(compared.wheels_rad[fixed]))
    return heading_constant(turned, _names(data, fixed), len(fixed))


def single_runs(data: JoinedRuns, compared: RunAgreement) -> Iterator[Finding]:
    """Yield findings about runs with constant poses, and about runs with poses of another run."""
    still = compared.still
    if still.any():
        every = bool(still.mean() >= SHARE_IF_ALL)
        yield Finding(
            "pose_constant",
            f"the poses do not change in {still.sum()} of {len(still)} runs while the wheels "
            f"travel {np.median(compared.wheels_m[still]):.2g} m",
            "check the columns of pose_x, pose_y and pose_heading, and the marker's visibility"
            if every
            else "exclude these runs from the globs of [[logs]]",
            runs=() if every else _names(data, still),
        )
    fixed = compared.heading_fixed
    if fixed.any():
        yield _heading_constant(data, compared)
    # Runs in which the robot slips in place disagree for a good reason, and are not judged.
    moves = compared.judged & ~still & ~fixed
    if moves.any():
        share = compared.poses_m / np.maximum(compared.wheels_m, 1e-300)
        moves &= share > 0.25 * np.median(share[moves])
    if moves.sum() < 2 or (usual := float(np.median(compared.cosine[moves]))) < USUAL_COSINE:
        return
    odd = moves & (1 - compared.cosine > max(ODD_DISAGREEMENT, ODD_RATIO * (1 - usual)))
    if odd.any():
        yield Finding(
            "pose_of_another_run",
            f"the poses of {odd.sum()} of {len(odd)} runs do not follow their wheels "
            f"(agreement {np.median(compared.cosine[odd]):.2f}, in the other runs "
            f"{np.median(compared.cosine[moves & ~odd]):.2f})",
            "check whether these files contain poses of another run or of another time, or have x "
            "and y or two wheels exchanged; if so, exclude them from the globs of [[logs]]",
            runs=_names(data, odd),
        )


def _names(data: JoinedRuns, which: Bool[np.ndarray, " run"]) -> tuple[str, ...]:
    return tuple(data.names[k] for k in np.flatnonzero(which))
