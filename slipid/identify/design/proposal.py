"""From a fit and what is wanted to the runs that shrink it most, and what they save."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from typing import Any

import numpy as np

from slipid.identify.design import fisher as info
from slipid.identify.design import planned_runs as dr
from slipid.identify.design.planned_runs import Drive, Setup
from slipid.identify.design.planner import Goal, Planner, parameter_goal, prediction_goal, weighed
from slipid.identify.result import Fit
from slipid.identify.slip_curves import Validity
from slipid.identify.verdicts.estimates import NEEDS_VOLTAGE
from slipid.support.errors import DataError

SCHEMA = "slipid.design/1"
REACHED = 0.9
"""A goal that keeps more than this part of its std however long one drives is out of reach."""
MOST_SPEEDS = 4
ORDERS = 8
"""Random orders of a grid that are averaged."""
POINTS = 40
"""Numbers of runs at which the curve of a grid is given."""
ASSUMPTIONS = (
    "noise and run effects as fitted; a run is one piece however long it is",
    "all new runs are of one session, whose own offset they cannot average away",
    "linear around the fitted numbers; what the fit holds fixed stays fixed",
    "steady wheel speeds: nothing is learnt from starting and stopping",
    "runs start with the marker's heading at zero and are centred in the image",
    "the marker is put on once more for the new runs; predictions have it on as on average",
)


@dataclass(frozen=True)
class Wish:
    """What a user asks for; what is None or empty is chosen from what the fit has seen.

    Attributes:
        parameters: patterns of names; predictions: `floor[@load][:speed[:heading_deg]]`.
        runs: to propose.
        headings_deg, speeds, turns, distance: of candidates [deg], [m/s], [rad/s], [m].
        floors, loads: of candidates.
    """

    parameters: tuple[str, ...] = ()
    predictions: tuple[str, ...] = ()
    runs: int = 12
    headings_deg: tuple[float, ...] = dr.HEADINGS
    speeds: tuple[float, ...] | None = None
    turns: tuple[float, ...] | None = None
    distance: float | None = None
    floors: tuple[str, ...] = ()
    loads: tuple[str, ...] = ()


def wish(
    parameters: Sequence[str],
    predictions: Sequence[str],
    runs: int = 12,
    headings: str | None = None,
    speeds: str | None = None,
    turns: str | None = None,
    distance: float | None = None,
    floors: Sequence[str] = (),
    loads: Sequence[str] = (),
) -> Wish:
    """Wish from words of the command line: lists with commas, headings and turns in degrees.

    Raises:
        DataError: no numbers, or none that can be driven.
    """
    if distance is not None and not 0 < distance < np.inf:
        raise DataError(f"--distance {distance:g}: expected metres above zero")
    rates = _numbers("turns", turns)
    return Wish(
        parameters=tuple(parameters),
        predictions=tuple(predictions),
        runs=runs,
        headings_deg=_numbers("headings", headings) or dr.HEADINGS,
        speeds=_numbers("speeds", speeds, least=0.0),
        turns=None if rates is None else tuple(float(np.radians(t)) for t in rates),
        distance=distance,
        floors=tuple(floors),
        loads=tuple(loads),
    )


def _numbers(name: str, text: str | None, least: float = -np.inf) -> tuple[float, ...] | None:
    if text is None:
        return None
    try:
        found = tuple(float(x) for x in text.split(","))
    except ValueError:
        found = ()
    if not found or not np.isfinite(found).all() or min(found) < least:
        rule = "numbers" if least < 0 else f"numbers not below {least:g}"
        raise DataError(f"--{name} {text}: expected {rule} with commas between, as in 0,45,90")
    return tuple(dict.fromkeys(found))


@dataclass(frozen=True, eq=False)
class Design:
    """Proposed runs.

    Attributes:
        content: of design.json.
        drives: the runs, the most useful first.
        base_radius: of the robot [m].
        seen: what each floor was driven with.
        reached: whether every goal that was asked for can be reached.
    """

    content: dict[str, Any]
    drives: tuple[Drive, ...]
    base_radius: float
    seen: Mapping[str, Validity]
    reached: bool


@dataclass(frozen=True, eq=False)
class _Scope:
    """Floors and loads by what the fit saw, and what may be driven on them."""

    fit: Fit
    wish: Wish
    driven: tuple[Setup, ...] = field(init=False)

    def __post_init__(self) -> None:
        seen = self.fit.validity
        pairs = tuple((floor, load) for floor in seen for load in seen[floor].loads)
        object.__setattr__(self, "driven", pairs)
        _known("floor", self.wish.floors, seen)
        _known("load set-up", self.wish.loads, self.fit.robot.body.loads)

    @property
    def setups(self) -> tuple[Setup, ...]:
        """Floors and loads of candidates."""
        floors = self.wish.floors or tuple(self.fit.validity)
        loads = self.wish.loads or self.fit.robot.body.loads
        return tuple((floor, load) for floor in floors for load in loads)

    @property
    def base(self) -> float:
        return float(self.fit.robot.geometry.base_radius)

    @property
    def speeds(self) -> dict[str, tuple[float, ...]]:
        """Of each floor [m/s]; as driven."""
        if self.wish.speeds is not None:
            return dict.fromkeys(self.fit.validity, self.wish.speeds)
        return {floor: self._driven_speeds(floor) for floor in self.fit.validity}

    def _driven_speeds(self, floor: str) -> tuple[float, ...]:
        seen = self.fit.validity[floor]
        found = [v for v in seen.speeds if v > 0]
        if not found:  # no commands in the logs: what the fastest wheel did
            top = seen.wheel_speed[1] * float(self.fit.robot.geometry.wheel_radius)
            return (round(0.5 * top, 3), round(top, 3))
        if len(found) > MOST_SPEEDS:
            found = np.quantile(found, np.linspace(0, 1, MOST_SPEEDS), method="nearest").tolist()
        return tuple(dict.fromkeys(found))

    @property
    def distance(self) -> dict[str, float]:
        """Of each floor's runs [m]: as driven, on the whole."""
        if self.wish.distance is not None:
            return dict.fromkeys(self.fit.validity, self.wish.distance)
        return {floor: round(seen.distance, 2) for floor, seen in self.fit.validity.items()}

    def candidates(self) -> tuple[Drive, ...]:
        """Runs to choose from."""
        found = dr.candidates(
            self.setups,
            self.speeds,
            self.distance,
            self.base,
            self.wish.headings_deg,
            self.wish.turns,
        )
        kept = dr.drivable(found, self.fit.robot)
        if not kept:
            raise DataError(
                "no candidate run is left; expected at least one heading and speed, or turning "
                "rate, that the robot can drive"
            )
        return kept

    def predicted(self, text: str) -> tuple[Drive, ...]:
        """Runs of a prediction `floor[@load][:speed[:heading]]`."""
        head, *rest = text.split(":")
        floor, _, load = head.partition("@")
        try:
            numbers = [float(x) for x in rest]
            ok = len(rest) < 3 and np.isfinite(numbers).all() and (not rest or numbers[0] > 0)
        except ValueError:
            ok = False
        if not ok:
            raise DataError(
                f"--predict {text}: expected floor[@load][:speed in m/s[:heading in degrees]], "
                "as in gray:0.3:45"
            )
        _known("floor", [floor], self.fit.validity)
        _known("load set-up", [load] if load else [], self.fit.robot.body.loads)
        loads = self.fit.validity[floor].loads
        load = load or ("as_built" if "as_built" in loads else loads[0])
        speeds = numbers[:1] or self._driven_speeds(floor)
        ways = np.radians(numbers[1:] or dr.HEADINGS)
        far = self.distance[floor]
        runs = [Drive(floor, load, float(a), v, 0.0, far) for v in speeds for a in ways]
        return self._can(runs, f"--predict {text}")

    def all_predicted(self) -> tuple[Drive, ...]:
        """Every heading at every driven speed on every floor and load that was driven."""
        runs = [
            Drive(floor, load, float(a), v, 0.0, self.distance[floor])
            for floor, load in self.driven
            for v in self._driven_speeds(floor)
            for a in np.radians(dr.HEADINGS)
        ]
        return self._can(runs, "predictions")

    def _can(self, runs: Sequence[Drive], what: str) -> tuple[Drive, ...]:
        kept = dr.drivable(runs, self.fit.robot)
        if not kept:
            raise DataError(f"{what}: these wheels cannot drive in that heading")
        return kept


def _known(what: str, names: Sequence[str], known: Collection[str]) -> None:
    for name in names:
        if name not in known:
            raise DataError(f"no {what} '{name}'; identified: {', '.join(known)}")


def design(fit: Fit, wish: Wish) -> Design:
    """Runs that shrink what is wanted most, and how many they save against grids.

    Raises:
        DataError: a parameter, floor, load or prediction the fit does not have.
    """
    scope, planner = _Scope(fit, wish), Planner.of(fit)
    offered = scope.candidates()
    rows, now = planner.rows(offered), planner.after(fit)
    last = info.endless(now, rows)
    wanted, weight = _goals(fit, wish, scope, planner)
    lost = {g.name: s for g in wanted if (s := _out_of_reach(fit, g, now, last, len(offered)))}
    goals = [g for g in wanted if g.name not in lost]
    weight = [w for g, w in zip(wanted, weight, strict=True) if g.name not in lost]
    asked = bool(wish.parameters or wish.predictions)
    content: dict[str, Any] = {
        "schema": SCHEMA,
        "goals": [
            {
                "name": g.name,
                "unit": g.unit,
                "now": g.std(now),
                "endless": g.std(last),
                "reachable": g.name not in lost,
            }
            for g in wanted
        ],
        "candidates": {
            "count": len(offered),
            "floors": sorted({d.surface for d in offered}),
            "loads": sorted({d.load for d in offered}),
            "headings_deg": sorted({round(float(np.degrees(d.heading)), 3) for d in offered}),
            "speeds": sorted({d.speed for d in offered}),
            "turn_rates": sorted({d.turn for d in offered}),
        },
        "assumptions": list(ASSUMPTIONS),
        "criterion": [],
        "runs": [],
        "runs_saved": {},
    }
    chosen: list[int] = []
    if goals:
        goal = weighed(goals, now, weight)
        chosen, _ = info.greedy(now, rows, goal, wish.runs)
        chosen = info.exchanged(now, rows, goal, chosen)
        content["criterion"] = info.path(now, rows, goal, chosen)
        content["runs"] = _runs(
            scope, planner, goals, now, rows, [offered[k] for k in chosen], chosen
        )
        content["runs_saved"] = saved(scope, planner, goals, goal, offered, rows)
    drives = tuple(offered[k] for k in chosen)
    content["messages"] = [*lost.values(), *_extrapolated(fit, drives)]
    content["data"] = {"hash": fit.data_hash, "runs": len(fit.runs)}
    return Design(content, drives, scope.base, fit.validity, not (asked and lost) and bool(goals))


def _goals(fit: Fit, wish: Wish, scope: _Scope, planner: Planner) -> tuple[list[Goal], list[float]]:
    """What is to shrink, and with which weight."""
    found = [parameter_goal(planner, path) for path in _paths(fit, wish.parameters)]
    found += [
        prediction_goal(planner, f"prediction {text}", scope.predicted(text))
        for text in dict.fromkeys(wish.predictions)
    ]
    if found:
        return found, [1.0] * len(found)
    weak = [
        e.path
        for e in planner.space.free
        if e.part != "camera" and fit.parameters[e.path].verdict == "weak"
    ]
    ends = prediction_goal(planner, "prediction of every floor", scope.all_predicted())
    share = 1.0 / max(len(weak), 1)
    return [ends, *(parameter_goal(planner, p) for p in weak)], [1.0] + [share] * len(weak)


def _paths(fit: Fit, patterns: Sequence[str]) -> list[str]:
    """Free parameters that match, in order."""
    out: list[str] = []
    can = [e.path for e in fit.space.free if e.session is None]
    for pattern in patterns:
        matching = [e.path for e in fit.space.all if fnmatchcase(e.path, pattern)]
        free = [p for p in can if p in matching]
        if not free:
            names = ", ".join(can)
            why = "is not free in this fit" if matching else "matches no parameter"
            raise DataError(f"--parameter {pattern}: {why}; expected one of {names}")
        out += free
    return list(dict.fromkeys(out))


def _out_of_reach(
    fit: Fit, goal: Goal, now: info.Knowledge, last: info.Knowledge, count: int
) -> str | None:
    """Why no candidate shrinks a goal, None where one does."""
    # a prior elsewhere must not lend them a scale
    scaleless = goal.name in NEEDS_VOLTAGE and not fit.has["voltage"]
    part = goal.std(last) / goal.std(now)
    if part < REACHED and not scaleless:
        return None
    said = next((f.text for f in fit.flat if goal.name in f.paths), None)
    if said is not None:
        return f"no candidate run shrinks {goal.name}: {said}"
    return (
        f"no candidate run shrinks {goal.name}: driving all {count} {info.ENDLESS:.0f} times "
        f"would leave {part:.0%} of its std"
    )


def _runs(
    scope: _Scope,
    planner: Planner,
    goals: Sequence[Goal],
    now: info.Knowledge,
    rows: info.Rows,
    drives: Sequence[Drive],
    chosen: Sequence[int],
) -> list[dict[str, Any]]:
    out = []
    for drive, k in zip(drives, chosen, strict=True):
        now = now.plus(rows.pick([k]))
        out.append(
            {
                "floor": drive.surface,
                "load": drive.load,
                "heading_deg": float(np.degrees(drive.heading)),
                "speed": drive.speed,
                "turn_rate": drive.turn,
                "distance": drive.distance,
                "seconds": drive.seconds(scope.base),
                "expected": {g.name: g.std(now) for g in goals},
            }
        )
    return out


def _extrapolated(fit: Fit, drives: Sequence[Drive]) -> list[str]:
    """Where proposed runs leave what the fit has seen: its form is not known to hold there."""
    out = []
    for floor, seen in fit.validity.items():
        mine = [d for d in drives if d.surface == floor]
        turned = any(abs(t) > 1e-3 for t in seen.turn_rates)
        if not turned and any(d.turn for d in mine):
            out.append(
                f"{floor} was never driven turning: proposed turns trust the contact law there"
            )
        top = max(seen.speeds, default=np.inf)
        if any(d.speed > 1.05 * top for d in mine):
            out.append(
                f"{floor} was driven at {top:g} m/s at most: faster runs trust the contact law"
            )
        other = {d.load for d in mine} - set(seen.loads)
        if other:
            out.append(f"{floor} was never driven with load {', '.join(sorted(other))}")
    return out


def saved(
    scope: _Scope,
    planner: Planner,
    goals: Sequence[Goal],
    goal: np.ndarray,
    offered: Sequence[Drive],
    rows: info.Rows,
) -> dict[str, Any]:
    """How many runs, chosen one after another from nothing, tell as much as whole grids.

    They are chosen from the candidates and the grid's own runs. The grids are driven wherever it
    was driven before, but only with the floors and loads the goals are about.
    """
    setups = [s for s in scope.setups if any(g.is_about(s) for g in goals)]
    setups = [s for s in setups if s in scope.driven] or setups or list(scope.setups)
    straight = replace(scope, wish=replace(scope.wish, speeds=None)).speeds
    grids = {
        "paper_grid": ("the 2021 paper's grid", dr.paper_grid(setups, scope.distance)),
        "heading_grid": (
            "the 2022 grid of headings every 5 deg",
            dr.heading_grid(setups, straight, scope.distance),
        ),
    }
    return {
        key: {"name": name, "setups": [list(s) for s in setups]}
        | _against(planner, goal, dr.drivable(grid, scope.fit.robot), offered, rows, scope.base)
        for key, (name, grid) in grids.items()
    }


def _against(
    planner: Planner,
    goal: np.ndarray,
    grid: tuple[Drive, ...],
    offered: Sequence[Drive],
    rows: info.Rows,
    base: float,
) -> dict[str, Any]:
    of_grid, start = planner.rows(grid), planner.nothing()
    target = start.plus(of_grid).criterion(goal)
    both, drives = rows.joined(of_grid), [*offered, *grid]
    chosen, found = info.greedy(start, both, goal, len(grid), target)
    count, reached = len(chosen), found[-1] <= target
    at = sorted({*np.geomspace(1, len(grid), POINTS).round().astype(int).tolist(), count})
    orders = [np.random.default_rng(k).permutation(len(grid)) for k in range(ORDERS)]
    random = np.mean([info.path(start, of_grid, goal, order, at) for order in orders], axis=0)
    in_order = info.path(start, of_grid, goal, np.arange(len(grid)), at)
    return {
        "grid_runs": len(grid),
        "greedy_runs": count if reached else None,
        "ratio": count / len(grid) if reached else None,
        "grid_minutes": sum(d.seconds(base) for d in grid) / 60,
        "greedy_minutes": sum(drives[k].seconds(base) for k in chosen) / 60,
        "criterion": target,
        "criterion_random_order": float(random[at.index(count)]),
        "curves": {
            "greedy": {"runs": list(range(1, count + 1)), "criterion": found[1:]},
            "grid": {"runs": at, "criterion": in_order},
            "random_order": {"runs": at, "criterion": random.tolist()},
        },
    }


def commands(found: Design) -> str:
    """CSV of what to drive: body twist and duration of every run."""
    lines = ["run,floor,load,vx_m_s,vy_m_s,turn_rad_s,seconds"]
    for k, d in enumerate(found.drives, 1):
        vx, vy, turn = d.command + 0.0
        seconds = d.seconds(found.base_radius)
        lines.append(f"{k},{d.surface},{d.load},{vx:.4f},{vy:.4f},{turn:.4f},{seconds:.2f}")
    return "\n".join(lines) + "\n"
