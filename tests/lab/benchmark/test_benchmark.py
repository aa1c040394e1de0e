"""The command on the recorded runs of the test site: one table, checkpoints, rows that fail."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from slipid.cli.main import app
from slipid.lab.benchmark import work as benchmark_work
from slipid.lab.benchmark.benchmark import RectangleTask, benchmark, tasks_of
from slipid.lab.benchmark.scores import FoldScore
from slipid.lab.benchmark.work import (
    QUICK_RUNS,
    BenchmarkOptions,
    FoldTask,
    data_of,
    keys_of,
    source_of,
    split_of,
)
from slipid.support.errors import DataError
from slipid.support.executor import InProcess
from slipid.support.progress import Reporter


def kept(folder: Path) -> dict[str, int]:
    return {p.name: p.stat().st_mtime_ns for p in folder.rglob("known_floor_*.json")}


@pytest.mark.nightly  # compiles a fit, minutes
def test_one_command_makes_a_table_and_goes_on_from_what_was_kept(tmp_path, monkeypatch):
    data, out = tmp_path / "data", tmp_path / "out"
    data.mkdir()
    requested = ["benchmark", "--data", str(data), "--out", str(out), "--quick", "--quiet"]
    rows = ["--rows", "slipid,encoder,ojeda_gyro"]
    done = CliRunner().invoke(app, [*requested, *rows, "--json", str(tmp_path / "x.json")])
    assert done.exit_code == 0, done.output
    found = json.loads((tmp_path / "x.json").read_text())
    assert found == json.loads((out / "benchmark.json").read_text())
    table = found["sets"]["testsite"]["protocols"]["known_floor"]
    assert list(table) == ["slipid", "encoder", "ojeda_gyro"]
    assert table["slipid"]["endpoint_error"][0] < 0.3 * table["encoder"]["endpoint_error"][0]
    assert table["encoder"]["behind"][1] > 0
    assert table["slipid"]["coverage90"][0] > 0.7
    assert table["slipid"]["slip_auc"][0] > 0.9
    assert table["ojeda_gyro"]["absent"] == "needs a gyro"
    assert "needs a gyro" in done.output
    page = (out / "benchmark.html").read_text()
    assert "ojeda_gyro: needs a gyro" in page
    assert "data:image/png;base64," in page

    before = kept(out)
    next(out.rglob("known_floor_encoder.json")).unlink()
    again = CliRunner().invoke(app, [*requested, *rows])
    assert again.exit_code == 0
    after = kept(out)
    assert {name for name in after if after[name] != before[name]} == {"known_floor_encoder.json"}

    # in this process, where a row can be broken; the fit is kept
    task = FoldTask(
        BenchmarkOptions(data, out, ("encoder", "paper_code"), quick=True),
        "testsite",
        "headings",
        0,
    )
    next(out.rglob("known_floor_encoder.json")).unlink()

    def broken(*_: object) -> list:
        raise ZeroDivisionError("a wheel of size 0")

    monkeypatch.setattr("slipid.predict.kinematics.Encoder.predict", broken)
    assert task.run() == "testsite/headings_0"
    left = {name: row for (_, name), row in task.rows().items()}
    assert left["encoder"] == FoldScore(absent="ZeroDivisionError: a wheel of size 0", failed=True)
    assert len(left["paper_code"].runs) == len(split_of(task).held_out)


def test_every_fold_of_every_kind_is_a_task_or_one_of_headings_if_quick(tmp_path):
    (tmp_path / "x").mkdir()
    options = BenchmarkOptions(tmp_path / "x", tmp_path / "out")
    kinds = ("headings", "sectors", "speeds", "floors")
    every = [f"testsite/{kind}_{fold}" for kind in kinds for fold in (0, 1)]
    assert [task.name for task in tasks_of(options, "testsite")] == every
    quick = tasks_of(replace(options, quick=True), "testsite")
    assert [task.name for task in quick] == ["testsite/headings_0"]
    assert {protocol for protocol, _ in keys_of(quick[0])} == {"known_floor"}


def test_a_single_floor_has_no_protocol_with_unknown_floors(tmp_path, monkeypatch):
    (tmp_path / "x").mkdir()
    task = FoldTask(
        BenchmarkOptions(tmp_path / "x", tmp_path / "out", ("encoder",)), "testsite", "headings", 0
    )
    assert keys_of(task) == [("known_floor", "encoder"), ("unknown_floor", "encoder")]
    data = data_of(task.options, "testsite")
    alone = replace(data, facts=tuple(replace(f, floor="firm") for f in data.facts))
    monkeypatch.setattr(benchmark_work, "data_of", lambda options, source: alone)
    assert keys_of(task) == [("known_floor", "encoder")]


def test_other_runs_over_several_floors_are_other_work_but_no_other_fit(tmp_path, monkeypatch):
    (tmp_path / "x").mkdir()
    task = FoldTask(BenchmarkOptions(tmp_path / "x", tmp_path / "out"), "testsite", "headings", 0)
    data = data_of(task.options, "testsite")
    rows, fit = (benchmark_work.checkpoint_of(task, fit=fit).key for fit in (False, True))
    more = replace(data, crossing=data.logged.subset([0]))
    monkeypatch.setattr(benchmark_work, "data_of", lambda options, source: more)
    assert benchmark_work.checkpoint_of(task, fit=False).key != rows
    assert benchmark_work.checkpoint_of(task, fit=True).key == fit


def test_quick_work_does_not_overwrite_what_was_kept(tmp_path):
    (tmp_path / "x").mkdir()
    options = BenchmarkOptions(tmp_path / "x", tmp_path / "out", ("encoder",))
    few = data_of(options, "testsite").thinned(QUICK_RUNS)
    assert len(few.logged) < len(data_of(options, "testsite").logged)
    whole, quick = (
        FoldTask(replace(options, quick=quick), "testsite", "headings", 0)
        for quick in (False, True)
    )
    assert whole.name == quick.name
    folders = {
        benchmark_work.checkpoint_of(p, fit=f).folder for p in (whole, quick) for f in (False, True)
    }
    assert len(folders) == 4


def test_an_unknown_row_is_named_with_the_choices(tmp_path):
    with pytest.raises(DataError, match=r"no row 'encodr'.*did you mean.*encoder"):
        benchmark(
            BenchmarkOptions(tmp_path, tmp_path / "out", ("encodr",)),
            InProcess(),
            Reporter(quiet=True),
        )


def test_a_missing_folder_is_named(tmp_path):
    requested = ["benchmark", "--data", str(tmp_path / "gone"), "--out", str(tmp_path / "out")]
    done = CliRunner().invoke(app, requested)
    assert done.exit_code == 2
    assert "gone: no such folder" in done.output


def test_a_split_that_cannot_be_read_fails_alone(tmp_path, monkeypatch):
    (tmp_path / "x").mkdir()
    task = FoldTask(
        BenchmarkOptions(tmp_path / "x", tmp_path / "out", ("encoder",)), "testsite", "headings", 0
    )

    def broken(_: object) -> None:
        raise OSError("disk on fire")

    with monkeypatch.context() as patch:
        patch.setattr(benchmark_work, "fold_data", broken)
        task.run()
    rows = task.rows()
    assert {protocol for protocol, _ in rows} == {"known_floor", "unknown_floor"}
    assert all(row.failed and "disk on fire" in row.absent for row in rows.values())

    # what failed is tried again
    monkeypatch.setattr(benchmark_work, "fold_data", lambda task: None)
    monkeypatch.setattr(
        benchmark_work, "_score", lambda data, protocol, name: FoldScore.lacking(["gyro"])
    )
    task.run()
    assert {row.absent for row in task.rows().values()} == {"needs a gyro"}


def test_a_data_set_that_cannot_be_read_stops_no_other(tmp_path, monkeypatch):
    folder = tmp_path / "data" / "robotino2022" / "one_surface" / "gray"
    folder.mkdir(parents=True)
    (folder / "run.csv").write_text("this is no log")
    monkeypatch.setattr("slipid.lab.benchmark.benchmark.SOURCES", [source_of("robotino2022")])
    found = benchmark(
        BenchmarkOptions(tmp_path / "data", tmp_path / "out", ("quann_slip",)),
        InProcess(),
        Reporter(quiet=True),
    )
    assert list(found["unread"]) == ["robotino2022"]
    assert found["sets"] == {}
    assert (tmp_path / "out" / "benchmark.json").is_file()


def test_a_robot_that_cannot_be_identified_drives_no_rectangle(tmp_path, monkeypatch):
    (tmp_path / "x").mkdir()
    rectangle = RectangleTask(BenchmarkOptions(tmp_path / "x", tmp_path / "out"))

    def broken(*_: object) -> None:
        raise OSError("disk on fire")

    monkeypatch.setattr("slipid.lab.benchmark.benchmark.data_of", broken)
    assert rectangle.run() == "rectangle"
    assert rectangle.drive(InProcess(), Reporter(quiet=True)) == {"failed": "OSError: disk on fire"}
