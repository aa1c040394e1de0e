"""The interface of every slip model below the force balance."""

import abc
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np

from slipid.data.windows import Windows
from slipid.identify.compare.body_motion import Increments, as_increments
from slipid.model.robot import Robot

Number = TypeVar("Number")


@dataclass(frozen=True)
class Rung(abc.ABC):
    """A model that turns wheel motion into marker increments, in corrected metres.

    The state is the fitted numbers of each floor, with the name enough to build the rung again.
    """

    name: str
    state: dict[str, np.ndarray] = field(default_factory=dict, kw_only=True)

    @abc.abstractmethod
    def fit(self, w: Windows, robot: Robot) -> "Rung":
        """The rung fitted to these windows, floor by floor."""

    @abc.abstractmethod
    def twist(self, w: Windows, robot: Robot) -> np.ndarray:
        """Body twist of every window (piece, window, 3) [m/s, m/s, rad/s]."""

    def increments(self, w: Windows, robot: Robot) -> Increments:
        return as_increments(self.twist(w, robot), w, robot)

    def series(self, surface: str, load: str) -> str:
        """Key in `state` of the numbers that speak of a floor and load set-up.

        Raises:
            ValueError: no such floor was fitted.
        """
        of_floor(self.state, surface)
        return surface

    def stiffness(self, w: Windows, robot: Robot) -> dict[str, np.ndarray]:
        """What holds the fitted numbers besides the data: precision of each key's flat numbers."""
        return {}


def of_floor(floors: Mapping[str, Number], name: str) -> Number:
    """What is kept for a floor.

    Raises:
        ValueError: no such floor was fitted.
    """
    if name not in floors:
        raise ValueError(f"no surface '{name}'; identified: {', '.join(floors)}")
    return floors[name]
