"""Unseen real runs through the deployed estimator, floor unknown, from numbers fitted elsewhere."""

from __future__ import annotations

import json
from glob import escape
from pathlib import Path

import numpy as np
import pytest

from slipid.control.estimator import Estimator
from slipid.control.frozen import freeze
from slipid.data.dataset import Dataset, collect
from slipid.data.formats import preset
from slipid.data.reader import read_log
from slipid.model.geometry import omni
from slipid.model.robot import Robot, build
from slipid.parameter import Choice, Space
from tests import replayed

FIT = Path(__file__).with_name("robotino2022_sectors.json")
"""Numbers of a fit that has seen no heading of 0 to 60 deg."""
pytestmark = pytest.mark.slow  # compiles the estimator of 64 hypotheses


@pytest.fixture(scope="module")
def robot() -> Robot:
    kept = json.loads(FIT.read_text())
    shape = omni([60.0, 180.0, 300.0], 0.125, 0.040, gear_ratio=16.0)
    bare = build(shape, kept["surfaces"], kept["loads"], kept["sessions"], tuple(kept["centre"]))
    fixed = [Choice(escape(path), fixed=value) for path, value in kept["values"].items()]
    return Space(bare, fixed).template


@pytest.fixture(scope="module")
def data(real_data: Path) -> Dataset:
    """Eight runs on each floor at 0.1 m/s, 0 to 40 deg: the worst sixth on carpets."""
    folder = real_data / "robotino2022" / "one_surface"
    paths = sorted(folder.glob("*/exp0[0-8].csv"))
    layout = preset("robotino2022")
    return collect([read_log(p, layout, root=folder, surface=p.parent.name) for p in paths])


@pytest.fixture(scope="module")
def rows(robot: Robot, data: Dataset) -> list[replayed.Judged]:
    kept = json.loads(FIT.read_text())
    std, trend = kept["std"], tuple(kept["current_trend"])
    frozen = freeze(robot, "as_built", std, highest_speed=8.0, current_trend=trend)
    est = Estimator(frozen)
    said = replayed.replay(est, data.logs)
    noise = {name: value**2 for name, value in std.items()}
    return replayed.judged(robot, est.frozen.labels, data, said, noise)


def test_floors_are_recognised_within_a_second(rows: list[replayed.Judged]) -> None:
    assert len(rows) >= 20
    assert np.mean([r.told == r.surface for r in rows]) > 0.85


@pytest.mark.parametrize(
    ("floor", "most"), [("table", 0.02), ("brown", 0.04), ("gray", 0.17), ("green", 0.40)]
)
def test_end_points_are_predicted(rows: list[replayed.Judged], floor: str, most: float) -> None:
    some = [r for r in rows if r.surface == floor]
    error, straight = (np.mean([getattr(r, k) for r in some]) for k in ("error", "straight"))
    assert error < most
    assert floor in ("table", "brown") or error < 0.7 * straight


def test_regions_are_not_too_narrow(rows: list[replayed.Judged]) -> None:
    assert np.mean([r.level <= 0.9 for r in rows]) > 0.6
