"""Channels of all runs on one time axis, and their increments over common time steps.

The module also defines the conventions that logged poses may follow, with the body increments under
each, and the sums of products of increments by which interpretations are compared.

A robust linear regression of the body increments on the wheels' turns gives steps with outliers a
low weight:

    body = K turn,    weight = (1 + (|residual| / s)^2)^-2,    s = 2 median |residual|

The regression works for any interpretation, since the fitted matrix K absorbs order, signs, radius,
azimuths and heading offset.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from jaxtyping import Bool, Float, Int

from slipid.data.log import Log, WheelReading
from slipid.data.runs import Runs
from slipid.data.wheel_signals import body_increments, integral, interpolate
from slipid.model.geometry import Geometry

STEP_S = 0.4
"""Duration of a step [s]: long enough that jitter and rounding matter little, and short compared
with the duration of a turn of the robot."""
INTEGRATED = ("wheel_speed", "wheel_speed_command", "twist_command", "gyro")
"""Channels of rates, which are compared by their integrals."""
MOST_STEPS = 20_000
"""Largest number of steps; if there would be more, for example because time is in a wrong unit,
steps are made longer."""


@dataclass(frozen=True, eq=False)
class JoinedChannel:
    """One channel of all runs, on the time axis of `JoinedRuns`.

    Attributes:
        time: times of the rows, increasing [s].
        value: values, one column per wheel or axis; nan in runs without the channel.
    """

    time: Float[np.ndarray, " row"]
    value: Float[np.ndarray, "row column"]

    def at(self, when: Float[np.ndarray, " at"]) -> Float[np.ndarray, "at column"]:
        """Return the values at other times on the common time axis [s], interpolated linearly."""
        return interpolate(self.time, self.value, when)


@dataclass(frozen=True, eq=False)
class JoinedRuns:
    """Channels of all runs, one run after another on a common time axis, with pauses in between.

    Attributes:
        names: names of the runs.
        begin: time at which each run begins (run,) [s].
        end: time at which each run ends (run,) [s].
        row: median time between rows of each run (run,) [s].
        angle: angle of each wheel [rad].
        pose: x [m], y [m], heading [rad] in the rows with a new pose, and in the first and last row
            of each run; nan in coordinates that were not measured.
        channels: channels that some run has, keyed by the name of their attribute in `Log`:
            integrals [rad, m] of the rates in `INTEGRATED`, and values of currents [A] and voltages
            [V].
        current_is_signed: False if some run has only magnitudes of currents.
        current_is_torque: True if the values of currents are torques [N m].
        reading: what the angles were computed from; `whole` holds for all runs.
    """

    names: tuple[str, ...]
    begin: Float[np.ndarray, " run"]
    end: Float[np.ndarray, " run"]
    row: Float[np.ndarray, " run"]
    angle: JoinedChannel
    pose: JoinedChannel
    channels: Mapping[str, JoinedChannel]
    current_is_signed: bool
    current_is_torque: bool
    reading: WheelReading

    @property
    def wheels(self) -> int:
        """Return the number of wheels."""
        return self.angle.value.shape[1]

    def runs_of(self, when: Float[np.ndarray, " at"]) -> Int[np.ndarray, " at"]:
        """Return the index of the run at each time on the common time axis [s]."""
        return np.searchsorted(self.begin, when + 1e-9, side="right") - 1


@dataclass(frozen=True, eq=False)
class StepEdges:
    """Time steps over which motion is compared, with the poses at their begin and end.

    Attributes:
        before: begin of each step on the time axis of `JoinedRuns` (step,) [s].
        after: end of each step (step,) [s].
        run: index of the run of each step (step,).
        pose_before: pose at the begin, as logged (step, 3).
        pose_after: pose at the end, as logged (step, 3).
    """

    before: Float[np.ndarray, " step"]
    after: Float[np.ndarray, " step"]
    run: Int[np.ndarray, " step"]
    pose_before: Float[np.ndarray, "step 3"]
    pose_after: Float[np.ndarray, "step 3"]


@dataclass(frozen=True, eq=False)
class ChannelIncrements:
    """Increments of the robot's channels (all but the poses) over steps shifted by the poses' lag.

    Attributes:
        wheels: rotation of each wheel [rad]; nan if it was not logged for the whole step.
        commanded: commanded rotation of each wheel [rad], or None.
        twist: commanded increment of the body in its axes [m, m, rad], or None.
        gyro: rotation measured by the gyro [rad], or None.
    """

    wheels: Float[np.ndarray, "step wheel"]
    commanded: Float[np.ndarray, "step wheel"] | None
    twist: Float[np.ndarray, "step 3"] | None
    gyro: Float[np.ndarray, "step 1"] | None


def joined(data: Runs) -> JoinedRuns:
    """Return the channels of all runs on a common time axis, with a pause of 1 s between runs."""
    first = np.array([log.time[0] for log in data.logs])
    length = np.array([log.duration for log in data.logs])
    starts = np.concatenate([[0.0], np.cumsum(length + 1.0)])[:-1]
    time = data.time + np.repeat(starts - first, np.diff(data.offset))
    # The first and last row of a run count as new poses, so that no pose is interpolated between
    # two runs.
    fresh = data.fresh | np.isnan(data.pose).all(axis=1)  # no pose may be assumed between such rows
    fresh[data.offset[:-1]] = fresh[data.offset[1:] - 1] = True

    channels = {}
    for name in (*INTEGRATED, "current", "voltage", "bus_voltage"):
        logged = [values for log in data.logs if (values := getattr(log, name)) is not None]
        if logged:
            columns = logged[0].size // len(logged[0])
            parts = [_rows(log, name, columns) for log in data.logs]
            channels[name] = JoinedChannel(time, np.concatenate(parts))
    return JoinedRuns(
        names=tuple(log.name for log in data.logs),
        begin=starts,
        end=starts + length,
        row=np.array([float(np.median(np.diff(log.time))) for log in data.logs]),
        angle=JoinedChannel(time, data.wheel_angle),
        pose=JoinedChannel(time[fresh], data.pose[fresh]),
        channels=channels,
        current_is_signed=data.current_is_signed,
        current_is_torque=data.current_is_torque,
        reading=replace(
            data.logs[0].wheel_reading, whole=all(log.wheel_reading.whole for log in data.logs)
        ),
    )


def _rows(log: Log, name: str, columns: int) -> Float[np.ndarray, "row column"]:
    """Return a channel of a run, or the integral of a rate; nan if the run lacks the channel."""
    values = getattr(log, name)
    if values is None:
        return np.full((log.samples, columns), np.nan)
    rows = values.reshape(log.samples, columns)
    return integral(log.time, rows) if name in INTEGRATED else np.asarray(rows)


def edges(data: JoinedRuns) -> StepEdges:
    """Return the edges of steps of about `STEP_S`, of equal duration within each run.

    Steps are shorter in short runs, so that a median run has eight, but never shorter than a row.
    """
    length = data.end - data.begin
    step = max(min(STEP_S, float(np.median(length)) / 8), float(np.median(data.row)))
    step = max(step, float(length.sum()) / MOST_STEPS)
    count = np.maximum(np.round(length / step).astype(int), 1)
    run = np.repeat(np.arange(len(count)), count)
    within = np.arange(len(run)) - np.repeat(np.cumsum(count) - count, count)
    each = (length / count)[run]
    before = data.begin[run] + within * each
    after = before + each
    return StepEdges(before, after, run, data.pose.at(before), data.pose.at(after))


def increments(data: JoinedRuns, at: StepEdges, lag: float) -> ChannelIncrements:
    """Return the increments of the robot's channels over the steps, moved to earlier by `lag` [s].

    `lag` is the lag of the poses behind the robot's sensors. Increments are nan where a moved step
    leaves its run.
    """
    slack, before, after = data.row[at.run], at.before - lag, at.after - lag
    outside = (before < data.begin[at.run] - slack) | (after > data.end[at.run] + slack)

    def moved(channel: JoinedChannel) -> np.ndarray:
        change = channel.at(after) - channel.at(before)
        change[outside] = np.nan
        return change

    optional = map(data.channels.get, ("wheel_speed_command", "twist_command", "gyro"))
    return ChannelIncrements(
        moved(data.angle), *(None if channel is None else moved(channel) for channel in optional)
    )


Heading = Literal["as_logged", "turned_round", "degrees", "radians", "half_sine"]
"""Meaning of a logged heading, in the order of the names: the heading [rad]; its negative; degrees
that were read as radians; radians that were read as degrees; sin(heading / 2), the z of a
quaternion."""


@dataclass(frozen=True)
class PoseConvention:
    """Convention that the logged poses follow, relative to the declared one.

    Attributes:
        heading: meaning of the logged heading.
        y_down: True if the logged y axis points to the right of x, not to the left.
        offset: whole degrees to add to the heading [deg].
    """

    heading: Heading = "as_logged"
    y_down: bool = False
    offset: int = 0

    @property
    def bare(self) -> "PoseConvention":
        """The same convention with an offset of 0."""
        return replace(self, offset=0)


CONVENTIONS = tuple(
    PoseConvention(heading, down) for heading in get_args(Heading) for down in (False, True)
)
"""All conventions without offset; an offset only rotates the body increments."""


def rotation(degrees: int) -> Float[np.ndarray, "3 3"]:
    """Return the matrix that rotates a body increment about the vertical by an angle [deg]."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def body_motion(at: StepEdges, convention: PoseConvention) -> Float[np.ndarray, "step 3"]:
    """Return increments ahead [m], left [m] and of the heading [rad], under a pose convention.

    The offset of the convention is not applied. Increments are nan where the logged heading is
    impossible under the convention.
    """
    flip = [1.0, -1.0 if convention.y_down else 1.0, 1.0]
    before, after = at.pose_before * flip, at.pose_after * flip
    before[:, 2] = _heading(before[:, 2], convention.heading)
    turned = _heading(after[:, 2], convention.heading) - before[:, 2]
    # When the log was read, the wrap-around of the heading was removed as if the declared unit were
    # right. Under these two conventions the true heading wraps at other values, so the turn of each
    # step is wrapped into the range from -pi to pi.
    if convention.heading in ("radians", "half_sine"):
        turned = np.mod(turned + np.pi, 2 * np.pi) - np.pi
    after[:, 2] = before[:, 2] + turned
    return body_increments(before, after)


def aligned(
    body: Float[np.ndarray, "step 3"], wheels: Float[np.ndarray, "step wheel"], geometry: Geometry
) -> Float[np.ndarray, "step 3"]:
    """Return increments of the body without the rotation of the pose sensor on an omni robot.

    The rotation, which a calibration finds later, turns the translation computed from the wheels
    into that of the poses, on average over all steps. On robots that do not go sideways nothing is
    changed, since a place of the sensor off the centre has the same effect as a rotation.

    Args:
        body: increments ahead [m], left [m] and of the heading [rad].
        wheels: rotation of each wheel [rad].
        geometry: declared geometry of the robot.
    """
    if not geometry.determines_twist:
        return body
    twist = float(geometry.wheel_radius) * wheels @ np.asarray(geometry.pseudo_inverse()).T
    there, meant = (x[:, 0] + 1j * x[:, 1] for x in (body, twist))
    angle = np.angle(np.nansum(there * meant.conj()))
    turned = there * np.exp(-1j * angle)
    return np.column_stack([turned.real, turned.imag, body[:, 2]])


def _heading(logged: Float[np.ndarray, " step"], meaning: Heading) -> Float[np.ndarray, " step"]:
    """Return the true heading [rad] for logged values with a given meaning."""
    if meaning == "half_sine":
        # A magnitude above 1, apart from rounding, cannot be a sine: its heading is nan.
        return 2 * np.arcsin(np.where(np.abs(logged) <= 1.0 + 1e-3, logged.clip(-1, 1), np.nan))
    factor = {"turned_round": -1.0, "degrees": np.pi / 180, "radians": 180 / np.pi}
    return factor.get(meaning, 1.0) * logged


REWEIGHTINGS = 8
"""Number of iterations of the reweighted regression."""
RELATIVE_RIDGE = 1e-4
"""Ridge of the regression, relative to the mean squared turn [1]; it is needed because the wheels
on one side of a robot may turn by equal angles."""


@dataclass(frozen=True, eq=False)
class Products:
    """Weighted sums over steps of products of the wheels' turns and the body increments.

    The heading increment is an arc in metres at the base radius.

    Attributes:
        turns: products of turns with turns (wheel, wheel) [rad^2].
        across: products of turns with body increments (wheel, 3) [rad m].
        body: products of body increments with each other (3, 3) [m^2].
        known: for every step, True if its turns and its body increment are finite (every,).
        weight: weight of each step that is known (step,).
    """

    turns: Float[np.ndarray, "wheel wheel"]
    across: Float[np.ndarray, "wheel 3"]
    body: Float[np.ndarray, "3 3"]
    known: Bool[np.ndarray, " every"]
    weight: Float[np.ndarray, " step"]

    def predicted(self, predict: Float[np.ndarray, "3 wheel"]) -> Float[np.ndarray, "3"]:
        """Return the sum of squared predicted body increments along each axis [m^2].

        `predict` is the matrix from turns to body increments.
        """
        return np.einsum("aw,wv,av->a", predict, self.turns, predict)

    def matched(
        self, predict: Float[np.ndarray, "3 wheel"], axes: Float[np.ndarray, "3 3"]
    ) -> Float[np.ndarray, "3"]:
        """Return the sum of predicted times measured body increments along each axis [m^2].

        `predict` is the matrix from turns to body increments; `axes` maps the axes of the measured
        increments to the true ones.
        """
        return np.einsum("aw,wa->a", predict, self.across @ axes.T)


def usable(*parts: Float[np.ndarray, "step _"]) -> Bool[np.ndarray, " step"]:
    """Return, for each step, whether all given arrays are finite."""
    return np.all([np.isfinite(part).all(axis=1) for part in parts], axis=0)


def products(
    turns: Float[np.ndarray, "step wheel"],
    body: Float[np.ndarray, "step 3"],
    base: float,
    rounds: int = REWEIGHTINGS,
) -> Products | None:
    """Return the weighted sums of products over the known steps.

    The result is None if there are fewer known steps than twice the number of wheels.

    Args:
        turns: rotation of each wheel [rad].
        body: body increments ahead [m], left [m] and of the heading [rad].
        base: base radius [m], the factor that converts heading increments to arcs.
        rounds: iterations of the reweighted regression; 0 for commands, which have no outliers.
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
    squares = (body * weight[:, None]).T @ body
    return Products(weighted.T @ turns, weighted.T @ body, squares, known, weight)


def _linear(turns: np.ndarray, body: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return the matrix (wheel, 3) from turns to body increments, by weighted ridge regression."""
    weighted = turns * weight[:, None]
    gram = weighted.T @ turns
    ridge = RELATIVE_RIDGE * np.trace(gram) / len(gram) + 1e-300
    return np.asarray(np.linalg.solve(gram + ridge * np.eye(len(gram)), weighted.T @ body))
