"""Voltages that a competent person drives a motor with, as fractions of the largest one."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

EXCITATIONS = {"steps": 0.4, "random": 0.25, "sweep": 0.15, "quasi-static": 0.2}
"""Kinds of experiments, with their fractions of all."""


@dataclass(frozen=True)
class Plan:
    """Limits of an experiment.

    No current exceeds that of the stalled motor at the largest voltage by more than what is left
    of a transient: a level is held until the speed follows it before the voltage moves by more
    than the whole, and what changes faster stays within half of the range.

    Attributes:
        rows: number of rows.
        settling: mechanical time constant [rows].
        both: whether the motor runs in both directions; otherwise forward alone.
    """

    rows: int
    settling: float
    both: bool

    def command(self, rng: Generator, excitation: str) -> np.ndarray:
        """Return starts and stops, the experiment proper and a last stop, in -1 .. 1."""
        draw = {
            "steps": self._steps,
            "random": self._random,
            "sweep": self._sweeps,
            "quasi-static": self._quasi_static,
        }[excitation]
        parts = [self._starts(rng)]
        body = self.rows - len(parts[0])
        parts += draw(rng, body)
        command = np.concatenate(parts)[: self.rows]
        command[-max(5, self.rows // 50) :] = 0
        return command

    def _sign(self, rng: Generator) -> float:
        """A direction."""
        return float(rng.choice([-1, 1])) if self.both else 1.0

    def _dwell(self, rng: Generator, low: float = 3, high: float = 8) -> int:
        """A number of rows for which a level is held, between multiples of the settling."""
        return int(np.ceil(max(6, self.settling * rng.uniform(low, high))))

    def _starts(self, rng: Generator) -> np.ndarray:
        """Rest, a start from rest and a stop, in each direction."""
        rest = np.zeros(max(5, self.rows // 50))
        starts = [rest]
        for sign in (1, -1) if self.both else (1, 1):
            level, length = sign * rng.uniform(0.6, 1), self._dwell(rng, 4, 6)
            starts += [np.full(length, level), np.zeros(length)]
        return np.concatenate(starts)

    def _levels(self, rng: Generator) -> Iterator[np.ndarray]:
        """Levels until the rows end, a quarter of them stops."""
        longest = max(8.0, self.rows / self.settling / rng.uniform(20, 60))
        level = 0.0
        while True:
            wanted = 0.0 if rng.random() < 0.25 else self._sign(rng) * rng.uniform(0.15, 1)
            level = float(np.clip(wanted, level - 1, level + 1))
            yield np.full(self._dwell(rng, 3, longest), level)

    def _steps(self, rng: Generator, rows: int) -> list[np.ndarray]:
        """Levels for all of the rows."""
        parts, left = [], rows
        for part in self._levels(rng):
            parts.append(part)
            left -= len(part)
            if left <= 0:
                return parts

    def _random(self, rng: Generator, rows: int) -> list[np.ndarray]:
        """Pseudo-random switching, between two levels or among many, in bursts between stops."""
        shortest, two_levels = rng.uniform(0.2, 1), bool(rng.random() < 0.5)
        largest = rng.uniform(0.35, 0.5) * (1 if self.both else 2)
        parts, left = [], rows
        while left > 0:
            parts.append(np.zeros(self._dwell(rng)))
            for _ in range(rng.integers(20, 60)):
                length = int(np.ceil(max(2, self.settling * shortest * rng.geometric(0.5))))
                level = largest * (rng.integers(2) if two_levels else rng.random())
                parts.append(np.full(length, 2 * level - largest if self.both else level))
            left = rows - sum(map(len, parts))
        return parts

    def _sweeps(self, rng: Generator, rows: int) -> list[np.ndarray]:
        """Sines of rising frequency, up to about where the motor stops following, between stops."""
        amplitudes = rng.permutation([0.4, 0.7, 1.0])
        stop = self._dwell(rng)
        length = max(int(rows / 3) - stop, 10) + 1
        lowest, highest = (
            1.5 / length,
            min(rng.uniform(0.7, 2.5) / (2 * np.pi * self.settling), 0.05),
        )
        time = np.arange(length)
        rate = np.log(highest / lowest) / length
        phase = 2 * np.pi * lowest * np.expm1(rate * time) / rate
        wave = np.sin(phase) if self.both else (1 - np.cos(phase)) / 2
        return [part for a in amplitudes for part in (a * wave, np.zeros(stop))]

    def _quasi_static(self, rng: Generator, rows: int) -> list[np.ndarray]:
        """A slow ramp up and down, in each direction, and then steps."""
        length, top = int(rows * rng.uniform(0.3, 0.6)), rng.uniform(0.6, 1)
        knots = top * np.array([0, 1, 0, -1 if self.both else 1, 0])
        ramp = np.interp(np.linspace(0, 4, length), np.arange(5), knots)
        stop = np.zeros(self._dwell(rng))
        return [ramp, stop, *self._steps(rng, max(rows - length - len(stop), 1))]
