"""Figures of a camera calibration: coverage by corners, and residuals of points on the floor."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from slipid.camera.calibration.lens import LensFit
from slipid.camera.calibration.place import FloorFit
from slipid.camera.calibration.quality import Coverage
from slipid.camera.overhead import OverheadCamera
from slipid.plots.drawing import BLUE, GREEN, INK, ORANGE, figure, save

ARROW_LENGTH = 0.06
"""Largest length at which the 95 % quantile of residuals is drawn, as a fraction of the image
width."""
CELL_NUMBER: dict[str, Any] = {"xytext": (4, -4), "textcoords": "offset points", "color": "#777777"}
"""Style of the numbers of the image's columns and rows of cells."""
GRID_STEPS = np.array([0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0])
"""Possible distances between grid lines drawn on the floor [m]."""


def coverage_picture(
    fit: LensFit, covered: Coverage, held_out_px: float | None, path: Path
) -> Path:
    """Write a figure of a lens fit: corners with residuals, and image cells without corners.

    `held_out_px` is the error on held-out views, None for a lens that is refused [pixel].
    """
    width, height = fit.lens.image_px
    held_out = "" if held_out_px is None else f", {held_out_px:.2f} px on held-out views"
    title = (
        f"Corners in {covered.visited.sum()} of {covered.visited.size} cells; "
        f"rms error {fit.rms_px:.2f} px{held_out}"
    )
    drawing, axes = _frame(title, width, height)
    down, across = covered.visited.shape
    size = np.array([width / across, height / down])
    for row, column in np.argwhere(~covered.visited):
        corner = (column * size[0] - 0.5, row * size[1] - 0.5)
        axes.add_patch(Rectangle(corner, *size, fc=ORANGE, ec=ORANGE, alpha=0.18, lw=0))
    if not covered.visited.all():
        axes.add_patch(Rectangle((0, 0), 0, 0, fc=ORANGE, alpha=0.18, label="never visited"))
    for k in range(across):
        axes.annotate(f"{k + 1}", ((k + 0.5) * size[0], 0), **CELL_NUMBER, ha="center", va="top")
    for k in range(down):
        axes.annotate(f"{k + 1}", (0, (k + 0.5) * size[1]), **CELL_NUMBER, ha="left", va="center")
    axes.set_xticks(np.arange(across + 1) * size[0] - 0.5, minor=True)
    axes.set_yticks(np.arange(down + 1) * size[1] - 0.5, minor=True)
    axes.grid(which="minor", color="#dddddd", lw=0.6)
    pixels = np.concatenate([view.pixels for view in fit.views])
    _arrows(axes, pixels, np.concatenate(fit.residuals), width)
    drawing.legend(loc="outside lower center", ncols=3, frameon=False)
    return save(drawing, path)


def floor_picture(fit: FloorFit, path: Path) -> Path:
    """Write a figure of the floor's axes and grid as the camera sees them, with residuals.

    The residuals belong to the points to which the camera's pose was fitted.
    """
    width, height = fit.camera.lens.image_px
    title = f"The floor from {fit.camera.height:.3f} m; rms error of points {fit.rms_px:.2f} px"
    drawing, axes = _frame(title, width, height)
    step = _floor_lines(axes, fit.camera)
    axes.plot([], [], color="#bbbbbb", lw=0.8, label=f"floor, a line every {step:g} m")
    for axis, colour, name in ((0, GREEN, "x"), (1, "#CC79A7", "y")):
        ends = np.zeros((30, 3))
        ends[:, axis] = np.linspace(0, 2 * step, 30)
        line = fit.camera.pixels(ends)
        axes.plot(*line.T, color=colour, lw=2.5, label=f"world's {name}, {2 * step:g} m")
    _arrows(axes, fit.points.pixels, fit.residuals, width)
    drawing.legend(loc="outside lower center", ncols=3, frameon=False)
    return save(drawing, path)


def _frame(title: str, width: int, height: int) -> tuple[Figure, Axes]:
    """Return a figure and axes in pixels of the image, with the first row at the top."""
    drawing = figure(9.0, 8.3 * height / width + 1.2, title)
    axes = drawing.add_subplot()
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal")
    axes.set(xlabel="u [pixel]", ylabel="v [pixel]")
    return drawing, axes


def _arrows(
    axes: Axes,
    pixels: Float[np.ndarray, "point 2"],
    residuals: Float[np.ndarray, "point 2"],
    width: int,
) -> None:
    """Draw points with their residuals [pixel], enlarged by a round factor to be visible."""
    largest = float(np.quantile(np.hypot(*residuals.T), 0.95))
    wanted = ARROW_LENGTH * width / max(largest, 1e-6)
    times = 10 ** np.floor(np.log10(wanted))
    times *= max(k for k in (1, 2, 5) if k * times <= wanted)
    axes.plot(*np.stack([pixels.T, (pixels + times * residuals).T], axis=1), color=INK, lw=0.9)
    axes.plot([], [], color=INK, lw=0.9, label=f"measured less computed, {times:g} times as long")
    axes.plot(*pixels.T, "o", color=BLUE, ms=3, label=f"{len(pixels)} corners or points")


def _floor_lines(axes: Axes, camera: OverheadCamera) -> float:
    """Draw lines of constant x and of constant y on the floor, and return their distance [m]."""
    width, height = camera.lens.image_px
    edge = np.array([[0, 0], [width, 0], [width, height], [0, height]], float)
    farthest = 4 * camera.height
    floor = np.nan_to_num(camera.on_plane(edge, 0.0), nan=farthest)
    floor = np.clip(floor, camera.place[:2] - farthest, camera.place[:2] + farthest)
    low, high = floor.min(0), floor.max(0)
    step = float(GRID_STEPS[np.argmin(np.abs(np.log(GRID_STEPS / ((high - low).max() / 8))))])
    for axis in (0, 1):
        for at in np.arange(np.ceil(low[axis] / step), high[axis] / step + 1e-9) * step:
            line = np.zeros((60, 3))
            line[:, axis] = at
            line[:, 1 - axis] = np.linspace(low[1 - axis], high[1 - axis], 60)
            before_lens = (line - camera.place) @ camera.rotation[2] > 0.05 * camera.height
            line = line[before_lens]
            if len(line):
                axes.plot(*camera.pixels(line).T, color="#bbbbbb", lw=0.8, zorder=0)
    return step
