"""Priors of a robot's motor are the intervals of its bench."""

from __future__ import annotations

import json

import numpy as np
import pytest

from slipid.app.bench_priors import bench_priors
from slipid.app.config import parsed
from slipid.infer.verdicts.estimates import Z95
from slipid.model.geometry import omni
from slipid.model.robot import build
from slipid.search_space import Space
from slipid.support.errors import DataError

ROBOT = """
[robot]
drive = "omni"
wheel_radius_m = 0.04
base_radius_m = 0.125
wheel_azimuths_deg = [60, 180, 300]
gear_ratio = 16
motor = "motor.json"
[[logs]]
glob = "*.csv"
format = "robotino2022"
"""
ENDS = {
    "resistance": (0.7, 1.1),
    "back_emf": (0.051, 0.052),
    "brush_drop": (0.2, 0.45),
    "brush_current": (0.01, 0.3),
    "brush_shape": (0.1, 0.9),
    "brush_tail": (0.01, 0.5),
}
"""Intervals of a bench, some of them not symmetric about the value."""


def priors_of(folder, numbers):
    """Choices and lines of a robot whose bench has the given verdicts and intervals."""
    content = {"schema": "slipid.identified/1", "drive": "motor", "parameters": {}}
    for path, (verdict, ends) in numbers.items():
        number = {"value": ends[0], "std": 1e-9, "interval90": ends, "verdict": verdict}
        content["parameters"][f"motor.{path}"] = number
    (folder / "motor.json").write_text(json.dumps(content))
    return bench_priors(parsed(folder / "robot.toml", ROBOT), 16.0)


def interval_of(path, choices):
    """90 % interval of the prior of a parameter in the search space of a robot."""
    space = Space(build(omni([60.0, 180.0, 300.0], 0.125, 0.04, 16.0), ["a"]), choices)
    (entry,) = (e for e in space.free if e.path == path)
    at = space.slices[path]
    ends = space.prior_mean[at] + Z95 * np.array([-1.0, 1.0]) * space.prior_std[at]
    return entry.declaration.to_si(ends)


def test_intervals_of_a_bench_become_those_of_priors(tmp_path):
    choices, _ = priors_of(tmp_path, {name: ("weak", ends) for name, ends in ENDS.items()})
    assert [c.pattern for c in choices] == [f"motor.{name}" for name in ENDS]
    for name, ends in ENDS.items():
        found = interval_of(f"motor.{name}", choices)
        if name == "brush_drop":
            # A normal distribution has the same width, about the centre of the logarithms.
            assert found[1] - found[0] == pytest.approx(ends[1] - ends[0])
            assert found.mean() == pytest.approx(0.3)
        else:
            np.testing.assert_allclose(found, ends, rtol=1e-9)


def test_what_a_bench_does_not_identify_is_not_taken(tmp_path):
    verdicts = ("identified", "not_identified", "weak", "at_bound", "fixed")
    numbers = dict(zip(ENDS, ((v, (0.1, 0.2)) for v in verdicts), strict=False))
    numbers["brush_current"] = ("fixed", None)
    choices, lines = priors_of(tmp_path, {k: v for k, v in numbers.items() if v[1]})
    assert [c.pattern for c in choices] == ["motor.resistance", "motor.brush_drop"]
    assert "not identified there: back_emf, brush_current, brush_shape" in lines[-1]


def test_motors_that_differ_widen_the_prior_of_one(tmp_path):
    alike, differing = (
        priors_of(
            tmp_path,
            {f"resistance@{k}": ("identified", (low, 1.1 * low)) for k, low in enumerate(values)},
        )[0]
        for values in ((1.0, 1.0), (1.0, 1.5))
    )
    one, other = (interval_of("motor.resistance", c) for c in (alike, differing))
    np.testing.assert_allclose(one, (1.0, 1.1), rtol=1e-9)
    log = np.log([1.0, 1.5])
    std = np.hypot(log.std(ddof=1), np.log(1.1) / (2 * Z95))
    centre = log.mean() + np.log(1.1) / 2
    np.testing.assert_allclose(np.log(other), centre + Z95 * std * np.array([-1, 1]), rtol=1e-9)


def test_friction_behind_a_gear_is_known_to_30_percent(tmp_path):
    choices, _ = priors_of(tmp_path, {"coulomb_friction": ("identified", (0.004, 0.004004))})
    low, high = interval_of("motor.coulomb_friction", choices)
    assert np.sqrt(low * high) == pytest.approx(16 * 0.004002, rel=1e-6)
    assert np.log(high / low) / (2 * Z95) == pytest.approx(0.3, rel=1e-3)


@pytest.mark.parametrize("ends", [(0.0, 1.0), (-1.0, 1.0), (2.0, 1.0), (1.0,), None])
def test_an_interval_that_is_none_is_refused(tmp_path, ends):
    content = {"motor.resistance": {"verdict": "weak", "interval90": ends}}
    text = {"schema": "slipid.identified/1", "drive": "motor", "parameters": content}
    (tmp_path / "motor.json").write_text(json.dumps(text))
    with pytest.raises(DataError, match=r"motor.json: damaged"):
        bench_priors(parsed(tmp_path / "robot.toml", ROBOT), 16.0)
