"""Where the surfaces lie that are told by colour alone: patches matched under the light so far.

Colours on their own are a poor start, for light changes them by more than they differ. Patches that
match a colour well say how the floor is lit, and then more of them match.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from slipid.vision.floor.segmentation.colour import Features, lab_of
from slipid.vision.floor.segmentation.proposal import LIGHTNESS, Patches, patches_of
from slipid.vision.floor.segmentation.shading import Light, Lit, lit

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
