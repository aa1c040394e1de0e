"""The trial's rectangle on the test site, from 48 starts on four maps that no other number is from.

    SLIPID_FIT=demo_out/result .venv/bin/python -m pytest -s -o python_files='bench_*.py' \
        tests/benchmarks/bench_trial.py

Needs a folder `slipid identify` wrote for floors of the test site; finished runs are kept there.
"""

from __future__ import annotations

import os

import numpy as np

from tests.benchmarks.quick import QUICK, quick
from tests.benchmarks.record import record

MAPS, STARTS = quick(((101, 102, 103, 104), 12), ((101,), 2))
SHOWN = {
    "contact": "contact",
    "contact_map": "contact, with the floor map",
    "contact_gyro": "contact, with a gyro",
}
"""Controllers in the documentation's table, and their names there."""
ROWS = ("encoder", "contact", "contact_map", "contact_gyro")


def test_other_starts_on_other_maps(fit_folder, robot, tmp_path):
    from slipid.data.floor_map import patchwork, write_map
    from slipid.lab.trial.summary import best_controllers, summaries
    from slipid.lab.trial.trial import TrialOptions, trial
    from slipid.support.executor import Processes
    from slipid.support.progress import Reporter

    labels = robot.labels
    colours = {name: f"#{40 * k:02x}8080" for k, name in enumerate(labels)}
    runs = []
    for seed in MAPS:
        there = tmp_path / f"map{seed}.toml"
        write_map(there, patchwork(labels, seed, patch=0.35, half=2.0), colours)
        wish = TrialOptions(map=there, controllers=ROWS, starts=STARTS)
        with Processes(os.cpu_count() or 1) as executor:
            runs += trial(fit_folder, wish, executor, Reporter(quiet=True)).runs
    table = summaries(runs)
    base = table["encoder"]
    print(
        f"\n{len(MAPS)} maps, {STARTS} starts each; encoders {base['closure_error_median']:.0f} mm"
    )
    for name, row in table.items():
        closes, across = (
            row["to_encoder"][key] for key in ("closure_error_median", "cross_track_rmse")
        )
        low, high = closes["interval90"]
        print(
            f"{name:13s} closes at {closes['value']:4.0%} ({low:.0%} to {high:.0%}) of encoders,"
            f" worse than they in {row['worse_share']:3.0%}, cross-track {across['value']:4.0%},"
            f" {row['finished_share']:4.0%} finish"
        )
        if name in SHOWN:
            shares = (row["worse_share"], across["value"], row["finished_share"])
            wide = f"{100 * closes['value']:.0f} % ({100 * low:.0f} to {100 * high:.0f})"
            cells = [f"{100 * share:.0f} %" for share in shares]
            record("trial_site", [[SHOWN[name], wide, *cells]])
    print("not told apart:", ", ".join(best_controllers(runs)))
    assert QUICK or min(row["finished_share"] for row in table.values()) > 0.9
    assert np.isfinite(base["closure_error_median"])
