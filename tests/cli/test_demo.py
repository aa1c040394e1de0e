"""The demo: recorded logs of the test site, and a fit to a physics that slipid does not know."""

import json
import shutil
import subprocess
import sys
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest

from slipid.app import logs as packaged
from slipid.app.config import read_config
from slipid.app.logs import RECORDED, packaged_config, unpack
from slipid.app.problem import read_fit_task
from slipid.cli import demo
from slipid.cli.demo import PARTS, drive_anew
from slipid.lab.testsite.config import plan
from slipid.lab.testsite.driving import drive
from slipid.plots.motion import path_figure
from slipid.report.estimates import compared
from slipid.support.errors import DataError
from slipid.support.executor import InProcess
from slipid.support.progress import Reporter
from tests.helpers.golden_rows import of_identified, of_validation
from tests.helpers.recording import pack
from tests.helpers.shared import invoke


def test_the_recording_holds_logs_and_truth(tmp_path):
    unpack(tmp_path)
    files = {p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*") if p.is_file()}
    for part in PARTS:
        made = plan(Path("x"), packaged_config(f"testsite_{part}.toml"))
        assert {f"{part}/logs/{name}.csv" for name, _ in made.runs} <= files
        assert f"{part}/truth/truth.json" in files
    assert len(files) == 84 + 36 + 2
    assert RECORDED.stat().st_size < 1_000_000


def test_an_edited_config_is_kept(tmp_path):
    config = tmp_path / "robotino.toml"
    config.write_text("mine")
    result = invoke("demo", "--out", tmp_path)
    assert result.exit_code == 2
    assert "robotino.toml: no copy that slipid made for a fit, or changed" in result.stderr
    assert (config.read_text(), len(list(tmp_path.iterdir()))) == ("mine", 1)
    config.unlink()
    (tmp_path / "recorded").mkdir()
    (tmp_path / "recorded" / "mine.csv").touch()
    result = invoke("demo", "--out", tmp_path)
    assert result.exit_code == 2
    assert "mine.csv: no recorded log of this version of slipid, or changed" in result.stderr
    shutil.rmtree(tmp_path / "recorded")
    (tmp_path / "recorded").touch()
    assert "recorded: a file; expected a folder" in invoke("demo", "--out", tmp_path).stderr
    assert [p.name for p in tmp_path.iterdir()] == ["recorded"]
    (tmp_path / "result").mkdir()
    for name in ("report.html", "config.toml"):
        (tmp_path / "result" / name).write_text("mine")
        result = invoke("demo", "--out", tmp_path)
        assert result.exit_code == 2
        assert f"{name}: " in result.stderr
        assert "would be overwritten" in result.stderr
        (tmp_path / "result" / name).unlink()


def test_recorded_logs_are_unpacked_again_unless_they_were_edited(tmp_path):
    unpack(tmp_path)
    log = tmp_path / "fit" / "logs" / "as_built" / "firm" / "run000.csv"
    recorded = log.read_bytes()
    (tmp_path / "fit" / "truth" / "truth.json").unlink()  # as after an interrupt
    (tmp_path / ".DS_Store").write_text("of the system")
    for unchanged in (recorded.replace(b"\n", b"\r\n"), b"", bytes(1000)):
        log.write_bytes(unchanged)
        unpack(tmp_path)
        assert log.read_bytes() == recorded
    log.write_bytes(recorded + b"mine")
    with pytest.raises(DataError, match=r"run000\.csv: no recorded log of this version"):
        unpack(tmp_path)
    assert log.read_bytes().endswith(b"mine")


def test_packing_what_was_unpacked_gives_the_same_bytes(tmp_path):
    unpack(tmp_path)
    pack(tmp_path, tmp_path / "again.zip")
    assert (tmp_path / "again.zip").read_bytes() == RECORDED.read_bytes()


@pytest.mark.slow
def test_the_recording_is_what_its_config_drives():
    """To what another version of MuJoCo or another processor may change."""
    made = plan(Path("x"), packaged_config("testsite_fit.toml"))
    from slipid.lab.testsite.simulate import _seed

    name, run = made.runs[40]
    trace = drive(run, made.site, _seed(0, 40))
    with ZipFile(RECORDED) as archive:
        rows = archive.read(f"fit/logs/{name}.csv").decode().splitlines()
    last = dict(zip(rows[0].split(","), map(float, rows[-1].split(",")), strict=True))
    at = last["time"]
    x, y = (np.interp(at - 0.056, trace.time, trace.pose[:, k]) for k in (0, 1))
    assert np.hypot(x - 1.117e-3 * last["x"], y - 1.117e-3 * last["y"]) < 0.004
    tick = 2 * np.pi / 32000
    turned = np.interp(at, trace.time, trace.wheel_angle[:, 0])
    assert turned / tick == pytest.approx(last["ticks_1"], abs=60)


def test_a_plant_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(DataError, match="--plant gazebo: unknown; expected recorded or mujoco"):
        demo.run(tmp_path, "gazebo", None, InProcess(), Reporter(quiet=True))


def test_a_seed_for_what_is_recorded_is_refused(tmp_path):
    with pytest.raises(DataError, match="expected --plant mujoco with it"):
        demo.run(tmp_path, "recorded", 3, InProcess(), Reporter(quiet=True))


@pytest.mark.slow
def test_the_recording_needs_neither_mujoco_nor_opencv(tmp_path):
    code = (
        "import sys\n"
        "class Absent:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name.split('.')[0] in ('mujoco', 'cv2'):\n"
        "            raise ModuleNotFoundError(name, name=name)\n"
        "sys.meta_path.insert(0, Absent())\n"
        "from pathlib import Path\n"
        "from slipid.app.logs import packaged_config, unpack\n"
        "from slipid.support.progress import Reporter\n"
        "from slipid.lab.testsite.simulate import simulate\n"
        "from slipid.lab.testsite.config import plan\n"
        "from slipid.support.errors import DataError\n"
        f"unpack(Path({str(tmp_path)!r}))\n"
        "made = plan(Path('x'), packaged_config('testsite_unseen.toml'))\n"
        "try:\n"
        f"    simulate(made, Path({str(tmp_path / 'out')!r}), None, Reporter(quiet=True))\n"
        "except DataError as error:\n"
        "    print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "the virtual test site needs the package mujoco, which is not installed" in done.stdout
    assert (tmp_path / "fit" / "truth" / "truth.json").is_file()


def test_a_missing_recording_is_reported(tmp_path, monkeypatch):
    monkeypatch.setattr(packaged, "RECORDED", tmp_path / "gone.zip")
    with pytest.raises(DataError, match=r"gone\.zip: .*expected the recorded logs"):
        unpack(tmp_path)


def test_driving_anew_drives_what_ships(tmp_path, monkeypatch):
    seen = {}
    monkeypatch.setattr(
        "slipid.lab.testsite.simulate.simulate",
        lambda made, out, executor, report: seen.update({out.name: made}),
    )
    drive_anew(tmp_path, 0, InProcess(), Reporter(quiet=True))
    shipped = {p: plan(Path("x"), packaged_config(f"testsite_{p}.toml")) for p in PARTS}
    assert {p: made.hash for p, made in seen.items()} == {p: m.hash for p, m in shipped.items()}
    drive_anew(tmp_path, 3, InProcess(), Reporter(quiet=True))
    assert [seen[p].content.seed for p in PARTS] == [6, 7]


@pytest.mark.slow
def test_the_demo_finds_the_motor_weighs_the_robot_and_beats_the_encoders(tmp_path, golden):
    """Bars for logs whose physics slipid's model does not share; left-out headings."""
    done, found, truth = demo.run(tmp_path, "recorded", None, InProcess(), Reporter(quiet=True))
    rows = compared(done.fit, truth)
    assert done.fit.converged
    errors = {(r.path, r.label): r.value - r.truth for r in rows}
    for path in ("motor.resistance", "motor.back_emf"):
        row = next(r for r in rows if r.path == path)
        assert row.value == pytest.approx(row.truth, rel=0.03)
        assert row.inside
    shares = [e for (path, _), e in errors.items() if path.startswith("robot.load_share")]
    assert len(shares) == 6
    assert np.abs(shares).max() < 0.03
    for floor in ("soft", "soft@moved"):
        by = found["summary"][floor]
        mine, encoder = (by[m]["endpoint_error_mean"] for m in ("identified", "encoder"))
        assert encoder > 4 * mine
    assert json.loads((tmp_path / "result" / "validation.json").read_text()) == found
    identified = json.loads((tmp_path / "result" / "identified.json").read_text())
    golden("demo_identified", list(of_identified(identified)), rtol=1e-3, atol=1e-6)
    golden("demo_validation", list(of_validation(found)), rtol=1e-3, atol=1e-6)
    # the picture of the paths says what the table says
    config = read_config(tmp_path / "result" / "config.toml")
    data = read_fit_task(
        config, tmp_path / "recorded" / "unseen" / "logs", Reporter(quiet=True)
    ).dataset
    order = [("firm", "as_built"), ("soft", "as_built"), ("soft", "moved")]
    fit = done.fit
    drawn = path_figure(fit.robot, fit.tracks, data, order, "unseen runs", fit.config_shape).axes
    for ax, floor in zip(drawn, ("firm", "soft", "soft@moved"), strict=False):
        by = found["summary"][floor]
        mine = 100 * by["selected"]["endpoint_error_over_path_mean"]
        assert f"off by {mine:.1f} % of the path" in ax.get_title()
