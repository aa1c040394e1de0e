"""Text of results: tables that fit 80 columns, a sentence below each, notes by their rank."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest
from rich.table import Table

from slipid.exports.feedforward import gains_json
from slipid.fitting.calibration.result import Calibration, MotionNoise, Value
from slipid.infer.verdicts.estimates import Estimate
from slipid.infer.verdicts.trust import Trust
from slipid.model.feedforward import Feedforward, Gain
from slipid.predict.selection import FloorSelection
from slipid.report import answers, calibration, checks, estimates, gains
from slipid.report.numbers import interval, rounded
from slipid.report.page import MOST_NOTES, WIDTH, Page, grouped, table

FLOORS = ("carpet_gray", "table")


class Kept(Page):
    """A page that keeps its tables, and in which order tables and sentences came."""

    def __init__(self):
        super().__init__(kept=True)
        self.tables: list[Table] = []
        self.order = ""

    def table(self, table):
        self.tables.append(table)
        self.order += "t"
        super().table(table)

    def line(self, text=""):
        self.order += "s" if text else ""


def estimate(path, value=0.1234567, **more):
    given = {"unit": "N*m*s/rad", "interval90": (0.05, 0.4), "verdict": "identified"}
    return Estimate(path=path, doc="", value=value, **{"provenance": "measured", **given, **more})


PARAMETERS = [
    estimate("motor.resistance", 5.4951, unit="ohm", interval90=(5.4811, 5.5099)),
    estimate("motor.viscous_friction", 1e-5, verdict="not_identified", provenance="borrowed"),
    *(
        estimate(f"surface.{floor}.{name}", verdict="at_bound", provenance="borrowed")
        for name in ("rolling_resistance", "roller_viscosity")
        for floor in FLOORS
    ),
    estimate(
        "robot.load_share@as_built",
        (0.2, 0.3, 0.5),
        unit="1",
        labels=("wheel 1", "wheel 2", "wheel 3"),
        interval90=((0.1, 0.3), (0.2, 0.4), (0.4, 0.6)),
    ),
    estimate("robot.mass", 12.0, interval90=None, verdict="fixed"),
    estimate("camera.session_yaw"),
]
RATIOS = [estimate(f"surface.{FLOORS[0]}.friction/motor.back_emf", unit="ohm*rad/(V*s)")]


def show_parameters(page):
    estimates.show_estimates(page, PARAMETERS, "84 runs")
    estimates.show_ratios(page, RATIOS)


def show_truth(page):
    fit = SimpleNamespace(parameters={e.path: e for e in PARAMETERS})
    truth = {e.path: {"value": list(e.value) if e.labels else e.value} for e in PARAMETERS}
    estimates.show_truth(page, fit, truth)


def value(number=0.0987, unit="m", verdict="identified"):
    return Value(number, (0.9 * number, 1.2 * number), 0.01, verdict, unit)


CALIBRATION = Calibration(
    sideways=False,
    radius={floor: (value(), value()) for floor in FLOORS},
    base={floor: value(0.5) for floor in FLOORS},
    centre={floor: value(0.0391) for floor in FLOORS},
    offset=(value(-0.0012), value(0.1)),
    yaw=value(-0.0149, "rad"),
    session_yaw={},
    lag=value(0.0643, "s"),
    scale=value(1.0008, "1", "not_identified"),
    firmest=FLOORS[0],
    steering={},
    gyro={"gyro_scale": value(0.998, "1"), "gyro_bias_rad_s": value(0.001, "rad/s")},
    nominal_radius=0.1,
    nominal_base=0.4,
    noise=MotionNoise(0.01, 0.01, {}, {}),
    runs=20,
    settled=True,
)


def show_trust(page):
    errors = dict.fromkeys(("nominal", "encoder", "calibrated", "contact"), 1.0312)
    floors = {floor: FloorSelection("calibrated", errors, {}, 5, True) for floor in FLOORS}
    calibration.show_trust(page, Trust("trusted", (), ("a cause",), floors))


def show_check(page):
    expected = {
        e.path: {"unit": e.unit, "ratio": 1.0, "verdict": "not_identified"}
        | {"best_ratio": 0.31, "best_verdict": "identified"}
        for e in (*PARAMETERS, *RATIOS)
    }
    group = {"surface": FLOORS[0], "load": "as_built", "session": f"{FLOORS[0]}/as_built/0.10"}
    group |= {"runs": 120, "seconds": 5000.0, "headings": 72, "speeds": [0.1, 0.2, 0.3, 0.4]}
    content = {"findings": [], "groups": [group], "channels": ["pose"], "clocks": {}, "notes": {}}
    content |= {"settings": {}, "messages": [], "derived": {}, "parameters": expected}
    checks.show_check(page, content)


def show_selftest(page):
    one = {"error_rms": 1.2345e-5, "relative_error_rms": 0.123, "z_rms": 1.02, "coverage90": 0.9}
    one |= {"intervals": 80, "unit": "N*m*s/rad", "recovered": "roughly"}
    parameters = {e.path: one for e in PARAMETERS}
    curve = {"median_gap": 0.01, "largest_gap": 0.1, "coverage90": 0.9}
    content = {"replicates": 8, "runs": 120, "converged": 8, "parameters": parameters}
    content |= {"wanted": list(parameters), "curves": {FLOORS[0]: curve}, "messages": []}
    content |= {"predictions": {FLOORS[0]: {"identified": 0.0123, "encoder": 1.0312}}}
    checks.show_selftest(page, content | {"failed": []})


def show_bench_check(page):
    log = {"name": "logs/of/a/bench/with/a/long/name.csv", "rows": 100_000, "seconds": 1000.0}
    log |= {"row_period_s": 0.001, "voltage": [-24.12, 24.12], "current": None}
    content = {"logs": [log | {"speed": [-523.1, 523.1]}], "parameters": {}, "messages": []}
    checks.show_bench_check(page, content)


def show_gains(page):
    units = ("V", "V*s/rad", "V*s^2/rad")
    parts = (
        Gain.of(value, value / 30, unit, "not_identified")
        for value, unit in zip((0.4123, 0.05373, 0.000107312), units, strict=True)
    )
    found = Feedforward("linear", *parts, radius=0.0512)
    gains.show_gains(page, gains_json([found, replace(found, name="angular")]))


MODELS = ("nominal", "calibrated", "identified", "selected", "heading_lookup", "monotone_spline")


def show_validation(page):
    one = dict.fromkeys(answers._ERRORS, 1.0312)
    one |= {"heading_error_median_deg": 110.02, "coverage90": 1.0, "runs": 120}
    answers.show_validation(page, {"summary": {f: dict.fromkeys(MODELS, one) for f in FLOORS}})


def show_comparison(page, refused=None):
    models = {f"{m}_{k}": (k, m) for m in MODELS for k in range(6)}
    ranked = {
        name: {"difference": -float(k), "se_clustered": 0.5, "endpoint_error": 1.0312}
        | {"coverage90": 0.9, "verdict": "best" if name == "identified_0" else "tied"}
        for name, (k, _) in models.items()
    }
    floor = {"runs": 120, "models": ranked, "sentence": "one is best", "band90": [0.8, 1.0]}
    cost = {name: {"numbers": {"a": 2, "b": 11, "shared": 5}, "fit_s": 1234.5} for name in models}
    floors = dict.fromkeys(("brown", "gray", "green", "table"), floor)
    question = {"floors": floors, "cost": cost}
    content = {"questions": {"sectors": question}, "surfaces": None}
    over = {"runs": 3, "refused": refused}
    answers.show_comparison(page, content | {"data": {"over_several_floors": over}})


def show_design(page):
    goal = {"name": "prediction of every floor", "unit": "m/m", "reachable": True, "now": 0.0123}
    goals = [goal | {"name": f"goal {k}"} for k in range(4)]
    run = {"floor": FLOORS[0], "load": "as_built", "heading_deg": 345.0, "speed": 0.25}
    run |= {"turn_rate": -1.6, "distance": 0.51, "seconds": 12.3}
    run |= {"expected": {g["name"]: 0.0123 for g in goals}}
    content = {"goals": goals, "runs": 12 * [run], "runs_saved": {}, "messages": []}
    answers.show_design(page, content)


def show_trial(page):
    row = {"closure_error_median": 2537.4, "worse_share": 1.0, "finished_share": 1.0, "runs": 20}
    row |= {"cross_track_rmse": 958.0, "first_side_along_track_mm": 115.0}
    row |= {"heading_error_deg": 171.2, "recovery_share": 0.0}
    row |= {"to_encoder": {"closure_error_median": {"value": 1.2345}}}
    names = ("encoder", "goswami_padhy", "slip_odometry")
    answers.show_trial(page, {"summary": dict.fromkeys(names, row), "verdict": "no difference"})


SHOWN = {
    "parameters": show_parameters,
    "truth": show_truth,
    "calibration": lambda page: calibration.show_calibration(page, CALIBRATION),
    "trust": show_trust,
    "check": show_check,
    "selftest": show_selftest,
    "bench check": show_bench_check,
    "gains": show_gains,
    "validation": show_validation,
    "comparison": show_comparison,
    "design": show_design,
    "trial": show_trial,
}


@pytest.mark.parametrize("name", SHOWN)
def test_tables_fit_and_a_sentence_follows_each(name):
    page = Kept()
    SHOWN[name](page)
    text = page.text
    assert max(map(len, text.splitlines())) <= WIDTH
    assert "…" not in text
    assert page.tables
    assert page.order.count("ts") == page.order.count("t")
    for one in page.tables:
        assert all(column.header for column in one.columns)
        # what is too wide goes on in the next line
        assert {(column.overflow, column.no_wrap) for column in one.columns} == {("fold", False)}


def test_long_names_go_on_in_the_next_line():
    page = Kept()
    made = table(("surface", "value"), right=("value",))
    made.add_row("a_carpet_with_a_name_that_is_longer_than_the_page_" * 2, "0.1234")
    page.table(made)
    lines = page.text.splitlines()
    assert max(map(len, lines)) <= WIDTH
    assert "".join(line.split()[0] for line in lines[1:]).count("longer_than_the_page_") == 2
    assert "0.1234" in page.text


def test_parameters_stand_below_the_first_part_of_their_paths():
    page = Kept()
    show_parameters(page)
    lines = [line.split("  ")[0] if line[:1] != " " else line for line in page.text.splitlines()]
    for group in ("motor", "robot", *(f"surface.{floor}" for floor in FLOORS)):
        assert lines.count(group) == 1
    assert "viscous_friction" not in page.text  # it keeps the value of its prior
    assert ".load_share@as_built" in page.text
    assert "wheel 3" in page.text
    assert "session_yaw" not in page.text


def test_the_summary_counts_verdicts_and_names_what_is_not_identified():
    page = Page(kept=True)
    show_parameters(page)
    assert "of 7 free parameters: 2 identified, 4 at a bound, 1 not identified; *: " in page.text
    assert "values of their priors: motor.viscous_friction" in page.text


def test_a_comparison_says_whether_runs_over_several_floors_were_used():
    used, refused = Page(kept=True), Page(kept=True)
    show_comparison(used)
    show_comparison(refused, "3 runs contradict the others")
    assert "also fitted to runs over several floors (3)" in " ".join(used.text.split())
    assert "3 runs contradict the others" in refused.text
    assert "also fitted" not in refused.text


def test_a_comparison_shows_five_models_and_names_the_files_with_all():
    page = Page(kept=True)
    show_comparison(page)
    lines = page.text.splitlines()
    rows = [line for line in lines if line.startswith(MODELS) and "2-11 + 5" in line]
    assert len(rows) == 5
    assert all(line.split()[0].endswith("_0") for line in rows)  # the best of 36
    assert "36 models were compared: comparison.png shows them" in page.text


def test_notes_are_ranked_and_the_rest_is_counted():
    page = Page(kept=True, rest="report.html")
    page.notes(f"small {k}" for k in range(4))
    page.notes(["grave", "small 1", "graver"], first=True)
    page.notes(["last", "last but one"])
    page.line("verdict: trusted")
    lines = page.text.splitlines()
    assert lines[0] == "verdict: trusted"
    assert lines[1:3] == ["note: grave", "note: graver"]
    assert len(lines) == 1 + MOST_NOTES + 1
    assert lines[-1] == "3 more notes in report.html"


def test_findings_that_could_not_be_checked_are_notes():
    page = Page(kept=True)
    finding = {"kind": "x", "found": "a is b", "remedy": "set c", "runs": ["run1"]}
    page.findings([finding | {"severity": word} for word in ("wrong", "note")])
    assert page.text.splitlines() == [
        *("wrong: a is b (in run1)", "    set c"),
        "note: a is b (in run1); set c",
    ]


@pytest.mark.parametrize(
    ("number", "width", "text"),
    [
        (5.49513, 0.0288, "5.495"),
        (0.0007278, 0.51, "0.00073"),
        (105.6, 2.0, "105.6"),
        (1234.5, 5000.0, "1234"),
        (24.0, 2.7, "24.0"),
        (0.0, 1.0, "0"),
        (1.5, 0.0, "1.5"),
        (1.5, float("inf"), "1.5"),
        (-0.016, 0.02, "-0.016"),
    ],
)
def test_numbers_have_the_digits_that_their_interval_deserves(number, width, text):
    assert rounded(number, width) == text


def test_both_ends_of_an_interval_have_as_many_decimal_places():
    assert interval((0.076, 0.084)) == "0.0760 .. 0.0840"
    assert interval((0.68, 10.49), " to ") == "0.68 to 10.5"
    assert interval((4.2e-8, 36847.0)) == "4.2e-08 .. 36847"


def test_intervals_and_groups():
    assert interval(None) == ""
    assert interval((0.05125, 0.05193)) == "0.05125 .. 0.05193"
    paths = ["a.x", "b.y", "a.z", "a.x/b.y", "b.w", "c.v/b.y"]
    assert grouped(paths, str) == ["a.x", "a.z", "b.y", "b.w", "a.x/b.y", "c.v/b.y"]
