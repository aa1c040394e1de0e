"""The whole comparison on the real logs: every rung on every floor, at every question.

    make bench
    .venv/bin/python -m pytest -s -o python_files='bench_*.py' tests/benchmarks -k compare

Prints the tables and sentences of `slipid compare`; asserts that every run was judged, and that the
force balance's 90 % regions hold as many ends as 99 % of honest forecasts would.
"""

from pathlib import Path
from typing import Any

import pytest

from slipid.app.compare import compare
from slipid.predict.folds import QUESTIONS
from slipid.report.answers import show_comparison
from slipid.report.page import Page
from slipid.support.progress import Reporter
from tests.benchmarks.quick import QUICK

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def found(real_data: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    config, out = ROOT / "configs" / "robotino2022.toml", tmp_path_factory.mktemp("compare")
    with Reporter() as report:
        result = compare(config, real_data / "robotino2022", out, list(QUESTIONS), report)
    show_comparison(Page(), result)
    return result


def test_every_run_is_judged(found: dict[str, Any]) -> None:
    for question, runs in (("sectors", 472), ("random", 472), ("speeds", 300)):
        floors = found["questions"][question]["floors"]
        assert QUICK or sum(one["runs"] for one in floors.values()) == runs


def test_regions_are_as_wide_as_they_have_to_be(found: dict[str, Any]) -> None:
    for floor, one in found["questions"]["sectors"]["floors"].items():
        mine = one["models"]["identified"]
        low, high = one["band90"]
        assert QUICK or low <= mine["coverage90"] <= high, floor
        other = min(m["energy_score"] for m in one["models"].values() if m is not mine)
        print(f"{floor:14} energy {1000 * mine['energy_score']:.1f}, other {1000 * other:.1f} mm")
