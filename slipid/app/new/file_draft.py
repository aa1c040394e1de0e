"""From files that were looked into to the layout that a config proposes for them."""

from dataclasses import replace

import numpy as np

from slipid.app.new.config_lines import ConfigLine
from slipid.app.new.draft import ChannelDraft, FileDraft, RobotHint, layout_line
from slipid.app.new.file_channels import FileChannel
from slipid.app.new.file_study import (
    ANGLES,
    CURRENTS,
    SPEEDS,
    FileStudy,
    RunStudy,
    is_battery_voltage,
    reading_rate,
    ticks_are_increments,
)
from slipid.app.new.units import (
    RADII,
    UnitGuess,
    angle_unit,
    current_unit,
    duty_unit,
    heading_unit,
    speed_unit,
    usual_unit,
)
from slipid.data.reading.units import factor

PIXELS = ("pixel", "pixels", "pix", "px")
ASK_EFFORT = (
    "what is it: a current (unit A), a torque (N*m, and torque_constant in the layout), a voltage "
    "(V) or a duty (1)?"
)
_SUPPLY_CURRENT = (
    "positive whichever way the wheels drive, and negative at times, so it is what the battery "
    "gives: slipid wants the current of each motor"
)
_BATTERY_VOLTAGE = (
    "it stays up whatever the wheels do, so it is the battery's: slipid wants the voltage at the "
    "motors, or duty beside bus_voltage"
)


def file_draft(one: FileStudy, known: RunStudy) -> FileDraft:
    """What a config says of one kind of file."""
    channels = [channel_draft(one, found, known) for found in one.columns.found]
    format = one.format
    above = list(one.columns.notes)
    if one.columns.unused:
        above.append(f"Not used: {', '.join(one.columns.unused)}.")
    if not format.names_row and format.delimiter:
        above.append("Columns without names, by their places from 0.")
    main = one is known.main
    return FileDraft(
        tuple(sorted(channels, key=lambda channel: channel.channel != "time")),
        delimiter=format.delimiter,
        names_row=format.names_row,
        units_row=_units_row(one),
        first_data_row=format.first_data_row,
        settings=tuple(_row_lines(one, main) + (_layout_settings(known) if main else [])),
        above=tuple(above),
        questions=_questions(one),
    )


def _units_row(one: FileStudy) -> int:
    """A row of units is checked by the reader, where every column that counts has one there."""
    used = [at for found in one.columns.found for at in found.at]
    return one.format.units_row if all(one.format.units[at] for at in used) else 0


def _questions(one: FileStudy) -> tuple[str, ...]:
    if not one.columns.found:
        names = ", ".join(name for name in one.format.names if name) or "none have a name"
        return (f"which column holds what? There are: {names}",)
    return ()


def _row_lines(one: FileStudy, main: bool) -> list[ConfigLine]:
    """Keys about the rows: runs in one file, rows that repeat, gaps, no time at all."""
    if one.clock is None:
        ask = "no column of time: how long is a row [s]?"
        return [layout_line("row_period", 0.05, ask)]
    steps, lines = np.diff(one.time), []
    usual = one.usual_step
    if main and (steps < -10 * usual).any():
        lines.append(layout_line("new_run", "time_restarts"))
    elif (steps < 0).any():
        at = int(np.argmax(steps < 0)) + 1 + one.format.first_data_row
        ask = f"time goes backwards in row {at}: sort the rows, or is another column the time?"
        lines.append(layout_line("new_run", "never", ask))
    if (steps == 0).any():
        lines.append(layout_line("drop_repeated_time", True))
    longest = float(steps.max(initial=0.0))
    if longest > max(1.0, 20 * usual):
        ask = f"rows are up to {longest:.3g} s apart: a pause that may stay in a run?"
        lines.append(layout_line("max_gap", 1.0, ask))
    return lines


def _layout_settings(known: RunStudy) -> list[ConfigLine]:
    """Keys about encoders and currents, of the layout of all files of a run."""
    lines = []
    robot, ticks = known.robot, known.find("wheel_ticks")
    if ticks is not None:
        ask = ""
        if "ticks_per_revolution" in robot.taken:
            ask = "how many, of the motor shaft, all edges counted?" + _ticks_by_speed(known, ticks)
        lines.append(layout_line("ticks_per_revolution", robot.ticks_per_revolution or 1000.0, ask))
        step = ticks_are_increments(ticks, known.main, known.moved)
        ask = "do ticks add up, or does each row have those since the last?" if step is None else ""
        lines.append(layout_line("ticks_are_increments", bool(step), ask))
    lines.append(layout_line("gear_ratio", robot.gear_ratio, comment="as above"))
    if known.find(*CURRENTS) is not None and not known.of_supply:
        sign = known.has_sign
        ask = "the logs do not tell: do currents have a sign, or are they magnitudes?"
        lines.append(
            layout_line(
                "current_is_signed",
                sign is not False,
                ask if sign is None else "",
                "false where only magnitudes are logged",
            )
        )
    return lines


def _ticks_by_speed(known: RunStudy, ticks: FileChannel) -> str:
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


def radius_hint(known: RunStudy) -> tuple[RobotHint, ...]:
    """What the poses say of the wheel radius, of wheels that all point aformat."""
    speed, ratio = known.find("wheel_speed"), known.pose_over_wheel_speed
    if ratio is None or speed is None or len(speed.at) > 2:
        return ()
    unit = speed.unit or unit_of(known.main, speed, known).unit
    radius = ratio / factor(unit, "rad/s")
    if not RADII[0] <= radius <= RADII[1]:
        return ()
    return (
        RobotHint(
            "wheel_radius_m", f"taken by default: measure it; the poses say about {radius:.2g}"
        ),
    )


def channel_draft(one: FileStudy, found: FileChannel, known: RunStudy) -> ChannelDraft:
    """A channel with its unit, rate, and what is not known of it."""
    columns = tuple(one.format.column(at) for at in found.at)
    unit = UnitGuess(found.unit) if found.unit else unit_of(one, found, known)
    comments = [reading_rate(one, found) if found.channel != "time" else "", unit.why]
    questions = list(dict.fromkeys(found.doubts)) + [unit.doubt] * bool(unit.doubt)
    sketch = ChannelDraft(
        found.channel, columns, unit.unit, "; ".join(filter(None, comments)), " ".join(questions)
    )
    return _unused_draft(sketch, found, known)


def _unused_draft(sketch: ChannelDraft, found: FileChannel, known: RunStudy) -> ChannelDraft:
    """Channels that are better not used before something was answered."""
    speed = known.find(*SPEEDS)
    if found.channel.endswith("torque") and found.unit != "N*m":
        return replace(sketch, off=True, question=ASK_EFFORT)
    if found.channel.endswith("torque"):
        return replace(sketch, off=True, question="give torque_constant [N m/A] in the layout")
    if found.channel == "current" and known.of_supply:
        return replace(sketch, off=True, comment=_SUPPLY_CURRENT)
    runs = (run.find(found.channel) for run in known.runs)
    if found.channel == "voltage" and is_battery_voltage([one for one in runs if one], speed):
        return replace(sketch, off=True, comment=_BATTERY_VOLTAGE)
    if found.channel == "bus_voltage" and known.find("duty") is None:
        return replace(sketch, off=True, comment="of use beside a duty cycle alone")
    if found.channel.startswith("pose_") and not any(s.columns.has_pose for s in known.all):
        return replace(sketch, off=True, comment="a pose in parts is none: x, y and a heading")
    if found.channel.startswith("pose_") and known.moved.place.unit in PIXELS:
        ask = "give metres_per_pixel in the layout" if found.channel == "pose_x" else ""
        return replace(sketch, off=True, question=ask)
    return sketch


def unit_of(one: FileStudy, found: FileChannel, known: RunStudy) -> UnitGuess:
    """Unit of a channel whose name says none."""
    channel = found.channel
    most = float(np.nanmax(np.abs(found.values)))
    if channel == "time":
        return one.clock or UnitGuess("s")
    if channel in ("pose_x", "pose_y"):
        # asked once is enough
        place = known.moved.place
        return place if channel == "pose_x" else UnitGuess(place.unit)
    if channel == "pose_heading":
        farthest = max(known.runs, key=_pose_heading_range)
        turning = farthest.find(channel) or found
        return heading_unit(turning.values[:, 0], _heading_range(farthest))
    if channel in (*SPEEDS, *ANGLES):
        ratio = known.pose_over_wheel_speed
        if channel.startswith("motor") and ratio is not None:
            unknown = "gear_ratio" in known.robot.taken
            ratio = None if unknown else ratio * known.robot.gear_ratio
        unit = speed_unit if channel in SPEEDS else angle_unit
        return unit(ratio, known.radius)
    if channel.endswith("speed_command"):
        speed = known.find(channel.removesuffix("_command"))
        if speed is None:
            return UnitGuess("rad/s", doubt="in which unit?")
        return UnitGuess(speed.unit or "rad/s", "as the speeds")
    if channel == "current":
        return current_unit(most)
    if channel == "duty":
        return duty_unit(most)
    if channel.startswith("twist_command") and channel != "twist_command_yaw":
        return UnitGuess("m/s") if most < 20 else UnitGuess("mm/s", f"up to {most:.4g}")
    if channel in ("twist_command_yaw", "gyro"):
        return _turn_rate_unit(most)
    return usual_unit(channel)


def _pose_heading_range(run: RunStudy) -> float:
    found = run.find("pose_heading")
    return 0.0 if found is None else float(np.nanmax(found.values) - np.nanmin(found.values))


def _heading_range(run: RunStudy) -> float:
    """Range of the heading by the gyro or by the commands of a run [rad]; 0 without."""
    for one in run.all:
        reading_rate = one.columns.first("gyro", "twist_command_yaw")
        if reading_rate is None or one.clock is None:
            continue
        unit = (
            reading_rate.unit or _turn_rate_unit(float(np.nanmax(np.abs(reading_rate.values)))).unit
        )
        speeds = np.nan_to_num(reading_rate.values[:-1, 0]) * factor(unit, "rad/s")
        return float(np.ptp(np.cumsum(speeds * np.diff(one.time))))
    return 0.0


def _turn_rate_unit(most: float) -> UnitGuess:
    return UnitGuess("rad/s") if most < 20 else UnitGuess("deg/s", f"up to {most:.4g}")
