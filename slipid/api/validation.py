"""Predictions of runs with their table and picture."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from slipid.data.runs import Runs
from slipid.identify.compare import validation
from slipid.identify.result import Fit

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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
