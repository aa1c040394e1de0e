"""Proposal of the runs to drive next to reduce given stds most, compared with grids of runs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING

import numpy as np

from slipid.infer.design import fisher as info
from slipid.infer.design.planned_runs import PlannedRun, drivable, heading_grid, paper_grid
from slipid.infer.design.planner import Goal, Planner, parameter_goal, prediction_goal, weighed
from slipid.infer.design.scope import Scope
from slipid.infer.result import Fit
from slipid.infer.verdicts.estimates import NEEDS_VOLTAGE
from slipid.model.robot import Validity
from slipid.support.content import Content
from slipid.support.errors import DataError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SCHEMA = "slipid.design/1"
UNREACHABLE_RATIO = 0.9
"""A goal is unreachable if unlimited driving leaves at least this fraction of its present std."""
RANDOM_ORDERS = 8
"""Number of random orders of a grid's runs over which the criterion is averaged."""
CURVE_POINTS = 40
"""Number of points on the curve of a grid's criterion over the number of its runs."""
ASSUMPTIONS = (
    "noise and run effects are those of the fit, and each run is one observation, whatever its "
    "length",
    "effects shared by runs in similar directions are treated as independent effects of each run",
    "all new runs belong to one session, so its offset does not average out",
    "the model is linear around the fitted parameters, and fixed parameters stay fixed",
    "wheel speeds are steady: starting and stopping add no information",
    "runs start with the marker's heading at zero and are centred in the image",
    "the marker is mounted again for the new runs; predictions assume its mean position",
)


@dataclass(frozen=True, eq=False)
class Design:
    """Proposed runs, the most useful first; `print` shows their commands as CSV.

    Attributes:
        content: content of design.json, which includes the stds expected after each run, and how
            many runs are saved compared with grids.
        runs: the proposed runs.
        base_radius: distance of the wheels from the robot's centre [m].
        validity: ranges that the runs of the fit cover, keyed by floor.
        reachable: True if candidate runs can reduce the std of every requested goal.
    """

    content: Content
    runs: tuple[PlannedRun, ...]
    base_radius: float
    validity: Mapping[str, Validity]
    reachable: bool

    def __str__(self) -> str:
        notes = [f"note: {text}" for text in self.content["messages"]]
        return "\n".join([commands(self).rstrip(), *notes])

    def plot(self) -> "Figure":
        """Draw the runs, and the expected uncertainty as a function of their number."""
        from slipid.plots.design import design_figure

        return design_figure(self)


def design(scope: Scope) -> Design:
    """Return the runs that reduce the stds of the goals most, and a comparison with grids of runs.

    Raises:
        DataError: the fit lacks a requested parameter, floor, load or prediction.
    """
    fit = scope.fit
    candidates = scope.candidates()
    _paths(fit, scope.parameters)  # goals are computed after the simulation, and checked before it
    for text in scope.predictions:
        scope.predicted(text)
    planner = Planner.of(fit)
    rows, now = planner.rows(candidates), planner.after(fit)
    last = now.plus(rows, info.UNLIMITED_REPEATS)
    weights = _goals(scope, planner)
    lost = {g.name: s for g in weights if (s := _out_of_reach(fit, g, now, last, len(candidates)))}
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
            "count": len(candidates),
            "floors": sorted({d.surface for d in candidates}),
            "loads": sorted({d.load for d in candidates}),
            "headings_deg": sorted({round(float(np.degrees(d.heading)), 3) for d in candidates}),
            "speeds": sorted({d.speed for d in candidates}),
            "turn_rates": sorted({d.turn for d in candidates}),
        },
        "assumptions": list(ASSUMPTIONS),
        "criterion": [],
        "runs": [],
        "runs_saved": {},
    }
    chosen: list[int] = []
    if goals:
        goal = weighed(goals, now, [weights[g] for g in goals])
        chosen, _ = info.greedy(now, rows, goal, scope.runs)
        chosen = info.exchanged(now, rows, goal, chosen)
        content["criterion"] = info.criterion_path(now, rows, goal, chosen)
        content["runs_saved"] = _saved(scope, planner, goals, goal, candidates, rows)
    runs = tuple(candidates[k] for k in chosen)
    after = now
    for k, run in zip(chosen, runs, strict=True):
        after = after.plus(rows.pick([k]))
        expected = {g.name: g.std(after) for g in goals}
        content["runs"].append(
            {
                "floor": run.surface,
                "load": run.load,
                "heading_deg": float(np.degrees(run.heading)),
                "speed": run.speed,
                "turn_rate": run.turn,
                "distance": run.distance,
                "seconds": run.seconds(scope.base),
                "expected": expected,
            }
        )
    content["messages"] = [*lost.values(), *_extrapolated(fit, runs)]
    content["data"] = {"hash": fit.data_hash, "runs": len(fit.runs)}
    requested = bool(scope.parameters or scope.predictions)
    reachable = bool(goals) and not (requested and lost)
    return Design(content, runs, scope.base, fit.validity, reachable)


def _goals(scope: Scope, planner: Planner) -> dict[Goal, float]:
    """Return the requested goals with weights, by default predictions and weak parameters."""
    found = [parameter_goal(planner, path) for path in _paths(scope.fit, scope.parameters)]
    found += [
        prediction_goal(planner, f"prediction {text}", scope.predicted(text))
        for text in dict.fromkeys(scope.predictions)
    ]
    if found:
        return dict.fromkeys(found, 1.0)
    weak = [
        parameter_goal(planner, e.path)
        for e in planner.space.free
        if not (e.part == "camera" or e.declaration.relative)
        and scope.fit.parameters[e.path].verdict == "weak"
    ]
    ends = prediction_goal(planner, "prediction of every floor", scope.all_predicted())
    return {ends: 1.0} | dict.fromkeys(weak, 1.0 / max(len(weak), 1))


def _paths(fit: Fit, patterns: Sequence[str]) -> list[str]:
    """Return the paths of the free parameters that match the patterns, in order of the patterns."""
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
    """Return the reason why no candidate reduces a goal's std, None if one does."""
    # Without voltages, the scale of parameters in `NEEDS_VOLTAGE` comes only from priors of other
    # parameters: driving does not reduce their stds, whatever the linear model predicts.
    scaleless = goal.name in NEEDS_VOLTAGE and not fit.channels.voltage
    part = goal.std(last) / goal.std(now)
    if part < UNREACHABLE_RATIO and not scaleless:
        return None
    most = (
        f"driving all {count} candidates {info.UNLIMITED_REPEATS:.0f} times would leave {part:.0%} "
        "of its std"
    )
    why = next((f.text for f in fit.flat if goal.name in f.paths), most)
    return f"no candidate run reduces the std of {goal.name}: {why}"


def _extrapolated(fit: Fit, runs: Sequence[PlannedRun]) -> list[str]:
    """Return warnings about proposed runs outside the ranges of the fitted runs."""
    out = []
    for floor, valid in fit.validity.items():
        mine = [d for d in runs if d.surface == floor]
        turned = any(abs(t) > 1e-3 for t in valid.turn_rates)
        if not turned and any(d.turn for d in mine):
            out.append(
                f"no fitted run turns on {floor}: the proposed turns rely on the contact law there"
            )
        top = max(valid.speeds, default=np.inf)
        if any(d.speed > 1.05 * top for d in mine):
            out.append(
                f"fitted runs on {floor} reach {top:g} m/s: the faster runs rely on the contact law"
            )
        other = {d.load for d in mine} - set(valid.loads)
        if other:
            out.append(f"no fitted run on {floor} has the load set-up {', '.join(sorted(other))}")
    return out


def _saved(
    scope: Scope,
    planner: Planner,
    goals: Sequence[Goal],
    goal: np.ndarray,
    candidates: Sequence[PlannedRun],
    rows: info.RunJacobians,
) -> Content:
    """Return, for each grid, how many greedily chosen runs reach the criterion of the whole grid.

    The grid and the greedy choice both start from priors only. Runs are chosen from the candidates
    and the grid's runs. The grids cover the fit's floors and load set-ups that inform about the
    goals.
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
        | _against(planner, goal, drivable(grid, scope.fit.robot), candidates, rows, scope.base)
        for key, (name, grid) in grids.items()
    }


def _against(
    planner: Planner,
    goal: np.ndarray,
    grid: tuple[PlannedRun, ...],
    candidates: Sequence[PlannedRun],
    rows: info.RunJacobians,
    base: float,
) -> Content:
    of_grid, start = planner.rows(grid), planner.nothing()
    target = start.plus(of_grid).criterion(goal)
    both, runs = rows.joined(of_grid), [*candidates, *grid]
    chosen, found = info.greedy(start, both, goal, len(grid), target)
    count, reached = len(chosen), found[-1] <= target
    at = sorted({*np.geomspace(1, len(grid), CURVE_POINTS).round().astype(int).tolist(), count})
    orders = [np.random.default_rng(k).permutation(len(grid)) for k in range(RANDOM_ORDERS)]
    random = np.mean(
        [info.criterion_path(start, of_grid, goal, order, at) for order in orders], axis=0
    )
    in_order = info.criterion_path(start, of_grid, goal, np.arange(len(grid)), at)
    return {
        "grid_runs": len(grid),
        "greedy_runs": count if reached else None,
        "ratio": count / len(grid) if reached else None,
        "grid_minutes": sum(d.seconds(base) for d in grid) / 60,
        "greedy_minutes": sum(runs[k].seconds(base) for k in chosen) / 60,
        "criterion": target,
        "criterion_random_order": float(random[at.index(count)]),
        "curves": {
            "greedy": {"runs": list(range(1, count + 1)), "criterion": found[1:]},
            "grid": {"runs": at, "criterion": in_order},
            "random_order": {"runs": at, "criterion": random.tolist()},
        },
    }


COLUMNS = "run,floor,load,vx_m_s,vy_m_s,turn_rad_s,seconds"
"""Names of the columns of a table of commands."""


def commands(found: Design) -> str:
    """Return the commands as CSV: body twist and duration of every run."""
    lines = [COLUMNS]
    for k, d in enumerate(found.runs, 1):
        vx, vy, turn = d.command + 0.0
        seconds = d.seconds(found.base_radius)
        lines.append(f"{k},{d.surface},{d.load},{vx:.4f},{vy:.4f},{turn:.4f},{seconds:.2f}")
    return "\n".join(lines) + "\n"
