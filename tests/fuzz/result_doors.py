"""Doors of what slipid writes itself: fits, robots, draws, checkpoints, and what is exported."""

from __future__ import annotations

import fcntl
import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from slipid.app.calibrate import read_calibration
from slipid.app.logs import log_folder
from slipid.deploy.deploy import read_robot
from slipid.exports.folder import check_folder
from slipid.exports.stablehlo import load_program
from slipid.infer.fit_file import load
from slipid.report.html.evidence import read_evidence
from slipid.report.html.fit_page import fit_page, write_report
from slipid.report.html.results import read_results
from slipid.robot.filter.floor import Floor
from slipid.robot.record import RobotRecord
from slipid.robot.robot_file import typed
from slipid.support.checkpoint import Checkpoint
from slipid.support.errors import DataError
from slipid.support.files import checksum
from tests.fuzz.door import Door, Files, Silent
from tests.helpers.later_files import COMPARISON, LATER

HERE = Path()
OUT = Path(__file__).resolve().parents[2] / ".cache" / "fuzz" / "out"
"""Folder with the result of `slipid identify` and `sample`; made where it is absent (minutes)."""
EXPORTED = OUT.parent / "exported"
LABELS = ("firm", "soft")
ARRAYS = {"z": np.linspace(0.0, 1.0, 7), "round": np.asarray(4), "stage": np.asarray("joint")}
PLAIN = {"x": 0.25, "rows": [1.0, None, "a"], "inner": {"k": [1, 2, 3]}}
_PROGRAM = ("*.stablehlo", "*.json", "*.npz")
_RESULT = ("*.json", "*.npz", "posterior.nc", "config.toml")


def _kept(folder: Path, check: Callable[[Path], Any], make: Callable[[Path], Any]) -> Path:
    """Return a folder that was made before, made anew where this version does not read it.

    Of several processes that need it, one makes it.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    with (folder.parent / f"{folder.name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        try:
            check(folder)
        except DataError:
            if ".cache" not in folder.parts:
                raise
            shutil.rmtree(folder, ignore_errors=True)
            make(folder)
    return folder


def _make_out(out: Path) -> None:
    from tests.helpers.shared import identify, sample

    small = out.parent / "small"
    shutil.rmtree(small, ignore_errors=True)
    small.mkdir(parents=True)
    identify(small)
    sample(small / "out", out)


def _made_out() -> Path:
    """Return the folder of results, made by the commands if it is not there."""
    return _kept(OUT, lambda out: (load(out), read_results(out), read_robot(out)), _make_out)


def _results(*patterns: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        for pattern in patterns or _RESULT:
            for path in _made_out().glob(pattern):
                shutil.copy(path, folder)

    return make


def _mapping(raw: bytes) -> dict[str, Any] | None:
    try:
        content = json.loads(raw)
    except (ValueError, RecursionError):
        return None
    return content if isinstance(content, dict) else None


def _sealed_fit(files: Files) -> Files:
    """Mend the hash of the arrays and the checksum of the fit."""
    content = _mapping(files["fit.json"])
    if content is None:
        return files
    content.pop("checksum", None)
    arrays = content.get("arrays")
    if isinstance(arrays, dict) and isinstance(arrays.get("file"), str):
        packed = files.get(arrays["file"], b"")
        arrays["sha256"] = hashlib.sha256(packed).hexdigest()
    try:
        mark = checksum(content)
        sealed = json.dumps(content | {"checksum": mark}).encode()
        table = json.dumps(json.loads(files["identified.json"]) | {"fit": mark}).encode()
    except (TypeError, ValueError, RecursionError):
        return files
    return {**files, "fit.json": sealed, "identified.json": table}


def _sealed_robot(files: Files) -> Files:
    """Mend the checksum of the robot, and the hash of its numbers where it can be computed."""
    content = _mapping(files["robot.json"])
    if content is None:
        return files
    content.pop("checksum", None)
    try:
        own = {k: v for k, v in content.items() if k not in ("schema", "units", "numbers")}
        content["numbers"] = typed(RobotRecord, own).numbers
    except Exception:  # a record that cannot be read has no numbers
        pass
    try:
        sealed = json.dumps(content | {"checksum": checksum(content)}).encode()
    except (TypeError, ValueError, RecursionError):
        return files
    return {**files, "robot.json": sealed}


def _robot(path: Path) -> Any:
    robot = read_robot(path)
    return robot, robot.record


def _page(path: Path) -> Any:
    from slipid.support.files import read_json

    write_report(HERE)
    (HERE / "report.html").unlink()
    return read_json(HERE / "identified.json", "a result")["derived"]


def _later(folder: Path) -> None:
    _results()(folder)
    fit, logs = (json.loads((folder / "identified.json").read_text())[k] for k in ("fit", "data"))
    contents = {name: {"fit": fit, **one} for name, one in LATER.items() if name != "sample"}
    contents["comparison"] = {"data": {"hash": logs["hash"]}, **COMPARISON}
    for name, content in contents.items():
        (folder / f"{name}.json").write_text(json.dumps(content), encoding="utf-8")


def _later_page(path: Path) -> Any:
    found = read_results(HERE)
    fit_page(found)
    return found.validation, found.trial, found.comparison, found.design


def _checkpoint(folder: Path) -> None:
    kept = Checkpoint(folder, "K")
    kept.save("a", ARRAYS)
    kept.save_json("a", PLAIN)


def _arrays(path: Path) -> None:
    # an array that was exchanged with its checksum by hand is not distinguished from a good one
    Checkpoint(HERE, "K").load("a")


def _fit(path: Path) -> Any:
    fit = load(HERE)
    numbers = fit.z, fit.covariance, fit.laplace, fit.variance, fit.lag, fit.curves, fit.parameters
    return numbers, fit.derived, fit.robot, fit.calibration, fit.shared, fit.selection, fit.chain


def _plain(path: Path) -> None:
    found = Checkpoint(HERE, "K").load_json("a")
    if found not in (None, PLAIN):
        raise Silent("a damaged checkpoint is used")


def _floor(folder: Path) -> None:
    cells = np.tile([[0, 1, 1], [0, 0, -1]], (4, 4))
    Floor.of((*LABELS, ""), cells, (-1.0, -0.5), 0.05, LABELS).save(folder / "floor.npz", LABELS)


def _loaded_floor(path: Path) -> Any:
    floor = Floor.load(path, LABELS)
    cells, corner, cell = (np.asarray(x) for x in (floor.cells, floor.corner, floor.cell))
    if cells.ndim != 2 or not cells.size or corner.shape != (2,) or cell.shape or cell <= 0:
        raise Silent(f"a floor of shape {cells.shape}, corner {corner.shape}, cell {cell.shape}")
    if cells.dtype.kind != "i" or cells.min() < -1 or cells.max() >= len(LABELS):
        raise Silent("cells with surfaces that the robot does not have")
    return corner, cell


def _exported(folder: Path) -> None:
    """Copy an exported program, which takes long to compile when it is made."""
    shutil.copytree(_kept(EXPORTED, load_program, _export), folder / "stablehlo")


def _export(folder: Path) -> None:
    from slipid.deploy.controllers import control_loop_of
    from slipid.exports.folder import write_folder
    from slipid.exports.stablehlo import stablehlo_files
    from slipid.lab.trial.controllers import ROWS
    from tests.helpers import small_twin

    loop = control_loop_of(small_twin.deployed(1.0, 1.0, 0.3), ROWS["slip_odometry"])
    write_folder(folder, stablehlo_files(loop))


def _program(path: Path) -> None:
    load_program(path.parent)  # its state may hold nan, for what was not measured yet


FITS = (
    Door("fit", _results(), _fit, ("fit.json", "identified.json"), weight=0.2),
    Door("fit_sealed", _results(), _fit, ("fit.json",), _sealed_fit, 0.5),
    Door("fit_arrays", _results(), _fit, ("fit*.npz",), _sealed_fit, 0.3),
    Door("robot", _results("robot.json"), _robot, weight=0.2),
    Door("robot_sealed", _results("robot.json"), _robot, seal=_sealed_robot, weight=0.5),
    Door(
        "results",
        _results(),
        lambda _: read_results(HERE),
        ("identified.json", "run.json", "sample.json", "fit.json", "config.toml"),
    ),
    Door("draws", _results(), lambda _: read_results(HERE).draws, ("posterior.nc",), weight=0.3),
    Door("evidence", _results("evidence.json"), read_evidence, weight=0.5),
    Door(
        "page",
        _results(),
        _page,
        ("identified.json", "run.json", "evidence.json", "sample.json"),
        weight=0.02,
    ),
    Door(
        "later_files",
        _later,
        _later_page,
        ("validation.json", "trial.json", "comparison.json", "design.json"),
        weight=0.2,
    ),
    Door("run_file", _results("run.json"), lambda _: log_folder(HERE, None)),
    Door("calibration", _results("identified.json"), lambda _: read_calibration(HERE)),
)
"""Doors whose specimens are results of a fit."""
DOORS = (
    *FITS,
    Door("checkpoint_arrays", _checkpoint, _arrays, ("a.npz",)),
    Door("checkpoint_values", _checkpoint, _plain, ("a.json",)),
    Door("floor_arrays", _floor, _loaded_floor),
    Door("exported_program", _exported, _program, _PROGRAM, weight=0.02),
    Door("exported_sums", _exported, lambda _: check_folder(HERE / "stablehlo"), weight=0.2),
)
