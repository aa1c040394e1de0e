"""What an experiment can recover: what `slipid selftest` does."""

from dataclasses import replace
from pathlib import Path

from slipid.data.runs import collect
from slipid.job.check import expected
from slipid.job.config import Config, one_floor, read_config
from slipid.job.logs import layout_of
from slipid.job.problem import Job, job_of, read_job, shape_of
from slipid.model.robot import build
from slipid.selftest import replicates as test
from slipid.selftest.known import Sensors, grid
from slipid.selftest.logs import make_logs
from slipid.selftest.summary import SCHEMA, summary, wanted_of
from slipid.support.checkpoint import Checkpoint, key_of
from slipid.support.content import Content
from slipid.support.files import writable, write_json
from slipid.support.jax_setup import setup_jax
from slipid.support.progress import Reporter


def selftest(
    config_path: Path, data: Path | None, out: Path, count: int, seed: int, report: Reporter
) -> Content:
    """What an experiment can recover, by making it with known truth and fitting that.

    Args:
        config_path: of the experiment.
        data: its logs, whose wheel motion is taken; without them a plan is made.
        out: folder for selftest.json and the replicates, which a later call goes on from.
        count: replicates.
        seed: of truths and noise.
        report: progress.

    Raises:
        DataError: config or logs are wrong.
    """
    setup_jax(quiet=True)
    config = read_config(config_path)
    job = planned(config, report) if data is None else read_job(config, data, report)
    problem = job.problem()
    wanted = wanted_of(config, problem)
    test.plausible(config, job.choices, problem)
    writable(out)
    report.stage("expected information")
    before = expected(job, problem)
    kept = Checkpoint(out, key_of(config.hash, job.data_hash, seed))
    rows = test.replicates(config, job.choices, problem, count, seed, kept, report)
    found = {
        "schema": SCHEMA,
        "source": "plan" if data is None else "logs",
        "runs": len(job.dataset),
        "seed": seed,
        "noise": dict(zip(problem.noise.names, problem.noise.typical.tolist(), strict=True)),
        **summary(rows, wanted),
        "messages": list(before.messages),
        "data": {"hash": job.data_hash},
    }
    write_json(out / "selftest.json", found)
    return found


def planned(config: Config, report: Reporter) -> Job:
    """Job of an experiment that nobody has driven yet: the grid of the config's `[selftest]`.

    Channels are those that the config's layouts name; every load set-up of the config is driven on
    every floor.

    Raises:
        DataError: a config that cannot be driven.
    """
    wanted, shape = config.content.selftest, shape_of(config)
    sections = one_floor(config.content.logs)
    loads = list(dict.fromkeys(section.load for section in sections))
    setups = [(floor, load) for floor in wanted.surfaces for load in loads]
    runs = grid(setups, wanted.headings, wanted.speeds_m_s, wanted.turns)
    drives = [replace(d, distance=wanted.distance_m) for d in runs]
    robot = build(shape, wanted.surfaces, loads, sorted({d.session for d in drives}))
    layouts = [layout_of(config, section) for section in sections]
    channels = [layout.channels.keys() for layout in layouts]
    has_current = all("current" in c for c in channels)
    has_voltage = all("voltage" in c or {"duty", "bus_voltage"} <= c for c in channels)
    is_signed = all(layout.current_is_signed for layout in layouts)
    made = make_logs(robot, drives, 0, Sensors(has_voltage=has_voltage))
    logs = [replace(log, current_is_signed=is_signed) for log in made]
    if not has_current:
        logs = [replace(log, current=None) for log in logs]
    report.line(f"no logs given: {len(logs)} runs of [selftest] on {', '.join(wanted.surfaces)}")
    return job_of(config, collect(logs), [], report)
