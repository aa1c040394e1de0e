"""Causal features of what a robot feels: what the last half to two seconds were like.

For every window, of rows that lie in the last so many seconds, the row itself included:

    mean and std of the current and of the speed of each drive
    mean of the summed currents over that of the summed wheel speeds
    mean size of the gyro's yaw rate; mean and std of how much it falls short of the encoders'

and how long the robot has been heard, since windows are shorter at the start. This is what slipid's
filter hears too: wheels, currents, gyro. The vibration comes in only where it is asked for.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from slipid.baselines.floors.interface import Felt
from slipid.identify.compare.slip_model import Machine

WINDOWS_S = (0.5, 1.0, 2.0)
"""Lengths of the windows [s]."""


@dataclass(frozen=True)
class Hearing:
    """Which channels features are made of; wheel speeds always.

    Attributes:
        current, gyro, vibration: whether they are heard.
    """

    current: bool = True
    gyro: bool = True
    vibration: bool = False


def features(
    felt: Felt,
    machine: Machine,
    hearing: Hearing = Hearing(),
    windows_s: Sequence[float] = WINDOWS_S,
    piece_s: float = np.inf,
) -> Float[np.ndarray, "row feature"]:
    """Features of every row, by the rows up to it; NaN where nothing was heard of a channel.

    After every `piece_s` [s] what came before is forgotten, as if the run began anew.
    """
    began = felt.began(piece_s)
    columns = [np.minimum(felt.time - felt.time[began], max(windows_s))]
    for seconds in windows_s:
        window = Window.of(felt.time, seconds, began)
        columns += [column for x in _moving(felt, hearing) for column in window.both(x)]
        if hearing.current:
            amps, turned = np.abs(felt.current).sum(axis=1), np.abs(felt.speed).sum(axis=1)
            columns.append(window.mean(amps) / (window.mean(turned) + 0.1))
        if hearing.gyro and felt.gyro is not None:
            turn = felt.rolling(machine)[:, 2]
            columns.append(window.mean(np.abs(felt.gyro)))
            columns += window.both(short_of(felt.gyro, turn))
        if hearing.vibration and felt.vibration is not None:
            columns += window.both(felt.vibration)
    return np.stack(columns, axis=1)


def short_of(
    gyro: Float[np.ndarray, " row"], turn: Float[np.ndarray, " row"]
) -> Float[np.ndarray, " row"]:
    """How much a gyro's yaw rate falls short of the encoders', whichever way they turn [rad/s]."""
    return np.asarray(np.where(turn < 0, gyro - turn, turn - gyro))


def _moving(felt: Felt, hearing: Hearing) -> list[np.ndarray]:
    """Channels of which means and stds are features, one array each."""
    drives = range(felt.speed.shape[1])
    amps = [np.abs(felt.current[:, k]) for k in drives] if hearing.current else []
    return [*amps, *(felt.speed[:, k] for k in drives)]


@dataclass(frozen=True, eq=False)
class Window:
    """For every row, those rows of the last so many seconds.

    Attributes:
        first: of the rows in the window of each row.
    """

    first: Int[np.ndarray, " row"]

    @classmethod
    def of(
        cls,
        time: Float[np.ndarray, " row"],
        seconds: float,
        began: Int[np.ndarray, " row"] | None = None,
    ) -> "Window":
        """Windows of a length at rows of these times [s], none of them from before `began`."""
        first = np.searchsorted(time, time - seconds + 1e-6)
        return cls(first if began is None else np.maximum(first, began))

    def mean(self, x: Float[np.ndarray, " row"]) -> Float[np.ndarray, " row"]:
        """Mean over each window of what is a number; NaN where nothing is."""
        return self.both(x)[0]

    def both(self, x: Float[np.ndarray, " row"]) -> list[Float[np.ndarray, " row"]]:
        """Mean and std over each window of what is a number; NaN where nothing is."""
        known = np.isfinite(x)
        # about the first value, so that squares lose fewer digits
        middle = float(x[known][0]) if known.any() else 0.0
        value = np.where(known, x - middle, 0.0)
        count = self._sum(known.astype(float))
        count = np.where(count > 0, count, np.nan)
        mean = self._sum(value) / count
        variance = self._sum(value**2) / count - mean**2
        return [mean + middle, np.sqrt(np.maximum(variance, 0.0))]

    def _sum(self, x: Float[np.ndarray, " row"]) -> Float[np.ndarray, " row"]:
        total = np.append(0.0, np.cumsum(x))
        return np.asarray(total[1:] - total[self.first])
