"""Which column of a file holds which channel, by their names and by what the numbers are like."""

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from slipid.data.reading.column_names import ColumnMeaning, meaning_of
from slipid.data.reading.layout import PER_WHEEL
from slipid.data.reading.table_format import TableNumbers

_ORDER = ("fl", "fr", "ml", "mr", "rl", "rr", "l", "r")
"""Wheels as the drives count them."""
_QUATERNION = ("x", "y", "z", "w")
TURNS = ("wheel_ticks", "wheel_angle", "motor_angle", "wheel_speed", "motor_speed")
"""Channels that tell how far the wheels turned, the best first."""
_COUNTS = 50
"""Whole numbers up to which a position is no count of ticks."""


@dataclass(frozen=True, eq=False)
class FileChannel:
    """A channel and where it is.

    Attributes:
        channel: its name.
        at: places of its columns.
        labels: which wheel each is of, as the names say.
        values: of the columns, as they are in the file.
        unit: that names or a row of units say; empty where they say none.
        doubts: what was assumed, one sentence each.
    """

    channel: str
    at: tuple[int, ...]
    labels: tuple[str, ...]
    values: Float[np.ndarray, "row column"]
    unit: str = ""
    doubts: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class FileChannels:
    """What is in a file.

    Attributes:
        found: its channels.
        unused: names of other columns of numbers.
        notes: what people should know of it.
    """

    found: tuple[FileChannel, ...]
    unused: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    def get(self, channel: str) -> FileChannel | None:
        """A channel, if it is there."""
        return next((one for one in self.found if one.channel == channel), None)

    def first(self, *channels: str) -> FileChannel | None:
        """The first of some channels that is there."""
        return next((found for name in channels if (found := self.get(name))), None)

    @property
    def turns(self) -> FileChannel | None:
        """The channel that tells how far the wheels turned."""
        return self.first(*TURNS)

    @property
    def wheels(self) -> int:
        """How many wheels, or drives, have columns."""
        return len(self.turns.at) if self.turns else 0

    @property
    def has_pose(self) -> bool:
        """Whether there is a whole pose."""
        turned = self.get("pose_heading") or self.get("pose_quaternion")
        return bool(self.get("pose_x") and self.get("pose_y") and turned)


def columns_of(numbers: TableNumbers) -> FileChannels:
    """What the named columns of a file hold."""
    format, meanings = numbers.format, {}
    for at, name in enumerate(format.names):
        if at not in numbers.texts and name and not np.isnan(numbers.values[:, at]).all():
            meanings[at] = meaning_of(name, format.units[at])
    channels: dict[str, dict[str, int]] = {}
    also: list[str] = []
    for at, one in meanings.items():
        if not one.channel or one.channel == "odometry":
            continue
        there = channels.setdefault(one.channel, {})
        if one.label in there:
            also.append(f"{format.names[at]} (as {format.names[there[one.label]]})")
        else:
            there[one.label] = at
    found = [_found(numbers, meanings, name, places) for name, places in channels.items()]
    found = _one_of_each(_told_apart(found))
    notes = _odometry(numbers, meanings) + [f"not used, said twice: {', '.join(also)}"] * bool(also)
    kept, dropped = _agreeing(found)
    used = {at for one in kept for at in one.at}
    unused = [
        name for at, name in enumerate(format.names) if name and at in meanings and at not in used
    ]
    return FileChannels(tuple(kept), tuple(unused), tuple(notes + dropped))


def _found(
    numbers: TableNumbers, meanings: dict[int, ColumnMeaning], channel: str, places: dict[str, int]
) -> FileChannel:
    """A channel with its columns in order."""
    labels = sorted(places, key=rank)
    at = tuple(places[label] for label in labels)
    units = Counter(meanings[k].unit for k in at)
    doubts = [
        f"column '{numbers.format.names[k]}': {meanings[k].doubt}" for k in at if meanings[k].doubt
    ]
    if len(units) > 1:
        doubts.append(f"columns of one channel in several units ({', '.join(units)})")
    unit = units.most_common(1)[0][0]
    return FileChannel(channel, at, tuple(labels), numbers.values[:, at], unit, tuple(doubts))


def rank(label: str) -> tuple[int, int, str]:
    """Order of wheels: by the drives' convention, else by number."""
    if label in _QUATERNION:
        return (0, _QUATERNION.index(label), label)
    if label in _ORDER:
        return (1, _ORDER.index(label), label)
    return (2, int(label) if label.isdecimal() else 0, label)


def _told_apart(found: list[FileChannel]) -> list[FileChannel]:
    """Positions are ticks where they are whole numbers; v is a speed where no speed is logged."""
    speeds = {one.labels for one in found if one.channel.endswith("_speed")}
    out = []
    for one in found:
        kind, _, what = one.channel.rpartition("_")
        if what == "position":
            ticks = one.unit in ("tick", "ticks") or (not one.unit and _counted(one.values))
            one = replace(one, channel="wheel_ticks" if ticks else f"{kind}_angle")
        elif what == "v":
            volts = (
                one.unit in ("V", "mV")
                or one.labels in speeds
                or (not one.unit and _always_far(one.values))
            )
            one = replace(one, channel="voltage" if volts else f"{kind}_speed")
        out.append(one)
    return out


def _counted(values: Float[np.ndarray, "row column"]) -> bool:
    known = values[~np.isnan(values)]
    return bool((known == np.round(known)).all() and np.abs(known).max(initial=0.0) > _COUNTS)


def _always_far(values: Float[np.ndarray, "row column"]) -> bool:
    """Whether numbers keep away from 0, as a battery's voltage does and a speed does not."""
    known = values[~np.isnan(values)]
    return bool(known.size) and float(known.min()) > 0.5 * float(known.max()) > 0.0


def _one_of_each(found: list[FileChannel]) -> list[FileChannel]:
    """The first of channels that turned out to be the same."""
    out: dict[str, FileChannel] = {}
    for one in found:
        out.setdefault(one.channel, one)
    return list(out.values())


def _agreeing(found: list[FileChannel]) -> tuple[list[FileChannel], list[str]]:
    """Channels that go together, and a line for each that is left out."""
    turns = [one for name in TURNS for one in found if one.channel == name]
    per_wheel = turns or [one for one in found if one.channel in PER_WHEEL]
    count = len(per_wheel[0].at) if per_wheel else 0
    labels = set(per_wheel[0].labels) if per_wheel else set()
    kept, dropped = [], []
    for one in found:
        if one.channel == "pose_quaternion" and len(one.at) != 4:
            dropped.append(f"{len(one.at)} columns of a quaternion; expected x, y, z and w")
        elif one.channel in PER_WHEEL and (len(one.at) != count or not _alike(labels, one)):
            what = f"{len(one.at)} columns of {one.channel}"
            dropped.append(f"{what} are left out: {count} wheels have {per_wheel[0].channel}")
        else:
            kept.append(one)
    return kept, dropped


def _alike(labels: set[str], one: FileChannel) -> bool:
    """Whether channels name the same wheels, or one names sides and the other numbers."""
    numbers = all(label.isdecimal() for label in labels)
    return set(one.labels) == labels or numbers != all(label.isdecimal() for label in one.labels)


def _odometry(numbers: TableNumbers, meanings: dict[int, ColumnMeaning]) -> list[str]:
    names = [numbers.format.names[at] for at, one in meanings.items() if one.channel == "odometry"]
    if not names:
        return []
    return [f"{', '.join(names)}: odometry is no pose of its own, wheels tell it already"]


def without_names(numbers: TableNumbers) -> FileChannels:
    """What columns without names may hold: time, a pose and whole numbers as ticks."""
    values = numbers.values
    whole = [k for k in range(values.shape[1]) if _counted(values[:, [k]])]
    time = next((k for k in range(values.shape[1]) if (np.diff(values[:, k]) > 0).all()), None)
    whole = [k for k in whole if k != time]
    others = [k for k in range(values.shape[1]) if k not in (*whole, time)]
    found = []

    def put(channel: str, *at: int) -> None:
        labels = tuple(str(k + 1) for k in range(len(at)))
        doubt = (f"taken for {channel} by its numbers: is it?",)
        found.append(FileChannel(channel, at, labels, values[:, at], "", doubt))

    if time is not None:
        put("time", time)
    if whole:
        put("wheel_ticks", *whole)
    for channel, at in zip(("pose_x", "pose_y", "pose_heading"), others, strict=False):
        if len(others) >= 3:
            put(channel, at)
    used = {at for one in found for at in one.at}
    unused = tuple(str(k) for k in range(values.shape[1]) if k not in used)
    return FileChannels(tuple(found), unused)


def without(channels: FileChannels, names: frozenset[str]) -> FileChannels:
    """Channels of a file less some channels, which another file of the run has as well."""
    kept = tuple(one for one in channels.found if one.channel not in names)
    again = sorted(one.channel for one in channels.found if one.channel in names)
    notes = (f"Also here, but taken from the other file: {', '.join(again)}.",) if again else ()
    return replace(channels, found=kept, notes=(*channels.notes, *notes))
