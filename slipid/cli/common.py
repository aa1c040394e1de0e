"""Code shared by commands: types of options, exit codes, and output as text and JSON."""

import functools
import os
import shlex
import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Annotated, NamedTuple, ParamSpec

import typer
from typer.models import OptionInfo

from slipid.support.errors import DataError, shown
from slipid.support.quantities import limits_of

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
    kind: object = None,
) -> OptionInfo:
    """Return an option with a value, for an annotation.

    Args:
        metavar: one word for the value, such as DIR, which the help shows after the option's name.
        words: meaning of the option.
        names: name of the option; by default it is made from the name of the function's parameter.
        min, max: limits of a numeric value.
        kind: kind of number in `slipid.support.quantities`, whose bounds are the limits.
    """
    if kind is not None:
        min, max = limits_of(kind).low, limits_of(kind).high
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
    int | None,
    typer.Option(min=1, max=1024, help="Number of parallel processes; by default one per core."),
]
SCHEMAS = {
    "calibrate": ("camera",),
    "compare": ("comparison",),
    "export": ("export", "export_check"),
    "identify": ("identified",),
    "map_": ("map_result",),
    "motor": ("identified",),
    "robots": ("reference", "references"),
    "sample": ("identified",),
    "simulate": ("simulation",),
    "validate": ("validation",),
}
"""Names of the schemas of the JSON that commands write, keyed by the name of the function; the
schemas of others have its own name."""
OUTPUTS = frozenset(("json", "out", "preview"))
"""Options whose values are written to."""
LONGEST_NAME = 255
"""Length of the longest name of a file or a folder [bytes]."""
MOST_SEED = 2**32 - 1
"""Largest seed of random numbers."""
Json = Annotated[
    str | None, option("FILE", "Also write the result as JSON to this file; - for stdout.")
]
Quiet = Annotated[bool, flag("--quiet", "Print no progress.")]
Words = ParamSpec("Words")
FIRST = ("report.html", "benchmark.html", "paths.png", "validation_paths.png")
"""Names of files at which to look first, the best one first."""


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
            _check_json(SCHEMAS.get(command.__name__, (command.__name__,)), options)
            _refuse_own_input(options)
            _check_names(options)
            _refuse_nan(options)
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


def _check_json(schemas: Sequence[str], options: Mapping[str, object]) -> None:
    """Raise `DataError` unless the option `json` is `-`, None or the name of a file to write.

    This is checked first, as the file is written after the work. A file that is there must be JSON
    of the same command, and may only be in a result folder if this is `out`.

    Args:
        schemas: names of the schemas of the command's JSON.
        options: values of all options by name.
    """
    name = options.get("json")
    if not isinstance(name, str) or name == "-":
        return
    from slipid.support.files import target_of

    odd = any(c in "*?" or not c.isprintable() for c in name)
    if not name or odd or name.startswith(("-", "~")):
        raise DataError(
            f"--json {name[:80]!r}: no name of a file; expected a path without * and ?, or - for "
            "standard output (./ before a name that begins with - or ~)"
        )
    try:
        target = target_of(Path(name))
    except DataError as error:
        raise DataError(f"--json {error}, or - for standard output") from error
    _refuse_other_json(target, schemas)
    out = options.get("out")
    if target.exists() and not (isinstance(out, Path) and target.parent.samefile(out)):
        from slipid.infer.result_folder import FIT, IDENTIFIED, WRITTEN

        beside = (target.parent / one for one in (FIT, IDENTIFIED))
        if target.name in WRITTEN and any(map(Path.exists, beside)):
            raise DataError(
                f"--json {name}: belongs to the results in {target.parent}, and would be "
                "overwritten; expected the name of a new file"
            )


def _refuse_other_json(path: Path, schemas: Sequence[str]) -> None:
    """Raise `DataError` if a file exists that is not empty and has none of some schemas."""
    from slipid.support.files import read_json

    if not path.exists() or not path.stat().st_size:
        return
    try:
        found = read_json(path, "JSON")
    except DataError:
        found = None
    schema = str(found.get("schema", "")) if isinstance(found, dict) else ""
    if schema.removeprefix("slipid.").split("/")[0] not in schemas:
        raise DataError(
            f"--json {path}: a file that `--json` of this command did not write, and would be "
            "overwritten; expected the name of a new file"
        )


def _refuse_own_input(options: Mapping[str, object]) -> None:
    """Raise `DataError` if a file to write to is also the file of a different option."""
    files = {
        key: os.path.realpath(value)
        for key, value in options.items()
        if isinstance(value, Path) or (key in ("json", "source") and isinstance(value, str))
    }
    for written in OUTPUTS & files.keys():
        for key in files.keys() - {written}:
            if files[key] == files[written] and not os.path.isdir(files[key]):
                raise DataError(
                    f"--{written} {shown(str(options[written]))}: also the file of "
                    f"{key.replace('_', '-')}, and would be overwritten; expected a different name"
                )


def _check_names(options: Mapping[str, object]) -> None:
    """Raise `DataError` for a path with too long a name or ~, and control characters in `out`."""
    if not (out := str(options.get("out", ""))).isprintable():
        raise DataError(f"{shown(out)}: a name to write to; expected printable characters")
    for path in (value for value in options.values() if isinstance(value, Path)):
        if path.parts[:1] == ("~",):
            raise DataError(
                f"{shown(str(path))}: the shell did not replace the ~; expected a whole path"
            )
        if max(map(len, map(os.fsencode, path.parts)), default=0) > LONGEST_NAME:
            raise DataError(
                f"{shown(str(path))}: a name of over {LONGEST_NAME} bytes; expected a shorter one"
            )


def _refuse_nan(options: Mapping[str, object]) -> None:
    """Raise `DataError` for an option that is NaN, which is within any limits of Typer."""
    for name, value in options.items():
        if isinstance(value, float) and value != value:
            raise DataError(f"--{name.replace('_', '-')}: nan; expected a number")


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
    from slipid.support.toml_file import mapping_of, text_of

    if path.is_dir():
        if (path / "motor.json").is_file() and not (path / "config.toml").is_file():
            return True
        path = path / "config.toml"
    try:
        robot = mapping_of(path, text_of(path)).get("robot")
    except DataError:  # the command itself reports the error
        return False
    return isinstance(robot, dict) and robot.get("drive") == "motor"


class Next(NamedTuple):
    """A command that is suggested at the end of another one.

    Attributes:
        purpose: what it is for, as an imperative.
        words: its name, arguments and options.
    """

    purpose: str
    words: tuple[object, ...]


def renew(out: Path) -> Next:
    """Return the suggestion to write the page of a result folder again."""
    return Next("see it on the page, with all other results", ("report", out))


def emit(
    json: str | None,
    content: object,
    show: Callable[["Page"], None],
    following: Sequence[Next],
    out: Path | None = None,
    written: Sequence[str] = (),
) -> None:
    """Print a result for people, and write it as JSON if the option `--json` is given.

    Args:
        json: file for the JSON; `-` writes it to stdout, and then nothing else is printed; None for
            no JSON.
        content: content of the JSON.
        show: function that prints the result as text.
        following: commands to suggest.
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
    kept = [name for name in written if name.endswith(".html")]
    kept += [name for name in written if name.endswith(".json")]
    page = Page(rest=str(out / kept[0]) if out and kept else json or "the file of --json FILE")
    show(page)
    page.end()
    if out is not None:
        _show_files(page, out, written)
    suggest(following)


def _show_files(page: "Page", out: Path, written: Sequence[str]) -> None:
    """Print where to look first among files that a command wrote, and the names of the others."""
    pictures = [name for name in written if name.endswith((".html", ".png"))]
    order = [name for name in FIRST if name in pictures] or pictures
    first = order[0] if order else written[0]
    page.line(f"in {out}: {'look first at ' if order else ''}{first}")
    others = ", ".join(name for name in written if name != first)
    for line in wrap(others, 76, break_long_words=False, break_on_hyphens=False):
        page.line(f"  {line}")


def suggest(following: Sequence[Next]) -> None:
    """Print commands to type next."""
    for purpose, words in following:
        typer.echo(f"next, {purpose}:\n  {program()} {shlex.join(map(str, words))}")


def program() -> str:
    """Return how slipid was called, so that a suggested command can be typed in the same place."""
    called = Path(sys.argv[0])
    if called.parts[-2:] == ("slipid", "__main__.py"):
        return "python -m slipid"
    found = shutil.which("slipid")
    known = found is not None and called.exists() and Path(found).samefile(called)
    return shlex.quote(sys.argv[0]) if called.name == "slipid" and not known else "slipid"
