"""Runs to drive next, with table and picture."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from slipid.identify.design import proposal

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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
