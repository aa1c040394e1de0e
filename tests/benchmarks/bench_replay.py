"""Unseen real runs through the deployed estimator, floor unknown.

    .venv/bin/python -m pytest -s -o python_files='bench_*.py' tests/benchmarks/bench_replay.py

(-k one_floor or two_floors). Fits of the parts, one to three minutes each, are kept in
out/bench_replay/CODE.

One floor: fits of two opposite pairs of 60-degree sectors, the third pair judged, three times over,
so that no judged heading was fitted on any floor. 64 joint hypotheses; the pose is used once, where
the wheels have moved 10 mm. Two floors: deployed from runs on one floor each, without and with
being told that these two floors are all there are, and with their map and the pose at the start;
what the runs across the edge would teach is refused by `slipid identify`.
"""

from __future__ import annotations

import pickle
from collections import Counter
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest

from slipid.app.config import parsed
from slipid.app.problem import ConfigFitTask, read_fit_task, with_mixed
from slipid.deploy.deploy import robot_of_force_balance
from slipid.deploy.floors import floor_of
from slipid.fitting.likelihood import batch
from slipid.fitting.optimise import optimise
from slipid.infer.slip_curves import current_trend
from slipid.predict.folds import fold_keys, sectors
from slipid.predict.predictive import ForceBalance, force_balance_of
from slipid.robot.deployed import DeployedRobot
from slipid.robot.estimator import Estimator
from slipid.robot.interface import MIXED_FLOORS_PENALTY, Settings
from slipid.support.progress import Reporter
from tests.benchmarks.quick import QUICK
from tests.helpers import replayed
from tests.helpers.replayed import Judged

ROOT = Path(__file__).resolve().parents[2]
CONFIG = ROOT / "configs" / "robotino2022.toml"
CODE = sha256(
    b"".join(
        p.read_bytes()
        for part in ("data", "identify", "model")
        for p in sorted((ROOT / "slipid" / part).rglob("*.py"))
    )
    + CONFIG.read_bytes()
)
OUT = ROOT / "out" / "bench_replay" / CODE.hexdigest()[:8]
TOP = 8.0
"""Highest wheel speed of the fitted runs [rad/s]."""
BARS = {"table": 0.02, "brown": 0.03, "gray": 0.065, "green": 0.11}
"""Mean end-point error over the camera's chord."""
TOLD = 0.92
PAIR = ("green", "table")
ACROSS = """
[[logs]]
glob = "two_surfaces/green_table/*.csv"
format = "robotino2022"
map = "maps/green_table.toml"
load = "as_built"
"""
Made = TypeVar("Made")


@pytest.fixture(scope="module")
def job(real_data: Path) -> ConfigFitTask:
    config = parsed(CONFIG, CONFIG.read_text(encoding="utf-8") + ACROSS)
    root = real_data / "robotino2022"
    report = Reporter()
    return with_mixed(read_fit_task(config, root, report), root, report)


def kept(name: str, make: Callable[[], Made]) -> Made:
    """Fits, made once."""
    path = OUT / f"{name}.pickle"
    if not path.is_file():
        made = pickle.dumps(make())
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(made)
    found: Made = pickle.loads(path.read_bytes())
    return found


def fitted(job: ConfigFitTask, runs: np.ndarray) -> ForceBalance:
    """Fit of some of the runs on one floor."""
    problem = job.problem()
    keep = np.isin(problem.windows.run, runs).astype(float)
    optimum = optimise(problem, keep=keep)
    return force_balance_of(problem, optimum.state, optimum.covariance, keep)


def deployed(job: ConfigFitTask, contact: ForceBalance, runs: np.ndarray) -> DeployedRobot:
    """From a fit; `runs` on one floor are those it was fitted to."""
    windows = job.problem().windows
    seen = windows.segments(np.flatnonzero(np.isin(windows.run, runs)))
    trend = current_trend(contact.robot, batch(seen, contact.robot))
    return robot_of_force_balance(contact, TOP, trend, load="as_built")


def show(rows: list[Judged]) -> None:
    print(f"{'':8}runs   told in 1 s   end-point error   median   encoders   in 90 % region")
    for name in (*BARS, None):
        some = [r for r in rows if name in (None, r.surface)]
        told = np.mean([r.told == r.surface for r in some])
        error, straight = ([getattr(r, k) for r in some] for k in ("error", "straight"))
        inside = np.mean([r.level <= 0.9 for r in some])
        print(
            f"{name or 'all':8}{len(some):4d}{100 * told:12.1f} %{100 * np.mean(error):15.2f} %"
            f"{100 * np.median(error):9.2f}{100 * np.mean(straight):10.1f}{100 * inside:12.0f} %"
        )
    names = list(BARS)
    table = Counter((r.surface, r.told) for r in rows)
    print("floor, and what it was told to be: " + "  ".join(names))
    for name in names:
        print(f"  {name:8}" + "".join(f"{table[name, other]:8d}" for other in names))
    for speed in (0.1, 0.2, 0.3):
        line = f"  at {speed} m/s:"
        for name in ("gray", "green"):
            some = [r for r in rows if r.surface == name and abs(r.speed - speed) < 0.05]
            right = 100 * np.mean([r.told == name for r in some])
            error = 100 * np.mean([r.error for r in some])
            line += f"   {name} told {right:.0f} %, error {error:.1f} %"
        print(line)


def test_one_floor(job: ConfigFitTask) -> None:
    data = job.dataset
    fold = sectors(fold_keys(data)) % 3
    built = np.array([log.load == "as_built" for log in data.logs])
    rows: list[Judged] = []
    for k in range(3):
        fit = kept(f"fold{k}", lambda k=k: fitted(job, np.flatnonzero(fold != k)))
        est = Estimator(deployed(job, fit, np.flatnonzero(fold != k)))
        some = data.subset(np.flatnonzero(built & (fold == k)))
        said = replayed.replay(est, some.logs)
        rows += replayed.judged(fit.robot, est.robot.labels, some, said, fit.variance)
    print("\nruns on one floor, none of whose headings was fitted")
    show(rows)
    assert len(rows) == built.sum()
    for name, bar in BARS.items():
        some = [r for r in rows if r.surface == name]
        assert QUICK or np.mean([r.error for r in some]) < bar
    assert QUICK or np.mean([r.told == r.surface for r in rows]) > TOLD


def test_two_floors(job: ConfigFitTask) -> None:
    data, floor = job.mixed[0]
    everything = np.arange(len(job.dataset))
    fit = kept("everything", lambda: fitted(job, everything))
    known = deployed(job, fit, everything)
    print("\nacross green and table, wheel by wheel")
    begin = [
        replayed.poses(fit.robot, log, session)[0]
        for log, session in zip(data.logs, data.session, strict=True)
    ]
    for title, settings, there, mapped in (
        ("any of four", Settings(), known.labels, None),
        ("these two", Settings(further_floor_penalty=MIXED_FLOORS_PENALTY), PAIR, None),
        (
            "their map",
            Settings(further_floor_penalty=MIXED_FLOORS_PENALTY),
            PAIR,
            floor_of(floor, PAIR),
        ),
    ):
        est = Estimator(known.on(*there), settings, mapped)
        said, labels = replayed.replay(est, data.logs, np.array(begin)), est.robot.labels
        every = replayed.judged(fit.robot, labels, data, said, fit.variance)
        truth, said_of = replayed.wheels(fit.robot, labels, floor, data, said)
        error, straight = (np.mean([getattr(r, k) for r in every]) for k in ("error", "straight"))
        print(
            f"{title}: error {100 * error:.1f} %, encoders {100 * straight:.1f} %, "
            f"in 90 % region {100 * np.mean([r.level <= 0.9 for r in every]):.0f} %; "
            f"accuracy {100 * balanced(truth, said_of):.0f} %"
        )
        for name in PAIR:
            told = said_of[truth == labels.index(name)][:, :-1].argmax(axis=1)
            share = np.bincount(told, minlength=len(labels)) / len(told)
            text = "  ".join(f"{n} {s:.2f}" for n, s in zip(labels, share, strict=True))
            print(f"  on {name}: {text}")
        assert QUICK or error < 0.75 * straight


def balanced(truth: np.ndarray, belief: np.ndarray) -> float:
    """Mean over the floors that are there of how often the most probable floor is it."""
    told = belief[:, :-1].argmax(axis=1)
    return float(np.mean([np.mean(told[truth == f] == f) for f in np.unique(truth)]))
