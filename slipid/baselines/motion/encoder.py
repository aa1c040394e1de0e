"""Encoders alone, with no slip.

    xi = back r w

with r w the rim speed of each drive by its encoder. Nothing is fitted and nothing is tuned. This is
what every method is compared with, and what it falls back to where it corrects nothing.

Liberties: none.

Source: Indiveri 2009, IEEE Transactions on Robotics 25(1), for omni wheels; for skid steer the body
twist by least squares, which says nothing about motion sideways.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

from slipid.baselines.interface import Heard, Machine, Method, Run, Said
from slipid.baselines.motion.steps import Steps


@final
@dataclass(frozen=True)
class Encoder(Method):
    """What the encoders say if no wheel slips."""

    name: str = "encoder"

    def fit(self, runs: Sequence[Run], machine: Machine) -> "Encoder":
        return self

    def predict(self, runs: Sequence[Heard], machine: Machine) -> list[Said]:
        steps = Steps.of(runs)
        return steps.said(steps.heard.rolling(machine))

    @property
    def numbers(self) -> int:
        return 0
