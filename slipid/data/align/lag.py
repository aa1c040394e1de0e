"""Lag of the poses of a set of runs behind their encoders, estimated from the motion itself."""

from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np

from slipid.data.align.regression import MotionPair, clear_best, unexplained
from slipid.data.runs import Runs

LONGEST_LAG_S, LEAST_OVERLAP = 8.0, 0.3
"""Largest searched lag of either sign [s], and fraction of the median run's duration in which poses
and encoders must still overlap [1]."""
COARSE_GRID_S, FINE_GRID_S = 0.1, 0.01
"""Grid spacings of the first and of the second search [s]."""
STEP_S = 0.2
"""Shortest duration of the compared pose increments [s]."""
MOST_RUNS = 40
"""Largest number of compared runs, which are picked evenly from all runs."""
DECISIVE_RATIO, DECISIVE_DROP = 0.75, 0.02
"""A lag is decisive if the fraction of the motion that it leaves unexplained is below
`DECISIVE_RATIO` times the fraction at zero lag, and smaller than the latter by more than
`DECISIVE_DROP` [1]."""


@dataclass(frozen=True)
class PoseLag:
    """Lag of the poses behind the encoders.

    Attributes:
        seconds: the lag [s], positive if poses are late.
        unexplained: fraction of the motion that stays unexplained at this lag [1].
        unexplained_at_zero: fraction of the motion that stays unexplained at zero lag [1].
    """

    seconds: float
    unexplained: float
    unexplained_at_zero: float

    @property
    def decisive(self) -> bool:
        """True if poses and wheels agree clearly better at this lag than at zero lag."""
        drop = self.unexplained_at_zero - self.unexplained
        return self.unexplained < DECISIVE_RATIO * self.unexplained_at_zero and drop > DECISIVE_DROP


_CACHE: WeakKeyDictionary[Runs, PoseLag | None] = WeakKeyDictionary()


def pose_lag(data: Runs) -> PoseLag | None:
    """Return the lag of the poses of some runs, or None if no lag is clearly the best.

    The result is kept for each set of runs, because both the check and the start of a fit use it.
    """
    if data not in _CACHE:
        _CACHE[data] = _searched(data)
    return _CACHE[data]


def _searched(data: Runs) -> PoseLag | None:
    """Return the lag from a coarse search, refined by a fine search around the best coarse lag.

    The result is None if no coarse lag is clearly the best, or if the best one is at an end of the
    searched range.
    """
    some = np.unique(np.linspace(0, len(data) - 1, MOST_RUNS).round().astype(int)).tolist()
    pairs = [pair for k in some if len((pair := _pair(data, k)).pose_time) > 2]
    if not pairs:
        return None
    # Runs whose poses have the most coordinates are compared, since one matrix is fitted to all.
    known = [np.isfinite(pair.pose[0]).sum() for pair in pairs]
    pairs = [pair for pair, count in zip(pairs, known, strict=True) if count == max(known)]
    usual = float(np.median([pair.time[-1] - pair.time[0] for pair in pairs]))
    most = round(min(LONGEST_LAG_S, (1.0 - LEAST_OVERLAP) * usual) / COARSE_GRID_S)
    coarse = COARSE_GRID_S * np.arange(-most, most + 1)
    rest = unexplained(pairs, -coarse, STEP_S)
    best = clear_best(coarse, rest)
    if best is None or best in (0, len(coarse) - 1):
        return None
    fine = coarse[best] + np.arange(-COARSE_GRID_S, COARSE_GRID_S + FINE_GRID_S / 2, FINE_GRID_S)
    near = unexplained(pairs, -np.append(fine, 0.0), STEP_S)
    k = int(np.argmin(near[:-1]))
    return PoseLag(float(fine[k]), float(near[k]), float(near[-1]))


def _pair(data: Runs, run: int) -> MotionPair:
    """Return the motion pair of one run; its motion is extrapolated beyond the ends of the run."""
    rows = data.rows(run)
    time, fresh, pose = data.time[rows], data.fresh[rows], data.pose[rows]
    seen = fresh & (np.isfinite(pose) == np.isfinite(pose[fresh][0])).all(axis=1)
    return MotionPair(
        time,
        data.wheel_angle[rows],
        time[seen],
        pose[seen],
        source="wheels",
        step=STEP_S,
        collinear=1e-9,
        components=(2,) if np.isnan(pose[seen][0, 0]) else (0, 1, 2),
        goes_on=True,
    )
