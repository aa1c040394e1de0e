"""From files that were looked into to the layout that a config proposes for them."""

import numpy as np

from slipid.data.reading.units import factor
from slipid.job.new.lines import Line
from slipid.job.new.look.channels import channel_sketch, unit_of
from slipid.job.new.look.columns.found import Found
from slipid.job.new.look.signals.known import CURRENTS, SPEEDS, Known
from slipid.job.new.look.signals.magnitudes import RADII
from slipid.job.new.look.signals.study import Study, increments
from slipid.job.new.sketch import FileSketch, Hint, setting


def file_sketch(one: Study, known: Known) -> FileSketch:
    """What a config says of one kind of file."""
    channels = [channel_sketch(one, found, known) for found in one.columns.found]
    head = one.head
    above = list(one.columns.notes)
    if one.columns.unused:
        above.append(f"Not used: {', '.join(one.columns.unused)}.")
    if not head.names_row and head.delimiter:
        above.append("Columns without names, by their places from 0.")
    main = one is known.main
    return FileSketch(
        tuple(sorted(channels, key=lambda channel: channel.channel != "time")),
        delimiter=head.delimiter,
        names_row=head.names_row,
        units_row=_units_row(one),
        first_data_row=head.first_data_row,
        settings=tuple(_clock(one, main) + (_settings(known) if main else [])),
        above=tuple(above),
        questions=_questions(one),
    )


def _units_row(one: Study) -> int:
    """A row of units is checked by the reader, where every column that counts has one there."""
    used = [at for found in one.columns.found for at in found.at]
    return one.head.units_row if all(one.head.units[at] for at in used) else 0


def _questions(one: Study) -> tuple[str, ...]:
    if not one.columns.found:
        names = ", ".join(name for name in one.head.names if name) or "none have a name"
        return (f"which column holds what? There are: {names}",)
    return ()


def _clock(one: Study, main: bool) -> list[Line]:
    """Keys about the rows: runs in one file, rows that repeat, gaps, no time at all."""
    if one.clock is None:
        ask = "no column of time: how long is a row [s]?"
        return [setting("row_period", 0.05, ask)]
    steps, lines = np.diff(one.time), []
    usual = one.usual_step
    if main and (steps < -10 * usual).any():
        lines.append(setting("new_run", "time_restarts"))
    elif (steps < 0).any():
        at = int(np.argmax(steps < 0)) + 1 + one.head.first_data_row
        ask = f"time goes backwards in row {at}: sort the rows, or is another column the time?"
        lines.append(setting("new_run", "never", ask))
    if (steps == 0).any():
        lines.append(setting("drop_repeated_time", True))
    longest = float(steps.max(initial=0.0))
    if longest > max(1.0, 20 * usual):
        ask = f"rows are up to {longest:.3g} s apart: a pause that may stay in a run?"
        lines.append(setting("max_gap", 1.0, ask))
    return lines


def _settings(known: Known) -> list[Line]:
    """Keys about encoders and currents, of the layout of all files of a run."""
    lines = []
    robot, ticks = known.robot, known.find("wheel_ticks")
    if ticks is not None:
        ask = ""
        if "ticks_per_revolution" in robot.taken:
            ask = "how many, of the motor shaft, all edges counted?" + _by_speeds(known, ticks)
        lines.append(setting("ticks_per_revolution", robot.ticks_per_revolution or 1000.0, ask))
        step = increments(ticks, known.main, known.moved)
        ask = "do ticks add up, or does each row have those since the last?" if step is None else ""
        lines.append(setting("ticks_are_increments", bool(step), ask))
    lines.append(setting("gear_ratio", robot.gear_ratio, comment="as above"))
    if known.find(*CURRENTS) is not None and not known.of_supply:
        sign = known.signed
        ask = "the logs do not tell: do currents have a sign, or are they magnitudes?"
        lines.append(
            setting(
                "current_is_signed",
                sign is not False,
                ask if sign is None else "",
                "false where only magnitudes are logged",
            )
        )
    return lines


def _by_speeds(known: Known, ticks: Found) -> str:
    """How many ticks a turn has by the reported speeds, if both are in one file."""
    speed = known.main.columns.first(*reversed(SPEEDS))
    if speed is None or not speed.unit or known.main.clock is None:
        return ""
    time, rates = known.main.time, np.nan_to_num(speed.values) * factor(speed.unit, "rad/s")
    if len(speed.at) != len(ticks.at):
        return ""
    turned = float((np.abs(rates[1:]) * np.diff(time)[:, None]).sum()) / (2 * np.pi)
    counted = float(np.abs(np.diff(np.nan_to_num(ticks.values), axis=0)).sum())
    of = "motor" if speed.channel == "motor_speed" else "wheel"
    return (
        f" By the reported speeds about {counted / turned:.4g} a turn of the {of}" if turned else ""
    )


def radius_hint(known: Known) -> tuple[Hint, ...]:
    """What the poses say of the wheel radius, of wheels that all point ahead."""
    speed, seen = known.find("wheel_speed"), known.over_wheels
    if seen is None or speed is None or len(speed.at) > 2:
        return ()
    unit = speed.unit or unit_of(known.main, speed, known).unit
    radius = seen / factor(unit, "rad/s")
    if not RADII[0] <= radius <= RADII[1]:
        return ()
    return (
        Hint("wheel_radius_m", f"taken by default: measure it; the poses say about {radius:.2g}"),
    )
