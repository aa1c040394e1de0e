"""Reference robots: the shipped files, what the loader refuses, and numbers for comparison."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from configs.robots.derive import ROBOTS, WORST_FIRST, derive
from slipid.app.config import BenchMotors, read_config
from slipid.app.logs import packaged_path
from slipid.app.problem import read_fit_task
from slipid.app.reference_robots import (
    ReferenceRobot,
    read_reference,
    reference_bands,
    reference_names,
    reference_robot,
    reference_robots,
)
from slipid.support.errors import DataError
from slipid.support.files import json_text, read_json
from slipid.support.progress import Reporter

FOLDER = packaged_path("robots")
KEYS = {
    *("schema", "name", "about", "drive", "nominal", "trust", "notes", "floors", "numbers"),
    *("source", "origin"),
}
SAME = 2e-3
"""Relative tolerance of numbers: the end of a fit depends on how code is compiled."""
CHAIN = 0.25
"""Tolerance of the ends of intervals, as a fraction of the width: they are those of the short chain
of `slipid identify`, whose course depends on the last bits and whose widths are within 14 %."""
TWO_OPTIMA = ("warthog",)
"""Robots whose force balance has two optima: in which one a fit ends depends on the last bits."""


def test_every_robot_of_the_script_is_shipped_and_no_other():
    assert reference_names() == tuple(sorted(ROBOTS))
    assert set(reference_names()) >= {"husky", "omni3", "robotino", "robotino_motor", "warthog"}


@pytest.mark.parametrize("name", sorted(ROBOTS))
def test_a_shipped_file_is_whole(name):
    path = FOLDER / f"{name}.json"
    text = path.read_text(encoding="utf-8")
    content = json.loads(text)
    assert content.keys() == KEYS
    assert content["schema"] == "slipid.reference/1"
    assert json_text(read_reference(path).to_json()) == text
    one = reference_robot(name)
    assert one.name == name
    assert one.source.licence in ("Apache-2.0", "BSD-3-Clause", "MIT")
    assert one.source.url.startswith("https://github.com/")
    assert len(one.source.data_hash) == 64
    assert (path.parents[1] / one.origin.config).is_file()
    assert len(text) < 20_000  # derived numbers alone


@pytest.mark.parametrize("name", sorted(ROBOTS))
def test_numbers_lie_in_their_intervals_and_models_in_order(name):
    one = reference_robot(name)
    for path, number in one.numbers.items():
        low, high = np.moveaxis(np.asarray(number.interval90), -1, 0)
        assert np.shape(number.value) == low.shape, path
        assert (low <= number.value).all(), path
        assert (number.value <= high).all(), path
    for floor in one.floors.values():
        errors = floor.error_over_path
        assert errors["selected"] == errors[floor.selected]
        assert errors["selected"] < errors["nominal"]
        assert floor.held_out
    assert (one.drive == "motor") == (not one.floors)


def test_sizes_and_multipliers_agree_with_lengths():
    for one in reference_robots():
        for floor in one.floors:
            radii = one.numbers[f"calibration.surfaces.{floor}.rolling_radius_m"].value
            expected = np.mean(radii) / one.nominal["wheel_radius_m"]
            assert one.multiplier("wheel_radius", floor) == pytest.approx(expected, rel=1e-4)
    assert reference_robot("husky").multiplier("track", "wet_grass") > 1.5
    assert reference_robot("robotino").multiplier("track", "gray") is None  # straight runs


def broken(tmp_path: Path, **changes: object) -> Path:
    content = read_json(FOLDER / "husky.json", "a file") | changes
    path = tmp_path / "mine.json"
    path.write_text(json.dumps({k: v for k, v in content.items() if v is not None}))
    return path


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"schema": "slipid.reference/9"}, r"schema: 'slipid.reference/9'; expected one of"),
        ({"weight": 3}, r"weight: no such key; expected one of schema, name"),
        ({"floors": None}, r"floors: missing; expected a value"),
        ({"floors": {"mud": {"runs": 0}}}, r"floors\.mud\.runs: 0; expected: input should be"),
        ({"numbers": {"a": {"value": "x"}}}, r"numbers\.a\.unit: missing"),
    ],
)
def test_a_damaged_file_is_refused_with_its_key(tmp_path, changes, error):
    path = broken(tmp_path, **changes)
    with pytest.raises(DataError, match=error) as caught:
        read_reference(path)
    assert str(path) in str(caught.value)


def test_what_is_no_file_or_no_json_is_refused(tmp_path):
    with pytest.raises(DataError, match=r"none\.json: No such file"):
        read_reference(tmp_path / "none.json")
    (tmp_path / "text.json").write_text("robot")
    with pytest.raises(DataError, match="not valid JSON"):
        read_reference(tmp_path / "text.json")


def test_an_unknown_name_is_refused_with_the_choices():
    with pytest.raises(DataError, match=r"'roboton', did you mean robotino.*one of husky, omni3"):
        reference_robot("roboton")


def test_bands_are_those_of_robots_with_similar_wheels():
    creep = reference_bands("mecanum", "surface.*.creep")
    assert {(band.robot, band.floor) for band in creep} == {
        ("robotino", floor) for floor in ("brown", "gray", "green", "table")
    }
    for band in creep:
        low, high = band.interval90
        assert low < band.value < high
        assert band.unit == "1"
    assert {band.robot for band in reference_bands("differential", "surface.*.creep")} == {
        "warthog"  # Husky's logs do not determine it
    }
    assert reference_bands("steered", "surface.*.creep") == ()
    assert reference_bands("omni", "surface.*.cree") == ()


def test_bands_of_errors_and_multipliers():
    errors = reference_bands("skid", "trust.held_out_error_over_path.*.selected")
    assert [(b.robot, b.floor) for b in errors] == [
        ("husky", "wet_grass"),
        ("warthog", "asphalt"),
        ("warthog", "grass"),
    ]
    assert all(b.verdict == "held-out" and b.interval90 is None for b in errors)
    nominal = reference_bands("skid", "trust.held_out_error_over_path.*.nominal")
    assert all(a.value < b.value for a, b in zip(errors, nominal, strict=True))
    track = reference_bands("skid", "calibration.multipliers.*.track")
    assert {b.robot for b in track} == {"husky", "warthog"}
    assert all(1.5 < b.value < 2.1 for b in track)


def test_numbers_of_a_bench_stand_beside_those_of_benches_alone():
    path = "motor.coulomb_friction/motor.back_emf"
    (wheeled,) = reference_bands("omni", path)
    assert (wheeled.robot, wheeled.floor) == ("robotino", "")
    bench = reference_bands("motor", "motor.coulomb_friction@*/motor.back_emf@1")
    assert [band.robot for band in bench] == ["robotino_motor"]


def rederived(name: str, real_data: Path, out: Path) -> ReferenceRobot:
    """The robot from the public logs; the test is skipped if the folder has other logs."""
    shipped, report = reference_robot(name), Reporter(quiet=True)
    config = read_config(FOLDER.parent / ROBOTS[name].config)
    if not isinstance(config.content.robot, BenchMotors):
        found = read_fit_task(config, real_data / ROBOTS[name].folder, report).data_hash
        if found != shipped.source.data_hash:
            pytest.skip(f"{real_data / ROBOTS[name].folder} has other logs than those of {name}")
    return derive(name, real_data, out, report)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if "motor" in name else pytest.mark.nightly)
        for name in sorted(ROBOTS)
    ],
)
def test_public_logs_give_the_shipped_numbers(name, real_data, tmp_path):
    found, shipped = rederived(name, real_data, tmp_path), reference_robot(name)
    assert replace(found, numbers={}, floors={}, origin=shipped.origin) == replace(
        shipped, numbers={}, floors={}
    )
    assert found.origin.command == shipped.origin.command
    assert found.numbers.keys() == shipped.numbers.keys()
    for path, number in shipped.numbers.items():
        if name in TWO_OPTIMA and not path.startswith("calibration."):
            continue
        new, ends = found.numbers[path], np.asarray(number.interval90)
        apart = abs(WORST_FIRST.index(new.verdict) - WORST_FIRST.index(number.verdict))
        assert new.unit == number.unit, path
        assert apart <= 1, path
        width = float(np.ptp(ends, axis=-1).max())
        np.testing.assert_allclose(
            new.value, number.value, rtol=SAME, atol=0.01 * width, err_msg=path
        )
        np.testing.assert_allclose(new.interval90, ends, atol=CHAIN * width, err_msg=path)
    for floor, one in shipped.floors.items():
        again, errors = found.floors[floor], one.error_over_path
        same = (again.runs, again.held_out, again.selected)
        assert same == (one.runs, one.held_out, one.selected)
        assert again.error_over_path.keys() == errors.keys()
        for model, error in errors.items():
            used = one.selected if model == "selected" else model
            loose = name in TWO_OPTIMA and used == "contact"
            assert again.error_over_path[model] == pytest.approx(error, rel=0.1 if loose else SAME)
