"""The page of a fit or of a calibration, from the files in its result folder."""

from pathlib import Path

from slipid.report.html.blocks import badge
from slipid.report.html.page import REPORT, Page, write_page
from slipid.report.html.results import Results, read_results
from slipid.report.html.sections import data, outlook, predictions, summary, wheels

SECTIONS = (
    summary.verdict,
    summary.numbers,
    summary.values,
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
    outlook.provenance,
)
"""Functions that return the sections, or None where the results have nothing for them."""


def fit_page(found: Results) -> Page:
    """Return the page of the results in a folder."""
    name = found.run["config"]["name"].removesuffix(".toml")
    word = found.trust.get("verdict")
    sections = [section for of in SECTIONS if (section := of(found)) is not None]
    return Page(
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


def write_report(out: Path) -> Path:
    """Write report.html of the results in a folder, and return its path.

    Raises:
        DataError: the folder has no results, a file in it is damaged, or a library is missing.
    """
    return write_page(fit_page(read_results(out)), out / REPORT)
