"""`slipid demo`: logs of the virtual test site, the main job on them, and how near it came."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slipid.cli.common import Out, Quiet, guarded
from slipid.support.content import Content
from slipid.support.errors import DataError
from slipid.support.progress import Reporter

if TYPE_CHECKING:
    from slipid.identify.result import Fit
    from slipid.job.identify import Identified

PARTS = ("fit", "unseen")
"""What is fitted, and what is predicted: folders, and configs `testsite_<part>.toml`."""
RECORDED = Path(__file__).with_name("recorded.zip")
"""Logs of the test site that ship with slipid."""


@dataclass(frozen=True)
class Row:
    """Truth against estimate of one number."""

    path: str
    label: str
    unit: str
    truth: float
    value: float
    interval: tuple[float, float]
    verdict: str

    @property
    def inside(self) -> bool:
        """Whether the 90 % interval holds the truth."""
        return self.interval[0] <= self.truth <= self.interval[1]


@dataclass(frozen=True, eq=False)
class Shown:
    """End of the demo."""

    done: "Identified"
    validation: Content
    rows: tuple[Row, ...]


@guarded
def demo(
    out: Out = Path("demo_out"),
    plant: Annotated[
        str, typer.Option(metavar="NAME", help="recorded, or mujoco to drive the logs anew.")
    ] = "recorded",
    seed: Annotated[
        int | None, typer.Option("--seed", min=0, help="Of the runs that are driven anew.")
    ] = None,
    quiet: Quiet = False,
) -> int:
    """The whole job on logs of the virtual test site, small: a folder to look at."""
    with Reporter(quiet=quiet) as report:
        shown = run(out, plant, seed, os.cpu_count() or 1, report)
    show(shown, out)
    return 0 if shown.done.fit.converged else 1


def run(out: Path, plant: str, seed: int | None, jobs: int, report: Reporter) -> Shown:
    """Logs of the test site, identify, predict unseen runs, compare with the truth.

    Raises:
        DataError: no such plant, a seed for what is recorded, or MuJoCo is missing.
    """
    from slipid.cli.identify import run as identify
    from slipid.cli.validate import run as validate
    from slipid.support.files import read_json, write_bytes, write_json

    if plant not in ("recorded", "mujoco"):
        raise DataError(f"no plant '{plant}'; expected recorded or mujoco")
    if plant == "recorded" and seed is not None:
        raise DataError("--seed is for runs that are driven anew; expected --plant mujoco with it")
    source = out / plant
    if plant == "recorded":
        report.stage("unpacking recorded logs")
        unpack(source)
    else:
        drive_anew(source, seed or 0, jobs, report)
    write_bytes(out / "robotino.toml", packaged_config("robotino.toml").encode())
    result = out / "result"
    done = identify(out / "robotino.toml", source / "fit" / "logs", result, report)
    found = validate(result, source / "unseen" / "logs", report).content
    write_json(result / "validation.json", found)
    truth = read_json(source / "fit/truth/truth.json", "the truth that slipid simulate wrote")
    known = {path: p["value"] for path, p in truth["parameters"].items()}
    return Shown(done, found, tuple(compared(done.fit, known)))


def packaged_config(name: str) -> str:
    """Text of a config that ships with slipid."""
    import slipid

    package = Path(slipid.__file__).parent
    # beside the package in a clone, inside it in an installation
    for folder in (package / "configs", package.parent / "configs"):
        if (folder / name).is_file():
            return (folder / name).read_text(encoding="utf-8")
    raise FileNotFoundError(f"{name} is missing from this installation of slipid")


def unpack(out: Path) -> None:
    """Write the recorded logs, their truth and nothing else below a folder.

    Raises:
        DataError: the recording is missing from this installation.
    """
    from zipfile import ZipFile

    from slipid.support.files import write_bytes

    try:
        archive = ZipFile(RECORDED)
    except OSError as error:
        raise DataError(f"{RECORDED}: {error.strerror}; expected the recorded logs") from error
    with archive:
        for name in archive.namelist():
            write_bytes(out / name, archive.read(name))


def pack(folder: Path, archive: Path = RECORDED) -> None:
    """Make the recording from a folder that `drive_anew` wrote; same files, same bytes."""
    from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

    from slipid.support.files import write_bytes

    wanted = [p for part in PARTS for p in (folder / part / "logs").rglob("*.csv")]
    wanted += [folder / part / "truth" / "truth.json" for part in PARTS]
    content = BytesIO()
    with ZipFile(content, "w") as file:
        for path in sorted(wanted):
            info = ZipInfo(path.relative_to(folder).as_posix())
            file.writestr(info, path.read_bytes(), ZIP_DEFLATED, 9)
    write_bytes(archive, content.getvalue())


def drive_anew(out: Path, seed: int, jobs: int, report: Reporter) -> None:
    """Drive the runs that ship recorded, and those to be predicted, on the test site.

    Raises:
        DataError: MuJoCo is missing, or the folder holds runs of another seed.
    """
    from slipid.testsite.simulate.config import plan
    from slipid.testsite.simulate.simulate import simulate

    for k, part in enumerate(PARTS):
        name = f"testsite_{part}.toml"
        text = packaged_config(name).replace(f"seed = {k}\n", f"seed = {2 * seed + k}\n")
        simulate(plan(Path(name), text), out / part, jobs, report)


def compared(fit: "Fit", known: Mapping[str, float | list[float]]) -> list[Row]:
    """Every number that was fitted beside its truth, as far as there is one."""
    from slipid.report.estimates import rows_of

    rows = []
    for e in fit.parameters.values():
        if e.verdict == "fixed" or e.path not in known:
            continue
        true = known[e.path]
        truths = true if isinstance(true, list) else [true]
        for truth, (label, value, interval) in zip(truths, rows_of(e), strict=True):
            low, high = interval or (value, value)
            rows.append(Row(e.path, label, e.unit, float(truth), value, (low, high), e.verdict))
    return rows


def show(shown: Shown, out: Path) -> None:
    """Print truth against estimate, the prediction of unseen runs, and where to look."""
    from rich.text import Text

    from slipid.cli.validate import show as show_validation
    from slipid.report.page import Page, table, verdict

    page, rows, result = Page(), shown.rows, out / "result"
    columns = ("parameter", "truth", "identified", "unit", "90 % interval", "truth in it", "")
    made = table(columns, right=("truth", "identified"))
    for r in rows:
        made.add_row(
            Text(f"{r.path} [{r.label}]" if r.label else r.path),
            f"{r.truth:.4g}",
            f"{r.value:.4g}",
            r.unit,
            f"{r.interval[0]:.4g} .. {r.interval[1]:.4g}",
            "yes" if r.inside else "no",
            verdict(r.verdict),
        )
    page.table(made)
    page.line(
        f"{sum(r.inside for r in rows)} of {len(rows)} intervals hold the truth: the logs come "
        "from another physics (MuJoCo's rollers) than the model's, and intervals know nothing of "
        "that\n"
    )
    page.line("runs it has not seen, predicted open loop:")
    show_validation(shown.validation)
    pictures = [result / name for name in shown.done.written if name.endswith(".png")]
    pictures += sorted(result.glob("validation_*.png"))
    page.line(f"\nlook at: {', '.join(map(str, pictures))}")
    page.line(f"numbers: {result / 'identified.json'}, {result / 'validation.json'}")
