"""Fitted numbers as a table, with what a reader must know of them."""

from collections.abc import Iterable, Sequence

from rich.table import Table
from rich.text import Text

from slipid.identify.result import Fit
from slipid.identify.verdicts.estimates import Estimate
from slipid.identify.verdicts.profile import Profile
from slipid.report.page import Page, table, verdict


def estimates(items: Iterable[Estimate], title: str) -> Table:
    """Table of estimates; numbers of single sessions and defaults are left to the files."""
    columns = ("parameter", "value", "unit", "90 % interval", "verdict", "from")
    made = table(columns, title, right=("value",))
    for e in items:
        if "session_yaw" in e.path or (e.verdict == "fixed" and e.provenance == "borrowed"):
            continue
        for k, (label, value, interval) in enumerate(rows_of(e)):
            name = "" if k else e.path
            made.add_row(
                Text(f"{name} [{label}]".strip() if label else name),
                f"{value:.4g}",
                e.unit,
                "" if interval is None else f"{interval[0]:.4g} .. {interval[1]:.4g}",
                "" if k else verdict(e.verdict),
                "" if k else e.provenance,
            )
    return made


def rows_of(e: Estimate) -> list[tuple[str, float, tuple[float, float] | None]]:
    """Label, value and interval of a scalar, or of each entry of a vector."""
    if not e.labels:
        return [("", e.value, e.interval90)]
    intervals = e.interval90 or [None] * len(e.labels)
    return list(zip(e.labels, e.value, intervals, strict=True))


def show_fit(page: Page, fit: Fit, profiles: Sequence[Profile] = ()) -> None:
    """Write the numbers of a fit, what the logs leave open, and how the fit ended."""
    page.table(estimates(fit.parameters.values(), f"{len(fit.runs)} runs, {fit.rounds} rounds"))
    if fit.derived:
        page.table(estimates(fit.derived.values(), "\nknown as ratios, or not even so"))
    for profile in profiles:
        page.line(f"profile: {profile.said}")
    page.notes(fit.messages)
    page.line(f"{'converged' if fit.converged else 'NOT converged'}: {fit.reason}")
