"""Currents and voltages: their sign by the work that they do, their size by what robots draw."""

from collections.abc import Iterator
from itertools import permutations

import numpy as np
from jaxtyping import Float

from slipid.data.check.columns import Finding
from slipid.data.check.interpretation import Interpretation, columns
from slipid.data.check.joined import JoinedRuns

BACKWARDS = -0.25
"""Work over the sum of its magnitudes below which a sign is wrong."""
ORDERED = 0.4
"""The same of every wheel in another order of the columns, and what it is more than by signs."""
MOST_ORDERED = 6
"""Wheels up to which every order is tried."""
SIDED = 0.1
"""The same, forwards and backwards apart, from which the sign is that of the power."""
MOST_A_PER_KG = 2.5
"""Current of one motor that no wheeled robot of a mass draws all the time [A/kg],"""
MOST_A = 8.0
"""beyond so much that any may [A]."""
MOST_UNWEIGHED_A = 200.0
"""The same where the mass is not known [A]."""
LEAST_A = 0.005
"""Current of a motor that drives, below which it is in another unit [A]."""
MOST_V, LEAST_V = 200.0, 0.2
"""Voltages that motors of such robots see [V]."""
POWER = (0.003, 60.0)
"""Electrical power over mass, gravity and speed, of any robot that rolls or climbs."""
GRAVITY = 9.81


def electric(
    data: JoinedRuns, meant: Interpretation, radius: float, mass_kg: float | None, by_power: bool
) -> Iterator[Finding]:
    """Findings about currents and voltages.

    Args:
        meant: order and signs of the wheels, as they were found.
        radius: of the wheels [m].
        mass_kg: of the robot, None where it is not known.
        by_power: whether speeds can be trusted, so that power can be compared with them.
    """
    declared = _speeds(data)
    speed = declared @ columns(meant, data.wheels).T
    driving = np.abs(speed).max(axis=1, initial=0.0) > 0.2 * np.nanquantile(np.abs(speed), 0.95)
    for channel, name in ((data.current, "current"), (data.voltage, "voltage")):
        if channel is None or (name == "current" and not data.current_is_signed):
            continue
        yield from _signs(channel.value[driving], speed[driving], declared[driving], name)
    current = None if data.current is None else np.abs(data.current.value[driving])
    volts = data.bus if data.voltage is None else data.voltage
    voltage = None if volts is None else np.abs(volts.value[driving])
    power = None
    if by_power and current is not None and voltage is not None and mass_kg is not None:
        watts = float(np.nanmean((current * voltage).sum(axis=1)))
        rim = float(np.nanmean(np.abs(speed[driving]).mean(axis=1))) * radius
        power = watts / max(mass_kg * GRAVITY * rim, 1e-9)
    odd = list(_size_of_voltage(voltage)) + list(_size_of_current(current, mass_kg))
    if not odd and power is not None and not POWER[0] <= power <= POWER[1]:
        yield Finding(
            "current_unit",
            f"the motors take {power:.3g} times the power of lifting the robot at its speed",
            "correct the unit of current (mA?) or voltage (mV?), or mass_kg in [robot]",
        )
    yield from odd


def _speeds(data: JoinedRuns) -> Float[np.ndarray, "row wheel"]:
    """Speed of each column's wheel [rad/s]; nothing between runs."""
    step = np.diff(data.angle.time)
    speed = np.diff(data.angle.value, axis=0) / step[:, None]
    run = data.runs_of(data.angle.time)
    speed[np.diff(run) > 0] = 0.0
    return np.concatenate([speed, speed[-1:]])


def _signs(
    values: Float[np.ndarray, "row wheel"],
    speed: Float[np.ndarray, "row wheel"],
    declared: Float[np.ndarray, "row wheel"],
    name: str,
) -> Iterator[Finding]:
    """Motors must do work on the whole: sum of value x speed above zero, wheel by wheel.

    The speed is in the order and with the signs that were found, or as `declared`.
    """
    work = np.nan_to_num(values * speed)
    forwards, backwards = (_share(work[way]) for way in (speed > 0, speed < 0))
    if name == "current" and forwards > SIDED and backwards < -SIDED:
        both = "currents are positive whichever way the wheels drive"
        if np.nanmin(values) < 0.0:
            yield Finding(
                "current_of_supply",
                f"{both}, and negative at times: they are what the battery gives, with the sign of "
                "the power, not what the torque goes with",
                "take the current out of the layout, or log that of each motor",
                "note",
            )
        else:
            yield Finding(
                "current_of_supply",
                f"{both}: they are magnitudes, which do not tell driving from braking",
                "set current_is_signed = false in the layout",
                "note",
            )
        return
    if order := _other_order(values, speed, declared):
        listed = ", ".join(str(k + 1) for k in order)
        yield Finding(
            f"{name}_order",
            f"the columns of the {name} are in another order than the wheels: number {listed} "
            f"go with wheels 1 to {len(order)}",
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
    """Which column goes with each wheel, where another order explains more than turned signs do.

    Columns that are in the order of the encoders' are right, even where that is not the wheels'.
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
    """`_share` of every column with every wheel's speed."""
    return np.array([[_share(np.nan_to_num(v * w)) for w in speed.T] for v in values.T])


def _share(work: np.ndarray) -> float:
    """Work over the sum of its magnitudes; 0 where there is none."""
    total = float(np.abs(work).sum())
    return float(work.sum()) / total if total > 0 else 0.0


def _size_of_current(amps: np.ndarray | None, mass_kg: float | None) -> Iterator[Finding]:
    """Whether currents are what such a robot draws."""
    if amps is None or not np.nanmax(amps, initial=0.0) > 0:
        return
    high = float(np.nanquantile(amps, 0.95))
    most = MOST_UNWEIGHED_A if mass_kg is None else MOST_A + MOST_A_PER_KG * mass_kg
    weighs = "" if mass_kg is None else f" for a robot of {mass_kg:g} kg"
    if high > most:
        yield Finding(
            "current_unit",
            f"the motors draw {high:.4g} A{weighs}, where at most {most:.3g} A are to be expected",
            "set unit = 'mA' for the channel current (scale = 0.001)",
        )
    elif high < LEAST_A:
        yield Finding(
            "current_unit",
            f"the motors draw no more than {high:.2g} A while they drive",
            "set unit = 'A' for the channel current, if it is declared in mA (scale = 1000)",
        )


def _size_of_voltage(volts: np.ndarray | None) -> Iterator[Finding]:
    """Whether voltages are what such a robot has."""
    if volts is None or not np.nanmax(volts, initial=0.0) > 0:
        return
    high = float(np.nanquantile(volts, 0.95))
    if LEAST_V <= high <= MOST_V:
        return
    unit, scale = ("mV", "0.001") if high > MOST_V else ("V", "1000")
    yield Finding(
        "voltage_unit",
        f"the motors see {high:.4g} V while they drive",
        f"set unit = '{unit}' for the channel voltage or bus_voltage (scale = {scale})",
    )
