"""A channel as a config proposes it: its unit, its rate, and what is not known of it."""

from dataclasses import replace

import numpy as np

from slipid.data.reading.units import factor
from slipid.job.new.look.columns.found import Found
from slipid.job.new.look.signals.known import ANGLES, SPEEDS, Known
from slipid.job.new.look.signals.magnitudes import (
    Unit,
    angle_unit,
    current_unit,
    duty_unit,
    heading_unit,
    plain_unit,
    speed_unit,
)
from slipid.job.new.look.signals.study import Study, of_battery, rate
from slipid.job.new.sketch import ChannelSketch

PIXELS = ("pixel", "pixels", "pix", "px")
EFFORT = (
    "what is it: a current (unit A), a torque (N*m, and torque_constant in the layout), a voltage "
    "(V) or a duty (1)?"
)
_SUPPLY = (
    "positive whichever way the wheels drive, and negative at times, so it is what the battery "
    "gives: slipid wants the current of each motor"
)
_BATTERY = (
    "it stays up whatever the wheels do, so it is the battery's: slipid wants the voltage at the "
    "motors, or duty beside bus_voltage"
)


def channel_sketch(one: Study, found: Found, known: Known) -> ChannelSketch:
    """A channel with its unit, rate, and what is not known of it."""
    columns = tuple(one.head.column(at) for at in found.at)
    unit = Unit(found.unit) if found.unit else unit_of(one, found, known)
    said = [rate(one, found) if found.channel != "time" else "", unit.why]
    questions = list(dict.fromkeys(found.doubts)) + [unit.doubt] * bool(unit.doubt)
    sketch = ChannelSketch(
        found.channel, columns, unit.unit, "; ".join(filter(None, said)), " ".join(questions)
    )
    return _set_apart(sketch, found, known)


def _set_apart(sketch: ChannelSketch, found: Found, known: Known) -> ChannelSketch:
    """Channels that are better not used before something was answered."""
    speed = known.find(*SPEEDS)
    if found.channel.endswith("torque") and found.unit != "N*m":
        return replace(sketch, off=True, question=EFFORT)
    if found.channel.endswith("torque"):
        return replace(sketch, off=True, question="give torque_constant [N m/A] in the layout")
    if found.channel == "current" and known.of_supply:
        return replace(sketch, off=True, comment=_SUPPLY)
    runs = (run.find(found.channel) for run in known.runs)
    if found.channel == "voltage" and of_battery([one for one in runs if one], speed):
        return replace(sketch, off=True, comment=_BATTERY)
    if found.channel == "bus_voltage" and known.find("duty") is None:
        return replace(sketch, off=True, comment="of use beside a duty cycle alone")
    if found.channel.startswith("pose_") and not any(s.columns.has_pose for s in known.all):
        return replace(sketch, off=True, comment="a pose in parts is none: x, y and a heading")
    if found.channel.startswith("pose_") and known.moved.place.unit in PIXELS:
        ask = "give metres_per_pixel in the layout" if found.channel == "pose_x" else ""
        return replace(sketch, off=True, question=ask)
    return sketch


def unit_of(one: Study, found: Found, known: Known) -> Unit:
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
        farthest = max(known.runs, key=_range_of_heading)
        turning = farthest.find(channel) or found
        return heading_unit(turning.values[:, 0], _turned(farthest))
    if channel in (*SPEEDS, *ANGLES):
        seen = known.over_wheels
        if channel.startswith("motor") and seen is not None:
            unknown = "gear_ratio" in known.robot.taken
            seen = None if unknown else seen * known.robot.gear_ratio
        unit = speed_unit if channel in SPEEDS else angle_unit
        return unit(seen, known.radius)
    if channel.endswith("speed_command"):
        speed = known.find(channel.removesuffix("_command"))
        if speed is None:
            return Unit("rad/s", doubt="in which unit?")
        return Unit(speed.unit or "rad/s", "as the speeds")
    if channel == "current":
        return current_unit(most)
    if channel == "duty":
        return duty_unit(most)
    if channel.startswith("twist_command") and channel != "twist_command_yaw":
        return Unit("m/s") if most < 20 else Unit("mm/s", f"up to {most:.4g}")
    if channel in ("twist_command_yaw", "gyro"):
        return _turn_rate_unit(most)
    return plain_unit(channel)


def _range_of_heading(run: Known) -> float:
    found = run.find("pose_heading")
    return 0.0 if found is None else float(np.nanmax(found.values) - np.nanmin(found.values))


def _turned(run: Known) -> float:
    """Range of the heading by the gyro or by the commands of a run [rad]; 0 without."""
    for one in run.all:
        rate = one.columns.first("gyro", "twist_command_yaw")
        if rate is None or one.clock is None:
            continue
        unit = rate.unit or _turn_rate_unit(float(np.nanmax(np.abs(rate.values)))).unit
        speeds = np.nan_to_num(rate.values[:-1, 0]) * factor(unit, "rad/s")
        return float(np.ptp(np.cumsum(speeds * np.diff(one.time))))
    return 0.0


def _turn_rate_unit(most: float) -> Unit:
    return Unit("rad/s") if most < 20 else Unit("deg/s", f"up to {most:.4g}")
