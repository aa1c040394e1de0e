"""Colours as people see differences of them, as light adds up, and how rough a surface looks.

From what each surface costs in each cell to one per cell, in patches with clean edges.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from slipid.camera.opencv import opencv


@dataclass(frozen=True, eq=False)
class Features:
    """What surfaces are told apart by, in every cell.

    Attributes:
        look: lightness L, a, b of CIELAB, and texture, each with a spread of its own.
        light: red, green, blue as light adds up, 0 to 1.
    """

    look: Float[np.ndarray, "row column 4"]
    light: Float[np.ndarray, "row column 3"]


def features(colour: UInt8[np.ndarray, "row column 3"], smooth: float = 1.0) -> Features:
    """What a picture in blue, green, red shows.

    Args:
        smooth: of the noise [cells].
    """
    cv2 = opencv()
    fine = colour.astype(np.float32) / 255
    soft = cv2.GaussianBlur(fine, (0, 0), smooth)
    lab = cv2.cvtColor(soft, cv2.COLOR_BGR2LAB)
    rough = texture(cv2.cvtColor(fine, cv2.COLOR_BGR2LAB)[..., 0])
    look = np.concatenate([lab, rough[..., None]], axis=-1)
    return Features(look, as_light(soft[..., ::-1]))


def texture(lightness: Float[np.ndarray, "row column"]) -> Float[np.ndarray, "row column"]:
    """How much the lightness changes within a few cells, as the logarithm of 1 and that.

    The median over a window leaves out edges between surfaces, which are lines in it.
    """
    cv2 = opencv()
    change = np.abs(lightness - cv2.GaussianBlur(lightness, (0, 0), 2.5))
    coarse = np.clip(change * 16, 0, 255).astype(np.uint8)
    usual = cv2.medianBlur(coarse, 13).astype(np.float32) / 16
    return np.log1p(cv2.GaussianBlur(usual, (0, 0), 3.0))


def as_light(rgb: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    """Amounts of light that add up, of sRGB values from 0 to 1."""
    low = rgb / np.asarray(12.92, rgb.dtype)
    high = ((np.maximum(rgb, 0) + 0.055) / 1.055) ** 2.4
    return np.where(rgb <= 0.04045, low, high).astype(rgb.dtype)


def as_shown(light: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    """SRGB values from 0 to 1 of amounts of light."""
    inside = np.clip(light, 0, 1)
    low, high = 12.92 * inside, 1.055 * inside ** (1 / 2.4) - 0.055
    return np.where(inside <= 0.0031308, low, high)


def lab_of(light: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    """CIELAB of amounts of red, green, blue light."""
    cv2 = opencv()
    shown = as_shown(light)[..., ::-1].astype(np.float32).reshape(-1, 1, 3)
    if not len(shown):
        return np.zeros(light.shape)
    found = cv2.cvtColor(np.ascontiguousarray(shown), cv2.COLOR_BGR2LAB)
    return np.asarray(found, float).reshape(light.shape)


def light_of_code(code: str) -> Float[np.ndarray, "3"]:
    """Amounts of light of a colour `#rrggbb`."""
    return as_light(np.array([int(code[k : k + 2], 16) for k in (1, 3, 5)]) / 255)


def code_of_light(light: Float[np.ndarray, "3"]) -> str:
    """`#rrggbb` of amounts of light."""
    return "#" + "".join(f"{round(255 * float(v)):02x}" for v in as_shown(light))


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
