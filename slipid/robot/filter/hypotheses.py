"""Which floors may lie under the wheels of a robot at once, all wheels together.

Floors to the power of wheels grows fast: 625 ways for four wheels on five floors. The edge of a
floor is nearly straight on the scale of a robot, so going around the robot from wheel to wheel the
floor changes at most twice: every way has one floor, or two with neighbouring wheels on each side.
That leaves 125 of the 625 and 21 of three wheels' 27. Three floors at once, where patches meet at a
corner, are taken for the nearest of these or for "unknown". A floor that nobody drove on is under
all wheels or under none.
"""

import itertools
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Int

from slipid.robot.deployed import RobotArrays

CHANGES = 2
"""Changes of floor around the robot, from wheel to wheel, that count as possible."""


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """Ways in which the wheels may stand.

    Attributes:
        under: number of the floor under each wheel.
        beside: for each wheel and floor, the hypothesis that has this floor under this wheel and
            the others as they are; as many as there are hypotheses where there is none.
        uniform: for each floor, the hypothesis that has it under all wheels.
        on: whether the floor is under the wheel.
    """

    under: Int[np.ndarray, "hypothesis wheel"]
    beside: Int[np.ndarray, "wheel hypothesis floor"]
    uniform: Int[np.ndarray, " floor"]
    on: Bool[np.ndarray, "hypothesis wheel floor"]

    def __len__(self) -> int:
        return len(self.under)


def hypotheses_of(robot: RobotArrays) -> Hypotheses:
    """Ways in which the wheels of a robot may stand on the floors it knows."""
    return _hypotheses(robot.around, robot.unseen, CHANGES)


@lru_cache(maxsize=32)
def _hypotheses(around: tuple[int, ...], unseen: tuple[bool, ...], changes: int) -> Hypotheses:
    wheels, floors = len(around), len(unseen)
    driven = [k for k in range(floors) if not unseen[k]]
    ways = list(itertools.product(driven, repeat=wheels))
    ways += [(k,) * wheels for k in range(floors) if unseen[k]]
    under = np.array([way for way in ways if _changes(way, around) <= changes])
    number = {tuple(way): k for k, way in enumerate(under.tolist())}

    def beside(way: list[int], wheel: int, floor: int) -> int:
        return number.get((*way[:wheel], floor, *way[wheel + 1 :]), len(under))

    return Hypotheses(
        under=under,
        beside=np.array(
            [
                [[beside(way, wheel, floor) for floor in range(floors)] for way in under.tolist()]
                for wheel in range(wheels)
            ]
        ),
        uniform=np.array([number[(floor,) * wheels] for floor in range(floors)]),
        on=under[:, :, None] == np.arange(floors),
    )


def _changes(way: tuple[int, ...], around: tuple[int, ...]) -> int:
    """How often the floor changes on the way around the robot."""
    return sum(way[a] != way[b] for a, b in zip(around, around[1:] + around[:1], strict=True))
