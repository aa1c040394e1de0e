"""What several test files need and what takes long is made once for all of their processes."""

from __future__ import annotations

import fcntl
import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import pytest
from typer.testing import CliRunner

from slipid.app.logs import packaged_config
from slipid.cli.main import app
from slipid.lab.selftest.logs import (
    PlannedRun,
    SimulatedSensors,
    heading_grid,
    simulate_logs,
    true_robot,
)
from tests.helpers.made_logs import write_logs

DRIVES = heading_grid(setups=(("soft", "as_built"),), headings=6, speeds=(0.1, 0.3), turns=0)
UNSEEN = [type(d)(d.surface, d.load, d.heading + 0.4, d.speed) for d in DRIVES[:3]]
FEW = ("--draws", "10", "--most", "40", "--block", "2", "--quiet")  # blocks: 36 are to warm up


@dataclass(frozen=True)
class Said:
    """How a command ended and what it wrote."""

    exit_code: int
    stdout: str
    stderr: str


def invoke(*words: object):
    """A command of slipid in this process."""
    return CliRunner().invoke(app, [str(w) for w in words])


def once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], Said]):
    """A folder and what was said when it was made, by whichever process came first."""
    root = factory.getbasetemp()
    if root.name.startswith("popen-"):  # of a worker of xdist: beside those of the others
        root = root.parent
    folder, said = root / name, root / f"{name}.json"
    with (root / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not said.exists():
            folder.mkdir()
            said.write_text(json.dumps(asdict(make(folder))), encoding="utf-8")
    return folder, Said(**json.loads(said.read_text(encoding="utf-8")))


def identify(folder: Path, drives: Sequence[PlannedRun] = DRIVES) -> Said:
    """A config, made logs, unseen logs, and the result of identify on them."""
    for name, some, seed in (("logs", drives, 1), ("unseen", UNSEEN, 2)):
        robot = true_robot(some)
        write_logs(
            simulate_logs(robot, some, seed, SimulatedSensors()), robot, folder / name, folder / "t"
        )
    (folder / "my.toml").write_text(packaged_config("robotino.toml"), encoding="utf-8")
    args = ("identify", folder / "my.toml", "--data", folder / "logs", "--out", folder / "out")
    done = invoke(*args)
    return Said(done.exit_code, done.stdout, done.stderr)


def sample(fit: Path, out: Path) -> Said:
    """A copy of a fit, and what a `sample` of far too few steps says of it."""
    shutil.copytree(fit, out)
    done = invoke("sample", out, *FEW)
    return Said(done.exit_code, done.stdout, done.stderr)
