"""Results of slipid for a robot's logs: calibration, `slipid identify`, and `slipid validate`."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from slipid.app.config import read_config
from slipid.app.problem import read_fit_task
from slipid.fitting.calibration.estimate import calibrate
from slipid.search_space import Space
from slipid.support.errors import DataError
from slipid.support.progress import Reporter
from tests.benchmarks.every_robot.drive import Judged
from tests.benchmarks.every_robot.rivals import Kinematics
from tests.benchmarks.every_robot.robots import MadeRobot
from tests.benchmarks.every_robot.score import numbers, true
from tests.helpers.shared import invoke

Rows = dict[str, dict[str, float]]
"""Mean error over the fresh runs [% of the path], keyed by model and floor."""


@dataclass(frozen=True)
class Answer:
    """Answer of slipid about a robot.

    Attributes:
        verdict: verdict of trust, or why there is none.
        rows: errors, keyed by slip model.
        inside: whether the 90 % interval of each number of the motors holds the true one.
        selected: slip model that slipid selects on each floor.
    """

    verdict: str
    rows: Rows = field(default_factory=dict)
    inside: dict[str, bool] = field(default_factory=dict)
    selected: dict[str, str] = field(default_factory=dict)


def calibration(robot: MadeRobot, folder: Path) -> dict | str:
    """Section `calibration` of identified.json, made without the rest of a fit, or why not."""
    try:
        with Reporter(quiet=True) as report:
            task = read_fit_task(read_config(folder / "robot.toml"), folder / "logs", report)
        space = Space(task.robot, task.choices)
        return calibrate(task.dataset, space, task.choices).to_json()
    except DataError as error:
        return f"refused: {str(error).replace(str(folder), '')}"


def kinematics(content: dict) -> Kinematics:
    """The numbers of a section `calibration`, for the judge."""
    floors = content["surfaces"]
    length = "effective_base_m" if "base_m" in content["nominal"] else "effective_track_m"
    centre = dict.fromkeys(floors, 0.0)
    centre |= {floor: of["value"] for floor, of in content["centre_of_rotation_m"].items()}
    x, y = (of["value"] for of in content["pose_offset_m"])
    straight = {"zero_rad": {"value": 0.0}, "gain": {"value": 1.0}, "understeer": {"value": 0.0}}
    steering = content.get("steering", straight)
    return Kinematics(
        {f: np.array([r["value"] for r in of["rolling_radius_m"]]) for f, of in floors.items()},
        {f: of[length]["value"] for f, of in floors.items()},
        centre,
        (x, y),
        content["pose_yaw_rad"]["value"],
        content["pose_lag_s"]["value"],
        (steering["zero_rad"]["value"], steering["gain"]["value"]),
        dict.fromkeys(floors, steering["understeer"]["value"]),
    )


def answer(robot: MadeRobot, folder: Path, truth: dict[str, Judged]) -> Answer:
    """Fit the logs of a folder and predict its fresh runs, as a user would on the command line."""
    config, out = folder / "robot.toml", folder / "out"
    done = invoke("identify", config, "--data", folder / "logs", "--out", out, "--quiet")
    if done.exit_code not in (0, 1) or not (out / "identified.json").exists():
        return Answer(f"refused: {done.stderr.strip().replace(str(folder), '')}")
    content = json.loads((out / "identified.json").read_text(encoding="utf-8"))
    run = json.loads((out / "run.json").read_text(encoding="utf-8"))
    verdict = (content.get("trust") or run["trust"])["verdict"]
    inside = covered_motors(robot, content["parameters"])
    selected = content.get("selected_model", {})
    file = out / "validation.json"
    done = invoke("validate", out, "--data", folder / "fresh", "--json", file, "--quiet")
    if done.exit_code != 0:
        return Answer(f"{verdict}; not validated: {done.stderr.strip()}", {}, inside, selected)
    runs = json.loads(file.read_text(encoding="utf-8"))["runs"]
    return Answer(verdict, _rows(runs, truth), inside, selected)


def _rows(runs: Iterable[dict], truth: dict[str, Judged]) -> Rows:
    """Errors of every model over the true path lengths, by which the rivals are judged, too."""
    errors: dict[str, dict[str, list[float]]] = {}
    for run in runs:
        path = next(j.path for name, j in truth.items() if run["name"].endswith(name))
        for model, score in run["models"].items():
            error = 100 * run["chord"] * score["endpoint_error"] / path
            name = "contact" if model == "identified" and "contact" not in run["models"] else model
            errors.setdefault(name, {}).setdefault(run["surface"], []).append(error)
    return {
        model: {floor: sum(each) / len(each) for floor, each in floors.items()}
        for model, floors in errors.items()
    }


def covered(robot: MadeRobot, calibration: dict) -> dict[str, bool]:
    """Return, for each number of the calibration, whether its interval holds the true one."""
    stated = {"lag": calibration["pose_lag_s"]}
    stated |= dict(zip(("place x", "place y"), calibration["pose_offset_m"], strict=True))
    for floor, centre in calibration.get("centre_of_rotation_m", {}).items():
        stated[f"centre {floor}"] = centre
    for floor, of in calibration["surfaces"].items():
        for j, radius in enumerate(of["rolling_radius_m"]):
            stated[f"radius {floor} {j + 1}"] = radius
        for key in {"effective_track_m", "effective_base_m"} & of.keys():
            stated[f"base {floor}"] = of[key]
    stated |= {f"steering {key}": of for key, of in calibration.get("steering", {}).items()}
    truth, found = true(robot), {}
    for name, number in numbers(robot).items():
        if stated.get(name, {}).get("interval90") is not None:
            low, high = stated[name]["interval90"]
            found[name] = bool(low <= number(truth) <= high)
    return found


def covered_motors(robot: MadeRobot, parameters: dict) -> dict[str, bool]:
    """Return, for each number of the motors, whether its interval holds the true one."""
    if robot.motors is None:
        return {}
    right = {
        "motor.resistance": robot.motors.resistance,
        "motor.back_emf": robot.motors.back_emf,
        "motor.coulomb_friction": robot.motors.coulomb,
        "motor.viscous_friction": robot.motors.viscous,
    }
    found = {}
    for path, value in right.items():
        low, high = parameters[path]["interval90"]
        found[path] = bool(low <= value <= high)
    return found
