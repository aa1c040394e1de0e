"""Scope of a proposal of runs: its goals, and the candidate runs that its options allow."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from slipid.infer.design.planned_runs import HEADINGS, PlannedRun, Setup, candidates, drivable
from slipid.infer.result import Fit
from slipid.support.errors import DataError

MOST_SPEEDS = 4
"""Largest number of candidate speeds of a floor."""

MOST_S = 3600.0
"""Longest duration of a candidate run whose distance or speed is given by an option [s]."""


def _numbers(name: str, text: str | None, least: float = -3600.0) -> tuple[float, ...] | None:
    if text is None:
        return None
    try:
        found = tuple(float(x) for x in text.split(","))
    except ValueError:
        found = ()
    if not 0 < len(found) <= 100 or not all(least <= number <= 3600 for number in found):
        rule = f"1 to 100 numbers from {least:g} to 3600"
        raise DataError(f"--{name} {text}: expected {rule} separated by commas, as in 0,45,90")
    return tuple(dict.fromkeys(found))


@dataclass(frozen=True, eq=False)
class Scope:
    """Goals and candidate runs of a proposal, according to the options of `slipid design`.

    By default, candidates cover the ranges of the fitted runs. A goal is a parameter or a
    prediction whose std is to be reduced by the new runs.

    Attributes:
        fit: the fit.
        parameters: patterns of parameter names; every matching parameter is a goal.
        predictions: predictions that are goals, as `floor[@load][:speed[:heading_deg]]`.
        runs: number of runs to propose.
        headings: headings of candidates, separated by commas [deg].
        speeds: speeds of candidates, separated by commas [m/s].
        turns: yaw rates of candidates, separated by commas [deg/s].
        length: path length of candidates [m].
        floors: floors of candidates.
        loads: load set-ups of candidates.

    Raises:
        DataError: the fit lacks a requested floor or load set-up, an option is invalid, or no run
            is drivable.
    """

    fit: Fit
    parameters: Sequence[str] = ()
    predictions: Sequence[str] = ()
    runs: int = 12
    headings: str | None = None
    speeds: str | None = None
    turns: str | None = None
    length: float | None = None
    floors: Sequence[str] = ()
    loads: Sequence[str] = ()

    def __post_init__(self) -> None:
        if self.length is not None and not 1e-3 <= self.length <= 1e4:
            raise DataError(f"--distance {self.length:g}: expected a length of 0.001 to 10000 m")
        self._known("floor", self.floors, self.fit.validity)
        self._known("load set-up", self.loads, self.fit.robot.body.loads)

    @staticmethod
    def _known(what: str, names: Sequence[str], known: Collection[str]) -> None:
        for name in names:
            if name not in known:
                raise DataError(f"no {what} '{name}'; identified: {', '.join(known)}")

    @property
    def driven(self) -> tuple[Setup, ...]:
        """Pairs of floor and load set-up of the fit's runs."""
        return tuple((floor, load) for floor, v in self.fit.validity.items() for load in v.loads)

    @property
    def setups(self) -> tuple[Setup, ...]:
        """Pairs of floor and load set-up of candidates."""
        floors = self.floors or tuple(self.fit.validity)
        loads = self.loads or self.fit.robot.body.loads
        return tuple((floor, load) for floor in floors for load in loads)

    @property
    def base(self) -> float:
        return float(self.fit.robot.geometry.base_radius)

    @cached_property
    def driven_speeds(self) -> dict[str, tuple[float, ...]]:
        """Up to `MOST_SPEEDS` speeds of each floor's runs [m/s].

        If no speed of a floor's runs is known, the speeds are the largest rim speed and half of it.
        """
        out = {}
        for floor, valid in self.fit.validity.items():
            found = [v for v in valid.speeds if v > 0]
            top = valid.wheel_speed[1] * float(self.fit.robot.geometry.wheel_radius)
            if len(found) > MOST_SPEEDS:
                at = np.linspace(0, 1, MOST_SPEEDS)
                found = np.quantile(found, at, method="nearest").tolist()
            out[floor] = tuple(dict.fromkeys(found)) or (round(0.5 * top, 3), round(top, 3))
        return out

    @property
    def distance(self) -> dict[str, float]:
        """Path length of each floor's candidates [m], by default the mean over the floor's runs."""
        if self.length is not None:
            return dict.fromkeys(self.fit.validity, self.length)
        return {floor: round(v.distance, 2) for floor, v in self.fit.validity.items()}

    def candidates(self) -> tuple[PlannedRun, ...]:
        speeds = _numbers("speeds", self.speeds, least=0.0)
        turns = _numbers("turns", self.turns)
        found = candidates(
            self.setups,
            dict.fromkeys(self.fit.validity, speeds) if speeds else self.driven_speeds,
            self.distance,
            self.base,
            _numbers("headings", self.headings) or HEADINGS,
            np.radians(turns).tolist() if turns else None,
        )
        given = {self.length, self.speeds, self.turns} != {None}
        if found and given and (longest := max(d.seconds(self.base) for d in found)) > MOST_S:
            raise DataError(
                f"--distance, --speeds and --turns: a candidate run of {longest:.3g} s; expected a "
                f"shorter distance, or higher speeds, for runs of at most {MOST_S:g} s"
            )
        return self._drivable(
            found,
            "no candidate run remains; expected at least one heading and speed, or turning rate, "
            "that the robot can drive",
        )

    def predicted(self, text: str) -> tuple[PlannedRun, ...]:
        """Return the runs of a prediction `floor[@load][:speed[:heading]]`."""
        head, *rest = text.split(":")
        floor, _, load = head.partition("@")
        try:
            numbers = [float(x) for x in rest]
            ok = len(rest) < 3 and (np.abs(numbers) <= 3600).all() and (not rest or numbers[0] > 0)
        except ValueError:
            ok = False
        if not ok:
            raise DataError(
                f"--predict {text}: expected floor[@load][:speed in m/s[:heading in degrees]], "
                "as in gray:0.3:45"
            )
        self._known("floor", [floor], self.fit.validity)
        self._known("load set-up", [load] if load else [], self.fit.robot.body.loads)
        loads = self.fit.validity[floor].loads
        load = load or ("as_built" if "as_built" in loads else loads[0])
        runs = self._straight([(floor, load)], numbers[:1], numbers[1:] or HEADINGS)
        return self._drivable(
            runs,
            f"--predict {text}: the wheels cannot drive straight in this heading; expected another "
            "heading",
        )

    def all_predicted(self) -> tuple[PlannedRun, ...]:
        runs = self._straight(self.driven, [], HEADINGS)
        return self._drivable(
            runs,
            "the wheels cannot drive straight in any heading, so that there is no prediction to "
            "improve; name goals with --parameter",
        )

    def _straight(
        self, setups: Sequence[Setup], speeds: Sequence[float], headings_deg: Sequence[float]
    ) -> list[PlannedRun]:
        return [
            PlannedRun(floor, load, float(heading), speed, 0.0, self.distance[floor])
            for floor, load in setups
            for speed in speeds or self.driven_speeds[floor]
            for heading in np.radians(headings_deg)
        ]

    def _drivable(self, runs: Sequence[PlannedRun], otherwise: str) -> tuple[PlannedRun, ...]:
        kept = drivable(runs, self.fit.robot)
        if not kept:
            raise DataError(otherwise)
        return kept
