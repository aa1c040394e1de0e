"""Feed-forward and feedback gains in written forms: JSON, a header in C99, and ROS 2 parameters."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

from slipid.exports.description import made_with, verdict_text
from slipid.exports.ros.yaml_text import Parameter, comment, nodes
from slipid.exports.text import filled, identifiers, interval, wrapped
from slipid.model.feedforward import Feedforward, Gain
from slipid.robot.feedback import UNITS, FeedbackGains
from slipid.support.content import Content
from slipid.support.files import write_bytes
from slipid.support.folder import refuse_foreign

HEADER, PARAMETERS = "motor_feedforward.h", "motor_feedforward.yaml"
"""Names of the files with gains in C and for ROS 2."""
MEANING = {
    "kS": "voltage against dry friction",
    "kV": "voltage per speed",
    "kA": "voltage per acceleration",
    "kG": "voltage against gravity",
    "velocity_kP": "velocity loop: voltage per velocity error",
    "position_kP": "position loop: voltage per position error",
    "position_kD": "position loop: voltage per velocity error",
}
"""Meaning of each gain, keyed by name."""


def gains_json(found: Sequence[Feedforward]) -> Content:
    """Return the contents `feedforward` and `feedback` of result files, each keyed by name.

    Every name has the gains per radian, and kV and kA also per rotation and, with a wheel, per
    metre of its rim.
    """
    feedforward: Content = {}
    feedback: Content = {}
    for one in found:
        feedforward[one.name] = {name: asdict(gain) for name, gain in one.gains.items()}
        others = {"per_rotation": one.per_rotation(), "per_metre": one.per_metre()}
        for unit, other in others.items():
            if other is not None:
                feedforward[one.name][unit] = {"kV": asdict(other.kV), "kA": asdict(other.kA)}
        if (back := FeedbackGains.of(one)) is not None:
            values = {n: {"value": x, "unit": UNITS[n]} for n, x in back.values.items()}
            about = {"verdict": back.verdict, "demand": asdict(back.demand)}
            feedback[one.name] = values | about
    return {"feedforward": feedforward, "feedback": feedback}


def write_gains(folder: Path, found: Sequence[Feedforward]) -> tuple[str, ...]:
    """Write gains as a header in C and as ROS 2 parameters; return the names of the files.

    Without gains nothing is written.
    """
    if not found:
        return ()
    lines = [*comment(_head()), *nodes([("slipid", tuple(gain_parameters(found)))])]
    yaml = "\n".join(lines) + "\n"
    for name in (HEADER, PARAMETERS):
        refuse_foreign(folder / name)
    write_bytes(folder / HEADER, c_header(found).encode())
    write_bytes(folder / PARAMETERS, yaml.encode())
    return HEADER, PARAMETERS


def gain_parameters(found: Sequence[Feedforward]) -> Iterator[Parameter]:
    """Yield the gains as ROS parameters in the groups `feedforward.NAME` and `feedback.NAME`."""
    names = _names(found)
    for name, one in zip(names, found, strict=True):
        for key, gain in one.gains.items():
            path = f"feedforward.{name}.{key}"
            yield Parameter(path, gain.value, f"{MEANING[key]} [{gain.unit}]; {_sure(gain)}")
    for name, one in zip(names, found, strict=True):
        back = FeedbackGains.of(one)
        for key, value in {} if back is None else back.values.items():
            yield Parameter(f"feedback.{name}.{key}", value, f"{MEANING[key]} [{UNITS[key]}]")


def c_header(found: Sequence[Feedforward]) -> str:
    """Return the text of a header with constants, and a function that returns the voltage."""
    body: list[str] = []
    for name, one in zip(_names(found), found, strict=True):
        prefix = name.upper()
        body += ["", f"/* {name}: speeds are those of the {_place(one)} [rad/s]. */"]
        for key, gain in one.gains.items():
            about = f"{MEANING[key]} [{gain.unit}]; {_sure(gain)}"
            body.append(_constant(f"FEEDFORWARD_{prefix}_{key.upper()}", gain.value, about))
        back = FeedbackGains.of(one)
        for key, value in {} if back is None else back.values.items():
            about = f"{MEANING[key]} [{UNITS[key]}]"
            body.append(_constant(f"FEEDBACK_{prefix}_{key.upper()}", value, about))
        body += ["", *_function(name, prefix, one.kG is not None)]
    return filled("c99/motor_feedforward.h", {"HEAD": [f" * {x}" for x in _head()], "BODY": body})


def _constant(name: str, value: float, about: str) -> str:
    return f"#define {name} ({value!r}) /* {about} */"


def _function(name: str, prefix: str, lifts: bool) -> list[str]:
    """Return the lines of the function that computes the voltage."""
    terms = [f"sign * FEEDFORWARD_{prefix}_KS", f"FEEDFORWARD_{prefix}_KV * speed"]
    terms.append(f"FEEDFORWARD_{prefix}_KA * acceleration")
    if lifts:
        terms.append(f"FEEDFORWARD_{prefix}_KG")
    return [
        "/* Voltage [V] for a wanted speed [rad/s] and acceleration [rad/s^2]. */",
        f"static inline double feedforward_{name}_volts(double speed, double acceleration) {{",
        "  /* at standstill dry friction acts against the acceleration */",
        "  const double along = speed < 0.0 || speed > 0.0 ? speed : acceleration;",
        "  const double sign = (double)(along > 0.0) - (double)(along < 0.0);",
        "  return " + "\n         + ".join(terms) + ";",
        "}",
    ]


def _head() -> list[str]:
    return list(
        wrapped(
            f"Feed-forward gains, V = kS sign(w) + kV w + kA dw/dt, and feedback gains with the "
            f"defaults of WPILib's SysId, by slipid {made_with()}. A gain that is NOT IDENTIFIED "
            "is an assumption."
        )
    )


def _names(found: Sequence[Feedforward]) -> tuple[str, ...]:
    return identifiers([one.name for one in found], "motor")


def _place(one: Feedforward) -> str:
    return "motor shaft" if one.radius is None else f"wheel, with a radius of {one.radius!r} m"


def _sure(gain: Gain) -> str:
    """Return verdict and interval of a gain as text."""
    word = verdict_text(gain.verdict)
    return word if gain.interval90 is None else f"{word}, 90 % interval {interval(gain.interval90)}"
