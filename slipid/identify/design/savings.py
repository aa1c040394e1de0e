"""How many chosen runs tell as much as the whole grids of published experiments."""

from collections.abc import Sequence

import numpy as np

from slipid.identify.design import fisher as info
from slipid.identify.design.planned_runs import Drive, drivable, heading_grid, paper_grid
from slipid.identify.design.planner import Goal, Planner
from slipid.identify.design.wish import Scope
from slipid.support.content import Content

ORDERS = 8
"""Random orders of a grid that are averaged."""
POINTS = 40
"""Numbers of runs at which the curve of a grid is given."""


def saved(
    scope: Scope,
    planner: Planner,
    goals: Sequence[Goal],
    goal: np.ndarray,
    offered: Sequence[Drive],
    rows: info.Rows,
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
    grid: tuple[Drive, ...],
    offered: Sequence[Drive],
    rows: info.Rows,
    base: float,
) -> Content:
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
