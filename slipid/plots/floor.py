"""Figure for checking a floor map: the photograph with outlines of patches, next to the map."""

from pathlib import Path
from textwrap import shorten

import numpy as np
from jaxtyping import Bool, Float, UInt8
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.patches import Patch as Swatch
from matplotlib.patches import PathPatch, Rectangle
from matplotlib.path import Path as Outline
from matplotlib.patheffects import withStroke
from scipy.ndimage import distance_transform_edt

from slipid.data.geojson_map import Patch, VectorMap, covered
from slipid.plots.drawing import INK, SHADE, figure, save

LABELLED_SHARE = 0.01
"""Smallest fraction of the map's area at which a patch is labelled with its name."""
HATCH = "////"


def floor_plot(
    vector: VectorMap,
    photograph: UInt8[np.ndarray, "row column 3"],
    in_view: Bool[np.ndarray, "row column"],
    path: Path,
) -> Path:
    """Write a figure of the rectified photograph with outlines and names, next to the map.

    Args:
        vector: the map.
        photograph: blue, green, red of every cell of the map; the first row has the lowest y.
        in_view: True for cells that the camera sees.
        path: file of the picture.
    """
    known = f"{100 * (1 - vector.region.unknown_share):.0f} % of the rectangle is known"
    surfaces, patches = len(vector.region.colours), len(vector.patches)
    title = f"Map of the floor: {surfaces} surfaces, {patches} patches, {known}"
    low_x, low_y, high_x, high_y = vector.region.extent_m
    tall = (high_y - low_y) / (high_x - low_x)
    made = figure(13.0, float(np.clip(6.2 * tall, 3.0, 12.0)) + 1.4, title)
    left, right = made.subplots(1, 2, sharex=True, sharey=True)
    extent = (low_x, high_x, low_y, high_y)
    shown = np.dstack([photograph[..., ::-1], np.where(in_view, 255, 0)]).astype(np.uint8)
    step = max(1, max(shown.shape[:2]) // 1200)
    for axes, name in ((left, "photograph, projected onto the floor"), (right, "map")):
        axes.set_title(name, fontsize=10, loc="left")
        axes.add_patch(_unknown(vector))
        axes.set(xlabel="x [m]", aspect="equal", xlim=extent[:2], ylim=extent[2:])
    left.set_ylabel("y [m]")
    left.imshow(shown[::step, ::step], origin="lower", extent=extent, interpolation="antialiased")
    for patch in vector.patches:
        _outline(left, patch, None)
        _outline(right, patch, vector.region.colours[patch.surface])
    for axes in (left, right):
        _names(axes, vector)
    made.legend(handles=_swatches(vector), loc="outside lower center", ncols=5, fontsize=8)
    return save(made, path)


def _unknown(vector: VectorMap) -> Rectangle:
    """Return a hatched rectangle behind the map, which is visible where the floor is unknown."""
    low_x, low_y, high_x, high_y = vector.region.extent_m
    corner, size = (low_x, low_y), (high_x - low_x, high_y - low_y)
    return Rectangle(corner, *size, facecolor="white", edgecolor=SHADE, hatch=HATCH, lw=0, zorder=0)


def _outline(axes: Axes, patch: Patch, colour: str | None) -> None:
    """Draw a patch with its holes, filled with `colour`.

    Without a colour only the edges are drawn, in two shades that show on light and dark floors.
    """
    rings = [np.concatenate([ring, ring[:1]]) for ring in patch.rings]
    shape = Outline.make_compound_path(*(Outline(ring, closed=True) for ring in rings))
    if colour is None:
        for width, shade in ((2.6, "white"), (1.1, INK)):
            axes.add_patch(PathPatch(shape, fill=False, edgecolor=shade, lw=width))
    else:
        axes.add_patch(PathPatch(shape, facecolor=colour, edgecolor=INK, lw=0.5))


def _names(axes: Axes, vector: VectorMap) -> None:
    """Write the name of each large patch in its widest part."""
    low_x, low_y, high_x, high_y = vector.region.extent_m
    whole = (high_x - low_x) * (high_y - low_y)
    for patch in vector.patches:
        if patch.area < LABELLED_SHARE * whole:
            continue
        x, y = middle(patch)
        dark = np.dot(to_rgb(vector.region.colours[patch.surface]), [0.3, 0.6, 0.1]) < 0.5
        ink, around = ("white", INK) if dark else (INK, "white")
        text = axes.text(x, y, shorten(patch.surface, 16, placeholder="…"), fontsize=7, color=ink)
        text.set(
            ha="center", va="center", path_effects=[withStroke(linewidth=1.8, foreground=around)]
        )


def middle(patch: Patch) -> Float[np.ndarray, "2"]:
    """Return the point of a patch that is farthest from its edge [m].

    The resolution is a hundredth of the patch's longer side.
    """
    low, high = patch.rings[0].min(axis=0), patch.rings[0].max(axis=0)
    step = float((high - low).max()) / 100
    columns, rows = (int(n) for n in np.maximum(np.ceil((high - low) / step), 1))
    inside = covered([(ring - low) / step for ring in patch.rings], rows, columns)
    distance = distance_transform_edt(np.pad(inside, 1))[1:-1, 1:-1]
    row, column = np.unravel_index(int(np.argmax(distance)), distance.shape)
    return low + step * (np.array([column, row]) + 0.5)


def _swatches(vector: VectorMap) -> list[Swatch]:
    """Return the entries of the legend: surfaces with colours and areas, and the hatching."""
    swatches = []
    for name, colour in vector.region.colours.items():
        area = sum(patch.area for patch in vector.patches if patch.surface == name)
        swatches.append(Swatch(facecolor=colour, edgecolor=INK, label=f"{name} ({area:.2f} m²)"))
    return [*swatches, Swatch(facecolor="white", edgecolor=SHADE, hatch=HATCH, label="unknown")]
