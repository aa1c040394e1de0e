"""Proposal of points on surfaces, from patches of uniform appearance.

A patch extends over slow changes of the light up to its edges. Without a config, distant patches
are compared after removing the illumination, which is estimated from the patches recognised as
similar so far; similar patches become one surface. With a config that specifies surfaces only by
colour, patches are matched with the given colours. Light may change colours by more than surfaces
differ, so matching is repeated: patches that match a colour well show the illumination, and after
it is removed more patches match.
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
from slipid.camera.floor.surfaces import COARSE_CELLS, MarkedCells, positions, thinned
from slipid.camera.opencv import Labels, Mask, cv2
from slipid.support.errors import DataError

JOIN_LIMITS = (5.0, 7.0, 8.0, 8.0, 8.0)
"""Largest colour distance of patches that count as one surface, in each round [CIELAB units]."""
SEPARATE_FROM = 7.0
"""Smallest colour distance of patches that are proposed as two surfaces [CIELAB units]. It is
small, since users can easily give two proposed surfaces the same name, but not easily split one."""
LEAST_PART = 0.002
"""Fraction of the floor below which a patch is too small to propose a surface [1]."""
LIGHTNESS_WEIGHT = 0.8
"""Weight of a difference in lightness, relative to a difference in a or b [1]; it is below 1 since
shading changes lightness."""
TEXTURE_WEIGHT = 10.0
"""Colour distance [CIELAB units] that counts as much as a difference of 1 in texture."""
ABOUT_SAMPLES = 4000
"""Approximate number of cells to which the illumination is fitted."""
MOST_POINTS = 4
"""Largest number of points that mark a surface."""
MATCH_LIMITS = (8.0, 10.0, 12.0, 14.0, 16.0, 16.0)
"""Largest distance of a patch's colour from a given colour that it matches, in each round [CIELAB
units]."""
CLEAR_RATIO = 0.7
"""Largest ratio of a patch's distance to the nearest given colour to its distance to the second
nearest with which the patch still matches the nearest [1]."""


@dataclass(frozen=True, eq=False)
class Patches:
    """Patches of uniform appearance, found in an image of lower resolution (see `thinned`).

    Attributes:
        appearance: L, a, b and texture of each patch.
        place: row and column, in the full grid, of the cell that is farthest from the patch's edge.
        cells: number of cells of the full grid in each patch.
        samples: colours in all patches; the samples' `surface` is the number of the patch.
    """

    appearance: Float[np.ndarray, "patch 4"]
    place: Int[np.ndarray, "patch 2"]
    cells: Int[np.ndarray, " patch"]
    samples: ColourSamples


def proposed(features: Features, visible: Mask, count: int | None) -> MarkedCells:
    """Return points on surfaces proposed without a config; surface 0 is the largest.

    Args:
        features: features of every cell.
        visible: cells that show the floor.
        count: number of surfaces; None to separate patches whose colours differ by more than
            `SEPARATE_FROM`.

    Raises:
        DataError: there are fewer patches than surfaces.
    """
    patches = patches_of(features, visible)
    if len(patches.place) < max(1, count or 1):
        raise DataError(
            f"{len(patches.place)} uniform patches, too few for {count or 1} surfaces; expected "
            "an image of a floor: mark surfaces in a config, or request fewer with --surfaces"
        )
    own = _clusters(patches, count)
    size = np.bincount(own, weights=patches.cells)
    rank = np.argsort(np.argsort(-size))
    chosen = [
        one
        for k in range(len(size))
        for one in np.flatnonzero(own == k)[np.argsort(-patches.cells[own == k])][:MOST_POINTS]
    ]
    return np.column_stack([patches.place[chosen], rank[own[chosen]]])


def patches_of(features: Features, visible: Mask) -> Patches:
    """Return patches of connected cells within which the appearance changes slowly."""
    step = max(1, round(np.sqrt(visible.size / (2 * COARSE_CELLS))))
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
    places = np.stack(np.unravel_index(np.array(peak, int), parts.shape), axis=1)
    appearance = [np.median(few.appearance[parts == k], axis=0) for k in kept]
    return Patches(
        np.array(appearance, float).reshape(-1, 4),
        np.minimum(places * step + step // 2, np.array(visible.shape) - 1),
        np.array([area[k] * step**2 for k in kept], int),
        _samples(few, parts, kept),
    )


def _samples(few: Features, parts: Labels, kept: Sequence[int]) -> ColourSamples:
    """Return colour samples spread evenly over every kept patch."""
    own = np.full(parts.max() + 1, -1)
    own[list(kept)] = np.arange(len(kept))
    patch = own[parts].ravel()
    cells = np.flatnonzero(patch >= 0)
    cells = cells[:: max(1, len(cells) // ABOUT_SAMPLES)]
    weight = 1 / np.sqrt(np.bincount(patch[cells], minlength=1)[patch[cells]])
    at, rgb = positions(parts.shape)[cells], few.rgb.reshape(-1, 3)[cells].astype(float)
    return ColourSamples(at, rgb, patch[cells], weight)


def _means(samples: ColourSamples) -> Float[np.ndarray, "surface 3"]:
    """Return the mean linear RGB of each surface of the samples."""
    count = samples.surface.max() + 1
    return np.array([samples.rgb[samples.surface == k].mean(axis=0) for k in range(count)])


def _clusters(patches: Patches, count: int | None) -> Int[np.ndarray, " patch"]:
    """Return the surface of each patch, by hierarchical clustering of the patches' colours.

    At first each patch is a surface of its own, and the illumination is estimated from changes of
    colour within patches. Patches recognised as similar then give a better estimate of the
    illumination.
    """
    from scipy.cluster.hierarchy import fcluster, linkage

    samples, own = patches.samples, np.arange(len(patches.place))
    if len(own) == 1:
        return own
    for near in JOIN_LIMITS:
        grouped = replace(samples, surface=own[samples.surface])
        start = LitColours(Illumination.uniform(), _means(grouped))
        plain = _perceptual(lab_of(_relit(fit_illumination(grouped, start).illumination, samples)))
        middle = [np.median(plain[samples.surface == k], axis=0) for k in range(len(own))]
        rough = TEXTURE_WEIGHT * patches.appearance[:, 3:]
        tree = linkage(np.concatenate([np.array(middle), rough], axis=1), "average")
        own = fcluster(tree, near, "distance") - 1
    if count is None:
        return np.asarray(fcluster(tree, SEPARATE_FROM, "distance") - 1)
    return np.asarray(fcluster(tree, count, "maxclust") - 1)


def _perceptual(lab: Float[np.ndarray, "place 3"]) -> Float[np.ndarray, "place 3"]:
    """Return CIELAB values with compressed chroma and with lightness times `LIGHTNESS_WEIGHT`.

    The compression makes distances between strong colours match perception.
    """
    chroma = np.linalg.norm(lab[:, 1:], axis=1, keepdims=True)
    drawn = np.log1p(0.045 * chroma) / (0.045 * np.maximum(chroma, 1e-6))
    return np.concatenate([LIGHTNESS_WEIGHT * lab[:, :1], drawn * lab[:, 1:]], axis=1)


def _relit(illumination: Illumination, samples: ColourSamples) -> Float[np.ndarray, "place 3"]:
    """Return the linear RGB that the samples would have at the position with the smallest veil."""
    plain = illumination.true_colours(samples.rgb, samples.at)
    veil = basis_at(samples.at) @ illumination.veil
    clearest = samples.at[[int(np.argmin(veil.sum(axis=1)))]]
    return illumination.rgb_of(plain, clearest)[:, 0]


def matched(
    features: Features, visible: Mask, colours: Float[np.ndarray, "surface 3"]
) -> MarkedCells:
    """Return the middles of patches that match a given colour [linear RGB], and its number."""
    patches = patches_of(features, visible)
    count = len(patches.place)
    own = np.full(count, -1)
    if not count:
        return np.zeros((0, 3), int)
    samples = patches.samples
    fit = LitColours(Illumination.uniform(), np.concatenate([colours, _means(samples)]))
    for near in MATCH_LIMITS:
        expected = _to_brightness(colours, fit.colours[: len(colours)], np.unique(own[own >= 0]))
        own = _nearest(patches, fit.illumination.rgb_of(expected, samples.at), near)
        # keep a patch without a match as a surface of its own, since it shows how the light changes
        each = np.where(own >= 0, own, len(colours) + np.arange(count))
        fit = fit_illumination(replace(samples, surface=each[samples.surface]), fit)
    return np.column_stack([patches.place, own])[own >= 0]


def _to_brightness(
    given: Float[np.ndarray, "surface 3"],
    fitted: Float[np.ndarray, "surface 3"],
    matched: Int[np.ndarray, " match"],
) -> Float[np.ndarray, "surface 3"]:
    """Return the fitted colours of matched surfaces, and scaled given colours of all others.

    The scale is the median ratio of fitted to given brightness of the matched surfaces.
    """
    if not len(matched):
        return given
    brighter = np.median(fitted[matched].sum(axis=1) / given[matched].sum(axis=1))
    colours = given * float(np.clip(brighter, 0.3, 3.0))
    colours[matched] = fitted[matched]
    return colours


def _nearest(
    patches: Patches, expected: Float[np.ndarray, "surface sample 3"], near: float
) -> Int[np.ndarray, " patch"]:
    """Return the number of the colour that each patch matches, or -1 if it matches none.

    A patch has no match if no colour is near or if two colours are about equally near.
    """
    samples = patches.samples
    scale = np.array([LIGHTNESS_WEIGHT, 1, 1])
    off = np.linalg.norm((lab_of(expected) - lab_of(samples.rgb)) * scale, axis=-1)
    distance = np.stack(
        [np.median(off[:, samples.surface == k], 1) for k in range(len(patches.place))]
    )
    ordered = np.sort(distance, axis=1)
    clear = ordered[:, 0] < near
    if distance.shape[1] > 1:
        clear &= ordered[:, 0] < CLEAR_RATIO * ordered[:, 1]
    return np.where(clear, np.argmin(distance, axis=1), -1)
