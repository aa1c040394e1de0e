"""Reading of a motor's log from one or several files, each with its own rows.

Channels of several files are put onto the rows of the slowest file. All times are those of one
clock; lags of a few rows are left to the fit.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from slipid.data.log import Log
from slipid.data.reading.assemble import assembled
from slipid.data.reading.checks import MIN_ROWS, check_log
from slipid.data.reading.layout import Channel, Layout
from slipid.data.reading.motor_files import MotorFile, motor_file, tests_in
from slipid.data.reading.motor_layout import (
    PULSES,
    GivenColumns,
    MotorOptions,
    given_channels,
    layout_of,
    motor_layout,
    of_shaft,
    time_channel,
)
from slipid.data.reading.reader import signals_of, times_of
from slipid.data.reading.signal import Identity, RawRun, Signal, SignalSource
from slipid.data.reading.table import Table
from slipid.support.errors import DataError

SHORTEST_S = 20e-6
"""Time between rows below which rows, as of an oscilloscope, are averaged in groups [s]."""


@dataclass(frozen=True)
class MotorLogs:
    """A motor's log that was read.

    Attributes:
        logs: one log for each test in the file, or a single one.
        layout: layout of the main file.
        columns_used: one line about each channel and the columns assigned to it.
    """

    logs: tuple[Log, ...]
    layout: Layout
    columns_used: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _FileRows:
    """Rows of one file with its layout, and the column of pulses if the file has it."""

    table: Table
    layout: Layout
    pulses: Channel | None


def read_motor_logs(
    path: Path, given: Mapping[str, GivenColumns], delimiter: str | None, options: MotorOptions
) -> MotorLogs:
    """Return the logs in a main file and the files of the given columns.

    Args:
        path: the main file, which has the time.
        given: columns that the user named, keyed by channel.
        delimiter: character between the cells of the main file; None if it is unknown.
        options: properties of the log that no file tells.

    Raises:
        DataError: a file cannot be read or lacks a channel, or the clocks of files do not overlap.
    """
    if (PULSES in given) != (options.pulses_per_revolution is not None):
        raise DataError(
            f"{path}: only one of --pulses and --pulses-per-revolution; expected both or neither"
        )
    main = motor_file(path, delimiter)
    layout = motor_layout(main.format, given, options, main.texts, main.zeros)
    rows = _read(main, layout)
    others = []
    for file in dict.fromkeys(one.file for one in given.values() if one.file is not None):
        beside = {c: one for c, one in given.items() if one.file == file}
        others.append(_beside(motor_file(file), beside, options))
    logs = []
    for name, part in tests_in(rows.table, MIN_ROWS):
        run = _run(name, replace(rows, table=part), others, options)
        log = assembled(run, rows.layout)
        check_log(log, run.signals, rows.layout)
        logs.append(log)
    used = [_used(c, one, "", options) for c, one in layout.channels.items()]
    for other in others:
        found = {**other.layout.channels, **({PULSES: other.pulses} if other.pulses else {})}
        used += [_used(c, one, f"{other.table.path}::", options) for c, one in found.items()]
    return MotorLogs(tuple(logs), rows.layout, tuple(used))


def _used(channel: str, one: Channel, place: str, options: MotorOptions) -> str:
    """Return the line about a channel and its columns."""
    name = channel.removeprefix("motor_")
    line = f"{name}: {', '.join(f'{place}{column}' for column in one.columns)} [{one.unit}]"
    if name not in ("speed", "angle", PULSES):
        return line
    gear = options.gear_ratio
    behind = "" if gear == 1 else f" times the gear ratio {gear:g}"
    return f"{line}{behind}, taken as that of the motor's shaft"


def _read(file: MotorFile, layout: Layout) -> _FileRows:
    """Return the rows of a file; fast rows are averaged, and those of one time are united."""
    table = file.rows(layout)
    pulses = layout.channels.get(PULSES)
    rest = {name: one for name, one in layout.channels.items() if name != PULSES}
    layout = replace(layout, channels=rest)
    if "time" in rest and np.isfinite(times_of(table, layout)).all():
        table = _thinned(table, times_of(table, layout))
        table = table.rows(np.append(np.diff(times_of(table, layout)) != 0, True))
    return _FileRows(table, layout, pulses)


def _thinned(table: Table, time: Float[np.ndarray, " row"]) -> Table:
    """Return the means of groups of rows that are `SHORTEST_S` apart or more."""
    period = (time[-1] - time[0]) / max(len(time) - 1, 1)
    if not 0 < period < 0.5 * SHORTEST_S or len(time) < 2 * (size := int(SHORTEST_S / period)):
        return table
    count = len(time) // size
    values = table.values[: count * size].reshape(count, size, -1).mean(axis=1)
    first = table.rows(slice(0, count * size, size))
    return replace(first, values=values)


def _beside(file: MotorFile, given: Mapping[str, GivenColumns], options: MotorOptions) -> _FileRows:
    """Return the rows of another file than the main one.

    A file of pulse times needs no other time.
    """
    channels = given_channels(file.format, given)
    pulses = given.get(PULSES)
    alone = channels.keys() == {PULSES} and pulses is not None and pulses.unit is not None
    if "time" not in channels and not alone:
        channels = {"time": time_channel(file.format)} | channels
    channels = of_shaft(file.format.path, channels, options)
    return _read(file, layout_of(file.format, channels, options))


def _run(name: str, main: _FileRows, others: list[_FileRows], options: MotorOptions) -> RawRun:
    """Return a test of the main file as a run, with the channels of the other files."""
    notes: list[str] = []
    every, signals = [main, *others], dict[str, Signal]()
    for rows in every:
        if {*rows.layout.channels} > {"time"}:
            signals |= signals_of(rows.table, rows.layout, notes)
    pulses = next((_pulses(rows) for rows in every if rows.pulses is not None), None)
    if pulses is not None:
        volts = signals.get("voltage", signals.get("duty"))
        if volts is None:
            found = "pulses have no direction, and there is no column for the voltage"
            raise pulses.source.error(found, "--voltage, or --duty and --bus")
        signals = _on_slowest(signals, pulses)
        volts = signals.get("voltage", signals.get("duty", volts))
        signals["motor_speed"] = _pulse_speed(pulses, volts, options)
    elif others:
        signals = _on_slowest(signals, None)
    path = main.table.path
    known = f"{path.name}: {name}" if name else path.name
    identity = Identity(known, path, main.table.sha256, None, "bench")
    return RawRun(identity, signals, tuple(dict.fromkeys(notes)))


def _on_slowest(signals: Mapping[str, Signal], pulses: Signal | None) -> dict[str, Signal]:
    """Return signals at the rows of the slowest one, within the time that all of them cover.

    Pulses, if there are some, must cover the time as well. A faster signal is replaced by its mean
    over the interval around each row.

    Raises:
        DataError: the signals have no time in common.
    """
    every = [*signals.values(), *([pulses] if pulses is not None else [])]
    first, last = max(s.time[0] for s in every), min(s.time[-1] for s in every)
    slowest = max((s.time for s in signals.values()), key=_period)
    clock = slowest[(slowest >= first) & (slowest <= last)]
    if len(clock) < MIN_ROWS:
        spans = {f"{s.source.path} {s.time[0]:.6g} to {s.time[-1]:.6g} s" for s in signals.values()}
        raise DataError(
            f"times that do not overlap: {', '.join(sorted(spans))}; expected files that "
            "were logged at the same time, with times on the same clock"
        )
    edges = _edges(clock)
    out = {}
    for name, signal in signals.items():
        columns = []
        for column in signal.values.T:
            there = ~np.isnan(column)
            time, values = signal.time[there], column[there]
            fast = 2 * _period(time) <= _period(clock)
            columns.append(_means(time, values, edges) if fast else np.interp(clock, time, values))
        where = np.searchsorted(signal.time, clock, side="right").clip(1) - 1
        source = replace(signal.source, lines=signal.source.lines[where])
        out[name] = Signal(clock, np.stack(columns, axis=1), source)
    return out


def _period(time: Float[np.ndarray, " sample"]) -> float:
    """Return the median time between samples [s], infinite for a single one."""
    return float(np.median(np.diff(time))) if len(time) > 1 else np.inf


def _edges(clock: Float[np.ndarray, " row"]) -> Float[np.ndarray, " edge"]:
    """Return the times between rows, and the first and last row."""
    return np.concatenate([clock[:1], 0.5 * (clock[1:] + clock[:-1]), clock[-1:]])


def _means(
    time: Float[np.ndarray, " sample"],
    values: Float[np.ndarray, " sample"],
    edges: Float[np.ndarray, " edge"],
) -> Float[np.ndarray, " row"]:
    """Return the means of a signal, linear between its samples, between successive edges."""
    every = np.union1d(time, edges)
    at = np.interp(every, time, values)
    area = np.concatenate([[0.0], np.cumsum(0.5 * (at[1:] + at[:-1]) * np.diff(every))])
    return np.diff(np.interp(edges, every, area)) / np.diff(edges)


def _pulse_speed(pulses: Signal, volts: Signal, options: MotorOptions) -> Signal:
    """Return the speed from the times between pulses, with the sign of the voltage.

    While the voltage is close to zero, the speed keeps its sign.

    Args:
        pulses: number of pulses until the time of each pulse.
        volts: voltage or duty cycle, at whose times the speed is returned.
        options: options with the number of pulses per revolution and the gear ratio.
    """
    volt, edges = volts.values[:, 0], _edges(volts.time)
    per_pulse = 2 * np.pi * options.gear_ratio / float(options.pulses_per_revolution or 1.0)
    count = np.interp(edges, pulses.time, pulses.values[:, 0])
    speed = per_pulse * np.diff(count) / np.diff(edges)
    known = np.abs(volt) > 0.02 * np.abs(volt).max()
    latest = np.maximum.accumulate(np.where(known, np.arange(len(volt)), 0))
    return Signal(volts.time, (np.sign(volt[latest]) * speed)[:, None], volts.source)


def _pulses(rows: _FileRows) -> Signal:
    """Return the number of pulses until the time of each pulse.

    The column has the times of the pulses, or a count of pulses, or a level that changes between
    low and high. A time counts if the file has no other, a count if the numbers never fall.
    """
    assert rows.pulses is not None
    column = str(rows.pulses.columns[0])
    source = SignalSource(rows.table.path, (column,), rows.table.lines)
    values = rows.table[column]
    if not np.isfinite(values).all() or len(rows.pulses.columns) > 1:
        raise source.error("cells without a finite number", "a number in every row", column=0)
    if "time" not in rows.layout.channels:
        times = values * rows.layout.factor("time", rows.pulses.unit)
        counts = np.arange(len(times), dtype=float)
    else:
        time = times_of(rows.table, rows.layout)
        if (np.diff(values) < 0).any():
            high = values > 0.5 * (values.min() + values.max())
            values = np.cumsum(np.diff(high, prepend=high[:1]) & high)
        new = np.flatnonzero(np.diff(values) > 0) + 1
        times, counts = time[new], values[new].astype(float)
    if len(times) < MIN_ROWS or not (np.diff(times) > 0).all():
        raise source.error("fewer than two pulses, or pulses back in time", "pulses", column=0)
    lines = np.zeros(len(times), dtype=int)
    return Signal(times, counts[:, None], replace(source, lines=lines))
