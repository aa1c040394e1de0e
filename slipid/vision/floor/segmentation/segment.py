"""From what each surface costs in each cell to one per cell, in patches with clean edges."""

import numpy as np
from jaxtyping import Bool, Float32, Int

from slipid.vision.opencv import opencv

UNKNOWN = -1
"""Surface of cells of which none is known."""
PULL = 3.0
"""What a cell pays whose neighbours are all of another surface [squared spreads]."""
REACH = 1.5
"""How far neighbours reach [cells]."""
ROUNDS = 5
SMALL = 150
"""A patch of fewer cells is part of what lies around it."""


def settled(
    costs: Float32[np.ndarray, "surface row column"], known: Bool[np.ndarray, "row column"]
) -> Int[np.ndarray, "row column"]:
    """Surface of each cell that costs little and agrees with its neighbours.

    Mean field of a Potts model: each cell holds a share of every surface, and is pulled by the
    shares around it. Cells that are not known take no part and are `UNKNOWN`.
    """
    cv2 = opencv()
    weight = known.astype(np.float32)
    around = np.maximum(cv2.GaussianBlur(weight, (0, 0), REACH), 1e-3)
    pulled = costs
    for _ in range(ROUNDS):
        share = np.exp(-0.5 * (pulled - pulled.min(axis=0)))
        share *= weight / share.sum(axis=0)
        near = np.stack([cv2.GaussianBlur(one, (0, 0), REACH) for one in share])
        pulled = costs - 2 * PULL * near / around
    labels = np.argmin(pulled, axis=0)
    return np.where(known, labels, UNKNOWN)


def tidy(
    labels: Int[np.ndarray, "row column"], known: Bool[np.ndarray, "row column"], width: int
) -> Int[np.ndarray, "row column"]:
    """Labels without patches that are small or narrow: those become part of what lies nearest.

    Along an edge of two surfaces their mixed colour may look like a third: a narrow line of it.

    Args:
        known: cells that may have a surface.
        width: of the narrowest patch that is kept [cells].
    """
    cv2 = opencv()
    size = 2 * (width // 2) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    kept = np.zeros(labels.shape, bool)
    for surface in np.unique(labels):
        mine = (labels == surface).astype(np.uint8)
        # what is not known may go on as any surface: the edge of the picture narrows nothing
        opened = cv2.morphologyEx(mine | (~known).astype(np.uint8), cv2.MORPH_OPEN, disc)
        kept |= (opened > 0) & (mine > 0)
    labels = np.where(known, nearest(labels, kept & known), UNKNOWN)
    large = np.zeros(labels.shape, bool)
    for surface in np.unique(labels[known]):
        large |= _large(labels == surface)
    return np.where(known, nearest(labels, large & known), UNKNOWN)


def _large(mine: Bool[np.ndarray, "row column"]) -> Bool[np.ndarray, "row column"]:
    """Cells of patches that are not small."""
    cv2 = opencv()
    _, parts, stats, _ = cv2.connectedComponentsWithStats(mine.astype(np.uint8), connectivity=4)
    big = stats[:, cv2.CC_STAT_AREA] >= SMALL
    big[0] = False
    return np.asarray(big[parts])


def nearest(
    labels: Int[np.ndarray, "row column"], kept: Bool[np.ndarray, "row column"]
) -> Int[np.ndarray, "row column"]:
    """Every cell with the label of the nearest one that is kept; the same where none is."""
    from scipy.ndimage import distance_transform_edt

    if kept.all() or not kept.any():
        return labels
    rows, columns = distance_transform_edt(~kept, return_distances=False, return_indices=True)
    return np.asarray(labels[rows, columns])
