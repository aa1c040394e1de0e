"""Progress away from a terminal has few lines and whole sentences, and none if quiet."""

from __future__ import annotations

import time

import pytest
from rich.progress import TimeRemainingColumn

from slipid.support import progress
from slipid.support.progress import Reporter


def test_stages_and_sentences_are_lines_and_progress_is_one_now_and_then(capsys):
    with Reporter() as report:
        report.stage("reading logs")
        report.stage("reading logs")
        report.note("on a bar only")
        for k in range(1, 1001):
            report.advance(k, 1000)
        report.line("[1000] runs")
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.splitlines() == ["reading logs ...", "  1000 of 1000", "[1000] runs"]


def test_the_time_left_is_that_of_the_steps_after_the_first(capsys, monkeypatch):
    monkeypatch.setattr(progress, "LINE_PERIOD_S", 0.0)
    now = [0.0]
    with Reporter() as report:
        monkeypatch.setattr(report._bars, "get_time", lambda: now[0])
        report.stage("driving")
        for k, at in enumerate((100.0, 110.0, 120.0), start=1):  # the first one compiles
            now[0] = at
            report.advance(k, 10, f"run {k}")
    lines = capsys.readouterr().err.splitlines()
    assert lines == [
        "driving ...",
        "  run 1",
        "  run 2, about 80 s left",
        "  run 3, about 70 s left",
    ]


def test_a_stage_that_compiles_has_its_usual_time(capsys):
    with Reporter() as report:
        report.stage("compiling", usual_s=15.0)
        report.stage("fitting")
        report.steps(3, 12)
        report.steps(12, 12)
    lines = capsys.readouterr().err.splitlines()
    assert lines == ["compiling ... (the first time usually 15 s)", "fitting ...", "  100 %"]


def test_on_a_terminal_the_usual_time_is_counted_down_until_progress_is_known(monkeypatch):
    now = [100.0]
    report = Reporter()
    bars = report._bars
    monkeypatch.setattr(bars, "get_time", lambda: now[0])
    column = next(c for c in bars.columns if isinstance(c, TimeRemainingColumn))

    def left():
        [task] = bars.tasks
        return column(task).plain

    report.stage("compiling", usual_s=75.0)
    assert left() == "1:15"
    now[0] = 110.0
    assert left() == "1:05"
    now[0] = 500.0
    assert left() == "0:00"
    report.stage("calibrating", usual_s=75.0)
    report.advance(0, 10)
    now[0] = 510.0
    report.advance(1, 10)
    assert left() == "1:05"
    now[0] = 514.0
    report.advance(2, 10)
    assert left() == "0:00:32"


def test_lines_come_no_closer_than_they_should(capsys, monkeypatch):
    monkeypatch.setattr(progress, "LINE_PERIOD_S", 0.05)
    with Reporter() as report:
        report.stage("driving")
        began = time.monotonic()
        while time.monotonic() < began + 0.3:
            report.advance(1, 10)
            time.sleep(0.005)
    assert 2 <= len(capsys.readouterr().err.splitlines()) <= 8


@pytest.mark.parametrize("inside", [True, False])
def test_a_quiet_reporter_says_nothing(capsys, inside):
    report = Reporter(quiet=True)
    if inside:
        with report:
            report.stage("a")
            report.advance(2, 2)
    else:
        report.stage("a")
        report.advance(2, 2)
    report.line("b")
    assert capsys.readouterr() == ("", "")
