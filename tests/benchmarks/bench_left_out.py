"""The ladder on real left-out runs: sectors, speeds, a moved load, random headings.

    make bench
    .venv/bin/python -m pytest -s -o python_files='bench_*.py' tests/benchmarks -k sectors

(or random, speeds, moved, shares).

Prints mean end-point errors in percent; asserts that every run was judged, and of the load shares
that gray and green agree.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from glob import escape
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from slipid.app.config import read_config
from slipid.app.problem import ConfigFitTask, read_fit_task
from slipid.data.runs import Runs
from slipid.fitting.optimise import Optimum, optimise
from slipid.fitting.problem import Problem, fixed_viscosities
from slipid.infer.result import draws
from slipid.model.robot import build
from slipid.predict.folds import judge
from slipid.predict.ranking import Ranking, compared, ranking
from slipid.search_space import Choice
from slipid.support.progress import Reporter
from tests.benchmarks.quick import QUICK, quick
from tests.benchmarks.record import record

ROOT = Path(__file__).resolve().parents[2]
SHOWN = {
    "encoder": "encoders",
    "linear": "wheel by wheel, linear in torque",
    "affine": "wheel by wheel, affine in torque",
    "svr": "wheel by wheel, affine, support vectors",
    "quadratic": "wheel by wheel, quadratic in torque",
    "saturating": "wheel by wheel, saturating in torque",
    "monotone_spline": "wheel by wheel, monotone spline in torque",
    "affine_current": "wheel by wheel, affine in current",
    "paper": "the form deployed in 2021, refitted per floor",
    "heading_lookup": "lookup by heading",
    "identified": "force balance (slipid)",
}
"""Models in the documentation's table, and their names there."""


@pytest.fixture(scope="module")
def job(real_data: Path) -> ConfigFitTask:
    config = read_config(ROOT / "configs" / "robotino2022.toml")
    return read_fit_task(config, real_data / "robotino2022", Reporter())


def show(title: str, floors: Mapping[str, Ranking]) -> None:
    print(f"\n{title}\nend-point error, %{''.join(f'{floor:>16}' for floor in floors)}")
    for model in next(iter(floors.values())).models:
        errors = (100 * floor.models[model].endpoint_error for floor in floors.values())
        print(f"{model:18}{''.join(f'{error:16.2f}' for error in errors)}")
    for name, floor in floors.items():
        mine, lookup = floor.models["identified"], floor.models["heading_lookup"]
        print(
            f"  {name:12} {floor.runs} runs, coverage of 90 % regions {mine.coverage90:.0%}, "
            f"energy score {1000 * mine.energy_score:.1f} mm, "
            f"yaw {mine.heading_error_median_deg:.1f} deg, "
            f"{mine.endpoint_error / lookup.endpoint_error:.0%} of heading_lookup"
        )


def count(floors: Mapping[str, Ranking]) -> int:
    return sum(floor.runs for floor in floors.values())


def some(job: ConfigFitTask, runs: np.ndarray) -> tuple[Runs, Problem]:
    """Runs and problem of a part of the runs, viscous terms held where they must be."""
    data = job.dataset.subset(runs)
    robot = build(
        job.robot.geometry,
        sorted({str(log.surface) for log in data.logs}),
        sorted({log.load for log in data.logs}),
        sorted(set(data.session)),
        centre=job.robot.camera.centre,
    )
    floors = set(robot.surfaces.labels) | {"*"}
    choices = [
        c
        for c in job.choices
        if not (c.pattern.startswith("surface.") and c.pattern.split(".")[1] not in floors)
    ]
    part = replace(job, dataset=data, robot=robot, choices=tuple(fixed_viscosities(data) + choices))
    return data, part.problem()


def test_sectors(job: ConfigFitTask) -> None:
    floors = compared(job.problem(), job.choices, job.dataset, "sectors", 6, quiet=True).floors
    show("(a) left-out 60-degree sectors", floors)
    record("left_out_sectors", recorded(floors))
    assert count(floors) == len(job.dataset)


def recorded(floors: Mapping[str, Ranking]) -> list[list[str | float]]:
    """Return the rows of the documentation's table: errors, and coverage of the regions [%]."""
    order = [floors[name] for name in ("table", "brown", "gray", "green", "gray@moved")]
    rows: list[list[str | float]] = [
        [name, *(round(100 * floor.models[model].endpoint_error, 1) for floor in order)]
        for model, name in SHOWN.items()
    ]
    inside = [round(100 * floor.models["identified"].coverage90) for floor in order]
    return [*rows, ["end points inside the predicted 90 % region of slipid", *inside]]


def test_random_headings(job: ConfigFitTask) -> None:
    floors = compared(job.problem(), job.choices, job.dataset, "random", 6, quiet=True).floors
    show("(d) random headings", floors)
    assert count(floors) == len(job.dataset)


@pytest.mark.parametrize("seen", quick([(0.1,), (0.1, 0.2)], [(0.1,)]))
def test_speeds(job: ConfigFitTask, seen: tuple[float, ...]) -> None:
    data = job.dataset
    speed = np.round(data.speed, 2)
    several = np.array([log.surface in ("gray", "green") for log in data.logs])
    built = np.array([log.load == "as_built" for log in data.logs])
    fitted = np.isin(speed, seen)
    used = np.flatnonzero(fitted | (several & built))
    part, problem = some(job, used)
    judged = np.flatnonzero(~fitted[used])
    floors = ranking(judge(problem, job.choices, part, "speeds", judged).rows)
    show(f"(b) fitted at {seen} m/s, faster runs predicted", floors)
    assert count(floors) == len(judged)


def test_moved_load(job: ConfigFitTask) -> None:
    """Fit of one_surface; of the moved load only the shares, from a third of its headings."""
    data, problem = job.dataset, job.problem()
    moved = np.array([log.load == "moved" for log in data.logs])
    built, rest = np.flatnonzero(~moved), without_third(data, np.flatnonzero(moved))
    optimum = optimise(problem, keep=np.isin(problem.windows.run, built).astype(float))
    held = only(problem, optimum.state.z, "robot.load_share@moved")
    refit = Problem(problem.windows, problem.robot, held)
    assert refit.space.names == ["robot.load_share@moved[1]", "robot.load_share@moved[2]"]
    again: list[Optimum] = []

    def fit(part: Problem, keep: np.ndarray) -> Optimum:
        again.append(optimise(part, keep=keep))
        return again[0]

    floors = ranking(judge(refit, held, data, "random", rest, fit).rows)
    show("(c) moved load, shares from a third of its headings", floors)
    print_shares("shares of the third", refit, again[0], ("moved",))
    assert count(floors) == len(rest)


def only(problem: Problem, z: np.ndarray, pattern: str) -> list[Choice]:
    """Choices that hold every number at a fitted value and leave those of a pattern free.

    Those have their declared prior again.
    """
    robot = problem.space.tree(jnp.asarray(z))
    values = {e.path: np.asarray(e.get(robot)).tolist() for e in problem.space.all}
    return [*(Choice(escape(p), fixed=v) for p, v in values.items()), Choice(pattern, free=True)]


def without_third(data: Runs, runs: np.ndarray) -> np.ndarray:
    """Some runs without every third heading."""
    heading = np.round(np.degrees(data.heading[runs])) % 360
    return runs[~np.isin(heading, np.unique(heading)[::3])]


def test_load_shares(job: ConfigFitTask) -> None:
    """Where the weight rests, from each carpet by itself and from all floors together."""
    floor = np.array([str(log.surface) for log in job.dataset.logs])
    print("\nload shares of the wheels with 90 % intervals")
    found = {}
    for name in ("gray", "green", None):
        mine = np.arange(len(floor)) if name is None else np.flatnonzero(floor == name)
        data, problem = some(job, mine)
        optimum = optimise(problem)
        loads = sorted({log.load for log in data.logs})
        found[name] = print_shares(name or "all floors", problem, optimum, loads)
    for one, other in (("gray", "green"), ("gray", None), ("green", None)):
        (share, std), (another, wide) = found[one]["as_built"], found[other]["as_built"]
        apart = (np.abs(share - another) / np.hypot(std, wide)).max()
        print(f"  {one} and {other or 'all floors'} are {apart:.1f} standard errors apart")
        assert QUICK or apart < 2
    for one in ("gray", None):
        assert QUICK or np.abs(found[one]["as_built"][0] - found[one]["moved"][0]).max() > 0.03


def print_shares(
    what: str, problem: Problem, optimum: Optimum, loads: Iterable[str]
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Prints shares with intervals; returns shares and their stds of each load set-up."""
    z, out = optimum.state.z, {}
    for load in loads:
        entry = next(e for e in problem.space.free if e.path == f"robot.load_share@{load}")
        at = problem.space.slices[entry.path]
        some_z = draws(z, optimum.covariance, 4000, 0)[:, at]
        drawn = np.asarray(jax.vmap(entry.declaration.to_si)(some_z))
        low, high = np.quantile(drawn, (0.05, 0.95), axis=0)
        share = np.asarray(entry.declaration.to_si(jnp.asarray(z[at])))
        out[load] = share, drawn.std(axis=0)
        text = "   ".join(
            f"{x:.4f} [{a:.4f}, {b:.4f}]" for x, a, b in zip(share, low, high, strict=True)
        )
        print(f"  {what:20} {load:9} {text}")
    return out
