"""How near it came: predictions beside the camera, estimates beside the truth."""

from dataclasses import dataclass

from rich.text import Text

from slipid.identify.result import Fit
from slipid.report.estimates import rows_of
from slipid.report.page import Page, percent, table, verdict
from slipid.support.content import Content

RECOVERED = {"yes": "green", "roughly": "yellow", "no": "red", "wrong": "magenta"}
"""Colours of what a self-test says."""


def show_validation(page: Page, found: Content) -> None:
    """Write the summary of a validation file: one row per floor and model."""
    columns = ("surface", "model", "end-point error", "median", "length", "heading")
    made = table((*columns, "in 90 %", "runs"))
    for surface, models in found["summary"].items():
        for model, s in models.items():
            heading = s["heading_error_median_deg"]
            made.add_row(
                surface,
                model,
                percent(s["endpoint_error_mean"]),
                percent(s["endpoint_error_median"]),
                percent(s["length_error_mean"]),
                "" if heading is None else f"{heading:.2f} deg",
                percent(s["coverage90"]),
                str(s["runs"]),
            )
    page.table(made)


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


def compared(fit: Fit, truth: Content) -> list[Row]:
    """Every number that was fitted beside its truth, as far as truth.json has one."""
    rows = []
    for e in fit.parameters.values():
        if e.verdict == "fixed" or e.path not in truth:
            continue
        true = truth[e.path]["value"]
        truths = true if isinstance(true, list) else [true]
        for one, (label, value, interval) in zip(truths, rows_of(e), strict=True):
            low, high = interval or (value, value)
            rows.append(Row(e.path, label, e.unit, float(one), value, (low, high), e.verdict))
    return rows


def show_truth(page: Page, fit: Fit, truth: Content) -> None:
    """Write `compared`, and how many intervals hold the truth."""
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
        f"{sum(r.inside for r in rows)} of {len(rows)} intervals hold the truth: the logs come "
        "from another physics (MuJoCo's rollers) than the model's, and intervals know nothing of "
        "that\n"
    )


def show_selftest(page: Page, found: Content) -> None:
    """Write the content of selftest.json."""
    numbers = table(
        ("parameter", "unit", "error", "of truth", "z rms", "in 90 %", "verdict", "recovered"),
        f"{found['replicates']} made experiments like this one ({found['runs']} runs), "
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
    page.line("* wanted; wrong: errors larger than the fits say\n")
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
