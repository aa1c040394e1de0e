"""Findings about the columns of the wheels' channels: wheel speeds, currents and voltages.

Columns of commanded or reported speeds may be in another order than those of the encoders; one run
is enough to find that. The columns of commanded and reported speeds may be exchanged: a command
comes before the motion and is constant in between, so the channel that is called the command then
changes later than the one that is called the measured speed, and in more rows. The sign and order
of currents and voltages follow from the work that they do, their units from what robots draw.
"""

from collections.abc import Iterator, Sequence
from itertools import permutations

import numpy as np
from jaxtyping import Bool, Float

from slipid.data.check.findings import Finding
from slipid.data.check.interpretation import Interpretation, columns
from slipid.data.check.joined import JoinedChannel, JoinedRuns
from slipid.data.log import Log
from slipid.data.wheel_signals import integral, interpolate, swapped_order
from slipid.support.errors import DataError

SAME = ("wheel_sign", "wheel_order", "command_sign", "command_order")
"""Findings from the poses of all runs that make a finding about wheel columns redundant."""
BROUGHT = ("wheel_scale", "wheel_speed_unit")
"""Findings that a wrong order of columns may cause; they come back if they remain in the right
order."""
STEP_S = 0.5
"""Length of a compared step [s]; delays and jitter are small beside it."""
CHANNELS = ("wheel_speed_command", "wheel_speed")
"""Channels that are compared with the encoders."""
LONGEST_S = 1.0
"""Largest lag of either sign between command and motion that is searched [s]."""
MOST_SHIFTS = 50
"""Largest lag in rows, which limits the search where time is in a wrong unit."""
MOST_ROWS = 20_000
"""Most rows that are compared."""
ALIKE = 0.3
"""Least correlation for which a lag is used."""
BUSIER = 1.5
"""Least ratio between the numbers of rows in which the two speeds change."""


def misordered(logs: Sequence[Log]) -> Iterator[Finding]:
    """Yield a finding for every channel whose columns fit the encoders only in another order."""
    found: dict[tuple[str, tuple[int, ...]], list[str]] = {}
    for log in logs:
        for name, order in _orders(log):
            found.setdefault((name, order), []).append(log.name)
    for (name, order), names in found.items():
        listed = ", ".join(map(str, order))
        yield Finding(
            "wheel_columns",
            f"the wheels match their {name} only with their columns in the order "
            f"{listed}, where those below zero count backwards",
            f"list the columns of the wheels, or those of {name}, in another order, or set "
            "scale = -1 for those that count backwards",
            runs=() if len(names) == len(logs) else tuple(names),
        )


def refuse_misordered(logs: Sequence[Log]) -> None:
    """Raise `DataError` with all findings, for commands that check for no other mistakes."""
    if listed := "\n".join(f"not used: {finding}" for finding in misordered(logs)):
        raise DataError(listed)


def _orders(log: Log) -> Iterator[tuple[str, tuple[int, ...]]]:
    """Yield the channels of a run that fit the encoders only in another order, with that order."""
    edges = np.linspace(log.time[0], log.time[-1], max(2, int(log.duration / STEP_S) + 1))
    measured: Float[np.ndarray, "step wheel"] | None = None
    for name in CHANNELS:
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
    if data.commanded is None or data.reported is None:
        return
    row = float(np.median(data.row))
    when = np.arange(data.begin[0], data.end[-1], row)[:MOST_ROWS]
    inside = when + row <= data.end[data.runs_of(when).clip(0)]
    command, speed = (
        _changes(channel, when, row, inside) for channel in (data.commanded, data.reported)
    )
    if not (command**2).sum() > 0 or not (speed**2).sum() > 0:
        return
    most = min(int(LONGEST_S / row), MOST_SHIFTS)
    shifts = np.arange(-most, most + 1)
    correlation = np.array([_correlation(command, speed, int(k)) for k in shifts])
    best = int(np.argmax(correlation))
    busy = [float((np.abs(x) > 1e-3 * np.abs(x).max()).mean()) for x in (command, speed)]
    if correlation[best] > ALIKE and shifts[best] < 0 and busy[0] > BUSIER * busy[1]:
        yield Finding(
            "command_exchanged",
            f"what is called the commanded wheel speed comes {-shifts[best] * row:.2g} s after the "
            f"measured one, and changes in {busy[0]:.0%} of the rows, the measured one in "
            f"{busy[1]:.0%}",
            "exchange the columns of wheel_speed_command and wheel_speed (or of "
            "motor_speed_command and motor_speed)",
        )


def _changes(
    channel: JoinedChannel,
    when: Float[np.ndarray, " at"],
    row: float,
    inside: Bool[np.ndarray, " at"],
) -> Float[np.ndarray, "change wheel"]:
    """Return the change of a speed from row to row [rad/s], zero across the ends of runs."""
    speed = (channel.at(when + row) - channel.at(when)) / row
    speed[~inside] = np.nan
    return np.nan_to_num(np.diff(speed, axis=0))


def _correlation(command: np.ndarray, speed: np.ndarray, shift: int) -> float:
    """Return the correlation of a command with the speed `shift` rows later."""
    n = len(command) - abs(shift)
    first, second = (command[:n], speed[-n:]) if shift >= 0 else (command[-n:], speed[:n])
    size = np.sqrt((first**2).sum() * (second**2).sum())
    return float((first * second).sum() / size) if size > 0 else 0.0


BACKWARDS = -0.25
"""A sign is wrong where work over the sum of its magnitudes is below this [1]."""
ORDERED = 0.4
"""Another order of the columns must give every wheel a larger share of work than this, and a sum
that exceeds the best sum with other signs by as much [1]."""
MOST_ORDERED = 6
"""Most wheels for which every order is tried."""
SIDED = 0.1
"""A current has the sign of the power where its share of work exceeds this forwards and is below
its negative backwards [1]."""
MOST_A_PER_KG = 2.5
"""Continuous current of one motor per mass of the robot, which no wheeled robot draws [A/kg]."""
MOST_A = 8.0
"""Current that is plausible in addition, whatever the mass [A]."""
MOST_UNWEIGHED_A = 200.0
"""Implausible current where the mass is not known [A]."""
LEAST_A = 0.005
"""Current of a driving motor below which the unit is wrong [A]."""
MOST_V, LEAST_V = 200.0, 0.2
"""Largest and smallest plausible voltages of the motors of such robots [V]."""
POWER = (0.003, 60.0)
"""Range of electrical power over mass, gravity and speed of any robot that rolls or climbs [1]."""
GRAVITY = 9.81


def electric(
    data: JoinedRuns, meant: Interpretation, radius: float, mass_kg: float | None, by_power: bool
) -> Iterator[Finding]:
    """Yield findings about currents and voltages.

    Args:
        meant: the right order and signs of the wheels.
        radius: radius of the wheels [m].
        mass_kg: mass of the robot, or None where it is not known.
        by_power: whether the speeds are right, so that the power can be compared with them.
    """
    declared = _speeds(data)
    speed = declared @ columns(meant, data.wheels).T
    driving = np.abs(speed).max(axis=1, initial=0.0) > 0.2 * np.nanquantile(np.abs(speed), 0.95)
    for channel, name in ((data.current, "current"), (data.voltage, "voltage")):
        if channel is None or (name == "current" and not data.current_is_signed):
            continue
        yield from _sign_findings(channel.value[driving], speed[driving], declared[driving], name)
    current = None if data.current is None else np.abs(data.current.value[driving])
    volts = data.bus if data.voltage is None else data.voltage
    voltage = None if volts is None else np.abs(volts.value[driving])
    power = None
    if by_power and current is not None and voltage is not None and mass_kg is not None:
        watts = float(np.nanmean((current * voltage).sum(axis=1)))
        rim = float(np.nanmean(np.abs(speed[driving]).mean(axis=1))) * radius
        power = watts / max(mass_kg * GRAVITY * rim, 1e-9)
    most = MOST_UNWEIGHED_A if mass_kg is None else MOST_A + MOST_A_PER_KG * mass_kg
    sizes = [
        *_size(voltage, "voltage", "V", LEAST_V, MOST_V, "voltage or bus_voltage"),
        *_size(current, "current", "A", LEAST_A, most, "current"),
    ]
    if not sizes and power is not None and not POWER[0] <= power <= POWER[1]:
        yield Finding(
            "current_unit",
            f"the motors take {power:.3g} times the power of lifting the robot at its speed",
            "correct the unit of current (mA?) or voltage (mV?), or mass_kg in [robot]",
        )
    yield from sizes


def _speeds(data: JoinedRuns) -> Float[np.ndarray, "row wheel"]:
    """Return the speed of each column's wheel [rad/s], zero between runs."""
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
    """Yield findings about signs and order: motors must do positive work, so sum value x speed > 0.

    Args:
        speed: wheel speeds in the right order and with the right signs.
        declared: wheel speeds as declared.
        name: name of the channel.
    """
    work = np.nan_to_num(values * speed)
    forwards, backwards = (_share(work[turns]) for turns in (speed > 0, speed < 0))
    if name == "current" and forwards > SIDED and backwards < -SIDED:
        both = "currents are positive in both directions of the wheels"
        if np.nanmin(values) < 0.0:
            yield Finding(
                "current_of_supply",
                f"{both}, and negative at times: they are currents of the supply, with the sign of "
                "the power, not of the torque",
                "take the current out of the layout, or log that of each motor",
                "note",
            )
        else:
            yield Finding(
                "current_of_supply",
                f"{both}: they are magnitudes, which do not distinguish driving from braking",
                "set current_is_signed = false in the layout",
                "note",
            )
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
    share = np.array([_share(column) for column in work.T])
    turned = np.flatnonzero(share < BACKWARDS)
    if not len(turned):
        return
    every = len(turned) == len(share)
    which = "every wheel" if every else "wheel " + " and ".join(str(k + 1) for k in turned)
    yield Finding(
        f"{name}_sign",
        f"the {name} of {which} brakes where the motor should drive: its product with the wheel's "
        f"speed sums to {share[turned].min():+.2f} of its magnitude",
        f"set scale = -1 for {'the channel' if every else 'its column of the channel'} {name}, "
        "if it is 1 (else turn its sign)",
    )


def _other_order(
    values: Float[np.ndarray, "row wheel"],
    speed: Float[np.ndarray, "row wheel"],
    declared: Float[np.ndarray, "row wheel"],
) -> tuple[int, ...] | None:
    """Return the column of each wheel, where another order explains more than other signs do.

    Columns in the declared order of the encoders are right, even where that is not the wheels'.
    """
    wheels = range(speed.shape[1])
    if len(wheels) > MOST_ORDERED:
        return None
    share, as_declared = (_shares(values, one) for one in (speed, declared))
    best = max(permutations(wheels), key=lambda order: float(share[list(order), wheels].sum()))
    ordered = share[list(best), wheels]
    signs = max(float(np.abs(np.diagonal(one)).sum()) for one in (share, as_declared))
    return best if ordered.min() > ORDERED and ordered.sum() > signs + ORDERED else None


def _shares(
    values: Float[np.ndarray, "row wheel"], speed: Float[np.ndarray, "row wheel"]
) -> Float[np.ndarray, "wheel wheel"]:
    """Return the `_share` of every column with every wheel's speed."""
    return np.array([[_share(np.nan_to_num(v * w)) for w in speed.T] for v in values.T])


def _share(work: np.ndarray) -> float:
    """Return the work over the sum of its magnitudes, 0 where there is none."""
    total = float(np.abs(work).sum())
    return float(work.sum()) / total if total > 0 else 0.0


def _size(
    values: np.ndarray | None, name: str, unit: str, low: float, high: float, channel: str
) -> Iterator[Finding]:
    """Yield a finding where currents or voltages are implausible while the motors drive."""
    if values is None or not np.nanmax(values, initial=0.0) > 0:
        return
    usual = float(np.nanquantile(values, 0.95))
    if low <= usual <= high:
        return
    right, scale = (f"m{unit}", "0.001") if usual > high else (unit, "1000")
    yield Finding(
        f"{name}_unit",
        f"the {name} of driving motors reaches {usual:.4g} {unit}; plausible are {low:g} to "
        f"{high:.3g} {unit} for such a robot",
        f"set unit = '{right}' for the channel {channel} (scale = {scale})",
    )
