"""Sections about wheels and motors: currents before and after the fit, loads, and slip curves."""

from collections.abc import Sequence

import numpy as np

from slipid.infer.slip_curves import slip_sentence
from slipid.infer.verdicts.disputed import LoadComparison, sensitivity
from slipid.report.html import figures as draw
from slipid.report.html.blocks import (
    Block,
    DrawingBlock,
    FigureBlock,
    PageSection,
    TableBlock,
    TextBlock,
    label,
)
from slipid.report.html.evidence import FitEvidence, WheelLayout
from slipid.report.html.results import Results
from slipid.support.content import Content


def currents(found: Results) -> PageSection | None:
    """Return the section about measured, initial and fitted currents."""
    evidence = found.evidence
    if evidence is None or evidence.currents is None or not evidence.currents.run:
        return None
    c, runs = evidence.currents, evidence.runs
    measured = np.array(c.measured)
    error = {name: np.abs(np.array(getattr(c, name)) - measured) for name in ("start", "fitted")}
    rms = {name: float(np.sqrt(np.mean(x**2))) for name, x in error.items()}
    names = [runs[r].name if r < len(runs) else "" for r in c.run]
    text = [f"{n}, drive {d + 1}" for n, d in zip(names, c.drive, strict=True)]
    hover = "%{text}<br>measured %{x:.3f} A, predicted %{y:.3f} A<extra>%{fullData.name}</extra>"
    data = [
        draw.dots(
            c.measured,
            c.start,
            "before the fit",
            "@orange",
            text=text,
            hovertemplate=hover,
            marker={"symbol": "triangle-up"},
        ),
        draw.dots(c.measured, c.fitted, "after the fit", "@blue", text=text, hovertemplate=hover),
    ]
    low, high = float(measured.min()), float(measured.max())
    data.append(
        draw.line([low, high], [low, high], "equal", "@ink", line={"width": 1, "dash": "dot"})
    )
    layout = {
        "xaxis": draw.axis("measured current [A]"),
        "yaxis": draw.axis("predicted current [A]"),
        "showlegend": True,
    }
    title = (
        f"Currents are predicted within {rms['fitted']:.2g} A after the fit, {rms['start']:.2g} A "
        "before it"
    )
    alt = f"{title} (root mean square). Dots of predicted over measured currents."
    caption = "Means over segments of the runs; before the fit, every number had its start value."
    return PageSection(
        "currents",
        "Before and after the fit",
        [FigureBlock("currents", title, alt, data, layout, caption, 420)],
    )


def loads(found: Results) -> PageSection | None:
    """Return the section with the loads drawn on the robot."""
    evidence = found.evidence
    if evidence is None:
        return None
    blocks: list[Block] = []
    for path, e in found.parameters.items():
        name = path.removeprefix("robot.load_share@")
        if name == path or e["interval90"] is None:
            continue
        blocks.append(_robot(evidence.wheels, name, e))
    if blocks and found.fit is not None:
        blocks += _comparisons(found.fit.get("load_comparisons", ()))
    return PageSection("loads", "Weight on the wheels", blocks) if blocks else None


def _comparisons(content: Sequence[Content]) -> list[Block]:
    """Return which differences of the loads between floors were found, or would have been."""
    found = [LoadComparison.of_json(one) for one in content]
    if not found:
        return []
    wheels = [f"wheel {k + 1}, %" for k in range(len(found[0].smallest))]
    head = ("floors", "disputed", "difference found, standard errors", *wheels)
    rows = [
        (
            " and ".join(one.floors),
            "yes" if one.disputed else "no",
            f"{one.standard_errors:.1f}",
            *(f"{100 * x:.0f}" for x in one.smallest),
        )
        for one in found
    ]
    title = "Smallest difference of each wheel's load that would have been reported."
    text = sensitivity(found)
    return [
        TextBlock([f"{text[0].upper()}{text[1:]}."], kind="note"),
        TableBlock(title, head, rows, right=head[2:], folded=True),
    ]


def _robot(wheels: WheelLayout, name: str, e: Content) -> DrawingBlock:
    """Return the robot from above, with the share of the weight on each wheel; ahead is up."""
    place = np.array(wheels.place_m)
    reach = max(float(np.abs(place).max()), 1e-3)
    scale = 70 / reach
    at = np.stack([-place[:, 1], -place[:, 0]], -1) * scale  # x of the page, y down
    share = np.array(e["value"])
    centre = share @ place
    width, tall = 420, 290
    parts = [
        f'<svg viewBox="{-width / 2:.0f} {-tall / 2:.0f} {width} {tall}" role="img" class="robot">',
        '<path d="M0 -30 l6 12 h-12 z" class="ink"/>',
        '<text x="0" y="-36" text-anchor="middle">ahead</text>',
    ]
    for k, (x, y) in enumerate(at):
        low, high = e["interval90"][k]
        angle = -wheels.angle_deg[k]
        radius = 34 * np.sqrt(share[k] * len(share))
        parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:.1f}" class="load"/>')
        parts.append(
            f'<rect x="-4" y="-14" width="8" height="28" rx="2" class="ink" '
            f'transform="translate({x:.1f} {y:.1f}) rotate({angle:.1f})"/>'
        )
        side = 1 if x > 1 else -1 if x < -1 else 0
        anchor = {1: "start", -1: "end", 0: "middle"}[side]
        off = radius + 6
        tx, ty = (x + side * off, y - 2) if side else (x, y + (off + 10 if y > 0 else -off - 14))
        parts.append(
            f'<text x="{tx:.1f}" y="{ty:.1f}" text-anchor="{anchor}" class="strong">'
            f"{100 * share[k]:.1f} %</text>"
            f'<text x="{tx:.1f}" y="{ty + 13:.1f}" text-anchor="{anchor}" class="small">'
            f"{100 * low:.1f} to {100 * high:.1f}</text>"
        )
    cx, cy = -centre[1] * scale, -centre[0] * scale
    parts.append(
        f'<path d="M{cx - 6:.1f} {cy - 6:.1f} l12 12 m0 -12 l-12 12" class="cross"/></svg>'
    )
    ahead, left = 1000 * centre
    where = f"{abs(ahead):.0f} mm {'ahead of' if ahead > 0 else 'behind'} the middle"
    if abs(left) >= 0.5:
        where += f" and {abs(left):.0f} mm to the {'left' if left > 0 else 'right'}"
    title = f"Load set-up {name}: centre of weight {where}"
    alt = f"{title}. " + ", ".join(
        f"wheel {k + 1} carries {100 * s:.1f} %" for k, s in enumerate(share)
    )
    caption = "Share of the weight on each wheel, with its 90 % interval; the cross is the centre."
    return DrawingBlock(title, alt, "".join(parts), caption)


def slip(found: Results) -> PageSection | None:
    """Return the section about slip over torque, floor by floor."""
    evidence, curves = found.evidence, found.identified["curves"]
    if not curves:
        return None
    floors = list(curves)
    titles = [_panel_title(found, floor) for floor in floors]
    layout, axes, rows = draw.panels(len(floors), titles, 2)
    data = []
    for panel, floor in zip(axes, floors, strict=True):
        c, first = curves[floor], panel == axes[0]
        if evidence is not None and evidence.slip is not None:
            data.append(draw.onto(_cloud(evidence, floor, first), panel))
        group = {"legendgroup": "curve", "showlegend": first}
        torque = c["torque_nm"]
        shade = draw.band(torque, c["slip_lo"], c["slip_hi"], "90 % band", "@blue")
        data.append(draw.onto(shade | {"legendgroup": "band", "showlegend": first}, panel))
        data.append(draw.onto(draw.line(torque, c["slip"], "fitted", "@blue", **group), panel))
        layout[f"xaxis{panel}"] |= draw.axis("torque of a wheel [N m]")
        layout[f"yaxis{panel}"] |= draw.axis("slip [1]") | _span(evidence, floor, c["slip_hi"])
    title = _slip_title(found)
    alt = f"{title}. Dots of measured slip of single wheels over their torque, and fitted curves."
    caption = (
        "Slip is 1 less the speed of the wheel over the floor divided by that of its rim. Dots: "
        "single wheels in segments of the runs, by the measured poses, over the torque by the "
        "measured current (or the predicted torque), scaled to an even load. The curve is that of "
        "a wheel that rolls straight ahead; one that also moves sideways slips more."
    )
    figure = FigureBlock(
        "slip",
        title,
        alt,
        data,
        layout | {"showlegend": True},
        caption,
        70 + 290 * rows,
        minimum=420,
    )
    return PageSection("slip", "Slip of the wheels", [figure])


def _span(evidence: FitEvidence | None, floor: str, high: list[float]) -> Content:
    """Return the range of the axis of slip, without the most extreme dots."""
    if evidence is None or evidence.slip is None:
        return {}
    s, runs = evidence.slip, evidence.runs
    mine = [s.slip[n] for n, r in enumerate(s.run) if r < len(runs) and runs[r].floor == floor]
    low, top = np.quantile(mine, [0.01, 0.99]) if mine else (0.0, 0.0)
    low, top = min(float(low), 0.0), max(float(top), *high)
    return {"range": [low - 0.05 * (top - low), top + 0.05 * (top - low)]}


def _panel_title(found: Results, floor: str) -> str:
    chosen = found.selected.get(floor, "contact")
    return floor if chosen == "contact" else f"{floor} (not selected: {label(chosen)} is)"


def _cloud(evidence: FitEvidence, floor: str, first: bool) -> Content:
    """Return the dots of a floor."""
    s, runs = evidence.slip, evidence.runs
    assert s is not None
    mine = [n for n, r in enumerate(s.run) if r < len(runs) and runs[r].floor == floor]
    return draw.dots(
        [s.torque_nm[n] for n in mine],
        [s.slip[n] for n in mine],
        "measured",
        "@muted",
        text=[f"{runs[s.run[n]].name}, drive {s.drive[n] + 1}" for n in mine],
        hovertemplate="%{text}<br>%{x:.3f} N m, slip %{y:.3f}<extra></extra>",
        marker={"opacity": 0.35},
        legendgroup="dots",
        showlegend=first,
    )


def _slip_title(found: Results) -> str:
    """Return a sentence on whether the measured slip rises with torque, floor by floor."""
    evidence = found.evidence
    if evidence is None or evidence.slip is None:
        return "Fitted slip over torque"
    s, runs = evidence.slip, evidence.runs
    floor = np.array([runs[r].floor if r < len(runs) else "" for r in s.run])
    each = {
        f: (np.array(s.torque_nm)[floor == f], np.array(s.slip)[floor == f])
        for f in found.identified["curves"]
    }
    return slip_sentence(each)
