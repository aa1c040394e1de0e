"""Code shared by commands: types of options, exit codes, and output as text and JSON."""

import functools
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ParamSpec

import typer
from typer.models import OptionInfo

from slipid.support.errors import DataError

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from slipid.report.page import Page
    from slipid.support.progress import Reporter


def option(
    metavar: str,
    words: str,
    *names: str,
    min: float | int | None = None,
    max: float | int | None = None,
) -> OptionInfo:
    """Return an option with a value, for an annotation.

    Args:
        metavar: one word for the value, such as DIR, which the help shows after the option's name.
        words: meaning of the option.
        names: name of the option; by default it is made from the name of the function's parameter.
        min, max: limits of a numeric value.
    """
    made: OptionInfo = typer.Option(*names, metavar=metavar, help=words, min=min, max=max)
    return made


def flag(name: str, words: str) -> OptionInfo:
    """Return an option without a value and without an opposite of the form --no-NAME."""
    made: OptionInfo = typer.Option(name, help=words)
    return made


ConfigFile = Annotated[Path, typer.Argument(metavar="CONFIG", help="Config file (TOML).")]
OutFolder = Annotated[
    Path, typer.Argument(metavar="OUT", help="Result folder of `slipid identify`.")
]
DataFolder = Annotated[
    Path, option("DIR", "Folder of the logs, to which globs in the config refer.")
]
Out = Annotated[Path, option("DIR", "Folder to write to.")]
MaybeOut = Annotated[
    Path | None, option("DIR", "Folder to write to; by default nothing is written.")
]
Load = Annotated[str | None, option("NAME", "Name of the load set-up; the first by default.")]
Jobs = Annotated[
    int | None, typer.Option(min=1, help="Number of parallel processes; by default one per core.")
]
Json = Annotated[
    str | None, option("FILE", "Also write the result as JSON to this file; - for stdout.")
]
Quiet = Annotated[bool, flag("--quiet", "Print no progress.")]
Words = ParamSpec("Words")


def executor_of(jobs: int | None) -> "Executor":
    """Return an executor with `jobs` processes, by default one per core.

    With one job, the work runs in this process.
    """
    from slipid.support.executor import InProcess, Processes

    count = jobs or os.cpu_count() or 1
    return InProcess() if count == 1 else Processes(count)


def can_draw(report: "Reporter") -> bool:
    """Begin the stage of drawing; return False if pictures cannot be drawn, which a line explains.

    A command writes its other results without the package that draws.
    """
    from slipid.support.extras import MissingExtra, require

    try:
        require("matplotlib", "report", "a picture")
    except MissingExtra as error:
        report.line(f"all pictures are left out: {error}")
        return False
    report.stage("drawing")
    return True


def guarded(command: Callable[Words, int]) -> Callable[Words, None]:
    """Return a command that turns exceptions into exit codes.

    For bad input (`DataError`) it prints the message and exits with code 2; after an interrupt it
    exits with code 130.
    """

    @functools.wraps(command)
    def run(*args: Words.args, **options: Words.kwargs) -> None:
        try:
            code = command(*args, **options)
        except KeyboardInterrupt:
            typer.echo(
                "interrupted; the same command continues from the last checkpoint, if there is one",
                err=True,
            )
            raise typer.Exit(130) from None
        except DataError as error:
            typer.echo(str(error), err=True)
            raise typer.Exit(2) from None
        raise typer.Exit(code)

    return run


def for_robots(command: Callable[Words, int]) -> Callable[Words, None]:
    """Return a guarded command that refuses the config or result of motors on a bench.

    The config or result folder is taken to be the first path among the arguments of the command.
    See `guarded` for the exit codes.
    """

    @functools.wraps(command)
    def checked(*args: Words.args, **options: Words.kwargs) -> int:
        paths = (value for value in (*args, *options.values()) if isinstance(value, Path))
        if (first := next(paths, None)) is not None and is_bench(first):
            name = command.__name__.replace("_", "-")
            raise DataError(
                f"{first}: drive = 'motor' describes motors on a bench, for which `slipid "
                f"{name}` is not made; expected `slipid check`, `identify` or "
                "`motor`. The config of a robot can use the result by [robot] motor = 'FILE'"
            )
        return command(*args, **options)

    return guarded(checked)


def is_bench(path: Path) -> bool:
    """Return True if a config, or the config in a result folder, describes motors on a bench."""
    import tomllib

    if path.is_dir():
        if (path / "motor.json").is_file() and not (path / "config.toml").is_file():
            return True
        path = path / "config.toml"
    try:
        robot = tomllib.loads(path.read_text(encoding="utf-8")).get("robot")
    except (OSError, ValueError):  # the command itself reports the error
        return False
    return isinstance(robot, dict) and robot.get("drive") == "motor"


def emit(
    json: str | None,
    content: object,
    show: Callable[["Page"], None],
    out: Path | None = None,
    written: Sequence[str] = (),
) -> None:
    """Print a result for people, and write it as JSON if the option `--json` is given.

    Args:
        json: file for the JSON; `-` writes it to stdout, and then nothing else is printed; None for
            no JSON.
        content: content of the JSON.
        show: function that prints the result as text.
        out: folder to which the command wrote files, or None.
        written: names of these files, to be printed.
    """
    from slipid.report.page import Page
    from slipid.support.files import json_text, write_json

    if json == "-":
        sys.stdout.write(json_text(content))
        return
    if json is not None:
        write_json(Path(json), content)
    page = Page()
    show(page)
    if out is not None:
        page.line(f"in {out}: {', '.join(written)}")
