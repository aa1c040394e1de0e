"""Head of every file that is made of a robot: its origin, floors, verdicts and warnings.

README of an exported folder.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version

from slipid.export.rows import WARNED_VERDICTS
from slipid.export.rows import paths_with_verdict
from slipid.export.text import listed, one_line, wrapped
from slipid.robot.deployed import DeployedRobot
from slipid.robot.record import Source, Verdict
from slipid.robot.robot_file import declared_numbers

SOURCES: Mapping[Source, str] = {
    "laplace": "a fit to logs (Laplace approximation)",
    "posterior": "the posterior of a fit to logs",
    "given": "given values, no logs",
}
WARNINGS: Mapping[Verdict, str] = {
    "not_identified": "NOT IDENTIFIED, their values are assumed and no measurement",
    "at_bound": "AT A BOUND, the model or a number that was held fixed may be wrong",
    "disputed": "DISPUTED, floors disagree about them",
}


def header(robot: DeployedRobot) -> list[str]:
    """Lines of a comment without its sign: origin, floors, loads, verdicts and warnings of a robot.

    Each is plain printable text, of 96 characters at most where no word is longer.
    """
    said = (*_sentences(robot), *(f"WARNING: {text}" for text in warnings(robot)))
    return [line for part in said for line in wrapped(part)]


def in_markdown(robot: DeployedRobot) -> list[str]:
    """The head as Markdown, warnings first, with the messages of the fit."""
    return [*warned(robot), *facts(robot)]


def warned(robot: DeployedRobot) -> list[str]:
    """Warnings as Markdown."""
    return [line for text in warnings(robot) for line in (f"> **WARNING.** {text}", "")]


def facts(robot: DeployedRobot) -> list[str]:
    """Origin, floors, loads, verdicts and messages of the fit as a list in Markdown."""
    notes = (f"Note of the fit: {message}" for message in robot.record.messages)
    return [*(f"- {one_line(part)}" for part in (*_sentences(robot), *notes)), ""]


def warnings(robot: DeployedRobot) -> tuple[str, ...]:
    """A sentence for each verdict of which a user must be warned, where a number has it."""
    found = {verdict: paths_with_verdict(robot, verdict) for verdict in WARNED_VERDICTS}
    return tuple(f"{WARNINGS[v]}: {listed(paths)}." for v, paths in found.items() if paths)


def _sentences(robot: DeployedRobot) -> Iterator[str]:
    record = robot.record
    yield f"Made by slipid {made_with()} from robot.json; make it anew rather than change it."
    yield f"Numbers: {record.numbers} (`numbers` of robot.json)."
    yield f"They come from {SOURCES[record.source]}."
    loads = listed([load.name for load in record.loads])
    yield f"Load set-up: {one_line(robot.load_setup)}, of those known: {loads}."
    yield f"Floors: {listed(robot.labels)}."
    numbers = declared_numbers(record)
    counts = Counter(record.parameters[e.path].verdict for e in numbers)
    said = ", ".join(f"{n} {v.replace('_', ' ')}" for v, n in counts.most_common())
    yield f"Verdicts: {said}."


def made_with() -> str:
    """Version of slipid."""
    try:
        return version("slipid")
    except PackageNotFoundError:
        return "(not installed as a package)"


ABOUT: Mapping[str, str] = {
    "c": "estimator and controller in C99, with a test of themselves and an example; also a "
    "library for PlatformIO and the Arduino IDE",
    "ros2": "parameters for drive controllers of ros2_controllers, for robot_localization, and of "
    "a node of your own with their declaration",
    "stablehlo": "the same step for programs in JAX: `jax.export.deserialize`, or "
    "`slipid.export.stablehlo.load_program`, which compares it first",
    "table": "gains, limits and matrices for a person who types them in",
}


def readme(robot: DeployedRobot, forms: Sequence[str], controller: str) -> str:
    """Text of README.md."""
    lines = [
        "# One identified robot, ready to be taken along",
        "",
        *in_markdown(robot),
        f"Everything here is made of `robot.json`, for the controller `{controller}`.",
        "",
        *(f"- `{form}/`: {ABOUT[form]}." for form in forms),
        "",
        "`sha256sum -c SHA256SUMS` tells whether a byte was changed; with slipid, "
        "`slipid export --check` and this folder.",
    ]
    return "\n".join(lines) + "\n"
