"""How far the poses of some runs lag behind the turns of their wheels, from the motion itself."""

from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np

from slipid.data.align.regression import MotionPair, clear_best, unexplained
from slipid.data.runs import Runs

LONGEST, SHARED = 8.0, 0.3
"""Lag of either sign that is looked for [s], and the part of a usual run that is shared there."""
COARSE, FINE = 0.1, 0.01
"""Steps of the search [s]."""
STEP = 0.2
"""Least length of the steps that are compared [s]."""
MOST_RUNS = 40
"""Runs that are looked at, evenly picked from all."""
GAIN, DROP = 0.75, 0.02
"""A lag is decisive where it leaves less than this part of what no lag leaves, and so much less of
the motion."""


@dataclass(frozen=True)
class PoseLag:
    """Lag of the poses behind the encoders.

    Attributes:
        seconds: positive where poses are late [s].
        left: part of the motion that is left unexplained there [1].
        left_at_zero: the same without a lag [1].
    """

    seconds: float
    left: float
    left_at_zero: float

    @property
    def decisive(self) -> bool:
        """Whether poses and wheels do not go together without it."""
        less = self.left_at_zero - self.left
        return self.left < GAIN * self.left_at_zero and less > DROP


_FOUND: WeakKeyDictionary[Runs, PoseLag | None] = WeakKeyDictionary()


def pose_lag(data: Runs) -> PoseLag | None:
    """Lag of the poses of some runs; None where none is clearly the best.

    It is searched once for each set of runs: a fit starts from it, and `check` reports it.
    """
    if data not in _FOUND:
        _FOUND[data] = _searched(data)
    return _FOUND[data]


def _searched(data: Runs) -> PoseLag | None:
    """Search on a coarse grid, then on a fine one around its best lag."""
    some = np.unique(np.linspace(0, len(data) - 1, MOST_RUNS).round().astype(int)).tolist()
    pairs = [pair for k in some if len((pair := _pair(data, k)).pose_time) > 1]
    if not pairs:
        return None
    usual = float(np.median([pair.time[-1] - pair.time[0] for pair in pairs]))
    most = round(min(LONGEST, (1.0 - SHARED) * usual) / COARSE)
    coarse = COARSE * np.arange(-most, most + 1)
    left = unexplained(pairs, -coarse, STEP)
    best = clear_best(coarse, left)
    if best is None or best in (0, len(coarse) - 1):
        return None
    fine = coarse[best] + np.arange(-COARSE, COARSE + FINE / 2, FINE)
    near = unexplained(pairs, -np.append(fine, 0.0), STEP)
    k = int(np.argmin(near[:-1]))
    return PoseLag(float(fine[k]), float(near[k]), float(near[-1]))


def _pair(data: Runs, run: int) -> MotionPair:
    """Wheels and poses of one run; a log may begin and end while the robot moves."""
    rows = data.rows(run)
    time, fresh = data.time[rows], data.fresh[rows]
    return MotionPair(
        time,
        data.wheel_angle[rows],
        time[fresh],
        data.pose[rows][fresh],
        source="wheels",
        step=STEP,
        collinear=1e-9,
        goes_on=True,
    )
