"""Calibration of a robot's kinematics from the logs of a config, without a force balance."""

import json
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from slipid.app.bench_priors import COPY_NAME, bench_of
from slipid.app.floor_maps import copy_maps, map_files
from slipid.app.logs import write_run_file
from slipid.app.problem import ConfigFitTask, FitTask
from slipid.data.runs import Runs
from slipid.data.wheel_signals import interpolate
from slipid.fitting.calibration.result import ABSURD, Calibration
from slipid.infer.fit_file import SCHEMA
from slipid.infer.result_content import AGAIN, IdentifiedContent, checked_result
from slipid.infer.result_folder import CONFIG, FIT, IDENTIFIED, files_of_fit, fit_of
from slipid.infer.verdicts.trust import Trust, verdict_of_trust
from slipid.model.geometry import Geometry
from slipid.model.robot import Robot
from slipid.predict.selection import (
    CONTRADICTION,
    FloorSelection,
    KinematicFit,
    kinematic_fit,
    selected,
)
from slipid.search_space import Space
from slipid.support.errors import DataError
from slipid.support.files import (
    checksum,
    json_text,
    read_json,
    writable,
    write_json,
    write_together,
)
from slipid.support.progress import COMPILING_S, Reporter


@dataclass(frozen=True, eq=False)
class CalibrationResult:
    """Result of a calibration without a force balance.

    Attributes:
        calibration: the calibration.
        selection: selected kinematic model on each floor.
        trust: trust in the selected models.
        task: runs, config and choices.
        written: names of the written files.
    """

    calibration: Calibration
    selection: dict[str, FloorSelection]
    trust: Trust
    task: FitTask
    written: tuple[str, ...] = ()

    @property
    def models(self) -> dict[str, str]:
        """Name of the selected model, keyed by floor."""
        return {floor: one.model for floor, one in self.selection.items()}


def calibrated(task: FitTask, report: Reporter) -> KinematicFit:
    """Return the calibrated kinematics of a task, and report their numbers."""
    report.stage("calibrated kinematics", usual_s=COMPILING_S)
    space = Space(task.robot, task.choices)
    found = kinematic_fit(task.dataset, space, task.choices, report.steps)
    for sentence in found.calibration.sentences:
        report.line(sentence)
    return found


SLIP_SEEN = 0.01
"""Relative difference of rolling radii between floors, and std of the runs' effects per distance,
above which slip is seen [1]."""
DRIVING, LEAST_M_S = 0.3, 0.01
"""A robot drives in the steps in which its speed exceeds this share of the largest [1]; a robot
that is slower than the second number [m/s] turns on the spot."""
SPEED_STEP_S = 0.4
"""Duration of the steps over which the speed of the wheels is averaged [s]."""
ONE_SPEED = 1.3
"""Ratio of the speeds exceeded in 10 % and in 85 % of the steps in which a robot drives, below
which it is driven at one speed [1]; the other steps may be starts and stops."""
FAR_FROM_CONFIG = 0.02
"""Relative difference of a calibrated length from the config's that is reported [1]."""


def remarks(
    found: KinematicFit, selection: Mapping[str, FloorSelection], task: FitTask
) -> tuple[str, ...]:
    """Return sentences about what the runs do not tell, and about suspected errors in the config.

    They are suspects, not reasons against the result: the calibrated numbers are used.

    Args:
        found: calibrated kinematics of the task.
        selection: selected model on each floor.
        task: runs, robot and choices.
    """
    c = found.calibration
    out = list(found.suspects)
    if not c.settled:
        out.append(
            "the calibration had not settled when it ended, so that its intervals may be too "
            "narrow: drive more runs, with turns and straight parts at several speeds"
        )
    what = c.length
    far_base = _is_absurd(c.base[c.firmest].value / c.nominal_base)
    straight = [f for f, v in c.base.items() if v.verdict == "not_identified" and not far_base]
    if len(straight) == len(c.base):
        out.append(
            f"no run turns: the effective {what} and the place of the pose sensor are not "
            f"identified; drive {'curves' if c.steering else 'curves or turns on the spot'}"
        )
    elif straight:
        out.append(f"on {', '.join(straight)} no run turns: the effective {what} is not identified")
    unseen = any(v.verdict in ("weak", "not_identified") for v in c.radius[c.firmest])
    if unseen and not _is_absurd(_mean_radius(c) / c.nominal_radius):
        out.append(
            "the runs tell ratios of lengths, and little of the mean wheel radius: drive some "
            "metres straight ahead with known positions at both ends"
        )
    for floor, one in selection.items():
        if one.runs == 1:
            out.append(f"on {floor} one run alone: intervals come from its parts; drive several")
    out += _one_speed(task)
    radii, base = c.radius[c.firmest], c.base[c.firmest]
    firmest = ", the firmest floor," if len(c.base) > 1 else ""
    for name, value, nominal, std in (
        ("wheel radius", _mean_radius(c), c.nominal_radius, max(v.std for v in radii)),
        (what, base.value, c.nominal_base, base.std),
    ):
        ratio = value / nominal
        if _is_absurd(ratio):
            out.append(
                f"the {name} comes out {ratio:.3g} times as large as in the config, which is not "
                "to be trusted, unless the wheels really slip that much: check the lengths of "
                "[robot], and the columns and units of wheels and poses"
            )
        elif abs(value - nominal) > max(FAR_FROM_CONFIG * nominal, CONTRADICTION * std):
            out.append(
                f"the {name} in the config is {1e3 * nominal:.4g} mm; on {c.firmest}{firmest} it "
                f"is {1e3 * value:.4g} mm ({100 * (ratio - 1):+.1f} %)"
            )
    apart = [abs(v.value / _mean_radius(c) - 1) for row in c.radius.values() for v in row]
    effects = [max(x[:2]) for x in c.noise.effect.values()]
    kinematic = all(one.model != "contact" for one in selection.values())
    known = all(v.verdict in ("identified", "fixed") for v in (*radii, base))
    repeated = known and all(one.held_out for one in selection.values())
    if kinematic and repeated and max(effects) < SLIP_SEEN and max(apart) < 2 * SLIP_SEEN:
        if c.centre:
            out.append("runs do not differ in slip: effective lengths explain the motion")
        else:
            out.append("no slip seen: effective lengths explain the motion")
    if kinematic and known and len(c.radius) == 1:
        out.append(
            "one floor alone: a constant slip looks the same as smaller wheels; a firm floor would "
            "tell them apart"
        )
    return tuple(out)


def _is_absurd(ratio: float) -> bool:
    """Return whether a calibrated length over the config's is far beyond what is plausible."""
    return not 1 / ABSURD < ratio < ABSURD


def _one_speed(task: FitTask) -> Iterator[str]:
    """Yield a sentence about the floors on which all runs are driven at one speed, if any."""
    runs, shape = task.dataset, task.robot.geometry
    to_body = np.asarray(shape.pseudo_inverse()) * float(shape.wheel_radius)
    speeds: dict[str, list[np.ndarray]] = {}
    for floor, log in zip(runs.surface, runs.logs, strict=True):
        edges = np.linspace(log.time[0], log.time[-1], max(2, int(log.duration / SPEED_STEP_S)))
        turned = np.diff(interpolate(log.time, log.wheel_angle, edges), axis=0)
        ahead = np.linalg.norm(turned @ to_body[:2].T, axis=1) / (edges[1] - edges[0])
        speeds.setdefault(floor, []).append(ahead)
    usual = {}
    for floor, parts in speeds.items():
        each = np.concatenate(parts)
        driven = each[each > DRIVING * each.max()]
        low, high = np.quantile(driven, [0.15, 0.9]) if len(driven) else (0.0, 0.0)
        if LEAST_M_S < high < ONE_SPEED * low:
            usual[floor] = float(np.median(driven))
    if not usual:
        return
    places = ", ".join(f"{floor} ({speed:.2g} m/s)" for floor, speed in usual.items())
    headings = np.isfinite(runs.pose[:, 2]).any()
    yield (
        f"one speed alone on {places}: the runs do not show whether slip grows with speed (its "
        "viscous terms), so that other speeds are extrapolated"
        + (
            ""
            if headings
            else "; without headings, the lag of the poses and the place of their "
            "sensor ahead are nearly one number"
        )
        + "; drive also at half or twice this speed"
    )


def _mean_radius(c: Calibration) -> float:
    """Return the mean rolling radius on the firmest floor [m]."""
    radii = c.radius[c.firmest]
    return sum(v.value for v in radii) / len(radii)


def calibration_of(task: FitTask, report: Reporter) -> CalibrationResult:
    """Return the calibration of a task with the selected kinematic models and the trust in them."""
    found = calibrated(task, report)
    selection = selected(task.dataset, found.errors, found.contradicted)
    trust = verdict_of_trust(selection, notes=remarks(found, selection, task))
    return CalibrationResult(found.calibration, selection, trust, task)


def calibrate_only(
    task: ConfigFitTask, data: Path, out: Path, report: Reporter
) -> CalibrationResult:
    """Return the calibration of a config's robot, and write identified.json and run.json to `out`.

    Args:
        task: runs and config, as read and checked by `slipid.app.identify.checked_task`.
        data: folder of the logs.
        out: folder to write to.
        report: reporter of the progress.

    Raises:
        DataError: the folder has the result of a whole fit.
    """
    if (out / FIT).exists():
        raise DataError(
            f"{out}: has the result of a whole fit ({FIT}), which a calibration would contradict; "
            "choose another folder with --out"
        )
    began = time.monotonic()
    found = calibration_of(task, report)
    writable(out)
    runs = [log.name for log in task.logs]
    messages = [] if task.calibration_only is None else [task.calibration_only]
    content = {
        "schema": SCHEMA,
        "parameters": {},
        "derived": {},
        "surfaces": list(task.robot.surfaces.labels),
        "curves": {},
        "validity": {},
        "messages": ["calibrated kinematics alone: no force balance was fitted", *messages],
        "calibration": found.calibration.to_json(),
        "selected_model": found.models,
        "trust": found.trust.to_json(),
        "data": {"hash": task.data_hash, "runs": runs},
    }
    content = json.loads(json_text(content))
    content |= {"fit": checksum(content)}
    files = {out / IDENTIFIED: json_text(content).encode(), out / CONFIG: task.config.text.encode()}
    write_together(files, files_of_fit(out, content["fit"], keep_config=True))
    write_run(task, found.trust, data, out, time.monotonic() - began)
    return replace(found, written=(IDENTIFIED, "run.json", "config.toml"))


@dataclass(frozen=True, eq=False)
class CalibrationFile:
    """Calibration in the identified.json of a result without a force balance.

    Attributes:
        calibration: the calibration.
        models: name of the selected kinematic model, keyed by floor.
        runs: names of the calibrated runs.
    """

    calibration: Calibration
    models: Mapping[str, str]
    runs: tuple[str, ...]

    def seen(self, shape: Geometry, data: Runs) -> Robot:
        """Return the robot with the calibrated pose sensor, for runs on the calibrated floors."""
        loads, sessions = (sorted(set(x)) for x in ((one.load for one in data.logs), data.session))
        robot = Robot.of(shape).on(sorted(self.calibration.radius), loads, sessions)
        return self.calibration.seen(robot)


def read_calibration(out: Path) -> CalibrationFile:
    """Return the calibration that `identify --only calibration` wrote to a folder.

    Raises:
        DataError: there is no such file, or no calibration in it.
    """
    fit_of(out)
    path = out / IDENTIFIED
    content = read_json(path, "a result of `slipid identify`")
    found = checked_result(path, content, IdentifiedContent)
    if found.calibration is None or not found.selected_model:
        raise DataError(f"{path}: no calibration; {AGAIN}")
    calibration = Calibration.of_json(content["calibration"])
    return CalibrationFile(calibration, found.selected_model, tuple(found.data.runs))


def write_run(task: ConfigFitTask, trust: Trust, data: Path, out: Path, seconds: float) -> None:
    """Write run.json, and copies of maps and bench file, which later commands read."""
    config = task.config
    if (bench := bench_of(config)) is not None:
        write_json(out / COPY_NAME, read_json(bench[0], "the parameters of a motor"))
    copy_maps(map_files(config), out)
    logs = {log.name: log.sha256 for log in task.logs}
    inputs = {"folder": str(data), "hash": task.data_hash, "logs": logs, "skipped": task.skipped}
    fit = read_json(out / IDENTIFIED, "the result that was just written")["fit"]
    verdict = {"trust": trust.to_json(), "seed": task.settings.seed, "fit": fit}
    write_run_file(out, config, inputs, seconds, verdict)
