"""The page of a fit or of a calibration, from the files in its result folder."""

from pathlib import Path

from slipid.app.calibrate import CalibrationResult
from slipid.app.logs import config_of_fit, log_folder
from slipid.app.problem import FitTask, read_fit_task
from slipid.infer.fit_file import load
from slipid.infer.motion_models import MotionModels
from slipid.infer.result import Fit
from slipid.infer.result_folder import FIT
from slipid.report.html.blocks import badge
from slipid.report.html.evidence import EVIDENCE, FitEvidence, write_evidence
from slipid.report.html.gather import evidence_of_fit, evidence_of_runs
from slipid.report.html.page import REPORT, WebPage, try_page, write_page
from slipid.report.html.results import Results, read_results
from slipid.report.html.sections import data, gains, others, outlook, predictions, summary, wheels
from slipid.support.jax_setup import setup_jax
from slipid.support.progress import Reporter

SECTIONS = (
    summary.verdict,
    summary.numbers,
    summary.values,
    gains.gains,
    predictions.held_out,
    predictions.paths,
    predictions.residuals,
    wheels.currents,
    wheels.loads,
    wheels.slip,
    data.correlations,
    data.quality,
    data.posterior,
    outlook.trial,
    outlook.design,
    others.others,
    outlook.provenance,
)
"""Functions that return the sections, or None where the results have nothing for them."""


def fit_page(found: Results) -> WebPage:
    """Return the page of the results in a folder."""
    name = found.run["config"]["name"].removesuffix(".toml")
    word = found.trust.get("verdict")
    sections = [section for of in SECTIONS if (section := of(found)) is not None]
    return WebPage(
        title=f"{name}: what its logs tell",
        badge=None if word is None else badge(word),
        lead=_lead(found),
        sections=sections,
    )


def _lead(found: Results) -> str:
    """Return one sentence about what was identified."""
    runs, floors = len(found.run["data"]["logs"]), found.floors
    what = "Calibrated kinematics" if found.fit is None else "Identified model"
    plural = "floors" if len(floors) > 1 else "floor"
    return f"{what} from {runs} runs on {len(floors)} {plural}: {', '.join(floors)}."


def write_fit_report(fit: Fit, task: FitTask, out: Path, report: Reporter) -> tuple[str, ...]:
    """Write the evidence of a fit and its page; return the names of the files.

    Args:
        fit: the fit, whose other files are in the folder.
        task: the runs of the fit.
        out: folder to write to.
        report: reporter of the progress.
    """
    report.stage("gathering what the page shows")
    found = evidence_of_fit(fit, task.dataset, task.mixed, report.steps)
    return _written(found, out, report)


def write_calibration_report(
    done: CalibrationResult, out: Path, report: Reporter
) -> tuple[str, ...]:
    """Write the evidence of a calibration and its page; return the names of the files.

    Arguments are those of `write_fit_report`.
    """
    report.stage("gathering what the page shows")
    task, found = done.task, done.calibration
    robot = found.seen(task.robot)
    models = MotionModels.of_calibration(found, done.models, task.robot.geometry, robot)
    evidence = evidence_of_runs(task.dataset, models, task.data_hash, tell=report.steps)
    return _written(evidence, out, report)


def _written(evidence: FitEvidence, out: Path, report: Reporter) -> tuple[str, ...]:
    write_evidence(evidence, out)
    report.stage("writing the page")
    return *try_page(fit_page(read_results(out)), out / REPORT, report), EVIDENCE


def write_report(out: Path) -> Path:
    """Write report.html of the results in a folder, and return its path.

    Raises:
        DataError: the folder has no results, a file in it is damaged, or a library is missing.
    """
    return write_page(fit_page(read_results(out)), out / REPORT)


def renew(out: Path, logs: Path | None, report: Reporter) -> Path:
    """Write report.html of the results in a folder again, and return its path.

    The evidence of a fit that has none, since another version wrote it, is gathered from the logs.

    Args:
        out: folder that `slipid identify` wrote.
        logs: folder of the logs; None for the folder from which the fit read them.
        report: reporter of the progress.

    Raises:
        DataError: the folder has no results, a file in it is damaged, or a library is missing.
    """
    if (out / FIT).exists() and not (out / EVIDENCE).exists():
        setup_jax(quiet=True)
        fit = load(out)
        folder = log_folder(out, logs)
        task = read_fit_task(config_of_fit(out), folder, report)
        report.stage("gathering what the page shows")
        found = evidence_of_fit(fit, task.dataset, tell=report.steps)
        if any(section.map for section in task.config.content.logs):
            note = "runs over several floors are shown after `slipid identify` alone"
            found = found.model_copy(update={"notes": [*found.notes, note]})
        write_evidence(found, out)
    report.stage("writing the page")
    return write_report(out)
