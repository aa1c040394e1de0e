"""Closed-loop runs on the rectangle of the 2021 paper, with published controllers and slipid's."""

from concurrent.futures import Executor
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from slipid.deploy.deploy import ROBOT, robot_of_force_balance
from slipid.lab.benchmark.scores import FoldScore
from slipid.lab.benchmark.slipid_rows import fit_slipid
from slipid.lab.benchmark.work import FIT_SOURCES, BenchmarkOptions, data_of, problem_of
from slipid.lab.trial import trial
from slipid.robot.record import LogSensors
from slipid.support.checkpoint import Checkpoint, key_of, source_hash
from slipid.support.content import Content
from slipid.support.files import read_json, write_json
from slipid.support.jax_setup import setup_jax
from slipid.support.progress import Reporter

SOURCE = "testsite"
"""Name of the data set from which the robot is identified."""
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
    """Task that identifies the test site's robot and drives it in closed-loop runs.

    Attributes:
        options: options of the benchmark.
        name: name of the task.
    """

    options: BenchmarkOptions
    name: str = "rectangle"

    @property
    def folder(self) -> Path:
        """Folder of robot.json and of the trial's results."""
        return self.options.out / self.name

    def run(self) -> str:
        """Identify the robot of the test site from all its runs, and return the task's name."""
        setup_jax(quiet=True)
        self._failure.unlink(missing_ok=True)
        try:
            self._identify()
        except Exception as error:  # the other tasks run even if this one fails
            write_json(self._failure, {"failed": FoldScore.of_error(error).absent})
        return self.name

    @property
    def _failure(self) -> Path:
        """Path of the file that records why the robot could not be identified."""
        return self.folder / "failed.json"

    def _identify(self) -> None:
        """Fit slipid to all runs, and write robot.json."""
        data = data_of(self.options, SOURCE)
        code = source_hash(*FIT_SOURCES)
        key = key_of(data.job.config.hash, data.job.data_hash, code)
        everybody = np.arange(len(data.logged))
        kept = Checkpoint(self.folder, key)
        fit = fit_slipid(data.job, problem_of(self.options, SOURCE), everybody, kept)
        sensors = LogSensors(current_is_signed=data.logged.current_is_signed, voltage=True)
        robot_of_force_balance(fit.contact, fit.highest_speed, fit.trend, sensors).save(
            self.folder / ROBOT
        )

    def drive(self, executor: Executor, report: Reporter) -> Content:
        """Run all controllers on the virtual test site, or on the twin if MuJoCo is missing.

        Returns:
            Content that `slipid trial` writes, or the reason for a failure under the key `failed`.
        """
        if self._failure.is_file():
            return read_json(self._failure, "the reason why there is no robot")
        plant = "testsite" if find_spec("mujoco") is not None else "twin"
        only = self.options.only or CONTROLLERS
        controllers = [name for name in CONTROLLERS if name in only]
        try:
            options = trial.TrialOptions(plant, controllers=tuple(controllers), starts=STARTS)
            return trial.trial(self.folder, options, executor, report).content
        except Exception as error:  # the benchmark goes on if the trial fails
            return {"failed": FoldScore.of_error(error).absent}
