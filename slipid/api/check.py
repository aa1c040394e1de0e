"""What runs hold and can tell, before anything is fitted."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from slipid.api.fit import Numbers, Prior, task_of
from slipid.data.runs import Runs
from slipid.identify.verdicts.estimates import Estimate
from slipid.job.check import Expected, expected, overview
from slipid.model.robot import Robot
from slipid.report.estimates import show_check
from slipid.report.page import text_of
from slipid.support.content import Content


@dataclass(frozen=True, eq=False)
class LogCheck:
    """What runs hold and can be expected to tell; `print` shows it, `check[path]` is one number.

    Attributes:
        content: runs by floor, channels, what the reader repaired.
        result: verdicts that can be expected, and what stays open.
    """

    content: Content
    result: Expected

    def __str__(self) -> str:
        return text_of(show_check, self.content | self.result.to_json())

    def __getitem__(self, path: str) -> Estimate:
        """What is to be expected of one number; KeyError where there is none of this name."""
        return self.result.parameters[path]


def check(
    runs: Runs,
    robot: Robot,
    *,
    priors: Mapping[str, Prior] | None = None,
    fixed: Mapping[str, Numbers] | None = None,
    free: Sequence[str] = (),
) -> LogCheck:
    """Look before you fit: arguments and errors as of `fit`, which takes far longer."""
    task = task_of(runs, robot, priors or {}, fixed or {}, {}, free)
    return LogCheck(overview(task), expected(task, task.problem()))
