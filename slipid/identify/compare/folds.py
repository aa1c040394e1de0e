"""Who is left out together when models are judged on runs that they have not seen.

Runs of one heading stay in one fold at every speed and on every floor, so that nothing of a
left-out heading is seen. Folds differ only in the weight of each piece: one compiled function
serves all.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Int

from slipid.data.runs import Runs
from slipid.support.errors import DataError

Fold = Int[np.ndarray, " run"]


def sectors(data: Runs, width_deg: float = 60.0) -> Fold:
    """Fold of every run by the sector its commanded heading lies in, -1 where it has none."""
    known = np.isfinite(data.heading)
    turn = np.degrees(np.where(known, data.heading, 0.0)) % 360.0
    sector = (np.floor((turn + 1e-6) / width_deg) % round(360 / width_deg)).astype(int)
    return np.where(known, sector, -1)


def random_headings(data: Runs, folds: int = 6, step_deg: float = 5.0, seed: int = 0) -> Fold:
    """Fold of every run by its heading, headings dealt at random, -1 where it has none."""
    count = round(360 / step_deg)
    dealt = np.random.default_rng(seed).permutation(count) % folds
    known = np.isfinite(data.heading)
    way = np.degrees(np.where(known, data.heading, 0.0))
    return np.where(known, dealt[np.round(way / step_deg).astype(int) % count], -1)


def speeds(data: Runs) -> Fold:
    """Fold of every run by its commanded speed, -1 where its floor and load saw one speed only.

    Turns on the spot have no speed to leave out.
    """
    speed = np.round(data.speed, 3)
    speed[speed == 0] = np.nan
    group = np.array([f"{log.surface}@{log.load}" for log in data.logs])
    out = np.full(len(data), -1)
    every = np.unique(speed[np.isfinite(speed)])
    for name in np.unique(group):
        mine = (group == name) & np.isfinite(speed)
        if len(np.unique(speed[mine])) > 1:
            out[mine] = np.searchsorted(every, speed[mine])
    return out


QUESTIONS: dict[str, Callable[[Runs], Fold]] = {
    "sectors": sectors,
    "speeds": speeds,
    "random": random_headings,
}
"""What is left out together: 60-degree sectors of headings, one speed, headings dealt at random."""


def folds_of(data: Runs, question: str) -> Fold:
    """Fold of every run; -1 for one that cannot be judged and is always fitted.

    A run cannot be judged where leaving out its fold leaves nothing of its floor and load set-up.

    Raises:
        DataError: no such question.
    """
    if question not in QUESTIONS:
        raise DataError(
            f"--folds: '{question}': no such question; expected some of {', '.join(QUESTIONS)}"
        )
    fold = QUESTIONS[question](data)
    group = np.array([f"{log.surface}@{log.load}" for log in data.logs])
    for name in np.unique(group):
        mine = group == name
        if len(np.unique(fold[mine])) < 2:
            fold[mine] = -1
    return fold
