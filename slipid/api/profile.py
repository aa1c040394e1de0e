"""A profile likelihood with its picture."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from slipid.identify.verdicts import profile

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
