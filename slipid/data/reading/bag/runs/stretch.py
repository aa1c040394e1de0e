"""One run of a bag in time."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Stretch:
    """One run in time.

    Attributes:
        start: of its time [s].
        end: first time behind it [s].
        suffix: what follows the bag's name; empty where it is to be numbered.
        surface: name of the floor, or None.
        load: name of the load set-up, or None.
    """

    start: float
    end: float
    suffix: str = ""
    surface: str | None = None
    load: str | None = None
