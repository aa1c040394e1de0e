"""Texts common to exported files: a robot's parameters, their source, warnings and the README.

The export form `table` consists of such texts only: parameters, gains and limits of a robot as
tables, for entering them into a controller by hand. `gains.md` is for reading and shows each value
rounded and with all digits. `gains.csv` has the same rows with all digits; lines in it that start
with # are comments.
"""

import csv
import io
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version

import numpy as np

from slipid.exports.text import filled, interval, listed, one_line, short, table, wrapped
from slipid.robot.deployed import DeployedRobot
from slipid.robot.gains import DesignedGains, Gains, used_gains
from slipid.robot.record import UNITS, Basis, Pair, Provenance, Setting, Source, Verdict
from slipid.robot.robot_file import declared_numbers

VERDICTS: Mapping[Verdict, str] = {
    "identified": "determined by the logs",
    "weak": "the logs reduce its uncertainty, but its prior still has influence: note its interval",
    "disputed": "its estimates on different floors disagree: use it only under the conditions of "
    "the logs",
    "not_identified": "the logs do not determine it: its value is an assumption (the prior), not a "
    "measurement. Do not rely on it without measuring it in another way",
    "at_bound": "the fit ended at a bound of its possible values. The model, or a parameter that "
    "was held fixed, may be wrong",
    "fixed": "it was given by the user instead of fitted",
}
"""Meaning of each verdict, as text for people."""
PROVENANCES: Mapping[Provenance, str] = {
    "measured": "the logs",
    "borrowed": "a prior: a default or a data sheet",
    "override": "a value chosen by the user",
}
"""Meaning of each provenance, as text for people."""
WARNINGS: Mapping[Verdict, str] = {
    "not_identified": "NOT IDENTIFIED (their values are assumptions, not measurements)",
    "at_bound": "AT A BOUND (the model, or a parameter that was held fixed, may be wrong)",
    "disputed": "DISPUTED (their estimates on different floors disagree)",
}
"""Warning text for each verdict of which users must be warned."""


@dataclass(frozen=True)
class NumberRow:
    """One parameter, gain, limit or matrix element of a robot, as a row of a table.

    Attributes:
        group: key of the table to which the row belongs.
        name: name of the number; for a parameter, its path in robot.json.
        entry: wheel or drive to which the number belongs, such as "wheel 2"; empty for a number of
            the whole robot.
        symbol: symbol in equations.
        value: value [unit].
        unit: unit of the value.
        interval90: 90 % interval [unit]; None if there is none.
        verdict: verdict on the number's identification, as text for people.
        provenance: source of the value, as text for people.
        about: meaning of the number in words.
    """

    group: str
    name: str
    entry: str
    symbol: str
    value: float
    unit: str
    interval90: Pair | None
    verdict: str
    provenance: str
    about: str

    @property
    def verdict_markdown(self) -> str:
        """Verdict as Markdown, in bold if users must be warned of it."""
        warned = self.verdict in map(verdict_text, WARNINGS)
        return f"**{self.verdict}**" if warned else self.verdict


def verdict_text(verdict: str) -> str:
    """Return a verdict as text for people, in capitals if users must be warned of it."""
    words = verdict.replace("_", " ")
    return words.upper() if verdict in WARNINGS else words


def number_rows(robot: DeployedRobot) -> Iterator[NumberRow]:
    """Yield a row for every parameter of a robot; a parameter of wheels has one row per wheel."""
    for e in declared_numbers(robot.record):
        number, d, group = robot.record.parameters[e.path], e.declaration, e.path.partition(".")[0]
        ends = np.reshape([] if number.interval90 is None else number.interval90, (-1, 2)).tolist()
        values = np.ravel(number.value).tolist()
        for k, (value, entry) in enumerate(zip(values, e.labels or ("",), strict=True)):
            about = (d.symbol, value, d.unit, (ends[k][0], ends[k][1]) if ends else None)
            sure = (verdict_text(number.verdict), number.provenance, d.doc)
            yield NumberRow(group, e.path, entry, *about, *sure)


SETTINGS: Mapping[str, str] = {
    "limits.speed": "largest translational speed demanded of the body",
    "limits.yaw_rate": "largest yaw rate demanded of the body",
    "limits.acceleration": "largest acceleration of the rim of a wheel",
    "limits.wheel_speed": "largest speed of a wheel",
    "limits.voltage": "supply voltage",
    "sensors.ammeter_std_a": "std of an ammeter's noise",
    "sensors.voltmeter_std_v": "std of a voltmeter's noise",
    "sensors.gyro_std": "std of the gyro's noise",
    "sensors.gyro_bias_std": "std of the gyro's bias at the start",
    "sensors.stale_s": "time without readings after which a wheel counts as stale",
    "actuators.delay_s": "time until a command reaches the wheels",
    "actuators.lag_s": "time constant with which the wheels then follow a command",
}
"""Meaning of each limit, of the noise of each sensor, and so on, keyed by its path in robot.json;
`UNITS` has the units."""
BASES: Mapping[Basis, tuple[str, str]] = {
    "config": ("given", "config"),
    "logs": ("measured", "logs of the fitted runs"),
    "assumed": ("ASSUMED", "neither config nor logs: enter your own value"),
}
"""Verdict and provenance of a setting with each origin, as text for people."""


def settings(robot: DeployedRobot) -> dict[str, Setting]:
    """Return the known limits, noise of sensors and response of actuators, keyed by path."""
    record = robot.record
    return {
        path: one
        for path in SETTINGS
        if (one := getattr(getattr(record, path.split(".")[0]), path.split(".")[1])) is not None
    }


def settings_origin(robot: DeployedRobot) -> str:
    """Return sentences about the origin of a robot's limits and of the noise of its sensors."""
    known = settings(robot)
    words = {"config": "From the config", "logs": "From the logs", "assumed": "ASSUMED"}
    parts = []
    for basis, word in words.items():
        if paths := [path for path, one in known.items() if one.provenance == basis]:
            parts.append(f"{word}: {', '.join(paths)}.")
    if any(one.provenance == "assumed" for one in known.values()):
        parts.append(
            "Enter your own values for what is assumed: in the config ([robot.limits], "
            "[robot.sensors]), or here."
        )
    return " ".join(parts)


def gains_origin(robot: DeployedRobot) -> str:
    """Return sentences about the origin of a robot's gains and limits."""
    return f"{gains_sentence(robot)} {settings_origin(robot)}"


def gains_sentence(robot: DeployedRobot) -> str:
    """Return a sentence about the origin of a robot's gains, with the margins of designed ones."""
    found = DesignedGains.of(robot)
    if found is None:
        return "Gains set by hand, since delay and lag of the wheels are unknown."
    loops = listed(
        [
            f"{name} loop with a phase margin of {one.margin_deg:.0f} deg and a bandwidth of "
            f"{one.bandwidth_hz:.2g} Hz"
            for name, one in found.loops.items()
        ]
    )
    a = found.actuator
    return (
        f"Gains designed for wheels with a delay of {a.delay_s:.2g} s and a lag of "
        f"{a.lag_s:.2g} s: {loops}."
    )


SOURCES: Mapping[Source, str] = {
    "laplace": "a fit to logs (Laplace approximation)",
    "short_chain": "a fit to logs (draws of a short chain)",
    "posterior": "the posterior of a fit to logs",
    "given": "values given without logs",
}
"""Meaning of each `RobotRecord.source`, as text for people."""


def header(robot: DeployedRobot) -> list[str]:
    """Return comment lines, without comment signs, about the robot of an exported file.

    The lines give source, floors, load set-ups, verdicts and warnings. Each line is plain printable
    text of at most `COMMENT_WIDTH` characters, unless a single word is longer.
    """
    sentences = (*_sentences(robot), *(f"WARNING: {text}" for text in warnings(robot)))
    return [line for sentence in sentences for line in wrapped(sentence)]


def in_markdown(robot: DeployedRobot) -> list[str]:
    """Return the content of `header` as Markdown, warnings first, and the fit's messages."""
    return [*warned(robot), *facts(robot)]


def warned(robot: DeployedRobot) -> list[str]:
    """Return the warnings as lines of Markdown."""
    return [line for text in warnings(robot) for line in (f"> **WARNING.** {text}", "")]


def facts(robot: DeployedRobot) -> list[str]:
    """Return source, floors, load set-ups, verdicts and the fit's messages as a Markdown list."""
    notes = (f"Note of the fit: {message}" for message in robot.record.messages)
    return [*(f"- {one_line(part)}" for part in (*_sentences(robot), *notes)), ""]


def warnings(robot: DeployedRobot) -> tuple[str, ...]:
    """Return a warning for each verdict in `WARNINGS` that any parameter of the robot has."""
    known = {e.path: robot.record.parameters[e.path] for e in declared_numbers(robot.record)}
    by_verdict = {
        verdict: [path for path, number in known.items() if number.verdict == verdict]
        for verdict in WARNINGS
    }
    return tuple(f"{WARNINGS[v]}: {listed(paths)}." for v, paths in by_verdict.items() if paths)


def _sentences(robot: DeployedRobot) -> Iterator[str]:
    """Yield sentences about source, floors, load set-ups, verdicts and gains."""
    record = robot.record
    yield f"Made by slipid {made_with()} from robot.json; export it again instead of editing it."
    yield f"Hash of the parameters: {record.numbers} (`numbers` in robot.json)."
    yield f"Source of the parameters: {SOURCES[record.source]}."
    loads = listed([load.name for load in record.loads])
    yield f"Load set-up: {one_line(robot.load_setup)}; identified load set-ups: {loads}."
    yield f"Floors: {listed(robot.labels)}."
    counts = Counter(record.parameters[e.path].verdict for e in declared_numbers(record))
    listing = ", ".join(f"{n} {v.replace('_', ' ')}" for v, n in counts.most_common())
    yield f"Verdicts: {listing}."
    yield gains_sentence(robot)


def made_with() -> str:
    """Return the version of slipid that writes an export."""
    try:
        return version("slipid")
    except PackageNotFoundError:
        return "(not installed as a package)"


ABOUT: Mapping[str, str] = {
    "c": "estimator and controller in C99, with a test and an example; also a library for "
    "PlatformIO and the Arduino IDE",
    "ros2": "parameters for drive controllers of ros2_controllers, for robot_localization, and for "
    "your own node (with the input for `generate_parameter_library`)",
    "stablehlo": "a step of estimator and controller for programs in JAX: load it by "
    "`jax.export.deserialize`, or by `slipid.exports.stablehlo.load_program`, which also checks "
    "its results",
    "table": "gains, limits, matrices and parameters as tables, for entering them by hand",
}
"""Description of each exported form, for README.md."""


def readme(robot: DeployedRobot, forms: Sequence[str], controller: str) -> str:
    """Return the text of README.md."""
    values = {
        "HEAD": in_markdown(robot),
        "CONTROLLER": controller,
        "FORMS": [f"- `{form}/`: {ABOUT[form]}." for form in forms],
    }
    return filled("README.md", values)


_NUMBER = ("symbol", "value", "unit", "low90", "high90")
HEAD = ("group", "name", "entry", *_NUMBER, "verdict", "provenance", "meaning")
"""Columns of gains.csv."""
_TITLES = {
    "gains": "Controller gains",
    "limits": "Limits",
    "sensors": "Noise of the sensors",
    "actuators": "Response of the wheels to commands",
    "forward": "Kinematics J: rim speed of a wheel [m/s] from the body twist",
    "inverse": "Pseudo-inverse of J: body twist from rim speeds [m/s]",
    "motor": "Motor, the same for all wheels",
    "wheel_curve": "Slip ratio a + b |I| of each wheel at a current I, fitted over all floors",
    "robot": "Wheels and body",
    "surface": "Floors",
}
_GEOMETRY = ("robot.base_radius", "robot.drive_offset")
_FITTED = "from the motor and all floors"
_TWIST = (("vx", "m/s"), ("vy", "m/s"), ("W", "rad/s"))


def table_files(robot: DeployedRobot) -> dict[str, str]:
    """Return the text of gains.md and gains.csv, for the robot's load set-up."""
    lines = tuple(_table_rows(robot))
    return {"gains.md": _as_markdown(robot, lines), "gains.csv": _as_csv(robot, lines)}


def _table_rows(robot: DeployedRobot) -> Iterator[NumberRow]:
    yield from _gain_rows(robot)
    for path, one in settings(robot).items():
        number = (path, "", "", one.value, UNITS[path], None)
        yield NumberRow(path.partition(".")[0], *number, *BASES[one.provenance], SETTINGS[path])
    yield from _matrix_rows(robot)
    yield from _curve_rows(robot)
    ratio, about = float(robot.record.wheels.gear_ratio), "motor speed over wheel speed"
    gear = ("n", ratio, "1", None, "fixed", "override", about)
    yield NumberRow("motor", "wheels.gear_ratio", "", *gear)
    yield from number_rows(robot)


def _gain_rows(robot: DeployedRobot) -> Iterator[NumberRow]:
    gains, designed = Gains.of(robot), DesignedGains.of(robot)
    sure = ("by hand", "default") if designed is None else ("designed", "from delay and lag")
    for e in used_gains(robot):
        d = e.declaration
        about = (d.symbol, float(e.get(gains)), d.unit, None)
        yield NumberRow("gains", f"gains.{e.path}", "", *about, *sure, d.doc)


def _matrix_rows(robot: DeployedRobot) -> Iterator[NumberRow]:
    known = robot.record.parameters
    made_of = [f"{path} ({verdict_text(known[path].verdict)})" for path in _GEOMETRY]
    sure = ("derived", f"from {', '.join(made_of)}")
    each = _drives(robot)
    for k, drive in enumerate(each):
        for axis, (name, unit) in enumerate(_TWIST):
            about = ("J", float(robot.forward[k, axis]), f"m/s per {unit}", None, *sure)
            meaning = f"rim speed of {drive} per {name}"
            yield NumberRow("forward", f"forward[{k + 1}]", name, *about, meaning)
    for axis, (name, unit) in enumerate(_TWIST):
        for k, drive in enumerate(each):
            about = ("J^+", float(robot.inverse[axis, k]), f"{unit} per m/s", None, *sure)
            meaning = f"{name} per rim speed of {drive}"
            yield NumberRow("inverse", f"inverse[{name}]", drive, *about, meaning)


def _curve_rows(robot: DeployedRobot) -> Iterator[NumberRow]:
    columns = (("a", "1", "slip ratio without current"), ("b", "1/A", "slip ratio per current"))
    for drive, row in zip(_drives(robot), robot.wheel_curve.tolist(), strict=True):
        for value, (name, unit, meaning) in zip(row, columns, strict=True):
            about = (name, value, unit, None, "derived", _FITTED, meaning)
            yield NumberRow("wheel_curve", f"wheel_curve.{name}", drive, *about)


def _drives(robot: DeployedRobot) -> list[str]:
    """Return the names of the drives, which are the wheels unless motors drive several wheels."""
    return [f"{'drive' if robot.drive_of else 'wheel'} {k + 1}" for k in range(robot.drives)]


def _as_csv(robot: DeployedRobot, lines: tuple[NumberRow, ...]) -> str:
    text = io.StringIO()
    for line in header(robot):
        # replace double quotes, which would make CSV readers join lines
        text.write(f"# {line}".replace('"', "'") + "\n")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(HEAD)
    for x in lines:
        ends = ("", "") if x.interval90 is None else tuple(repr(end) for end in x.interval90)
        words = (x.group, one_line(x.name), x.entry, x.symbol, repr(x.value), x.unit, *ends)
        writer.writerow((*words, x.verdict, x.provenance, x.about))
    return text.getvalue()


def _as_markdown(robot: DeployedRobot, lines: tuple[NumberRow, ...]) -> str:
    text = ["# Parameters of a robot identified by slipid", "", *in_markdown(robot)]
    text += [gains_origin(robot), ""]
    for group, title in _TITLES.items():
        rows = []
        for x in (x for x in lines if x.group == group):
            number = (x.symbol, short(x.value), repr(x.value), x.unit, interval(x.interval90))
            rows.append(
                (f"`{x.name}`", x.entry, *number, x.verdict_markdown, x.provenance, x.about)
            )
        head = ("name", "", "symbol", "rounded", "value", "unit", "90 % interval", "verdict")
        text += [f"## {title}", "", *table((*head, "provenance", "meaning"), rows), ""]
    text += ["## Verdicts", ""]
    text += [f"- *{verdict_text(v)}*: {about}." for v, about in VERDICTS.items()]
    return "\n".join(text) + "\n"
