"""Appearance of each surface, learnt with the illumination from a few marked cells or colours.

Two steps alternate: every cell is assigned the surface that it resembles most under the present
illumination, and from cells that clearly belong to their surface, colours, spreads and illumination
are estimated again. The assignment also depends on a cell's neighbours, so that surfaces form
patches with clean edges.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int

from slipid.camera.floor.light import (
    ColourSamples,
    Features,
    Illumination,
    LitColours,
    fit_illumination,
    lab_of,
)
from slipid.camera.opencv import Labels, Mask, cv2

MOST_ROUNDS = 10
"""Largest number of rounds of learning, see `learnt`."""
STEADY_SHARE = 3e-4
"""Learning ends when less than this fraction of the cells changes its surface in a round [1]."""
COARSE_CELLS = 25_000
"""Approximate number of cells of the coarser grid from which surfaces are learnt, see `thinned`."""
MOST_SAMPLES = 5_000
"""Largest number of cells to which illumination and colours are fitted."""
LEAST_SPREAD = np.array([2.0, 1.5, 1.5, 0.25])
MOST_SPREAD = np.array([6.0, 4.0, 4.0, 0.7])
"""Smallest and largest spread of L, a, b [units of CIELAB] and texture [1] within a surface."""
OUTLIER_COST = 60.0
"""Cost of a cell above which it belongs to none of the surfaces [squared spreads]."""
CLEAR_COST = 16.0
"""Cost of a cell below which it clearly belongs to its surface [squared spreads]."""
Costs = Float32[np.ndarray, "surface row column"]
"""Cost of assigning each surface to each cell: the squared difference of their appearances, in
squared spreads within the surface [1]."""
UNKNOWN = -1
"""Label of cells without a surface."""
NEIGHBOUR_COST = 3.0
"""Additional cost of a surface in a cell whose neighbours all have another surface [squared
spreads]."""
NEIGHBOUR_STD = 1.5
"""Width sigma of the Gaussian kernel that weights a cell's neighbours [cells]."""
FIELD_ROUNDS = 5
"""Number of mean-field iterations over neighbouring cells."""
SMALL_PATCH = 150
"""Number of cells below which a patch is merged with its surroundings."""
MARK_RADIUS = 4
"""Distance around a marked point within which cells are assumed to have its surface [cells]."""


MarkedCells = Int[np.ndarray, "_ 3"]
"""Row, column and number of the surface of some cells."""


def surroundings(marked: MarkedCells, visible: Mask) -> MarkedCells:
    """Return visible cells around each marked cell, marked with the same surface.

    These are the marked cell and every second cell within `MARK_RADIUS` along rows and columns.
    """
    steps = np.arange(-MARK_RADIUS, MARK_RADIUS + 1, 2)
    down, across = (step.ravel() for step in np.meshgrid(steps, steps))
    around = np.stack([down, across, np.zeros(len(down), int)], axis=1)
    cells = (marked[:, None] + around).reshape(-1, 3)
    cells = cells[((cells[:, :2] >= 0) & (cells[:, :2] < visible.shape)).all(axis=1)]
    return cells[visible[cells[:, 0], cells[:, 1]]]


@dataclass(frozen=True, eq=False)
class Seeds:
    """Prior knowledge of the surfaces: the colour of each [linear RGB], and marked cells."""

    colours: Float[np.ndarray, "surface 3"]
    marked: MarkedCells


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Learnt appearance of every surface.

    Attributes:
        lit: colours of the surfaces, and the illumination.
        texture: texture of each surface, see `slipid.camera.floor.light.texture`.
        spread: spread of L, a, b and texture within each surface.
    """

    lit: LitColours
    texture: Float[np.ndarray, " surface"]
    spread: Float[np.ndarray, "surface 4"]

    def appearances(self, shape: tuple[int, int]) -> Float32[np.ndarray, "surface row column 4"]:
        """Return the L, a, b and texture that each surface would have in every cell."""
        rows, columns = min(shape[0], 48), min(shape[1], 48)
        at = positions((rows, columns))
        coarse = lab_of(self.lit.illumination.rgb_of(self.lit.colours, at))
        out = np.empty((len(coarse), *shape, 4), np.float32)
        size = (shape[1], shape[0])
        for k, lab in enumerate(coarse.reshape(-1, rows, columns, 3).astype(np.float32)):
            out[k, ..., :3] = cv2.resize(lab, size, interpolation=cv2.INTER_LINEAR)
            out[k, ..., 3] = self.texture[k]
        return out

    def costs(self, appearance: Float[np.ndarray, "row column 4"]) -> Costs:
        """Return the cost of each surface in each cell [squared spreads].

        The cost is at most 1.5 `OUTLIER_COST`. A wide spread adds to the cost, since otherwise the
        surface with the widest spread would have the lowest cost in most cells.
        """
        out = np.empty((len(self.spread), *appearance.shape[:2]), np.float32)
        for k, expected in enumerate(self.appearances(appearance.shape[:2])):
            off = (appearance - expected) / self.spread[k].astype(np.float32)
            wide = 2 * np.log(self.spread[k] / LEAST_SPREAD).sum()
            # the cost of texture is limited, since edges and dirt are rough on every surface
            rough = np.minimum(off[..., 3] ** 2, 6.0)
            out[k] = (off[..., :3] ** 2).sum(axis=-1) + rough + wide
        return np.minimum(out, 1.5 * OUTLIER_COST)


def positions(shape: tuple[int, int]) -> Float[np.ndarray, "place 2"]:
    """Return x and y of all cells, row by row, scaled to -1 to 1 over the grid."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    size = np.maximum(np.array([shape[1], shape[0]]) - 1, 1)
    return 2 * np.stack([x.ravel(), y.ravel()], axis=-1) / size - 1


def learnt(features: Features, visible: Mask, seeds: Seeds) -> Surfaces:
    """Return the appearance of the surfaces in an image, learnt from seeds."""
    step = max(1, round(np.sqrt(visible.size / COARSE_CELLS)))
    few, some = thinned(features, step), visible[step // 2 :: step, step // 2 :: step]
    shape = few.appearance.shape[:2]
    places = np.minimum(seeds.marked[:, :2] // step, np.array(shape) - 1)
    marked = places @ np.array([shape[1], 1])
    surfaces = _start(few, marked, seeds)
    flat = _flat(few.appearance) & some
    before = np.full(shape, -1)
    for _ in range(MOST_ROUNDS):
        costs = surfaces.costs(few.appearance)
        labels = labelled(costs, some)
        if np.mean(labels != before) < STEADY_SHARE:
            break
        before = labels
        costs = np.concatenate([costs, np.full((1, *shape), np.inf)])
        own = np.take_along_axis(costs, np.maximum(labels, 0)[None], axis=0)[0]
        clear = (own < CLEAR_COST) & flat & (labels < len(seeds.colours)) & (labels >= 0)
        surfaces = _updated(surfaces, few, np.where(clear, labels, -1).ravel(), marked, seeds)
    return surfaces


def thinned(features: Features, step: int) -> Features:
    """Return the features of every `step`-th cell along both axes, smoothed over `step` cells."""
    if step == 1:
        return features
    cut = slice(step // 2, None, step)
    appearance, rgb = (
        cv2.GaussianBlur(one, (0, 0), 0.4 * step)[cut, cut]
        for one in (features.appearance, features.rgb)
    )
    return Features(appearance, rgb)


def _flat(appearance: Float[np.ndarray, "row column 4"]) -> Mask:
    """Return a mask of the cells that do not lie at an edge, where colours mix."""
    lab = np.ascontiguousarray(appearance[..., :3])
    kernel = np.ones((3, 3), np.uint8)
    change = (cv2.dilate(lab, kernel) - cv2.erode(lab, kernel)).max(axis=-1)
    return np.asarray(change < max(8.0, 1.5 * float(np.median(change))))


def _start(few: Features, marked: Int[np.ndarray, " seed"], seeds: Seeds) -> Surfaces:
    """Return the appearance of the surfaces, estimated only from the seeds."""
    start = LitColours(Illumination.uniform(), seeds.colours)
    texture = np.full(len(seeds.colours), float(np.median(few.appearance[..., 3])))
    spread = np.tile(MOST_SPREAD, (len(seeds.colours), 1))
    spread[:, 3] = 100.0  # without marked cells the texture is unknown: give it no influence
    if not len(marked):
        return Surfaces(start, texture, spread)
    rgb, rough = (
        few.rgb.reshape(-1, 3)[marked].astype(float),
        few.appearance[..., 3].ravel()[marked],
    )
    at, own = positions(few.appearance.shape[:2])[marked], seeds.marked[:, 2]
    for k in np.unique(own):
        texture[k], spread[k, 3] = np.median(rough[own == k]), MOST_SPREAD[3]
    fit = fit_illumination(ColourSamples(at, rgb, own, np.ones(len(at))), start)
    return Surfaces(fit, texture, spread)


def _updated(
    surfaces: Surfaces,
    few: Features,
    labels: Int[np.ndarray, " cell"],
    marked: Int[np.ndarray, " seed"],
    seeds: Seeds,
) -> Surfaces:
    """Return the appearance of the surfaces, estimated from labelled cells and marked cells."""
    cells = np.flatnonzero(labels >= 0)
    cells = cells[:: 1 + len(cells) // MOST_SAMPLES]
    if not len(cells):
        return surfaces
    own = np.concatenate([labels[cells], seeds.marked[:, 2]])
    cells = np.concatenate([cells, marked])
    count = np.bincount(own, minlength=len(seeds.colours))
    # small surfaces get larger weights, so that all contribute to the illumination
    weight = 1 / np.sqrt(count[own])
    weight[len(weight) - len(marked) :] *= 3  # a marked cell certainly has its surface
    at, appearance = (
        positions(few.appearance.shape[:2])[cells],
        few.appearance.reshape(-1, 4)[cells],
    )
    samples = ColourSamples(at, few.rgb.reshape(-1, 3)[cells].astype(float), own, weight)
    fit = fit_illumination(samples, surfaces.lit)
    texture, spread = surfaces.texture.copy(), surfaces.spread.copy()
    for k in np.unique(own):
        mine = own == k
        texture[k] = np.median(appearance[mine, 3])
        expected = lab_of(fit.illumination.rgb_of(fit.colours[k : k + 1], at[mine])[0])
        off = np.abs(
            appearance[mine] - np.column_stack([expected, np.full(mine.sum(), texture[k])])
        )
        # a median instead of a standard deviation, since some cells have the wrong label
        spread[k] = np.clip(1.5 * np.median(off, axis=0), LEAST_SPREAD, MOST_SPREAD)
    return Surfaces(fit, texture, spread)


def labelled(costs: Costs, visible: Mask) -> Labels:
    """Return the surface of each cell; `len(costs)` marks a cell that resembles no surface."""
    outlier = np.full((1, *visible.shape), OUTLIER_COST, np.float32)
    return smoothed(np.concatenate([costs, outlier]), visible)


def smoothed(costs: Costs, visible: Mask) -> Labels:
    """Return labels that have a low cost and agree with the labels of neighbouring cells.

    The method is the mean-field approximation of a Potts model: each cell has a probability for
    every surface, and the more probable a surface is in neighbouring cells, the lower its cost in
    the cell. Cells that are not visible do not affect others and get the label `UNKNOWN`.
    """
    weight = visible.astype(np.float32)
    around = np.maximum(cv2.GaussianBlur(weight, (0, 0), NEIGHBOUR_STD), 1e-3)
    total = costs
    for _ in range(FIELD_ROUNDS):
        chance = np.exp(-0.5 * (total - total.min(axis=0)))
        chance *= weight / chance.sum(axis=0)
        neighbours = np.stack([cv2.GaussianBlur(one, (0, 0), NEIGHBOUR_STD) for one in chance])
        total = costs - 2 * NEIGHBOUR_COST * neighbours / around
    return np.where(visible, np.argmin(total, axis=0), UNKNOWN)


def without_small_patches(labels: Labels, visible: Mask, width: int) -> Labels:
    """Return labels with small or narrow patches merged into the nearest other patches.

    Narrow patches arise along the edge between two surfaces, where the mixed colour may resemble a
    third surface.

    Args:
        labels: surface of each cell.
        visible: cells that may have a surface.
        width: width of the narrowest patch that is kept [cells].
    """
    size = 2 * (width // 2) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    kept = np.zeros(labels.shape, bool)
    for surface in np.unique(labels):
        mine = (labels == surface).astype(np.uint8)
        # count hidden cells as part of the patch, which may continue there and not be narrow
        opened = cv2.morphologyEx(mine | (~visible).astype(np.uint8), cv2.MORPH_OPEN, disc)
        kept |= (opened > 0) & (mine > 0)
    labels = np.where(visible, _nearest(labels, kept & visible), UNKNOWN)
    large = np.zeros(labels.shape, bool)
    for surface in np.unique(labels[visible]):
        mine = (labels == surface).astype(np.uint8)
        _, parts, stats, _ = cv2.connectedComponentsWithStats(mine, connectivity=4)
        big = stats[:, cv2.CC_STAT_AREA] >= SMALL_PATCH
        big[0] = False  # component 0 is the background
        large |= big[parts]
    return np.where(visible, _nearest(labels, large & visible), UNKNOWN)


def _nearest(labels: Labels, kept: Mask) -> Labels:
    """Give every cell the label of the nearest kept cell; no change if no cell is kept."""
    from scipy.ndimage import distance_transform_edt

    if kept.all() or not kept.any():
        return labels
    rows, columns = distance_transform_edt(~kept, return_distances=False, return_indices=True)
    return np.asarray(labels[rows, columns])
