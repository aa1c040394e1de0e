"""Calibration of a robot's kinematics from the logs of a config, without a force balance."""

import time
from dataclasses import dataclass
from pathlib import Path

from slipid.app.bench_priors import COPY_NAME
from slipid.app.logs import write_run_file
from slipid.app.problem import ConfigFitTask, FitTask
from slipid.fitting.calibration import Calibration
from slipid.infer.fit_file import IDENTIFIED, SCHEMA
from slipid.infer.verdicts.trust import Trust, verdict_of_trust
from slipid.predict.selection import Errors, FloorSelection, kinematic_errors, selected
from slipid.search_space import Space
from slipid.support.files import read_json, writable, write_json
from slipid.support.progress import Reporter


@dataclass(frozen=True, eq=False)
class KinematicFit:
    """Calibrated kinematics of a task.

    Attributes:
        calibration: calibration from all runs.
        errors: errors of the kinematic models on held-out runs.
    """

    calibration: Calibration
    errors: Errors


@dataclass(frozen=True, eq=False)
class CalibrationResult:
    """Result of a calibration without a force balance.

    Attributes:
        calibration: the calibration.
        selection: selected kinematic model on each floor.
        trust: trust in the selected models.
        task: runs, config and choices.
        written: names of the written files.
    """

    calibration: Calibration
    selection: dict[str, FloorSelection]
    trust: Trust
    task: ConfigFitTask
    written: tuple[str, ...]


def calibrated(task: FitTask, report: Reporter) -> KinematicFit:
    """Return the calibrated kinematics of a task, and report their numbers."""
    report.stage("calibrated kinematics")
    space = Space(task.robot, task.choices)
    found = KinematicFit(*kinematic_errors(task.dataset, space, task.choices))
    for sentence in found.calibration.sentences:
        report.line(sentence)
    return found


def calibrate_only(
    task: ConfigFitTask, data: Path, out: Path, report: Reporter
) -> CalibrationResult:
    """Return the calibration of a config's robot, and write identified.json and run.json to `out`.

    Args:
        task: runs and config, as read and checked by `slipid.app.identify.checked_task`.
        data: folder of the logs.
        out: folder to write to.
        report: reporter of the progress.
    """
    began = time.monotonic()
    found = calibrated(task, report)
    selection = selected(task.dataset, found.errors)
    trust = verdict_of_trust(selection)
    writable(out)
    runs = [log.name for log in task.logs]
    content = {
        "schema": SCHEMA,
        "parameters": {},
        "derived": {},
        "surfaces": list(task.robot.surfaces.labels),
        "curves": {},
        "validity": {},
        "messages": ["calibrated kinematics alone: no force balance was fitted"],
        "calibration": found.calibration.to_json(),
        "selected_model": {floor: one.model for floor, one in selection.items()},
        "trust": trust.to_json(),
        "data": {"hash": task.data_hash, "runs": runs},
    }
    write_json(out / IDENTIFIED, content)
    write_run(task, trust, data, out, time.monotonic() - began)
    written = (IDENTIFIED, "run.json", "config.toml")
    return CalibrationResult(found.calibration, selection, trust, task, written)


def write_run(task: ConfigFitTask, trust: Trust, data: Path, out: Path, seconds: float) -> None:
    """Write run.json, and copies of the config and the bench file, which later commands read."""
    config = task.config
    if (bench := config.content.wheels.motor) is not None:
        write_json(
            out / COPY_NAME, read_json(config.path.parent / bench, "the parameters of a motor")
        )
    logs = {log.name: log.sha256 for log in task.logs}
    inputs = {"folder": str(data), "hash": task.data_hash, "logs": logs, "skipped": task.skipped}
    verdict = {"trust": trust.to_json(), "seed": task.settings.seed}
    write_run_file(out, config, inputs, seconds, verdict)
