"""The demo: logs of the virtual test site, the main job on them, and how near it came."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

import numpy as np

from slipid.app import commands, runtime
from slipid.app.progress import Reporter
from slipid.data.files import read_json, write_bytes, write_json
from slipid.data.log import DataError

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


def packaged_config(name: str) -> str:
    """Text of a config that ships with slipid."""
    import slipid

    package = Path(slipid.__file__).parent
    # beside the package in a clone, inside it in an installation
    for folder in (package / "configs", package.parent / "configs"):
        if (folder / name).is_file():
            return (folder / name).read_text(encoding="utf-8")
    raise FileNotFoundError(f"{name} is missing from this installation of slipid")


def demo(
    out: Path, plant: str, seed: int | None, jobs: int, report: Reporter
) -> tuple[Any, dict[str, Any], list[Row]]:
    """Logs of the test site, identify, predict unseen runs; fit, validation and comparison.

    Args:
        out: folder to write to.
        plant: `recorded` for the logs that ship with slipid, `mujoco` to drive them anew.
        seed: of the runs that are driven anew, by default that of the recorded ones.
        jobs: processes that drive at once.
        report: progress.

    Raises:
        DataError: no such plant, a seed for what is recorded, or MuJoCo is missing.
    """
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
    runtime.start()
    write_bytes(out / "robotino.toml", packaged_config("robotino.toml").encode())
    result = out / "result"
    done = commands.identify(out / "robotino.toml", source / "fit" / "logs", result, report)
    found = commands.validate(result, source / "unseen" / "logs", report)
    write_json(result / "validation.json", found)
    truth = read_json(
        source / "fit" / "truth" / "truth.json", "the truth that slipid simulate wrote"
    )
    known = {path: p["value"] for path, p in truth["parameters"].items()}
    return done, found, compared(done.fit, known)


def unpack(out: Path) -> None:
    """Write the recorded logs, their truth and nothing else below a folder.

    Raises:
        DataError: the recording is missing from this installation.
    """
    try:
        archive = ZipFile(RECORDED)
    except OSError as error:
        raise DataError(f"{RECORDED}: {error.strerror}; expected the recorded logs") from error
    with archive:
        for name in archive.namelist():
            write_bytes(out / name, archive.read(name))


def pack(folder: Path, archive: Path = RECORDED) -> None:
    """Make the recording from a folder that `drive_anew` wrote; same files, same bytes."""
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
    from slipid.app.simulate import simulate
    from slipid.app.simulate_config import plan

    for k, part in enumerate(PARTS):
        name = f"testsite_{part}.toml"
        text = packaged_config(name).replace(f"seed = {k}\n", f"seed = {2 * seed + k}\n")
        simulate(plan(Path(name), text), out / part, jobs, report)


def compared(fit: Any, known: Mapping[str, Any]) -> list[Row]:
    """Every number that was fitted beside its truth, as far as there is one.

    Args:
        fit: what `identify` found.
        known: true value of each path, one number or a list.
    """
    rows = []
    for e in fit.parameters.values():
        if e.verdict == "fixed" or e.path not in known:
            continue
        values = e.value if e.labels else [e.value]
        intervals = e.interval90 if e.labels else [e.interval90]
        labels = e.labels or ("",)
        truths = np.atleast_1d(np.asarray(known[e.path], float))
        for label, truth, value, interval in zip(labels, truths, values, intervals, strict=True):
            rows.append(Row(e.path, label, e.unit, float(truth), value, tuple(interval), e.verdict))
    return rows


def real_logs() -> Path | None:
    """Folder of real logs, where this machine has them: SLIPID_DATA, else ../shared/data."""
    for folder in (os.environ.get("SLIPID_DATA"), "../shared/data"):
        if folder and (Path(folder) / "robotino2022").is_dir():
            return Path(folder)
    return None
