"""Figure of a design: commands of the proposed runs, and uncertainty over the number of runs."""

import math
from collections import Counter

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullLocator

from slipid.infer.design.planned_runs import PlannedRun
from slipid.infer.design.proposal import Design
from slipid.plots import drawing
from slipid.support.content import Content

CURVES = (
    ("greedy", drawing.BLUE, "-", "chosen one after another"),
    ("grid", drawing.ORANGE, "-", "the 2021 paper's grid"),
    ("random_order", drawing.SHADE, "--", "the same grid in random order"),
)


def design_figure(found: Design) -> Figure:
    """Draw proposed and driven runs by floor and load (left), and the uncertainty (right).

    The uncertainty is drawn over the number of runs.
    """
    setups = list(dict.fromkeys((d.surface, d.load) for d in found.runs))
    columns = min(len(setups), 2 if len(setups) < 5 else 3)
    rows = math.ceil(len(setups) / columns)
    made = drawing.figure(3.6 * columns + 5.6, max(3.7 * rows, 4.4) + 0.8, _title(found))
    halves = made.subfigures(1, 2, width_ratios=(3.6 * columns, 5.4), squeeze=False)
    left, right = halves[0]
    axes = list(left.subplots(rows, columns, squeeze=False).flat)
    order = {d: k for k, d in reversed(list(enumerate(found.runs, 1)))}
    for ax, setup in zip(axes, setups, strict=False):
        mine = Counter(d for d in found.runs if (d.surface, d.load) == setup)
        _commands(ax, found, setup, mine, order)
    for spare in axes[len(setups) :]:
        spare.remove()
    words = "numbers: order of the runs (x3: three times)\nbent or round arrows: runs with a turn"
    left.supxlabel(f"{words}\ngray dots: runs of the fit", fontsize=9, color=drawing.SHADE)
    _uncertainty_curves(right.subplots(), found.content["runs_saved"]["paper_grid"])
    return made


def _title(found: Design) -> str:
    goals = [g for g in found.content["goals"] if g["reachable"]]
    names = [g["name"] for g in goals[:2]] + ["..."] * (len(goals) > 2)
    last = found.content["runs"][-1]["expected"]
    kept = math.sqrt(found.content["criterion"][-1])
    head = f"Next {len(found.runs)} runs, to reduce the uncertainty of {', '.join(names)}\n"
    if len(goals) > 1:
        return head + f"uncertainty falls to {kept:.0%} of its present value"
    g = goals[0]
    scale, unit = (100, " %") if g["unit"] == "m/m" else (1, "" if g["unit"] == "1" else g["unit"])
    return head + f"std falls from {scale * g['now']:.3g} to {scale * last[g['name']]:.3g}{unit}"


def _commands(
    ax: Axes,
    found: Design,
    setup: tuple[str, str],
    mine: Counter[PlannedRun],
    order: dict[PlannedRun, int],
) -> None:
    """Draw the commanded velocities on one floor with one load set-up.

    Args:
        ax: axes to draw on.
        found: the design.
        setup: floor and load set-up.
        mine: number of repetitions of each proposed run.
        order: position of each run in the proposed order, from 1.
    """
    floor, load = setup
    driven = found.validity[floor]
    reach = 1.4 * max(d.speed or abs(d.turn) * found.base_radius for d in mine)
    if load in driven.loads:
        angle = np.radians(driven.headings_deg)
        for speed in driven.speeds:
            x, y = speed * np.cos(angle), speed * np.sin(angle)
            ax.plot(x, y, ".", color="#bbbbbb", ms=3.5, mew=0)
    for d, times in mine.items():
        text = f"{order[d]}" + f" x{times}" * (times > 1) + "\nspin" * (not d.speed)
        at = _arrow(ax, d, found.base_radius, 0.1 * reach)
        ax.text(at[0], at[1], text, ha="center", va="center", fontsize=9, color=_colour(d))
    drawing.plain(ax)
    ax.set_aspect("equal")
    ax.set(xlim=(-reach, reach), ylim=(-reach, reach), title=f"{floor}, load {load}")
    ax.set(xlabel="ahead [m/s]", ylabel="left [m/s]")


def _arrow(ax: Axes, d: PlannedRun, base: float, beyond: float) -> tuple[float, float]:
    """Draw the command of a run as an arrow, and return the position of its label.

    The arrow ends at the commanded velocity [m/s]. It is bent if the run turns, and an arc for a
    turn on the spot. The label is `beyond` [m/s] further out than the tip.
    """
    colour, sign = _colour(d), float(np.sign(d.turn))
    style = {"arrowstyle": "-|>", "color": colour, "lw": 1.5, "shrinkA": 0, "shrinkB": 0}
    if d.speed:
        style["connectionstyle"] = f"arc3,rad={0.25 * sign}"
        end, start = (float(d.command[0]), float(d.command[1])), (0.0, 0.0)
        side = d.heading + 0.12 * sign
        place = (d.speed + beyond) * np.array([np.cos(side), np.sin(side)])
    else:
        size = abs(d.turn) * base
        style["connectionstyle"] = f"arc3,rad={0.9 * sign}"
        low, high = (0.0, -size), (0.0, size)
        start, end = (low, high) if sign > 0 else (high, low)
        place = np.array([sign * (size + 1.3 * beyond), 0.0])
    ax.annotate("", end, start, arrowprops=style)
    return float(place[0]), float(place[1])


def _colour(d: PlannedRun) -> str:
    if not d.turn:
        return drawing.BLUE
    return drawing.ORANGE if d.turn > 0 else drawing.GREEN


def _uncertainty_curves(ax: Axes, saved: Content) -> None:
    """Draw the curves of the uncertainty over the number of runs, if no runs were driven before."""
    for key, colour, style, label in CURVES:
        curve = saved["curves"][key]
        std = np.sqrt(curve["criterion"])
        ax.plot(curve["runs"], std, style, color=colour, lw=1.8, label=label)
    end = math.sqrt(saved["criterion"])
    ax.axhline(end, color=drawing.INK, lw=0.8, ls=":")
    ax.plot(saved["grid_runs"], end, "o", color=drawing.ORANGE, ms=6)
    worth = "worth more than as many"
    if saved["greedy_runs"]:
        last = math.sqrt(saved["curves"]["greedy"]["criterion"][-1])
        ax.plot(saved["greedy_runs"], last, "o", color=drawing.BLUE, ms=6)
        worth = f"worth {saved['greedy_runs']}"
    title = f"without earlier data: the grid's {saved['grid_runs']} runs are\n{worth} chosen ones"
    ax.set_title(title, fontsize=11)
    ax.set(xscale="log", yscale="log", xlabel="runs")
    ax.set(ylabel="uncertainty (1: the present fit)")
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter(FormatStrFormatter("%g"))
        axis.set_minor_locator(NullLocator())
    drawing.plain(ax)
    ax.legend(frameon=False)
