"""Identification of motors on a test bench, from a config or from a single log file."""

import fnmatch
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import numpy as np
from jaxtyping import Bool

from slipid.app import logs as of_config
from slipid.app.config import BenchMotors, Config
from slipid.app.problem import checked_choice, unknown_parameter
from slipid.data.check.columns import refuse_misordered
from slipid.data.log import Log
from slipid.data.reading.checks import MIN_ROWS
from slipid.data.reading.layout import SensorLayout
from slipid.data.reading.motor_layout import GivenColumns, MotorOptions
from slipid.data.reading.motor_log import read_motor_logs
from slipid.data.reading.reader import read_logs
from slipid.data.runs import counted_once
from slipid.exports.feedforward import gains_json, write_gains
from slipid.infer.bench.checks import check_records
from slipid.infer.bench.fit import fit_motor
from slipid.infer.bench.motor import BenchMotor, BenchRecord, BenchRoot
from slipid.infer.bench.rows import Between
from slipid.infer.bench.verdict import BenchFit, bench_fit
from slipid.infer.feedforward import bench_feedforwards
from slipid.infer.result_folder import CONFIG, FIT, IDENTIFIED, files_of_fit
from slipid.parameter import entries
from slipid.search_space import Choice
from slipid.support.content import Content
from slipid.support.errors import DataError, did_you_mean
from slipid.support.files import json_text, writable, write_json, write_together
from slipid.support.jax_setup import setup_jax
from slipid.support.progress import Reporter


@dataclass(frozen=True, eq=False)
class BenchTask:
    """Everything that a fit of motors on a bench needs.

    Motors have labels; a single motor has the label "".

    Attributes:
        records: records of each motor, keyed by the motor's label.
        choices: fixed, free and prior values of each motor's parameters, keyed by its label.
        skipped: one line about each log that is not used.
        columns_used: for a single file, one line about each channel and the columns assigned to it.
        unit_is_known: True if the unit of the current was given or the config has a choice for the
            resistance, so that an unlikely current is not refused.
        between: form of the voltage between rows, None for the likeliest.
    """

    records: Mapping[str, tuple[BenchRecord, ...]]
    choices: Mapping[str, tuple[Choice, ...]]
    skipped: tuple[str, ...] = ()
    columns_used: tuple[str, ...] = ()
    unit_is_known: bool = False
    between: Between | None = None

    def fit(self, report: Reporter) -> BenchFit:
        """Return the fit of every motor; raise `DataError` if the records cannot be right."""
        setup_jax(quiet=True)
        for label, records in self.records.items():
            if self.between is not None and records[0].voltage is None:
                raise DataError(
                    f"{records[0].name}: the voltage between rows is given ({self.between}), but "
                    "there is no voltage; expected a column of the voltage"
                )
            check_records(records, label, self.unit_is_known)
        fits = []
        for label, records in self.records.items():
            report.stage(f"fitting motor {label}".strip())
            fits.append(fit_motor(records, self.choices[label], label, self.between))
        return bench_fit(fits)


def read_bench_task(config: Config, root: Path, report: Reporter) -> BenchTask:
    """Return the task of a config of motors, after reading all its logs.

    Raises:
        DataError: a log cannot be read, or the config or the logs are wrong.
    """
    report.stage("reading logs")
    found, skipped = of_config.required_files(config, config.content.logs, root)
    parts: list[list[BenchRecord]] = []
    for section, paths in found:
        layout = of_config.layout_of(config, section)
        for path in paths:
            logs = counted_once(read_logs(path, layout, root, None, section.load).logs)
            refuse_misordered(logs)
            parts += [records_of(log, layout) for log in logs]
    counts = {len(p) for p in parts}
    if len(counts) > 1:
        raise DataError(
            f"{config.path}: logs of {min(counts)} and of {max(counts)} motors; expected the same "
            "number in every log"
        )
    with_voltage = [p for p in parts if p[0].voltage is not None]
    if without := len(parts) - len(with_voltage) if with_voltage else 0:
        skipped.append(f"skipped: {without} logs without a voltage, since other logs have one")
        parts = with_voltage
    robot = config.content.robot
    names = robot.names if isinstance(robot, BenchMotors) else []
    records = _by_motor(parts, names, config.path)
    choices = {label: _choices(config, label) for label in records}
    for line in skipped:
        report.line(line)
    unit_is_known = any(
        fnmatch.fnmatch("motor.resistance", c.pattern) for cs in choices.values() for c in cs
    )
    between = robot.voltage_between_rows if isinstance(robot, BenchMotors) else None
    return BenchTask(records, choices, tuple(skipped), (), unit_is_known, between)


def read_motor_log(
    path: Path,
    given: Mapping[str, GivenColumns],
    delimiter: str | None,
    options: MotorOptions,
    between: str | None = None,
) -> BenchTask:
    """Return the task of motors in a single log, whose channels may be in several files.

    Args:
        path: the log file.
        given: columns that the user named, keyed by channel; other channels are found by their
            column names.
        delimiter: character between cells, or None to guess it.
        options: properties of the log that no file tells.
        between: form of the voltage between rows, None for the likeliest.

    Raises:
        DataError: a file cannot be read, or lacks a channel, or there is no such form.
    """
    form = _form(between)
    found = read_motor_logs(path, given, delimiter, options)
    logs = counted_once(found.logs)
    refuse_misordered(logs)
    records = _by_motor([records_of(log, found.layout) for log in logs], (), path)
    for some in records.values():
        _check_directions(some, found.columns_used)
    unit_is_known = "current" in given and given["current"].unit is not None
    none: dict[str, tuple[Choice, ...]] = dict.fromkeys(records, ())
    return BenchTask(records, none, (), found.columns_used, unit_is_known, form)


def _form(between: str | None) -> Between | None:
    """Return a form of the voltage between rows; raise `DataError` if there is no such form."""
    forms: tuple[Between, ...] = get_args(Between)
    for form in forms:
        if between == form:
            return form
    if between is None:
        return None
    raise DataError(
        f"--between {between}: no form of the voltage between rows{did_you_mean(between, forms)}; "
        f"expected one of {', '.join(forms)}"
    )


def _check_directions(records: Sequence[BenchRecord], used: Sequence[str]) -> None:
    """Raise `DataError` if voltage and speed have opposite signs while no current was logged.

    With a current, the checks before the fit tell which of the three columns is reversed. `used`
    are the lines about the columns that were used.
    """
    volts = [r.voltage for r in records if r.voltage is not None and r.current is None]
    if len(volts) < len(records):
        return
    voltage, speed = np.concatenate(volts), np.concatenate([r.speed for r in records])
    if voltage @ speed < -0.5 * np.linalg.norm(voltage) * np.linalg.norm(speed):
        columns = "; ".join(line for line in used if not line.startswith("time"))
        raise DataError(
            f"{records[0].name}: the voltage opposes the speed ({columns}); expected one "
            "of the two reversed, as by --speed NAME:-rad/s"
        )


def records_of(log: Log, layout: SensorLayout) -> list[BenchRecord]:
    """Return a record for each motor in a log, with its speed at the motor shaft."""
    if log.current is None and log.voltage is None:
        raise DataError(f"{log.name}: no current or voltage; expected a column for each motor")
    if log.current_is_torque:
        raise DataError(
            f"{log.name}: a torque in place of the current; expected a column of each motor's "
            "current, or torque_constant [N m/A] in the layout"
        )
    if not log.wheels:
        raise DataError(f"{log.name}: no speed; expected the speed or angle of each motor's shaft")
    speed = log.wheel_speed
    if speed is None:
        speed = np.gradient(log.wheel_angle, log.time, axis=0)
    speed = speed * layout.gear_ratio
    current = log.current
    if current is not None and not log.current_is_signed:
        current = np.copysign(current, speed)
    # A fit needs rows with independent errors, so only rows with new readings are used.
    return [
        BenchRecord(
            name=log.name,
            sha256=log.sha256,
            time=log.time[read],
            voltage=None if log.voltage is None else log.voltage[read, k],
            current=None if current is None else current[read, k],
            speed=speed[read, k],
            signed=log.current_is_signed,
        )
        for k, read in enumerate(_read(log, k) for k in range(speed.shape[1]))
    ]


def _read(log: Log, motor: int) -> Bool[np.ndarray, " time"]:
    """Return whether each row has a new reading of both current and voltage of a motor."""
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


def _by_motor(
    logs: Sequence[Sequence[BenchRecord]], names: Sequence[str], where: Path
) -> dict[str, tuple[BenchRecord, ...]]:
    """Return the records of each motor, keyed by its label: its name, or else its number from 1.

    A single motor without a name has the label "". `logs` has a record of each motor in each log,
    and `where` is the file with the names, for messages.
    """
    motors = len(logs[0])
    if names and len(names) != motors:
        raise DataError(
            f"{where}: robot.names: {len(names)} names; expected {motors}, one per motor"
        )
    labels = names or ([""] if motors == 1 else [str(k + 1) for k in range(motors)])
    return dict(zip(labels, zip(*logs, strict=True), strict=True))


def _choices(config: Config, label: str) -> tuple[Choice, ...]:
    """Return the config's choices for the parameters of the motor with a label.

    Raises:
        DataError: a pattern matches no parameter, or a choice is impossible.
    """
    paths = [e.path for e in entries(BenchRoot(BenchMotor()))]
    choices = []
    for pattern in config.content.parameters:
        plain, at, _ = pattern.partition("@")
        if not fnmatch.filter(paths, plain):
            raise unknown_parameter(config, pattern, plain, paths)
        if at and not fnmatch.fnmatchcase(label, pattern.partition("@")[2]):
            continue
        choices.append(checked_choice(config, pattern, plain, BenchRoot(BenchMotor())))
    return tuple(choices)


def identify_bench(
    config: Config, data: Path, out: Path, report: Reporter
) -> tuple[BenchFit, tuple[str, ...]]:
    """Return the fit of the motors of a config, and the names of the written files.

    Args:
        config: config of the motors.
        data: folder of the logs.
        out: folder to write to.
        report: reporter of the progress.

    Raises:
        DataError: a log is wrong, or the folder has the result of a robot.
    """
    if (out / FIT).exists():
        raise DataError(
            f"{out}: has the fit of a robot ({FIT}); choose a different folder with --out"
        )
    began = time.monotonic()
    task = read_bench_task(config, data, report)
    fit = task.fit(report)
    writable(out)
    content = bench_content(fit)
    files = {out / IDENTIFIED: json_text(content).encode(), out / CONFIG: config.text.encode()}
    write_together(files, files_of_fit(out, keep_config=True))
    gains = write_gains(out, bench_feedforwards(fit))

    inputs: Content = {
        "folder": str(data),
        "hash": content["data"]["hash"],
        "logs": {r.name: r.sha256 for rs in task.records.values() for r in rs},
        "skipped": task.skipped,
    }
    of_config.write_run_file(out, config, inputs, time.monotonic() - began, {})
    return fit, ("identified.json", *gains, "run.json", "config.toml")


def bench_content(fit: BenchFit) -> Content:
    """Return the content of the result file of motors, with their feed-forward gains."""
    return fit.to_json() | gains_json(bench_feedforwards(fit))


def check_bench(
    config: Config, data: Path, out: Path | None, report: Reporter
) -> tuple[BenchFit, Content]:
    """Return a fit of motors and the content of check.json, which is written to `out` if given.

    The check reports the verdicts of a real fit, since a fit of a motor takes less than a second.
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
    """Return the part of check.json about one motor's record: its duration and ranges of values."""

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
