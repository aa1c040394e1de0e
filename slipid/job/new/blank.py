"""A config for logs that nobody has shown yet: columns with names to be replaced."""

from slipid.job.new.answers import Answers
from slipid.job.new.lines import Line
from slipid.job.new.sketch import (
    ChannelSketch,
    FileSketch,
    LayoutSketch,
    LogsSketch,
    Sketch,
    setting,
)

_NAMES = "the column names and units below are examples: write those of your files"
_LABELS = {
    (4, False): ("fl", "fr", "rl", "rr"),
    (4, True): ("left", "right"),
    (2, False): ("left", "right"),
}


def blank(known: Answers) -> Sketch:
    """Everything that this robot may log, in one file for each run."""
    layout = LayoutSketch(
        "mine", FileSketch(_channels(known), settings=_settings(known)), examples=True
    )
    return Sketch(known, (layout,), (LogsSketch("*/*.csv", "mine"),))


def _settings(known: Answers) -> tuple[Line, ...]:
    gear = setting("gear_ratio", known.gear_ratio, comment="as above")
    signed = setting("current_is_signed", True, comment="false where only magnitudes are logged")
    if not known.ticks_per_revolution:
        return (gear, signed)
    asked = "ticks_per_revolution" in known.taken
    question = "taken by default: look it up, of the motor shaft with all edges" if asked else ""
    ticks = setting("ticks_per_revolution", known.ticks_per_revolution, question)
    increments = setting("ticks_are_increments", False)
    return (ticks, increments, gear, signed)


def _channels(known: Answers) -> tuple[ChannelSketch, ...]:
    labels = _LABELS.get((known.wheels, known.shared))
    if labels is None or known.drive in ("omni", "general"):
        labels = tuple(str(k + 1) for k in range(known.wheels))

    def each(name: str) -> tuple[str, ...]:
        return tuple(f"{name}_{label}" for label in labels)

    ticks = bool(known.ticks_per_revolution)
    turns = ChannelSketch("wheel_ticks", each("ticks"), "tick", "or wheel_angle, motor_angle")
    speed = ChannelSketch("wheel_speed", each("speed"), "rad/s", "or motor_speed, before the gear")
    sideways = known.drive in ("omni", "mecanum", "general")
    twist = [("twist_command_x", "command_x", "m/s"), ("twist_command_y", "command_y", "m/s")]
    twist = twist if sideways else twist[:1]
    commands = [
        ChannelSketch(*(channel, (column,), unit))
        for channel, column, unit in (*twist, ("twist_command_yaw", "command_yaw", "rad/s"))
    ]
    return (
        ChannelSketch("time", ("time",), "s", question=_NAMES),
        turns if ticks else speed,
        ChannelSketch("current", each("current"), "A"),
        ChannelSketch("voltage", each("voltage"), "V", "at the motors, not the battery's"),
        ChannelSketch("pose_x", ("x",), "m", "at the rate of its sensor; empty cells between"),
        ChannelSketch("pose_y", ("y",), "m"),
        ChannelSketch("pose_heading", ("heading",), "rad"),
        *commands,
    )
