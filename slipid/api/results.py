"""What a fit is asked for beyond its numbers, each with table and picture."""

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import numpy as np

from slipid.data.runs import Runs
from slipid.identify.compare import validation
from slipid.identify.compare.folds import folds_of, judge
from slipid.identify.compare.ranking import Ranking, ranking
from slipid.identify.design import proposal
from slipid.identify.fit.problem import Problem
from slipid.identify.result import Fit
from slipid.identify.verdicts import profile
from slipid.job.problem import Task
from slipid.support.errors import DataError
from slipid.support.progress import Reporter

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Profile:
    """Profile likelihood of one number; `print` says in a sentence what it tells.

    Attributes:
        result: points, rises, interval.
    """

    result: profile.Profile

    def __str__(self) -> str:
        return self.result.said

    def plot(self) -> "Figure":
        """How fast the fit gets worse when the number is held elsewhere."""
        from slipid.plots.posterior import profile_figure

        return profile_figure([self.result])


@dataclass(frozen=True, eq=False)
class Validation:
    """Runs that a fit predicted open loop, model by model; `print` shows the mean errors.

    Attributes:
        result: every run and model.
        fit: that predicted.
        runs: that were predicted.
    """

    result: validation.Validation
    fit: Fit
    runs: Runs

    def __str__(self) -> str:
        return self.result.table

    def plot(self) -> "Figure":
        """End-point errors of every model."""
        from slipid.plots.compare import ladder_figure
        from slipid.plots.fit import new_runs

        return ladder_figure(self.result.to_json(), new_runs(self.fit, self.runs))


@dataclass(frozen=True, eq=False)
class Proposal:
    """Runs that would shrink what was asked for; `print` shows their commands as CSV.

    Attributes:
        result: the runs, what each is expected to tell, and what they save against grids.
    """

    result: proposal.Design

    def __str__(self) -> str:
        notes = [f"note: {text}" for text in self.result.content["messages"]]
        return "\n".join([proposal.commands(self.result).rstrip(), *notes])

    def plot(self) -> "Figure":
        """The runs, and how fast uncertainty falls."""
        from slipid.plots.design import design_figure

        return design_figure(self.result)


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
    """Every slip model judged fold by fold; arguments as of `Fit.compare`."""
    fold = folds_of(task.dataset, question, parts)
    if (fold < 0).all():
        raise DataError("no run can be left out; expected several headings or speeds")
    rows: list[validation.ScoredRun] = []
    with Reporter(quiet=quiet) as report:
        for k in sorted(set(fold[fold >= 0].tolist())):
            report.stage(f"{question}: without part {k + 1} of {fold.max() + 1}")
            out = np.flatnonzero(fold == k)
            rows += judge(problem, task.choices, task.dataset, question, out).rows
    return Comparison(ranking(rows), question)
