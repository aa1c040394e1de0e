"""From a fit and what is wanted to the runs that shrink it most, and what they save."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING

import numpy as np

from slipid.infer.design import fisher as info
from slipid.infer.design.planned_runs import PlannedRun, drivable, heading_grid, paper_grid
from slipid.infer.design.planner import Goal, Planner, parameter_goal, prediction_goal, weighed
from slipid.infer.design.scope import DesignOptions, Scope
from slipid.infer.result import Fit
from slipid.infer.verdicts.estimates import NEEDS_VOLTAGE
from slipid.model.robot import Validity
from slipid.support.errors import DataError
from slipid.support.files import Content

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SCHEMA = "slipid.design/1"
REACHED = 0.9
"""A goal that keeps more than this part of its std however long one drives is out of reach."""
ORDERS = 8
"""Random orders of a grid that are averaged."""
POINTS = 40
"""Numbers of runs at which the curve of a grid is given."""
ASSUMPTIONS = (
    "noise and run effects as fitted; a run is one piece however long it is",
    "what runs in nearly one direction share counts as each run's own",
    "all new runs are of one session, whose own offset they cannot average away",
    "linear around the fitted numbers; what the fit holds fixed stays fixed",
    "steady wheel speeds: nothing is learnt from starting and stopping",
    "runs start with the marker's heading at zero and are centred in the image",
    "the marker is put on once more for the new runs; predictions have it on as on average",
)


@dataclass(frozen=True, eq=False)
class Design:
    """Proposed runs, the most useful first; `print` shows their commands as CSV.

    The content is that of design.json: what each run is expected to tell, and what they save
    against grids. Seen is what each floor was driven with; reached, whether every goal that was
    asked for can be.
    """

    content: Content
    drives: tuple[PlannedRun, ...]
    base_radius: float
    seen: Mapping[str, Validity]
    reached: bool

    def __str__(self) -> str:
        notes = [f"note: {text}" for text in self.content["messages"]]
        return "\n".join([commands(self).rstrip(), *notes])

    def plot(self) -> "Figure":
        """The runs, and how fast uncertainty falls."""
        from slipid.plots.design import design_figure

        return design_figure(self)


def design(fit: Fit, wish: DesignOptions) -> Design:
    """Runs that shrink what is wanted most, and how many they save against grids.

    Raises:
        DataError: a parameter, floor, load or prediction the fit does not have.
    """
    scope, planner = Scope(fit, wish), Planner.of(fit)
    offered = scope.candidates()
    rows, now = planner.rows(offered), planner.after(fit)
    last = now.plus(rows, info.ENDLESS)
    weights = _goals(fit, wish, scope, planner)
    lost = {g.name: s for g in weights if (s := _out_of_reach(fit, g, now, last, len(offered)))}
    goals = [g for g in weights if g.name not in lost]
    content: Content = {
        "schema": SCHEMA,
        "goals": [
            {
                "name": g.name,
                "unit": g.unit,
                "now": g.std(now),
                "endless": g.std(last),
                "reachable": g.name not in lost,
            }
            for g in weights
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
        goal = weighed(goals, now, [weights[g] for g in goals])
        chosen, _ = info.greedy(now, rows, goal, wish.runs)
        chosen = info.exchanged(now, rows, goal, chosen)
        content["criterion"] = info.criterion_path(now, rows, goal, chosen)
        content["runs_saved"] = _saved(scope, planner, goals, goal, offered, rows)
    drives = tuple(offered[k] for k in chosen)
    after = now
    for k, drive in zip(chosen, drives, strict=True):
        after = after.plus(rows.pick([k]))
        expected = {g.name: g.std(after) for g in goals}
        content["runs"].append(
            {
                "floor": drive.surface,
                "load": drive.load,
                "heading_deg": float(np.degrees(drive.heading)),
                "speed": drive.speed,
                "turn_rate": drive.turn,
                "distance": drive.distance,
                "seconds": drive.seconds(scope.base),
                "expected": expected,
            }
        )
    content["messages"] = [*lost.values(), *_extrapolated(fit, drives)]
    content["data"] = {"hash": fit.data_hash, "runs": len(fit.runs)}
    asked = bool(wish.parameters or wish.predictions)
    return Design(content, drives, scope.base, fit.validity, not (asked and lost) and bool(goals))


def _goals(fit: Fit, wish: DesignOptions, scope: Scope, planner: Planner) -> dict[Goal, float]:
    found = [parameter_goal(planner, path) for path in _paths(fit, wish.parameters)]
    found += [
        prediction_goal(planner, f"prediction {text}", scope.predicted(text))
        for text in dict.fromkeys(wish.predictions)
    ]
    if found:
        return dict.fromkeys(found, 1.0)
    weak = [
        parameter_goal(planner, e.path)
        for e in planner.space.free
        if e.part != "camera" and fit.parameters[e.path].verdict == "weak"
    ]
    ends = prediction_goal(planner, "prediction of every floor", scope.all_predicted())
    return {ends: 1.0} | dict.fromkeys(weak, 1.0 / max(len(weak), 1))


def _paths(fit: Fit, patterns: Sequence[str]) -> list[str]:
    """Free parameters that match, in order."""
    out: list[str] = []
    can = [e.path for e in fit.space.free if e.session is None]
    for pattern in patterns:
        free = [path for path in can if fnmatchcase(path, pattern)]
        if not free:
            known = any(fnmatchcase(e.path, pattern) for e in fit.space.all)
            why = "is not free in this fit" if known else "matches no parameter"
            raise DataError(f"--parameter {pattern}: {why}; expected one of {', '.join(can)}")
        out += free
    return list(dict.fromkeys(out))


def _out_of_reach(
    fit: Fit, goal: Goal, now: info.Information, last: info.Information, count: int
) -> str | None:
    """Why no candidate shrinks a goal, None where one does."""
    # a prior elsewhere must not lend them a scale
    scaleless = goal.name in NEEDS_VOLTAGE and not fit.channels.voltage
    part = goal.std(last) / goal.std(now)
    if part < REACHED and not scaleless:
        return None
    most = f"driving all {count} {info.ENDLESS:.0f} times would leave {part:.0%} of its std"
    why = next((f.text for f in fit.flat if goal.name in f.paths), most)
    return f"no candidate run shrinks {goal.name}: {why}"


def _extrapolated(fit: Fit, drives: Sequence[PlannedRun]) -> list[str]:
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


def _saved(
    scope: Scope,
    planner: Planner,
    goals: Sequence[Goal],
    goal: np.ndarray,
    offered: Sequence[PlannedRun],
    rows: info.RunJacobians,
) -> Content:
    """How many runs, chosen one after another from nothing, tell as much as whole grids.

    They are chosen from the candidates and the grid's own runs. The grids are driven wherever it
    was driven before, but only with the floors and loads the goals are about.
    """
    setups = [s for s in scope.setups if any(g.is_about(s) for g in goals)]
    setups = [s for s in setups if s in scope.driven] or setups or list(scope.setups)
    headings = heading_grid(setups, scope.driven_speeds, scope.distance)
    grids = {
        "paper_grid": ("the 2021 paper's grid", paper_grid(setups, scope.distance)),
        "heading_grid": ("the 2022 grid of headings every 5 deg", headings),
    }
    return {
        key: {"name": name, "setups": [list(s) for s in setups]}
        | _against(planner, goal, drivable(grid, scope.fit.robot), offered, rows, scope.base)
        for key, (name, grid) in grids.items()
    }


def _against(
    planner: Planner,
    goal: np.ndarray,
    grid: tuple[PlannedRun, ...],
    offered: Sequence[PlannedRun],
    rows: info.RunJacobians,
    base: float,
) -> Content:
    of_grid, start = planner.rows(grid), planner.nothing()
    target = start.plus(of_grid).criterion(goal)
    both, drives = rows.joined(of_grid), [*offered, *grid]
    chosen, found = info.greedy(start, both, goal, len(grid), target)
    count, reached = len(chosen), found[-1] <= target
    at = sorted({*np.geomspace(1, len(grid), POINTS).round().astype(int).tolist(), count})
    orders = [np.random.default_rng(k).permutation(len(grid)) for k in range(ORDERS)]
    random = np.mean(
        [info.criterion_path(start, of_grid, goal, order, at) for order in orders], axis=0
    )
    in_order = info.criterion_path(start, of_grid, goal, np.arange(len(grid)), at)
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
