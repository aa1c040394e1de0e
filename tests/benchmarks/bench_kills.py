"""Long commands killed at random moments, forty times in all, against the same left in peace."""

from __future__ import annotations

import csv
import json
import shutil
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import xarray

from slipid.app.logs import packaged_config
from slipid.deploy.deploy import read_robot
from slipid.infer.fit_file import load
from slipid.infer.result_folder import fit_of
from slipid.support.errors import DataError
from slipid.support.folder import LOCK, name_of_temporary
from tests.benchmarks.quick import quick
from tests.cli import test_cli
from tests.helpers import made_bench
from tests.helpers.track_command import LONE, ROBOT, made_in

TIMES = ("seconds", "fit_s", "predict_s", "tune_s", "finished", "step_us", "row_us", "checksum")
"""Keys of what differs between two equal results: times, and hashes of what has times."""
CLOSE = 1e-9
"""Largest relative difference between numbers of equal results."""


@dataclass(frozen=True)
class Job:
    """A long command, and how often it is killed.

    Attributes:
        kills: number of kills.
        words: command and options without `--out`.
        result: names of the files that must be equal, in the folder.
        before: folder from which it starts; None for an empty one.
        out: how the command is given its folder.
    """

    kills: int
    words: tuple[object, ...]
    result: tuple[str, ...]
    before: Path | None = None
    out: Callable[[Path], tuple[object, ...]] = lambda folder: ("--out", folder)


@pytest.fixture(scope="module")
def jobs(small, tmp_path_factory) -> dict[str, Job]:
    folder, made = small[0], tmp_path_factory.mktemp("made")
    (made / "nothing").mkdir()
    config = made / "other.toml"  # another fit than the one in the folder
    text = packaged_config("robotino.toml").replace("tolerance = 0.02", "tolerance = 1e-5")
    config.write_text(text, encoding="utf-8")
    film = made_in(made)
    video = film.video("long", ROBOT, count=400)
    bench = made_bench.logged(made_bench.driven(made_bench.FLYWHEEL), 100, 3)
    logs, parallel, first = ("--data", folder / "logs"), ("--jobs", 2), folder / "out"
    few = ("--draws", 40, "--most", 60, "--block", 4)
    fit = ("identified.json", "robot.json")
    starts = ("--plant", "twin", "--starts", 3, "--controllers", "encoder,contact")
    return {
        "identify": Job(6, ("identify", config, *logs), (*fit, "fit.json"), first),
        "sample": Job(6, ("sample", *few), ("posterior.nc", *fit), first, lambda out: (out,)),
        "compare": Job(6, ("compare", config, *logs, "--folds", "sectors"), ("comparison.json",)),
        "selftest": Job(
            5, ("selftest", config, *logs, "--replicates", 4), ("selftest.json", "replicates.json")
        ),
        "benchmark": Job(
            5, ("benchmark", "--data", made / "nothing", "--quick", *parallel), ("benchmark.json",)
        ),
        "trial": Job(5, ("trial", *starts, *parallel), ("trial.json",), first, lambda out: (out,)),
        "motor": Job(3, ("motor", made_bench.write(bench, made / "bench.csv")), ("motor.json",)),
        "track": Job(
            4,
            ("track", video, "--camera", film.camera, *LONE[:-1]),
            ("poses.csv",),
            out=lambda folder: ("--out", folder / "poses.csv"),
        ),
    }


def start(job: Job, out: Path) -> subprocess.Popen:
    if not out.exists():
        shutil.copytree(job.before, out) if job.before else out.mkdir()
    return test_cli.process(job.words[0], *job.out(out), *job.words[1:], "--quiet")


def ended(run: subprocess.Popen) -> int:
    """The exit code of a command that ended as commands do."""
    _, stderr = run.communicate()
    assert run.returncode in (0, 1), stderr
    return run.returncode


def numbers_of(value: object, where: str = "") -> dict[str, object]:
    """Plain values by their place, without times."""
    if isinstance(value, dict):
        items = {k: v for k, v in value.items() if k not in TIMES}.items()
    elif isinstance(value, list):
        items = enumerate(value)
    else:
        return {where: value}
    return {k: v for name, one in items for k, v in numbers_of(one, f"{where}/{name}").items()}


def content(path: Path) -> dict[str, object]:
    if path.suffix == ".csv":
        rows = list(csv.reader(path.read_text(encoding="utf-8").splitlines()))
        return {f"{n}/{k}": cell for n, row in enumerate(rows) for k, cell in enumerate(row)}
    if path.suffix == ".nc":
        with xarray.open_datatree(path, engine="h5netcdf") as tree:
            return {
                f"{group}/{name}/{k}": x
                for group in tree.children
                for name, array in tree[group].data_vars.items()
                for k, x in enumerate(array.values.ravel().tolist())
            }
    return numbers_of(json.loads(path.read_text(encoding="utf-8")))


def difference(one: Path, other: Path, result: tuple[str, ...], close: float) -> float:
    """The largest relative difference between two results; other values must be equal."""
    most = 0.0
    for name in result:
        mine, theirs = content(one / name), content(other / name)
        assert mine.keys() == theirs.keys(), name
        for place, x in mine.items():
            y = theirs[place]
            if x == y or (x != x and y != y) or place in ("/fit", "/robot", "/numbers"):
                continue
            try:
                x, y = float(x), float(y)
            except (TypeError, ValueError):
                pytest.fail(f"{name}{place}: {x} and {y}")
            off = abs(x - y) / max(abs(x), abs(y), 1e-3)
            assert off <= close, (name, place, x, y)
            most = max(most, off)
    return most


def refuse_mixture(out: Path) -> str:
    """Return `one fit` or `no fit`, or the message by which a folder is refused after a kill."""
    try:
        fit_of(out)
        if (out / "fit.json").exists():
            load(out)
            read_robot(out)
        return "one fit" if (out / "fit.json").exists() else "no fit"
    except DataError as error:
        return str(error).partition(": ")[2][:60]


NAMES = ("identify", "sample", "compare", "selftest", "benchmark", "trial", "motor", "track")


@pytest.mark.parametrize("name", quick(NAMES, ("motor",)))
def test_a_killed_command_ends_as_if_it_had_not_been(name, jobs, tmp_path):
    job, rng = jobs[name], np.random.default_rng(NAMES.index(name))
    close = 2e-2 if name == "track" else CLOSE  # 0.02 mm: a marker is found anew after a restart
    whole, out = tmp_path / "whole", tmp_path / "out"
    began = time.perf_counter()
    code = ended(start(job, whole))
    took = time.perf_counter() - began
    killed, most, restarts, found = 0, 0.0, 0, []
    while killed < quick(job.kills, 1):
        run = start(job, out)
        try:
            run.wait(rng.uniform(0.05, 0.9) * took)
        except subprocess.TimeoutExpired:
            run.kill()
            run.communicate()
            killed += 1
            found.append(refuse_mixture(out))
            continue
        assert ended(run) == code  # done before the kill: once more from the beginning
        most = max(most, difference(whole, out, job.result, close))
        restarts += 1
        shutil.rmtree(out)
    assert ended(start(job, out)) == code
    most = max(most, difference(whole, out, job.result, close))
    left = [p.name for p in out.rglob(".*") if name_of_temporary(p.name) or p.name == LOCK]
    assert not left
    print(
        f"\n{name}: {took:.0f} s in peace, killed {killed} times, {restarts + 1} results, largest "
        f"relative difference {most:.1e}; after the kills: {sorted(set(found))}"
    )
