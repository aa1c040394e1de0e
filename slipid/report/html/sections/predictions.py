"""Sections about predictions: held-out errors, unseen runs, ranking, paths and residuals."""

from collections.abc import Mapping, Sequence

import numpy as np

from slipid.report.html import figures as draw
from slipid.report.html.blocks import (
    Block,
    Cell,
    FigureBlock,
    PageSection,
    Player,
    TableBlock,
    TextBlock,
    badge,
    colour,
    enumerated,
    label,
    marker,
)
from slipid.report.html.evidence import MapEvidence, Quarters, RunEvidence, Track
from slipid.report.html.results import Results
from slipid.report.html.sections.summary import percent
from slipid.support.content import Content

SHOWN_RANKS = 5
"""Number of models of a ranking that are listed; the figure shows all."""
MOST_NAMED = 4
"""Largest number of floors that a title names."""
HALF90 = 1.645
"""Half width of a 90 % interval of a normal distribution [std]."""


def held_out(found: Results) -> PageSection | None:
    """Return the section about errors on held-out runs, model by model."""
    blocks: list[Block] = []
    if errors := found.trust.get("held_out_error_over_path"):
        blocks += _selection(found, errors)
    if found.validation is not None:
        blocks += _validation(found.validation)
    if found.comparison is not None:
        blocks += _ranking(found.comparison)
    return PageSection("errors", "How well it predicts", blocks) if blocks else None


def _selection(found: Results, errors: Content) -> list[Block]:
    """Return figure and table of the errors by which models were selected."""
    behind = {} if found.fit is None else found.fit.get("selection", {})
    floors, rows = list(errors), []
    models = list(dict.fromkeys(m for each in errors.values() for m in each))
    data = []
    for model in models:
        mine = [f for f in floors if model in errors[f]]
        spread = [
            100 * HALF90 * behind[f]["behind"][model][1] if f in behind else 0.0 for f in mine
        ]
        data.append(
            draw.errors(
                [100 * errors[f][model] for f in mine],
                mine,
                (spread, spread),
                label(model),
                colour(model),
                marker=marker(model),
                hovertemplate="%{y}: %{x:.2f} % of the path<extra>%{fullData.name}</extra>",
            )
        )
    for floor, each in errors.items():
        best = found.selected[floor]
        for model, error in each.items():
            extra = behind.get(floor, {}).get("behind", {}).get(model)
            difference = ""
            if extra is not None and any(extra):
                difference = f"{100 * extra[0]:+.2f} ± {100 * HALF90 * extra[1]:.2f}"
            chosen: Cell = badge("selected") if model == best else ""
            row = (floor, label(model), f"{100 * error:.2f}", difference, chosen)
            rows.append(row)
    title = "; ".join(_compared(f, errors[f], found.selected[f]) for f in floors[:MOST_NAMED])
    if len(floors) > MOST_NAMED:
        title += f"; {len(floors) - MOST_NAMED} more in the table"
    layout: Content = {
        "xaxis": draw.axis("error on held-out runs [% of the path]", rangemode="tozero"),
        "yaxis": {"automargin": True, "autorange": "reversed"},
        "showlegend": True,
    }
    if is_wide([100 * e for each in errors.values() for e in each.values()]):
        layout["xaxis"] |= draw.logarithmic() | {"rangemode": "normal"}
    alt = f"{title}. Dots show the error of every model on every floor; the table has the numbers."
    caption = (
        "Mean over held-out runs and their halves; bars are 90 % intervals of the difference from "
        "the best model on the same runs."
    )
    height = 130 + 55 * len(floors)
    head = ("floor", "model", "error [% of the path]", "minus the best", "")
    about = "Errors of the models on held-out runs, with 90 % intervals of the difference."
    return [
        FigureBlock("held_out", title, alt, data, layout, caption, height),
        TableBlock(about, head, rows, right=head[2:4], folded=True),
    ]


def is_wide(values: Sequence[float]) -> bool:
    """Return whether values need a logarithmic axis."""
    return min(values) > 0 and max(values) > 15 * min(values)


def _compared(floor: str, errors: Content, chosen: str) -> str:
    """Return a sentence that compares the selected model with the config's lengths on a floor."""
    sentence = f"{floor}: {label(chosen)} off by {percent(errors[chosen])}"
    if chosen != "nominal" and "nominal" in errors:
        sentence += f", the config's lengths by {percent(errors['nominal'])}"
    return sentence


MODELS = ("nominal", "encoder", "calibrated", "identified", "selected", "heading_lookup", "paper")
"""Models of a validation that are shown."""


def _validation(content: Content) -> list[Block]:
    """Return figure and table of the predictions of other runs."""
    summary = content["summary"]
    floors = list(summary)
    names = [m for m in MODELS if any(m in summary[f] for f in floors)]
    data, rows = [], []
    for model in names:
        mine = [f for f in floors if model in summary[f]]
        error = [100 * summary[f][model]["endpoint_error_over_path_mean"] for f in mine]
        data.append(draw.dots(error, mine, label(model), colour(model), marker=marker(model)))
        for f in mine:
            one = summary[f][model]
            inside = one["coverage90"]
            shown = "" if inside is None else f"{100 * inside:.0f}"
            turn = one["heading_error_median_deg"]
            cells = (
                f"{100 * one['endpoint_error_over_path_mean']:.2f}",
                "" if turn is None else f"{turn:.2f}",
                shown,
                str(one["runs"]),
            )
            rows.append((f, label(model), *cells))
    rows.sort(key=lambda row: floors.index(row[0]))
    chosen = "selected" if "selected" in names else "identified"
    parts = [
        f"{f} {percent(summary[f][chosen]['endpoint_error_over_path_mean'])}"
        for f in floors
        if chosen in summary[f]
    ]
    title = f"Other runs: the {label(chosen)} ends off by {enumerated(parts)} of the path"
    every = [s["endpoint_error_over_path_mean"] for f in summary.values() for s in f.values()]
    layout: Content = {
        "xaxis": draw.axis("mean end-point error [% of the path]"),
        "yaxis": {"automargin": True, "autorange": "reversed"},
        "showlegend": True,
    }
    layout["xaxis"] |= draw.logarithmic() if is_wide(every) else {"rangemode": "tozero"}
    alt = f"{title}. Dots show the error of every model by floor; the table has the numbers."
    head = ("floor", "model", "end error [% of path]", "heading [deg]", "in 90 % region", "runs")
    about = "Errors of open-loop predictions of the runs of `slipid validate`, and coverage [%]."
    return [
        FigureBlock("validation", title, alt, data, layout, "", 140 + 55 * len(floors)),
        TableBlock(about, head, rows, right=head[2:], folded=True),
    ]


def _ranking(content: Content) -> list[Block]:
    """Return figure and sentences of a comparison of slip models."""
    out: list[Block] = []
    for question, answer in content["questions"].items():
        for floor, one in answer["floors"].items():
            models = one["models"]
            order = sorted(models, key=lambda m: models[m]["difference"])
            spread = [HALF90 * (models[m]["se_clustered"] or 0.0) for m in order]
            behind = [-models[m]["difference"] for m in order]
            data = [
                draw.errors(
                    behind,
                    [label(m) for m in order],
                    (spread, spread),
                    "nats per run behind the best",
                    "@blue",
                )
            ]
            layout = {
                "xaxis": draw.axis("behind the best [nats per run]", rangemode="tozero"),
                "yaxis": {"automargin": True},
                "showlegend": False,
            }
            name = f"ranking_{question}_{floor}"
            best, then = order[-1], order[-2] if len(order) > 1 else order[-1]
            title = f"{question} held out, {floor}: {label(best)} is best, then {label(then)}"
            alt = f"{title}. Dots show how far every model is behind the best."
            caption = (
                f"{one['sentence']}. One nat behind: the poses of a run are 2.7 times less "
                "probable under that model."
            )
            height = 130 + 22 * len(order)
            out.append(FigureBlock(name, title, alt, data, layout, caption, height))
            listed = order[::-1][:SHOWN_RANKS]
            rows = [
                (
                    label(m),
                    f"{models[m]['difference']:.1f}",
                    f"{100 * models[m]['endpoint_error']:.1f}",
                )
                for m in listed
            ]
            head = ("model", "log density [nats per run]", "end error [% of chord]")
            about = f"The {len(listed)} best of {len(order)} models on {floor}."
            out.append(TableBlock(about, head, rows, right=head[1:], folded=True))
    return out


def paths(found: Results) -> PageSection | None:
    """Return the section in which the path of any run can be played."""
    evidence = found.evidence
    shown = [] if evidence is None else [*evidence.runs, *evidence.over_floors]
    if evidence is None or not shown:
        notes = [] if evidence is None else evidence.notes
        return PageSection("paths", "Paths", [TextBlock(notes, kind="note")]) if notes else None
    names = list(dict.fromkeys(m for run in shown for m in run.models))
    about = (
        "Every run of the fit, predicted from its first pose and the wheels alone, as if it were "
        "the only run of its session. The ellipse is the 90 % region of the selected model. These "
        f"runs were fitted: the errors of held-out runs are above.{_inside(evidence.runs)}"
    )
    if evidence.over_floors:
        refused = found.fit is not None and "refused" in found.fit["settings"]
        about += (
            f" Runs over several floors ({len(evidence.over_floors)}) are drawn on their map, from "
            "which the models take the floor under each wheel; they have no region"
            f"{', and were not used in the fit, which they contradict' if refused else ''}."
        )
    alt = (
        "Measured path of a run, and its predictions by the config's lengths, by calibrated "
        "kinematics and by the selected model, on the floor seen from above."
    )
    runs, maps = [_played(run) for run in shown], [_drawn(each) for each in evidence.maps]
    player = Player(runs, maps, {m: label(m) for m in names}, alt)
    return PageSection("paths", "Play a run", [TextBlock([about]), player])


def _drawn(floor: MapEvidence) -> Content:
    """Return the content of a floor map from which the page draws it."""
    return {
        "surfaces": floor.surfaces,
        "corner": floor.corner_m,
        "cell": floor.cell_m,
        "cells": floor.cells,
    }


def _inside(runs: Sequence[RunEvidence]) -> str:
    """Return a sentence on how many runs end inside their 90 % region; empty without regions."""
    inside = []
    for run in runs:
        if run.region is None:
            continue
        k, end = run.region.edge[-1], run.models[run.selected]
        off = np.array([run.measured.x_mm[k] - end.x_mm[k], run.measured.y_mm[k] - end.y_mm[k]])
        c, s = (f(run.region.angle_mrad[-1] / 1000) for f in (np.cos, np.sin))
        axes = np.array([run.region.major_mm[-1], run.region.minor_mm[-1]])
        inside.append(bool(np.sum((np.array([[c, s], [-s, c]]) @ off / axes) ** 2) <= 1.0))
    return f" {sum(inside)} of {len(inside)} end inside their region." if inside else ""


def _played(run: RunEvidence) -> Content:
    """Return the content of a run from which the page plays it."""
    region = None if run.region is None else run.region.model_dump()
    # a command that changes its direction has a median far below the speed of the run
    steady = run.speed is not None and run.speed * run.seconds > 0.5 * run.path_m
    return {
        "name": run.name,
        "floor": run.floor,
        "load": run.load,
        "map": run.map,
        "speed": run.speed if steady else None,
        "heading": run.heading_deg if steady else None,
        "path": run.path_m,
        "time": run.time_s,
        "measured": _flat(run.measured),
        "models": {name: _flat(track) for name, track in run.models.items()},
        "region": region,
        "headings": any(run.measured.yaw_mrad),
        "selected": run.selected,
        "error": round(1000 * end_error(run, run.selected)),
    }


def _flat(track: Track) -> list[list[int]]:
    return [track.x_mm, track.y_mm, track.yaw_mrad]


def end_error(run: RunEvidence, model: str) -> float:
    """Return the end-point error of a model in a run [m]."""
    a, b = run.models[model], run.measured
    return float(np.hypot(a.x_mm[-1] - b.x_mm[-1], a.y_mm[-1] - b.y_mm[-1])) / 1000


ERRORS: Mapping[str, tuple[str, str]] = {
    "along_mm_s": ("along the motion", "mm/s"),
    "across_mm_s": ("across the motion", "mm/s"),
    "yaw_deg_s": ("yaw rate", "deg/s"),
}
"""Label and unit of each error of a quarter of a run, keyed by its column."""
CONDITIONS: Mapping[str, str] = {
    "time_s": "time in the run [s]",
    "speed": "speed [m/s]",
    "heading_deg": "direction of travel [deg]",
    "turn_deg_s": "yaw rate [deg/s]",
}
"""Title of the axis of each condition of a quarter, keyed by its column."""


def residuals(found: Results) -> PageSection | None:
    """Return the section about errors of the selected model in quarters of the runs."""
    evidence = found.evidence
    if evidence is None or not evidence.quarters.run:
        return None
    q, runs = evidence.quarters, evidence.runs
    floors = list(dict.fromkeys(run.floor for run in runs))
    wanted = [c for c in CONDITIONS if _varies(getattr(q, c))]
    layout, axes, rows = draw.panels(len(wanted), [CONDITIONS[c] for c in wanted], 2)
    data: list[Content] = []
    choices: dict[str, list[list[float | None]]] = {
        f"{text} [{unit}]": [] for text, unit in ERRORS.values()
    }
    for panel, condition in zip(axes, wanted, strict=True):
        for k, floor in enumerate(floors):
            mine = [n for n, r in enumerate(q.run) if runs[r].floor == floor]
            trace = draw.dots(
                [getattr(q, condition)[n] for n in mine],
                [q.along_mm_s[n] for n in mine],
                floor,
                draw.SERIES[k % len(draw.SERIES)],
                marker={"symbol": draw.SYMBOLS[k % len(draw.SYMBOLS)]},
                text=[f"{runs[q.run[n]].name}, {q.time_s[n]:g} s" for n in mine],
                hovertemplate="%{text}<br>%{x:.3g}, error %{y:.2f}<extra>%{fullData.name}</extra>",
                legendgroup=floor,
                showlegend=panel == axes[0],
            )
            data.append(draw.onto(trace, panel))
            for column, (text, unit) in ERRORS.items():
                choices[f"{text} [{unit}]"].append([getattr(q, column)[n] for n in mine])
        layout[f"yaxis{panel}"]["zeroline"] = True
    titles = {
        f"{text} [{unit}]": _bias(q, column, f"{text} [{unit}]", runs)
        for column, (text, unit) in ERRORS.items()
    }
    title = next(iter(titles.values()))
    alt = f"{title}. Dots show predicted less measured motion in quarters of runs."
    caption = "Predicted less measured motion of the selected model in quarters of the runs."
    figure = FigureBlock(
        "residuals", title, alt, data, layout, caption, 60 + 260 * rows, choices, titles, 520
    )
    return PageSection("residuals", "What the model leaves unexplained", [figure])


def _varies(column: Sequence[float | None]) -> bool:
    there = [x for x in column if x is not None]
    return len(there) > 2 and max(there) - min(there) > 1e-3


TREND = 0.4
"""Rank correlation of errors with a condition from which on a trend is named [1]."""


def _bias(q: Quarters, column: str, text: str, runs: Sequence[RunEvidence]) -> str:
    """Return a sentence on mean, spread and trends of one error, floor by floor.

    Args:
        q: quarters of the runs.
        column: column of the error.
        text: name of the error, with its unit.
        runs: the runs.
    """
    from scipy.stats import spearmanr

    error, parts, trends = np.array(getattr(q, column)), [], []
    under = np.array([runs[r].floor for r in q.run])
    for floor in dict.fromkeys(under.tolist()):
        mine = error[under == floor]
        parts.append(f"{floor} {mine.mean() + 0.0:+.1f} ± {mine.std():.1f}".replace("-0.0", "+0.0"))
        for condition in ("speed", "turn_deg_s"):
            x = np.array(getattr(q, condition))[under == floor]
            if len(x) > LEAST_FOR_TREND and np.ptp(x) > 0 and np.ptp(mine) > 0:
                rank = float(spearmanr(x, mine).statistic)
                if abs(rank) > TREND:
                    name = CONDITIONS[condition].split(" [")[0]
                    trends.append(f"{'rises' if rank > 0 else 'falls'} with {name} on {floor}")
    trend = f"; it {', '.join(trends)}" if trends else "; no trend with speed or turn"
    return f"Error {text}, mean and spread: {', '.join(parts)}{trend}"


LEAST_FOR_TREND = 12
"""Smallest number of quarters in which a trend is looked for."""
