"""From files that were looked into to the layout that a config proposes for them."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from slipid.data.reading.units import factor
from slipid.job.new.lines import Line
from slipid.job.new.look.columns import Columns, Found
from slipid.job.new.look.magnitudes import (
    RADII,
    Unit,
    current_unit,
    duty_unit,
    heading_unit,
    plain_unit,
    speed_unit,
)
from slipid.job.new.look.study import (
    Motion,
    Study,
    increments,
    motion,
    of_battery,
    over_wheels,
    rate,
    signed,
)
from slipid.job.new.questions import Answers
from slipid.job.new.sketch import ChannelSketch, FileSketch, Hint, setting

_CURRENTS = ("current", "motor_torque", "wheel_torque")
EFFORT = (
    "what is it: a current (unit A), a torque (N*m, and torque_constant in the layout), a voltage "
    "(V) or a duty (1)?"
)
_BATTERY = (
    "it stays up whatever the wheels do, so it is the battery's: slipid wants the voltage at the "
    "motors, or duty beside bus_voltage"
)


@dataclass(frozen=True, eq=False)
class Known:
    """What files of a run tell of each other.

    Attributes:
        robot: its sizes, as far as they are known.
        main: the file that has the wheels; `all`: every file of the run.
        others: the same of further runs, for what a single run may not show.
    """

    robot: Answers
    main: Study
    all: tuple[Study, ...]
    others: tuple["Known", ...] = ()

    @cached_property
    def moved(self) -> Motion:
        """Motion by the pose."""
        return motion(pose_study(self.all))

    def find(self, *channels: str) -> Found | None:
        """The first of some channels, in any of the files."""
        return next(
            (f for name in channels for one in self.all if (f := one.columns.get(name))), None
        )

    @property
    def runs(self) -> tuple["Known", ...]:
        """This run, and the others."""
        return (self, *self.others)

    @cached_property
    def over_wheels(self) -> float | None:
        """Speed of the pose over that of the wheels, the middle one of all runs."""
        found = []
        for run in self.runs:
            if (speed := run.find("wheel_speed", "motor_speed")) is None:
                continue
            ratio = over_wheels(run.main, speed, run.moved)
            found += [ratio] if ratio is not None else []
        return float(np.median(found)) if found else None

    @property
    def radius(self) -> float | None:
        """Wheel radius, where somebody said it [m]."""
        taken = "wheel_radius_m" in self.robot.taken
        return None if taken else self.robot.wheel_radius_m


def file_sketch(one: Study, known: Known) -> FileSketch:
    """What a config says of one kind of file."""
    channels = [_channel(one, found, known) for found in one.columns.found]
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
    if known.find(*_CURRENTS) is not None:
        sign = _signed(known)
        ask = "nothing drove backwards: do currents have a sign, or only magnitudes?"
        lines.append(
            setting(
                "current_is_signed",
                sign is not False,
                ask if sign is None else "",
                "false where only magnitudes are logged",
            )
        )
    return lines


def _signed(known: Known) -> bool | None:
    """Whether currents have a sign in any of the runs; None where none tells."""
    said = [
        signed(current, run.find("wheel_speed", "motor_speed"))
        for run in known.runs
        if (current := run.find(*_CURRENTS)) is not None
    ]
    return True if True in said else False if False in said else None


def _by_speeds(known: Known, ticks: Found) -> str:
    """How many ticks a turn has by the reported speeds, if both are in one file."""
    speed = known.main.columns.get("motor_speed") or known.main.columns.get("wheel_speed")
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


def _channel(one: Study, found: Found, known: Known) -> ChannelSketch:
    """A channel with its unit, rate, and what is not known of it."""
    columns = tuple(one.head.column(at) for at in found.at)
    unit = Unit(found.unit) if found.unit else _unit(one, found, known)
    said = [rate(one, found) if found.channel != "time" else "", unit.why]
    questions = list(dict.fromkeys(found.doubts)) + [unit.doubt] * bool(unit.doubt)
    sketch = ChannelSketch(
        found.channel, columns, unit.unit, "; ".join(filter(None, said)), " ".join(questions)
    )
    return _set_apart(sketch, found, known)


def _set_apart(sketch: ChannelSketch, found: Found, known: Known) -> ChannelSketch:
    """Channels that are better not used before something was answered."""
    speed = known.find("wheel_speed", "motor_speed")
    if found.channel.endswith("torque") and found.unit != "N*m":
        return replace(sketch, off=True, question=EFFORT)
    if found.channel.endswith("torque"):
        return replace(sketch, off=True, question="give torque_constant [N m/A] in the layout")
    if found.channel == "voltage" and of_battery(found, speed):
        return replace(sketch, off=True, comment=_BATTERY)
    if found.channel == "bus_voltage" and known.find("duty") is None:
        return replace(sketch, off=True, comment="of use beside a duty cycle alone")
    if found.channel.startswith("pose_") and not any(s.columns.has_pose for s in known.all):
        return replace(sketch, off=True, comment="a pose in parts is none: x, y and a heading")
    if sketch.unit in ("pixel", "pixels", "pix", "px"):
        return replace(sketch, off=True, question="give metres_per_pixel in the layout")
    return sketch


def _unit(one: Study, found: Found, known: Known) -> Unit:
    """Unit of a channel whose name says none."""
    channel = found.channel
    most = float(np.nanmax(np.abs(found.values)))
    if channel == "time":
        return one.clock or Unit("s")
    if channel in ("pose_x", "pose_y"):
        # asked once is enough
        place = known.moved.place
        return place if channel == "pose_x" else Unit(place.unit)
    if channel == "pose_heading":
        return heading_unit(found.values[:, 0])
    if channel in ("wheel_speed", "motor_speed"):
        gear = known.robot.gear_ratio if channel == "motor_speed" else 1.0
        if channel == "motor_speed" and "gear_ratio" in known.robot.taken:
            return speed_unit(None, None)
        seen = known.over_wheels
        return speed_unit(seen and seen * gear, known.radius)
    if channel.endswith("speed_command"):
        speed = known.find(channel.removesuffix("_command"))
        if speed is None:
            return Unit("rad/s", doubt="in which unit?")
        return Unit(speed.unit or "rad/s", "as the speeds")
    if channel in ("wheel_angle", "motor_angle"):
        return Unit("rad" if most < 1e3 else "deg", doubt="radians, degrees, turns or ticks?")
    if channel == "current":
        return current_unit(most)
    if channel == "duty":
        return duty_unit(most)
    if channel.startswith("twist_command") and channel != "twist_command_yaw":
        return Unit("m/s") if most < 20 else Unit("mm/s", f"up to {most:.4g}")
    if channel in ("twist_command_yaw", "gyro"):
        return Unit("rad/s") if most < 20 else Unit("deg/s", f"up to {most:.4g}")
    return plain_unit(channel)


def radius_hint(known: Known) -> tuple[Hint, ...]:
    """What the poses say of the wheel radius, of wheels that all point ahead."""
    speed, seen = known.find("wheel_speed"), known.over_wheels
    if seen is None or speed is None or len(speed.at) > 2:
        return ()
    unit = speed.unit or _unit(known.main, speed, known).unit
    radius = seen / factor(unit, "rad/s")
    if not RADII[0] <= radius <= RADII[1]:
        return ()
    return (
        Hint("wheel_radius_m", f"taken by default: measure it; the poses say about {radius:.2g}"),
    )


def pose_study(studies: tuple[Study, ...]) -> Study | None:
    """The file that has the pose."""
    return next((one for one in studies if one.columns.has_pose), None)


def without(columns: Columns, names: frozenset[str]) -> Columns:
    """Columns less some channels, which another file of the run has as well."""
    kept = tuple(one for one in columns.found if one.channel not in names)
    again = sorted(one.channel for one in columns.found if one.channel in names)
    said = (f"Also here, but taken from the other file: {', '.join(again)}.",) if again else ()
    return replace(columns, found=kept, notes=(*columns.notes, *said))
