"""Real skid-steer robots: held-back runs predicted by the fit and by corrected kinematics.

    make bench
    .venv/bin/python -m pytest -s -o python_files='bench_*.py' tests/benchmarks/bench_skid.py

(about two minutes a case). Prints medians and means over the path, and the yaw at the end; asserts
that the force balance is ahead of the effective track where half of the runs of each day are held
back, and that its regions hold what they say.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from slipid.data.runs import Runs
from slipid.identify.compare.slip_models import restored
from slipid.identify.compare.validation import Summary, validation
from slipid.job.config import read_config
from slipid.job.identify import optimised, summarised
from slipid.job.problem import Job, job_of, read_job
from slipid.support.progress import Reporter

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Split:
    """A config, and what is in the names of fitted and of judged runs."""

    config: str
    fitted: tuple[str, ...]
    judged: tuple[str, ...]


ODD = tuple(f"step_{k:02d}" for k in range(1, 41, 2))
EVEN = tuple(f"step_{k:02d}" for k in range(2, 41, 2))
SPLITS = {
    "Warthog, every other run": Split("warthog", ODD, EVEN),
    "Warthog, the other runs": Split("warthog", EVEN, ODD),
    "Warthog, 18 July by 29 July": Split("warthog", ("2024_7_29",), ("2024_7_18",)),
    "Warthog, 29 July by 18 July, which is nearly straight": Split(
        "warthog", ("2024_7_18",), ("2024_7_29",)
    ),
    "Husky, every other run": Split("husky", ODD, EVEN),
    "Husky, the other runs": Split("husky", EVEN, ODD),
}


def part(data: Runs, names: tuple[str, ...]) -> Runs:
    kept = [
        k
        for k, log in enumerate(data.logs)
        if "asphalt" not in log.name and any(name in log.name for name in names)
    ]
    return data.subset(kept)


def judged(split: Split, real_data: Path) -> dict[str, Summary]:
    with Reporter(quiet=True) as report:
        config = read_config(ROOT / "configs" / f"{split.config}.toml")
        whole: Job = read_job(config, real_data / "drive_skid", report)
        job = job_of(config, part(whole.dataset, split.fitted), (), report)
        problem = job.problem()
        fit = summarised(job, problem, optimised(job, problem, None, report), report)
    assert fit.converged, fit.reason
    rungs = restored(fit.space.template.geometry, dict(fit.baselines))
    other = part(whole.dataset, split.judged)
    # a session that was not fitted has the marker where the robot has it
    other = replace(other, session=tuple(fit.robot.camera.sessions[:1] * len(other)))
    (floor,) = validation(fit.contact, rungs, other).summary.values()
    return floor


@pytest.mark.parametrize("name", SPLITS)
def test_runs_that_were_held_back(name, real_data):
    found = judged(SPLITS[name], real_data)
    print(f"\n{name}, {found['identified'].runs} runs")
    print(f"{'':24}{'median / path':>14}{'mean / path':>14}{'yaw at the end':>16}{'in 90 %':>10}")
    for model, s in found.items():
        inside = "" if s.coverage90 is None else f"{s.coverage90:.0%}"
        print(
            f"{model:24}{100 * s.endpoint_error_over_path_median:13.2f}%"
            f"{100 * s.endpoint_error_over_path_mean:13.2f}%"
            f"{s.heading_error_median_deg:12.2f} deg{inside:>10}"
        )
    mine, track = found["identified"], found["effective_track"]
    assert mine.coverage90 is not None
    assert np.isfinite(mine.endpoint_error_over_path_mean)
    if "straight" not in name:
        assert mine.endpoint_error_over_path_median < 0.95 * track.endpoint_error_over_path_median
        assert mine.heading_error_median_deg < track.heading_error_median_deg
        assert mine.coverage90 >= 0.7
