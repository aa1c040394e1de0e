"""The command line: files, exit codes, messages, interrupts; in process and as real processes."""

from __future__ import annotations

import errno
import inspect
import itertools
import json
import os
import re
import shlex
import shutil
import signal
import stat
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer

import slipid
from slipid.app.config import read_config, single_floor_sections
from slipid.app.logs import matching_files, packaged_config, packaged_path
from slipid.cli.common import SCHEMAS
from slipid.cli.main import PANELS, LossyStream, app
from slipid.infer.result_folder import refuse_foreign_config
from slipid.report.html.results import read_results
from slipid.support.errors import DataError
from slipid.support.files import writable, write_bytes, write_json
from slipid.support.progress import Reporter
from tests.helpers.broken_logs import CASES, GENERIC, ROBOTINO, Case, write_good
from tests.helpers.kept import kept
from tests.helpers.shared import FEW, invoke

ROOT = Path(__file__).resolve().parents[2]


def process(*words: object, **more):
    # a suite started in the background hands on a SIGINT that is ignored
    listen = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    command = [sys.executable, "-c", f"{listen}; from slipid.cli.main import main; main()"]
    return subprocess.Popen(
        [*command, *map(str, words)],
        cwd=ROOT,
        env={**os.environ, "JAX_ENABLE_X64": "0"},  # the command itself must switch it on
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        **more,
    )


# help and usage ---------------------------------------------------------------------------------


def test_help_loads_nothing_heavy():
    code = (
        "import sys; from slipid.cli.main import app; from typer.testing import CliRunner; "
        "r = CliRunner().invoke(app, ['--help']); assert r.exit_code == 0; "
        "print(sorted({'jax', 'numpy', 'pydantic', 'matplotlib', 'scipy'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize(
    "words",
    [
        ("identify",),
        ("identify", "none.toml"),
        ("nonsense",),
        ("identify", "none.toml", "--data", ".", "--out", "o", "--unknown"),
    ],
)
def test_wrong_usage_is_2(words):
    assert invoke(*words).exit_code == 2


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no full device")
@pytest.mark.parametrize("buffer", ["", "1"])
@pytest.mark.parametrize("words", [("--help",), ("reference", "units"), ("robots", "--json", "-")])
def test_a_full_disk_for_standard_output_is_2_and_a_sentence(words, buffer):
    kept = {**os.environ, "PYTHONUNBUFFERED": buffer}
    command = [sys.executable, "-m", "slipid", *words]
    with open("/dev/full", "w") as full:
        ended = subprocess.run(command, env=kept, stdout=full, stderr=subprocess.PIPE, text=True)
    found = (ended.returncode, ended.stderr)
    assert found == (2, "standard output cannot be written (No space left on device)\n")
    reader, writer = os.pipe()
    os.close(reader)
    ended = subprocess.run(command, env=kept, stdout=writer, stderr=subprocess.PIPE, text=True)
    os.close(writer)
    assert (ended.returncode, ended.stderr) == (1, "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no full device")
def test_work_goes_on_where_progress_cannot_be_written(monkeypatch):
    with open("/dev/full", "w") as full:
        stream = LossyStream(full)
        monkeypatch.setattr(sys, "stderr", stream)
        with Reporter() as report:
            for stage in ("reading", "fitting"):
                report.stage(stage)
        stream.flush()
    assert stream.lost is not None
    assert stream.lost.errno == errno.ENOSPC


@pytest.mark.parametrize("command", ["identify", "check"])
def test_a_bad_config_is_2_and_a_message(tmp_path, command):
    bad = tmp_path / "bad.toml"
    bad.write_text('[robot]\ndrive = "omny"\n', encoding="utf-8")
    out = tmp_path / "out"
    result = invoke(command, bad, "--data", tmp_path, "--out", out)
    assert result.exit_code == 2
    assert f"{bad}: robot.drive: 'omny', did you mean omni?" in result.stderr
    assert not out.exists()


def test_no_data_folder_is_2(tmp_path):
    config = ROOT / "configs" / "robotino2022.toml"
    result = invoke("check", config, "--data", tmp_path / "none")
    assert result.exit_code == 2
    assert "no such folder; expected the folder of the logs" in result.stderr


def test_validate_without_a_fit_is_2(tmp_path):
    result = invoke("validate", tmp_path, "--data", tmp_path)
    assert result.exit_code == 2
    assert "expected the result of `slipid identify`" in result.stderr


def suggested(text: str) -> list[list[str]]:
    """Commands that a command suggested at its end, each checked as if it was typed."""
    lines = text.splitlines()
    typed = [
        shlex.split(after)[1:]
        for line, after in itertools.pairwise(lines)
        if line.startswith("next, ")
    ]
    for name, *words in typed:
        with typer.main.get_command(app).commands[name].make_context(name, words):
            pass
    return typed


# broken logs ------------------------------------------------------------------------------------


def toml(value: object) -> str:
    """A value as inline TOML; JSON is TOML for strings, numbers and lists."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{k} = {toml(v)}" for k, v in value.items()) + " }"
    return json.dumps(value)


def config_of(case: Case, folder: Path) -> Path:
    """A config that reads the case's file with the layout the case declares."""
    layout = "\n".join(f"{k} = {toml(v)}" for k, v in case.mapping().items())
    two = (
        'drive = "general"\nwheel_places_m = [[0, 0.1], [0, -0.1]]\n'
        'drive_directions_deg = [0, 0]\nroller_angles_deg = ["none", "none"]'
    )
    three = 'drive = "omni"\nbase_radius_m = 0.125\nwheel_azimuths_deg = [60, 180, 300]'
    path = folder / "my.toml"
    path.write_text(
        f"[robot]\n{three if case.file == ROBOTINO else two}\nwheel_radius_m = 0.04\n"
        f"mass_kg = 12\ngear_ratio = {case.mapping().get('gear_ratio', 16)}\n"
        f"[layouts.mine]\n{layout}\n"
        f'[[logs]]\nglob = "{case.file}"\nformat = "mine"\nsurface = "gray"\n',
        encoding="utf-8",
    )
    return path


def words_of(case: Case) -> list[str]:
    """What the message must hold; a glob does not see files that are no files."""
    if case.name in ("folder", "missing file"):
        return ["no file matches", "exp07.csv"]
    return [w.replace("layout columns", "layouts.mine columns") for w in case.expected]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_a_broken_log_is_one_message_and_2(tmp_path, case: Case):
    data = tmp_path / "data"
    write_good(data)
    case.breaker(data / case.file)
    config, out = config_of(case, tmp_path), tmp_path / "out"
    result = invoke("identify", config, "--data", data, "--out", out, "--quiet")
    assert result.exit_code == 2
    assert isinstance(result.exception, SystemExit)
    assert [w for w in words_of(case) if w not in result.stderr] == [], result.stderr
    assert result.stderr.count("\n") == 1
    assert result.stdout == ""
    assert not out.exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", kept(["empty file", "binary file", "missing column"], ["binary file"])
)
def test_a_broken_log_in_a_real_process(tmp_path, name):
    [case] = [c for c in CASES if c.name == name]
    data = tmp_path / "data"
    write_good(data)
    case.breaker(data / case.file)
    config, out = config_of(case, tmp_path), tmp_path / "out"
    run = process("identify", config, "--data", data, "--out", out)
    stdout, stderr = run.communicate(timeout=120)
    assert run.returncode == 2
    assert [w for w in words_of(case) if w not in stderr] == []
    assert "Traceback" not in stderr + stdout
    assert not out.exists()


def test_a_log_without_motion_is_refused_before_anything_is_written(tmp_path):
    data = tmp_path / "data"
    write_good(data)
    path = data / GENERIC
    still = [line.split(",") for line in path.read_text(encoding="utf-8").splitlines()]
    for cells in still[1:]:
        cells[1:5] = ["0", "0", "0", "0"]
        cells[9:11] = ["5.0", "1.0"]
    path.write_text("\n".join(",".join(c) for c in still) + "\n", encoding="utf-8")
    config = config_of(Case("still", lambda p: None, (), GENERIC), tmp_path)
    result = invoke("identify", config, "--data", data, "--out", tmp_path / "out", "--quiet")
    assert result.exit_code == 2
    assert "no wheel turns in these runs" in result.stderr
    assert "log runs in which the robot drives" in result.stderr
    assert not (tmp_path / "out").exists()


def test_identify_asks_for_a_place_to_write_before_it_fits(tmp_path):
    data = tmp_path / "data"
    write_good(data)
    config = config_of(Case("good", lambda p: None, (), GENERIC), tmp_path)
    (tmp_path / "file").write_text("")
    result = invoke("identify", config, "--data", data, "--out", tmp_path / "file" / "out")
    assert result.exit_code == 2
    assert "cannot be written (Not a directory)" in result.stderr
    assert "compiling" not in result.stderr


# the job end to end -----------------------------------------------------------------------------


@pytest.mark.slow
def test_identify_writes_the_files_of_the_contract(small):
    folder, result = small
    assert result.exit_code == 0, result.stderr
    out = folder / "out"
    names = {p.name for p in out.iterdir()}
    assert names >= {"identified.json", "fit.json", "run.json", "config.toml"}
    assert len([n for n in names if n.startswith("fit-") and n.endswith(".npz")]) == 1
    assert not [n for n in names if n.startswith(".") or n.endswith(".part")]
    assert "checkpoint.npz" not in names  # it is done with
    assert (out / "config.toml").read_text() == (folder / "my.toml").read_text()
    run = json.loads((out / "run.json").read_text())
    assert set(run["data"]["logs"]) == {f"as_built/soft/run{k:03d}.csv" for k in range(12)}
    assert run["seed"] == 0
    assert {"python", "jax", "numpy", "slipid"} <= set(run["versions"])
    found = json.loads((out / "identified.json").read_text(), parse_constant=pytest.fail)
    assert found["data"]["hash"] == run["data"]["hash"]
    assert json.loads((out / "fit.json").read_text(), parse_constant=pytest.fail)["converged"]
    assert ".resistance" in result.stdout
    assert f"in {out}: look first at report.html" in result.stdout
    assert "skipped" in result.stderr  # the config also names moved/


@pytest.mark.slow
def test_identify_finds_the_motor(small):
    folder, _ = small
    found = json.loads((folder / "out" / "identified.json").read_text())["parameters"]
    # half and twice the truth to begin with, hardly any data
    assert found["motor.resistance"]["value"] == pytest.approx(5.5, rel=0.03)
    assert found["motor.back_emf"]["value"] == pytest.approx(0.0514, rel=0.03)
    assert found["motor.resistance"]["verdict"] == "identified"
    ratios = json.loads((folder / "out" / "identified.json").read_text())["derived"]
    assert ratios["motor.resistance/motor.back_emf"]["verdict"] == "identified"
    assert ratios["motor.resistance/motor.back_emf"]["unit"] == "ohm*rad/(V*s)"


@pytest.mark.slow
def test_json_to_stdout_and_the_same_numbers_again(small, tmp_path):
    folder, _ = small
    config, data = folder / "my.toml", folder / "logs"
    words = ("--json", "-", "--quiet", "--profile", "motor.resistance")
    result = invoke("identify", config, "--data", data, "--out", tmp_path, *words)
    assert result.exit_code == 0
    assert json.loads(result.stdout) == json.loads((folder / "out/identified.json").read_text())
    kept = json.loads((tmp_path / "profile.json").read_text(), parse_constant=pytest.fail)
    [(path, profile)] = kept["profiles"].items()
    assert (kept["schema"], path) == ("slipid.profile/1", "motor.resistance")
    low, high = profile["interval90"]
    assert low < profile["estimate"] < high
    assert (tmp_path / "profile.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


@pytest.mark.slow
def test_a_profile_of_what_is_not_fitted_is_2_before_the_fit(small, tmp_path):
    folder, _ = small
    words = ("--data", folder / "logs", "--out", tmp_path / "out", "--profile", "robot.mass")
    result = invoke("identify", folder / "my.toml", *words)
    assert result.exit_code == 2
    assert "--profile: robot.mass is fixed; expected one of the free scalars" in result.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_commands_suggest_what_to_type_next(small, sampled):
    folder, result = small
    out = str(folder / "out")
    assert suggested(result.stdout) == [
        ["validate", out, "--data", "other"],
        ["export", out, "--out", f"{out}/to_go"],
    ]
    [[name, *words]] = suggested(sampled[1].stdout)
    assert (name, words[1:]) == ("sample", ["--most", "80"])
    check = invoke("check", folder / "my.toml", "--data", folder / "logs")
    [[name, *words]] = suggested(check.stdout)
    assert (name, words[-1]) == ("identify", "out/my")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("report", "x" * 300), "xx': a name of over 255 bytes; expected a shorter one"),
        (("sample", "~/a"), "~/a': the shell did not replace the ~; expected a whole path"),
        (("sample", "a\x1b"), r"'a\x1b': a name to write to; expected printable characters"),
        (("sample", "a", "--json", "*"), "--json '*': no name of a file; expected a path without"),
        (("sample", "a", "--json=-x"), "--json '-x': no name of a file; expected a path without"),
        (("sample", "a", "--json", "~/a.json"), "--json '~/a.json': no name of a file"),
        (("check", "a", "--data", ".", "--json", "/dev/full"), "--json /dev/full: cannot be wri"),
    ],
)
def test_names_to_write_to_are_checked_before_the_work(tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    result = invoke(*words)
    assert result.exit_code == 2
    assert message in result.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "content",
    [
        *("[robot]", "time,x\n1,2\n", "[]", '{"schema": "slipid.fit/9"}'),
        '{"schema": "slipid.identified/1"}',
    ],
)
def test_json_overwrites_no_file_that_is_not_the_json_of_a_result(tmp_path, content):
    path = tmp_path / "mine"
    path.write_text(content)
    result = invoke("check", tmp_path / "a.toml", "--data", tmp_path, "--json", path)
    assert result.exit_code == 2
    assert "mine: a file that `--json` of this command did not write" in result.stderr
    assert path.read_text() == content
    result = invoke("check", tmp_path / "a.toml", "--data", tmp_path, "--json", tmp_path / "a.toml")
    assert "a.toml': also the file of config" in result.stderr
    path.write_text('{"schema": "slipid.check/1"}')
    result = invoke("check", tmp_path / "a.toml", "--data", tmp_path, "--json", path)
    assert "a.toml" in result.stderr
    assert "--json" not in result.stderr
    words = ("motor", "x.csv", "--json", tmp_path / "old" / "identified.json")
    words[-1].parent.mkdir()
    words[-1].write_text('{"schema": "slipid.identified/1"}')
    assert "identified.json: belongs to the results in" in invoke(*words).stderr
    assert "x.csv" in invoke(*words, "--out", tmp_path / "old").stderr


def test_schemas_of_the_json_of_commands_exist():
    names = set()
    for path in Path(slipid.__file__).parent.rglob("*.py"):
        names |= set(re.findall(r'"slipid\.(\w+)/\d+"', path.read_text(encoding="utf-8")))
    commands = [one.run for panel in PANELS.values() for one in panel]
    written = {f.__name__ for f in commands if "json" in inspect.signature(f).parameters}
    assert {*SCHEMAS} < written
    assert {schema for name in written for schema in SCHEMAS.get(name, (name,))} <= names


@pytest.mark.slow
def test_files_of_the_user_and_logs_are_kept(small, tmp_path):
    folder, _ = small
    logs = folder / "logs"
    log = next(logs.rglob("*.csv"))
    name = log.relative_to(logs).as_posix()
    before = log.read_bytes()
    fit = ("identify", folder / "my.toml", "--data", logs, "--quiet", "--out")
    own = tmp_path / "own"
    own.mkdir()
    for file in ("config.toml", "robot.json", "report.html"):
        (own / file).write_text("[1, 2]")
        words = ("--data", logs, "--out", own)
        commands = [(*fit, own)] + [("check", folder / "my.toml", *words)] * (file[:3] == "rep")
        for command in commands:
            result = invoke(*command)
            assert result.exit_code == 2
            assert f"{own / file}: " in result.stderr
            assert "overwritten" in result.stderr
        assert [p.name for p in own.iterdir()] == [file]
        (own / file).unlink()
    result = invoke("export-run", folder / "out", name, "--out", log)
    assert result.exit_code == 2
    assert f"{log}: exists and was not written by slipid" in result.stderr
    assert log.read_bytes() == before


@pytest.mark.slow
def test_a_log_that_is_cut_off_at_its_beginning_spoils_no_other(small, tmp_path):
    folder, _ = small
    logs = tmp_path / "logs"
    shutil.copytree(folder / "logs", logs)
    first, *_ = sorted(logs.rglob("*.csv"))
    name, lines = first.relative_to(logs).as_posix(), first.read_text().splitlines(keepends=True)
    for rows in (3, 6):
        first.write_text("".join(lines[:rows]))
        result = invoke("check", folder / "my.toml", "--data", logs)
        assert result.exit_code == 0, result.stderr
        assert f"note: set aside: {name}: no wheel rim moves by 10 mm" in result.stdout
        assert "no estimate of a fit can be predicted" not in result.stdout


@pytest.mark.slow
def test_a_changed_config_is_not_that_of_the_fit(small, tmp_path):
    folder, _ = small
    out = tmp_path / "out"
    shutil.copytree(folder / "out", out)
    config = out / "config.toml"
    text = config.read_text()
    config.write_bytes(("\ufeff" + text.replace("\n", "\r\n")).encode())
    assert invoke("report", out).exit_code == 0  # line ends of Windows
    (out / "posterior.nc").write_text("mine")
    result = invoke("sample", out)
    assert result.exit_code == 2
    assert "posterior.nc: exists and was not written by slipid" in result.stderr
    (out / "posterior.nc").unlink()
    config.write_text(text.removesuffix("\n"))
    assert invoke("report", out).exit_code == 0
    config.write_text(text + "# mine\n")
    unseen, to_go = ("--data", folder / "unseen"), ("--out", tmp_path / "to_go")
    for words in (("report",), ("sample",), ("design",), ("export", *to_go), ("validate", *unseen)):
        result = invoke(*words, out)
        assert result.exit_code == 2
        assert "config.toml: not the config of the fit" in result.stderr
    again = invoke("identify", folder / "my.toml", "--data", folder / "logs", "--out", out)
    assert again.exit_code == 2
    assert "config.toml: no copy that slipid made for a fit, or changed since" in again.stderr
    assert config.read_text().endswith("# mine\n")
    for damaged in ('{"schema": "slipid.run/0"}', "{"):  # `identify` mends it
        (out / "run.json").write_text(damaged)
        refuse_foreign_config(out, "of a different fit")


@pytest.mark.slow
def test_validate_predicts_unseen_runs(small, tmp_path):
    folder, _ = small
    target = tmp_path / "v.json"
    result = invoke("validate", folder / "out", "--data", folder / "unseen", "--json", target)
    assert result.exit_code == 0, result.stderr
    found = json.loads(target.read_text(), parse_constant=pytest.fail)
    assert found["schema"] == "slipid.validation/1"
    models = found["summary"]["soft"]
    assert {"encoder", "paper", "heading_lookup", "identified"} <= set(models)
    assert models["identified"]["runs"] == len(found["runs"]) == 3
    # encoders are off by a quarter on this floor
    assert models["identified"]["endpoint_error_mean"] < 0.05
    assert models["encoder"]["endpoint_error_mean"] > 0.15
    assert "were used in the fit" not in result.stderr


@pytest.mark.slow
def test_validate_reports_fitted_runs_and_unknown_floors(small, tmp_path):
    folder, _ = small
    result = invoke("validate", folder / "out", "--data", folder / "logs")
    assert result.exit_code == 0
    assert "12 of 12 runs were used in the fit" in result.stderr
    other = tmp_path / "as_built/ice/run000.csv"
    other.parent.mkdir(parents=True)
    other.write_bytes((folder / "logs/as_built/soft/run000.csv").read_bytes())
    result = invoke("validate", folder / "out", "--data", tmp_path)
    assert result.exit_code == 2
    assert "'ice'" in result.stderr
    assert "identified: soft" in result.stderr
    lost = tmp_path / "lost"
    shutil.copytree(folder / "out", lost)
    (lost / "fit.json").unlink()
    result = invoke("validate", lost, "--data", folder / "unseen")
    assert result.exit_code == 2
    assert "fit.json: missing, though identified.json beside it is of a fit" in result.stderr


@pytest.mark.slow
def test_validate_predicts_the_runs_that_a_glob_names(small, tmp_path):
    folder, _ = small
    target = tmp_path / "v.json"
    words = ("validate", folder / "out", "--data", folder / "logs", "--logs")
    result = invoke(*words, "as_built/soft/run00[12].csv", "--json", target)
    assert result.exit_code == 0, result.stderr
    runs = json.loads(target.read_text())["runs"]
    assert sorted(run["name"] for run in runs) == [f"as_built/soft/run00{k}.csv" for k in (1, 2)]
    ice = tmp_path / "as_built" / "ice" / "a.csv"
    ice.parent.mkdir(parents=True)
    ice.write_bytes((folder / "logs/as_built/soft/run000.csv").read_bytes())
    result = invoke("validate", folder / "out", "--data", tmp_path, "--logs", "*/ice/*.csv")
    assert result.exit_code == 2
    assert "'ice'" in result.stderr
    assert "identified: soft" in result.stderr
    for glob, said in (
        ("as_built/*/x*.csv", "no file matches 'as_built/*/x*.csv'; expected at least one"),
        ("/tmp/*.csv", "--logs '/tmp/*.csv': "),
    ):
        result = invoke(*words, glob)
        assert result.exit_code == 2
        assert said in result.stderr


def test_files_of_no_section_are_read_as_all_sections_say_and_refused_if_these_differ(tmp_path):
    for name in ("new/a.csv", "one_surface/gray/b.csv"):
        (tmp_path / name).parent.mkdir(parents=True)
        (tmp_path / name).touch()
    config = read_config(packaged_path("robotino2022.toml"))
    one, other = single_floor_sections(config.content.logs)
    found = matching_files(config, [one], tmp_path, "**/*.csv")
    assert [(section, [path.name for path in paths]) for section, paths in found] == [
        (one, ["b.csv"]),
        (one, ["a.csv"]),
    ]
    with pytest.raises(DataError, match=r"new/a.csv: .* no section .* that match one of 'one_surf"):
        matching_files(config, [one, other], tmp_path, "**/*.csv")


@pytest.mark.slow
def test_check_reports_before_the_fit(small, tmp_path):
    folder, _ = small
    out = tmp_path / "check"
    result = invoke("check", folder / "my.toml", "--data", folder / "logs", "--out", out)
    assert result.exit_code == 0, result.stderr
    found = json.loads((out / "check.json").read_text(), parse_constant=pytest.fail)
    keys = ("surface", "load", "session", "runs", "headings", "speeds")
    assert [tuple(group[k] for k in keys) for group in found["groups"]] == [
        ("soft", "as_built", f"soft/as_built/{v:.2f}", 6, 6, [v]) for v in (0.1, 0.3)
    ]
    assert "voltage" in found["channels"]
    assert "current (unsigned)" in found["channels"]
    assert found["parameters"]["motor.resistance"]["verdict"] == "identified"
    assert found["parameters"]["robot.mass"]["verdict"] == "fixed"
    assert found["derived"]["motor.resistance/motor.back_emf"]["verdict"] == "identified"
    picture = (out / "raw_soft_as_built.png").read_bytes()
    assert picture[:8] == b"\x89PNG\r\n\x1a\n"


@pytest.mark.slow
def test_a_fit_that_does_not_converge_exits_with_1_and_reports_it(small, tmp_path):
    folder, _ = small
    config = tmp_path / "short.toml"
    text = packaged_config("robotino.toml").replace("rounds = 30 ", "rounds = 1  ")
    config.write_text(text, encoding="utf-8")
    result = invoke("identify", config, "--data", folder / "logs", "--out", tmp_path / "out")
    assert result.exit_code == 1
    assert "NOT converged: 1 rounds without convergence" in result.stdout
    assert json.loads((tmp_path / "out/fit.json").read_text())["converged"] is False


# interrupts -------------------------------------------------------------------------------------


def endless(target: Path) -> Path:
    """The config of the small job with a tolerance that takes many rounds."""
    text = packaged_config("robotino.toml").replace("tolerance = 0.02", "tolerance = 1e-12")
    target.write_text(text.replace("rounds = 30 ", "rounds = 14 "), encoding="utf-8")
    return target


def stopped(config: Path, data: Path, out: Path, how: signal.Signals) -> subprocess.Popen:
    """A fit stopped by a signal some rounds after its first checkpoint."""
    run = process("identify", config, "--data", data, "--out", out)
    deadline = time.monotonic() + 300
    while not (out / "checkpoint.npz").exists():
        assert run.poll() is None, run.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.02)
    run.send_signal(how)
    return run


@pytest.mark.slow
def test_a_killed_fit_goes_on_and_ends_where_it_would_have(small, tmp_path):
    folder, _ = small
    config, data = endless(tmp_path / "long.toml"), folder / "logs"
    killed = stopped(config, data, tmp_path / "a", signal.SIGKILL)
    killed.communicate(timeout=60)
    assert killed.returncode == -signal.SIGKILL
    assert [p.name for p in (tmp_path / "a").iterdir() if p.suffix == ".json"] == []
    again, whole = (
        invoke("identify", config, "--data", data, "--out", tmp_path / name) for name in "ab"
    )
    assert again.exit_code == whole.exit_code == 1  # the tolerance is out of reach
    assert "resuming from round" in again.stderr
    one, other = (json.loads((tmp_path / k / "fit.json").read_text()) for k in "ab")
    assert one["z"] == pytest.approx(other["z"], rel=1e-9, abs=1e-12)
    assert one["history"] == pytest.approx(other["history"], rel=1e-9)
    assert one["rounds"] == other["rounds"] == len(one["history"]) > 10


@pytest.mark.slow
def test_an_interrupt_that_python_must_ignore_where_it_arrives_stops_the_command():
    code = """if True:
        import gc, signal, time
        from slipid.cli import main as cli
        from slipid.app import check

        def collecting(phase, info):
            gc.callbacks.remove(collecting)
            signal.raise_signal(signal.SIGINT)

        def work(*_):
            gc.callbacks.append(collecting)
            gc.collect()
            print("went on")
            for _ in range(300):
                time.sleep(0.1)

        signal.signal(signal.SIGINT, signal.default_int_handler)
        check.check = work
        cli.AGAIN_S = 3.0  # a busy machine may be slow to print
        cli.main()
    """
    words = [sys.executable, "-c", code, "check", "configs/omni3.toml", "--data", "."]
    run = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert run.stdout == "went on\n"
    assert "interrupted" in run.stderr
    assert "Traceback" not in run.stderr
    assert run.returncode == 130


@pytest.mark.slow
def test_an_interrupt_is_130_and_keeps_the_checkpoint(small, tmp_path):
    folder, _ = small
    config = endless(tmp_path / "long.toml")
    run = stopped(config, folder / "logs", tmp_path / "out", signal.SIGINT)
    _, stderr = run.communicate(timeout=60)
    assert run.returncode == 130
    assert "interrupted" in stderr
    assert "Traceback" not in stderr
    assert (tmp_path / "out" / "checkpoint.npz").exists()
    assert not (tmp_path / "out" / "identified.json").exists()


# posterior --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_posterior_that_has_not_converged_is_marked_everywhere(sampled):
    out, result = sampled
    assert result.exit_code == 1, result.stderr
    assert "NOT converged" in result.stdout
    about = json.loads((out / "sample.json").read_text())
    assert about["converged"] is False
    found = json.loads((out / "identified.json").read_text())
    assert any("did not converge" in said for said in found["messages"])
    import xarray

    with xarray.open_datatree(out / "posterior.nc", engine="h5netcdf") as tree:
        assert tree.attrs["converged"] == "False"
    assert read_results(out).draws


@pytest.mark.slow
def test_a_posterior_that_has_converged_is_0_and_takes_its_blocks_away(
    sampled, tmp_path, monkeypatch
):
    from slipid.infer.posterior import diagnosis
    from slipid.infer.posterior import sample as posterior

    shutil.copytree(sampled[0], tmp_path / "out")
    out, found = tmp_path / "out", diagnosis.diagnose
    assert list(out.glob("sampling/*.npz"))
    monkeypatch.setattr(
        diagnosis, "diagnose", lambda chain, plan: replace(found(chain, plan), converged=True)
    )
    monkeypatch.setattr(posterior, "MOST_REFUSED", 1.0)
    result = invoke("sample", out, *FEW)
    assert result.exit_code == 0, result.output
    assert "converged: worst is" in result.stdout
    assert not (out / "sampling").exists()
    said = json.loads((out / "identified.json").read_text())
    assert not any("did not converge" in sentence for sentence in said["messages"])
    assert stat.S_IMODE((out / "posterior.nc").stat().st_mode) == stat.S_IMODE(
        (out / "sample.json").stat().st_mode
    )


@pytest.mark.slow
def test_quotients_have_the_intervals_of_their_draws(sampled):
    import xarray

    found = json.loads((sampled[0] / "identified.json").read_text())
    with xarray.open_datatree(sampled[0] / "posterior.nc", engine="h5netcdf") as tree:
        draws = tree["posterior"]["motor.resistance"] / tree["posterior"]["motor.back_emf"]
        expected = np.quantile(draws.values, [0.05, 0.95]).tolist()
    ratio = found["derived"]["motor.resistance/motor.back_emf"]
    assert ratio["interval90"] == pytest.approx(expected)


@pytest.mark.slow
def test_posterior_nc_has_the_groups_of_arviz_and_names_for_everything(sampled):
    import xarray

    out, _ = sampled
    found = json.loads((out / "identified.json").read_text())
    with xarray.open_datatree(out / "posterior.nc", engine="h5netcdf") as tree:
        assert set(tree.children) == {
            *("posterior", "sample_stats", "log_likelihood", "posterior_predictive"),
            *("observed_data", "unconstrained_posterior"),
        }
        posterior = tree["posterior"]
        assert posterior["robot.load_share"].dims == ("chain", "draw", "load", "wheel")
        np.testing.assert_allclose(posterior["robot.load_share"].sum("wheel"), 1.0)
        creep = posterior["surface.creep"]
        assert creep.dims == ("chain", "draw", "surface")
        assert creep.shape[:2] == (4, 10)
        floor = str(creep.surface[0].values)
        low, high = found["parameters"][f"surface.{floor}.creep"]["interval90"]
        draws = creep.sel(surface=floor).values.ravel()
        assert [low, high] == pytest.approx(np.quantile(draws, [0.05, 0.95]).tolist())
        runs = tree["log_likelihood"]["motion"]
        assert runs.dims == ("chain", "draw", "run")
        assert sorted(runs.run.values) == sorted(found["data"]["runs"])
        measured, new = (
            tree[group]["increment"] for group in ("observed_data", "posterior_predictive")
        )
        assert new.dims[2:] == measured.dims == ("piece", "window", "direction")
        inside = (new.quantile(0.05, ("chain", "draw")) < measured) & (
            measured < new.quantile(0.95, ("chain", "draw"))
        )
        assert 0.7 < float(inside.mean()) < 1.0
    sources = {p["source"] for p in found["parameters"].values() if p["verdict"] != "fixed"}
    assert sources == {"posterior"}


@pytest.mark.slow
def test_sampling_that_was_killed_ends_as_if_it_had_not_been(sampled, small, tmp_path):
    whole, _ = sampled
    out = tmp_path / "out"
    shutil.copytree(small[0] / "out", out)
    run = process("sample", out, *FEW)
    deadline = time.monotonic() + 120
    while len(list(out.glob("sampling/*.npz"))) < 3:
        assert run.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.02)
    run.kill()
    run.communicate()
    kept = len(list(out.glob("sampling/*.npz")))
    result = invoke("sample", out, *[w for w in FEW if w != "--quiet"])
    assert f"continuing from block {kept} " in result.output
    import xarray

    with (
        xarray.open_datatree(whole / "posterior.nc", engine="h5netcdf") as one,
        xarray.open_datatree(out / "posterior.nc", engine="h5netcdf") as other,
    ):
        for group in ("unconstrained_posterior", "sample_stats"):
            xarray.testing.assert_equal(one[group].to_dataset(), other[group].to_dataset())


@pytest.mark.slow
def test_sample_refuses_logs_that_were_not_fitted(small, tmp_path):
    folder, _ = small
    out = tmp_path / "out"
    shutil.copytree(folder / "out", out)
    result = invoke("sample", out, "--data", folder / "unseen")
    assert result.exit_code == 2
    assert "since the fit" in result.stderr
    assert not (out / "sampling").exists()
    result = invoke("sample", tmp_path / "nothing")
    assert result.exit_code == 2
    assert "slipid identify" in result.stderr


# files ------------------------------------------------------------------------------------------


def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    path = tmp_path / "a.json"
    write_json(path, {"x": 1.5})
    with pytest.raises(ValueError, match="JSON"):
        write_json(path, {"x": float("inf")})

    def crash(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", crash)
    with pytest.raises(DataError, match=r"a\.json: cannot be written"):
        write_bytes(path, b"new")
    assert json.loads(path.read_text()) == {"x": 1.5}
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]


# export ---------------------------------------------------------------------------------------


@pytest.mark.slow
def test_export_writes_a_folder_and_detects_a_changed_byte(small, tmp_path):
    out = tmp_path / "to_go"
    done = invoke(
        "export", small[0] / "out", "--to", "table, ros2", "--out", out, "--json", "-", "--quiet"
    )
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    assert found["forms"] == ["ros2", "table"]
    assert all((out / name).is_file() for name in found["files"])
    for _ in range(2):  # the JSON of an earlier result is replaced
        assert invoke("export", out, "--check", "--json", tmp_path / "c.json").exit_code == 0
    path = out / "table/gains.csv"
    written = path.read_bytes()
    path.write_bytes(written.replace(b"1", b"2", 1))
    told = invoke("export", out, "--check")
    assert told.exit_code == 2
    assert "gains.csv: changed or damaged" in told.output
    words = ("export", out / "robot.json", "--to", "table", "--out", out, "--quiet")
    refused = invoke(*words)
    assert refused.exit_code == 2
    assert "gains.csv: changed since it was exported, and would be overwritten" in refused.output
    path.write_bytes(written)
    again = invoke(*words)
    assert again.exit_code == 0, again.output
    assert not (out / "ros2").exists()


def test_export_names_missing_options(tmp_path):
    assert "robot.json: missing" in invoke("export", tmp_path, "--out", tmp_path / "o").output
    told = invoke("export", tmp_path)
    assert told.exit_code == 2
    assert "--out is missing" in told.output
    assert invoke("export", tmp_path, "--check").exit_code == 2


@pytest.mark.slow
def test_a_folder_that_cannot_be_written_to_is_refused_before_the_work(tmp_path):
    (tmp_path / "file").write_text("")
    path = tmp_path / "file" / "x.toml"
    with pytest.raises(DataError, match=r"x\.toml: cannot be written"):
        write_bytes(path, b"")
    with pytest.raises(DataError, match="cannot be written"):
        writable(tmp_path / "file" / "out")
    writable(tmp_path / "new")
    assert list((tmp_path / "new").iterdir()) == []
