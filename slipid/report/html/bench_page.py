"""The page of a fit of motors on a bench."""

from collections.abc import Iterator, Sequence

import numpy as np

from slipid.exports.feedforward import gains_json
from slipid.infer.bench.fit import MotorFit
from slipid.infer.bench.signals import FittedSignal, fitted_signals
from slipid.infer.bench.verdict import BenchFit
from slipid.infer.feedforward import bench_feedforwards
from slipid.infer.verdicts.estimates import Estimate
from slipid.report.held_out import WORDS, held_out_rows
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
            *_held_out(fit),
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


def _held_out(fit: BenchFit) -> list[PageSection]:
    """Return the section about rows that were not used, if there are any."""
    known = [(f.label or "motor", f.held_out) for f in fit.fits if f.held_out is not None]
    if not known:
        return []
    rivals = tuple(WORDS.values())
    rows = [
        (name, row.channel, row.unit, row.error, *(row.rivals[word] for word in rivals))
        for name, found in known
        for row in held_out_rows(found)
    ]
    head = ("motor", "channel", "unit", "fitted motor", *rivals)
    caption = (
        "Root mean square errors of simulations from the voltage alone, on rows that were not used:"
        " of the fitted motor, and of least squares for comparison."
    )
    table = TableBlock(caption, head, rows, head[3:])
    return [PageSection("held_out", "Held-out rows", [table])]


def _signals(fit: MotorFit) -> PageSection:
    """Return the section about measured and fitted signals of a motor, and their residuals."""
    which = f"_{fit.label}" if fit.label else ""
    title = f"Motor {fit.label}: signals" if fit.label else "Signals"
    blocks: list[Block] = []
    given = "voltage" if fit.has_voltage else "current"
    for signal in fitted_signals(fit):
        blocks.append(_overlay(signal, which, given))
        blocks.append(_residuals(signal, which))
    return PageSection(f"signals{which}", title, blocks)


def _overlay(signal: FittedSignal, which: str, given: str) -> FigureBlock:
    """Return the figure of a measured signal over time, and of that simulated from `given`."""
    some = slice(None, None, max(1, len(signal.time) // MOST_POINTS))
    clock = _short(signal.time[some])
    wide = {"line": {"width": 5}, "opacity": 0.5}
    thin = {"line": {"width": 1.5}}
    data = [
        draw.line(clock, _short(signal.measured[some]), "measured", "@muted", **wide),
        draw.line(clock, _short(signal.fitted[some]), "simulated", "@blue", **thin),
    ]
    rms = float(np.sqrt(np.mean(signal.residual**2)))
    channel, unit = signal.channel, signal.unit
    title = f"The {channel} is simulated within {rms:.2g} {unit}"
    layout = {
        "xaxis": draw.axis("time, records one after the other [s]"),
        "yaxis": draw.axis(f"{channel} [{unit}]"),
        "showlegend": True,
    }
    alt = f"{title} (root mean square). Measured {channel} over time, and the simulated one."
    caption = f"The simulation uses the {given} alone, from the first row to the last."
    return FigureBlock(f"{channel}{which}", title, alt, data, layout, caption, 330)


def _residuals(signal: FittedSignal, which: str) -> FigureBlock:
    """Return the figure of residuals over time, speed and current."""
    residual = signal.residual
    some = slice(None, None, max(1, len(residual) // MOST_POINTS))
    signals = (signal.time, signal.speed, signal.current)
    names = ("time [s]", "speed [rad/s]", "current [A]")
    layout, axes, _ = draw.panels(3, names, 3)
    data = []
    for panel, x in zip(axes, signals, strict=True):
        dots = draw.dots(_short(x[some]), _short(residual[some]), "", "@muted", marker={"size": 3})
        data.append(draw.onto(dots, panel))
        means = list(_binned(x, residual))
        line = draw.line([m[0] for m in means], [m[1] for m in means], "", "@orange")
        data.append(draw.onto(line | {"mode": "lines+markers"}, panel))
        layout[f"yaxis{panel}"] |= {"range": [-6 * signal.scale, 6 * signal.scale]}
    layout["yaxis"] |= draw.axis(f"residual [{signal.unit}]")
    layout["showlegend"] = False
    title = f"Residuals of the {signal.channel}"
    alt = f"{title} over time, speed and current, with their means in bins."
    caption = "Measured less simulated; orange: means. A trend is an effect that the model lacks."
    return FigureBlock(f"residual_{signal.channel}{which}", title, alt, data, layout, caption, 260)


def _binned(x: np.ndarray, y: np.ndarray) -> Iterator[tuple[float, float]]:
    """Yield the median of x and the mean of y in bins of equal numbers of rows."""
    for some in np.array_split(np.argsort(x, kind="stable"), 24):
        if len(some):
            yield float(np.median(x[some])), float(np.mean(y[some]))


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
