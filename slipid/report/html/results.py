"""Results of a fit in a folder, as far as commands have written them so far."""

import hashlib
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from slipid.infer.result_content import AGAIN, IdentifiedContent, RunContent, checked_result
from slipid.infer.result_folder import (
    CONFIG,
    FIT,
    IDENTIFIED,
    config_text,
    fit_of,
    refuse_other_fit,
)
from slipid.report.html.evidence import EVIDENCE, FitEvidence, read_evidence
from slipid.report.html.later_content import COMMANDS, LATER, ShownFitContent
from slipid.support.content import Content
from slipid.support.errors import DataError, bad_data, refused_as
from slipid.support.files import read_bytes, read_json
from slipid.support.toml_file import mapping_of

RESULT = "a result of `slipid identify`"
DRAWS = "posterior.nc"
MOST_DRAWS = 1500
"""Largest number of draws of a posterior that are shown."""
MOST_NUMBERS = 2**26
"""Largest number of values in posterior.nc."""
MOST_BYTES = 2**30
"""Largest size of posterior.nc [bytes]."""
PARTS = ("motor", "camera", "robot", "surface")
"""Parts of a robot whose parameters are shown."""


@dataclass(frozen=True, eq=False)
class Results:
    """Contents of the files in a result folder; None for a file that is absent.

    Files of a different fit, and a comparison of other logs, are not read.

    Attributes:
        folder: the result folder.
        drive: type of the robot's wheels, as in its config.
        identified: content of identified.json.
        run: content of run.json.
        fit: content of fit.json; None for a calibration alone.
        evidence: evidence of the logs.
        validation, comparison, trial, design, sample: contents of these commands' files.
        draws: draws of the posterior, keyed by parameter.
        exports: names of the folders, below the result folder, that `slipid export` wrote.
        has_robot: True if the folder has robot.json.
        outdated: names of files of a different fit or of other logs, which are left out.
    """

    folder: Path
    drive: str
    identified: Content
    run: Content
    fit: Content | None
    evidence: FitEvidence | None
    validation: Content | None
    comparison: Content | None
    trial: Content | None
    design: Content | None
    sample: Content | None
    draws: dict[str, np.ndarray] | None
    exports: tuple[str, ...]
    has_robot: bool
    outdated: tuple[str, ...]

    @property
    def parameters(self) -> Content:
        """Every parameter with its prior, keyed by path; empty for a calibration alone.

        Values and intervals are those of identified.json, which has those of the posterior, if
        there is one.
        """
        priors = {} if self.fit is None else self.fit["parameters"]
        return {p: priors.get(p, {}) | e for p, e in self.identified["parameters"].items()}

    @property
    def calibration(self) -> Content | None:
        """PageSection `calibration` of identified.json."""
        found: Content | None = self.identified.get("calibration")
        return found

    @property
    def trust(self) -> Content:
        """PageSection `trust` of identified.json; empty for a fit without calibrated kinematics."""
        found: Content = self.identified.get("trust", {})
        return found

    @property
    def floors(self) -> list[str]:
        """Names of the identified floors."""
        return list(self.identified["surfaces"])

    @property
    def selected(self) -> Content:
        """Name of the selected model, keyed by floor."""
        found: Content = self.identified.get("selected_model", {})
        return found


def read_results(out: Path) -> Results:
    """Return the results in a folder.

    Raises:
        DataError: the folder has no result of `slipid identify`, or a file in it is damaged or
            belongs to another fit.
    """
    fit = fit_of(out)
    identified, run = _content(out / IDENTIFIED, RESULT), _content(out / "run.json", RESULT)
    checked_result(out / IDENTIFIED, identified, IdentifiedContent)
    checked_result(out / "run.json", run, RunContent)
    evidence = read_evidence(out / EVIDENCE) if (out / EVIDENCE).exists() else None
    if evidence is not None:
        refuse_other_fit(out, out / EVIDENCE, evidence.fit)
    if evidence is not None and evidence.data_hash != identified["data"]["hash"]:
        raise DataError(
            f"{out / EVIDENCE}: of other logs than {IDENTIFIED} beside it; run `slipid identify` "
            "again"
        )
    outdated = _outdated(out, fit, identified["data"]["hash"])
    later = {name: None if name in outdated else _later(out, name) for name in LATER}
    return Results(
        folder=out,
        drive=_drive(out),
        identified=identified,
        run=run,
        fit=_maybe(out / FIT, ShownFitContent, AGAIN),
        evidence=evidence,
        **later,
        draws=_draws(out, later["sample"]),
        exports=tuple(sorted(p.parent.name for p in out.glob("*/SHA256SUMS"))),
        has_robot=(out / "robot.json").exists(),
        outdated=outdated,
    )


def _drive(out: Path) -> str:
    """Return the type of wheels in the config of a fit; empty if it names none."""
    robot = mapping_of(out / CONFIG, config_text(out)).get("robot")
    return str(robot.get("drive", "")) if isinstance(robot, dict) else ""


def _content(path: Path, what: str) -> Content:
    found = read_json(path, what)
    if not isinstance(found, dict):
        raise DataError(f"{path}: expected {what}")
    return found


def _outdated(out: Path, fit: str | None, data_hash: object) -> tuple[str, ...]:
    """Return the names of later commands whose files are of a different fit, or of other logs.

    Files of older versions, which do not name their fit, are of it if they are not older.
    """
    made = (out / IDENTIFIED).stat().st_mtime

    def is_of_fit(name: str) -> bool:
        path = out / f"{name}.json"
        found = _content(path, "the result of a command of slipid") if path.exists() else {}
        if name != "comparison":
            mark = found.get("fit")
            return mark == fit if mark is not None else not found or path.stat().st_mtime >= made
        of = found.get("data")  # a comparison is made from logs, without the fit
        return not isinstance(of, dict) or of.get("hash") == data_hash

    return tuple(name for name in LATER if not is_of_fit(name))


def _later(out: Path, name: str) -> Content | None:
    """Return the content of the file of a later command, or None if it is absent."""
    again = f"run `slipid {COMMANDS.get(name, name)}` again"
    return _maybe(out / f"{name}.json", LATER[name], again)


def _maybe(path: Path, kind: type, again: str) -> Content | None:
    """Return the content of a JSON file, or None if it is absent; `again` is a remedy."""
    if not path.exists():
        return None
    content = _content(path, "the result of a command of slipid")
    checked_result(path, content, kind, again)
    return content


def _draws(out: Path, sample: Content | None) -> dict[str, np.ndarray] | None:
    """Return the draws of scalar parameters in posterior.nc, keyed by path, chain after chain.

    Args:
        out: folder of the results.
        sample: content of the sample.json of this fit, which has the hash of the draws' file: HDF5
            never ends with some damaged files.

    Returns:
        None if there is no such content or file, or if h5py, which reads it, is not installed.
    """
    path = out / DRAWS
    if sample is None or not path.exists():
        return None
    try:
        import h5py
    except ImportError:
        return None
    expected = "draws that `slipid sample` wrote; run it again"
    raw = read_bytes(path, expected, MOST_BYTES)
    if hashlib.sha256(raw).hexdigest() != sample["posterior_sha256"]:
        raise bad_data(path, "damaged, or of a different chain than sample.json", expected)
    arrays: dict[str, np.ndarray] = {}
    with refused_as(path, expected), h5py.File(BytesIO(raw)) as file:
        group: Any = file["posterior"]
        if sum(one.size for one in group.values()) > MOST_NUMBERS:
            raise bad_data(path, f"over {MOST_NUMBERS} numbers", expected)
        floors = [name.decode() for name in group["surface"][:].tolist()]
        for name, one in group.items():
            if one.dtype == float and name.partition(".")[0] in PARTS:
                arrays[name] = one[:]
    found: dict[str, np.ndarray] = {}
    for name, values in arrays.items():
        part, _, rest = name.partition(".")
        if values.ndim == 2 and part != "surface":
            found[name] = values.ravel()
        elif values.ndim == 3 and part == "surface" and values.shape[2] == len(floors):
            for k, floor in enumerate(floors):
                found[f"surface.{floor}.{rest}"] = values[:, :, k].ravel()
    sizes = {len(x) for x in found.values()}
    if len(sizes) != 1 or 0 in sizes or not all(np.isfinite(x).all() for x in found.values()):
        raise bad_data(path, f"{sorted(sizes)} draws of parameters, or not finite ones", expected)
    step = max(1, sizes.pop() // MOST_DRAWS)
    return {name: x[::step] for name, x in found.items()}
