"""Draws of a posterior with their table, pictures, and the robot that is made of them."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from slipid.control.deployed import DeployedRobot
from slipid.deploy.deploy import deploy
from slipid.identify.fit.problem import Problem
from slipid.identify.posterior import diagnosis, netcdf
from slipid.identify.result import Fit
from slipid.identify.verdicts.estimates import Estimate
from slipid.job.problem import Task
from slipid.report import estimates as report
from slipid.report.page import Page

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from xarray import DataTree


@dataclass(frozen=True, eq=False)
class Posterior:
    """Posterior of a fit; `print` shows its numbers and whether the chains agree.

    Attributes:
        result: draws and diagnosis.
        fit: that was sampled around.
        task: runs, robot and wishes.
        problem: the likelihood of the runs.
    """

    result: diagnosis.Posterior
    fit: Fit
    task: Task
    problem: Problem

    def __str__(self) -> str:
        page = Page(kept=True)
        page.table(report.estimates(self.parameters.values(), f"{self.result.log_prob.size} draws"))
        state = "converged" if self.converged else "NOT converged, do not trust the intervals"
        page.line(f"{state}: {self.result.reason}")
        return page.text

    @property
    def converged(self) -> bool:
        """Whether the chains may be believed."""
        return self.result.converged

    @cached_property
    def parameters(self) -> dict[str, Estimate]:
        """Every number by path, with mean, interval and verdict from the draws."""
        return diagnosis.estimates(self.fit, self.result.z)

    def draws(self, path: str) -> Float[np.ndarray, "ensemble draw *number"]:
        """Draws of a free number [SI], a row per ensemble, early steps first.

        Raises:
            KeyError: no such number, or fixed; names those there are.
        """
        space = self.fit.space
        if path not in space.place:
            raise KeyError(f"no draws of '{path}'; there are {', '.join(space.place)}")
        d = next(e.declaration for e in space.free if e.path == path)
        found = jax.vmap(jax.vmap(d.to_si))(jnp.asarray(self.result.z[..., space.place[path]]))
        return np.asarray(found if d.tied else found[..., 0])

    @cached_property
    def tree(self) -> "DataTree":
        """Draws, likelihoods and replicated data as an ArviZ DataTree."""
        runs = tuple(log.name for log in self.task.dataset.logs)
        about = {"schema": netcdf.SCHEMA, "data_hash": self.fit.data_hash}
        return netcdf.tree(self.problem, self.result, runs, about)

    def plot(self, name: str = "intervals") -> "Figure":
        """One of the posterior's pictures.

        Args:
            name: `intervals` of every number, or `pairs` that are bent the most.

        Raises:
            ValueError: no such picture.
        """
        from slipid.plots.posterior import PICTURES

        if name not in PICTURES:
            raise ValueError(f"no picture '{name}'; there are {', '.join(PICTURES)}")
        return PICTURES[name](self.fit, self.result.z.reshape(-1, self.fit.space.size))

    def deploy(self) -> DeployedRobot:
        """What runs on the robot, with the intervals of the draws.

        Raises:
            ValueError: the wheels' kinematics have rank below 3.
        """
        return deploy(self.fit, self.result)

    def save(self, path: Path | str) -> None:
        """Write posterior.nc, whole or not at all."""
        netcdf.write(self.tree, Path(path))
