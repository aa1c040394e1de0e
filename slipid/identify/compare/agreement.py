"""Whether what runs over several floors taught still predicts the runs that kept to one floor."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from slipid.data.runs import Runs
from slipid.identify.compare import open_loop as replay
from slipid.identify.compare.predictive import Predictive
from slipid.identify.compare.score import chords, mean_error
from slipid.identify.fit.variances import Search, Square
from slipid.search_space import Space

WORSE = 1.5
"""Factor by which end-point errors on a floor may grow; a map that is wrong makes it several."""
FAR = 4.0
"""Standard errors beyond which no number that runs on one floor tell may move."""
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

    Both learnt from these runs, the second from others, too.
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
        _, error, _ = mean_error(grown, np.arange(len(grown)))
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
        far[tracks.run] = chords(tracks.measured)
    return error, far


class Moved(NamedTuple):
    """The number that other runs moved most, and by how many of its standard errors before."""

    name: str
    sigma: float


def most_moved(
    space: Space, before: Search, covariance: Square, after: Search, settled: bool
) -> Moved:
    """Of the numbers that runs on one floor tell from motion; infinite where no rest was found.

    Runs that agree move a number by less than the standard error it had without them (Hausman
    1978, Econometrica 46(6)).
    """
    told = ~space.electric & ~space.where(lambda e: e.part == "camera")
    sigma = np.where(told, np.abs(after - before) / np.sqrt(np.diag(covariance)), 0.0)
    worst = int(np.argmax(sigma))
    return Moved(space.names[worst], float(sigma[worst]) if settled else np.inf)


def contradiction(
    found: Mapping[str, FloorErrors], moved: Moved, by_map: float, as_if: Mapping[str, float]
) -> str | None:
    """Why runs over several floors are not learnt from, None where they agree with the others.

    Args:
        found: errors of the runs on one floor each.
        moved: what they moved most.
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
    if not np.isfinite(moved.sigma):
        return f"{_NOT_LEARNT} (the fit to all found no rest); {_WHY}"
    if moved.sigma > FAR:
        return f"{_NOT_LEARNT} ({moved.name} moves by {moved.sigma:.0f} standard errors); {_WHY}"
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
_WHY = "their map may be wrong or out of place, or the contact law where floors meet"
