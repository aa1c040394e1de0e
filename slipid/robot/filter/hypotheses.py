"""Hypotheses about the floors under all wheels of a robot.

The number of assignments of floors to wheels grows as floors^wheels: 625 for four wheels on five
floors. The edge of a floor is nearly straight on the scale of a robot, so the floor changes at most
twice from wheel to wheel around the robot: every hypothesis has one floor, or two floors with
neighbouring wheels on each. That leaves 125 of the 625, and 21 of the 27 for three wheels on
three floors. Three floors at once, where patches meet at a corner, are represented by the most
similar hypothesis or by "unknown". A hypothetical floor (`slipid.robot.deployed`) is under all
wheels or under none.
"""

import itertools
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Int

from slipid.robot.deployed import RobotArrays

MOST_CHANGES = 2
"""Largest number of floor changes from wheel to wheel around the robot."""


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """All hypotheses of the floors under a robot.

    Attributes:
        under: index of the floor under each wheel.
        beside: for each wheel, hypothesis and floor, index of the hypothesis that differs only by
            having this floor under this wheel; without such a hypothesis, the number of hypotheses.
        uniform: for each floor, index of the hypothesis with this floor under all wheels.
        on: True if the hypothesis has the floor under the wheel.
    """

    under: Int[np.ndarray, "hypothesis wheel"]
    beside: Int[np.ndarray, "wheel hypothesis floor"]
    uniform: Int[np.ndarray, " floor"]
    on: Bool[np.ndarray, "hypothesis wheel floor"]

    def __len__(self) -> int:
        return len(self.under)


def hypotheses_of(robot: RobotArrays) -> Hypotheses:
    """Return the hypotheses of a robot on its identified and hypothetical floors."""
    return _hypotheses(robot.around, robot.unseen, MOST_CHANGES)


@lru_cache(maxsize=32)
def _hypotheses(around: tuple[int, ...], unseen: tuple[bool, ...], changes: int) -> Hypotheses:
    wheels, floors = len(around), len(unseen)
    driven = [k for k in range(floors) if not unseen[k]]
    rows = list(itertools.product(driven, repeat=wheels))
    rows += [(k,) * wheels for k in range(floors) if unseen[k]]
    under = np.array([row for row in rows if _changes(row, around) <= changes])
    number = {tuple(row): k for k, row in enumerate(under.tolist())}

    def beside(row: list[int], wheel: int, floor: int) -> int:
        return number.get((*row[:wheel], floor, *row[wheel + 1 :]), len(under))

    return Hypotheses(
        under=under,
        beside=np.array(
            [
                [[beside(row, wheel, floor) for floor in range(floors)] for row in under.tolist()]
                for wheel in range(wheels)
            ]
        ),
        uniform=np.array([number[(floor,) * wheels] for floor in range(floors)]),
        on=under[:, :, None] == np.arange(floors),
    )


def _changes(row: tuple[int, ...], around: tuple[int, ...]) -> int:
    """Return the number of floor changes from wheel to wheel around the robot."""
    return sum(row[a] != row[b] for a, b in zip(around, around[1:] + around[:1], strict=True))
