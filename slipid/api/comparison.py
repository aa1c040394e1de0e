"""Slip models judged on runs that they have not seen, with table and picture."""

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import numpy as np

from slipid.identify.compare.folds import folds_of, judge
from slipid.identify.compare.ranking import Ranking, ranking
from slipid.identify.compare.validation import Judged
from slipid.identify.fit.problem import Problem
from slipid.job.problem import Task
from slipid.support.errors import DataError
from slipid.support.progress import Reporter

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Comparison:
    """Which slip model each floor prefers; `print` says so in a sentence per floor.

    Attributes:
        floors: by name; each has its `best` model, and every model's score and verdict.
        question: what was left out together.
    """

    floors: dict[str, Ranking]
    question: str

    def __str__(self) -> str:
        return "\n".join(floor.sentence for floor in self.floors.values())

    def plot(self) -> "Figure":
        """Every model's distance to the best one, and its end-point error."""
        from slipid.plots.compare import SHOWN, compare_figure

        floors = {name: asdict(floor) for name, floor in self.floors.items()}
        return compare_figure(floors, SHOWN[self.question])


def compared(task: Task, problem: Problem, question: str, parts: int, quiet: bool) -> Comparison:
    """Every rung of the ladder judged fold by fold; arguments as of `Fit.compare`."""
    task.robot.geometry.inverse()  # nothing to compare where motion does not tell the wheels' turns
    fold = folds_of(task.dataset, question, parts)
    if (fold < 0).all():
        raise DataError("no run can be left out; expected several headings or speeds")
    rows: list[Judged] = []
    with Reporter(quiet=quiet) as report:
        for k in sorted(set(fold[fold >= 0].tolist())):
            report.stage(f"{question}: without part {k + 1} of {fold.max() + 1}")
            out = np.flatnonzero(fold == k)
            rows += judge(problem, task.choices, task.dataset, out).rows
    return Comparison(ranking(rows), question)
