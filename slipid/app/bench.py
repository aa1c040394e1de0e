"""Motors on a bench: from a config, or a single file, to their numbers and files."""

import fnmatch
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from slipid.app import logs as of_config
from slipid.app.config import BenchMotors, Config
from slipid.data.check.columns import refuse_misordered
from slipid.data.log import Log
from slipid.data.reading.checks import MIN_ROWS
from slipid.data.reading.layout import SensorLayout
from slipid.data.reading.motor_layout import GivenColumns, motor_layout
from slipid.data.reading.reader import read_logs
from slipid.data.reading.table_format import format_of
from slipid.data.runs import counted_once
from slipid.infer.bench.fit import fit_motor
from slipid.infer.bench.motor import BenchMotor, BenchRecord, BenchRoot
from slipid.infer.bench.record_checks import check_records
from slipid.infer.bench.verdict import BenchFit, bench_fit
from slipid.parameter import entries
from slipid.search_space import Choice, Space
from slipid.support.checkpoint import versions
from slipid.support.errors import DataError, did_you_mean
from slipid.support.files import Content, writable, write_bytes, write_json
from slipid.support.jax_setup import setup_jax
from slipid.support.progress import Reporter


@dataclass(frozen=True, eq=False)
class BenchTask:
    """Records of every motor by its label ("" of a single one), and what is wanted of its numbers.

    `skipped` and `taken` are lines for people; `units_said`: the unit of the current is not
    doubted, as it was named, or something was said of the resistance.
    """

    records: Mapping[str, tuple[BenchRecord, ...]]
    choices: Mapping[str, tuple[Choice, ...]]
    skipped: tuple[str, ...] = ()
    taken: tuple[str, ...] = ()
    units_said: bool = False

    def fit(self, report: Reporter) -> BenchFit:
        """Refuse what cannot be, and fit the rest."""
        setup_jax(quiet=True)
        for label, records in self.records.items():
            check_records(records, label, self.units_said)
        fits = []
        for label, records in self.records.items():
            report.stage(f"fitting motor {label}".strip())
            fits.append(fit_motor(records, self.choices[label], label))
        return bench_fit(fits)


def read_bench_task(config: Config, root: Path, report: Reporter) -> BenchTask:
    """Every log of the motors that a config names; DataError where config or logs are wrong."""
    report.stage("reading logs")
    if not root.is_dir():
        raise DataError(f"{root}: no such folder; expected the folder of the logs (--data)")
    found, skipped = of_config.files_of(config, config.content.logs, root)
    if not found:
        raise DataError("\n".join(s.removeprefix("skipped: ") for s in skipped))
    parts: list[list[BenchRecord]] = []
    for section, paths in found:
        layout = of_config.layout_of(config, section)
        for path in paths:
            logs = counted_once(read_logs(path, layout, root, None, section.load).logs)
            refuse_misordered(logs)
            parts += [records_of(log, layout) for log in logs]
    counts = {len(p) for p in parts}
    if len(counts) > 1:
        raise DataError(f"{config.path}: logs of {min(counts)} and of {max(counts)} motors")
    robot = config.content.robot
    names = robot.names if isinstance(robot, BenchMotors) else []
    labels = _labels(names, counts.pop(), str(config.path))
    parts, left = _with_voltage(parts)
    records = {label: tuple(p[k] for p in parts) for k, label in enumerate(labels)}
    choices = {label: _choices(config, label) for label in labels}
    lines = (*skipped, *left)
    for line in lines:
        report.line(line)
    said = any(
        fnmatch.fnmatch("motor.resistance", c.pattern) for cs in choices.values() for c in cs
    )
    return BenchTask(records, choices, lines, (), said)


def read_motor_log(
    path: Path, given: Mapping[str, GivenColumns], delimiter: str | None, signed: bool
) -> BenchTask:
    """Motors of a single file, with given columns, the others by their names."""
    layout = motor_layout(format_of(path, delimiter), given, signed)
    logs = counted_once(read_logs(path, layout, path.parent, None, "bench").logs)
    refuse_misordered(logs)
    parts = [records_of(log, layout) for log in logs]
    labels = _labels((), len(parts[0]), str(path))
    records = {label: tuple(p[k] for p in parts) for k, label in enumerate(labels)}
    taken = tuple(
        f"{channel.removeprefix('motor_')}: {', '.join(map(str, c.columns))} [{c.unit}]"
        for channel, c in layout.channels.items()
    )
    said = "current" in given and given["current"].unit is not None
    return BenchTask(records, dict.fromkeys(labels, ()), (), taken, said)


def records_of(log: Log, layout: SensorLayout) -> list[BenchRecord]:
    """Record of each motor of a log, at its shaft."""
    if log.current is None:
        raise DataError(f"{log.name}: no current; expected a column of it for each motor")
    if not log.wheels:
        raise DataError(f"{log.name}: no speed; expected the speed or angle of each motor's shaft")
    speed = log.wheel_speed
    if speed is None:
        speed = np.gradient(log.wheel_angle, log.time, axis=0)
    speed = speed * layout.gear_ratio
    current = log.current if log.current_is_signed else np.abs(log.current) * np.sign(speed)
    out = []
    for k in range(speed.shape[1]):
        # the halves of a window are independent only where every row is a reading of its own
        read = _read(log, k)
        out.append(
            BenchRecord(
                name=log.name,
                sha256=log.sha256,
                time=log.time[read],
                voltage=None if log.voltage is None else log.voltage[read, k],
                current=current[read, k],
                speed=speed[read, k],
                signed=log.current_is_signed,
            )
        )
    return out


def _read(log: Log, motor: int) -> Bool[np.ndarray, " time"]:
    """Rows in which current and voltage of a motor were read and do not repeat what was read."""
    out = np.ones(log.samples, dtype=bool)
    for fresh in (log.current_fresh, log.voltage_fresh):
        if fresh is not None:
            out &= fresh[:, motor]
    if out.sum() < MIN_ROWS:
        raise DataError(
            f"{log.name}: no row with a current and a voltage of motor {motor + 1}; expected both "
            "in the same rows"
        )
    return out


def _labels(names: Sequence[str], motors: int, where: str) -> tuple[str, ...]:
    if names and len(names) != motors:
        raise DataError(
            f"{where}: robot.names: {len(names)} names; expected {motors}, one per motor"
        )
    return tuple(names) or (("",) if motors == 1 else tuple(str(k + 1) for k in range(motors)))


def _with_voltage(parts: list[list[BenchRecord]]) -> tuple[list[list[BenchRecord]], list[str]]:
    """Logs with a voltage, if there are any, and a line about the others."""
    have = [p for p in parts if p[0].voltage is not None]
    if not have or len(have) == len(parts):
        return parts, []
    return have, [f"skipped: {len(parts) - len(have)} logs without a voltage, others have one"]


def _choices(config: Config, label: str) -> tuple[Choice, ...]:
    """What the config wants of a motor's numbers; DataError where it names none."""
    paths = [e.path for e in entries(BenchRoot(BenchMotor()))]
    choices = []
    for pattern, setting in config.content.parameters.items():
        plain, at, _ = pattern.partition("@")
        if not fnmatch.filter(paths, plain):
            raise DataError(
                f"{config.path}: parameters.'{pattern}': no such parameter"
                f"{did_you_mean(plain, paths)}; "
                f"expected one of {', '.join(paths)}"
            )
        if at and not fnmatch.fnmatchcase(label, pattern.partition("@")[2]):
            continue
        gauss = (setting.prior.mean, setting.prior.std) if setting.prior else (None, None)
        choice = Choice(plain, setting.start, setting.fixed, setting.free, *gauss)
        try:
            Space(BenchRoot(BenchMotor()), [choice])
        except ValueError as error:
            raise DataError(f"{config.path}: parameters.'{pattern}': {error}") from error
        choices.append(choice)
    return tuple(choices)


def identify_bench(
    config: Config, data: Path, out: Path, report: Reporter
) -> tuple[BenchFit, tuple[str, ...]]:
    """Fit the motors of a config and write identified.json; names of the files."""
    began = time.monotonic()
    task = read_bench_task(config, data, report)
    fit = task.fit(report)
    writable(out)
    content = fit.to_json()
    write_json(out / "identified.json", content)
    write_bytes(out / "config.toml", config.text.encode())
    about = {
        "schema": "slipid.run/1",
        "finished": datetime.now(UTC).isoformat(timespec="seconds"),
        "seconds": round(time.monotonic() - began, 1),
        "config": {"name": config.path.name, "sha256": config.hash},
        "data": {
            "folder": str(data),
            "hash": content["data"]["hash"],
            "logs": {r.name: r.sha256 for rs in task.records.values() for r in rs},
            "skipped": task.skipped,
        },
        "versions": versions(),
    }
    write_json(out / "run.json", about)
    return fit, ("identified.json", "run.json", "config.toml")


def check_bench(
    config: Config, data: Path, out: Path | None, report: Reporter
) -> tuple[BenchFit, Content]:
    """What the logs of motors hold and can tell: content of check.json, written where wanted.

    A fit of a motor takes less than a second: its verdicts are given, and not its numbers.
    """
    task = read_bench_task(config, data, report)
    fit = task.fit(report)
    content: Content = {
        "schema": "slipid.check/1",
        "drive": "motor",
        "logs": [
            _record_summary(f"{r.name}@{label}" if label else r.name, r)
            for label, rs in task.records.items()
            for r in rs
        ],
        "parameters": {
            path: {"unit": e.unit, "ratio": e.ratio, "verdict": e.verdict}
            for path, e in fit.parameters.items()
        },
        "messages": list(fit.messages),
        "skipped": list(task.skipped),
    }
    if out is not None:
        write_json(out / "check.json", content)
    return fit, content


def _record_summary(name: str, r: BenchRecord) -> Content:
    """What one log holds of one motor."""

    def span(x: np.ndarray | None) -> list[float] | None:
        return None if x is None else [float(x.min()), float(x.max())]

    return {
        "name": name,
        "rows": len(r.time),
        "seconds": round(float(r.time[-1] - r.time[0]), 3),
        "row_period_s": r.period,
        "voltage": span(r.voltage),
        "current": span(r.current),
        "speed": span(r.speed),
        "current_is_signed": r.signed,
    }
