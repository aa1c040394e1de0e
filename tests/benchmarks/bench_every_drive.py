"""Robots on ordinary wheels under control on the test site: three paths from 20 starts.

    .venv/bin/python -m pytest -s -o python_files='bench_*.py' tests/benchmarks/bench_every_drive.py

A differential and a skid-steer robot are simulated and identified by the configs of the test site,
and drive on patches of their floors. With a gyro the closure error must be at most a quarter of
that of encoders with nominal lengths. Without one, it must be smaller than that of calibrated
odometry by more than two standard errors of the paired difference; otherwise the two are reported
as not told apart. SLIPID_DRIVES names a folder that keeps the robots and finished runs.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from slipid.lab.trial.trial import TrialOptions, trial
from slipid.support.executor import Processes
from slipid.support.progress import Reporter
from tests.benchmarks.quick import QUICK, quick
from tests.benchmarks.record import record
from tests.helpers.shared import invoke

ROOT = Path(__file__).resolve().parents[2]
ROBOTS = ("differential", "skid")
PATHS, STARTS = quick((("rectangle", "circle", "eight"), 20), (("circle",), 2))
ROWS = ("encoder", "calibrated", "contact", "contact_gyro")
MOST_OF_ENCODERS = 0.25
"""Largest median closure error with a gyro, relative to that of encoders [1]."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    named = os.environ.get("SLIPID_DRIVES")
    return Path(named) if named else tmp_path_factory.mktemp("drives")


def identified(robot: str, folder: Path) -> tuple[Path, Path]:
    """Return the config of a robot's simulation and the folder with its fit."""
    config, out = ROOT / "configs" / f"testsite_{robot}.toml", folder / robot
    if QUICK:
        # arcs and turns on the spot, on one floor
        text = config.read_text(encoding="utf-8")
        config = folder / f"{robot}.toml"
        config.write_text("[[runs]]".join(text.split("[[runs]]")[:3]), encoding="utf-8")
    result = out / "result"
    if not (result / "robot.json").is_file():
        for words in (
            ("simulate", config, "--out", out, "--quiet"),
            ("identify", out / "robot.toml", "--data", out / "logs", "--out", result, "--quiet"),
        ):
            done = invoke(*words)
            assert done.exit_code in (0, 1), done.stderr
    return config, result


def _apart(row: Mapping[str, Any]) -> str:
    """Return the closure, and the difference from calibrated odometry with its standard error."""
    apart = row["to_calibrated"]
    gap = f"{apart['mean_difference_mm']:+.0f} +- {apart['standard_error_mm']:.0f}"
    return f"{row['closure_error_median']:.0f} ({gap})"


@pytest.mark.parametrize("robot", ROBOTS)
def test_every_path_closes(robot, folder):
    config, result = identified(robot, folder)
    missed = []
    for path in PATHS:
        options = TrialOptions(site=config, controllers=ROWS, path=path, starts=STARTS)
        with Processes(os.cpu_count() or 1) as executor:
            found = trial(result, options, executor, Reporter(quiet=True)).content
        print(f"\n{robot}, {path}, {STARTS} starts: {found['verdict']}")
        summary = found["summary"]
        for name, row in summary.items():
            apart = row["to_calibrated"]
            print(
                f"{name:13s} closes at {row['closure_error_median']:5.0f} mm, "
                f"{row['to_encoder']['closure_error_median']['value']:4.0%} of encoders'; "
                f"{apart['mean_difference_mm']:+5.0f} +- {apart['standard_error_mm']:.0f} mm to "
                f"calibrated; cross-track {row['cross_track_rmse']:4.0f} mm; "
                f"{row['finished_share']:4.0%} finish; recovery in {row['recovery_share']:.0%}"
            )
        closures = (round(summary[name]["closure_error_median"]) for name in ROWS[:2])
        apart_cells = (_apart(summary[name]) for name in ROWS[2:])
        record("every_drive", [[f"{robot}, {path}", *closures, *apart_cells]])
        with_gyro = summary["contact_gyro"]["to_encoder"]["closure_error_median"]["value"]
        apart = summary["contact"]["to_calibrated"]
        gap = apart["mean_difference_mm"] / max(apart["standard_error_mm"], 1e-9)
        better, worse = gap < -2, gap > 2
        print(
            "contact is",
            "better than" if better else "worse than" if worse else "not told apart from",
            "calibrated odometry",
        )
        if with_gyro > MOST_OF_ENCODERS:
            missed.append(f"{path}: {with_gyro:.0%} of encoders' with a gyro")
        if worse:
            missed.append(f"{path}: without a gyro worse than calibrated odometry")
        if min(row["finished_share"] for row in summary.values()) < 1:
            missed.append(f"{path}: not every run finishes")
    # checked at the end, so that every path is driven
    assert QUICK or not missed, missed
