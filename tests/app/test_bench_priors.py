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
        if verdict == "fixed":
            number = {"value": ends, "std": None, "interval90": None, "verdict": verdict}
        else:
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
    choices, _ = priors_of(tmp_path, {name: ("identified", ends) for name, ends in ENDS.items()})
    assert [c.pattern for c in choices] == [f"motor.{name}" for name in ENDS]
    for name, ends in ENDS.items():
        np.testing.assert_allclose(interval_of(f"motor.{name}", choices), ends, rtol=1e-9)


def test_a_weak_number_is_known_to_10_percent_at_best(tmp_path):
    """A misfit or a better rival makes a narrow interval weak, without the truth."""
    narrow, wide = (0.051, 0.052), (0.7, 1.3)
    choices, _ = priors_of(tmp_path, {"back_emf": ("weak", narrow), "resistance": ("weak", wide)})
    low, high = interval_of("motor.back_emf", choices)
    assert np.log(high / low) / (2 * Z95) == pytest.approx(0.1)
    assert np.sqrt(low * high) == pytest.approx(np.sqrt(narrow[0] * narrow[1]))
    np.testing.assert_allclose(interval_of("motor.resistance", choices), wide, rtol=1e-9)


@pytest.mark.parametrize("verdict", ["not_identified", "at_bound", "fixed"])
def test_what_a_bench_does_not_identify_is_not_taken(tmp_path, verdict):
    lost = 0.05 if verdict == "fixed" else (0.1, 0.2)
    numbers = {"resistance": ("identified", (0.1, 0.2)), "back_emf": (verdict, lost)}
    choices, lines = priors_of(tmp_path, numbers)
    assert [c.pattern for c in choices] == ["motor.resistance"]
    assert "not identified there: back_emf, brush_drop" in lines[-1]


@pytest.mark.parametrize(
    ("drop", "known"), [(("weak", (0.2, 0.45)), True), (("not_identified", (1e-4, 0.1)), False)]
)
def test_a_drop_of_the_brushes_has_the_curve_with_which_it_was_fitted(tmp_path, drop, known):
    curve = {"brush_current": ("not_identified", (0.1, 0.9)), "brush_shape": ("fixed", 0.3)}
    choices, _ = priors_of(tmp_path, {"brush_drop": drop, **curve})
    assert [c.pattern for c in choices] == [f"motor.{k}" for k in ("brush_drop", *curve) if known]
    if known:
        np.testing.assert_allclose(interval_of("motor.brush_current", choices), (0.1, 0.9))
        assert choices[-1].fixed == 0.3


@pytest.mark.parametrize(("volts", "known"), [(0.4, True), (1e-9, False)])
def test_a_drop_that_a_bench_fixed_stays_fixed(tmp_path, volts, known):
    numbers = {"brush_drop": ("fixed", volts), "brush_current": ("fixed", 0.02)}
    choices, _ = priors_of(tmp_path, numbers)
    assert [c.fixed for c in choices] == ([volts, 0.02] if known else [])


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


@pytest.mark.parametrize(
    ("name", "value", "ends", "message"),
    [
        ("resistance", 1.0, (0.0, 1.0), "interval from 0.0 to 1.0"),
        ("resistance", 1.0, (-1.0, 1.0), "interval from -1.0 to 1.0"),
        ("resistance", 1.0, (2.0, 1.0), "interval from 2.0 to 1.0"),
        ("resistance", 1.0, (1.0,), "not enough values"),
        ("resistance", 1.0, None, "no interval"),
        ("resistance", 1.0, (1.0, 1e19), r"1e\+19; expected a number from"),
        ("resistance", 1.0, (1.0, None), "None; expected a number from"),
        ("resistance", None, (0.5, 1.0), "None; expected a number from"),
        ("resistance", 1e19, (0.5, 1.0), r"1e\+19; expected a number from"),
        ("brush_shape", 0.5, (0.5, 3.0), "interval from 0.5 to 3.0"),
    ],
)
def test_a_number_or_interval_that_is_none_is_refused(tmp_path, name, value, ends, message):
    number = {"value": value, "verdict": "weak", "interval90": ends}
    content = {f"motor.{name}": number}
    text = {"schema": "slipid.identified/1", "drive": "motor", "parameters": content}
    (tmp_path / "motor.json").write_text(json.dumps(text))
    with pytest.raises(DataError, match=rf"motor.json: damaged \(motor.{name}: .*{message}"):
        bench_priors(parsed(tmp_path / "robot.toml", ROBOT), 16.0)
