"""Patches of cells as polygons: borders that two patches share are the same line in both."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Int

from slipid.camera.opencv import opencv

FITTED = 6
"""A line is fitted to a part of a border that is as long or longer [steps]."""


@dataclass(frozen=True, eq=False)
class Outlined:
    """A connected patch of cells.

    Attributes:
        label: of its cells.
        cells: which they are.
        rings: corners, the first around the patch, others around holes in it; columns and rows
            of corners of cells, which the last corner does not repeat.
    """

    label: int
    cells: Bool[np.ndarray, "row column"]
    rings: tuple[Float[np.ndarray, "_ 2"], ...]


def outlined(labels: Int[np.ndarray, "row column"], tolerance: float) -> tuple[Outlined, ...]:
    """All connected patches of labels from 0 on, the largest first.

    Args:
        tolerance: how far a line may be from the edges of cells it stands for [cells].
    """
    cv2 = opencv()
    fixed = _junctions(labels)
    found = []
    for label in np.unique(labels[labels >= 0]):
        mine = (labels == label).astype(np.uint8)
        count, parts = cv2.connectedComponents(mine, connectivity=8)
        for part in range(1, count):
            cells = parts == part
            simple = [_simplified(ring, fixed, tolerance) for ring in _rings(cells)]
            rings = tuple(ring for ring in simple if len(ring) >= 3)
            if rings:
                found.append(Outlined(int(label), cells, rings))
    return tuple(sorted(found, key=lambda one: -int(one.cells.sum())))


def area(ring: Float[np.ndarray, "corner 2"]) -> float:
    """Of a ring, positive where it runs anticlockwise."""
    x, y = ring.T
    return 0.5 * float(x @ np.roll(y, -1) - y @ np.roll(x, -1))


def _rings(cells: Bool[np.ndarray, "row column"]) -> list[Int[np.ndarray, "_ 2"]]:
    """Corners of cells along the edge of a connected patch, one step apart; the outer edge first.

    OpenCV's contours run through the middles of pixels. On a grid twice as fine, where a cell
    covers three by three points, they run along the edges of cells.
    """
    cv2 = opencv()
    rows, columns = np.nonzero(cells)
    low = np.array([columns.min(), rows.min()])
    cut = cells[low[1] : rows.max() + 1, low[0] : columns.max() + 1]
    fine = np.zeros((2 * cut.shape[0] + 1, 2 * cut.shape[1] + 1), np.uint8)
    fine[1::2, 1::2] = cut
    fine = cv2.dilate(fine, np.ones((3, 3), np.uint8))
    contours, tree = cv2.findContours(fine, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    outer = [k for k in range(len(contours)) if tree[0, k, 3] < 0]
    inner = [k for k in range(len(contours)) if tree[0, k, 3] >= 0]
    return [_corners(contours[k].reshape(-1, 2)) + low for k in (*outer, *inner)]


def _corners(fine: Int[np.ndarray, "point 2"]) -> Int[np.ndarray, "corner 2"]:
    """Corners of cells along a contour of the finer grid; it cuts those where the edge turns in."""
    after = np.roll(fine, -1, axis=0)
    aslant = (fine != after).all(axis=1)
    even = fine % 2 == 0
    turn = np.where(even, fine, after)
    path = np.stack([fine, np.where(aslant[:, None], turn, fine)], axis=1).reshape(-1, 2)
    whole = path[(path % 2 == 0).all(axis=1)] // 2
    return whole[(whole != np.roll(whole, 1, axis=0)).any(axis=1)]


def _junctions(labels: Int[np.ndarray, "row column"]) -> Bool[np.ndarray, "row1 column1"]:
    """Corners of cells at which borders meet, and those of the map: they stay where they are."""
    wide = np.pad(labels, 1, constant_values=-2)
    a, b, c, d = wide[:-1, :-1], wide[:-1, 1:], wide[1:, 1:], wide[1:, :-1]
    steps = sum((one != other).astype(int) for one, other in ((a, b), (b, c), (c, d), (d, a)))
    fixed = np.asarray(steps) > 2
    fixed[np.ix_([0, -1], [0, -1])] = True
    return fixed


def _simplified(
    ring: Int[np.ndarray, "step 2"], fixed: Bool[np.ndarray, "row column"], tolerance: float
) -> Float[np.ndarray, "corner 2"]:
    """A ring of few corners: each part between two junctions is simplified as its other side is."""
    ends = np.flatnonzero(fixed[ring[:, 1], ring[:, 0]])
    if not len(ends):  # both sides begin at the same corner
        ends = np.array([np.lexsort((ring[:, 1], ring[:, 0]))[0]])
    turned = np.roll(ring, -ends[0], axis=0)
    closed = np.concatenate([turned, turned[:1]]).astype(float)
    stops = [*(ends - ends[0]), len(ring)]
    parts = [_line(closed[a : b + 1], tolerance)[:-1] for a, b in pairwise(stops)]
    return np.concatenate(parts)


def _line(path: Float[np.ndarray, "step 2"], tolerance: float) -> Float[np.ndarray, "corner 2"]:
    """A border between two junctions, without stairs, in few corners, the same from either end."""
    cv2 = opencv()
    if (path[0] == path[-1]).all():  # a loop: its farthest corner parts it in two
        far = ((path - path[0]) ** 2).sum(axis=1)
        turn = int(np.lexsort((path[:, 1], path[:, 0], far))[-1])
        halves = _line(path[: turn + 1], tolerance), _line(path[turn:], tolerance)
        return np.concatenate([halves[0][:-1], halves[1]])
    back = tuple(path[::-1].ravel()) < tuple(path.ravel())
    way = path[::-1] if back else path
    # a step's ends lie half a step to either side of a slanted border, its middle on it
    middles = np.concatenate([way[:1], (way[1:] + way[:-1]) / 2, way[-1:]])
    twice = np.rint(2 * middles).astype(np.int32)
    few = cv2.approxPolyDP(twice.reshape(-1, 1, 2), 2 * tolerance, False).reshape(-1, 2)
    line = _fitted(middles, _indices(twice, few), tolerance)
    return line[::-1] if back else line


def _indices(way: Int[np.ndarray, "step 2"], few: Int[np.ndarray, "corner 2"]) -> list[int]:
    """Where some places of a way come in it, in its order."""
    index = [0]
    for corner in few[1:]:
        rest = way[index[-1] + 1 :]
        index.append(index[-1] + 1 + int(np.argmax((rest == corner).all(axis=1))))
    return index


def _fitted(
    middles: Float[np.ndarray, "step 2"], index: list[int], tolerance: float
) -> Float[np.ndarray, "corner 2"]:
    """Corners where lines meet that are fitted to what lies between them; the ends stay."""
    lines = [_through(middles[a : b + 1]) for a, b in pairwise(index)]
    out = middles[index].copy()
    for k in range(1, len(index) - 1):
        (p, along), (q, other) = lines[k - 1], lines[k]
        across = along[0] * other[1] - along[1] * other[0]
        if abs(across) > 0.1:  # else they are nearly one line
            off = q - p
            meet = p + along * (off[0] * other[1] - off[1] * other[0]) / across
        else:
            meet = (_foot(out[k], p, along) + _foot(out[k], q, other)) / 2
        # the middles cut a corner by up to half a step
        if np.linalg.norm(meet - out[k]) <= tolerance + 0.5:
            out[k] = meet
    return out


def _through(
    steps: Float[np.ndarray, "step 2"],
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """A point and a direction: of the line through many steps, or from end to end of few."""
    if len(steps) < FITTED:
        return steps[0], (steps[-1] - steps[0]) / np.linalg.norm(steps[-1] - steps[0])
    inner = steps[1:-1]  # a step at a corner may be of the next line
    middle = inner.mean(axis=0)
    return middle, np.linalg.svd(inner - middle, full_matrices=False)[2][0]


def _foot(
    place: Float[np.ndarray, "2"], on: Float[np.ndarray, "2"], along: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "2"]:
    """The place on a line that is nearest."""
    return on + along * float((place - on) @ along)
