"""Conversion of patches of cells to polygons; neighbouring patches share the line between them."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Int

from slipid.camera.opencv import Labels, Mask, cv2

FITTED_STEPS = 6
"""Smallest number of steps (cell edges) of a border section to which a line is fitted; in a shorter
section the line joins the first and last step."""


@dataclass(frozen=True, eq=False)
class PatchOutline:
    """A connected patch of cells and its polygon.

    Attributes:
        label: label of the patch's cells.
        cells: mask of the patch's cells.
        rings: polygons with corners in columns and rows, where integers are corners of cells. The
            first ring runs around the patch, the other rings around holes in it. A ring's last
            corner does not repeat its first.
    """

    label: int
    cells: Mask
    rings: tuple[Float[np.ndarray, "_ 2"], ...]


def outlines_of(labels: Labels, tolerance: float) -> tuple[PatchOutline, ...]:
    """Return all connected patches of cells with labels of 0 or more, the largest first.

    Args:
        labels: label of each cell.
        tolerance: largest distance of a polygon's edge from the cell edges that it replaces
            [cells].
    """
    fixed = _junctions(labels)
    outlines = []
    for label in np.unique(labels[labels >= 0]):
        mine = (labels == label).astype(np.uint8)
        count, parts = cv2.connectedComponents(mine, connectivity=8)
        for part in range(1, count):
            cells = parts == part
            simple = [_simplified(ring, fixed, tolerance) for ring in _rings(cells)]
            if rings := tuple(ring for ring in simple if len(ring) >= 3):
                outlines.append(PatchOutline(int(label), cells, rings))
    return tuple(sorted(outlines, key=lambda one: -int(one.cells.sum())))


def signed_area(ring: Float[np.ndarray, "corner 2"]) -> float:
    """Return the area of a ring, positive if the ring runs anticlockwise."""
    x, y = ring.T
    return 0.5 * float(x @ np.roll(y, -1) - y @ np.roll(x, -1))


def _rings(cells: Mask) -> list[Int[np.ndarray, "_ 2"]]:
    """Return the cell corners along each border of a connected patch, the outer border first.

    Corners are one step apart. OpenCV's contours run through the middles of pixels. To get contours
    along the edges of cells, compute them on a grid twice as fine, on which a cell covers three
    by three points.
    """
    rows, columns = np.nonzero(cells)
    low = np.array([columns.min(), rows.min()])
    cut = cells[low[1] : rows.max() + 1, low[0] : columns.max() + 1]
    fine = np.zeros((2 * cut.shape[0] + 1, 2 * cut.shape[1] + 1), np.uint8)
    fine[1::2, 1::2] = cut
    fine = cv2.dilate(fine, np.ones((3, 3), np.uint8))
    contours, tree = cv2.findContours(fine, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    outer_first = np.argsort(tree[0, :, 3] >= 0, kind="stable")
    return [_corners(contours[k].reshape(-1, 2)) + low for k in outer_first]


def _corners(fine: Int[np.ndarray, "point 2"]) -> Int[np.ndarray, "corner 2"]:
    """Return the cell corners along a contour of the finer grid.

    OpenCV's contour cuts off the corner where a border turns inwards; these corners are restored.
    """
    after = np.roll(fine, -1, axis=0)
    diagonal = (fine != after).all(axis=1)
    turn = np.where(fine % 2 == 0, fine, after)
    path = np.stack([fine, np.where(diagonal[:, None], turn, fine)], axis=1).reshape(-1, 2)
    whole = path[(path % 2 == 0).all(axis=1)] // 2
    return whole[(whole != np.roll(whole, 1, axis=0)).any(axis=1)]


def _junctions(labels: Labels) -> Bool[np.ndarray, "row1 column1"]:
    """Return a mask of the cell corners that stay fixed: junctions of borders and map corners."""
    wide = np.pad(labels, 1, constant_values=-2)
    a, b, c, d = wide[:-1, :-1], wide[:-1, 1:], wide[1:, 1:], wide[1:, :-1]
    changes = sum((one != other).astype(int) for one, other in ((a, b), (b, c), (c, d), (d, a)))
    fixed = np.asarray(changes) > 2
    fixed[np.ix_([0, -1], [0, -1])] = True
    return fixed


def _simplified(
    ring: Int[np.ndarray, "step 2"], fixed: Mask, tolerance: float
) -> Float[np.ndarray, "corner 2"]:
    """Return a ring simplified to few corners.

    Each section between two junctions is simplified separately, so that the patches on both sides
    of it get the same line.
    """
    ends = np.flatnonzero(fixed[ring[:, 1], ring[:, 0]])
    if not len(ends):
        # without a junction, begin at the lowest corner, which is the same for both patches
        ends = np.array([np.lexsort((ring[:, 1], ring[:, 0]))[0]])
    turned = np.roll(ring, -ends[0], axis=0)
    closed = np.concatenate([turned, turned[:1]]).astype(float)
    stops = [*(ends - ends[0]), len(ring)]
    parts = [_line(closed[a : b + 1], tolerance)[:-1] for a, b in pairwise(stops)]
    return np.concatenate(parts)


def _line(path: Float[np.ndarray, "step 2"], tolerance: float) -> Float[np.ndarray, "corner 2"]:
    """Return a border between two junctions, simplified to few corners.

    The result does not depend on the direction of the border.
    """
    if (path[0] == path[-1]).all():
        # a closed loop has no chord to simplify against: split it at the corner farthest from its
        # start
        distance = ((path - path[0]) ** 2).sum(axis=1)
        turn = int(np.lexsort((path[:, 1], path[:, 0], distance))[-1])
        halves = _line(path[: turn + 1], tolerance), _line(path[turn:], tolerance)
        return np.concatenate([halves[0][:-1], halves[1]])
    reverse = tuple(path[::-1].ravel()) < tuple(path.ravel())
    path = path[::-1] if reverse else path
    # use the middles of steps: a slanted border runs through them, but up to half a step beside
    # the steps' ends
    middles = np.concatenate([path[:1], (path[1:] + path[:-1]) / 2, path[-1:]])
    twice = np.rint(2 * middles).astype(np.int32)
    few = cv2.approxPolyDP(twice.reshape(-1, 1, 2), 2 * tolerance, False).reshape(-1, 2)
    line = _fitted(middles, _indices(twice, few), tolerance)
    return line[::-1] if reverse else line


def _indices(path: Int[np.ndarray, "step 2"], few: Int[np.ndarray, "corner 2"]) -> list[int]:
    """Return the index in `path` of each of its points in `few`, which has the path's order."""
    index = [0]
    for corner in few[1:]:
        rest = path[index[-1] + 1 :]
        index.append(index[-1] + 1 + int(np.argmax((rest == corner).all(axis=1))))
    return index


def _fitted(
    middles: Float[np.ndarray, "step 2"], index: list[int], tolerance: float
) -> Float[np.ndarray, "corner 2"]:
    """Return the corners of a path, moved to the intersections of lines fitted to the path.

    Each inner corner moves to the intersection of the lines that are fitted to the path on either
    side of it, unless this is farther away than `tolerance` allows. The ends stay fixed.
    """
    lines = [_through(middles[a : b + 1]) for a, b in pairwise(index)]
    out = middles[index].copy()
    for k in range(1, len(index) - 1):
        (p, along), (q, other) = lines[k - 1], lines[k]
        both = np.stack([along, -other], axis=1)
        # intersect the two lines unless they are nearly parallel
        if abs(np.linalg.det(both)) > 0.1:
            meet = p + along * np.linalg.solve(both, q - p)[0]
        else:
            feet = [on + d * float((out[k] - on) @ d) for on, d in lines[k - 1 : k + 1]]
            meet = (feet[0] + feet[1]) / 2
        # limit the move to the tolerance plus half a step, since the middles of steps cut corners
        if np.linalg.norm(meet - out[k]) <= tolerance + 0.5:
            out[k] = meet
    return out


def _through(
    steps: Float[np.ndarray, "step 2"],
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Return a point and the direction of the line fitted to steps.

    With fewer than `FITTED_STEPS` steps the line runs from the first to the last step.
    """
    if len(steps) < FITTED_STEPS:
        return steps[0], (steps[-1] - steps[0]) / np.linalg.norm(steps[-1] - steps[0])
    # leave out the first and last step, which may belong to the neighbouring lines
    inner = steps[1:-1]
    middle = inner.mean(axis=0)
    return middle, np.linalg.svd(inner - middle, full_matrices=False)[2][0]
