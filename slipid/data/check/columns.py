"""Findings of the check: what is wrong or could not be checked, and the remedy.

Findings from the channels of the wheels alone, without poses or a geometry.

Columns are in another order in one channel than in another; one run is enough for that. Or those of
commanded and reported wheel speeds are exchanged: a command comes before the motion, and holds
still in between, so what is called the command then changes later than what is called the measured
speed, and in more rows.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from slipid.data.check.joined import JoinedChannel, JoinedRuns
from slipid.data.log import Log
from slipid.data.wheel_signals import integral, interpolate, swapped_order
from slipid.support.content import Content
from slipid.support.errors import DataError

Severity = Literal["wrong", "suspicious", "note"]
"""Wrong: do not fit before it is put right. Suspicious: look. Note: what could not be checked."""
ORDER: tuple[Severity, ...] = ("wrong", "suspicious", "note")
NAMED = 4
"""Runs that a sentence names before it counts the others."""


@dataclass(frozen=True)
class Finding:
    """One thing that the check found in runs.

    Attributes:
        kind: its name, such as `wheel_sign`; the rooms' files list them.
        found: what is wrong, with numbers.
        remedy: which key to change, and to what; or None.
        severity: how bad it is.
        runs: names of the runs concerned; empty where all are.
    """

    kind: str
    found: str
    remedy: str | None
    severity: Severity = "wrong"
    runs: tuple[str, ...] = ()

    def __str__(self) -> str:
        where = f" (in {listed(self.runs)})" if self.runs else ""
        return self.found + where + (f"; {self.remedy}" if self.remedy else "")

    def explained(self, how: str, others: Iterable["Finding"] = ()) -> "Finding":
        """The finding with how it explains the logs, and the remedies of others that do as well."""
        more = "".join(f"; or, which explains these logs as well: {o.remedy}" for o in others)
        return replace(self, found=f"{self.found}: {how}", remedy=f"{self.remedy}{more}")

    def to_json(self) -> Content:
        """Its part of check.json."""
        return {
            "kind": self.kind,
            "severity": self.severity,
            "found": self.found,
            "remedy": self.remedy,
            "runs": list(self.runs),
        }


def listed(names: Sequence[str]) -> str:
    """The first few names, and how many more there are."""
    more = len(names) - NAMED
    return ", ".join(names[:NAMED]) + (f" and {more} more" if more > 0 else "")


def worst_first(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Findings with those first that forbid a fit."""
    return tuple(sorted(findings, key=lambda f: ORDER.index(f.severity)))


def wrong(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Findings that forbid a fit."""
    return tuple(f for f in findings if f.severity == "wrong")


SAME = ("wheel_sign", "wheel_order", "command_sign", "command_order")
"""Findings from the poses of all runs together, which say it better."""
BROUGHT = ("wheel_scale", "wheel_speed_unit")
"""Findings that columns in another order may bring about; they come again once it is right."""
STEP_S = 0.5
"""Length of a step [s]: delays and jitter do not matter."""
CHANNELS = ("wheel_speed_command", "wheel_speed")
"""Channels that are compared with the encoders."""
LONGEST_S = 1.0
"""Lags between command and motion that are looked at, either way [s]."""
MOST_SHIFTS = 50
"""The same in rows, for time in a wrong unit."""
MOST_ROWS = 20_000
"""Rows that are looked at."""
ALIKE = 0.3
"""Correlation from which a lag is believed."""
BUSIER = 1.5
"""Times as many rows in which a measured speed changes as in a command."""


def misordered(logs: Sequence[Log]) -> Iterator[Finding]:
    """A finding for every channel and every order in which its columns are those of the wheels."""
    found: dict[tuple[str, tuple[int, ...]], list[str]] = {}
    for log in logs:
        for name, order in _orders(log):
            found.setdefault((name, order), []).append(log.name)
    for (name, order), names in found.items():
        listed = ", ".join(map(str, order))
        yield Finding(
            "wheel_columns",
            f"the wheels move as their {name} says only if their columns are taken in the order "
            f"{listed}, where those below zero count backwards",
            f"list the columns of the wheels, or those of {name}, in another order, or set "
            "scale = -1 for those that count backwards",
            runs=() if len(names) == len(logs) else tuple(names),
        )


def refuse_misordered(logs: Sequence[Log]) -> None:
    """DataError with all findings, for commands that look for no other mistakes."""
    if listed := "\n".join(f"not used: {finding}" for finding in misordered(logs)):
        raise DataError(listed)


def _orders(log: Log) -> Iterator[tuple[str, tuple[int, ...]]]:
    """Channels of a run whose columns are those of the wheels in another order, and that order."""
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
    """The finding, if columns are exchanged."""
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
    alike = np.array([_correlation(command, speed, int(k)) for k in shifts])
    best = int(np.argmax(alike))
    busy = [float((np.abs(x) > 1e-3 * np.abs(x).max()).mean()) for x in (command, speed)]
    if alike[best] > ALIKE and shifts[best] < 0 and busy[0] > BUSIER * busy[1]:
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
    """Change of a speed from row to row [rad/s], zero across the ends of runs."""
    speed = (channel.at(when + row) - channel.at(when)) / row
    speed[~inside] = np.nan
    return np.nan_to_num(np.diff(speed, axis=0))


def _correlation(command: np.ndarray, speed: np.ndarray, shift: int) -> float:
    """Of a command with the speed so many rows later."""
    n = len(command) - abs(shift)
    first, second = (command[:n], speed[-n:]) if shift >= 0 else (command[-n:], speed[:n])
    size = np.sqrt((first**2).sum() * (second**2).sum())
    return float((first * second).sum() / size) if size > 0 else 0.0
