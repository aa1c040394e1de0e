"""Tables of parameters before and after a fit, with true values, and of prediction errors."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rich.table import Table
from rich.text import Text

from slipid.fitting.calibration.result import Calibration
from slipid.report.page import Page, percent, table, verdict
from slipid.support.content import Content

if TYPE_CHECKING:
    from slipid.fitting.calibration.result import Value
    from slipid.infer.bench.verdict import BenchFit
    from slipid.infer.posterior.diagnosis import Posterior
    from slipid.infer.result import Fit
    from slipid.infer.verdicts.estimates import Estimate
    from slipid.infer.verdicts.profile import Profile
    from slipid.infer.verdicts.trust import Trust

RECOVERED = {"yes": "green", "roughly": "yellow", "no": "red", "wrong": "magenta"}
"""Colours of a self test's verdicts on how a parameter was recovered."""
OPEN_RATIOS = "\nratios of numbers that the logs may not determine separately"
"""Title of the table of ratios."""


def estimates(items: "Iterable[Estimate]", title: str) -> Table:
    """Return a table of estimates, without marker yaws of sessions and default values."""
    columns = ("parameter", "value", "unit", "90 % interval", "verdict", "from")
    made = table(columns, title, right=("value",))
    for e in items:
        if "session_yaw" in e.path or (e.verdict == "fixed" and e.provenance == "borrowed"):
            continue
        for k, (label, value, interval) in enumerate(rows_of(e)):
            first = ("", "", "") if k else (e.path, verdict(e.verdict), e.provenance)
            name = Text(f"{first[0]} [{label}]".strip() if label else first[0])
            ends = "" if interval is None else f"{interval[0]:.4g} .. {interval[1]:.4g}"
            made.add_row(name, f"{value:.4g}", e.unit, ends, *first[1:])
    return made


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
            f"NOT converged, do not trust the intervals: worst is {about['reason']}; run again "
            "with a larger --most to continue"
        )


def show_posterior(page: Page, found: "Posterior") -> None:
    """Write the parameters of a posterior, and the convergence of its chains."""
    page.table(estimates(found.parameters.values(), f"{found.log_prob.size} draws"))
    state = "converged" if found.converged else "NOT converged, do not trust the intervals"
    page.line(f"{state}: {found.reason}")


def show_fit(page: Page, fit: "Fit", profiles: "Sequence[Profile]" = ()) -> None:
    """Write the parameters of a fit, their profiles, its warnings and how it ended."""
    if fit.calibration is not None:
        show_calibration(page, fit.calibration)
    by_contact = [name for name, floor in fit.selection.items() if floor.model == "contact"]
    where = f"selected on {', '.join(by_contact)}" if by_contact else "selected on no floor"
    page.line(f"force balance, {where}:")
    page.table(estimates(fit.parameters.values(), f"{len(fit.runs)} runs, {fit.rounds} rounds"))
    if fit.derived:
        page.table(estimates(fit.derived.values(), OPEN_RATIOS))
    for profile in profiles:
        page.line(f"profile: {profile.sentence}")
    page.notes(fit.messages)
    page.line(f"{'converged' if fit.converged else 'NOT converged'}: {fit.reason}")


def show_calibration(page: Page, found: Calibration) -> None:
    """Write calibrated lengths, floor by floor, and the place of the pose sensor."""
    page.table(calibration_table(found))
    for floor, (radius, base) in found.multipliers.items():
        each = " ".join(f"{r:.4f}" for r in radius)
        page.line(
            f"multipliers of the config's lengths on {floor}: radius {each}, "
            f"{found.length} {base:.4f}"
        )


def calibration_table(found: Calibration) -> Table:
    """Return a table of calibrated numbers."""
    columns = ("calibration", "value", "unit", "90 % interval", "verdict")
    made = table(columns, right=("value",))

    def row(name: str, value: "Value") -> None:
        factor, unit = (1e3, "mm") if value.unit == "m" else (1.0, value.unit)
        low, high = (factor * end for end in value.interval90)
        ends = "" if value.verdict == "fixed" else f"{low:.5g} .. {high:.5g}"
        made.add_row(Text(name), f"{factor * value.value:.5g}", unit, ends, verdict(value.verdict))

    for floor, radii in found.radius.items():
        for side, value in found.drives(radii).items():
            row(f"{floor}: rolling radius {side}", value)
        row(f"{floor}: effective {found.length}", found.base[floor])
        if floor in found.centre:
            row(f"{floor}: centre of rotation ahead", found.centre[floor])
    for name in [name for name in found.steering if name != "wheelbase_m"]:
        row(f"steering: {name.removesuffix('_rad')}", found.steering[name])
    row("pose sensor ahead", found.offset[0])
    row("pose sensor to the left", found.offset[1])
    row("pose sensor yaw", found.yaw)
    row("pose lag", found.lag)
    if found.scale.verdict != "fixed":
        row("true over logged length", found.scale)
    for name, number in found.gyro.items():
        row(name.removesuffix("_rad_s").replace("_", " "), number)
    return made


def show_trust(page: Page, found: "Trust") -> None:
    """Write the errors of slip models on held-out runs, the selected ones, and the verdict."""
    models = list(next(iter(found.floors.values())).errors) if found.floors else []
    made = table(("surface", *models, "selected", "runs"))
    for name, floor in found.floors.items():
        each = (percent(floor.errors[m]) for m in models)
        made.add_row(Text(name), *each, floor.model, str(floor.runs))
    if found.floors:
        every = all(floor.held_out for floor in found.floors.values())
        page.line(
            f"errors of {'held-out' if every else 'held-out or single'} runs over their path "
            "length, open loop, mean over the run and its halves"
        )
        page.table(made)
    page.notes(found.notes)
    page.line(f"verdict: {found}")


LARGEST_DRIFT = 3e-4
"""Relative difference of the rates of two clocks that is larger than quartz clocks can have [1]."""


def _clocks(clocks: Mapping[str, Content]) -> str:
    """Return a sentence about the clock offsets of poses, their intervals, and the drift."""
    offsets = [clock["offset_s"] for clock in clocks.values()]
    wide = [0.5 * (high - low) for low, high in (c["offset_interval90_s"] for c in clocks.values())]
    rate = max((clock["drift"] for clock in clocks.values()), key=abs)
    question = f"; rates differ by up to {1e6 * rate:+.0f} ppm: is the video's frame rate correct?"
    by = ", ".join(sorted({clock["told_by"] for clock in clocks.values()}))
    return (
        f"clock of the poses, from the motion ({by}): {min(offsets):+.3f} to {max(offsets):+.3f} s "
        f"from the robot's in {len(clocks)} runs; 90 % intervals +- {1e3 * min(wide):.1f} to "
        f"{1e3 * max(wide):.1f} ms{question if abs(rate) > LARGEST_DRIFT else ''}"
    )


def show_check(page: Page, found: Content) -> None:
    """Write the content of check.json, with its findings first."""
    page.findings(found["findings"])
    commanded = ("commanded headings", r"and speeds \[m/s]")
    groups = table(("surface", "load", "session", "runs", "minutes", *commanded))
    for row in found["groups"]:
        groups.add_row(
            row["surface"],
            row["load"],
            Text(row["session"]),
            str(row["runs"]),
            f"{row['seconds'] / 60:.1f}",
            str(row["headings"] or ""),  # 0 without commands, or for turns on the spot
            " ".join(f"{v:g}" for v in row["speeds"]),
        )
    page.table(groups)
    page.line("channels: " + ", ".join(found["channels"]))
    if found["clocks"]:
        page.line(_clocks(found["clocks"]))
    for note, count in found["notes"].items():
        page.line(f"repaired in {count} runs: {note}")
    _show_settings(page, found)
    if "calibration" in found:
        show_calibration(page, Calibration.of_json(found["calibration"]))
    page.notes(found.get("suspects", ()))
    if found["parameters"]:
        page.line(
            "before a fit: what a fit may find, from the least to the most informative of "
            "plausible floors, motors and noise; only the fit itself can find at bound or disputed"
        )
        page.table(_expected(found["parameters"] | found["derived"]))
    page.notes(found["messages"])


def _show_settings(page: Page, found: Content) -> None:
    """Write the limits and the noise that logs show, as tables for the config."""
    if not found["settings"]:
        return
    usual, longest = found["gaps_s"]["usual"], found["gaps_s"]["longest"]
    page.line(
        "limits and noise of this robot by its logs, which `slipid identify` uses where the config "
        "has none: the highest values driven, with a reserve of 20 % for wheel speed and motor "
        "voltage, and the noise while the wheels rest; rows are usually "
        f"{usual:.3g} s apart, and at most {longest:.3g} s. For the config:"
    )
    for group, values in found["settings"].items():
        page.line(f"\n[robot.{group}]")
        for key, value in values.items():
            page.line(f"{key} = {value:g}")
    page.line()


def _expected(numbers: Mapping[str, Content], title: str | None = None) -> Table:
    """Return the table of the ratios of expected posterior std to prior std of parameters.

    If the estimates are ranges, the least informative end comes first.
    """
    made = table(("parameter", "unit", "std after / before", "expected verdict"), title)
    for path, e in numbers.items():
        if e["ratio"] is not None and "session_yaw" not in path:
            # The ratio of an electric parameter may exceed 1, since the uncertainty of the motion
            # is added to that of its prior.
            keys = (("ratio", "verdict"), ("best_ratio", "best_verdict"))
            ends = [(min(e[ratio], 1.0), e[word]) for ratio, word in keys if ratio in e]
            ratios = dict.fromkeys(f"{ratio:.3f}" for ratio, _ in ends)
            words = dict.fromkeys(verdict(word) for _, word in ends)
            made.add_row(Text(path), e["unit"], " .. ".join(ratios), " to ".join(words))
    return made


_ERRORS = (
    "endpoint_error_mean",
    "endpoint_error_median",
    "endpoint_error_over_path_mean",
    "length_error_mean",
)
"""Errors of a validation file that are shown, in the order of the columns."""


def show_validation(page: Page, found: Content) -> None:
    """Write the summary of a validation file, one row per floor and model."""
    columns = ("surface", "model", "end / chord", "median", "end / path", "length", "heading")
    made = table((*columns, "in 90 %", "runs"))
    for surface, models in found["summary"].items():
        for model, s in models.items():
            heading = s["heading_error_median_deg"]
            turn = "" if heading is None else f"{heading:.2f} deg"
            errors = (percent(s[key]) for key in _ERRORS)
            made.add_row(surface, model, *errors, turn, percent(s["coverage90"]), str(s["runs"]))
    page.table(made)


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
        for one, (label, value, interval) in zip(truths, rows_of(e), strict=True):
            low, high = interval or (value, value)
            rows.append(TruthRow(e.path, label, e.unit, float(one), value, (low, high), e.verdict))
    return rows


def show_truth(page: Page, fit: "Fit", truth: Content) -> None:
    """Write estimates next to true values, and how many intervals contain the truth."""
    rows = compared(fit, truth)
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
        f"{sum(r.inside for r in rows)} of {len(rows)} intervals contain the true value. The logs "
        "were simulated with other physics (rollers in MuJoCo) than those of the model; "
        "intervals include this difference only as far as runs and floors disagree\n"
    )


def show_selftest(page: Page, found: Content) -> None:
    """Write the content of selftest.json: recovery of parameters, slip curves and predictions."""
    numbers = table(
        ("parameter", "unit", "error", "of truth", "z rms", "in 90 %", "verdict", "recovered"),
        f"{found['replicates']} simulated experiments like this one ({found['runs']} runs), "
        f"{found['converged']} fits converged",
    )
    for path, e in found["parameters"].items():
        share = None if e["recovered"] == "no" else e["relative_error_rms"]
        numbers.add_row(
            Text(path),
            e["unit"],
            f"{e['error_rms']:.2g}",
            "" if share is None else f"{100 * share:.1f} %",
            f"{e['z_rms']:.2f}",
            f"{round(e['coverage90'] * e['intervals'])} of {e['intervals']}",
            e["verdict"].replace("_", " "),
            verdict(e["recovered"], RECOVERED) + (" *" if path in found["wanted"] else ""),
        )
    page.table(numbers)
    page.line("* wanted; wrong: errors larger than expected from the intervals of the fits\n")
    floors = table(
        ("surface", "slip curve off by", "at most", "in its band", "prediction off by", "encoders")
    )
    for floor, c in found["curves"].items():
        p = found["predictions"].get(floor, {})
        floors.add_row(
            floor,
            f"{c['median_gap']:.4f}",
            f"{c['largest_gap']:.4f}",
            percent(c["coverage90"]),
            percent(p.get("identified")),
            percent(p.get("encoder")),
        )
    page.table(floors)
    page.notes(found["messages"])
    if found["failed"]:
        page.line(f"NOT recovered: {', '.join(found['failed'])}")


def show_bench(page: Page, fit: "BenchFit", taken: Sequence[str] = ()) -> None:
    """Write the fitted parameters of motors on a bench, warnings, and how the fits ended.

    `taken` has sentences about the columns of the log that were used.
    """
    if taken:
        page.line(f"columns: {'; '.join(taken)}")
    rows = sum(len(r.time) for f in fit.fits for r in f.records)
    motors = f"{len(fit.fits)} motors, " if len(fit.fits) > 1 else ""
    page.table(
        estimates(
            fit.parameters.values(), f"{motors}{rows} rows; all values refer to the motor shaft"
        )
    )
    if fit.derived:
        page.table(estimates(fit.derived.values(), OPEN_RATIOS))
    page.notes(fit.messages)
    ended = "converged" if fit.converged else "NOT converged"
    model = "" if fit.good or not fit.converged else "; the model does NOT explain the log"
    page.line(f"{ended}: {fit.reason}{model}")


def show_bench_check(page: Page, found: Content) -> None:
    """Write the content of check.json of bench logs: ranges of signals, expected information."""
    channels = (r"voltage \[V]", r"current \[A]", r"speed \[rad/s]")
    made = table(("log", "rows", "seconds", "rows/s", *channels))
    for row in found["logs"]:
        spans = [
            "none" if row[k] is None else f"{row[k][0]:.3g} .. {row[k][1]:.3g}"
            for k in ("voltage", "current", "speed")
        ]
        rate = f"{1 / row['row_period_s']:.4g}"
        made.add_row(Text(row["name"]), str(row["rows"]), f"{row['seconds']:.1f}", rate, *spans)
    page.table(made)
    page.table(_expected(found["parameters"], "\nexpected information of the logs"))
    page.notes(found["messages"])
