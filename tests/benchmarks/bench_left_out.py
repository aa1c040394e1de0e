"""The ladder on real left-out runs: sectors, speeds, a moved load, random headings.

    make bench
    .venv/bin/python -m pytest -s -o python_files='bench_*.py' tests/benchmarks -k sectors

(or random, speeds, moved, shares).

Prints mean end-point errors in percent; asserts that every run was judged, and of the load shares
that gray and green agree.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from slipid.data.runs import Runs
from slipid.identify.compare.folds import random_headings, sectors
from slipid.identify.compare.slip_models import rungs
from slipid.identify.compare.validation import Judged, Validation, validation
from slipid.identify.fit.optimise import Optimum
from slipid.identify.fit.problem import Problem, still_viscosities
from slipid.identify.result import draws
from slipid.job.config import read_config
from slipid.job.problem import Job, read_job
from slipid.model.robot import build
from slipid.support.progress import Reporter
from tests.helpers.left_out import left_out, only, train

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def job(real_data: Path) -> Job:
    config = read_config(ROOT / "configs" / "robotino2022.toml")
    return read_job(config, real_data / "robotino2022", Reporter())


def show(title: str, rows: Sequence[Judged]) -> None:
    report = Validation(tuple(rows))
    print(f"\n{title}\n{report.table}")
    for floor, by in report.summary.items():
        mine = by["identified"]
        share = mine.endpoint_error_mean / by["heading_lookup"].endpoint_error_mean
        print(
            f"  {floor:12} coverage of 90 % regions {100 * mine.coverage90:.0f} %, "
            f"energy score {1000 * mine.energy_score:.1f} mm, "
            f"yaw {mine.heading_error_median_deg:.1f} deg, {100 * share:.0f} % of heading_lookup"
        )


def some(job: Job, runs: np.ndarray) -> tuple[Runs, Problem]:
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
    _, *fitted = train(problem, part, np.arange(len(part)))
    rows = validation(*fitted, data.subset(judged)).runs
    show(f"(b) fitted at {seen} m/s, faster runs predicted", rows)
    assert len(rows) == len(judged)


def test_moved_load(job: Job) -> None:
    """Fit of one_surface; of the moved load only the shares, from a third of its headings."""
    data, problem = job.dataset, job.problem()
    moved = np.array([log.load == "moved" for log in data.logs])
    built, (third, rest) = np.flatnonzero(~moved), thirds(data, np.flatnonzero(moved))
    optimum, *_ = train(problem, data, built)
    held = only(problem, optimum.state.z, "robot.load_share@moved")
    refit = Problem(problem.windows, problem.robot, held)
    assert refit.space.names == ["robot.load_share@moved[1]", "robot.load_share@moved[2]"]
    again, contact, _ = train(refit, data, third)
    w = problem.windows  # the simpler models see all that the force balance has seen
    seen = w.pieces(np.flatnonzero(np.isin(w.run, np.concatenate([built, third]))))
    simple = [rung.fit(seen, contact.robot) for rung in rungs(w.has_current)]
    rows = validation(contact, simple, data.subset(rest)).runs
    show("(c) moved load, shares from a third of its headings", rows)
    print_shares("shares of the third", refit, again, ("moved",))
    assert len(rows) == len(rest)


def thirds(data: Runs, runs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Every third heading of some runs, and the others."""
    heading = np.round(np.degrees(data.heading[runs])) % 360
    chosen = np.isin(heading, np.unique(heading)[::3])
    return runs[chosen], runs[~chosen]


def test_load_shares(job: Job) -> None:
    """Where the weight rests, from each carpet by itself and from all floors together."""
    floor = np.array([str(log.surface) for log in job.dataset.logs])
    print("\nload shares of the wheels with 90 % intervals")
    found = {}
    for name in ("gray", "green", None):
        mine = np.arange(len(floor)) if name is None else np.flatnonzero(floor == name)
        data, problem = some(job, mine)
        optimum, *_ = train(problem, data, np.arange(len(data)))
        loads = sorted({log.load for log in data.logs})
        found[name] = print_shares(name or "all floors", problem, optimum, loads)
    apart = np.abs(found["gray"]["as_built"] - found["green"]["as_built"]).max()
    print(f"  gray and green by themselves differ by at most {apart:.4f}")
    assert apart < 0.01
    for one in ("gray", None):
        assert np.abs(found[one]["as_built"] - found[one]["moved"]).max() > 0.03


def print_shares(
    what: str, problem: Problem, optimum: Optimum, loads: Iterable[str]
) -> dict[str, np.ndarray]:
    """Prints shares with intervals; returns the shares of each load set-up."""
    z, out = optimum.state.z, {}
    for load in loads:
        entry = next(e for e in problem.space.free if e.path == f"robot.load_share@{load}")
        at = problem.space.place[entry.path]
        some_z = draws(z, optimum.covariance, 4000, 0)[:, at]
        low, high = np.quantile(jax.vmap(entry.declaration.to_si)(some_z), (0.05, 0.95), axis=0)
        out[load] = np.asarray(entry.declaration.to_si(jnp.asarray(z[at])))
        text = "   ".join(
            f"{x:.4f} [{a:.4f}, {b:.4f}]" for x, a, b in zip(out[load], low, high, strict=True)
        )
        print(f"  {what:20} {load:9} {text}")
    return out
