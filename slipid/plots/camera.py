"""Pictures of a calibrated camera, its corners and floor points, and of a map of the floor."""

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

from slipid.camera.calibration.lens import LensFit
from slipid.camera.calibration.place import FloorFit
from slipid.camera.calibration.quality import Quality
from slipid.camera.overhead import OverheadCamera
from slipid.data.geojson_map import Patch, VectorMap, covered
from slipid.plots.drawing import BLUE, GREEN, INK, ORANGE, SHADE, figure, save

LONGEST = 0.06
"""Length of the larger residuals in the picture, over its width."""
STEPS = np.array([0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0])
"""Distances between lines on the floor [m]."""
NAMED = 0.01
"""Smallest share of the map's area at which a patch shows its name."""
HATCH = "////"
"""Hatching of the unknown part of a map."""


def coverage_picture(fit: LensFit, quality: Quality, path: Path) -> Path:
    """Write a picture of the corners with their residuals, and of the cells without corners."""
    width, height = fit.lens.image_px
    covered = quality.coverage
    title = (
        f"Corners in {covered.visited.sum()} of {covered.visited.size} cells; "
        f"rms error {fit.rms_px:.2f} px, {quality.held_out_px:.2f} px on held-out views"
    )
    made, axes = _frame(title, width, height)
    down, across = covered.visited.shape
    size = np.array([width / across, height / down])
    for row, column in np.argwhere(~covered.visited):
        corner = (column * size[0] - 0.5, row * size[1] - 0.5)
        axes.add_patch(Rectangle(corner, *size, fc=ORANGE, ec=ORANGE, alpha=0.18, lw=0))
    if not covered.visited.all():
        axes.add_patch(Rectangle((0, 0), 0, 0, fc=ORANGE, alpha=0.18, label="never visited"))
    axes.set_xticks(np.arange(across + 1) * size[0] - 0.5, minor=True)
    axes.set_yticks(np.arange(down + 1) * size[1] - 0.5, minor=True)
    axes.grid(which="minor", color="#dddddd", lw=0.6)
    pixels = np.concatenate([view.pixels for view in fit.views])
    _arrows(axes, pixels, np.concatenate(fit.residuals), width)
    _legend(axes)
    return save(made, path)


def floor_picture(fit: FloorFit, path: Path) -> Path:
    """Write a picture of the floor's axes and lines in the camera, with points and residuals."""
    width, height = fit.camera.lens.image_px
    title = f"The floor from {fit.camera.height:.3f} m; rms error of points {fit.rms_px:.2f} px"
    made, axes = _frame(title, width, height)
    step = _floor_lines(axes, fit.camera)
    axes.plot([], [], color="#bbbbbb", lw=0.8, label=f"floor, a line every {step:g} m")
    for axis, colour, name in ((0, GREEN, "x"), (1, "#CC79A7", "y")):
        ends = np.zeros((30, 3))
        ends[:, axis] = np.linspace(0, 2 * step, 30)
        line = fit.camera.pixels(ends)
        axes.plot(*line.T, color=colour, lw=2.5, label=f"world's {name}, {2 * step:g} m")
    _arrows(axes, fit.points.pixels, fit.residuals, width)
    _legend(axes)
    return save(made, path)


def _frame(title: str, width: int, height: int) -> tuple[Figure, Axes]:
    """Return a figure in pixels, first row at the top, with room for a legend below."""
    made = figure(9.0, 8.3 * height / width + 1.2, title)
    axes = made.add_subplot()
    axes.set_xlim(-0.5, width - 0.5)
    axes.set_ylim(height - 0.5, -0.5)
    axes.set_aspect("equal")
    axes.set_xlabel("u [pixel]")
    axes.set_ylabel("v [pixel]")
    return made, axes


def _legend(axes: Axes) -> None:
    axes.figure.legend(loc="outside lower center", ncols=3, frameon=False)


def _arrows(
    axes: Axes,
    pixels: Float[np.ndarray, "point 2"],
    residuals: Float[np.ndarray, "point 2"],
    width: int,
) -> None:
    """Draw points with their residuals, enlarged by a round number to be visible."""
    largest = float(np.quantile(np.hypot(*residuals.T), 0.95))
    wanted = LONGEST * width / max(largest, 1e-6)
    times = 10 ** np.floor(np.log10(wanted))
    times *= max(k for k in (1, 2, 5) if k * times <= wanted)
    ends = pixels + times * residuals
    axes.plot(
        np.stack([pixels[:, 0], ends[:, 0]]),
        np.stack([pixels[:, 1], ends[:, 1]]),
        color=INK,
        lw=0.9,
    )
    axes.plot([], [], color=INK, lw=0.9, label=f"measured less computed, {times:g} times as long")
    axes.plot(*pixels.T, "o", color=BLUE, ms=3, label=f"{len(pixels)} corners or points")


def _floor_lines(axes: Axes, camera: OverheadCamera) -> float:
    """Draw lines of equal x and of equal y; return the distance between them [m]."""
    width, height = camera.lens.image_px
    edge = np.array([[0, 0], [width, 0], [width, height], [0, height]], float)
    visible = camera.on_plane(edge, 0.0)
    far = 4 * camera.height
    visible = np.nan_to_num(visible, nan=far)
    visible = np.clip(visible, camera.place[:2] - far, camera.place[:2] + far)
    low, high = visible.min(0), visible.max(0)
    step = float(STEPS[np.argmin(np.abs(np.log(STEPS / ((high - low).max() / 8))))])
    for axis in (0, 1):
        for at in np.arange(np.ceil(low[axis] / step), high[axis] / step + 1e-9) * step:
            line = np.zeros((60, 3))
            line[:, axis] = at
            line[:, 1 - axis] = np.linspace(low[1 - axis], high[1 - axis], 60)
            in_front = (line - camera.place) @ camera.rotation[2] > 0.05 * camera.height
            line = line[in_front]
            if len(line):
                axes.plot(*camera.pixels(line).T, color="#bbbbbb", lw=0.8, zorder=0)
    return step


def floor_plot(
    found: VectorMap,
    photograph: UInt8[np.ndarray, "row column 3"],
    visible: Bool[np.ndarray, "row column"],
    path: Path,
) -> Path:
    """Write a picture of the photograph on the floor with outlines and names, beside the map.

    Args:
        found: map of the floor.
        photograph: blue, green, red of every cell of the map, the first row at the lowest y.
        visible: cells in the camera's view.
        path: file of the picture.
    """
    known = f"{100 * (1 - found.unknown):.0f} % of its rectangle known"
    title = (
        f"Map of the floor: {len(found.colours)} surfaces, {len(found.patches)} patches, {known}"
    )
    tall = (found.high_y - found.low_y) / (found.high_x - found.low_x)
    made = figure(13.0, float(np.clip(6.2 * tall, 3.0, 12.0)) + 1.4, title)
    left, right = made.subplots(1, 2, sharex=True, sharey=True)
    extent = (found.low_x, found.high_x, found.low_y, found.high_y)
    shown = np.dstack([photograph[..., ::-1], np.where(visible, 255, 0)]).astype(np.uint8)
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
    """Return the hatching below everything else."""
    size = (found.high_x - found.low_x, found.high_y - found.low_y)
    corner = (found.low_x, found.low_y)
    return Rectangle(corner, *size, facecolor="white", edgecolor=SHADE, hatch=HATCH, lw=0, zorder=0)


def _outline(axes: Axes, patch: Patch, colour: str | None) -> None:
    """Draw a patch with its holes; without a colour only its edge, visible on any background."""
    rings = [np.concatenate([ring, ring[:1]]) for ring in patch.rings]
    codes = [_codes(len(ring)) for ring in rings]
    shape = Outline(np.concatenate(rings), np.concatenate(codes))
    if colour is None:
        for width, shade in ((2.6, "white"), (1.1, INK)):
            axes.add_patch(PathPatch(shape, fill=False, edgecolor=shade, lw=width))
    else:
        axes.add_patch(PathPatch(shape, facecolor=colour, edgecolor=INK, lw=0.5))


def _codes(count: int) -> np.ndarray:
    """Return the path codes of a closed ring."""
    return np.array([Outline.MOVETO, *[Outline.LINETO] * (count - 2), Outline.CLOSEPOLY])


def _names(axes: Axes, found: VectorMap) -> None:
    """Draw the names of large patches, where they have most room."""
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
    """Return the point of a patch farthest from its edge [m], to a hundredth of its size."""
    from scipy.ndimage import distance_transform_edt

    low, high = patch.rings[0].min(axis=0), patch.rings[0].max(axis=0)
    step = float((high - low).max()) / 100
    columns, rows = (int(n) for n in np.maximum(np.ceil((high - low) / step), 1))
    inside = covered([(ring - low) / step for ring in patch.rings], rows, columns)
    far = distance_transform_edt(np.pad(inside, 1))[1:-1, 1:-1]
    row, column = np.unravel_index(int(np.argmax(far)), far.shape)
    return low + step * (np.array([column, row]) + 0.5)


def _swatches(found: VectorMap) -> list[Swatch]:
    """Return legend entries of colours with names and areas, and of the hatching."""
    areas = dict.fromkeys(found.colours, 0.0)
    for patch in found.patches:
        areas[patch.surface] += patch.area
    known = [
        Swatch(facecolor=colour, edgecolor=INK, label=f"{name} ({areas[name]:.2f} m²)")
        for name, colour in found.colours.items()
    ]
    unknown = Swatch(facecolor="white", edgecolor=SHADE, hatch=HATCH, label="unknown")
    return [*known, unknown]
