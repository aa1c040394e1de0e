"""Sections of a page, of made contents of a result folder."""

import hashlib
import json
import os

import numpy as np
import pytest

from slipid.app.logs import log_folder
from slipid.app.reference_robots import reference_robot
from slipid.exports.feedforward import gains_json
from slipid.infer.verdicts.disputed import LoadComparison
from slipid.model.feedforward import Feedforward, Gain
from slipid.report.html import results
from slipid.report.html.blocks import CopyLines, FigureBlock, TableBlock, TextBlock
from slipid.report.html.evidence import FitEvidence, Quarters, write_evidence
from slipid.report.html.fit_page import fit_page
from slipid.report.html.later_content import COMMANDS, LATER
from slipid.report.html.results import read_results
from slipid.report.html.sections.predictions import _played
from slipid.support.errors import DataError
from tests.helpers import later_files


def value(x, half, verdict="identified", unit="m"):
    interval = [x - half, x + half]
    return {"value": x, "interval90": interval, "std": half / 1.6, "verdict": verdict, "unit": unit}


CONFIG = b'[robot]\ndrive = "differential"\n'
CALIBRATION = {
    "surfaces": {
        "wood": {
            "rolling_radius_m": [value(0.0497, 1e-4), value(0.0504, 1e-4)],
            "effective_track_m": value(0.312, 0.2, "not_identified"),
        }
    },
    "centre_of_rotation_m": {},
    "pose_offset_m": [value(0.06, 0.001), value(0.0, 0.001)],
    "pose_yaw_rad": value(0.01, 0.005, unit="rad"),
    "pose_session_yaw_rad": {},
    "pose_lag_s": value(0.08, 0.004, unit="s"),
    "pose_scale": value(1.0, 0.0, "fixed", "1"),
    "multipliers": {"wood": {"wheel_radius": [0.994, 1.008], "track": 1.04}},
    "nominal": {"wheel_radius_m": 0.05, "track_m": 0.3},
    "firmest": "wood",
    "noise": {
        "place": 0.001,
        "heading": 0.003,
        "process": {"wood": [0.0] * 3},
        "effect": {"wood": [0.0] * 3},
    },
    "runs": 6,
    "settled": True,
}


def parameter(x, interval, verdict, ratio, unit="1"):
    shared = {"unit": unit, "shape": [], "labels": [], "std": 0.1, "source": "laplace"}
    prior = {"doc": "", "ratio": ratio, "pull": 0.0, "prior_mean": 0.4, "prior_std": 0.2}
    own = {"value": x, "interval90": interval, "verdict": verdict, "provenance": "measured"}
    return shared | prior | own


@pytest.fixture
def folder(tmp_path):
    """A folder of a differential robot with a force balance, selected on no floor."""
    parameters = {
        "motor.resistance": parameter(1.2, [1.1, 1.3], "identified", 0.1, "ohm"),
        "surface.wood.friction": parameter(9.2, [1.5, 57.0], "not_identified", 4.0),
        "camera.lag": parameter(0.05, [0.04, 0.06], "identified", 0.2, "s"),
    }
    errors = {"nominal": 0.05, "calibrated": 0.004, "contact": 0.02}
    trust = {
        "verdict": "not to be trusted",
        "reasons": ["surface.wood.friction = 9.2; plausible values are 0.005 to 5"],
        "notes": [f"note {k}" for k in range(8)],
        "runs": {"wood": 6},
        "held_out": {"wood": True},
        "held_out_error_over_path": {"wood": errors},
    }
    identified = {
        "schema": "slipid.identified/1",
        "parameters": parameters,
        "derived": {},
        "surfaces": ["wood"],
        "curves": {},
        "validity": {},
        "messages": [],
        "calibration": CALIBRATION,
        "selected_model": {"wood": "calibrated"},
        "trust": trust,
        "data": {"hash": "ab" * 32, "runs": ["wood/0.csv"]},
    }
    run = {
        "schema": "slipid.run/1",
        "finished": "2026-01-01T00:00:00+00:00",
        "seconds": 9.0,
        "config": {"name": "robot.toml", "sha256": hashlib.sha256(CONFIG).hexdigest()},
        "data": {"folder": "logs", "hash": "ab" * 32, "logs": {"wood/0.csv": "e"}, "skipped": []},
        "versions": {"slipid": "0"},
    }
    flat = {
        "paths": ["surface.wood.friction"],
        "formula": "the data have almost no information about surface.wood.friction",
        "remedy": "drive there loaded unevenly",
    }
    behind = {"nominal": [0.046, 0.01], "calibrated": [0.0, 0.0], "contact": [0.016, 0.02]}
    fit = {
        "parameters": parameters,
        "settings": {},
        "flat": [flat],
        "selection": {"wood": {"behind": behind}},
        "converged": True,
        "reason": "no parameter changed",
    }
    for name, content in (("identified", identified), ("run", run), ("fit", fit)):
        (tmp_path / f"{name}.json").write_text(json.dumps(content))
    (tmp_path / "config.toml").write_bytes(CONFIG)
    (tmp_path / "robot.json").write_text("{}")
    return tmp_path


def page_of(folder):
    """Blocks of every section of the page of a folder, keyed by the section's name."""
    return {s.name: list(s.blocks) for s in fit_page(read_results(folder)).sections}


def words(blocks):
    return " ".join(" ".join(b.sentences) for b in blocks if isinstance(b, TextBlock))


def changed(folder, name, path, value):
    """Replace a value of a JSON file by another one, or remove it if the value is `...`."""
    file = folder / f"{name}.json"
    content = json.loads(file.read_text())
    place = content
    for key in path[:-1]:
        place = place[key]
    if value is ...:
        del place[path[-1]]
    else:
        place[path[-1]] = value
    file.write_text(json.dumps(content))


DAMAGED = [
    ("identified", ("schema",), "x/1", "schema: 'x/1'; expected"),
    ("identified", ("parameters",), ..., "parameters: missing"),
    ("identified", ("parameters", "camera.lag", "value"), "x", "value: 'x'; expected"),
    ("identified", ("parameters", "camera.lag", "interval90"), [1.0], "interval90"),
    ("identified", ("parameters", "camera.lag", "labels"), ["a", "b"], "with 2 labels"),
    ("identified", ("parameters", "camera.lag", "verdict"), "sure", "verdict: 'sure'; expected"),
    ("identified", ("curves",), {"wood": {}}, "curves.wood.torque_nm: missing"),
    ("identified", ("data",), [], r"data: \[\]; expected"),
    ("identified", ("trust", "reasons"), 3, "trust.reasons: 3; expected"),
    ("identified", ("calibration", "surfaces", "wood"), {}, "rolling_radius_m: missing"),
    ("identified", ("calibration", "nominal", "track_m"), ..., "other floors or lengths"),
    ("identified", ("calibration", "firmest"), "ice", "other floors or lengths"),
    ("identified", ("calibration", "pose_lag_s"), 7, "pose_lag_s: 7; expected"),
    ("identified", ("calibration", "surfaces", "wood", "rolling_radius_m"), [], "no positive"),
    ("identified", ("feedforward",), {"left": {"kV": None}}, "feedforward.left.kV: None"),
    ("identified", ("feedback",), {"left": {"x_kP": 3}}, "feedback.left"),
    ("identified", ("selected_model",), {}, "'wood' has errors, but no selected model"),
    ("identified", ("selected_model", "wood"), "x", "the model selected on 'wood' has no errors"),
    ("run", ("config",), ..., "config: missing"),
    ("run", ("data", "folder"), 3.0, "data.folder: 3.0; expected"),
    ("run", ("versions",), [], "versions"),
    ("fit", ("parameters", "camera.lag", "prior_std"), "x", "prior_std"),
    ("fit", ("flat",), [{}], r"flat\[1\].paths: missing"),
]


@pytest.mark.parametrize(("name", "path", "value", "message"), DAMAGED)
def test_a_damaged_result_is_refused_with_its_key(folder, name, path, value, message):
    changed(folder, name, path, value)
    with pytest.raises(DataError, match=message) as caught:
        read_results(folder)
    assert str(caught.value).startswith(str(folder / f"{name}.json: "))
    assert str(caught.value).endswith("; run `slipid identify` again")


@pytest.mark.parametrize("name", LATER)
@pytest.mark.parametrize("content", [{}, {"runs": 3}, {"summary": {}, "questions": {"a": 1}}])
def test_a_damaged_result_of_another_command_is_refused(folder, name, content):
    (folder / f"{name}.json").write_text(json.dumps(content))
    command = COMMANDS.get(name, name)
    with pytest.raises(DataError, match=rf"{name}\.json: .*; run `slipid {command}` again$"):
        read_results(folder)


@pytest.mark.parametrize("value", [{}, {"data": {}}, {"data": {"folder": 5.5}}, [], "x"])
def test_logs_are_not_sought_by_a_damaged_run_file(folder, value):
    (folder / "run.json").write_text(json.dumps(value))
    with pytest.raises(DataError, match=r"run\.json: .*; run `slipid identify` again"):
        log_folder(folder, None)
    (folder / "run.json").write_text("[" * 10_000)
    with pytest.raises(DataError, match=r"run\.json: not valid JSON"):
        log_folder(folder, None)
    assert log_folder(folder, folder) == folder


def posterior_file(path, lag):
    h5py = pytest.importorskip("h5py", reason="draws need the extra posterior")
    with h5py.File(path, "w") as file:
        group = file.create_group("posterior")
        group["surface"] = np.array([b"wood"])
        group["camera.lag"] = lag
        group["surface.friction"] = np.ones((2, 5, 1))
    sealed(path)


def sample_content(posterior):
    worst = {"r_hat": 1.1, "effective_draws": 40.0, "steps_per_tau": 9.0}
    about = {"converged": False, "reason": "40 effective draws", "worst": worst}
    mark = hashlib.sha256(posterior).hexdigest()
    return about | {"ensembles": 4, "walkers": 8, "steps": 100, "posterior_sha256": mark}


def sealed(path):
    """Write a sample.json with the hash of a posterior.nc."""
    content = json.dumps(sample_content(path.read_bytes()))
    path.with_name("sample.json").write_text(content)


DRAWS = np.linspace(0.0, 1.0, 10).reshape(2, 5)
HOSTILE_DRAWS = [
    np.full((2, 5), np.nan),
    np.ones((2, 6)),
    np.zeros((0, 5)),
]


@pytest.mark.parametrize("lag", HOSTILE_DRAWS)
def test_draws_that_are_none_are_refused(folder, lag):
    posterior_file(folder / "posterior.nc", DRAWS)
    found = read_results(folder).draws
    np.testing.assert_array_equal(found["camera.lag"], DRAWS.ravel())
    assert found["surface.wood.friction"].shape == (10,)
    posterior_file(folder / "posterior.nc", lag)
    with pytest.raises(DataError, match=r"posterior\.nc: .* draws of parameters, or not finite"):
        read_results(folder)


def test_a_damaged_file_of_draws_is_refused(folder, monkeypatch):
    path = folder / "posterior.nc"
    posterior_file(path, DRAWS)
    whole = path.read_bytes()
    monkeypatch.setattr(results, "MOST_NUMBERS", 20)
    with pytest.raises(DataError, match=r"posterior\.nc: over 20 numbers"):
        read_results(folder)
    for damaged in (whole[:300], b"x" * 900, whole.replace(b"surface\0", b"surfacf\0")):
        path.write_bytes(damaged)
        with pytest.raises(DataError, match=r"posterior\.nc: damaged, or of a different chain"):
            read_results(folder)
        sealed(path)
        with pytest.raises(DataError, match=r"posterior\.nc: cannot be read .* run it again"):
            read_results(folder)


def test_the_verdict_stands_first_with_its_reasons_and_at_most_five_notes(folder):
    page = fit_page(read_results(folder))
    assert page.badge is not None
    assert (page.sections[0].name, page.badge.text) == ("verdict", "not to be trusted")
    shown = words(page.sections[0].blocks)
    assert "Do not deploy" in shown
    assert "9.2; plausible" in shown
    assert "note 4" in shown
    assert "note 5" not in shown
    assert "note 5" in words(page_of(folder)["data"])
    assert "Files to deploy" not in words(page_of(folder)["provenance"])


def test_numbers_that_the_logs_do_not_determine_are_remarks_in_what_is_copied(folder):
    (code,) = (b for b in page_of(folder)["numbers"] if isinstance(b, CopyLines))
    lines = code.text.splitlines()
    assert "left_wheel_radius_m: 0.04970  # 0.04960 to 0.04980" in lines
    assert any(line.startswith("# effective_track_m") for line in lines)
    assert "# wheel_separation_multiplier: 1.04000" in lines
    assert any("off by 0.4 % of the path" in line for line in lines)
    live = [line for line in lines if line and not line.startswith("#")]
    assert all("not identified" not in line for line in live)


def test_gains_of_a_robot_have_a_section(folder):
    assert "feedforward" not in page_of(folder)
    identified = json.loads((folder / "identified.json").read_text())
    parts = (Gain.of(1.0, 0.1, unit, "weak") for unit in ("V", "V*s/rad", "V*s^2/rad"))
    identified |= gains_json([Feedforward("linear", *parts, radius=0.05)])
    (folder / "identified.json").write_text(json.dumps(identified))
    blocks = page_of(folder)["feedforward"]
    (table,) = (b for b in blocks if isinstance(b, TableBlock))
    name, value, unit, ends, word, rotation, metre = table.rows[1]
    assert (name, value, unit, word.text) == ("linear: kV", "1.00", "V*s/rad", "weak")
    assert (ends, rotation, metre) == ("0.85 to 1.18", "6.3", "20.0")
    assert "Feedback of linear: velocity loop kP" in words(blocks)


def test_values_say_what_was_learnt_what_to_do_and_what_is_measured_twice(folder):
    blocks = page_of(folder)["values"]
    rows = {r[0]: r for b in blocks if isinstance(b, TableBlock) for r in b.rows}
    assert rows["surface.wood.friction"][3] == "wider than the prior"
    assert rows["motor.resistance"][1:4] == ("1.20", "ohm", "1.10 to 1.30")
    shown = words(blocks)
    assert "on wood: drive loaded unevenly: for surface.wood.friction" in shown
    assert "lag of the poses: 0.0800 s (0.0760 to 0.0840) by the calibrated kinematics" in shown
    (figure,) = (b for b in blocks if isinstance(b, FigureBlock))
    assert figure.title == "The logs determine 2 of 3 parameters"


def test_errors_stand_beside_those_of_every_simpler_model(folder):
    figure, table = page_of(folder)["errors"]
    assert figure.title == "wood: calibrated kinematics off by 0.4 %, the config's lengths by 5 %"
    assert [row[1] for row in table.rows] == [
        "lengths of the config",
        "calibrated kinematics",
        "force balance",
    ]
    assert table.rows[2][3] == "+1.60 ± 3.29"


def test_a_trial_of_few_starts_has_no_intervals(folder):
    row = later_files.LATER["trial"]["summary"]["encoder"]
    few = row | {"interval90": dict.fromkeys(row["interval90"])}
    for summary, words in ((row, "with 90 % intervals"), (few, "too few for intervals")):
        content = later_files.LATER["trial"] | {"summary": {"encoder": summary}}
        (folder / "trial.json").write_text(json.dumps(content))
        figure, _ = page_of(folder)["trial"]
        assert words in figure.caption


def test_a_page_has_no_section_without_content(folder):
    sections = page_of(folder)
    assert not {"paths", "currents", "loads", "slip", "posterior", "trial", "design"} & set(
        sections
    )
    assert all(blocks for blocks in sections.values())


def driven(speeds, slope):
    """Evidence of straight runs whose error along the motion grows with speed."""
    runs, columns = [], {name: [] for name in Quarters.model_fields}
    for k, speed in enumerate(speeds):
        x = [round(250 * speed * n) for n in range(5)]
        track = {"x_mm": x, "y_mm": [0] * 5, "yaw_mrad": [0] * 5}
        off = {**track, "x_mm": [a + 30 * n for n, a in enumerate(x)]}
        run = {"name": f"{k}.csv", "floor": "wood", "load": "as_built", "heading_deg": 0.0}
        run |= {
            "speed": speed,
            "seconds": 1.0,
            "rest_s": 2.0,
            "path_m": speed,
            "selected": "nominal",
        }
        regions = {"edge": [4], "angle_mrad": [0], "major_mm": [125.0 - 10 * k], "minor_mm": [5.0]}
        run |= {"time_s": [0.25 * n for n in range(5)], "measured": track, "region": regions}
        runs.append({**run, "models": {"nominal": off}})
        for n in range(4):
            error = slope * speed + 0.1 * (-1) ** n
            row = {"run": k, "time_s": 0.25 * n, "seconds": 0.25, "speed": speed, "turn_deg_s": 0.0}
            row |= {"heading_deg": 0.0, "along_mm_s": error, "across_mm_s": 0.0, "yaw_deg_s": 0.0}
            for name, value in row.items():
                columns[name].append(value)
    shape = {"place_m": [(0.0, 0.15), (0.0, -0.15)], "angle_deg": [0.0, 0.0], "drive": [0, 1]}
    wheels = {**shape, "radius_m": 0.05, "sideways": False}
    return FitEvidence(data_hash="ab" * 32, wheels=wheels, runs=runs, quarters=columns)


@pytest.mark.parametrize(
    ("slope", "trend"),
    [(9.0, "rises with speed on wood"), (-9.0, "falls with speed on wood"), (0.0, "no trend")],
)
def test_the_title_of_the_residuals_names_a_trend_where_there_is_one(folder, slope, trend):
    write_evidence(driven((0.1, 0.2, 0.3, 0.4), slope), folder)
    (figure,) = page_of(folder)["residuals"]
    assert trend in figure.title


def test_runs_that_end_inside_their_regions_are_counted(folder):
    """Ends are 120 mm off, along regions with half axes of 125, 115, 105 and 95 mm."""
    write_evidence(driven((0.1, 0.2, 0.3, 0.4), 0.0), folder)
    assert "1 of 4 end inside their region" in words(page_of(folder)["paths"])


def test_the_table_of_what_was_driven_is_that_of_two_wheels(folder):
    write_evidence(driven((0.1, 0.2), 0.0), folder)
    table = next(block for block in page_of(folder)["data"] if isinstance(block, TableBlock))
    assert "directions" not in table.head  # two wheels drive ahead or back
    assert dict(zip(table.head, table.rows[0], strict=True))["rest [s]"] == "4"


def test_the_loads_stand_beside_the_differences_that_would_have_been_seen(folder):
    write_evidence(driven((0.1, 0.2), 0.0), folder)
    ends = [[0.45, 0.55], [0.45, 0.55]]
    shares = parameter([0.5, 0.5], ends, "identified", 0.1) | {
        "labels": ["wheel 1", "wheel 2"],
        "std": [0.1] * 2,
    }
    one = LoadComparison(("wood", "rug"), 3.1, (0.06, 0.11)).to_json()
    other = LoadComparison(("wood", "tiles"), 0.2, (0.4, 0.3)).to_json()
    for name, more in (("identified", {}), ("fit", {"load_comparisons": [one, other]})):
        path = folder / f"{name}.json"
        content = json.loads(path.read_text()) | more
        content["parameters"]["robot.load_share@as_built"] = shares
        path.write_text(json.dumps(content))
    blocks = page_of(folder)["loads"]
    assert "A wheel's load that differed by 6 % between wood and rug would" in words(blocks)
    assert "would have been reported: between wood and tiles (30 %)" in words(blocks)
    (table,) = (block for block in blocks if isinstance(block, TableBlock))
    assert [tuple(row) for row in table.rows] == [
        ("wood and rug", "yes", "3.1", "6", "11"),
        ("wood and tiles", "no", "0.2", "40", "30"),
    ]


def test_a_command_that_changes_its_direction_is_not_shown_as_the_speed():
    straight = driven((0.2,), 0.0).runs[0]
    circle = straight.model_copy(update={"speed": 0.01})
    for run, shown in ((straight, 0.2), (circle, None)):
        assert _played(run)["speed"] == shown
    assert (_played(straight)["heading"], _played(circle)["heading"]) == (0.0, None)


def test_a_robot_is_not_compared_with_itself(folder):
    robots = {row[1].partition(",")[0] for row in page_of(folder)["others"][2].rows}
    assert {"husky", "warthog"} <= robots
    path = folder / "run.json"
    run = json.loads(path.read_text())
    run["data"]["hash"] = reference_robot("husky").source.data_hash
    path.write_text(json.dumps(run))
    robots = {row[1].partition(",")[0] for row in page_of(folder)["others"][2].rows}
    assert "husky" not in robots
    assert "warthog" in robots


def test_results_of_a_different_fit_are_left_out_whatever_their_times(folder):
    for name, mark in (("identified", "fit 2"), ("run", "fit 2"), ("trial", "fit 1")):
        path = folder / f"{name}.json"
        content = json.loads(path.read_text()) if path.exists() else {}
        path.write_text(json.dumps(content | {"fit": mark}))
    (folder / "design.json").write_text(
        json.dumps({"runs": [], "messages": [], "reachable": [], "fit": "fit 2"})
    )
    (folder / "comparison.json").write_text(json.dumps({"data": {"hash": "of other logs"}}))
    os.utime(folder / "design.json", (1e9, 1e9))  # the clock was set back
    found = read_results(folder)
    assert found.outdated == ("comparison", "trial")
    assert (found.trial, found.comparison, found.design is None) == (None, None, False)
    shown = words(page_of(folder)["data"])
    assert "Left out, as of a different fit: comparison.json and trial.json" in shown


def test_a_folder_with_files_of_two_fits_is_refused_with_what_to_do(folder):
    for name, mark in (("identified", "fit 2"), ("run", "fit 1")):
        path = folder / f"{name}.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | {"fit": mark}))
    with pytest.raises(DataError, match=r"run\.json: belongs to a different fit than .*again\)"):
        read_results(folder)
    (folder / "run.json").unlink()
    with pytest.raises(DataError, match=r"run\.json: missing, since .* interrupted; run `slipid"):
        read_results(folder)


def test_a_posterior_that_has_not_converged_is_a_warning_with_the_command_to_type(folder):
    (folder / "sample.json").write_text(json.dumps(sample_content(b"")))
    warnings = [b for b in page_of(folder)["verdict"] if getattr(b, "kind", "") == "warning"]
    assert f"slipid sample {folder.name} --most" in words(warnings)
