"""The rectangle of the 2021 paper, driven by the published controllers and slipid's."""

from concurrent.futures import Executor
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from slipid.deploy.deploy import ROBOT, robot_of_force_balance
from slipid.lab.benchmark import slipid_rows
from slipid.lab.benchmark.scores import FoldScore
from slipid.lab.benchmark.work import OF_FITS, BenchmarkOptions, data_of, problem_of
from slipid.lab.trial import trial
from slipid.robot.record import LogSensors
from slipid.support.checkpoint import Checkpoint, key_of, source_hash
from slipid.support.content import Content
from slipid.support.files import read_json, write_json
from slipid.support.jax_setup import setup_jax
from slipid.support.progress import Reporter

SOURCE = "testsite"
"""Data set whose robot drives."""
CONTROLLERS = (
    "encoder",
    "goswami_padhy",
    "indiveri",
    "paper_print",
    "paper_code",
    "torque",
    "contact",
    "contact_gyro",
)
STARTS = 8


@dataclass(frozen=True)
class RectangleTask:
    """The part of the work that identifies the robot which is then driven."""

    wish: BenchmarkOptions
    name: str = "rectangle"

    @property
    def folder(self) -> Path:
        """Where the robot and its trial lie."""
        return self.wish.out / self.name

    def run(self) -> str:
        """Identify the robot of the test site from all its runs; the name of the part."""
        setup_jax(quiet=True)
        self._failure.unlink(missing_ok=True)
        try:
            self._identify()
        except Exception as error:  # other parts are done all the same
            write_json(self._failure, {"failed": FoldScore.of_error(error).absent})
        return self.name

    @property
    def _failure(self) -> Path:
        """Where it is kept why there is no robot."""
        return self.folder / "failed.json"

    def _identify(self) -> None:
        data = data_of(self.wish, SOURCE)
        code = source_hash(*OF_FITS)
        key = key_of(data.job.config.hash, data.job.data_hash, code)
        everybody = np.arange(len(data.logged))
        kept = Checkpoint(self.folder, key)
        own = slipid_rows.fit_slipid(data.job, problem_of(self.wish, SOURCE), everybody, kept)
        sensors = LogSensors(current_is_signed=data.logged.current_is_signed, voltage=True)
        robot_of_force_balance(own.contact, own.highest_speed, own.trend, sensors).save(
            self.folder / ROBOT
        )

    def drive(self, executor: Executor, report: Reporter) -> Content:
        """Drive all controllers on the virtual test site, or where MuJoCo is missing on the twin.

        Returns:
            What `slipid trial` writes, or why there is nothing.
        """
        if self._failure.is_file():
            return read_json(self._failure, "why there is no robot")
        plant = "testsite" if find_spec("mujoco") is not None else "twin"
        asked = [name for name in CONTROLLERS if not self.wish.only or name in self.wish.only]
        try:
            wish = trial.TrialOptions(plant, controllers=tuple(asked), starts=STARTS)
            return trial.trial(self.folder, wish, executor, report).content
        except Exception as error:  # all else is written all the same
            return {"failed": FoldScore.of_error(error).absent}
