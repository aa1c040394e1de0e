"""Points on surfaces, proposed by patches of uniform appearance.

A patch is followed across slow changes of the light to its edges. Without a config, patches far
apart are compared after removing the illumination estimated from those recognised as similar so
far, and similar ones become one surface. With a config that names surfaces by colour alone, patches
are matched with those colours: colours alone are a poor start, for light changes them by more than
they differ, but patches that match a colour well show how the floor is lit, and then more match.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from slipid.camera.floor.light import (
    ColourSamples,
    Features,
    Illumination,
    LitColours,
    basis_at,
    fit_illumination,
    lab_of,
)
from slipid.camera.floor.surfaces import COARSE, MarkedCells, positions, thinned
from slipid.camera.opencv import Labels, Mask, opencv
from slipid.support.errors import DataError

JOIN = (5.0, 7.0, 8.0, 8.0, 8.0)
"""Distance up to which patches count as one surface, round by round [L, a, b]."""
SEPARATE = 7.0
"""Distance from which on patches are proposed as two surfaces [L, a, b]. Two proposed surfaces are
more easily joined by one name than one is split."""
LEAST_PART = 0.002
"""Part of the floor below which a patch proposes no surface."""
LIGHTNESS = 0.8
"""Weight of a difference of lightness beside one of hue: shading changes lightness."""
TEXTURE = 10.0
"""Weight of a difference of 1 in texture, the logarithm of roughness [L, a, b]."""
SAMPLES = 4000
"""Number of cells in which the light is compared."""
POINTS = 4
"""Largest number of points that mark a surface."""
MATCH = (8.0, 10.0, 12.0, 14.0, 16.0, 16.0)
"""Distance up to which a patch matches a colour, round by round [L, a, b]."""
CLEARER = 0.7
"""Largest ratio of the distances to the nearest colour and to the next for a match."""


@dataclass(frozen=True, eq=False)
class Patches:
    """Patches of uniform appearance in the thinned picture.

    Attributes:
        appearance: L, a, b and texture of each patch.
        row, column: cell of the whole picture farthest from the patch's edge.
        cells: number of cells of the whole picture in each patch.
        samples: samples of the light in all patches; `surface` is the number of the patch.
    """

    appearance: Float[np.ndarray, "patch 4"]
    row: Int[np.ndarray, " patch"]
    column: Int[np.ndarray, " patch"]
    cells: Int[np.ndarray, " patch"]
    samples: ColourSamples


def proposed(features: Features, visible: Mask, count: int | None) -> MarkedCells:
    """Return points on surfaces proposed without a config, the largest surface first.

    Args:
        features: features of every cell.
        visible: cells that show the floor.
        count: number of surfaces; None separates all patches that are not clearly similar.

    Raises:
        DataError: there are fewer patches than surfaces.
    """
    patches = patches_of(features, visible)
    if len(patches.row) < max(1, count or 1):
        raise DataError(
            f"{len(patches.row)} uniform patches, too few for {count or 1} surfaces; expected "
            "a picture of a floor: mark surfaces in a config, or name fewer with --surfaces"
        )
    own = _clusters(patches, count)
    size = np.bincount(own, weights=patches.cells)
    rank = np.argsort(np.argsort(-size))
    chosen = [
        one
        for k in range(len(size))
        for one in np.flatnonzero(own == k)[np.argsort(-patches.cells[own == k])][:POINTS]
    ]
    return MarkedCells(patches.row[chosen], patches.column[chosen], rank[own[chosen]])


def patches_of(features: Features, visible: Mask) -> Patches:
    """Return patches of connected cells between which the appearance changes slowly."""
    cv2 = opencv()
    step = max(1, round(np.sqrt(visible.size / (2 * COARSE))))
    few, some = thinned(features, step), visible[step // 2 :: step, step // 2 :: step]
    soft = cv2.GaussianBlur(few.appearance[..., :3], (0, 0), 1.2)
    across, down = (cv2.Sobel(soft, cv2.CV_32F, i, 1 - i, scale=0.125) for i in (1, 0))
    slope = np.sqrt((across**2 + down**2).sum(axis=-1))
    flat = some & (slope < max(0.9, 1.5 * float(np.median(slope[some]))))
    core = cv2.erode(flat.astype(np.uint8), np.ones((3, 3), np.uint8))
    count, parts, stats, _ = cv2.connectedComponentsWithStats(core, connectivity=4)
    inner = cv2.distanceTransform(cv2.copyMakeBorder(core, 1, 1, 1, 1, 0), cv2.DIST_L2, 3)
    inner = inner[1:-1, 1:-1]
    area = stats[:, cv2.CC_STAT_AREA]
    kept = [k for k in range(1, count) if area[k] >= LEAST_PART * some.sum()]
    peak = [int(np.argmax(np.where(parts == k, inner, -1))) for k in kept]
    rows, columns = np.unravel_index(np.array(peak, int), parts.shape)
    appearance = [np.median(few.appearance[parts == k], axis=0) for k in kept]
    return Patches(
        np.array(appearance, float).reshape(-1, 4),
        np.minimum(rows * step + step // 2, visible.shape[0] - 1),
        np.minimum(columns * step + step // 2, visible.shape[1] - 1),
        np.array([area[k] * step**2 for k in kept], int),
        _samples(few, parts, kept),
    )


def _samples(few: Features, parts: Labels, kept: Sequence[int]) -> ColourSamples:
    """Return samples spread evenly over every kept patch."""
    own = np.full(parts.max() + 1, -1)
    own[list(kept)] = np.arange(len(kept))
    patch = own[parts].ravel()
    cells = np.flatnonzero(patch >= 0)
    cells = cells[:: max(1, len(cells) // SAMPLES)]
    weight = 1 / np.sqrt(np.bincount(patch[cells], minlength=1)[patch[cells]])
    at, rgb = positions(parts.shape)[cells], few.rgb.reshape(-1, 3)[cells].astype(float)
    return ColourSamples(at, rgb, patch[cells], weight)


def _means(samples: ColourSamples) -> Float[np.ndarray, "surface 3"]:
    """Return the mean linear RGB of each surface of the samples."""
    count = samples.surface.max() + 1
    return np.array([samples.rgb[samples.surface == k].mean(axis=0) for k in range(count)])


def _clusters(patches: Patches, count: int | None) -> Int[np.ndarray, " patch"]:
    """Return the surface of each patch, by hierarchical clustering of their colours.

    At first each patch is a surface of its own: the change of light within patches is enough to
    compare them, and those recognised as similar then give a better estimate of the light.
    """
    from scipy.cluster.hierarchy import fcluster, linkage

    samples, own = patches.samples, np.arange(len(patches.row))
    if len(own) == 1:
        return own
    for near in JOIN:
        grouped = replace(samples, surface=own[samples.surface])
        start = LitColours(Illumination.uniform(), _means(grouped))
        plain = _evenly(lab_of(_relit(fit_illumination(grouped, start).illumination, samples)))
        middle = [np.median(plain[samples.surface == k], axis=0) for k in range(len(own))]
        rough = TEXTURE * patches.appearance[:, 3:]
        tree = linkage(np.concatenate([np.array(middle), rough], axis=1), "average")
        own = fcluster(tree, near, "distance") - 1
    if count is None:
        return np.asarray(fcluster(tree, SEPARATE, "distance") - 1)
    return np.asarray(fcluster(tree, count, "maxclust") - 1)


def _evenly(lab: Float[np.ndarray, "place 3"]) -> Float[np.ndarray, "place 3"]:
    """Return CIELAB with the chroma of strong colours compressed, as people perceive it."""
    chroma = np.linalg.norm(lab[:, 1:], axis=1, keepdims=True)
    drawn = np.log1p(0.045 * chroma) / (0.045 * np.maximum(chroma, 1e-6))
    return np.concatenate([LIGHTNESS * lab[:, :1], drawn * lab[:, 1:]], axis=1)


def _relit(illumination: Illumination, samples: ColourSamples) -> Float[np.ndarray, "place 3"]:
    """Return the linear RGB that the samples would have at the place with the least glare."""
    plain = illumination.true_colours(samples.rgb, samples.at)
    veil = basis_at(samples.at) @ illumination.veil
    clearest = samples.at[[int(np.argmin(veil.sum(axis=1)))]]
    return illumination.rgb_of(plain, clearest)[:, 0]


def matched(
    features: Features, visible: Mask, colours: Float[np.ndarray, "surface 3"]
) -> MarkedCells:
    """Return the middles of patches that match one of some colours best [linear RGB]."""
    patches = patches_of(features, visible)
    count = len(patches.row)
    own = np.full(count, -1)
    if not count:
        return MarkedCells(patches.row, patches.column, own)
    samples = patches.samples
    fit = LitColours(Illumination.uniform(), np.concatenate([colours, _means(samples)]))
    for near in MATCH:
        expected = _exposed(colours, fit.colours[: len(colours)], np.unique(own[own >= 0]))
        own = _nearest(patches, fit.illumination.rgb_of(expected, samples.at), near)
        # a patch without a match still shows, by its own colour, how the light changes within it
        each = np.where(own >= 0, own, len(colours) + np.arange(count))
        fit = fit_illumination(replace(samples, surface=each[samples.surface]), fit)
    kept = own >= 0
    return MarkedCells(patches.row[kept], patches.column[kept], own[kept])


def _exposed(
    given: Float[np.ndarray, "surface 3"],
    fitted: Float[np.ndarray, "surface 3"],
    matched: Int[np.ndarray, " match"],
) -> Float[np.ndarray, "surface 3"]:
    """Return the fitted colours of matched surfaces, and given ones of equal brightness else."""
    if not len(matched):
        return given
    brighter = np.median(fitted[matched].sum(axis=1) / given[matched].sum(axis=1))
    colours = given * float(np.clip(brighter, 0.3, 3.0))
    colours[matched] = fitted[matched]
    return colours


def _nearest(
    patches: Patches, expected: Float[np.ndarray, "surface sample 3"], near: float
) -> Int[np.ndarray, " patch"]:
    """Return the matching colour of each patch; -1 where none is near or two are."""
    samples = patches.samples
    scale = np.array([LIGHTNESS, 1, 1])
    off = np.linalg.norm((lab_of(expected) - lab_of(samples.rgb)) * scale, axis=-1)
    distance = np.stack(
        [np.median(off[:, samples.surface == k], 1) for k in range(len(patches.row))]
    )
    ordered = np.sort(distance, axis=1)
    clear = ordered[:, 0] < near
    if distance.shape[1] > 1:
        clear &= ordered[:, 0] < CLEARER * ordered[:, 1]
    return np.where(clear, np.argmin(distance, axis=1), -1)
