"""Tables of parameters after a fit, with true values where they are known."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rich.table import Table
from rich.text import Text

from slipid.infer.verdicts.disputed import sensitivity
from slipid.report.calibration import show_calibration
from slipid.report.gains import show_gains
from slipid.report.held_out import PREDICTED, held_out_sentence
from slipid.report.numbers import interval, rounded
from slipid.report.page import Groups, Page, counted, grouped, in_two_lines, table, verdict
from slipid.support.content import Content

if TYPE_CHECKING:
    from slipid.infer.bench.verdict import BenchFit
    from slipid.infer.posterior.diagnosis import Posterior
    from slipid.infer.result import Fit
    from slipid.infer.verdicts.draws import Draws
    from slipid.infer.verdicts.estimates import Estimate
    from slipid.infer.verdicts.profile import Profile

SHOWN = {
    "identified": "identified",
    "weak": "weak",
    "disputed": "disputed",
    "at_bound": "at a bound",
}
"""Verdicts that a summary counts, in words."""


def show_estimates(page: Page, items: "Iterable[Estimate]", title: str) -> None:
    """Write a table of estimates below headings with the first part of their paths, and a summary.

    Marker yaws of sessions and defaults are left out; parameters that keep the values of their
    priors are only named.
    """
    kept = [
        e
        for e in items
        if "session_yaw" not in e.path and (e.verdict, e.provenance) != ("fixed", "borrowed")
    ]
    prior = [e.path for e in kept if (e.verdict, e.provenance) == ("not_identified", "borrowed")]
    made = table(("parameter", "value", "unit", "90 % interval", "verdict"), title, ("value",))
    groups = Groups(made)
    for e in grouped((e for e in kept if e.path not in prior), lambda e: e.path):
        _add(made, e, groups.name(e.path))
    page.table(made)
    page.line(_summary(kept, len(prior)))
    if prior:
        page.line(f"not identified, so that they keep the values of their priors: {counted(prior)}")


def _add(made: Table, e: "Estimate", name: str) -> None:
    """Add the rows of one parameter; a vector has a row for each entry below that of its name."""
    word = verdict(e.verdict) + (" *" if e.provenance == "borrowed" else "")
    if e.labels:
        made.add_row(Text(name), "", e.unit, "", word)
        name, word = "", ""
    for label, value, ends in rows_of(e):
        width = 0.0 if ends is None else ends[1] - ends[0]
        unit = "" if e.labels else e.unit
        made.add_row(
            Text(name or f"    {label}"), rounded(value, width), unit, interval(ends), word
        )


def _summary(items: "Sequence[Estimate]", prior: int) -> str:
    """Return the sentence below a table; `prior` parameters keep the values of their priors."""
    free = [e for e in items if e.verdict != "fixed"]
    words = {word: sum(e.verdict == word for e in free) for word in SHOWN}
    parts = [f"{count} {SHOWN[word]}" for word, count in words.items() if count]
    if unknown := sum(e.verdict == "not_identified" for e in free):
        parts.append(f"{unknown} not identified")
    mark = sum(e.provenance == "borrowed" for e in free) - prior
    star = "; *: the value is partly that of the prior" if mark > 0 else ""
    return f"of {len(free)} free parameters: {', '.join(parts) or 'none'}{star}"


def show_ratios(page: Page, found: "Iterable[Estimate]") -> None:
    """Write a table of ratios of parameters, if there are any, and what it is for."""
    made = table(("ratio", "value", "unit", "90 % interval", "verdict"), right=("value",))
    for e in found:
        _add(made, e, in_two_lines(e.path))
    if made.row_count:
        page.line()
        page.table(made)
        page.line("ratios may be identified where their two parameters are not")


def rows_of(e: "Estimate") -> list[tuple[str, float, tuple[float, float] | None]]:
    """Return label, value and 90 % interval of a scalar (no label), or of each vector entry."""
    if not e.labels:
        return [("", e.value, e.interval90)]
    intervals = e.interval90 or [None] * len(e.labels)
    return list(zip(e.labels, e.value, intervals, strict=True))


def show_sample(
    page: Page, numbers: "Iterable[Estimate]", about: Content, messages: Iterable[str]
) -> None:
    """Write the parameters of a posterior, and the convergence of its chains.

    Args:
        page: page to write to.
        numbers: estimates of the parameters.
        about: part of sample.json about the chains.
        messages: warnings.
    """
    worst = about["worst"]
    show_estimates(page, numbers, f"{about['draws']} draws")
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
            f"NOT converged, do not trust the intervals: worst is {about['reason']}; run again "
            "with a larger --most to continue"
        )


def show_posterior(page: Page, found: "Posterior") -> None:
    """Write the parameters of a posterior, and the convergence of its chains."""
    show_estimates(page, found.parameters.values(), f"{found.log_prob.size} draws")
    state = "converged" if found.converged else "NOT converged, do not trust the intervals"
    page.line(f"{state}: {found.reason}")


def show_fit(page: Page, fit: "Fit", profiles: "Sequence[Profile]" = ()) -> None:
    """Write the parameters of a fit, their profiles, its warnings and how it ended."""
    if fit.calibration is not None:
        show_calibration(page, fit.calibration)
    by_contact = [name for name, floor in fit.selection.items() if floor.model == "contact"]
    where = f"selected on {', '.join(by_contact)}" if by_contact else "selected on no floor"
    title = f"\nforce balance, {where}: {len(fit.runs)} runs, {fit.rounds} rounds"
    show_estimates(page, fit.parameters.values(), title)
    show_ratios(page, fit.derived.values())
    if fit.chain is not None:
        every = *fit.parameters.values(), *fit.derived.values()
        page.line(chain_sentence(fit.chain, every))
    for profile in profiles:
        page.line(f"profile: {profile.sentence}")
    if fit.held_out is not None:
        page.line(held_out_sentence(fit.held_out, PREDICTED))
    if fit.load_comparisons:
        page.line(sensitivity(fit.load_comparisons))
    page.notes(fit.messages)
    page.line(f"{'converged' if fit.converged else 'NOT converged'}: {fit.reason}")


def chain_sentence(chain: "Draws", found: "Iterable[Estimate]") -> str:
    """Return which parameters have the intervals of a short chain, and how precise they are."""
    named = [e.path for e in found if e.source == "short_chain"]
    draws = f"a short chain (at least {chain.effective.min():.0f} effective draws)"
    if not named:
        return f"{draws} contradicts no interval of the Laplace approximation"
    return (
        f"intervals of {draws}, which contradicts the Laplace approximation, for {counted(named)}"
    )


@dataclass(frozen=True)
class TruthRow:
    """True and estimated value of one parameter, or of one entry of a vector.

    Attributes:
        path: path of the parameter.
        label: label of the entry; empty for a scalar.
        unit: unit of the values.
        truth: true value [unit].
        value: estimated value [unit].
        interval: 90 % interval of the estimate [unit].
        verdict: verdict of the fit.
    """

    path: str
    label: str
    unit: str
    truth: float
    value: float
    interval: tuple[float, float]
    verdict: str

    @property
    def inside(self) -> bool:
        """True if the 90 % interval contains the truth."""
        return self.interval[0] <= self.truth <= self.interval[1]


def compared(fit: "Fit", truth: Content) -> list[TruthRow]:
    """Return true and estimated value of every fitted parameter with a true value in truth.json."""
    rows = []
    for e in fit.parameters.values():
        if e.verdict == "fixed" or e.path not in truth:
            continue
        true = truth[e.path]["value"]
        truths = true if isinstance(true, list) else [true]
        for one, (label, value, ends) in zip(truths, rows_of(e), strict=True):
            low, high = ends or (value, value)
            rows.append(TruthRow(e.path, label, e.unit, float(one), value, (low, high), e.verdict))
    return rows


def show_truth(page: Page, fit: "Fit", truth: Content) -> None:
    """Write estimates next to true values, and how many intervals contain the truth."""
    rows = compared(fit, truth)
    columns = ("parameter", "truth", "identified", "unit", "90 % interval", "truth in it")
    made = table(columns, "\ntrue and identified values", ("truth", "identified"))
    groups = Groups(made)
    for r in grouped(rows, lambda r: r.path):
        width = r.interval[1] - r.interval[0]
        made.add_row(
            Text(f"{groups.name(r.path)} {r.label}".rstrip()),
            rounded(r.truth, width),
            rounded(r.value, width),
            r.unit,
            interval(r.interval),
            "yes" if r.inside else "[yellow]no[/yellow]",
        )
    page.table(made)
    page.line(
        f"{sum(r.inside for r in rows)} of {len(rows)} intervals contain the true value. The logs "
        "were simulated with other physics (rollers in MuJoCo) than those of the model; "
        "intervals include this difference only as far as runs and floors disagree\n"
    )


def show_bench(page: Page, fit: "BenchFit", taken: Sequence[str] = ()) -> None:
    """Write the fitted parameters of motors on a bench, errors, warnings, and how the fits ended.

    `taken` has sentences about the columns of the log that were used.
    """
    from slipid.exports.feedforward import gains_json
    from slipid.infer.feedforward import bench_feedforwards

    if taken:
        page.line(f"columns: {'; '.join(taken)}")
    rows = sum(len(r.time) for f in fit.fits for r in f.records)
    motors = f"{len(fit.fits)} motors, " if len(fit.fits) > 1 else ""
    title = f"{motors}{rows} rows; all values refer to the motor shaft"
    show_estimates(page, fit.parameters.values(), title)
    show_ratios(page, fit.derived.values())
    show_gains(page, gains_json(bench_feedforwards(fit)))
    for f in fit.fits:
        if f.held_out is not None:
            page.line(f"{f.label}: " * bool(f.label) + held_out_sentence(f.held_out))
    page.notes(fit.messages)
    ended = "converged" if fit.converged else "NOT converged"
    model = "" if fit.good or not fit.converged else "; the model does NOT explain the log"
    page.line(f"{ended}: {fit.reason}{model}")
