"""Views and corners that do not fit the others are left out, and named."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from slipid.support.errors import DataError
from slipid.vision.calibration.board import View
from slipid.vision.calibration.lens.fit import LensFit, fit_lens
from slipid.vision.calibration.lens.views import enough

ROUNDS = 30
WORSE = 3.0
"""Times the usual residual, from which on a view is out."""
FAR = 6.0
"""Times the usual residual, from which on a corner is out: with noise alone, one in 10^7."""
LEAST_PX = 0.3
"""Nothing is out by less: such residuals harm nobody."""
MOST = 0.25
"""Of the views may be left out; more, and it is not known which are right."""


@dataclass(frozen=True, eq=False)
class Kept:
    """The fit to what was kept, and sentences about what was not."""

    fit: LensFit
    dropped: list[str]


def fit_kept(views: Sequence[View], image_px: tuple[int, int], k3: bool) -> Kept:
    """Fit a lens, leave out what does not fit, and fit again until nothing is left out.

    Raises:
        DataError: more would go than may.
    """
    now, dropped, first = list(views), [], len(views)
    for _ in range(ROUNDS):
        fit = fit_lens(now, image_px, k3)
        usual = [float(np.median(np.hypot(*r.T))) for r in fit.residuals]
        level = max(float(np.median(usual)), LEAST_PX / WORSE)
        worst = int(np.argmax(usual))
        if usual[worst] > WORSE * level:
            dropped.append(
                f"view {now[worst].name} left out: its corners are off by {usual[worst]:.2f} "
                f"pixels, those of the other views by {level:.2f}"
            )
            del now[worst]
            if first - len(now) > MOST * first:
                raise DataError(
                    f"{first - len(now)} of {first} views do not fit the others ({now[0].name} "
                    "does); expected a flat board of known size, sharp pictures, and one camera "
                    "whose focus and zoom stayed"
                )
            enough(now)
            continue
        bad = [_worst(np.hypot(*r.T), max(FAR * level, LEAST_PX)) for r in fit.residuals]
        if not any(b.any() for b in bad):
            break
        dropped += [
            f"view {v.name}: one of {len(b)} corners left out, off by "
            f"{np.hypot(*r.T).max():.2f} pixels"
            for v, b, r in zip(now, bad, fit.residuals, strict=True)
            if b.any()
        ]
        now = [v.only(~b) for v, b in zip(now, bad, strict=True)]
        now = [v for v in now if not v.flat]
        enough(now)
    return Kept(fit, dropped)


def _worst(off: Float[np.ndarray, " corner"], limit: float) -> Bool[np.ndarray, " corner"]:
    """The corner that is off most, if by more than a limit: it may have drawn others with it."""
    return (off > limit) & (off == off.max())
