"""The ladder on real left-out runs: sectors, speeds, a moved load, random headings.

    make bench
    .venv/bin/python -m pytest -s -o python_files='bench_*.py' tests/benchmarks -k sectors

Prints mean end-point errors in percent; asserts nothing but that every run was judged.
"""

from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from slipid.app.config import read_config
from slipid.app.job import Job, read_job
from slipid.data.dataset import Dataset
from slipid.identify.folds import left_out, only, random_headings, sectors, still_viscosities, train
from slipid.identify.problem import Problem
from slipid.identify.validate import summary, text_table, validation
from slipid.model.robot import build

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def job(real_data: Path) -> Job:
    config = read_config(ROOT / "configs" / "robotino2022.toml")
    return read_job(config, real_data / "robotino2022", lambda done, count: None, print)


def show(title: str, rows: list[dict]) -> None:
    report = {"summary": summary(rows)}
    print(f"\n{title}\n{text_table(report)}")
    for floor, by in report["summary"].items():
        mine = by["identified"]
        share = mine["endpoint_error_mean"] / by["heading_lookup"]["endpoint_error_mean"]
        print(
            f"  {floor:12} coverage of 90 % regions {100 * mine['coverage90']:.0f} %, "
            f"energy score {1000 * mine['energy_score']:.1f} mm, "
            f"yaw {mine['heading_error_median_deg']:.1f} deg, {100 * share:.0f} % of heading_lookup"
        )


def some(job: Job, runs: np.ndarray) -> tuple[Dataset, Problem]:
    """Dataset and problem of a part of the runs, viscous terms held where they must be."""
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
    part = replace(job, dataset=data, robot=robot, choices=tuple(still_viscosities(data) + choices))
    return data, part.problem()


def test_sectors(job: Job) -> None:
    rows = left_out(job.problem(), job.dataset, sectors(job.dataset))
    show("(a) left-out 60-degree sectors", rows)
    assert len(rows) == len(job.dataset)


def test_random_headings(job: Job) -> None:
    rows = left_out(job.problem(), job.dataset, random_headings(job.dataset))
    show("(d) random headings", rows)
    assert len(rows) == len(job.dataset)


@pytest.mark.parametrize("seen", [(0.1,), (0.1, 0.2)])
def test_speeds(job: Job, seen: tuple[float, ...]) -> None:
    data = job.dataset
    speed = np.round(data.speed, 2)
    several = np.array([log.surface in ("gray", "green") for log in data.logs])
    built = np.array([log.load == "as_built" for log in data.logs])
    fitted = np.flatnonzero(np.isin(speed, seen))
    judged = np.flatnonzero(~np.isin(speed, seen) & several & built)
    part, problem = some(job, fitted)
    _, frozen = train(problem, part, np.arange(len(part)))
    rows = validation(frozen, data.subset(judged))["runs"]
    show(f"(b) fitted at {seen} m/s, faster runs predicted", rows)
    assert len(rows) == len(judged)


def test_moved_load(job: Job) -> None:
    """Fit of one_surface; of the moved load only the shares, from a third of its headings."""
    data = job.dataset
    moved = np.array([log.load == "moved" for log in data.logs])
    part, problem = some(job, np.flatnonzero(~moved))
    optimum, first = train(problem, part, np.arange(len(part)))
    third = np.flatnonzero(moved)[::3]
    rest = np.setdiff1d(np.flatnonzero(moved), third)
    again, shares = some(job, np.concatenate([np.flatnonzero(~moved), third]))
    held = [
        c
        for c in only(problem, optimum.state.z, "robot.load_share@moved")
        if not c.pattern.startswith("robot.load_share@as_built") or c.fixed is not None
    ]
    refit = Problem(shares.windows, shares.robot, [*job_choices(shares), *held])
    is_third = np.isin([log.name for log in again.logs], [data.logs[k].name for k in third])
    _, frozen = train(refit, again, np.flatnonzero(is_third))
    rows = validation(replace(frozen, rungs=first.rungs), data.subset(rest))["runs"]
    show("(c) moved load, shares from a third of its headings", rows)
    share = refit.space.tree(jnp.asarray(frozen.z)).body.load_share
    print("  load shares as_built, moved:", np.round(np.asarray(share), 4).tolist())
    assert len(rows) == len(rest)


def job_choices(problem: Problem) -> list:
    """What was fixed stays fixed: only the pattern asked for is left free."""
    from slipid.parameter import Choice

    robot = problem.robot
    free = {e.path for e in problem.space.free}
    return [
        Choice(e.path, fixed=np.asarray(e.get(robot)).tolist())
        for e in problem.space.all
        if e.path not in free
    ] + [Choice("camera.session_yaw@gray/moved/0.10", fixed=0.0)]
