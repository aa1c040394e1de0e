"""Real skid-steer robots: held-back runs predicted by the fit and by corrected kinematics.

    make bench
    .venv/bin/python -m pytest -s -o python_files='bench_*.py' tests/benchmarks/bench_skid.py

(about two minutes a case). Prints medians and means over the path, and the yaw at the end. Asserts
that regions hold what they say, and for Warthog with every other run of each day held back that
the force balance is ahead of the effective track: in the other cases it is not in all.
"""

from dataclasses import dataclass
from pathlib import Path

import pytest

from slipid.predict.validation import FloorSummary
from tests.benchmarks.quick import QUICK, quick
from tests.benchmarks.record import record
from tests.helpers.held_back import held_back

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Split:
    """A config, and what is in the names of fitted and of judged runs."""

    config: str
    fitted: tuple[str, ...]
    judged: tuple[str, ...]


GRASS = ("grass_2024_7_18", "grass_2024_7_29", "wetgrass")
"""Folders of the runs on grass."""
ODD = tuple(f"{day}/step_{k:02d}" for day in GRASS for k in range(1, 41, 2))
EVEN = tuple(f"{day}/step_{k:02d}" for day in GRASS for k in range(2, 41, 2))
SPLITS = quick(
    {
        "Warthog, every other run": Split("warthog", ODD, EVEN),
        "Warthog, the other runs": Split("warthog", EVEN, ODD),
        "Warthog, 18 July by 29 July": Split("warthog", ("grass_2024_7_29",), ("grass_2024_7_18",)),
        "Warthog, 29 July by 18 July, which is nearly straight": Split(
            "warthog", ("grass_2024_7_18",), ("grass_2024_7_29",)
        ),
        "Husky, every other run": Split("husky", ODD, EVEN),
        "Husky, the other runs": Split("husky", EVEN, ODD),
    },
    {"Warthog, every other run": Split("warthog", ODD[::3], EVEN[::5])},
)


SHOWN = {
    "identified": "force balance",
    "selected": "selected by slipid",
    "calibrated": "calibrated kinematics",
    "effective_track": "effective track",
    "instantaneous_centres": "instantaneous centres",
    "nominal": "nominal",
}
"""Models in the table of results, with their labels."""


def judged(split: Split, real_data: Path) -> dict[str, FloorSummary]:
    config = ROOT / "configs" / f"{split.config}.toml"
    found = held_back(config, real_data / "drive_skid", split.fitted, split.judged)
    (floor,) = found.summary.values()
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
        if model in SHOWN:
            errors = (s.endpoint_error_over_path_median, s.endpoint_error_over_path_mean)
            cells = [*(round(100 * e, 1) for e in errors), round(s.heading_error_median_deg, 2)]
            share = None if s.coverage90 is None else round(100 * s.coverage90)
            record("skid_held_out", [[name, SHOWN[model], *cells, share]], keys=2)
    mine, track = found["identified"], found["effective_track"]
    assert mine.coverage90 is not None
    assert QUICK or mine.coverage90 >= 0.7
    if name in ("Warthog, every other run", "Warthog, the other runs"):
        assert (
            QUICK
            or mine.endpoint_error_over_path_median < 0.95 * track.endpoint_error_over_path_median
        )
        assert QUICK or mine.heading_error_median_deg < track.heading_error_median_deg
