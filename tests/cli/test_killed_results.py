"""A result folder whose writers are killed, or whose disk is full, at any step: never a mixture."""

from __future__ import annotations

import contextlib
import itertools
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slipid.app import identify as app
from slipid.app.config import read_config
from slipid.app.problem import read_fit_task
from slipid.cli.identify import run
from slipid.deploy import deploy
from slipid.deploy.deploy import read_robot
from slipid.infer.fit_file import load
from slipid.infer.result_folder import OF_FIT, fit_of
from slipid.report.html import fit_page
from slipid.report.html.evidence import read_evidence
from slipid.report.html.results import read_results
from slipid.robot.deployed import DeployedRobot
from slipid.support.errors import DataError
from slipid.support.files import write_bytes
from slipid.support.folder import locked
from slipid.support.progress import Reporter
from tests.helpers.killed_writes import Killed, dies_at, disk_full_at
from tests.helpers.later_files import LATER
from tests.helpers.shared import FEW, invoke

pytestmark = pytest.mark.slow
BEFORE, FIRST, SECOND = 1.0, 2.0, 3.0
"""Numbers of the fits that replace each other in one folder, the last two by refits."""


class Refits:
    """Refits of one folder as `slipid identify` writes them, without the work before."""

    def __init__(self, folder: Path, patch: pytest.MonkeyPatch):
        self.data, out = folder / "logs", folder / "out"
        self.report = Reporter(quiet=True)
        self.task = read_fit_task(read_config(folder / "my.toml"), self.data, self.report)
        self.fit, self.record = load(out), read_robot(out).record
        self.evidence = read_evidence(out / "evidence.json")
        patch.setattr("slipid.cli.identify.can_draw", lambda _: True)
        patch.setattr("slipid.cli.identify._draw", self._draw)
        patch.setattr(fit_page, "evidence_of_fit", lambda *_: self.evidence)
        patch.setattr(fit_page, "try_page", self._page)
        patch.setattr(deploy, "robot_feedforwards", lambda _: [])
        patch.setattr(deploy, "deploy", lambda fit: self.robots[fit.remaining])
        patch.setattr(app, "fitted", lambda *_: (self.now, None, None))
        numbers = (BEFORE, FIRST, SECOND)
        self.robots = {
            n: DeployedRobot.of(replace(self.record, highest_speed=n + 5)) for n in numbers
        }

    def write(self, out: Path, number: float) -> None:
        """The result whose fit, robot, config and page have this number."""
        self.now = replace(self.fit, remaining=number)
        config = self.task.config
        task = replace(self.task, config=replace(config, text=f"{config.text}\n# {number}\n"))
        run(task, self.data, out, self.report)

    @staticmethod
    def _draw(done, out: Path, _: Reporter) -> list[Path]:
        write_bytes(out / "paths.png", str(done.fit.remaining).encode())
        return [out / "paths.png"]

    def _page(self, _, path: Path, __) -> tuple[str]:
        write_bytes(path, str(self.now.remaining).encode())
        return (path.name,)


@pytest.fixture(scope="module")
def refits(small):
    with pytest.MonkeyPatch.context() as patch:
        yield Refits(small[0], patch)


def versions(out: Path) -> dict[str, set[float]]:
    """Numbers of the results that each reading command finds; none where it refuses."""
    found: dict[str, set[float]] = {"files": set()}
    with contextlib.suppress(DataError):
        found["fit"] = {load(out).remaining}
        found["fit"].add(float(read_config(out / "config.toml").text.split()[-1]))
    with contextlib.suppress(DataError):
        found["robot"] = {read_robot(out).record.highest_speed - 5}
    with contextlib.suppress(DataError):
        results = read_results(out)
        found["page"] = {results.fit["remaining"]}
        assert results.evidence is None or results.evidence.fit == results.fit["checksum"]
        assert results.run["fit"] == results.identified["fit"] == results.fit["checksum"]
        assert results.draws is None or found["page"] == {BEFORE}
    for name in ("paths.png", "report.html"):
        if (out / name).exists():
            found["files"].add(float((out / name).read_text()))
    if (out / "posterior.nc").exists():
        found["files"].add(BEFORE)
    return found


def whole(refits: Refits, sampled: Path, out: Path) -> None:
    """A folder with all that commands write, the posterior included."""
    refits.write(out, BEFORE)
    fit = json.loads((out / "fit.json").read_text())["checksum"]
    for name in ("posterior.nc", "posterior_pairs.png"):
        shutil.copy(sampled / name, out / name)
    for name, content in LATER.items():
        (out / f"{name}.json").write_text(json.dumps({"fit": fit, **content}))
    (out / "mine.txt").write_text("notes")


@pytest.mark.parametrize("broken", [dies_at, disk_full_at])
def test_two_refits_and_a_killed_one_never_mix(refits, sampled, tmp_path, broken):
    first = tmp_path / "first"
    whole(refits, sampled[0], first)

    def present(out, sample):  # a posterior that is not that of sample.json is refused
        return {} if sample is not None and (out / "posterior.nc").exists() else None

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("slipid.report.html.results._draws", present)
        assert versions(first)["page"] == {BEFORE}
        rng = np.random.default_rng(0)
        for step in itertools.count():
            out = tmp_path / "out"
            shutil.copytree(first, out)
            ended = False
            with contextlib.suppress(Killed, DataError), broken(step):
                refits.write(out, FIRST)
                ended = True
            each = versions(out)
            assert len(set().union(*each.values())) <= 1, (step, each)
            with contextlib.suppress(Killed, DataError), broken(int(rng.integers(25))):
                refits.write(out, SECOND)
            each = versions(out)
            assert len(set().union(*each.values())) <= 1, (step, each)
            with locked(out, "identify"):
                refits.write(out, SECOND)
            assert versions(out) == {key: {SECOND} for key in ("files", "fit", "robot", "page")}
            arrays = json.loads((out / "fit.json").read_text())["arrays"]["file"]
            expected = {"config.toml", "fit.json", "evidence.json", "identified.json", "mine.txt"}
            expected |= {"paths.png", "report.html", "robot.json", "run.json", arrays}
            assert {p.name for p in out.iterdir()} == expected
            shutil.rmtree(out)
            if ended:
                break
    assert step >= (9 if broken is disk_full_at else 25)


def test_every_file_of_a_result_is_known_to_depend_on_the_fit(small, sampled):
    from slipid.plots import fit, posterior

    drawn = {*fit.FIGURES, *(f"posterior_{name}" for name in posterior.FIGURES)}
    assert {f"{name}.png" for name in drawn} <= {*OF_FIT}
    plain = {"sampling", "fit.json", "config.toml", "run.json"}
    for out in (small[0] / "out", sampled[0]):
        arrays = json.loads((out / "fit.json").read_text())["arrays"]["file"]
        names = {p.name for p in out.iterdir()} - plain - {arrays}
        assert names <= {*OF_FIT}


def test_the_same_fit_again_keeps_what_was_made_from_it(refits, sampled, tmp_path):
    whole(refits, sampled[0], tmp_path)
    (tmp_path / "posterior.nc").unlink()  # the page refuses that of a different chain
    before = {p.name for p in tmp_path.iterdir()}
    load(tmp_path).save(tmp_path)
    assert {p.name for p in tmp_path.iterdir()} == before
    refits.write(tmp_path, BEFORE)
    assert {p.name for p in tmp_path.iterdir()} == before
    replace(load(tmp_path), remaining=SECOND).save(tmp_path)  # no config is known to this one
    assert load(tmp_path).remaining == SECOND
    arrays = json.loads((tmp_path / "fit.json").read_text())["arrays"]["file"]
    kept = {"mine.txt", "fit.json", "identified.json", arrays}
    assert {p.name for p in tmp_path.iterdir()} == kept


def test_an_identified_json_without_its_fit_is_refused(refits, tmp_path):
    refits.write(tmp_path, FIRST)
    path = tmp_path / "identified.json"
    content = json.loads(path.read_text())
    del content["fit"]
    path.write_text(json.dumps(content))
    with pytest.raises(DataError, match=r"belongs to a different fit than fit\.json"):
        load(tmp_path)


def test_a_robot_or_a_posterior_of_a_different_result_is_refused(refits, sampled, tmp_path):
    for number in (FIRST, SECOND):
        refits.write(tmp_path / str(number), number)
    one, other = tmp_path / str(FIRST), tmp_path / str(SECOND)
    for name, read in (("robot.json", read_robot), ("evidence.json", read_results)):
        kept = (one / name).read_bytes()
        (one / name).write_bytes((other / name).read_bytes())
        with pytest.raises(DataError, match=rf"{name}: .*run `slipid identify`.* again"):
            read(one)
        (one / name).write_bytes(kept)
    shutil.copy(sampled[0] / "posterior.nc", one)
    (one / "sample.json").write_text(json.dumps(LATER["sample"] | {"fit": fit_of(one)}))
    with pytest.raises(DataError, match=r"posterior\.nc: damaged, or of a different chain"):
        read_results(one)


def test_a_disk_that_is_full_after_sampling_loses_no_block(sampled, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(sampled[0], out)
    blocks = sorted(p.name for p in (out / "sampling").iterdir())
    with disk_full_at(0):
        ended = invoke("sample", out, *FEW)
    assert ended.exit_code == 2
    assert "identified.json: cannot be written (No space left on device)" in ended.stderr
    assert sorted(p.name for p in (out / "sampling").iterdir()) == blocks
    assert load(out).remaining == load(sampled[0]).remaining
    again = invoke("sample", out, *[word for word in FEW if word != "--quiet"])
    assert f"continuing from block {len(blocks)} " in again.stderr
    assert (out / "posterior.nc").exists()
