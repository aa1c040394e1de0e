"""Check of logs and config before a fit, and prediction of how certain each estimate will be."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from slipid.app.calibrate import calibrated, remarks
from slipid.app.config import SETTINGS, read_config
from slipid.app.logs import layout_of
from slipid.app.problem import ConfigFitTask, FitTask, read_fit_task
from slipid.data.align.clock import Clock
from slipid.data.check.findings import NOT_CALIBRATED, Finding, worst_first
from slipid.data.check.own_settings import gaps, own_settings
from slipid.data.check.sanity import findings
from slipid.data.log import Log
from slipid.data.runs import Runs, channels
from slipid.fitting.calibration.estimate import evenly
from slipid.fitting.problem import CREEPS, Problem
from slipid.fitting.variances import Search
from slipid.infer import slip_curves as curves_of
from slipid.infer.verdicts.estimates import Estimate, derived, estimates
from slipid.infer.verdicts.unidentified import FlatDirection, flat_directions, members, sentences
from slipid.model.geometry import Geometry
from slipid.predict.agreement import scatter
from slipid.predict.selection import selected
from slipid.search_space import Space
from slipid.support.content import Content
from slipid.support.errors import DataError
from slipid.support.files import write_json
from slipid.support.jax_setup import setup_jax
from slipid.support.progress import Reporter, Tell, silent

MOST_CALIBRATED = 64
"""Largest number of runs that a check calibrates."""
Task = TypeVar("Task", bound=FitTask)
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
    torques = task.dataset.current_is_torque  # which are those of the wheels
    absent += [] if torques or "gear_ratio" in robot.model_fields_set else ["gear_ratio"]
    logged = ["torque"] if torques else logged
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
class ExpectedEstimate:
    """Range of the estimates of one parameter that a fit may have, before it is made.

    Attributes:
        least: the least informative estimate.
        best: the most informative estimate.
    """

    least: Estimate
    best: Estimate

    @property
    def verdict(self) -> str:
        """Verdict of the least informative estimate."""
        return self.least.verdict

    def allows(self, verdict: str) -> bool:
        """Return whether a fit may end with a verdict; any but three depend on the fit alone."""
        if verdict not in _ORDER:
            return True
        ends = (_uncertainty(self.best)[0], _uncertainty(self.least)[0])
        return ends[0] <= _ORDER.index(verdict) <= ends[1]

    def to_json(self) -> Content:
        """Return the part of check.json about one parameter."""
        e, best = self.least, self.best
        return {
            "unit": e.unit,
            "start": e.value,
            "expected_std": e.std,
            "ratio": e.ratio,
            "verdict": e.verdict,
            "best_ratio": best.ratio,
            "best_verdict": best.verdict,
        }


@dataclass(frozen=True)
class ExpectedEstimates:
    """Estimates that a fit is expected to have, before it is made.

    Attributes:
        parameters: expected estimate of each parameter, keyed by its path.
        derived: expected estimate of each derived ratio of parameters, keyed by its name.
        messages: one sentence about each combination of parameters that stays unknown, with a
            measurement that would help.
    """

    parameters: dict[str, ExpectedEstimate]
    derived: dict[str, ExpectedEstimate]
    messages: tuple[str, ...]

    def to_json(self) -> Content:
        """Return the part of check.json with the expected estimates."""
        return {
            "parameters": {path: e.to_json() for path, e in self.parameters.items()},
            "derived": {path: e.to_json() for path, e in self.derived.items()},
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
    task, part = calibration_part(task, content["findings"], report)
    content |= part
    report.stage("expected information")
    content |= expected_if_any(task, report.steps).to_json()
    if out is not None:
        write_json(out / "check.json", content)
    return task.dataset, content


def calibration_part(
    task: Task, found_before: Sequence[Content], report: Reporter
) -> tuple[Task, Content]:
    """Return the task started from its calibration, and the part of check.json about it.

    Of many runs, `MOST_CALIBRATED` are calibrated; `slipid identify` calibrates all. Runs that
    contradict the config in order, axes or motion are not calibrated; `found_before` are the
    findings about them, as in check.json.
    """
    if any(f["severity"] == "wrong" and f["kind"] in NOT_CALIBRATED for f in found_before):
        sentence = "no calibration before the findings marked wrong are corrected"
        return task, {"suspects": [sentence]}
    data = task.dataset
    if len(data) > MOST_CALIBRATED:
        some = evenly(data.surface, MOST_CALIBRATED)
        data = data.subset(some)
        report.line(f"calibrated from {len(data)} of {len(task.dataset)} runs")
    try:
        found = calibrated(replace(task, dataset=data), report)
    except DataError as error:  # no run has poses while its wheels turn
        return task, {"suspects": [f"no calibration: {error}"]}
    suspects = remarks(found, selected(data, found.errors, found.contradicted), task)
    content = {"calibration": found.calibration.to_json(), "suspects": list(suspects)}
    return task.started_from(found.calibration), content


def overview(task: FitTask, skipped: Sequence[str] = ()) -> Content:
    """Return the part of check.json about the logs.

    This part has the findings, the runs by floor, load set-up and session, the channels, the
    repairs made when the logs were read, and the `skipped` logs.
    """
    data = task.dataset
    groups: dict[tuple[str, str, str], list[int]] = {}
    for k, log in enumerate(data.logs):
        groups.setdefault((data.surface[k], log.load, data.session[k]), []).append(k)
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
        **_shown_settings(data.logs, task.robot.geometry),
        "clocks": {log.name: _clock(log.pose_clock) for log in data.logs if log.pose_clock},
        "notes": dict(notes.most_common()),
        "skipped": list(skipped),
        "data": {"hash": task.data_hash, "logs": {log.name: log.sha256 for log in data.logs}},
    }


def _shown_settings(logs: Sequence[Log], shape: Geometry) -> Content:
    """Return the part of check.json with limits and noise that logs show, keyed as in a config."""
    found = own_settings(logs, shape)
    tables: dict[str, dict[str, float]] = {}
    for key, path in SETTINGS.items():
        if path in found:
            group, _, name = key.partition(".")
            tables.setdefault(group, {})[name] = found[path]
    usual, longest = gaps(logs)
    return {"settings": tables, "gaps_s": {"usual": usual, "longest": longest}}


def _clock(clock: Clock) -> Content:
    """Return the part of check.json about the clock offset of a run's poses, and its drift."""
    return {
        "offset_s": clock.offset,
        "offset_interval90_s": clock.offset_interval90,
        "drift": clock.drift,
        "drift_std": clock.drift_std,
        "told_by": clock.source,
    }


def expected_if_any(task: FitTask, tell: Tell = silent) -> ExpectedEstimates:
    """Return the expected estimates of a fit to a task, or why there are none."""
    try:
        return expected(task, task.problem(), tell)
    except DataError as error:  # the logs leave no windows to fit
        return ExpectedEstimates({}, {}, (f"no estimate of a fit can be predicted: {error}",))


def expected(task: FitTask, problem: Problem, tell: Tell = silent) -> ExpectedEstimates:
    """Return the expected estimates from the information that a fit would have.

    This information depends on the parameters and the noise, which are not known before a fit. It
    is computed as after a fit, at plausible values of the parameters: those from which a fit
    starts, and draws of the prior. They are combined with two sizes of the noise: that of the runs'
    scatter before any physics explains it, and the typical one with which a fit begins. `tell`
    reports the progress.
    """
    space, w = problem.space, problem.windows
    keep, volt = problem.full_weight, w.has_voltage
    noises = (scatter(problem), np.log(problem.noise.typical**2))
    validity = curves_of.validity(task.dataset, space.tree(space.start), problem.batch)
    where = w.has_current, volt, validity, problem.robot.geometry.determines_twist
    parameters: dict[str, ExpectedEstimate] = {}
    ratios: dict[str, ExpectedEstimate] = {}
    open_: tuple[FlatDirection, ...] = ()
    most = -np.inf
    cases = list(_plausible(space, noises))
    for count, (z, levels) in enumerate(cases, start=1):
        for covariance in problem.laplaces(z, levels, keep):
            flat = flat_directions(space, covariance, *where)
            found = estimates(space, task.choices, z, covariance, volt, members(flat))
            _widened(parameters, found)
            _widened(ratios, derived(space, z, covariance, volt))
            uncertainty = float(np.linalg.slogdet(covariance)[1])
            if uncertainty > most:
                most, open_ = uncertainty, flat
        tell(count, len(cases))
    possible = {path: e.best.verdict for path, e in parameters.items()}
    open_ = tuple(one for one in open_ if _is_certain(one, possible))
    return ExpectedEstimates(parameters, ratios, sentences(open_))


_DRAWS = 3
"""Number of draws of the prior, each of them used together with its mirror image."""


def _plausible(
    space: Space, noises: Sequence[np.ndarray]
) -> Iterator[tuple[Search, Sequence[np.ndarray]]]:
    """Yield plausible values of the parameters, and the sizes of the noise to combine them with.

    The values are those from which a fit starts, with both sizes of the noise, and draws of the
    prior, with the larger one.
    """
    creep = space.where(lambda e: e.quantity == "surface.creep")
    for value in CREEPS if creep.any() else CREEPS[:1]:
        yield np.where(creep, np.log(value), space.start), noises
    for step in np.random.default_rng(0).standard_normal((_DRAWS, space.size)):
        yield space.prior_mean + step * space.prior_std, noises[:1]
        yield space.prior_mean - step * space.prior_std, noises[:1]


def _widened(kept: dict[str, ExpectedEstimate], found: Iterable[Estimate]) -> None:
    """Widen the range of expected estimates of each path so that it contains the found one."""
    for e in found:
        before = kept.get(e.path, ExpectedEstimate(e, e))
        least = max(before.least, e, key=_uncertainty)
        kept[e.path] = ExpectedEstimate(least, min(before.best, e, key=_uncertainty))


_ORDER = ("identified", "weak", "not_identified")


def _uncertainty(e: Estimate) -> tuple[int, float]:
    """Return the key that orders estimates by verdict and, at equal verdicts, by their ratio.

    A start at the bound of a parameter, which says nothing about the fit, comes between the
    verdicts `weak` and `not_identified`.
    """
    return (_ORDER.index(e.verdict) if e.verdict in _ORDER else 1), e.ratio or 0.0


def _is_certain(one: FlatDirection, possible: Mapping[str, str]) -> bool:
    """Return True if a direction is flat whatever the parameters are, as far as verdicts show it.

    `possible` is the best expected verdict of each parameter.
    """
    allowed = ("not_identified",) if len(one.paths) == 1 else ("not_identified", "weak")
    return all(possible[path] in allowed for path in one.paths)
