"""Numbers as tables, before a fit and after it, with what a reader must know of them."""

from collections.abc import Iterable, Sequence

from rich.table import Table
from rich.text import Text

from slipid.identify.result import Fit
from slipid.identify.verdicts.estimates import Estimate
from slipid.identify.verdicts.profile import Profile
from slipid.report.page import Page, table, verdict
from slipid.support.content import Content


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


def show_sample(
    page: Page, numbers: Iterable[Estimate], about: Content, messages: Iterable[str]
) -> None:
    """Write what the draws of a posterior say, and what sample.json says of how they were made."""
    worst = about["worst"]
    page.table(estimates(numbers, f"{about['draws']} draws"))
    page.notes(messages)
    page.line(
        f"{about['ensembles']} ensembles of {about['walkers']} walkers, {about['steps']} steps: "
        f"worst R-hat {worst['r_hat']:.4f}, {worst['steps_per_tau']:.0f} steps per "
        f"autocorrelation time, {worst['effective_draws']:.0f} effective draws"
    )
    if about["converged"]:
        page.line(f"converged: worst is {about['reason']}")
    else:
        page.line(
            f"NOT converged, do not trust the intervals: worst is {about['reason']}; "
            "a larger --most goes on from here"
        )


def show_fit(page: Page, fit: Fit, profiles: Sequence[Profile] = ()) -> None:
    """Write the numbers of a fit, what the logs leave open, and how the fit ended."""
    page.table(estimates(fit.parameters.values(), f"{len(fit.runs)} runs, {fit.rounds} rounds"))
    if fit.derived:
        page.table(estimates(fit.derived.values(), "\nknown as ratios, or not even so"))
    for profile in profiles:
        page.line(f"profile: {profile.said}")
    page.notes(fit.messages)
    page.line(f"{'converged' if fit.converged else 'NOT converged'}: {fit.reason}")


def show_check(page: Page, found: Content) -> None:
    """Write the content of check.json."""
    groups = table(("surface", "load", "session", "runs", "minutes", "headings", r"speeds \[m/s]"))
    for row in found["groups"]:
        groups.add_row(
            row["surface"],
            row["load"],
            Text(row["session"]),
            str(row["runs"]),
            f"{row['seconds'] / 60:.1f}",
            str(row["headings"]),
            " ".join(f"{v:g}" for v in row["speeds"]),
        )
    page.table(groups)
    page.line("channels: " + ", ".join(found["channels"]))
    for note, count in found["notes"].items():
        page.line(f"repaired in {count} runs: {note}")
    before = table(
        ("parameter", "unit", "std after / before", "verdict"),
        "before any fit: what the logs can be expected to tell",
    )
    for path, e in (found["parameters"] | found["derived"]).items():
        if e["ratio"] is not None and "session_yaw" not in path:
            before.add_row(Text(path), e["unit"], f"{e['ratio']:.3f}", verdict(e["verdict"]))
    page.table(before)
    page.notes(found["messages"])
