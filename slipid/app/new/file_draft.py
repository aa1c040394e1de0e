"""Draft of the layout of a log file, with units, rates and open questions, from its numbers."""

from dataclasses import replace

import numpy as np

from slipid.app.new.config_lines import ConfigLine
from slipid.app.new.draft import LayoutDraft, channel_line, layout_line, row_lines
from slipid.app.new.file_channels import FileChannel
from slipid.app.new.file_study import (
    ANGLES,
    CURRENTS,
    PIXELS,
    SPEEDS,
    FileStudy,
    RunStudy,
    is_battery_voltage,
    reading_rate,
    ticks_are_increments,
)
from slipid.app.new.robot_answers import RobotAnswers
from slipid.app.new.units import (
    RADII,
    UnitGuess,
    angle_unit,
    current_unit,
    duty_unit,
    heading_unit,
    speed_unit,
    usual_step,
    usual_unit,
)
from slipid.data.reading.units import converts, factor

ASK_EFFORT = "what is it: a current (unit A), a torque (N*m), a voltage (V) or a duty (1)?"
_ASK_COLUMNS = "which column holds what? There are: {}"
_SUPPLY_CURRENT = (
    "positive in both directions of the wheels, and negative at times, so it is the battery's: "
    "slipid needs the current of each motor"
)
_BATTERY_VOLTAGE = (
    "it stays up whatever the wheels do, so it is the battery's: slipid needs the voltage at the "
    "motors, or duty beside bus_voltage"
)


def file_draft(
    name: str, one: FileStudy, run: RunStudy, robot: RobotAnswers, help: tuple[str, ...]
) -> LayoutDraft:
    """Return the draft of the layout of one file of a run.

    Args:
        name: name of the layout.
        one: study of the file.
        run: study of its run.
        robot: answers about the robot, with defaults for unknown ones.
        help: comments above the layout.
    """
    format, main = one.format, one is run.main
    channels = [channel_draft(one, found, run, robot) for found in one.found]
    above = list(one.notes)
    if one.unused:
        above.append(f"Not used: {', '.join(one.unused)}.")
    if not format.names_row and format.delimiter:
        above.append("The columns have no names; they are given by their positions from 0.")
    named = ", ".join(filter(None, format.names)) or "none have a name"
    rows = row_lines(format.delimiter, format.names_row, _units_row(one), format.first_data_row)
    return LayoutDraft(
        name,
        (*rows, *_row_lines(one, main), *(_layout_settings(run, robot) if main else [])),
        tuple(sorted(channels, key=lambda line: line.key != "time")),
        help=help,
        above=tuple(above),
        questions=() if one.found else (_ASK_COLUMNS.format(named),),
    )


def _units_row(one: FileStudy) -> int:
    """Return the row of units for the layout; 0 if there is none, or if a used column has no unit.

    When logs are read, the units in this row are checked against the layout.
    """
    used = [at for found in one.found for at in found.columns]
    return one.format.units_row if all(one.format.units[at] for at in used) else 0


def _row_lines(one: FileStudy, main: bool) -> list[ConfigLine]:
    """Return the lines of the layout about the times of rows.

    The lines are about new runs in the file, repeated times and gaps; or only about the period of
    the rows, if the file has no time.
    """
    if one.clock is None:
        ask = "no column of time: how long is a row [s]?"
        return [layout_line("row_period", 0.05, ask)]
    steps, lines = np.diff(one.time), []
    usual = usual_step(one.time)
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


def _layout_settings(run: RunStudy, robot: RobotAnswers) -> list[ConfigLine]:
    """Return the lines of the layout about encoders and currents, for all files of a run."""
    lines = []
    if (ticks := run.find("wheel_ticks")) is not None:
        ask = ""
        if "ticks_per_revolution" in robot.defaults:
            ask = "how many, of the motor shaft, all edges counted?" + _ticks_by_speed(run, ticks)
        lines.append(layout_line("ticks_per_revolution", robot.ticks_per_revolution or 1000.0, ask))
        step = ticks_are_increments(ticks, run)
        ask = "are ticks a running total, or those since the previous row?" if step is None else ""
        lines.append(layout_line("ticks_are_increments", bool(step), ask))
    lines.append(layout_line("gear_ratio", robot.gear_ratio, comment="as above"))
    if run.find(*CURRENTS) is not None and not run.of_supply:
        sign, comment = run.has_sign, "false where only magnitudes are logged"
        ask = "the logs do not show it: do currents have a sign, or are they magnitudes?"
        ask = ask if sign is None else ""
        lines.append(layout_line("current_is_signed", sign is not False, ask, comment))
    return lines


def _ticks_by_speed(run: RunStudy, ticks: FileChannel) -> str:
    """Return a remark about the ticks per turn that the reported speeds imply.

    The remark is empty if the main file has no speeds that can be compared with the ticks.
    """
    speed = run.main.find(*reversed(SPEEDS))
    if speed is None or not converts(speed.unit, "rad/s") or run.main.clock is None:
        return ""
    time, rates = run.main.time, np.nan_to_num(speed.values) * factor(speed.unit, "rad/s")
    if len(speed.columns) != len(ticks.columns):
        return ""
    turned = float((np.abs(rates[1:]) * np.diff(time)[:, None]).sum()) / (2 * np.pi)
    counted = float(np.abs(np.diff(np.nan_to_num(ticks.values), axis=0)).sum())
    of = "motor" if speed.channel == "motor_speed" else "wheel"
    return (
        f" By the reported speeds about {counted / turned:.4g} a turn of the {of}" if turned else ""
    )


def radius_hint(run: RunStudy, robot: RobotAnswers) -> dict[str, str]:
    """Return a question with the wheel radius that the poses imply, if all wheels point ahead."""
    speed, ratio = run.find("wheel_speed"), run.pose_over_wheel_speed
    if ratio is None or speed is None or len(speed.columns) > 2:
        return {}
    unit = speed.unit or unit_of(run.main, speed, run, robot).unit
    radius = ratio / factor(unit, "rad/s") if converts(unit, "rad/s") else 0.0
    if not RADII[0] <= radius <= RADII[1]:
        return {}
    ask = f"default value: measure it; according to the poses it is about {radius:.2g}"
    return {"wheel_radius_m": ask}


def channel_draft(
    one: FileStudy, found: FileChannel, run: RunStudy, robot: RobotAnswers
) -> ConfigLine:
    """Return the line for a channel, with its unit, its rate and open questions."""
    columns = tuple(one.format.column(at) for at in found.columns)
    unit = UnitGuess(found.unit) if found.unit else unit_of(one, found, run, robot)
    rate = reading_rate(one, found) if found.channel != "time" else ""
    questions = dict.fromkeys(filter(None, (*found.questions, unit.doubt)))
    comment = "; ".join(filter(None, (rate, unit.reason)))
    line = channel_line(found.channel, columns, unit.unit, comment, " ".join(questions))
    unusable = _unusable(found, run)
    return line if unusable is None else replace(line, commented_out=True, **unusable)


def _unusable(found: FileChannel, run: RunStudy) -> dict[str, str] | None:
    """Return the question or comment about a channel that must not be used as it is, else None."""
    channel = found.channel
    if channel.endswith("torque") and found.unit != "N*m":
        return {"question": ASK_EFFORT}
    if channel == "current" and run.of_supply:
        return {"comment": _SUPPLY_CURRENT}
    runs = (run.find(channel) for run in run.runs)
    if channel == "voltage" and is_battery_voltage([one for one in runs if one], run.find(*SPEEDS)):
        return {"comment": _BATTERY_VOLTAGE}
    if channel == "bus_voltage" and run.find("duty") is None:
        return {"comment": "used only together with a duty cycle"}
    if channel in ("pose_x", "pose_y") and not (run.find("pose_x") and run.find("pose_y")):
        return {"comment": "a position needs both x and y"}
    if channel in ("pose_x", "pose_y") and run.place_unit.unit in PIXELS:
        return {"question": "give metres_per_pixel in the layout" if channel == "pose_x" else ""}
    return None


def unit_of(one: FileStudy, found: FileChannel, run: RunStudy, robot: RobotAnswers) -> UnitGuess:
    """Return a guess of the unit of a channel whose columns do not name one."""
    channel = found.channel
    most = float(np.nanmax(np.abs(found.values)))
    if channel == "time":
        return one.clock or UnitGuess("s")
    if channel in ("pose_x", "pose_y"):
        # The question about the unit is asked for x only.
        place = run.place_unit
        return place if channel == "pose_x" else UnitGuess(place.unit)
    if channel == "pose_heading":
        farthest = max(run.runs, key=_pose_heading_range)
        turning = farthest.find(channel) or found
        return heading_unit(turning.values[:, 0], _heading_range(farthest))
    if channel in (*SPEEDS, *ANGLES):
        ratio = run.pose_over_wheel_speed
        if channel.startswith("motor") and ratio is not None:
            ratio = None if "gear_ratio" in robot.defaults else ratio * robot.gear_ratio
        radius = None if "wheel_radius_m" in robot.defaults else robot.wheel_radius_m
        return (speed_unit if channel in SPEEDS else angle_unit)(ratio, radius)
    if channel.endswith("speed_command"):
        speed = run.find(channel.removesuffix("_command"))
        if speed is None:
            return UnitGuess("rad/s", doubt="in which unit?")
        return UnitGuess(speed.unit or "rad/s", "as the speeds")
    if channel == "current":
        return current_unit(most)
    if channel == "duty":
        return duty_unit(found.values)
    if channel.startswith("twist_command") and channel != "twist_command_yaw":
        return UnitGuess("m/s") if most < 20 else UnitGuess("mm/s", f"up to {most:.4g}")
    if channel in ("twist_command_yaw", "gyro"):
        return _turn_rate_unit(most)
    return usual_unit(channel)


def _pose_heading_range(run: RunStudy) -> float:
    """Return the range of a run's logged heading, in the unit of the file; 0 without a heading."""
    found = run.find("pose_heading")
    return 0.0 if found is None else float(np.nanmax(found.values) - np.nanmin(found.values))


def _heading_range(run: RunStudy) -> float:
    """Return the range of the heading, integrated from a run's gyro or commands [rad].

    The range is 0 if the run has neither gyro nor commands.
    """
    for one in run.all:
        rate = one.find("gyro", "twist_command_yaw")
        if rate is None or one.clock is None:
            continue
        unit = rate.unit or _turn_rate_unit(float(np.nanmax(np.abs(rate.values)))).unit
        speeds = np.nan_to_num(rate.values[:-1, 0]) * factor(unit, "rad/s")
        return float(np.ptp(np.cumsum(speeds * np.diff(one.time))))
    return 0.0


def _turn_rate_unit(most: float) -> UnitGuess:
    """Return a guess of the unit of a turn rate, from its largest magnitude."""
    return UnitGuess("rad/s") if most < 20 else UnitGuess("deg/s", f"up to {most:.4g}")
