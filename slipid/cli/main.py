"""The command line with all commands.

Commands import their libraries when they run, so that `slipid --help` does not load numpy.
"""

import _thread
import errno
import logging
import os
import re
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from inspect import cleandoc
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, TextIO, cast

import typer
from typer.core import TyperCommand, TyperGroup

from slipid import __version__
from slipid.cli.arguments import refuse_odd
from slipid.cli.benchmark import benchmark, paper
from slipid.cli.calibrate import calibrate
from slipid.cli.check import check
from slipid.cli.demo import demo
from slipid.cli.design import design
from slipid.cli.export import export
from slipid.cli.export_run import export_run
from slipid.cli.floors import floors
from slipid.cli.identify import identify
from slipid.cli.map import map_
from slipid.cli.motor import motor
from slipid.cli.new import new, reference
from slipid.cli.report import report
from slipid.cli.robots import robots
from slipid.cli.sample import sample
from slipid.cli.selftest import selftest
from slipid.cli.simulate import simulate
from slipid.cli.track import track
from slipid.cli.trial import trial
from slipid.cli.validate import compare, validate
from slipid.support.errors import DataError, with_short_words

if TYPE_CHECKING:
    from contextlib import AbstractContextManager


UsageError: Any = typer.BadParameter.__base__
"""Typer's error for wrong usage, which it does not export."""


class Command(NamedTuple):
    """A command of the command line.

    Attributes:
        run: its function; the docstring is the help.
        line: what it does, in the list of commands.
        example: a command to type, with which the help begins.
    """

    run: Callable[..., None]
    line: str
    example: str


PANELS: dict[str, tuple[Command, ...]] = {
    "Start": (
        Command(demo, "Identify a robot from logs that ship with slipid", "slipid demo"),
        Command(new, "Write a config for your robot, from its logs", "slipid new --from logs"),
        Command(
            robots, "Show well-known robots, identified from public logs", "slipid robots husky"
        ),
        Command(
            reference, "List every key, channel, unit and parameter", "slipid reference channels"
        ),
    ),
    "From logs": (
        Command(
            check,
            "Find mistakes in logs, and what a fit can learn from them",
            "slipid check robot.toml --data logs",
        ),
        Command(
            identify,
            "Calibrate a robot and fit its motors, floors and loads",
            "slipid identify robot.toml --data logs --out out/robot",
        ),
        Command(
            validate,
            "Predict runs that the fit has not seen",
            "slipid validate out/robot --data other --json validation.json",
        ),
        Command(
            report,
            "Write the page of a fit again, with all results since",
            "slipid report out/robot",
        ),
        Command(
            export_run,
            "Write a run and its predictions for Foxglove and rerun",
            "slipid export-run out/robot run000.csv --out run.mcap",
        ),
        Command(
            compare,
            "Find the slip model that predicts best on every floor",
            "slipid compare robot.toml --data logs --out out/compare",
        ),
        Command(
            motor, "Identify a motor on a bench", "slipid motor bench.csv --current I:mA --out out"
        ),
    ),
    "Uncertainty": (
        Command(sample, "Sample the posterior of a fit", "slipid sample out/robot"),
        Command(
            design, "Propose which runs to drive next", "slipid design out/robot --predict gray:0.3"
        ),
        Command(
            selftest,
            "Simulate an experiment, and what it can recover",
            "slipid selftest robot.toml --out out/selftest",
        ),
    ),
    "On the robot": (
        Command(
            export,
            "Write C99, ROS 2, StableHLO and tables for the robot",
            "slipid export out/robot --out out/to_go",
        ),
        Command(
            trial,
            "Drive a simulated robot with every controller",
            "slipid trial out/robot --plant twin",
        ),
    ),
    "Camera": (
        Command(
            calibrate,
            "Calibrate an overhead camera",
            "slipid calibrate boards --board 7x5 --square 0.04 --marker 0.03",
        ),
        Command(
            track,
            "Find the poses of a robot in a video",
            "slipid track run.mp4 --camera camera.json --out run.poses.csv",
        ),
        Command(
            map_,
            "Map the surfaces of a floor from a picture",
            "slipid map floor.png --camera camera.json --out floor",
        ),
        Command(
            floors,
            "Find the floor under each wheel in logged runs",
            "slipid floors out/robot --map map.geojson --data logs --out under",
        ),
    ),
    "Laboratory": (
        Command(
            simulate,
            "Simulate logs on the virtual test site",
            "slipid simulate configs/testsite.toml --out out/site",
        ),
        Command(
            benchmark,
            "Compare slipid with published slip estimators",
            "slipid benchmark --data data --quick",
        ),
        Command(paper, "Reproduce the 2021 paper", "slipid paper --data data --out out/paper"),
    ),
}
"""Commands in the panels of the help."""


@contextmanager
def _short_message() -> Iterator[None]:
    """Return a context in which Typer's messages about wrong usage have no long words."""
    try:
        yield
    except UsageError as error:
        error.message = with_short_words(error.message)
        raise


class CommandHelp(TyperCommand):
    """A command whose help lists its options in panels, as text that is not boxed.

    Its words are checked before they are converted, see `refuse_odd`.
    """

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        with _short_message():
            given, *_ = self.make_parser(ctx).parse_args(args=list(args))
            try:
                if self.callback is not None and not ctx.resilient_parsing:
                    refuse_odd(self.callback, self.get_params(ctx), given)
            except DataError as error:
                typer.echo(str(error), err=True)
                raise typer.Exit(2) from None
            parsed: list[str] = super().parse_args(ctx, args)
            return parsed

    def format_options(self, ctx: Any, formatter: Any) -> None:
        panels: dict[str, list[tuple[str, str]]] = {}
        for one in self.get_params(ctx):
            default = "Arguments" if one.param_type_name == "argument" else "Options"
            record = one.get_help_record(ctx)
            if record is not None:
                panels.setdefault(getattr(one, "rich_help_panel", None) or default, []).append(
                    record
                )
        for panel, records in panels.items():
            with _section(formatter, panel):
                formatter.write_dl(records)


class CommandList(TyperGroup):
    """The group of all commands, whose help lists them in panels, a line each."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        with _short_message():
            parsed: list[str] = super().parse_args(ctx, args)
            return parsed

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        with _short_message():
            return super().resolve_command(ctx, args)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        width = max(len(_name(one)) for commands in PANELS.values() for one in commands)
        for panel, commands in PANELS.items():
            with _section(formatter, panel):
                formatter.write_dl([(_name(one).ljust(width), one.line) for one in commands])

    def format_options(self, ctx: Any, formatter: Any) -> None:
        self.format_commands(ctx, formatter)
        records = [one.get_help_record(ctx) for one in self.get_params(ctx)]
        with _section(formatter, "Options"):
            formatter.write_dl([one for one in records if one is not None])


def _section(formatter: Any, title: str) -> "AbstractContextManager[None]":
    """Return a section of a help, its title in bold letters on a terminal."""
    made: AbstractContextManager[None] = formatter.section(typer.style(title, bold=True))
    return made


def _name(command: Command) -> str:
    # `map_` only keeps the name of Python's built-in map free
    return command.run.__name__.rstrip("_").replace("_", "-")


def _help(command: Command) -> str:
    """Return the help of a command: its example, then its docstring with a line a paragraph."""
    text = cleandoc(command.run.__doc__ or "")
    paragraphs = [re.sub(r"\s*\n\s*", " ", part) for part in text.split("\n\n")]
    return "\n\n".join([f"Example: {command.example}", *paragraphs])


app = typer.Typer(
    name="slipid",
    cls=CommandList,
    # Plain text needs half the lines of rich's boxes, and half the time.
    rich_markup_mode=None,
    no_args_is_help=True,
    epilog="slipid COMMAND --help: an example, and every option of a command",
    pretty_exceptions_enable=False,
)
for panel, commands in PANELS.items():
    for command in commands:
        app.command(
            _name(command),
            cls=CommandHelp,
            help=_help(command),
            short_help=command.line,
            rich_help_panel=panel,
        )(command.run)


def _print_version(wanted: bool) -> bool:
    if wanted:
        typer.echo(f"slipid {__version__}")
        raise typer.Exit
    return wanted


@app.callback()
def slipid(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version."
        ),
    ] = False,
) -> None:
    """Identify the motors, floor friction and wheel loads of a robot from its logs."""


AGAIN_S = 0.05
"""Delay before an interrupt that Python ignored is sent again [s]."""


def main() -> None:
    """Run the `slipid` command; exit with code 2 if standard output cannot be written."""
    sys.unraisablehook = _interrupt_again
    # where its folders cannot be written, matplotlib works all the same
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    out, errors = LossyStream(sys.stdout), LossyStream(sys.stderr)
    sys.stdout, sys.stderr = cast("tuple[TextIO, TextIO]", (out, errors))
    try:
        app()
    finally:
        out.flush()
        if out.lost is not None and out.lost.errno != errno.EPIPE:
            errors.write(f"standard output cannot be written ({out.lost.strerror})\n")
        errors.flush()
        if out.lost is not None:  # a reader such as `head` ends without an error
            sys.exit(1 if out.lost.errno == errno.EPIPE else 2)


class LossyStream:
    """A standard stream whose errors do not stop the work, since its files matter more.

    After an error nothing is written to it any more.

    Attributes:
        lost: the first error, such as that of a full disk or of a reader that has ended; or None.
    """

    def __init__(self, stream: TextIO | None):
        self.lost: OSError | None = None
        # it is None if it was closed
        self._stream = stream or os.fdopen(os.open(os.devnull, os.O_WRONLY), "w")

    def write(self, text: str) -> int:
        """Write a text, and return its length."""
        return self._tried(lambda: self._stream.write(text)) or len(text)

    def flush(self) -> None:
        """Write all that waits for it."""
        self._tried(self._stream.flush)

    def _tried(self, action: Callable[[], int | None]) -> int | None:
        """Return the result of an action; after an error, redirect the stream to nothing."""
        try:
            return action()
        except OSError as error:
            self.lost = self.lost or error
            os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())
            return None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def _interrupt_again(lost: "sys.UnraisableHookArgs") -> None:
    """Send an interrupt again if Python ignored it.

    Python ignores an interrupt that arrives in a finaliser or in a callback of the garbage
    collector (jax has one), where no exception can be raised.
    """
    if lost.exc_type is KeyboardInterrupt:
        again = threading.Timer(AGAIN_S, _thread.interrupt_main)
        again.daemon = True  # so that the program can exit without waiting for the timer
        again.start()
    else:
        sys.__unraisablehook__(lost)
