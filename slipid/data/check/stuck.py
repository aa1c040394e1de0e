"""Search for encoders and positions that stay constant although the robot moves.

Encoders are also searched for a constant beginning or end of a run, positions for whole runs.

A wheel may rightly stand still while others turn: a robot turns about it, or an omni robot drives
along its axle. Its encoder is stuck only if the poses move the rim r of the wheel,

    r = d . (dx, dy) + c turn

where d is the drive direction of the wheel. The factor c is its lever in the config, changed by up
to `LEVER_BASES` base radii such that r is as small as possible, since neither the place of the pose
sensor nor the effective track are known before a calibration; nor is the rotation of the sensor,
which is removed on robots that go sideways. A wheel that is commanded to turn is judged with lever
and poses as they are, and one that is commanded to stand still is not judged.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from jaxtyping import Bool, Float, Int

from slipid.data.check.findings import (
    LEAST_PATH_M,
    ROUNDING_M,
    ROUNDING_RAD,
    Finding,
    Severity,
    wrong,
)
from slipid.data.check.joined import (
    ChannelIncrements,
    PoseConvention,
    StepEdges,
    aligned,
    body_motion,
    edges,
    increments,
    joined,
)
from slipid.data.runs import Runs
from slipid.model.geometry import Geometry
from slipid.support.errors import DataError

STILL_SHARE = 0.01
"""A wheel stands still in a run if the range of its angle is below this share of the largest range
of a wheel, which allows for an encoder that flickers by a tick [1]."""
EXPECTED_SHARE = {True: 0.4, False: 0.5}
"""An encoder is stuck if the poses move the rim of its wheel by more than this share of the travel
of the wheel that turns most [1], for robots whose wheels determine the twist and for others. A
wheel on whose axle an omni robot drives has a share of up to 0.08 in real runs. One side of a
skid-steer robot that turns about it slips by up to 0.42 on real grass."""
CONFIRMED_SHARE = 0.15
"""The same share for a wheel that is commanded to turn [1]."""
COMMANDED_SHARES = 0.1, 0.2
"""A wheel is commanded to stand still if it is to turn by less than the first share of the wheel
that is to turn most, and commanded to turn above the second one [1]."""
LEVER_BASES = {True: 1.0, False: 2.0}
"""Largest change of the lever of a wheel, in base radii: one for a pose sensor at the edge of the
robot, and one for robots whose wheels do not determine the twist, because of their effective track,
which is up to twice the track [1]."""
TURNING_SHARE = 0.5
"""A wheel that turns by more than this share of the travel of the wheel that turns most, although
the robot does not move its rim, may be exchanged with one that stands still [1]."""
SETTLING_S = 1.0
"""Time between the last change of an encoder and the part of the run that is judged, since poses
may be late [s]."""
TRANSLATION_SHARE = 0.5
"""Least translation computed from the wheels over their rotation, as an arc at the base radius, for
a judgement of constant positions; in a turn on the spot unequal wheels cause less [1]."""


@dataclass(frozen=True, eq=False)
class _Motion:
    """Motion of wheels and body in the steps of all runs.

    Attributes:
        at: the steps.
        moved: increments of the channels over the steps.
        rim: travel of the rim of each wheel, 0 where it is not known [m].
        bodies: motion of the body by the poses, and the same without a rotation of their sensor.
        geometry: geometry of the robot.
    """

    at: StepEdges
    moved: ChannelIncrements
    rim: Float[np.ndarray, "step wheel"]
    bodies: Float[np.ndarray, "2 step 3"]
    geometry: Geometry

    @classmethod
    def of(cls, runs: Runs, geometry: Geometry) -> Self:
        """Return the motion in runs."""
        data = joined(runs)
        at = edges(data)
        moved = increments(data, at, 0.0)
        rim = float(geometry.wheel_radius) * np.nan_to_num(moved.wheels)
        body = body_motion(at, PoseConvention())
        if moved.twist is not None:  # instead of poses that are not whole
            body = np.where(np.isfinite(body).all(axis=1)[:, None], body, moved.twist)
        bodies = np.stack([body, aligned(body, moved.wheels, geometry)])
        return cls(at, moved, rim, bodies, geometry)

    def span(self, steps: Int[np.ndarray, " step"]) -> Float[np.ndarray, " wheel"]:
        """Return the range of the travel of each wheel in some steps [m]."""
        return np.ptp(np.cumsum(self.rim[steps], axis=0), axis=0)

    def expected(
        self, steps: Int[np.ndarray, " step"], net: bool = False
    ) -> Float[np.ndarray, " wheel"]:
        """Return by how far the body moves the rim of each wheel in some steps, see `_expected`.

        If `net`, as for parts of a run, a command to a wheel of a robot whose wheels do not
        determine the twist is not enough: grass stopped such a wheel, and the others turned on.
        """
        least = _least_share(self.moved, steps, self.geometry)
        if net and not self.geometry.determines_twist:
            least = np.maximum(least, EXPECTED_SHARE[False])
        return _expected(self.bodies[:, steps], self.rim[steps], least, self.geometry, net)

    def stopped(self, steps: Int[np.ndarray, " step"]) -> Float[np.ndarray, " wheel"]:
        """Return by how far the body moves the rims of wheels at the constant ends of their angles.

        Args:
            steps: steps of one run.

        Returns:
            The longer path of both ends of the run for each wheel; 0 where it may stand still [m].
        """
        out = np.zeros(self.rim.shape[1])
        for wheel in range(len(out)):
            changes = steps[np.abs(self.rim[steps, wheel]) > ROUNDING_M]
            if not len(changes):
                continue
            begins, ends = self.at.before[steps], self.at.after[steps]
            first, last = self.at.before[changes[0]], self.at.after[changes[-1]]
            for end in (steps[ends <= first - SETTLING_S], steps[begins >= last + SETTLING_S]):
                span = self.span(end) if len(end) else np.zeros(len(out))
                still = span < STILL_SHARE * span.max()
                together = still.sum() > 1 and _stand_together(still, self.geometry)
                if span.max() > LEAST_PATH_M and not together:
                    out[wheel] = max(out[wheel], np.nan_to_num(self.expected(end, net=True)[wheel]))
        return out


def stuck_channels(
    runs: Runs, geometry: Geometry
) -> tuple[tuple[Finding, ...], Bool[np.ndarray, " run"]]:
    """Return findings about stuck encoders and positions, and the runs that these make useless."""
    motion = _Motion.of(runs, geometry)
    parts = np.split(np.arange(len(motion.rim)), np.flatnonzero(np.diff(motion.at.run)) + 1)
    span = np.array([motion.span(part) for part in parts])
    most = span.max(axis=1, initial=0.0)
    still = (span < STILL_SHARE * most[:, None]) & (most > LEAST_PATH_M)[:, None]
    always = still[most > LEAST_PATH_M].all(axis=0) & still.any(axis=0)
    expected, turns = np.full(still.shape, np.nan), np.zeros(still.shape, bool)
    for run in np.flatnonzero(still.any(axis=1)).tolist():
        path = motion.expected(parts[run])
        if np.isnan(path).all() and not geometry.determines_twist:
            path = np.full(len(path), _beyond_circle(runs, run, geometry))
        if still[run].sum() > 1 and _stand_together(still[run], geometry):
            path = np.where(always, path, 0.0)
        expected[run] = np.where(still[run], path, np.nan)
        turns[run] = (path == 0) & (span[run] > TURNING_SHARE * most[run])
    stuck = _frozen(runs, geometry, [motion.rim[part] for part in parts])
    found = [_positions_constant(runs, stuck)] if stuck.any() else []
    stopped = np.array([motion.stopped(part) for part in parts])
    for wheel in range(still.shape[1]):
        which, path = still[:, wheel], expected[:, wheel]
        every = bool(always[wheel])
        if (path > 0).any():
            which = every | (which & (path > 0))
            others = np.flatnonzero(turns[which].any(axis=0)).tolist()
            found.append(_wheel_constant(runs, wheel, which, float(np.nanmax(path)), others))
            stuck |= which
        elif every and np.isnan(path).all():
            found.append(_never_turns(runs, wheel, float(most.max()), geometry))
            stuck |= found[-1].severity == "wrong"
        if (which := (stopped[:, wheel] > 0) & ~still[:, wheel]).any():
            found.append(_wheel_stops(runs, wheel, which, float(stopped[:, wheel].max())))
            stuck |= which
    return tuple(found), stuck


def refuse_stuck(runs: Runs, geometry: Geometry) -> None:
    """Raise `DataError` with all findings of `stuck_channels` that forbid a fit, if there are any.

    Functions that do not run the whole check call it.
    """
    if listed := "\n".join(f"logs not used: {f}" for f in wrong(stuck_channels(runs, geometry)[0])):
        raise DataError(listed)


def _expected(
    bodies: Float[np.ndarray, "2 step 3"],
    rim: Float[np.ndarray, "step wheel"],
    least: Float[np.ndarray, " wheel"],
    geometry: Geometry,
    net: bool = False,
) -> Float[np.ndarray, " wheel"]:
    """Return by how far the body moves the rim of each wheel in a run [m].

    The path is a sum over parts in which the wheel that turns most travels `LEAST_PATH_M`, since
    the noise of poses would add up over steps. It is 0 below the `least` share of that travel, and
    nan if the motion of the body is not known. The motion is that of the poses for wheels that are
    commanded to turn, and for others that without a rotation of the pose sensor. If `net`, parts in
    opposite directions cancel each other, as the noise of poses does.
    """
    known = np.isfinite(bodies[0]).all(axis=1)
    bodies, rim = bodies[:, known], rim[known]
    travel = np.abs(rim).sum(axis=0)
    if travel.max(initial=0.0) < LEAST_PATH_M:
        return np.full(rim.shape[1], np.nan)
    turned = np.cumsum(np.abs(rim[:, np.argmax(travel)]))
    _, part = np.unique(turned // LEAST_PATH_M, return_inverse=True)
    logged, straight = (
        np.array([np.bincount(part, column) for column in body.T]) for body in bodies
    )
    turn = logged[2]
    slack = LEVER_BASES[geometry.determines_twist] * float(geometry.base_radius)
    squares = max(float(turn @ turn), 1e-300)
    out = np.zeros(rim.shape[1])
    for wheel, (ahead, left, lever) in enumerate(np.asarray(geometry.forward())):
        confirmed = least[wheel] == CONFIRMED_SHARE
        x, y, _ = logged if confirmed else straight
        along = ahead * x + left * y
        if not confirmed:
            lever = np.clip(-(along @ turn) / squares, lever - slack, lever + slack)
        path = along + lever * turn
        out[wheel] = abs(path.sum()) if net else np.abs(path).sum()
    return np.where(out > least * travel.max(), out, 0.0)


def _least_share(
    moved: ChannelIncrements, steps: Int[np.ndarray, " step"], geometry: Geometry
) -> Float[np.ndarray, " wheel"]:
    """Return the share of travel above which each wheel must turn in some steps [1].

    It is infinite for a wheel that is commanded to stand still, since a slipping body may move it.
    """
    least = np.full(moved.wheels.shape[1], EXPECTED_SHARE[geometry.determines_twist])
    if moved.commanded is not None:
        commanded = float(geometry.wheel_radius) * moved.commanded[steps]
    elif moved.twist is not None:
        commanded = moved.twist[steps] @ np.asarray(geometry.forward()).T
    else:
        return least
    path = np.abs(np.nan_to_num(commanded)).sum(axis=0)
    if path.max() > LEAST_PATH_M:
        stands, turns = (path < share * path.max() for share in COMMANDED_SHARES)
        least[~turns], least[stands] = CONFIRMED_SHARE, np.inf
    return least


def _stand_together(still: Bool[np.ndarray, " wheel"], geometry: Geometry) -> bool:
    """Return whether a robot that goes sideways may rightly drive while some wheels stand still.

    All of them stand still in one direction of travel, as two of four mecanum wheels do.
    """
    across = np.asarray(geometry.forward())[still, :2]
    return geometry.determines_twist and int(np.linalg.matrix_rank(across, tol=1e-3)) < 2


def _beyond_circle(runs: Runs, run: int, geometry: Geometry) -> float:
    """Return the range of the positions in a run [m], nan if a robot that turns may stay in it.

    The pose sensor of a robot that turns about a wheel stays on a circle around this wheel.
    """
    place = runs.pose[runs.rows(run), :2]
    place = place[np.isfinite(place).all(axis=1)]
    extent = float(np.hypot(*np.ptp(place, axis=0))) if len(place) else 0.0
    circle = 2.0 * (1.0 + LEVER_BASES[False]) * float(geometry.base_radius)
    return extent if extent > np.sqrt(2) * circle else np.nan


def _frozen(
    runs: Runs, geometry: Geometry, rim: Sequence[Float[np.ndarray, "_ wheel"]]
) -> Bool[np.ndarray, " run"]:
    """Return, for each run, whether x and y are constant although its wheels drive the robot on.

    Runs with constant headings are left to the finding about whole poses that are constant.
    """
    to_body, base = np.asarray(geometry.pseudo_inverse()), float(geometry.base_radius)
    out = np.zeros(len(runs), bool)
    for run in range(len(runs)):
        pose = runs.pose[runs.rows(run)]
        pose = pose[np.isfinite(pose).all(axis=1)]
        if not len(pose):
            continue
        x, y, heading = np.ptp(pose, axis=0)
        dx, dy, turn = np.abs(rim[run] @ to_body.T).sum(axis=0)
        driven = max(dx, dy) > max(LEAST_PATH_M, TRANSLATION_SHARE * base * turn)
        out[run] = max(x, y) < ROUNDING_M and heading > ROUNDING_RAD and driven
    return out


def _positions_constant(runs: Runs, which: Bool[np.ndarray, " run"]) -> Finding:
    """Return the finding about the runs whose positions are constant."""
    return Finding(
        "position_constant",
        f"x and y of the poses never change in {which.sum()} of {len(which)} runs, although the "
        "wheels drive the robot on",
        "check the columns of pose_x and pose_y, and that the tracker did not freeze"
        if which.all()
        else "exclude these runs from the globs of [[logs]], since the tracker froze",
        runs=() if which.all() else _names(runs, which),
    )


def _wheel_constant(
    runs: Runs,
    wheel: int,
    which: Bool[np.ndarray, " run"],
    path: float,
    others: Sequence[int],
) -> Finding:
    """Return the finding about the runs in which an encoder is stuck.

    Args:
        runs: all runs.
        wheel: index of the wheel.
        which: whether each run is among those.
        path: longest path by which the body moves the rim of the wheel in one of them [m].
        others: wheels that turn in some of them, although the body does not move their rims.
    """
    exchanged = " or ".join(str(other + 1) for other in others)
    return Finding(
        "wheel_constant",
        f"{_wheel(runs, wheel)} never turns in {which.sum()} of {len(which)} runs, while other "
        f"wheels turn and the robot moves its rim by up to {path:.2g} m",
        "check its encoder and cable, whether the wheel was blocked, and the places and the order "
        "of the wheels in the config"
        + (f"; its column may be exchanged with that of wheel {exchanged}" if others else "")
        + ("" if which.all() else "; exclude these runs from the globs of [[logs]]"),
        runs=() if which.all() else _names(runs, which),
    )


def _wheel_stops(runs: Runs, wheel: int, which: Bool[np.ndarray, " run"], path: float) -> Finding:
    """Return the finding about the runs in a part of which an encoder is stuck.

    `path` is the longest path by which the body moves the rim of its wheel in such a part [m].
    """
    return Finding(
        "wheel_constant",
        f"{_wheel(runs, wheel)} does not count at the beginning or the end of {which.sum()} of "
        f"{len(which)} runs, while other wheels turn and the robot moves its rim by up to "
        f"{path:.2g} m",
        "check its encoder and cable, and whether the wheel was blocked; exclude these runs from "
        "the globs of [[logs]], or cut their files there",
        runs=_names(runs, which),
    )


def _never_turns(runs: Runs, wheel: int, most: float, geometry: Geometry) -> Finding:
    """Return the finding about a wheel that turns in no run, if no run has whole poses.

    An omni robot may have driven along its axle; on other robots a wheel that turns in no run is
    not determined at all. `most` is the longest travel of a wheel in a run [m].
    """
    severity: Severity = "suspicious" if geometry.determines_twist else "wrong"
    return Finding(
        "wheel_constant",
        f"{_wheel(runs, wheel)} turns in no run, while other wheels travel up to {most:.2g} m",
        "check its encoder and cable"
        + (", unless the robot drove along its axle alone" if severity == "suspicious" else ""),
        severity,
    )


def _wheel(runs: Runs, wheel: int) -> str:
    """Return the number of a wheel, from 1, and the name of its column if that is known."""
    columns = runs.logs[0].wheel_reading.columns
    return f"wheel {wheel + 1}" + (f" (column {columns[wheel]!r})" if wheel < len(columns) else "")


def _names(runs: Runs, which: Bool[np.ndarray, " run"]) -> tuple[str, ...]:
    return tuple(runs.logs[k].name for k in np.flatnonzero(which))
