"""What residuals still go with: speed, current or time, where they should go with nothing."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from slipid.identify.bench.fit import MotorFit
from slipid.identify.bench.moments import Sums, cell_length, celled
from slipid.identify.bench.windows import Windows

BINS = 8
"""Of about as many windows."""
SURE = 5.0
"""Stds by which the mean of a bin is not 0."""
MATTERS = 0.01
"""Part of the range of the voltage, or of the current, from which a mean matters to people."""
FEWEST = 5
"""Stretches of time in a bin by which its scatter is judged, at least."""
LONG_S = 0.3
"""Memory of residuals from which a reader is told [s]."""


@dataclass(frozen=True)
class Misfit:
    """Where the model is off most: so much of a channel, at this value of another one."""

    channel: str
    unit: str
    off: float
    over: str
    at: str
    sure: float

    @property
    def text(self) -> str:
        return (
            f"the {self.channel} is {abs(self.off):.2g} {self.unit} "
            f"{'above' if self.off > 0 else 'below'} the model's at {self.at} ({self.over}, "
            f"{self.sure:.0f} stds): the motor has something that the model lacks, and intervals "
            "are wider for it"
        )


def misfits(fit: MotorFit) -> tuple[Misfit, ...]:
    """The worst of each equation, if it is sure and matters."""
    pairs = [("current", "A", fit.amps, fit.amps_sums)]
    if fit.volts is not None and fit.volts_sums is not None:
        pairs.insert(0, ("voltage", "V", fit.volts, fit.volts_sums))
    found = (_worst(fit, *pair) for pair in pairs)
    return tuple(m for m in found if m is not None)


def _worst(fit: MotorFit, channel: str, unit: str, w: Windows, s: Sums) -> Misfit | None:
    """Largest mean of a bin, in its stds, over speed, current and time."""
    size = MATTERS * float(np.ptp(w.both.left))
    best: Misfit | None = None
    used = np.flatnonzero(w.usable)
    time = w.time, w.time
    for over, (odd, even), what in (
        ("speed", (w.odd.speed, w.even.speed), "rad/s"),
        ("current", (w.odd.current, w.even.current), "A"),
        ("time", time, "s"),
    ):
        # a window is put by the rows that its residual is not of, or noise would sort residuals
        bins = [np.array_split(used[np.argsort(v[used], kind="stable")], BINS) for v in (odd, even)]
        for one, other in zip(*bins, strict=True):
            off, sure = _mean(fit, w, s, one, other)
            if abs(off) > size and sure > max(SURE, 0.0 if best is None else best.sure):
                at = f"{odd[one].min():.3g} to {odd[one].max():.3g} {what}"
                best = Misfit(channel, unit, off, over, at, sure)
    return best


def _mean(
    fit: MotorFit,
    w: Windows,
    s: Sums,
    even: Int[np.ndarray, " some"],
    odd: Int[np.ndarray, " some"],
) -> tuple[float, float]:
    """Weighted mean of residuals of even and odd rows of some windows, and its size in stds.

    Cells of the length of the residuals' memory count as independent.
    """
    weight, sum_ = np.zeros(len(w.time)), np.zeros(len(w.time))
    for asked, some in ((s.even, even), (s.odd, odd)):
        weight[some] += asked.weight[some]
        sum_[some] += asked.weight[some] * asked.residual[some]
    total = float(weight.sum())
    if total <= 0:
        return 0.0, 0.0
    off = float(sum_.sum()) / total
    length = max(fit.remember, cell_length([w]))
    away = celled((sum_ - weight * off)[:, None], w, length)
    square = away[:, 0] ** 2
    # too few stretches of time to judge by, or one that outweighs the others
    if np.count_nonzero(square) < FEWEST or square.max() > square.sum() / 2:
        return 0.0, 0.0
    return off, abs(off) * total / float(np.sqrt(square.sum()))
