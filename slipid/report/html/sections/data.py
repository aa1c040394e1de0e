"""Sections about the data: correlations in words, coverage and quality, and posterior draws."""

from collections.abc import Sequence

import numpy as np

from slipid.report.html import figures as draw
from slipid.report.html.blocks import (
    Block,
    FigureBlock,
    PageSection,
    TableBlock,
    TextBlock,
    Trace,
    enumerated,
    number,
)
from slipid.report.html.evidence import FitEvidence
from slipid.report.html.results import Results
from slipid.report.html.sections.summary import MOST_NOTES, ranked_notes
from slipid.support.content import Content

STRONG = 0.9
"""Absolute correlation from which a pair of parameters is named [1]."""
MOST_PAIRS, MOST_NAMES = 6, 26
"""Largest numbers of named pairs, and of parameters in the figure of correlations."""
SECTOR_DEG = 30
"""Width of a sector of directions of travel [deg]."""


def correlations(found: Results) -> PageSection | None:
    """Return the section about correlations and flat directions, in words and as a figure."""
    if found.fit is None:
        return None
    blocks: list[Block] = []
    if flat := list(dict.fromkeys(f["formula"] for f in found.fit["flat"])):
        intro = "Changes of the parameters that have no effect, or almost none, on the data:"
        blocks += [TextBlock([intro]), TextBlock(flat, listed=True)]
    if found.evidence is not None and found.evidence.correlations is not None:
        blocks += _matrix(found.evidence)
    return (
        PageSection("correlations", "What the logs cannot tell apart", blocks) if blocks else None
    )


def _matrix(evidence: FitEvidence) -> list[Block]:
    """Return the strongest correlations as sentences, and the matrix as a figure."""
    c = evidence.correlations
    assert c is not None
    keep = [k for k, name in enumerate(c.names) if "session_yaw" not in name]
    names = [c.names[k] for k in keep]
    rho = np.array(c.percent)[np.ix_(keep, keep)] / 100
    if len(names) < 2:
        return []
    i, j = np.triu_indices(len(names), 1)
    order = np.argsort(-np.abs(rho[i, j]))
    pairs = [(names[i[n]], names[j[n]], rho[i[n], j[n]]) for n in order]
    strong = [p for p in pairs if abs(p[2]) >= STRONG]
    pairs_in_words = [f"{a} and {b}: {_in_words(r)}" for a, b, r in strong[:MOST_PAIRS]]
    top = sorted(range(len(names)), key=lambda k: -np.sort(np.abs(rho[k]))[-2])[:MOST_NAMES]
    top.sort()
    shown = [names[k] for k in top]
    title = (
        f"{len(strong)} pairs of parameters are correlated by {STRONG:g} or more"
        if strong
        else f"No pair of parameters is correlated by {STRONG:g} or more"
    )
    heat = {
        "type": "heatmap",
        "z": rho[np.ix_(top, top)].round(2).tolist(),
        "x": shown,
        "y": shown,
        "zmin": -1,
        "zmax": 1,
        "colorscale": [[0, "#D55E00"], [0.5, "#f7f7f7"], [1, "#0072B2"]],
        "hovertemplate": "%{x} and %{y}: %{z:.2f}<extra></extra>",
        "colorbar": {"thickness": 12, "title": {"text": "correlation"}},
    }
    small = {"automargin": True, "tickfont": {"size": 9}}
    layout = {"xaxis": small | {"tickangle": -60}, "yaxis": small | {"autorange": "reversed"}}
    more = f" The {len(shown)} most correlated of {len(names)}." if len(shown) < len(names) else ""
    caption = f"Blue: they rise together; orange: one rises while the other falls.{more}"
    alt = f"{title}. Matrix of the correlations of fitted parameters."
    figure = FigureBlock(
        "correlation", title, alt, [heat], layout, caption, 160 + 19 * len(shown), minimum=620
    )
    blocks: list[Block] = []
    if pairs_in_words:
        blocks.append(TextBlock(["Pairs of which the data know a combination better than each:"]))
        blocks.append(TextBlock(pairs_in_words, listed=True))
    return [*blocks, figure]


def _in_words(rho: float) -> str:
    """Return a correlation in words."""
    known = "difference (or ratio)" if rho > 0 else "sum (or product)"
    return f"correlation {rho:+.2f}, so that their {known} is known best"


def quality(found: Results) -> PageSection:
    """Return the section about the quality of the data."""
    blocks: list[Block] = []
    evidence = found.evidence
    if evidence is not None and evidence.quarters.run:
        blocks += [_coverage_table(found, evidence), _coverage(evidence)]
    if (facts := _clocks(found)) is not None:
        blocks.append(facts)
    skipped = list(found.run["data"].get("skipped", ()))
    if skipped:
        blocks += [
            TextBlock([f"{len(skipped)} files or runs were set aside:"]),
            TextBlock(skipped, listed=True),
        ]
    else:
        blocks.append(TextBlock(["No file and no run was set aside."]))
    if found.outdated:
        names = enumerated([f"{name}.json" for name in found.outdated])
        blocks.append(
            TextBlock(
                [f"Left out, as of a different fit: {names}. Run its command again."], kind="note"
            )
        )
    if more := ranked_notes(found)[MOST_NOTES:]:
        blocks += [TextBlock(["Further notes:"]), TextBlock(more, listed=True)]
    if evidence is not None and evidence.notes:
        blocks.append(TextBlock(evidence.notes, listed=True, kind="note"))
    return PageSection("data", "Quality of the data", blocks)


def _coverage_table(found: Results, evidence: FitEvidence) -> TableBlock:
    """Return a table of what was driven on each floor with each load."""
    q, runs, sideways = evidence.quarters, evidence.runs, evidence.wheels.sideways
    rows = []
    for floor, load in dict.fromkeys((run.floor, run.load) for run in runs):
        mine = [k for k, run in enumerate(runs) if (run.floor, run.load) == (floor, load)]
        parts = np.array([n for n, r in enumerate(q.run) if r in set(mine)])
        speed = np.array(q.speed)[parts]
        turn = np.array(q.turn_deg_s)[parts]
        headings = [q.heading_deg[n] for n in parts.tolist()]
        sectors = {int(h // SECTOR_DEG) for h in headings if h is not None}
        rows.append(
            (
                floor,
                load,
                str(len(mine)),
                f"{sum(runs[k].seconds for k in mine) / 60:.1f}",
                f"{sum(runs[k].path_m for k in mine):.1f}",
                f"{speed.min():.2f} to {speed.max():.2f}",
                f"{turn.min():.0f} to {turn.max():.0f}",
                *([f"{len(sectors)} of {360 // SECTOR_DEG}"] if sideways else []),
                f"{sum(runs[k].rest_s for k in mine):.0f}",
            )
        )
    head = (
        "floor",
        "load",
        "runs",
        "minutes",
        "metres",
        "speed [m/s]",
        "turn [deg/s]",
        *(["directions"] if sideways else []),
        "rest [s]",
    )
    caption = f"What was driven: {len(runs)} runs."
    if sideways:
        caption += f" Directions are sectors of {SECTOR_DEG} degrees in the body frame."
    return TableBlock(caption, head, rows, right=head[2:])


def _coverage(evidence: FitEvidence) -> FigureBlock:
    """Return the figure of directions, speeds and turns that were driven."""
    q, runs = evidence.quarters, evidence.runs
    floors = list(dict.fromkeys(run.floor for run in runs))
    holonomic = evidence.wheels.sideways
    data = []
    for k, floor in enumerate(floors):
        mine = [n for n, r in enumerate(q.run) if runs[r].floor == floor]
        mine = [n for n in mine if not holonomic or q.heading_deg[n] is not None]
        shared = {
            "type": "scatterpolar" if holonomic else "scatter",
            "mode": "markers",
            "name": floor,
            "marker": {
                "color": draw.SERIES[k % len(draw.SERIES)],
                "symbol": draw.SYMBOLS[k % len(draw.SYMBOLS)],
                "size": 6,
                "opacity": 0.55,
            },
            "text": [runs[q.run[n]].name for n in mine],
        }
        speed = [q.speed[n] for n in mine]
        if holonomic:
            angle = [q.heading_deg[n] for n in mine]
            hover = "%{text}<br>%{r:.2f} m/s at %{theta:.0f} deg<extra></extra>"
            data.append(shared | {"r": speed, "theta": angle, "hovertemplate": hover})
        else:
            signed = [
                -v if 90 < (q.heading_deg[n] or 0.0) < 270 else v
                for n, v in zip(mine, speed, strict=True)
            ]
            turn = [q.turn_deg_s[n] for n in mine]
            hover = "%{text}<br>%{x:.2f} m/s, %{y:.0f} deg/s<extra></extra>"
            data.append(shared | {"x": signed, "y": turn, "hovertemplate": hover})
    if holonomic:
        layout: Content = {
            "polar": {
                "bgcolor": "rgba(0,0,0,0)",
                "angularaxis": {"rotation": 90, "gridcolor": "@grid", "linecolor": "@muted"},
                "radialaxis": {"gridcolor": "@grid", "angle": 90, "tickangle": 90},
            },
            "showlegend": True,
        }
        missing = _missing(evidence, floors)
        title = f"Directions of travel {missing}"
        caption = "Distance from the middle: speed [m/s]; up is straight ahead, left is left."
    else:
        layout = {
            "xaxis": draw.axis("speed, backwards negative [m/s]", zeroline=True),
            "yaxis": draw.axis("yaw rate [deg/s]", zeroline=True),
            "showlegend": True,
        }
        title = _turns(evidence)
        caption = "A dot for every quarter of a run."
    alt = f"{title}. Dots show how the quarters of the runs were driven."
    return FigureBlock("coverage", title, alt, data, layout, caption, 400)


def _missing(evidence: FitEvidence, floors: Sequence[str]) -> str:
    """Return how completely the directions of travel were driven, floor by floor."""
    q, runs = evidence.quarters, evidence.runs
    all_sectors, parts = 360 // SECTOR_DEG, []
    for floor in floors:
        there = {
            int(h // SECTOR_DEG)
            for h, r in zip(q.heading_deg, q.run, strict=True)
            if h is not None and runs[r].floor == floor
        }
        if len(there) < all_sectors:
            parts.append(f"{all_sectors - len(there)} of {all_sectors} sectors on {floor}")
    return (
        f"are missing in {enumerated(parts)}" if parts else "cover the full circle on every floor"
    )


def _turns(evidence: FitEvidence) -> str:
    """Return a sentence about the turns to both sides."""
    turn = np.array(evidence.quarters.turn_deg_s)
    left, right = int((turn > 2).sum()), int((turn < -2).sum())
    straight = len(turn) - left - right
    return f"{straight} quarters of runs go straight, {left} turn left and {right} turn right"


def _clocks(found: Results) -> TextBlock | None:
    """Return sentences about lag and noise of the poses."""
    c = found.calibration
    if c is None:
        return None
    lag, low, high = (1e3 * x for x in (c["pose_lag_s"]["value"], *c["pose_lag_s"]["interval90"]))
    noise = c["noise"]
    out = [
        f"Poses lag behind the wheels by {lag:.0f} ms ({low:.0f} to {high:.0f}).",
        f"Noise of a logged position {1e3 * noise['place']:.1f} mm, of a heading "
        f"{np.degrees(noise['heading']):.2f} deg.",
    ]
    if not c["settled"]:
        out.append("The calibration had not settled when it ended.")
    return TextBlock([" ".join(out)])


PAIRS = 5
"""Largest number of parameters in the figure of pairs."""


def posterior(found: Results) -> PageSection | None:
    """Return the section about the posterior: convergence, and pairs of parameters."""
    if found.sample is None:
        return None
    s, worst = found.sample, found.sample["worst"]
    state = "converged" if s["converged"] else "NOT converged; do not trust the intervals"
    blocks: list[Block] = [
        TextBlock(
            [
                f"The chains have {state}: worst R-hat {worst['r_hat']:.3f}, "
                f"{worst['effective_draws']:.0f} effective draws of the worst number; "
                f"{s['ensembles']} ensembles of {s['walkers']} walkers, {s['steps']} steps."
            ],
            kind="plain" if s["converged"] else "warning",
        )
    ]
    if found.draws:
        blocks.append(_pairs(found, found.draws))
    else:
        blocks.append(
            TextBlock(["Pairs need the draws in posterior.nc, and the extra `posterior`."])
        )
    return PageSection("posterior", "Posterior", blocks)


def _pairs(found: Results, draws: dict[str, np.ndarray]) -> FigureBlock:
    """Return the scatter plots of pairs of the most correlated scalar parameters."""
    free = {
        p: x
        for p, x in draws.items()
        if np.ptp(x) > 0 and found.parameters.get(p, {}).get("verdict", "fixed") != "fixed"
    }
    names = list(free)
    rho = np.corrcoef(np.stack([free[p] for p in names])) - np.eye(len(names))
    chosen: list[str] = []
    for n in np.argsort(-np.abs(np.triu(rho)), axis=None):
        for k in np.unravel_index(n, rho.shape):
            if names[k] not in chosen and len(chosen) < PAIRS:
                chosen.append(names[k])
        if len(chosen) >= min(PAIRS, len(names)):
            break
    index = [names.index(p) for p in chosen]
    block = np.triu(rho[np.ix_(index, index)], 1)
    i, j = np.unravel_index(np.argmax(np.abs(block)), block.shape)
    title = f"{chosen[i]} and {chosen[j]} have correlation {block[i, j]:+.2f}"
    data, layout = _pair_panels({p: free[p] for p in chosen})
    alt = f"{title}. Scatter plots of pairs of the {len(chosen)} most correlated parameters."
    caption = f"Draws of the {len(chosen)} most correlated parameters; a line means a trade-off."
    height = 80 + 120 * (len(chosen) - 1)
    return FigureBlock("pairs", title, alt, data, layout, caption, height, minimum=620)


def _pair_panels(draws: dict[str, np.ndarray]) -> tuple[list[Trace], Content]:
    """Return series and layout of a triangle of scatter plots, a panel for each pair."""
    names, data = list(draws), []
    count = len(names) - 1
    layout: Content = {"showlegend": False}
    for row in range(count):
        for column in range(row + 1):
            name = str(row * count + column + 1) if row + column else ""
            x, y = ([float(number(v, 5)) for v in draws[names[k]]] for k in (column, row + 1))
            fine = {"size": 3, "opacity": 0.3}
            dots = draw.dots(x, y, "", "@blue", hoverinfo="skip", marker=fine)
            data.append(draw.onto(dots, name))
            small: Content = {"tickfont": {"size": 9}, "nticks": 4}
            left, top, size = column / count, 1 - row / count, 0.8 / count
            across, up = [left, left + size], [top - size, top]
            layout[f"xaxis{name}"] = small | {"domain": across, "anchor": f"y{name}"}
            layout[f"yaxis{name}"] = small | {"domain": up, "anchor": f"x{name}"}
            layout[f"xaxis{name}"]["showticklabels"] = row == count - 1
            layout[f"yaxis{name}"]["showticklabels"] = column == 0
            if row == count - 1:
                layout[f"xaxis{name}"]["title"] = _small(names[column])
            if column == 0:
                layout[f"yaxis{name}"]["title"] = _small(names[row + 1])
    return data, layout


def _small(path: str) -> Content:
    """Return the title of an axis, with a line for each part of a path."""
    return {"text": path.replace(".", "<br>"), "font": {"size": 10}}
