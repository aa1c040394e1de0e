"""The tables and the page of a benchmark, of made content."""

import copy

import pytest
from typer.testing import CliRunner

from slipid.cli.main import app
from slipid.lab.benchmark.report import COLUMNS, LEGEND, benchmark_page, show_benchmark
from slipid.report.html.blocks import FigureBlock
from slipid.report.html.page import rendered
from slipid.report.page import Page


def row(error=None, absent="", failed=False, **more):
    ends = None if error is None else [error, error - 0.01, error + 0.01]
    names = "behind length_error heading_error_deg twist_error coverage90 slip_auc "
    blank = dict.fromkeys((names + "floor_accuracy energy_error floors").split())
    costs = {"runs": 9, "numbers": 3, "tune_s": 1.0, "fit_s": 0.02, "step_us": 12.3}
    about = {"settings": [], "unconverged": 0, "absent": absent, "failed": failed}
    return {"endpoint_error": ends, **blank, **costs, **about, **more}


CONTENT = {
    "sets": {
        "carpets": {
            "about": "a robot on carpets",
            "over": "chord",
            "runs": 9,
            "protocols": {
                "known_floor": {
                    "encoder": row(0.3, behind=[0.25, 0.2, 0.3]),
                    "slipid": row(0.05, coverage90=[0.9, 0.8, 1.0]),
                    "ojeda_gyro": row(absent="needs a gyro"),
                    "quann_slip": row(absent="ValueError: <no> rank", failed=True),
                }
            },
        }
    },
    "protocols": {"known_floor": "new headings on a floor that is told"},
    "floors": {},
    "rectangle": None,
    "reading": ["carpets, known floor: slipid errs by 5.0 %"],
    "seconds": 12.0,
    "versions": {"python": "3.11"},
}


def text(content):
    shown = Page(kept=True)
    show_benchmark(shown, content)
    return shown.text


def test_the_best_row_comes_first_and_absent_rows_have_reasons():
    lines = text(CONTENT).splitlines()
    first = next(k for k, line in enumerate(lines) if line.startswith("slipid"))
    assert lines[first + 1].startswith("encoder")
    assert "5.0 [4.0, 6.0]" in lines[first]
    assert "+25.0 [+20.0, +30.0]" in lines[first + 1]
    assert "ojeda_gyro: needs a gyro" in text(CONTENT)
    assert "quann_slip: failed: ValueError: <no> rank" in text(CONTENT)


def test_a_missing_interval_has_a_reason_and_no_error_bar():
    content = copy.deepcopy(CONTENT)
    rows = content["sets"]["carpets"]["protocols"]["known_floor"]
    rows["encoder"] |= {"endpoint_error": [0.3, None, None], "behind": [0.25, None, None]}
    line = next(line for line in text(content).splitlines() if line.startswith("encoder"))
    assert line.split()[1:5] == ["30.0", "[-]", "+25.0", "[-]"]
    assert "encoder: no interval, since the runs form fewer than 5 clusters" in page(content)
    (figure,) = figures(content)
    bars = {tuple(d["y"]): d["error_x"] for d in figure.data if "error_x" in d}
    assert bars[("encoder",)]["array"] == [0.0]


def page(content):
    return rendered(benchmark_page(content))


def figures(content):
    sections = benchmark_page(content).sections
    return [b for section in sections for b in section.blocks if isinstance(b, FigureBlock)]


def test_the_page_has_every_table_and_figure_and_escapes_its_texts():
    (figure,) = figures(CONTENT)
    assert "best of 2 rows is slipid, off by 5.0 %" in figure.alt
    written = page(CONTENT)
    for number, *_ in COLUMNS.values():
        assert number.partition(",")[0].lower() in LEGEND.lower()
    assert "quann_slip: failed: ValueError: &lt;no&gt; rank" in written
    own, other = '<span class="badge good">slipid</span>', '<th scope="row">encoder</th>'
    assert written.index(own) < written.index(other)


def test_a_data_set_in_which_nothing_ran_has_no_figure():
    content = copy.deepcopy(CONTENT)
    failed = {"slipid": row(absent="gone", failed=True)}
    content["sets"]["carpets"]["protocols"]["known_floor"] = failed
    assert figures(content) == []


def test_fits_that_did_not_converge_are_reported():
    content = copy.deepcopy(CONTENT)
    content["sets"]["carpets"]["protocols"]["known_floor"]["slipid"]["unconverged"] = 2
    assert "slipid: fits that did not converge: 2" in text(content)
    assert "slipid: fits that did not converge: 2" in page(content)


def classifier_row(name, absent=""):
    after = {"seconds": 1.0, "accuracy": [0.7, 0.6, 0.8], "behind": None}
    return {"name": name, "numbers": 3, "after": [] if absent else [after], "absent": absent}


def test_a_failed_classifier_is_reported_above_the_others():
    content = copy.deepcopy(CONTENT)
    rows = [classifier_row("gaussian"), classifier_row("trees", "ValueError: no leaf")]
    content["floors"] = {"husky": {"about": "a Husky", "runs": 9, "chance": 0.3, "rows": rows}}
    for written in (text(content), page(content)):
        flat = " ".join(written.split())
        assert "failed: trees: ValueError: no leaf" in flat
        assert "70 [60, 80]" in flat


def clean():
    content = copy.deepcopy(CONTENT)
    del content["sets"]["carpets"]["protocols"]["known_floor"]["quann_slip"]
    floor_table = {
        "about": "a Husky",
        "runs": 9,
        "chance": 0.3,
        "rows": [classifier_row("gaussian")],
    }
    return {**content, "unread": {}, "floors": {"husky": floor_table}}


BROKEN = {
    "data set": {"unread": {"carpets": "OSError: disk on fire"}},
    "row": {"sets": CONTENT["sets"]},
    "classifier": {
        "floors": {
            "husky": {**clean()["floors"]["husky"], "rows": [classifier_row("trees", "no leaf")]}
        }
    },
    "floors": {"floors": {"husky": {"failed": "no logs"}}},
    "rectangle": {"rectangle": {"failed": "no MuJoCo"}},
}


@pytest.mark.parametrize("broken", [None, *BROKEN])
def test_the_exit_code_is_one_if_anything_failed(broken, tmp_path, monkeypatch):
    content = clean() | (BROKEN[broken] if broken else {})
    monkeypatch.setattr("slipid.lab.benchmark.benchmark.benchmark", lambda *_: content)
    requested = ["benchmark", "--data", str(tmp_path), "--out", str(tmp_path / "out"), "--quiet"]
    done = CliRunner().invoke(app, requested)
    assert done.exit_code == (1 if broken else 0), done.output
    assert (tmp_path / "out" / "benchmark.html").is_file()


@pytest.mark.parametrize("where", ["terminal", "page"])
def test_the_rectangle_is_ranked_by_closure(where):
    content = copy.deepcopy(CONTENT)

    def controller(closure, ratio):
        return {
            "closure_error_median": closure,
            "cross_track_rmse": 20.0,
            "finished_share": 1.0,
            "runs": 8,
            "interval90": {"closure_error_median": [closure - 5, closure + 5]},
            "to_encoder": {"closure_error_median": {"value": ratio, "interval90": [0.4, 0.7]}},
        }

    rows = {"encoder": controller(200.0, 1.0), "contact": controller(110.0, 0.55)}
    content["rectangle"] = {"plant": "testsite", "summary": rows}
    written = text(content) if where == "terminal" else page(content)
    assert "rectangle on the virtual test site, 8 starts" in written
    assert written.index("110 [105, 115]") < written.index("200 [195, 205]")
    assert "55 [40, 70]" in written
    content["rectangle"] = {"failed": "no MuJoCo"}
    assert "failed: no MuJoCo" in (text(content) if where == "terminal" else page(content))
