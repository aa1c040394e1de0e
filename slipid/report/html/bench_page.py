"""The page of a fit of motors on a bench."""

from collections.abc import Iterator, Sequence

import numpy as np

from slipid.exports.feedforward import gains_json
from slipid.infer.bench.fit import MotorFit
from slipid.infer.bench.moments import Equation
from slipid.infer.bench.verdict import BenchFit
from slipid.infer.bench.windows import BenchWindows
from slipid.infer.feedforward import bench_feedforwards
from slipid.infer.verdicts.estimates import Estimate
from slipid.report.html import figures as draw
from slipid.report.html.blocks import (
    Badge,
    Block,
    Cell,
    CopyLines,
    FigureBlock,
    PageSection,
    TableBlock,
    TextBlock,
    badge,
    number,
    spanned,
)
from slipid.report.html.page import WebPage
from slipid.report.html.sections.gains import gains_section
from slipid.report.numbers import estimate
from slipid.support.content import Content

MOST_POINTS = 2000
"""Largest number of points of a curve, or of dots in a panel; longer signals are thinned."""


def bench_page(fit: BenchFit, name: str, taken: Sequence[str] = ()) -> WebPage:
    """Return the page of fitted motors.

    Args:
        fit: the fit.
        name: name of the log or of the config.
        taken: sentences about the columns of the log that were used.
    """
    word = "explains the log" if fit.good else "does not explain the log"
    rows = sum(len(r.time) for f in fit.fits for r in f.records)
    gains = gains_section(gains_json(bench_feedforwards(fit)))
    motors = "motor" if len(fit.fits) == 1 else f"{len(fit.fits)} motors"
    return WebPage(
        title=f"{name}: {motors} on a bench",
        badge=Badge(word, "good" if fit.good else "bad"),
        lead=f"Identified from {rows} rows; all values refer to the shaft of the motor.",
        sections=[
            _verdict(fit),
            _numbers(fit, name),
            _values(fit),
            *([] if gains is None else [gains]),
            *(_signals(f) for f in fit.fits),
            _origin(fit, taken),
        ],
    )


def _verdict(fit: BenchFit) -> PageSection:
    if fit.good:
        text = "The model explains the log: use the identified numbers."
    elif fit.converged:
        text = "The model does not explain the log: the intervals are widened, use them with care."
    else:
        text = "The fit did not converge: do not use these numbers."
    blocks: list[Block] = [TextBlock([text], kind="good" if fit.good else "bad")]
    if fit.messages:
        blocks.append(TextBlock(fit.messages, listed=True, kind="note"))
    return PageSection("verdict", "Verdict", blocks)


def _numbers(fit: BenchFit, name: str) -> PageSection:
    lines = [f"# {name}; 90 % intervals"]
    for path, e in fit.parameters.items():
        if e.verdict == "fixed":
            continue
        shown = estimate(e.value, e.interval90)
        line = f"{path}: {shown}  # [{e.unit}] {spanned(e.interval90)}"
        if e.verdict != "identified":
            line = f"# {line}; {e.verdict.replace('_', ' ')}"
        lines.append(line)
    about = TextBlock(
        ["Lines that begin with # are numbers that this log does not determine well."]
    )
    code = CopyLines("Numbers to type in", "\n".join(lines))
    return PageSection("numbers", "Type these numbers into your robot", [about, code])


def _values(fit: BenchFit) -> PageSection:
    head = ("parameter", "value", "unit", "90 % interval", "prior", "verdict", "meaning")
    rows = [_row(e) for e in fit.parameters.values() if e.verdict != "fixed"]
    blocks: list[Block] = [
        TableBlock("Fitted numbers; the prior is what was known before.", head, rows, ("value",))
    ]
    if fit.derived:
        ratios = [_row(e) for e in fit.derived.values()]
        caption = "Ratios of numbers, which a log may determine better than the numbers themselves."
        blocks.append(TableBlock(caption, head, ratios, ("value",)))
    fixed = [_row(e) for e in fit.parameters.values() if e.verdict == "fixed"]
    if fixed:
        caption = "Numbers that were given or have the default, and were not fitted."
        blocks.append(TableBlock(caption, head, fixed, ("value",), folded=True))
    return PageSection("values", "Values and intervals", blocks)


def _row(e: Estimate) -> Sequence[Cell]:
    known = e.prior_mean is not None and e.prior_std is not None
    prior = f"{number(e.prior_mean, 3)} ± {number(e.prior_std, 2)}" if known else ""
    shown, ends = estimate(e.value, e.interval90), spanned(e.interval90)
    return e.path, shown, e.unit, ends, prior, badge(e.verdict), e.doc


def _signals(fit: MotorFit) -> PageSection:
    """Return the section about measured and fitted signals of a motor, and their residuals."""
    which = f"_{fit.label}" if fit.label else ""
    title = f"Motor {fit.label}: signals" if fit.label else "Signals"
    blocks: list[Block] = []
    for equation in fit.equations:
        blocks.append(_overlay(equation, which))
        blocks.append(_residuals(equation, which))
    return PageSection(f"signals{which}", title, blocks)


def _overlay(equation: Equation, which: str) -> FigureBlock:
    """Return the figure of a measured and a fitted signal over time."""
    w = equation.windows
    measured = w.measured.mean(axis=0)
    fitted = measured - equation.residual.mean(axis=0)
    clock, some = _times(w), slice(None, None, max(1, len(w.time) // MOST_POINTS))
    shown = [None if not ok else x for x, ok in zip(_short(fitted), w.usable.tolist(), strict=True)]
    wide = {"line": {"width": 5}, "opacity": 0.5}
    data = [
        draw.line(_short(clock)[some], _short(measured)[some], "measured", "@muted", **wide),
        draw.line(_short(clock)[some], shown[some], "fitted", "@blue", line={"width": 1.5}),
    ]
    rms = float(np.sqrt(np.mean(equation.residual.mean(axis=0)[w.usable] ** 2)))
    channel, unit = equation.channel, equation.unit
    title = f"The {channel} is explained within {rms:.2g} {unit}"
    layout = {
        "xaxis": draw.axis("time, records one after the other [s]"),
        "yaxis": draw.axis(f"{channel} [{unit}]"),
        "showlegend": True,
    }
    alt = f"{title} (root mean square). Measured {channel} over time, and the one by the model."
    caption = (
        "The model computes it from the other measured signals, row by row; where the shaft "
        "rests it predicts nothing."
    )
    return FigureBlock(f"{channel}{which}", title, alt, data, layout, caption, 330)


def _residuals(equation: Equation, which: str) -> FigureBlock:
    """Return the figure of residuals over time, speed and current."""
    w = equation.windows
    residual = equation.residual.mean(axis=0)
    used = np.flatnonzero(w.usable)
    some = used[:: max(1, len(used) // MOST_POINTS)]
    signals = (_times(w), w.speed.mean(axis=0), w.current.mean(axis=0))
    names = ("time [s]", "speed [rad/s]", "current [A]")
    layout, axes, _ = draw.panels(3, names, 3)
    data = []
    for panel, x in zip(axes, signals, strict=True):
        dots = draw.dots(_short(x[some]), _short(residual[some]), "", "@muted", marker={"size": 3})
        data.append(draw.onto(dots, panel))
        means = list(_binned(x, residual, used))
        line = draw.line([m[0] for m in means], [m[1] for m in means], "", "@orange")
        data.append(draw.onto(line | {"mode": "lines+markers"}, panel))
        layout[f"yaxis{panel}"] |= {"range": [-6 * equation.scale, 6 * equation.scale]}
    layout["yaxis"] |= draw.axis(f"residual [{equation.unit}]")
    layout["showlegend"] = False
    title = f"Residuals of the {equation.channel}"
    alt = f"{title} over time, speed and current, with their means in bins."
    caption = "Measured less fitted; orange: means. A trend is an effect that the model lacks."
    return FigureBlock(
        f"residual_{equation.channel}{which}", title, alt, data, layout, caption, 260
    )


def _binned(x: np.ndarray, y: np.ndarray, used: np.ndarray) -> Iterator[tuple[float, float]]:
    """Yield the median of x and the mean of y in bins of equal numbers of windows."""
    for some in np.array_split(used[np.argsort(x[used], kind="stable")], 24):
        if len(some):
            yield float(np.median(x[some])), float(np.mean(y[some]))


def _times(w: BenchWindows) -> np.ndarray:
    """Return the times of windows, with records one after the other [s]."""
    ends = [float(w.time[w.record == k].max(initial=0.0)) for k in range(int(w.record.max()) + 1)]
    return np.asarray(w.time + np.concatenate([[0.0], np.cumsum(ends)])[w.record])


def _short(x: np.ndarray) -> list[float]:
    """Return numbers with five significant digits, which keeps the page small."""
    return [float(f"{v:.5g}") for v in x.tolist()]


def _origin(fit: BenchFit, taken: Sequence[str]) -> PageSection:
    content: Content = fit.to_json()
    runs = dict.fromkeys((r.name, r.sha256) for f in fit.fits for r in f.records)
    rows: list[Sequence[Cell]] = [(name, sha[:16]) for name, sha in runs]
    blocks: list[Block] = [
        TableBlock("Logs and the hashes of their files.", ("log", "SHA-256"), rows)
    ]
    if taken:
        blocks += [TextBlock(["Columns that were used:"]), TextBlock(taken, listed=True)]
    blocks.append(
        TextBlock([f"{'Converged' if fit.converged else 'Not converged'}: {fit.reason}."])
    )
    blocks.append(TextBlock([f"Hash of the data: {content['data']['hash'][:16]}."]))
    return PageSection("provenance", "Provenance", blocks)
