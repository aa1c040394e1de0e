"""Whether what runs over several floors taught still predicts the runs that kept to one floor."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from slipid.data.runs import Runs
from slipid.identify.compare import open_loop as replay
from slipid.identify.compare.predictive import Predictive

WORSE = 1.5
"""Factor by which end-point errors on a floor may grow; a map that is wrong makes it several."""
BETTER = 0.8
"""Part of the error by a map below which a single floor explains runs better than the map does."""
SURE = 3.0
"""Standard errors of paired differences beyond which a growth is not chance."""


@dataclass(frozen=True)
class FloorErrors:
    """End-point errors of the runs on one floor, over the distance driven, before and after."""

    before: float
    after: float
    is_worse: bool


def floor_errors(before: Predictive, after: Predictive, data: Runs) -> dict[str, FloorErrors]:
    """Errors of runs on one floor each under two models, by floor.

    The second learnt from other runs than these; the first is what it started from.
    """
    (old, far), (new, _) = end_errors(before, data), end_errors(after, data)
    return compared([log.surface or "unknown" for log in data.logs], old, new, far)


def compared(
    floors: Sequence[str],
    old: Float[np.ndarray, " run"],
    new: Float[np.ndarray, " run"],
    far: Float[np.ndarray, " run"],
) -> dict[str, FloorErrors]:
    """Errors of runs by their floors, old and new, and how far they went [m]."""
    out = {}
    for name in dict.fromkeys(floors):
        mine = np.array([floor == name for floor in floors])
        grown = new[mine] - old[mine]
        error = float(grown.std(ddof=1)) / np.sqrt(mine.sum()) if mine.sum() > 1 else np.inf
        much = new[mine].mean() > WORSE * old[mine].mean()
        way = max(float(far[mine].sum()), 1e-9)  # runs may only have turned
        out[name] = FloorErrors(
            float(old[mine].sum() / way),
            float(new[mine].sum() / way),
            bool(much and grown.mean() > SURE * error),
        )
    return out


def end_errors(
    model: Predictive, data: Runs
) -> tuple[Float[np.ndarray, " run"], Float[np.ndarray, " run"]]:
    """Distance of predicted from measured end, and how far each run went as the crow flies [m]."""
    error, far = np.zeros(len(data)), np.zeros(len(data))
    for w in replay.cuts(data, model.robot):
        tracks, _ = model.ends(w)
        error[tracks.run] = np.linalg.norm(tracks.gap[:, :2], axis=1)
        far[tracks.run] = tracks.chord
    return error, far


def contradiction(
    found: Mapping[str, FloorErrors], by_map: float, as_if: Mapping[str, float]
) -> str | None:
    """Why runs over several floors are not learnt from, None where they agree with the others.

    Args:
        found: errors of the runs on one floor each.
        by_map: error of the runs over several floors [m/s], whose map says where wheels stand.
        as_if: the same had all wheels stood on one floor all the while, by floor [m/s].
    """
    worse = [
        f"{floor} from {100 * e.before:.1f} to {100 * e.after:.1f} % of the way"
        for floor, e in found.items()
        if e.is_worse
    ]
    if worse:
        return f"{_NOT_LEARNT} (end-point errors on {', '.join(worse)}); {_WHY}"
    best = min(as_if, key=lambda floor: as_if[floor])
    if as_if[best] < BETTER * by_map:
        told = (
            f"{1000 * by_map:.1f} mm/s by their map, {1000 * as_if[best]:.1f} as if all on {best}"
        )
        return f"{_NOT_LEARNT} (errors of {told}); {_WHY}"
    return None


_NOT_LEARNT = (
    "the runs over several floors were not learnt from: they contradict those on one floor"
)
_WHY = "their map may be wrong or out of place"
