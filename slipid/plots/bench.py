"""A motor on a bench as a picture: measured against fitted, and what is left.

Picture to check a map of the floor by: the photograph with its outlines, beside the map.
"""

from pathlib import Path
from textwrap import shorten

import numpy as np
from jaxtyping import Bool, Float, UInt8
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch as Swatch
from matplotlib.patches import PathPatch, Rectangle
from matplotlib.path import Path as Outline
from matplotlib.patheffects import withStroke

from slipid.data.geojson_map import Patch, VectorMap, covered
from slipid.infer.bench.fit import MotorFit
from slipid.infer.bench.moments import MomentSums
from slipid.infer.bench.verdict import BenchFit
from slipid.infer.bench.windows import BenchWindows
from slipid.plots.drawing import BLUE, INK, ORANGE, SHADE, figure, plain, save

MOST = 4000
"""Points of a curve."""


def bench_plots(fit: BenchFit, out: Path) -> list[Path]:
    """A picture of every motor: files bench.png, or bench_LABEL.png."""
    return [
        save(bench_figure(f), out / (f"bench_{f.label}.png" if f.label else "bench.png"))
        for f in fit.fits
    ]


def bench_figure(fit: MotorFit) -> Figure:
    """Voltage and current, measured and fitted; residuals over time, speed and current."""
    pairs = [("current", "A", fit.amps, fit.amps_sums)]
    if fit.volts is not None and fit.volts_sums is not None:
        pairs.insert(0, ("voltage", "V", fit.volts, fit.volts_sums))
    which = f"motor {fit.label}: " if fit.label else ""
    made = figure(
        13.0,
        3.9 * len(pairs) + 0.8,
        f"{which}measured (gray) and what the fit makes of the rest (blue)",
    )
    grid = made.add_gridspec(2 * len(pairs), 3, height_ratios=[2.0, 1.2] * len(pairs))
    for k, (name, unit, w, s) in enumerate(pairs):
        top = made.add_subplot(grid[2 * k, :])
        below = [made.add_subplot(grid[2 * k + 1, j]) for j in range(3)]
        _signals(top, name, unit, w, s)
        _residuals(below, unit, w, s)
    return made


def _clock(w: BenchWindows) -> np.ndarray:
    """Time with the records one after the other [s]."""
    ends = [float(w.time[w.record == k].max(initial=0.0)) for k in range(int(w.record.max()) + 1)]
    return np.asarray(w.time + np.concatenate([[0.0], np.cumsum(ends)])[w.record])


def _signals(axes: Axes, name: str, unit: str, w: BenchWindows, s: MomentSums) -> None:
    plain(axes)
    clock, left = _clock(w), w.both.measured
    fitted = left - (s.even.residual + s.odd.residual) / 2
    some = slice(None, None, max(1, len(clock) // MOST))
    used = np.where(w.usable, fitted, np.nan)
    axes.plot(clock[some], left[some], color=SHADE, lw=2.2, alpha=0.6, label="measured")
    axes.plot(clock[some], used[some], color=BLUE, lw=0.9, label="fitted")
    axes.set(ylabel=f"{name} [{unit}]", xlabel="time [s]")
    axes.legend(loc="upper right", fontsize=8, frameon=False, ncols=2)


def _residuals(panels: list[Axes], unit: str, w: BenchWindows, s: MomentSums) -> None:
    """What is left, point by point, and its mean in bins."""
    clock, both = _clock(w), w.both
    good = np.flatnonzero(w.usable)
    left = (s.even.residual + s.odd.residual) / 2
    limit = 6 * s.scale
    for axes, (x, what) in zip(
        panels,
        ((clock, "time [s]"), (both.speed, "speed [rad/s]"), (both.current, "current [A]")),
        strict=True,
    ):
        plain(axes)
        some = good[:: max(1, len(good) // MOST)]
        axes.plot(x[some], left[some], ".", color=SHADE, ms=1.5, alpha=0.4)
        bins = np.array_split(good[np.argsort(x[good], kind="stable")], 24)
        weight = s.even.weight + s.odd.weight
        means = [np.average(left[b], weights=weight[b] + 1e-9) for b in bins if len(b)]
        axes.plot([np.median(x[b]) for b in bins if len(b)], means, "o-", color=ORANGE, ms=3, lw=1)
        axes.axhline(0.0, color=INK, lw=0.6)
        axes.set(ylim=(-limit, limit), xlabel=what)
    panels[0].set_ylabel(f"left [{unit}]")
    panels[0].set_title("what is left, and its mean (orange)", fontsize=9, loc="left", color=INK)


NAMED = 0.01
"""Patches of a larger share of the map have their name on them."""
HATCH = "////"


def floor_plot(
    found: VectorMap,
    photograph: UInt8[np.ndarray, "row column 3"],
    seen: Bool[np.ndarray, "row column"],
    path: Path,
) -> Path:
    """The photograph as the floor shows it, with outlines and names, beside the map in colours.

    Args:
        photograph: blue, green, red of every cell of the map, the first row at the lowest y.
        seen: cells that the camera sees.
        path: of the picture.
    """
    known = f"{100 * (1 - found.unknown):.0f} % of its rectangle known"
    title = (
        f"Map of the floor: {len(found.colours)} surfaces, {len(found.patches)} patches, {known}"
    )
    tall = (found.high_y - found.low_y) / (found.high_x - found.low_x)
    made = figure(13.0, float(np.clip(6.2 * tall, 3.0, 12.0)) + 1.4, title)
    left, right = made.subplots(1, 2, sharex=True, sharey=True)
    extent = (found.low_x, found.high_x, found.low_y, found.high_y)
    shown = np.dstack([photograph[..., ::-1], np.where(seen, 255, 0)]).astype(np.uint8)
    step = max(1, max(shown.shape[:2]) // 1200)
    for axes, name in ((left, "photograph, laid onto the floor"), (right, "map")):
        axes.set_title(name, fontsize=10, loc="left")
        axes.add_patch(_unknown(found))
        axes.set(xlabel="x [m]", aspect="equal", xlim=extent[:2], ylim=extent[2:])
    left.set_ylabel("y [m]")
    left.imshow(shown[::step, ::step], origin="lower", extent=extent, interpolation="antialiased")
    for patch in found.patches:
        _outline(left, patch, None)
        _outline(right, patch, found.colours[patch.surface])
    for axes in (left, right):
        _names(axes, found)
    made.legend(handles=_swatches(found), loc="outside lower center", ncols=5, fontsize=8)
    return save(made, path)


def _unknown(found: VectorMap) -> Rectangle:
    """Hatching below everything."""
    size = (found.high_x - found.low_x, found.high_y - found.low_y)
    corner = (found.low_x, found.low_y)
    return Rectangle(corner, *size, facecolor="white", edgecolor=SHADE, hatch=HATCH, lw=0, zorder=0)


def _outline(axes: Axes, patch: Patch, colour: str | None) -> None:
    """A patch with its holes; without a colour its edge alone, seen on light and dark."""
    rings = [np.concatenate([ring, ring[:1]]) for ring in patch.rings]
    codes = [_codes(len(ring)) for ring in rings]
    shape = Outline(np.concatenate(rings), np.concatenate(codes))
    if colour is None:
        for width, shade in ((2.6, "white"), (1.1, INK)):
            axes.add_patch(PathPatch(shape, fill=False, edgecolor=shade, lw=width))
    else:
        axes.add_patch(PathPatch(shape, facecolor=colour, edgecolor=INK, lw=0.5))


def _codes(count: int) -> np.ndarray:
    """Of a closed ring."""
    return np.array([Outline.MOVETO, *[Outline.LINETO] * (count - 2), Outline.CLOSEPOLY])


def _names(axes: Axes, found: VectorMap) -> None:
    """Names of the large patches, where they have most room."""
    whole = (found.high_x - found.low_x) * (found.high_y - found.low_y)
    for patch in found.patches:
        if patch.area < NAMED * whole:
            continue
        x, y = middle(patch)
        dark = np.dot(to_rgb(found.colours[patch.surface]), [0.3, 0.6, 0.1]) < 0.5
        ink, around = ("white", INK) if dark else (INK, "white")
        text = axes.text(x, y, shorten(patch.surface, 16, placeholder="…"), fontsize=7, color=ink)
        text.set(
            ha="center", va="center", path_effects=[withStroke(linewidth=1.8, foreground=around)]
        )


def middle(patch: Patch) -> Float[np.ndarray, "2"]:
    """The place within a patch that is farthest from its edge [m], to a hundredth of its size."""
    from scipy.ndimage import distance_transform_edt

    low, high = patch.rings[0].min(axis=0), patch.rings[0].max(axis=0)
    step = float((high - low).max()) / 100
    columns, rows = (int(n) for n in np.maximum(np.ceil((high - low) / step), 1))
    inside = covered([(ring - low) / step for ring in patch.rings], rows, columns)
    far = distance_transform_edt(np.pad(inside, 1))[1:-1, 1:-1]
    row, column = np.unravel_index(int(np.argmax(far)), far.shape)
    return low + step * (np.array([column, row]) + 0.5)


def _swatches(found: VectorMap) -> list[Swatch]:
    """Colours, names and areas, and what is hatched."""
    areas = dict.fromkeys(found.colours, 0.0)
    for patch in found.patches:
        areas[patch.surface] += patch.area
    known = [
        Swatch(facecolor=colour, edgecolor=INK, label=f"{name} ({areas[name]:.2f} m²)")
        for name, colour in found.colours.items()
    ]
    unknown = Swatch(facecolor="white", edgecolor=SHADE, hatch=HATCH, label="unknown")
    return [*known, unknown]
