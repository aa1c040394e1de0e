"""Unseen real runs through the deployed estimator, floor unknown, from numbers fitted elsewhere."""

from __future__ import annotations

import json
from glob import escape
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from slipid.data.floor_map import patchwork
from slipid.data.reading.presets import preset
from slipid.data.runs import Runs, collect
from slipid.deploy.controllers import control_loop_of
from slipid.lab.trial.controllers import ROWS
from slipid.model.geometry import omni
from slipid.model.robot import Robot, build
from slipid.robot import trajectory as reference
from slipid.robot.deployed import DeployedRobot
from slipid.robot.estimator import Estimator
from slipid.robot.filter.floor import Floor
from slipid.robot.interface import Settings
from slipid.robot.twin import ActuatorModel, Twin
from slipid.search_space import Choice, Space
from tests.helpers import replayed
from tests.helpers.known_robot import deploy_known
from tests.helpers.one_log import read_log
from tests.helpers.rolled_out import rollout

FIT = Path(__file__).parents[1] / "helpers" / "robotino2022_sectors.json"
"""Numbers of a fit that has seen no heading of 0 to 60 deg."""
_rollout = eqx.filter_jit(rollout)
pytestmark = pytest.mark.slow  # compiles the estimator of 64 hypotheses


@pytest.fixture(scope="module")
def robot() -> Robot:
    kept = json.loads(FIT.read_text())
    shape = omni([60.0, 180.0, 300.0], 0.125, 0.040, gear_ratio=16.0)
    bare = build(shape, kept["surfaces"], kept["loads"], kept["sessions"], tuple(kept["centre"]))
    fixed = [Choice(escape(path), fixed=value) for path, value in kept["values"].items()]
    return Space(bare, fixed).template


@pytest.fixture(scope="module")
def data(real_data: Path) -> Runs:
    """Eight runs on each floor at 0.1 m/s, 0 to 40 deg: the worst sixth on carpets."""
    folder = real_data / "robotino2022" / "one_surface"
    paths = sorted(folder.glob("*/exp0[0-8].csv"))
    layout = preset("robotino2022")
    return collect([read_log(p, layout, root=folder, surface=p.parent.name) for p in paths])


@pytest.fixture(scope="module")
def deployed(robot: Robot) -> DeployedRobot:
    kept = json.loads(FIT.read_text())
    std, trend = kept["std"], tuple(kept["current_trend"])
    return deploy_known(robot, std=std, highest_speed=8.0, current_trend=trend)


@pytest.fixture(scope="module")
def said(deployed: DeployedRobot, data: Runs) -> list[Any]:
    return replayed.replay(Estimator(deployed), data.logs)


@pytest.fixture(scope="module")
def rows(
    robot: Robot, deployed: DeployedRobot, data: Runs, said: list[Any]
) -> list[replayed.Judged]:
    std = json.loads(FIT.read_text())["std"]
    noise = {name: value**2 for name, value in std.items()}
    return replayed.judged(robot, deployed.labels, data, said, noise)


def test_it_repeats_the_reviewed_numbers(data: Runs, said: list[Any], golden) -> None:
    """Pose, covariance, slip and belief half-way and at the end of every run."""
    table = []
    for log, of in zip(data.logs, said, strict=True):
        for row in (log.samples // 2, log.samples - 1):
            x, y, yaw = of.pose[row].tolist()
            std = np.sqrt(np.diag(of.covariance[row])).tolist()
            belief = of.surface_probability[row].mean(axis=0).tolist()
            table.append(
                {"run": log.name, "row": row, "x": x, "y": y, "yaw": yaw}
                | dict(zip(("std_x", "std_y", "std_yaw"), std, strict=True))
                | {f"slip_{k}": float(v) for k, v in enumerate(of.slip[row], 1)}
                | {f"belief_{k}": float(v) for k, v in enumerate(belief)}
                | {
                    "flags": float(
                        sum(map(int, (of.stale[row], of.immobilised[row], of.out_of_range[row])))
                    )
                }
            )
    golden("replay", table, rtol=1e-6, atol=1e-8)


def test_twin_and_controllers_do_what_was_reviewed(deployed: DeployedRobot, golden) -> None:
    """The first 20 s of three starts of a trial on the fit's own twin, on four floors."""
    lines = []
    for k, start in enumerate(((0.0, 0.0, 0.3), (-0.4, 0.2, 2.0), (0.3, -0.3, -1.6))):
        drawn = patchwork(deployed.labels, seed=40 + k, patch=0.35, half=2.0)
        floor = Floor(jnp.asarray(drawn.cells), jnp.asarray(drawn.corner), jnp.asarray(drawn.cell))
        for row in (
            "encoder",
            "paper_code",
            "contact",
            "contact_map",
            "contact_gyro",
        ):
            kind = ROWS[row]
            habits = ActuatorModel(voltage=False, gyro=kind.gyro)
            control_loop = control_loop_of(deployed, kind, Settings(), floor=floor)
            path = reference.rectangle().moved(start).after_rest(1.0)
            twin = Twin(deployed, floor, habits)
            key = jax.random.key(1000 + k)
            pose, said = _rollout(control_loop, path, twin, jnp.asarray(start), key, 400)
            estimates = said.estimate
            for at in (100, 399):
                numbers = {
                    "x": pose[at, 0],
                    "y": pose[at, 1],
                    "yaw": pose[at, 2],
                    "believed_x": estimates.pose[at, 0],
                    "believed_y": estimates.pose[at, 1],
                    "believed_yaw": estimates.pose[at, 2],
                    "wheel_1": said.command[at, 0],
                    "wheel_2": said.command[at, 1],
                    "wheel_3": said.command[at, 2],
                    "current_1": estimates.current[at, 0],
                    "path_time": said.time[at],
                }
                plain = {name: float(value) for name, value in numbers.items()}
                lines.append({"start": k, "controller": row, "step": at} | plain)
    # a closed loop on patches grows rounding errors, a millionth in 20 s
    golden("trial", lines, rtol=1e-4, atol=1e-5)


def test_floors_are_recognised_within_a_second(rows: list[replayed.Judged]) -> None:
    assert len(rows) >= 20
    assert np.mean([r.told == r.surface for r in rows]) > 0.85


@pytest.mark.parametrize(
    ("floor", "most"), [("table", 0.02), ("brown", 0.04), ("gray", 0.17), ("green", 0.40)]
)
def test_end_points_are_predicted(rows: list[replayed.Judged], floor: str, most: float) -> None:
    some = [r for r in rows if r.surface == floor]
    error, straight = (np.mean([getattr(r, k) for r in some]) for k in ("error", "straight"))
    assert error < most
    assert floor in ("table", "brown") or error < 0.7 * straight


def test_regions_are_not_too_narrow(rows: list[replayed.Judged]) -> None:
    assert np.mean([r.level <= 0.9 for r in rows]) > 0.6
