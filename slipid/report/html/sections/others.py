"""Section that shows a robot beside the reference robots of a similar drive."""

from collections.abc import Iterator, Sequence

from slipid.app.reference_robots import ReferenceBand, reference_bands, reference_robot
from slipid.report.html import figures as draw
from slipid.report.html.blocks import (
    Block,
    Cell,
    FigureBlock,
    PageSection,
    TableBlock,
    TextBlock,
    colour,
    label,
    marker,
    spanned,
)
from slipid.report.html.results import Results
from slipid.report.html.sections.predictions import is_wide
from slipid.report.numbers import estimate

ERRORS = ("nominal", "calibrated", "selected")
"""Models whose errors are compared."""
OTHERS = {
    "calibration.multipliers.*.wheel_radius": "wheel radius over nominal",
    "calibration.multipliers.*.track": "track or base over nominal",
    "surface.*.friction": "friction coefficient",
    "surface.*.creep": "creep",
}
"""Text of each number that is compared, keyed by its path."""


def others(found: Results) -> PageSection | None:
    """Return the section about how this robot compares with reference robots."""
    errors = found.trust.get("held_out_error_over_path")
    bands = {m: _bands(found, f"trust.held_out_error_over_path.*.{m}") for m in ERRORS}
    if not errors or not bands["selected"]:
        return None
    blocks: list[Block] = [
        TextBlock(
            [
                "Robots with a similar drive, identified from public logs; `slipid robots` lists "
                "them. Other floors slip differently: a larger error is no fault by itself."
            ]
        ),
        _errors(found, bands),
        _numbers(found),
    ]
    return PageSection("others", "Is this good?", blocks)


def _bands(found: Results, path: str) -> tuple[ReferenceBand, ...]:
    """Return a number of similar robots, without those that were identified from these logs."""
    mine = found.run["data"]["hash"]
    every = reference_bands(found.drive, path)
    return tuple(b for b in every if reference_robot(b.robot).source.data_hash != mine)


def _errors(found: Results, bands: dict[str, tuple[ReferenceBand, ...]]) -> FigureBlock:
    """Return the figure of held-out errors of this robot and of the others."""
    errors = found.trust["held_out_error_over_path"]
    data, every = [], []
    for model in ERRORS:
        own = {
            f: e.get(found.selected[f] if model == "selected" else model) for f, e in errors.items()
        }
        rows = [(f"this robot, {f}", 100 * e) for f, e in own.items() if e is not None]
        rows += [(f"{b.robot}, {b.floor.replace('_', ' ')}", 100 * b.value) for b in bands[model]]
        every += [error for _, error in rows]
        data.append(
            draw.dots(
                [error for _, error in rows],
                [name for name, _ in rows],
                label(model),
                colour(model),
                marker=marker(model),
                hovertemplate="%{y}: %{x:.2f} % of the path<extra>%{fullData.name}</extra>",
            )
        )
    selected = data[-1]
    mine = [x for x, y in zip(selected["x"], selected["y"], strict=True) if y.startswith("this")]
    theirs = [100 * b.value for b in bands["selected"]]
    title = (
        f"This robot is predicted within {_span(mine)} of the path, others within {_span(theirs)}"
    )
    x = draw.axis("error on held-out runs [% of the path]")
    x |= draw.logarithmic() if is_wide(every) else {"rangemode": "tozero"}
    y = {"automargin": True, "autorange": "reversed"}
    layout = {"xaxis": x, "yaxis": y, "showlegend": True}
    alt = f"{title}. Dots show the errors of three models on every floor of every robot."
    rows_shown = len(set(selected["y"]))
    return FigureBlock("others", title, alt, data, layout, "", 140 + 26 * rows_shown, minimum=460)


def _span(percent: Sequence[float]) -> str:
    """Return the smallest and the largest of some percentages as text."""
    low, high = f"{min(percent):.2g}", f"{max(percent):.2g}"
    return f"{low} %" if low == high else f"{low} to {high} %"


def _numbers(found: Results) -> TableBlock:
    """Return the table of numbers of this robot beside those of the others."""
    rows = [row for path, text in OTHERS.items() for row in _rows(found, path, text)]
    head = ("number", "robot and floor", "value", "90 % interval")
    caption = "Numbers of this robot and of the others, as means over the drives."
    return TableBlock(caption, head, rows, right=("value",), folded=True)


def _rows(found: Results, path: str, text: str) -> Iterator[Sequence[Cell]]:
    for floor in found.floors:
        if (own := _own(found, path.replace("*", floor))) is not None:
            yield text, f"this robot, {floor}", estimate(*own), spanned(own[1])
    for band in _bands(found, path):
        where = f"{band.robot}, {band.floor.replace('_', ' ')}"
        yield text, where, estimate(band.value, band.interval90), spanned(band.interval90)


def _own(found: Results, path: str) -> tuple[float, Sequence[float] | None] | None:
    """Return a number of this robot and its interval; None if the logs do not determine it."""
    first, *rest = path.split(".")
    if first == "surface":
        e = found.parameters.get(path)
        known = e is not None and e["verdict"] in ("identified", "weak", "disputed")
        return (e["value"], e["interval90"]) if e is not None and known else None
    if found.calibration is None:
        return None
    floor, length = rest[-2:]
    value = found.calibration["multipliers"].get(floor, {}).get(length)
    if value is None:
        return None
    return (sum(value) / len(value) if isinstance(value, list) else value), None
