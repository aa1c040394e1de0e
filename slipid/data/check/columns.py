"""Findings about the columns of wheel speeds, currents and voltages.

The columns of commanded or reported speeds may be in another order than those of the encoders; this
can be found from a single run. The channels of commanded and of reported speeds may be exchanged: a
command precedes the motion and is constant between its changes. If the two channels are exchanged,
the declared command lags the declared measured speed, and changes in more rows than it. The sign
and order of currents and voltages are found from the work of the motors; their units are found from
the currents, voltages and power that are plausible for a robot.
"""

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import linear_sum_assignment

from slipid.data.check.findings import Finding
from slipid.data.check.interpretation import Interpretation, columns
from slipid.data.check.joined import JoinedChannel, JoinedRuns
from slipid.data.log import Log
from slipid.data.wheel_signals import integral, interpolate, swapped_order
from slipid.support.errors import DataError

MADE_REDUNDANT_BY = ("wheel_sign", "wheel_order", "command_sign", "command_order")
"""Kinds of findings, found by comparison with the poses, that make a `wheel_columns` finding
redundant."""
CAUSED_BY_ORDER = ("wheel_scale", "wheel_speed_unit", "wheels_exchanged")
"""Kinds of findings that may only be consequences of a wrong order of columns. They are omitted if
there is a `wheel_columns` finding; once its remedy is applied, the next check reports them if they
are real."""
STEP_S = 0.5
"""Duration of the steps in which channels are compared with encoders [s]; delays and jitter are
small compared with it."""
SPEED_CHANNELS = ("wheel_speed_command", "wheel_speed")
"""Channels whose order of columns is compared with the encoders'."""
LONGEST_LAG_S = 1.0
"""Largest searched lag of either sign between command and measured speed [s]."""
MOST_SHIFTS = 50
"""Largest searched lag in rows; it limits the search if time is in a wrong unit."""
MOST_ROWS = 20_000
"""Largest number of rows in which command and measured speed are compared."""
LEAST_CORRELATION = 0.3
"""Least correlation between the changes of command and measured speed, at the best lag, for a
finding [1]."""
CHANGE_RATIO = 1.5
"""Least ratio, for a finding, of the number of rows in which the declared command changes to that
in which the declared measured speed changes [1]."""


def misordered(logs: Sequence[Log]) -> Iterator[Finding]:
    """Yield a finding for every speed channel whose columns match the encoders in another order.

    Runs in which a channel matches in the same order share one finding.
    """
    found: dict[tuple[str, tuple[int, ...]], list[str]] = {}
    for log in logs:
        for name, order in _orders(log):
            found.setdefault((name, order), []).append(log.name)
    for (name, order), names in found.items():
        listed = ", ".join(map(str, order))
        yield Finding(
            "wheel_columns",
            f"the columns of the wheels match those of {name} only in the order {listed} (a "
            "negative number is a column with the opposite sign)",
            f"list the columns of the wheels, or those of {name}, in this order, and set scale = "
            "-1 for columns with the opposite sign",
            runs=() if len(names) == len(logs) else tuple(names),
        )


def refuse_misordered(logs: Sequence[Log]) -> None:
    """Raise `DataError` with all findings of `misordered`, if there are any.

    Commands that do not run the whole check call it.
    """
    if listed := "\n".join(f"logs not used: {finding}" for finding in misordered(logs)):
        raise DataError(listed)


def _orders(log: Log) -> Iterator[tuple[str, tuple[int, ...]]]:
    """Yield the speed channels that match the encoders only in another order, with that order."""
    edges = np.linspace(log.time[0], log.time[-1], max(2, int(log.duration / STEP_S) + 1))
    measured: Float[np.ndarray, "step wheel"] | None = None
    for name in SPEED_CHANNELS:
        rate = getattr(log, name)
        if rate is None:
            continue
        if measured is None:
            measured = np.diff(interpolate(log.time, log.wheel_angle, edges), axis=0)
        turned = np.diff(interpolate(log.time, integral(log.time, rate), edges), axis=0)
        if order := swapped_order(measured, turned):
            yield name, order


def exchanged(data: JoinedRuns) -> Iterator[Finding]:
    """Yield the finding that commanded and measured wheel speeds are exchanged, if they are."""
    if not {"wheel_speed_command", "wheel_speed"} <= set(data.channels):
        return
    row = float(np.median(data.row))
    when = np.arange(data.begin[0], data.end[-1], row)[:MOST_ROWS]
    inside = when + row <= data.end[data.runs_of(when).clip(0)]
    command, speed = (
        _changes(data.channels[name], when, row, inside)
        for name in ("wheel_speed_command", "wheel_speed")
    )
    if not (command**2).sum() > 0 or not (speed**2).sum() > 0:
        return
    most = min(int(LONGEST_LAG_S / row), MOST_SHIFTS)
    shifts = np.arange(-most, most + 1)
    correlation = np.array([_correlation(command, speed, int(k)) for k in shifts])
    best = int(np.argmax(correlation))
    busy = [float((np.abs(x) > 1e-3 * np.abs(x).max()).mean()) for x in (command, speed)]
    if (
        correlation[best] > LEAST_CORRELATION
        and shifts[best] < 0
        and busy[0] > CHANGE_RATIO * busy[1]
    ):
        yield Finding(
            "command_exchanged",
            "the channel declared as the commanded wheel speed lags the measured one by "
            f"{-shifts[best] * row:.2g} s, and changes in {busy[0]:.0%} of the rows, the measured "
            f"one in {busy[1]:.0%}",
            "exchange the columns of wheel_speed_command and wheel_speed (or of "
            "motor_speed_command and motor_speed)",
        )


def _changes(
    channel: JoinedChannel,
    when: Float[np.ndarray, " at"],
    row: float,
    inside: Bool[np.ndarray, " at"],
) -> Float[np.ndarray, "change wheel"]:
    """Return the change of a wheel speed from row to row [rad/s], zero across the ends of runs.

    Args:
        channel: integral of the wheel speed [rad].
        when: times of the rows [s].
        row: time between rows [s].
        inside: for each row, True if the time from it to the next row lies within one run.
    """
    speed = (channel.at(when + row) - channel.at(when)) / row
    speed[~inside] = np.nan
    return np.nan_to_num(np.diff(speed, axis=0))


def _correlation(command: np.ndarray, speed: np.ndarray, shift: int) -> float:
    """Return the correlation between changes of the command and of the speed `shift` rows later.

    A negative `shift` compares the command with the speed in earlier rows.
    """
    n = len(command) - abs(shift)
    first, second = (command[:n], speed[-n:]) if shift >= 0 else (command[-n:], speed[:n])
    size = np.sqrt((first**2).sum() * (second**2).sum())
    return float((first * second).sum() / size) if size > 0 else 0.0


SHARE_IF_REVERSED = -0.25
"""Share of work (see `_share`) below which the sign of a current or voltage is wrong [1]."""
SHARE_IF_ORDERED = 0.4
"""Another order of the columns is a finding if every wheel's share of work exceeds this value, and
the sum of the shares exceeds the sum for the declared order with the best signs by more than this
value [1]."""
SHARE_OF_POWER = 0.1
"""A current has the sign of the power, not of the torque, if its share of work is above this value
while wheels turn forwards, and below minus this value while they turn backwards [1]."""
MOST_A_PER_KG = 2.5
"""Slope of the largest plausible current of one motor, `MOST_A + MOST_A_PER_KG * mass` [A/kg];
wheeled robots do not draw more for long."""
MOST_A = 8.0
"""Constant part of the largest plausible current of one motor [A]."""
MOST_A_WITHOUT_MASS = 200.0
"""Largest plausible current of one motor if the robot's mass is unknown [A]."""
LEAST_A = 0.005
"""Current of a driving motor below which its unit must be wrong [A]."""
MOST_V, LEAST_V = 200.0, 0.2
"""Largest and smallest plausible voltages of a wheeled robot's motors [V]."""
PLAUSIBLE_POWER = (0.003, 60.0)
"""Plausible range of the electrical power over weight times speed, P / (m g v) [1], for robots on
any slope and surface."""
GRAVITY = 9.81
"""Acceleration of gravity [m/s^2]."""


def electric(
    data: JoinedRuns, meant: Interpretation, radius: float, mass_kg: float | None, by_power: bool
) -> Iterator[Finding]:
    """Yield findings about the signs, order and units of currents and voltages.

    Args:
        data: channels of all runs.
        meant: the right order and signs of the wheels.
        radius: radius of the wheels [m].
        mass_kg: mass of the robot [kg], or None if it is unknown.
        by_power: True if no wrong scale was found, so that power can be compared with speed.
    """
    declared = _speeds(data)
    speed = declared @ columns(meant, data.wheels).T
    driving = np.abs(speed).max(axis=1, initial=0.0) > 0.2 * np.nanquantile(np.abs(speed), 0.95)
    for name in ("current", "voltage") if data.current_is_signed else ("voltage",):
        if name in data.channels:
            values = data.channels[name].value[driving]
            yield from _sign_findings(values, speed[driving], declared[driving], name)
    magnitude = {name: np.abs(c.value[driving]) for name, c in data.channels.items()}
    current = None if data.current_is_torque else magnitude.get("current")
    voltage = magnitude.get("voltage", magnitude.get("bus_voltage"))
    power = None
    if by_power and current is not None and voltage is not None and mass_kg is not None:
        watts = float(np.nanmean((current * voltage).sum(axis=1)))
        rim = float(np.nanmean(np.abs(speed[driving]).mean(axis=1))) * radius
        power = watts / max(mass_kg * GRAVITY * rim, 1e-9)
    most = MOST_A_WITHOUT_MASS if mass_kg is None else MOST_A + MOST_A_PER_KG * mass_kg
    sizes = [
        *_size(voltage, "voltage", "V", LEAST_V, MOST_V, "voltage or bus_voltage"),
        *_size(current, "current", "A", LEAST_A, most, "current"),
    ]
    if not sizes and power is not None and not PLAUSIBLE_POWER[0] <= power <= PLAUSIBLE_POWER[1]:
        yield Finding(
            "current_unit",
            f"the motors take {power:.3g} times the power that lifting the robot at its speed "
            f"would take; plausible: {PLAUSIBLE_POWER[0]:g} to {PLAUSIBLE_POWER[1]:g} times",
            "correct the unit of current (mA?) or voltage (mV?), or mass_kg in [robot]",
        )
    yield from sizes


def _speeds(data: JoinedRuns) -> Float[np.ndarray, "row wheel"]:
    """Return the wheel speed in each encoder column as declared [rad/s], zero between runs."""
    step = np.diff(data.angle.time)
    speed = np.diff(data.angle.value, axis=0) / step[:, None]
    run = data.runs_of(data.angle.time)
    speed[np.diff(run) > 0] = 0.0
    return np.concatenate([speed, speed[-1:]])


def _sign_findings(
    values: Float[np.ndarray, "row wheel"],
    speed: Float[np.ndarray, "row wheel"],
    declared: Float[np.ndarray, "row wheel"],
    name: str,
) -> Iterator[Finding]:
    """Yield findings about the signs and order of currents or voltages.

    Over a whole run a motor does positive work on its wheel, so the sum of value x speed is
    positive.

    Args:
        values: currents [A] or voltages [V].
        speed: wheel speeds in the right order and with the right signs [rad/s].
        declared: wheel speeds as declared [rad/s].
        name: name of the channel.
    """
    work = np.nan_to_num(values * speed)
    forwards, backwards = (_share(work[turns]) for turns in (speed > 0, speed < 0))
    if name == "current" and forwards > SHARE_OF_POWER and backwards < -SHARE_OF_POWER:
        both = "currents are positive in both directions of the wheels"
        if np.nanmin(values) < 0.0:
            found = (
                f"{both}, and sometimes negative: they are supply currents, which have the sign "
                "of the power, not of the torque"
            )
            remedy = "remove the current from the layout, or log the current of each motor"
        else:
            found = f"{both}: they are magnitudes, which do not distinguish driving from braking"
            remedy = "set current_is_signed = false in the layout"
        yield Finding("current_of_supply", found, remedy, "note")
        return
    if order := _other_order(values, speed, declared):
        listed = ", ".join(str(k + 1) for k in order)
        yield Finding(
            f"{name}_order",
            f"the columns of the {name} are in another order than the wheels: columns {listed} "
            f"belong to wheels 1 to {len(order)}",
            f"name the columns of the channel {name} in the order {listed}",
        )
        return
    share = _share(work)
    turned = np.flatnonzero(share < SHARE_IF_REVERSED)
    if not len(turned):
        return
    every = len(turned) == len(share)
    which = "every wheel" if every else "wheel " + " and ".join(str(k + 1) for k in turned)
    yield Finding(
        f"{name}_sign",
        f"the {name} of {which} has the wrong sign: its product with the wheel speed, which "
        f"should be mostly positive, sums to {share[turned].min():+.2f} of the sum of its "
        "magnitudes",
        f"set scale = -1 for {'the channel' if every else 'its column of the channel'} {name}, "
        "if it is 1 (else reverse its sign)",
    )


def _other_order(
    values: Float[np.ndarray, "row wheel"],
    speed: Float[np.ndarray, "row wheel"],
    declared: Float[np.ndarray, "row wheel"],
) -> tuple[int, ...] | None:
    """Return the column of each wheel if the columns are in another order than the wheels.

    The result is None if other signs in the declared order explain the work as well. It is also
    None if the columns match those of the encoders as declared, even if the encoders are in a wrong
    order, because then the finding is about the encoders.
    """
    share, as_declared = (
        _share(np.nan_to_num(values[:, None] * one[:, :, None])) for one in (speed, declared)
    )
    wheels, best = linear_sum_assignment(share, maximize=True)
    ordered = share[wheels, best]
    signs = max(float(np.abs(np.diagonal(one)).sum()) for one in (share, as_declared))
    found = ordered.min() > SHARE_IF_ORDERED and ordered.sum() > signs + SHARE_IF_ORDERED
    return tuple(best.tolist()) if found else None


def _share(work: Float[np.ndarray, "step *any"]) -> Float[np.ndarray, "*any"]:
    """Return the share of work: the sum of `work` over steps, divided by the sum of |work| [1].

    It is 1 if all values are positive, -1 if all are negative, and 0 if all are zero.
    """
    total = np.abs(work).sum(axis=0)
    return np.asarray(work.sum(axis=0) / np.where(total > 0, total, 1.0))


def _size(
    values: np.ndarray | None, name: str, unit: str, low: float, high: float, channel: str
) -> Iterator[Finding]:
    """Yield a finding if currents or voltages of driving motors are implausible.

    Args:
        values: magnitudes of the current [A] or voltage [V], or None if it was not logged.
        name: name of the quantity.
        unit: unit of the values.
        low: smallest plausible value.
        high: largest plausible value.
        channel: name of the channel in the text of the remedy.
    """
    if values is None or not np.nanmax(values, initial=0.0) > 0:
        return
    usual = float(np.nanquantile(values, 0.95))
    if low <= usual <= high:
        return
    right, scale = (f"m{unit}", "0.001") if usual > high else (unit, "1000")
    yield Finding(
        f"{name}_unit",
        f"the {name} of driving motors reaches {usual:.4g} {unit}; plausible for such a robot: "
        f"{low:g} to {high:.3g} {unit}",
        f"set unit = '{right}' for the channel {channel} (scale = {scale})",
    )
