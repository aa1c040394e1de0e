"""Robots on ordinary wheels that MuJoCo drives: training and held-back runs, for benchmarks.

    found = simulated("skid", seed=0, training=8, held_back=4, out=folder)

The robots are those of configs/testsite_skid.toml and configs/testsite_differential.toml. All of a
robot's floors are driven on. Held-back runs are random paths at other speeds than training runs.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from itertools import cycle, islice
from pathlib import Path
from typing import Any

from slipid.lab.testsite.config import SimulationPlan, plan
from slipid.lab.testsite.simulate import simulate
from slipid.support.executor import InProcess, Processes
from slipid.support.progress import Reporter

ROOT = Path(__file__).resolve().parents[2]
ROBOTS = {"skid": ("firm", "soft"), "differential": ("firm", "medium")}
"""Floors of each robot."""
MOTIONS = (
    'kind = "arcs"\ncurvatures_1_m = [0.0]\nspeeds_m_s = [0.3]\ndistance_m = 1.5',
    'kind = "spins"\nrates_deg_s = [40]\nangle_deg = 180',
    'kind = "arcs"\ncurvatures_1_m = [0.8]\nspeeds_m_s = [0.3]\ndistance_m = 1.5',
    'kind = "spins"\nrates_deg_s = [-40]\nangle_deg = 180',
    'kind = "arcs"\ncurvatures_1_m = [-0.8]\nspeeds_m_s = [0.3]\ndistance_m = 1.5',
    'kind = "arcs"\ncurvatures_1_m = [0.0]\nspeeds_m_s = [-0.2]\ndistance_m = 1.0',
    'kind = "arcs"\ncurvatures_1_m = [0.0]\nspeeds_m_s = [0.5]\ndistance_m = 2.0',
    'kind = "spins"\nrates_deg_s = [70]\nangle_deg = 360',
)
"""Training runs in the order in which they are driven, from the start again after the last."""
HELD_BACK = 'kind = "paths"\nspeeds_m_s = [0.15, 0.4]\nturn_deg_s = 50'


@dataclass(frozen=True)
class SiteRuns:
    """Simulated runs of one robot.

    Attributes:
        config: config with which `slipid identify` fits the training runs.
        training: folder of the training runs' logs, to which the globs in the config refer.
        held_back: folder of the logs of held-back runs, in the same folders below it.
        kinematics: true effective kinematics of the training runs, keyed by surface.
        simulated_s: duration of all runs driven by this call [s].
    """

    config: Path
    training: Path
    held_back: Path
    kinematics: dict[str, Any]
    simulated_s: float


def simulated(
    robot: str, seed: int, training: int, held_back: int, out: Path, jobs: int = 1
) -> SiteRuns:
    """Drive runs of a robot, the given numbers on each floor, and return where their logs are.

    Args:
        robot: name of the robot, a key of `ROBOTS`.
        seed: seed of floors, starts, sensor noise and paths.
        training: number of training runs on each floor.
        held_back: number of held-back runs on each floor.
        out: folder for the runs; those that it already has are not driven again.
        jobs: number of processes.
    """
    path = ROOT / "configs" / f"testsite_{robot}.toml"
    shared = path.read_text(encoding="utf-8").partition("[[runs]]")[0]
    parts = {
        "training": (2 * seed, list(islice(cycle(MOTIONS), training))),
        "held_back": (2 * seed + 1, [f"{HELD_BACK}\nseed = {seed}\ncount = {held_back}"]),
    }
    seconds = 0.0
    for part, (number, motions) in parts.items():
        text = shared.replace("\nseed = 0\n", f"\nseed = {number}\n")
        for floor in ROBOTS[robot]:
            text += "".join(f'\n[[runs]]\nsurface = "{floor}"\n{motion}\n' for motion in motions)
        seconds += _driven(plan(path, text), out / part, jobs)
    kinematics = json.loads((out / "training/truth/kinematics.json").read_text(encoding="utf-8"))
    return SiteRuns(
        config=out / "training" / "robot.toml",
        training=out / "training" / "logs",
        held_back=out / "held_back" / "logs",
        kinematics=kinematics["load_setups"]["as_built"],
        simulated_s=seconds,
    )


def _driven(made: SimulationPlan, out: Path, jobs: int) -> float:
    """Drive the runs of a plan that the folder lacks, and return their duration [s]."""
    with Reporter(quiet=True) as report, Processes(jobs) if jobs > 1 else InProcess() as executor:
        return float(simulate(made, out, executor, report)["seconds"])
