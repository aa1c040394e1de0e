"""The page of a check of logs before a fit."""

from collections.abc import Sequence

import numpy as np

from slipid.data.runs import Runs
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
)
from slipid.report.html.page import WebPage
from slipid.report.html.sections.summary import calibration_table
from slipid.support.content import Content

MOST_POSES, MOST_ROWS = 60, 120
"""Largest numbers of poses of a drawn path, and of rows of a drawn signal."""
MOST_DRAWN = 60
"""Largest number of drawn runs; of more, evenly spaced ones are drawn."""


def check_page(data: Runs, found: Content, name: str) -> WebPage:
    """Return the page of a check.

    Args:
        data: the runs.
        found: content of check.json.
        name: name of the config.
    """
    bad = [f for f in found["findings"] if f["severity"] == "wrong"]
    word = f"{len(bad)} contradictions" if len(bad) > 1 else "a contradiction" if bad else "ready"
    seconds = sum(row["seconds"] for row in found["groups"])
    sections = [
        _findings(found, bool(bad)),
        _contents(found),
        _paths(data),
        _signals(data),
        _calibration(found),
        _expected(found),
        _settings(found),
    ]
    return WebPage(
        title=f"{name.removesuffix('.toml')}: its logs before a fit",
        badge=Badge(word, "bad" if bad else "good"),
        lead=f"{found['runs']} runs, {seconds / 60:.1f} minutes; {', '.join(found['channels'])}.",
        sections=[section for section in sections if section is not None],
    )


def _findings(found: Content, bad: bool) -> PageSection:
    text = (
        "Logs and config contradict each other: correct what is marked wrong before a fit."
        if bad
        else "Logs and config agree: `slipid identify` can follow."
    )
    blocks: list[Block] = [TextBlock([text], kind="bad" if bad else "good")]
    rows: list[Sequence[Cell]] = [
        (badge(f["severity"]), f["found"], f["remedy"] or "", _runs(f["runs"]))
        for f in found["findings"]
    ]
    if rows:
        head = ("severity", "what was found", "what to do", "runs")
        blocks.append(TableBlock("Findings, the worst first.", head, rows))
    notes = [*found.get("suspects", ()), *found["messages"]]
    if notes:
        blocks.append(TextBlock(notes, listed=True, kind="note"))
    return PageSection("findings", "Findings", blocks)


def _runs(names: Sequence[str]) -> str:
    """Return the first names of some runs, and the number of further ones."""
    more = f" and {len(names) - 2} more" if len(names) > 2 else ""
    return f"{', '.join(names[:2])}{more}" if names else "all"


def _contents(found: Content) -> PageSection:
    head = ("floor", "load", "session", "runs", "minutes", "headings", "speeds [m/s]")
    rows = [
        (
            row["surface"],
            row["load"],
            row["session"],
            str(row["runs"]),
            f"{row['seconds'] / 60:.1f}",
            str(row["headings"] or ""),
            " ".join(f"{v:g}" for v in row["speeds"]),
        )
        for row in found["groups"]
    ]
    caption = "Runs by floor, load set-up and session; headings and speeds are commanded ones."
    blocks: list[Block] = [TableBlock(caption, head, rows, right=("runs", "minutes", "headings"))]
    skipped = list(found.get("skipped", ()))
    if skipped:
        blocks += [
            TextBlock([f"{len(skipped)} files were set aside:"]),
            TextBlock(skipped, listed=True),
        ]
    if found["notes"]:
        repaired = [f"in {count} runs: {note}" for note, count in found["notes"].items()]
        blocks += [
            TextBlock(["Repaired when the logs were read:"]),
            TextBlock(repaired, listed=True),
        ]
    return PageSection("logs", "What was logged", blocks)


def _drawn(data: Runs) -> list[int]:
    """Return the indices of the drawn runs."""
    last = len(data) - 1
    return sorted(set(np.linspace(0, last, min(last + 1, MOST_DRAWN)).round().astype(int).tolist()))


def _paths(data: Runs) -> PageSection | None:
    """Return the section with the logged paths from their start."""
    floors, traces, seen = list(dict.fromkeys(data.surface)), [], set()
    for k in _drawn(data):
        pose = data.pose[data.rows(k)][data.fresh[data.rows(k)]]
        pose = pose[np.isfinite(pose[:, :2]).all(axis=1)]
        if len(pose) < 2:
            continue
        pose = pose[:: max(1, len(pose) // MOST_POSES)]
        floor = data.surface[k]
        n = floors.index(floor)
        x, y = (np.round(pose[:, a] - pose[0, a], 4).tolist() for a in (0, 1))
        more = {"legendgroup": floor, "showlegend": floor not in seen}
        seen.add(floor)
        text = data.logs[k].name
        hover = f"{text}<br>%{{x:.2f}} m, %{{y:.2f}} m<extra></extra>"
        style = {"width": 1.3, "dash": ("solid", "dash", "dot", "dashdot")[n % 4]}
        shade = draw.SERIES[n % len(draw.SERIES)]
        traces.append(draw.line(x, y, floor, shade, line=style, hovertemplate=hover, **more))
    if not traces:
        return None
    layout = {
        "xaxis": draw.axis("x from the start [m]"),
        "yaxis": draw.axis("y from the start [m]", scaleanchor="x"),
        "showlegend": True,
    }
    title = f"Logged paths of {len(traces)} of {len(data)} runs, each from its start"
    alt = f"{title}. Lines of the measured positions."
    caption = "Positions as logged, before any correction; hover names the run."
    return PageSection(
        "paths", "Paths", [FigureBlock("paths", title, alt, traces, layout, caption, 460)]
    )


def _signals(data: Runs) -> PageSection:
    """Return the section with the wheel speeds and currents of the drawn runs."""
    wheels = data.wheel_angle.shape[1]
    kinds = ["speed", *(["current"] if data.current is not None else [])]
    names = [f"drive {w + 1}" for _ in kinds for w in range(wheels)]
    layout, axes, rows = draw.panels(len(names), names, wheels)
    floors = list(dict.fromkeys(data.surface))
    traces = []
    for k in _drawn(data):
        span = data.rows(k)
        time = data.time[span] - data.time[span][0]
        some = slice(None, None, max(1, len(time) // MOST_ROWS))
        speed = np.gradient(data.wheel_angle[span], data.time[span], axis=0)
        values = [speed, *([data.current[span]] if data.current is not None else [])]
        n = 0
        shade = draw.SERIES[floors.index(data.surface[k]) % len(draw.SERIES)]
        for value in values:
            for w in range(wheels):
                shown = [
                    None if not np.isfinite(v) else round(v, 3) for v in value[some, w].tolist()
                ]
                style = {"line": {"width": 1}, "opacity": 0.4, "text": data.logs[k].name}
                hover = "%{text}: %{y:.2f} at %{x:.1f} s<extra></extra>"
                x = np.round(time[some], 2).tolist()
                trace = draw.line(x, shown, "", shade, hovertemplate=hover, **style)
                traces.append(draw.onto(trace, axes[n]))
                n += 1
    layout["showlegend"] = False
    for row, kind in enumerate(kinds):
        unit = "speed [rad/s]" if kind == "speed" else "current [A]"
        layout[f"yaxis{axes[row * wheels]}"] |= draw.axis(unit)
    title = "Speeds" + (" and currents" if len(kinds) > 1 else "") + " of the drives over time [s]"
    alt = f"{title}, a panel for each drive, a line for each run."
    caption = "A line for each run, in the colour of its floor as above; hover names the run."
    figure = FigureBlock(
        "signals", title, alt, traces, layout, caption, 60 + 220 * rows, minimum=560
    )
    return PageSection("signals", "Signals of the wheels", [figure])


def _calibration(found: Content) -> PageSection | None:
    if "calibration" not in found:
        return None
    return PageSection("calibration", "Calibration", [calibration_table(found["calibration"])])


def _expected(found: Content) -> PageSection | None:
    """Return the section on how much a fit to these logs may tell of each parameter."""
    numbers = found["parameters"] | found.get("derived", {})
    rows: list[Sequence[Cell]] = []
    for path, e in numbers.items():
        if e["ratio"] is None or "session_yaw" in path:
            continue
        pairs = [(e["ratio"], e["verdict"])]
        if "best_ratio" in e:
            pairs.append((e["best_ratio"], e["best_verdict"]))
        shown = " to ".join(dict.fromkeys(f"{min(ratio, 1.0):.3f}" for ratio, _ in pairs))
        words = list(dict.fromkeys(word for _, word in pairs))
        cells = (badge(words[0]), badge(words[-1]) if len(words) > 1 else "")
        rows.append((path, e["unit"], shown, *cells))
    if not rows:
        return None
    head = ("parameter", "unit", "std after / before", "at worst", "at best")
    caption = (
        "What a fit to these logs can find, from the least to the most informative of plausible "
        "floors, motors and noise. Small ratios are good."
    )
    return PageSection(
        "expected", "What a fit can identify", [TableBlock(caption, head, rows, right=head[2:3])]
    )


def _settings(found: Content) -> PageSection | None:
    """Return the section with the limits and the noise that the logs show, for the config."""
    if not found.get("settings"):
        return None
    lines = []
    for group, values in found["settings"].items():
        lines += [f"[robot.{group}]", *(f"{key} = {value:g}" for key, value in values.items()), ""]
    about = TextBlock(
        ["Limits and noise by these logs; `slipid identify` uses them without asking."]
    )
    code = CopyLines("For the config", "\n".join(lines).strip())
    return PageSection("settings", "Limits and noise", [about, code])
