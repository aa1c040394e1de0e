"""What a surface does to a roller."""

import re
from dataclasses import dataclass

from slipid.testsite.refuse import at_most, not_negative, positive

GRAVITY = 9.81


@dataclass(frozen=True)
class Ground:
    """Physics of one surface.

    Attributes:
        friction: Coulomb coefficient of a roller on it [1].
        rolling_m: lever arm of the rolling friction, about both axes of a roller [m].
        softness_m: how deep a wheel that carries a third of the robot sinks, about, whatever the
            robot weighs [m].
        shear_n_m: horizontal stiffness of the floor beneath one roller [N/m].
        compaction: resistance of a sunk wheel per sinkage to the power of 1.5 [N/m^1.5].
        body_drag_n: resistance of what touches the body, against its motion, not its turning [N].
        rib_height_m, rib_distance_m: size of ribs along y [m]; by default there are none.
        unevenness: std of the logarithm of rolling friction and shear stiffness over the floor [1].
        colour: in pictures.
    """

    friction: float = 0.8
    rolling_m: float = 0.0003
    softness_m: float = 0.0003
    shear_n_m: float = 1e5
    compaction: float = 0.0
    body_drag_n: float = 0.0
    rib_height_m: float = 0.0
    rib_distance_m: float = 0.03
    unevenness: float = 0.0
    colour: str = "#d9d4c7"

    def __post_init__(self) -> None:
        positive(self, "friction", "softness_m", "shear_n_m", "rib_distance_m")
        not_negative(self, "rolling_m", "compaction", "body_drag_n", "rib_height_m", "unevenness")
        at_most(self, friction=10.0, rolling_m=0.05, softness_m=0.03, compaction=1e7)
        at_most(self, body_drag_n=1000.0, rib_height_m=0.02, unevenness=1.0)
        if self.shear_n_m < 50:
            raise ValueError(f"shear_n_m = {self.shear_n_m}; expected 50 or above")
        if re.fullmatch("#[0-9a-fA-F]{6}", self.colour) is None:
            raise ValueError(f"colour = {self.colour!r}; expected '#rrggbb'")

    @property
    def settling_s(self) -> float:
        """Time constant of the engine's contact spring [s]: a wheel sinks in by about 1.9 g t^2."""
        return float((self.softness_m / (1.9 * GRAVITY)) ** 0.5)


GROUNDS: dict[str, Ground] = {
    "firm": Ground(rolling_m=0.0004, unevenness=0.05, colour="#e8e4da"),
    "short": Ground(
        friction=0.75,
        rolling_m=0.0008,
        softness_m=0.001,
        shear_n_m=1.2e4,
        compaction=2e4,
        unevenness=0.1,
        colour="#8a5a35",
    ),
    "medium": Ground(
        friction=0.8,
        rolling_m=0.0018,
        softness_m=0.004,
        shear_n_m=4.5e3,
        compaction=4e3,
        unevenness=0.15,
        colour="#8f9194",
    ),
    "soft": Ground(
        friction=0.8,
        rolling_m=0.0028,
        softness_m=0.007,
        shear_n_m=2.2e3,
        compaction=3e3,
        body_drag_n=0.5,
        unevenness=0.15,
        colour="#1f6b45",
    ),
    "ribbed": Ground(
        friction=0.6,
        rolling_m=0.0006,
        softness_m=0.001,
        shear_n_m=2e4,
        rib_height_m=0.0012,
        rib_distance_m=0.02,
        unevenness=0.05,
        colour="#3f4a5a",
    ),
}
"""Surfaces by name: bare, a short carpet, two deeper ones, and a ribbed mat."""
