"""The example of `docs/python.md`, run once for every file of this folder."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest

from slipid.data.write import robotino2022_csv
from slipid.infer.posterior import blocks, sample
from slipid.infer.posterior.blocks import Plan
from slipid.lab.selftest.logs import SimulatedSensors, heading_grid, simulate_logs, true_robot

ROOT = Path(__file__).resolve().parents[2]
FLOORS = (("gray", "as_built"),)
DRIVES = heading_grid(setups=FLOORS, headings=6, speeds=(0.1, 0.3), turns=0)


def example() -> str:
    """The Python example of `docs/python.md`."""
    return re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "python.md").read_text(), re.S)[0]


def write_runs(folder: Path) -> None:
    """Made logs of the drives, laid out as those of 2022."""
    for k, log in enumerate(simulate_logs(true_robot(DRIVES), DRIVES, 1, SimulatedSensors())):
        path = folder / "one_surface" / str(log.surface) / f"exp{k:02d}.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(
            robotino2022_csv(replace(log, wheel_speed_command=log.wheel_speed), 16.0, 2000)
        )


@pytest.fixture(scope="session")
def world(tmp_path_factory) -> dict:
    """Names that the example leaves behind, run where its logs are; few steps sampled."""
    folder = tmp_path_factory.mktemp("readme")
    write_runs(folder / "logs")
    around = sample.sampled
    names: dict = {"angle": [0.0, 0.1, 0.2], "amps": [0.3, 0.1, 0.4]}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        few = Plan(ensembles=2, walkers=6, block=4, warm_up=(1, 2), most=3, rows=200)
        patch.setattr(blocks, "Plan", lambda seed, most: replace(few, seed=seed))
        patch.setattr(
            sample, "sampled", lambda fit, plan, draws, *rest: around(fit, plan, 16, *rest)
        )
        exec(compile(example(), "docs/python.md", "exec"), names)
    names["folder"] = folder
    return names
