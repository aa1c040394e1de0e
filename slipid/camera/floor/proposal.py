"""Surfaces proposed where none are told: patches of one look, and which of them are alike.

A patch is followed across slow changes of light to its edges; patches far apart are compared after
the light is undone that those found alike so far tell of.

Where the surfaces lie that are told by colour alone: patches matched under the light so far.

Colours on their own are a poor start, for light changes them by more than they differ. Patches that
match a colour well say how the floor is lit, and then more of them match.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from slipid.camera.floor.colour import Features, lab_of
from slipid.camera.floor.shading import Light, Lit, Samples, lit, shapes
from slipid.camera.floor.surfaces import COARSE, places, thinned
from slipid.camera.opencv import opencv
from slipid.support.errors import DataError

CAUTION = (5.0, 7.0, 8.0, 8.0, 8.0)
"""Up to which distance patches are taken for alike, round by round [L, a, b]."""
ALIKE = 7.0
"""Patches farther apart are proposed as two surfaces: two are joined by one name more easily than
one is parted [L, a, b]."""
LEAST_PART = 0.002
"""A patch that is less of the floor proposes no surface."""
LIGHTNESS = 0.8
"""How much a difference of lightness counts beside one of hue: shading is one."""
TEXTURE = 10.0
"""How much a texture that is e times as rough counts [L, a, b]."""
SAMPLES = 4000
"""Cells that the light is compared in."""
POINTS = 4
"""Most points that a surface is marked with."""


@dataclass(frozen=True, eq=False)
class Patches:
    """Patches of one look each, of the thinned picture.

    Attributes:
        look: L, a, b and texture of each.
        light: amounts of red, green and blue light of each.
        row, column: of the point farthest from its edge, in cells of the whole picture.
        cells: of each, whole picture.
        samples: of the light in all of them; the surface is the number of the patch.
    """

    look: Float[np.ndarray, "patch 4"]
    row: Int[np.ndarray, " patch"]
    column: Int[np.ndarray, " patch"]
    cells: Int[np.ndarray, " patch"]
    samples: Samples


@dataclass(frozen=True, eq=False)
class Proposal:
    """Marked cells and the surface of each, those with most of the floor first."""

    row: Int[np.ndarray, " point"]
    column: Int[np.ndarray, " point"]
    surface: Int[np.ndarray, " point"]


def proposed(found: Features, known: Bool[np.ndarray, "row column"], count: int | None) -> Proposal:
    """Points that tell the surfaces apart.

    Args:
        count: of surfaces; None parts all that are not clearly alike.

    Raises:
        DataError: there are fewer patches than surfaces.
    """
    patches = patches_of(found, known)
    if len(patches.row) < max(1, count or 1):
        raise DataError(
            f"{len(patches.row)} patches of one look, too few for {count or 1} surfaces; expected "
            "a picture of a floor: mark surfaces in a config, or name fewer with --surfaces"
        )
    own = _alike(patches, count)
    whole = np.bincount(own, weights=patches.cells)
    rank = np.argsort(np.argsort(-whole))
    chosen = [
        one
        for k in range(len(whole))
        for one in np.flatnonzero(own == k)[np.argsort(-patches.cells[own == k])][:POINTS]
    ]
    return Proposal(patches.row[chosen], patches.column[chosen], rank[own[chosen]])


def patches_of(found: Features, known: Bool[np.ndarray, "row column"]) -> Patches:
    """Connected cells between which the look changes slowly."""
    cv2 = opencv()
    step = max(1, round(np.sqrt(known.size / (2 * COARSE))))
    few, some = thinned(found, step), known[step // 2 :: step, step // 2 :: step]
    soft = cv2.GaussianBlur(few.look[..., :3], (0, 0), 1.2)
    across, down = (cv2.Sobel(soft, cv2.CV_32F, i, 1 - i, scale=0.125) for i in (1, 0))
    slope = np.sqrt((across**2 + down**2).sum(axis=-1))
    flat = some & (slope < max(0.9, 1.5 * float(np.median(slope[some]))))
    core = cv2.erode(flat.astype(np.uint8), np.ones((3, 3), np.uint8))
    count, parts, stats, _ = cv2.connectedComponentsWithStats(core, connectivity=4)
    inner = cv2.distanceTransform(cv2.copyMakeBorder(core, 1, 1, 1, 1, 0), cv2.DIST_L2, 3)
    inner = inner[1:-1, 1:-1]
    area = stats[:, cv2.CC_STAT_AREA]
    wanted = [k for k in range(1, count) if area[k] >= LEAST_PART * some.sum()]
    peak = [int(np.argmax(np.where(parts == k, inner, -1))) for k in wanted]
    rows, columns = np.unravel_index(np.array(peak, int), parts.shape)
    look = [np.median(few.look[parts == k], axis=0) for k in wanted]
    return Patches(
        np.array(look, float).reshape(-1, 4),
        np.minimum(rows * step + step // 2, known.shape[0] - 1),
        np.minimum(columns * step + step // 2, known.shape[1] - 1),
        np.array([area[k] * step**2 for k in wanted], int),
        _samples(few, parts, wanted),
    )


def _samples(few: Features, parts: Int[np.ndarray, "row column"], wanted: Sequence[int]) -> Samples:
    """Cells of every patch, evenly over it."""
    own = np.full(parts.max() + 1, -1)
    own[list(wanted)] = np.arange(len(wanted))
    patch = own[parts].ravel()
    cells = np.flatnonzero(patch >= 0)
    cells = cells[:: max(1, len(cells) // SAMPLES)]
    weight = 1 / np.sqrt(np.bincount(patch[cells], minlength=1)[patch[cells]])
    at, light = places(parts.shape)[cells], few.light.reshape(-1, 3)[cells].astype(float)
    return Samples(at, light, patch[cells], weight)


def _alike(patches: Patches, count: int | None) -> Int[np.ndarray, " patch"]:
    """Which patches are of one surface.

    At first each is taken for a surface of its own: how the light changes within them is enough
    to compare them by, and what is alike then says more of the light.
    """
    from scipy.cluster.hierarchy import fcluster, linkage

    samples, own = patches.samples, np.arange(len(patches.row))
    if len(own) == 1:
        return own
    for near in CAUTION:
        surface = own[samples.surface]
        start = [samples.light[surface == k].mean(axis=0) for k in range(own.max() + 1)]
        found = lit(replace(samples, surface=surface), Lit(Light.even(), np.array(start)))
        plain = _evenly(lab_of(_at_the_clearest(found.light, samples)))
        middle = [np.median(plain[samples.surface == k], axis=0) for k in range(len(own))]
        rough = TEXTURE * patches.look[:, 3:]
        tree = linkage(np.concatenate([np.array(middle), rough], axis=1), "average")
        own = fcluster(tree, near, "distance") - 1
    if count is None:
        return np.asarray(fcluster(tree, ALIKE, "distance") - 1)
    return np.asarray(fcluster(tree, count, "maxclust") - 1)


def _evenly(lab: Float[np.ndarray, "place 3"]) -> Float[np.ndarray, "place 3"]:
    """CIELAB with the chroma of strong colours drawn together, as people tell them apart."""
    chroma = np.linalg.norm(lab[:, 1:], axis=1, keepdims=True)
    drawn = np.log1p(0.045 * chroma) / (0.045 * np.maximum(chroma, 1e-6))
    return np.concatenate([LIGHTNESS * lab[:, :1], drawn * lab[:, 1:]], axis=1)


def _at_the_clearest(light: Light, samples: Samples) -> Float[np.ndarray, "place 3"]:
    """What the samples would look like where the floor is seen with the least glare."""
    plain = light.undone(samples.light, samples.at)
    veil = shapes(samples.at) @ light.veil
    clearest = samples.at[[int(np.argmin(veil.sum(axis=1)))]]
    return light.seen(plain, clearest)[:, 0]


WIDER = (8.0, 10.0, 12.0, 14.0, 16.0, 16.0)
"""Up to which distance a patch matches a colour, round by round [L, a, b]."""
SURER = 0.7
"""A patch matches a colour that is nearer than this part of the distance to the next."""


@dataclass(frozen=True, eq=False)
class Matches:
    """Middles of patches, in cells, and the surface that each matches."""

    row: Int[np.ndarray, " patch"]
    column: Int[np.ndarray, " patch"]
    surface: Int[np.ndarray, " patch"]


def matched(
    found: Features, known: Bool[np.ndarray, "row column"], colours: Float[np.ndarray, "surface 3"]
) -> Matches:
    """Patches that look most like one of some colours."""
    patches = patches_of(found, known)
    count = len(patches.row)
    none = np.zeros(0, int)
    if not count:
        return Matches(none, none, none)
    samples = patches.samples
    own_colour = np.array([samples.light[samples.surface == k].mean(axis=0) for k in range(count)])
    now = Lit(Light.even(), np.concatenate([colours, own_colour]))
    own = np.full(count, -1)
    for wide in WIDER:
        expected = _exposed(colours, now.colours[: len(colours)], np.unique(own[own >= 0]))
        own = _nearest(patches, now.light.seen(expected, samples.at), wide)
        # a patch that matches nothing yet still tells by its own colour how the light changes
        each = np.where(own >= 0, own, len(colours) + np.arange(count))
        now = lit(replace(samples, surface=each[samples.surface]), now)
    kept = own >= 0
    return Matches(patches.row[kept], patches.column[kept], own[kept])


def _exposed(
    told: Float[np.ndarray, "surface 3"],
    found: Float[np.ndarray, "surface 3"],
    matched: Int[np.ndarray, " match"],
) -> Float[np.ndarray, "surface 3"]:
    """Colours as found where there are some, and as told but as bright as those where not."""
    if not len(matched):
        return told
    brighter = np.median(found[matched].sum(axis=1) / told[matched].sum(axis=1))
    now = told * float(np.clip(brighter, 0.3, 3.0))
    now[matched] = found[matched]
    return now


def _nearest(
    patches: Patches, expected: Float[np.ndarray, "surface sample 3"], wide: float
) -> Int[np.ndarray, " patch"]:
    """The colour of each patch; -1 where none is near or two are."""
    samples = patches.samples
    scale = np.array([LIGHTNESS, 1, 1])
    off = np.linalg.norm((lab_of(expected) - lab_of(samples.light)) * scale, axis=-1)
    far = np.stack([np.median(off[:, samples.surface == k], 1) for k in range(len(patches.row))])
    best = np.argmin(far, axis=1)
    ordered = np.sort(far, axis=1)
    sure = ordered[:, 0] < wide
    if far.shape[1] > 1:
        sure &= ordered[:, 0] < SURER * ordered[:, 1]
    return np.where(sure, best, -1)
