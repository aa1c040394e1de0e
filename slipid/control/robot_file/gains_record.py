"""Gains as robot.json has them."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class GainRecord:
    """One gain [unit], and its std over the end of the search."""

    value: float
    unit: str
    spread: float


@dataclass(frozen=True)
class GainValues:
    """Every gain, as `slipid.control.controller.Gains` has them."""

    place: GainRecord
    yaw: GainRecord
    integral: GainRecord
    ahead: GainRecord
    observer: GainRecord
    preview: GainRecord


@dataclass(frozen=True)
class Losses:
    """Loss of gains on cases not tuned on, mean and worst tenth together, by hand and tuned."""

    hand: float
    tuned: float


@dataclass(frozen=True)
class GainsRecord:
    """Gains that `slipid tune` found.

    Attributes:
        load: set-up they were tuned for; gyro: whether with one.
        method: of the search.
        better_than_hand: part of the cases in which they are.
        stability_margin: 1 - the largest spectral radius of a loop.
        verdict: what the losses say.
    """

    values: GainValues
    load: str
    gyro: bool
    method: str
    loss: Losses
    better_than_hand: float
    stability_margin: float
    verdict: Literal["no worse than by hand", "worse than by hand"]
