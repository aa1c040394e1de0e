"""Sections about what follows a fit: trial, further runs, comparison with others, provenance."""

import math

from slipid.infer.verdicts.trust import WORDS
from slipid.report.html import figures as draw
from slipid.report.html.blocks import (
    Block,
    CopyLines,
    FigureBlock,
    PageSection,
    TableBlock,
    TextBlock,
)
from slipid.report.html.results import Results


def trial(found: Results) -> PageSection | None:
    """Return the section about the trial of controllers in simulation."""
    t = found.trial
    if t is None:
        return None
    names = sorted(t["summary"], key=lambda n: -t["summary"][n]["closure_error_median"])
    data = []
    for k, name in enumerate(names):
        row = t["summary"][name]
        middle = row["closure_error_median"]
        low, high = row["interval90"]["closure_error_median"] or (middle, middle)
        shade = "@orange" if name == "encoder" else draw.SERIES[0]
        hover = "%{x:.0f} mm<extra>%{fullData.name}</extra>"
        spread = [middle - low], [high - middle]
        data.append(draw.errors([middle], [k], spread, name, shade, hovertemplate=hover))
    title = t["verdict"][0].upper() + t["verdict"][1:]
    layout = {
        "xaxis": draw.axis(
            "distance from the start after the closed path [mm]", rangemode="tozero"
        ),
        "yaxis": {"automargin": True, "tickvals": list(range(len(names))), "ticktext": names},
        "showlegend": False,
    }
    summaries = t["summary"].values()
    runs = min(row["runs"] for row in summaries)
    known = all(row["interval90"]["closure_error_median"] for row in summaries)
    intervals = "with 90 % intervals" if known else "too few for intervals"
    caption = (
        f"Medians of {runs} starts, {intervals}; path '{t['path']}' at {t['speed_m_s']:g} m/s."
    )
    figure = FigureBlock("trial_errors", title, title, data, layout, caption, 130 + 34 * len(names))
    rows = [
        (
            n,
            t["controllers"].get(n, n),
            f"{t['summary'][n]['closure_error_median']:.0f}",
            f"{t['summary'][n]['cross_track_rmse']:.0f}",
            f"{t['summary'][n]['heading_error_deg']:.1f}",
            f"{100 * t['summary'][n]['finished_share']:.0f}",
        )
        for n in reversed(names)
    ]
    head = (
        "controller",
        "what it is",
        "closure [mm]",
        "cross-track [mm]",
        "heading [deg]",
        "finished [%]",
    )
    plant = "the fitted model itself" if t["plant"] == "twin" else "a robot in a physics engine"
    site = f" ({t['site']})" if t.get("site") else ""
    about = (
        f"Errors of the controllers on the path '{t['path']}'. The simulated robot is "
        f"{plant}{site}; its floor: {t['map']}."
    )
    return PageSection(
        "trial", "Trial of controllers", [figure, TableBlock(about, head, rows, right=head[2:])]
    )


def design(found: Results) -> PageSection | None:
    """Return the section with the runs to drive next."""
    d = found.design
    if d is None or not d["runs"]:
        return None
    rows = [
        (
            str(k),
            run["floor"],
            run["load"],
            f"{run['heading_deg']:.0f} deg" if run["speed"] else "",
            f"{run['speed']:g}" if run["speed"] else "",
            f"{math.degrees(run['turn_rate']):.0f}" if run["turn_rate"] else "",
            f"{run['seconds']:.1f}",
        )
        for k, run in enumerate(d["runs"], start=1)
    ]
    head = ("run", "floor", "load", "direction", "speed [m/s]", "turn [deg/s]", "seconds")
    about = "Runs that narrow the intervals most, in the order in which to drive them."
    blocks: list[Block] = [TableBlock(about, head, rows, right=head[4:])]
    if d["messages"]:
        blocks.append(TextBlock(d["messages"], listed=True, kind="note"))
    return PageSection("design", "What to drive next", blocks)


def provenance(found: Results) -> PageSection:
    """Return the section about the origin of the results, and the commands that follow."""
    run, out = found.run, found.folder
    config, data = run["config"], run["data"]
    rows = [
        ("finished", str(run["finished"])),
        ("duration of the fit", f"{run['seconds']:.0f} s"),
        ("config", f"{config['name']}, SHA-256 {config['sha256'][:16]}"),
        ("logs", f"{len(data['logs'])} runs, hash {data['hash'][:16]}"),
        ("seed", str(run.get("seed", ""))),
        ("versions", ", ".join(f"{k} {v}" for k, v in run.get("versions", {}).items())),
    ]
    if found.fit is not None:
        ended = "converged" if found.fit["converged"] else "did NOT converge"
        rows.append(("optimisation", f"{ended}: {found.fit['reason']}"))
    blocks: list[Block] = [TableBlock("Where these results come from.", ("what", "value"), rows)]
    kind = "" if found.fit is not None else " --only calibration"
    blocks.append(
        CopyLines(
            "To repeat it",
            f"slipid identify {out.name}/config.toml --data LOGS --out {out.name}{kind}",
        )
    )
    lines = [f"{sentence:42}# {why}" for sentence, why in _next(found)]
    blocks.append(CopyLines("What you can do next", "\n".join(lines)))
    files = ["robot.json"] if found.has_robot else []
    files += [f"{name}/" for name in found.exports]
    if files and found.trust.get("verdict") != WORDS[-1]:
        blocks.append(TextBlock([f"Files to deploy: {', '.join(files)}."]))
    return PageSection("provenance", "Provenance and next steps", blocks)


def _next(found: Results) -> list[tuple[str, str]]:
    """Return commands that add to the results, each with its purpose."""
    name, out = found.folder.name, []
    fitted = found.fit is not None
    if found.validation is None:
        out.append((f"slipid validate {name} --data OTHER", "predict runs that were not fitted"))
    if found.sample is None and fitted:
        out.append((f"slipid sample {name}", "posterior by emcee"))
    if found.design is None and fitted:
        out.append((f"slipid design {name}", "which runs to drive next"))
    if found.trial is None and found.has_robot:
        out.append((f"slipid trial {name}", "compare controllers in simulation"))
    if not found.exports and found.has_robot:
        out.append((f"slipid export {name} --out to_go", "C99, ROS 2, StableHLO, tables"))
    out.append((f"slipid report {name}", "this page again, with what was added"))
    return out
