"""Runs of a robot whose every number is known: to learn on, and to see what a fit would recover."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from slipid.data.runs import Runs, collect
from slipid.model.robot import Robot
from slipid.selftest import known
from slipid.selftest.logs import make_logs


@dataclass(frozen=True, eq=False)
class Made:
    """Made runs and what is true of them.

    Attributes:
        runs: as `read_runs` would give them.
        robot: that drove them, a three-wheeled Robotino; no fit sees it.
    """

    runs: Runs
    robot: Robot

    @cached_property
    def truth(self) -> dict[str, float | list[float]]:
        """Every true number by its path [SI]."""
        return known.numbers(self.robot)


def made_runs(
    floors: Sequence[str] = ("firm", "soft"),
    *,
    headings: int = 12,
    speeds: Sequence[float] = (0.1, 0.2),
    turns: int = 2,
    truth: Mapping[str, float | Sequence[float]] | None = None,
    current: bool = True,
    voltage: bool = True,
    seed: int = 0,
) -> Made:
    """Drive a grid of runs with known numbers, seen by noisy sensors as those of a real Robotino.

    Args:
        floors: their names; `firm` and `soft` have numbers of their own, others the declared ones.
        headings: evenly spread, on every floor at every speed.
        speeds: [m/s].
        turns: curved runs beside them, at every speed.
        truth: numbers that are to be others, by path [SI].
        current, voltage: whether those of the motors are logged.
        seed: of the noise.

    Raises:
        ValueError: no such number; names those there are.
    """
    drives = known.grid([(floor, "as_built") for floor in floors], headings, speeds, turns)
    robot = known.truth(drives, truth)
    if wrong := sorted(set(truth or {}) - set(known.numbers(robot))):
        raise ValueError(f"no parameter '{wrong[0]}'; there are: {', '.join(known.numbers(robot))}")
    logs = make_logs(robot, drives, seed, known.Sensors(has_voltage=voltage))
    return Made(collect(logs if current else [replace(log, current=None) for log in logs]), robot)
