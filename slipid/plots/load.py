"""Load shares on a drawing of the robot from above."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyArrow, Polygon

from slipid.identify.result import Fit
from slipid.identify.verdicts.estimates import Estimate
from slipid.plots import drawing


def load_figure(fit: Fit) -> Figure | None:
    """Share of the weight on each wheel, one robot per load set-up; None where all are fixed."""
    loads = fit.robot.body.loads
    found = [fit.parameters[f"robot.load_share@{load}"] for load in loads]
    if all(e.interval90 is None for e in found):
        return None
    made, axes = drawing.panels(
        len(loads), 5.2, 4.7, "Share of the weight on each wheel, seen from above (90 % interval)"
    )
    for ax, load, estimate in zip(axes, loads, found, strict=True):
        _robot(ax, fit, estimate)
        ax.set_title(f"load {load}")
    return made


def _robot(ax: Axes, fit: Fit, estimate: Estimate) -> None:
    """One robot; x ahead points up, y to the left."""
    shape = fit.robot.geometry
    base, radius = float(shape.base_radius), float(shape.wheel_radius)
    place = np.asarray(shape.place) * base
    reach = float(np.linalg.norm(place, axis=1).max())
    ax.add_patch(Circle((0, 0), reach * 0.93, fc="#f2f2f2", ec=drawing.SHADE, lw=1.2))
    start, length, wide = 0.42 * reach, 0.25 * reach, 0.02 * reach
    ax.add_patch(FancyArrow(0, start, 0, length, width=wide, fc=drawing.SHADE, ec="none"))
    ax.text(0.06 * reach, 0.5 * reach, "ahead", color=drawing.INK, fontsize=9)
    share = np.asarray(estimate.value, float)
    angles = np.asarray(shape.drive_angle)
    for k, (p, angle) in enumerate(zip(place, angles, strict=True)):
        along = np.array([np.cos(angle), np.sin(angle)])
        side = np.array([-along[1], along[0]]) * 0.35 * radius
        ways = (radius * along + side, radius * along - side)
        corners = [_up(p + way) for way in (*ways, -ways[0], -ways[1])]
        size = reach * 0.62 * np.sqrt(share[k])
        ax.add_patch(Circle(_up(p), size, fc=drawing.BLUE, alpha=0.25, ec="none"))
        ax.add_patch(Polygon(corners, fc=drawing.INK, ec="none"))
        ax.text(*_up(p * [1.75, 1.95]), _words(k, estimate), ha="center", va="center", fontsize=10)
    ax.plot(*_up(share @ place), "X", color=drawing.ORANGE, ms=11, mec="white")
    ahead, left = 1000 * (share @ place)
    where = f"{abs(ahead):.0f} mm {'ahead of' if ahead > 0 else 'behind'} the middle"
    if abs(left) >= 0.5:
        where += f" and {abs(left):.0f} mm to the {'left' if left > 0 else 'right'}"
    said = f"cross: centre of weight, {where}"
    ax.text(0, -2.3 * reach, said, ha="center", fontsize=9, color=drawing.ORANGE)
    ax.set(xlim=(-2.2 * reach, 2.2 * reach), ylim=(-2.4 * reach, 1.6 * reach), aspect="equal")
    ax.grid(False)
    ax.axis("off")


def _up(p: np.ndarray | Sequence[float]) -> tuple[float, float]:
    """Body x, y on a page where ahead is up and left is left."""
    return -float(p[1]), float(p[0])


def _words(k: int, estimate: Estimate) -> str:
    text = f"wheel {k + 1}\n{100 * estimate.value[k]:.1f} %"
    if estimate.interval90 is not None:
        low, high = estimate.interval90[k]
        text += f"\n({100 * low:.1f} to {100 * high:.1f})"
    return text
