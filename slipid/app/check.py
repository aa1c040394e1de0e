"""Check of logs and config before a fit, and prediction of how certain each estimate will be."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slipid.app.config import read_config
from slipid.app.logs import layout_of
from slipid.app.problem import ConfigFitTask, FitTask, read_fit_task
from slipid.data.align.clock import Clock
from slipid.data.check.findings import Finding, worst_first
from slipid.data.check.sanity import findings
from slipid.data.runs import Runs, channels
from slipid.fitting.problem import CREEPS, Problem
from slipid.infer import slip_curves as curves_of
from slipid.infer.verdicts.estimates import Estimate, derived, estimates
from slipid.infer.verdicts.unidentified import FlatDirection, flat_directions, members, sentences
from slipid.predict.agreement import scatter
from slipid.support.content import Content
from slipid.support.errors import DataError
from slipid.support.files import write_json
from slipid.support.jax_setup import setup_jax
from slipid.support.progress import Reporter

_AT_MOTOR = ("wheel_ticks", "motor_angle", "motor_speed", "motor_speed_command")
"""Channels at the motor shaft, which the gear ratio of a layout converts to motion of the wheel."""


def sanity(task: FitTask) -> tuple[Finding, ...]:
    """Return the findings about the runs of a task and about its config, if any, worst first."""
    mass = task.config.content.wheels.mass_kg if isinstance(task, ConfigFitTask) else None
    found = [*_braking(task), *findings(task.dataset, task.robot.geometry, mass)]
    if isinstance(task, ConfigFitTask):
        found += [*_missing_sizes(task), *_different_gears(task)]
    return worst_first(found)


def _braking(task: FitTask) -> Iterator[Finding]:
    """Yield a finding if unsigned currents and voltages are logged on a robot that scrubs in turns.

    On such a robot some wheels are dragged along by other wheels and brake. In simulated runs of a
    skid-steer robot, the resistance was then wrong by ten standard deviations, with the verdict
    "identified".
    """
    runs = task.dataset
    has = runs.current is not None and runs.voltage is not None
    if has and not runs.current_is_signed and not task.robot.geometry.determines_twist:
        yield Finding(
            "braking_unseen",
            "currents are magnitudes, and in turns a wheel that is dragged along brakes: its "
            "current would be treated as a driving current, and would give, together with the "
            "voltage, a wrong resistance and back-EMF",
            "log currents with their sign, or remove the voltage from the layout",
            "wrong",
        )


def _missing_sizes(task: ConfigFitTask) -> Iterator[Finding]:
    """Yield a finding if mass or gear ratio, with which torques scale, is missing in the config."""
    logged = [n for n in ("current", "voltage") if getattr(task.dataset, n) is not None]
    robot = task.config.content.wheels
    absent = ["mass_kg"] if robot.mass_kg is None else []
    absent += [] if "gear_ratio" in robot.model_fields_set else ["gear_ratio"]
    if not logged or not absent:
        return
    taken = {"mass_kg": f"{float(task.robot.body.mass):g} kg", "gear_ratio": "1"}
    yield Finding(
        "forgotten",
        f"{' and '.join(f'{n} ({taken[n]} would be used)' for n in absent)} missing in [robot], "
        f"though a {' and a '.join(logged)} is logged: motor and friction parameters scale with "
        f"{'them' if len(absent) > 1 else 'it'}",
        "write " + " and ".join(f"{n} = ..." for n in absent) + " into [robot]",
        "wrong",
    )


def _different_gears(task: ConfigFitTask) -> Iterator[Finding]:
    """Yield a finding for each layout whose gear ratio differs from that of the robot."""
    robot = task.config.content.wheels
    if "gear_ratio" not in robot.model_fields_set:
        return
    checked: set[str] = set()
    for section in task.config.content.logs:
        layout = layout_of(task.config, section)
        if section.format in checked or not any(c in layout.holds for c in _AT_MOTOR):
            continue
        checked.add(section.format)
        if abs(layout.gear_ratio / robot.gear_ratio - 1) > 1e-3:
            yield Finding(
                "two_gear_ratios",
                f"gear_ratio is {robot.gear_ratio:g} in [robot] and {layout.gear_ratio:g} in the "
                f"layout '{section.format}' of the logs",
                "write the same number into both, or name the columns as those of the wheel "
                "(wheel_angle, wheel_speed), if they are of the wheel",
                "wrong",
            )


@dataclass(frozen=True)
class ExpectedEstimates:
    """Estimates that a fit is expected to have, before it is made.

    Attributes:
        parameters: expected estimate of each parameter, keyed by its path.
        derived: expected estimate of each derived ratio of parameters, keyed by its name.
        messages: one sentence about each combination of parameters that stays unknown, with a
            measurement that would help.
    """

    parameters: dict[str, Estimate]
    derived: dict[str, Estimate]
    messages: tuple[str, ...]

    def to_json(self) -> Content:
        """Return the part of check.json with the expected estimates."""
        return {
            "parameters": {path: _expected_json(e) for path, e in self.parameters.items()},
            "derived": {path: _expected_json(e) for path, e in self.derived.items()},
            "messages": list(self.messages),
        }


def check(
    config_path: Path, data: Path, out: Path | None, report: Reporter
) -> tuple[Runs, Content]:
    """Return the runs of a config, and the content of check.json, also written to `out` if given.

    Args:
        config_path: the config.
        data: folder of the logs.
        out: folder to write to, or None.
        report: reporter of the progress.
    """
    setup_jax(quiet=True)
    task = read_fit_task(read_config(config_path), data, report)
    report.stage("comparing logs with config")
    content = overview(task, task.skipped)
    report.stage("expected information")
    try:
        estimates_before = expected(task, task.problem())
    except DataError as error:  # the logs leave no windows to fit
        message = f"no estimate of a fit can be predicted: {error}"
        estimates_before = ExpectedEstimates({}, {}, (message,))
    content |= estimates_before.to_json()
    if out is not None:
        write_json(out / "check.json", content)
    return task.dataset, content


def overview(task: FitTask, skipped: Sequence[str] = ()) -> Content:
    """Return the part of check.json about the logs.

    This part has the findings, the runs by floor, load set-up and session, the channels, the
    repairs made when the logs were read, and the `skipped` logs.
    """
    data = task.dataset
    groups: dict[tuple[str, str, str], list[int]] = {}
    for k, log in enumerate(data.logs):
        groups.setdefault((log.surface or "unknown", log.load, data.session[k]), []).append(k)
    # Equal notes on several runs become one note with a count.
    notes = Counter(note for log in data.logs for note in log.notes)
    return {
        "schema": "slipid.check/1",
        "findings": [finding.to_json() for finding in sanity(task)],
        "runs": len(data),
        "groups": [
            {
                "surface": surface,
                "load": load,
                "session": session,
                "runs": len(runs),
                "seconds": round(sum(data.logs[k].duration for k in runs), 1),
                "headings": len(curves_of.distinct(np.degrees(data.heading[runs]), 1)),
                "speeds": list(curves_of.distinct(data.speed[runs], 3)),
            }
            for (surface, load, session), runs in sorted(groups.items())
        ],
        "channels": channels(data.logs),
        "clocks": {log.name: _clock(log.pose_clock) for log in data.logs if log.pose_clock},
        "notes": dict(notes.most_common()),
        "skipped": list(skipped),
        "data": {"hash": task.data_hash, "logs": {log.name: log.sha256 for log in data.logs}},
    }


def _clock(clock: Clock) -> Content:
    """Return the part of check.json about the clock offset of a run's poses, and its drift."""
    return {
        "offset_s": clock.offset,
        "offset_interval90_s": clock.offset_interval90,
        "drift": clock.drift,
        "drift_std": clock.drift_std,
        "told_by": clock.source,
    }


def expected(task: FitTask, problem: Problem) -> ExpectedEstimates:
    """Return the expected estimates from the expected information at the start of a fit.

    The noise variances are estimated from the runs. The parameters of the floors are not known yet;
    therefore the start values are tried with each creep in `CREEPS`, from which a fit starts. Each
    parameter gets the least informative of its estimates, and the messages describe the start with
    the largest determinant of the covariance.
    """
    space, w = problem.space, problem.windows
    log_v, keep, volt = scatter(problem), np.ones(len(w)), w.has_voltage
    creep = space.where(lambda e: e.quantity == "surface.creep")
    parameters: dict[str, Estimate] = {}
    ratios: dict[str, Estimate] = {}
    open_: tuple[FlatDirection, ...] = ()
    most = -np.inf
    starts = (space.start, *(np.where(creep, np.log(c), space.start) for c in CREEPS))
    covariances = [problem.laplace(z, log_v, keep) for z in starts]
    # The range of validity is computed after the covariances, since it uses the functions that were
    # compiled for them.
    robot = space.tree(space.start)
    validity = curves_of.validity(task.dataset, robot, problem.batch)
    where = w.has_current, volt, validity, robot.geometry.determines_twist
    for covariance in covariances:
        flat = flat_directions(space, covariance, *where)
        found = estimates(space, task.choices, space.start, covariance, volt, members(flat))
        _least(parameters, found)
        _least(ratios, derived(space, space.start, covariance, volt))
        uncertainty = float(np.linalg.slogdet(covariance)[1])
        if uncertainty > most:
            most, open_ = uncertainty, flat
    return ExpectedEstimates(parameters, ratios, sentences(open_))


def _least(kept: dict[str, Estimate], found: Iterable[Estimate]) -> None:
    """Replace each kept estimate by the found one of the same path if that one is less informative.

    An estimate is less informative if its verdict is worse or, at equal verdicts, its ratio larger.
    """
    order = ("identified", "weak", "not_identified")

    def promise(e: Estimate) -> tuple[int, float]:
        return order.index(e.verdict) if e.verdict in order else -1, e.ratio or 0.0

    for e in found:
        kept[e.path] = max(kept.get(e.path, e), e, key=promise)


def _expected_json(e: Estimate) -> Content:
    kept = {"unit": e.unit, "start": e.value, "expected_std": e.std}
    return kept | {"ratio": e.ratio, "verdict": e.verdict}
