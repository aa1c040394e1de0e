"""Fit a robot to runs, and look at the fit: table, pictures, profiles, predictions, posterior."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from slipid.api.results import Comparison, Profile, Proposal, Validation, compared
from slipid.data.runs import Runs
from slipid.data.sanity.columns import refuse_misordered
from slipid.identify import fit_file, result
from slipid.identify.compare.slip_models import restored
from slipid.identify.compare.validation import validation
from slipid.identify.design.proposal import design
from slipid.identify.design.wish import Wish
from slipid.identify.fit.optimise import Optimum
from slipid.identify.fit.problem import Problem, still_viscosities
from slipid.identify.posterior.blocks import Plan
from slipid.identify.verdicts import profile
from slipid.identify.verdicts.estimates import Estimate
from slipid.job.config import FitSection
from slipid.job.identify import optimised, summarised
from slipid.job.problem import Task, on_runs, said_of
from slipid.model.robot import Robot
from slipid.report.estimates import show_fit
from slipid.report.page import Page
from slipid.search_space import Choice
from slipid.support.progress import Reporter

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from slipid.api.posterior import Posterior
    from slipid.control.deployed import DeployedRobot

Numbers = int | float | Sequence[int | float]


@dataclass(frozen=True)
class Prior:
    """Gaussian prior of a number, or of every entry of a short vector, in its own unit."""

    mean: Numbers
    std: Numbers


@dataclass(frozen=True, eq=False)
class Fit:
    """A robot fitted to runs; `print` shows its numbers, and `fit[path]` gives one of them.

    Attributes:
        result: numbers, covariance, noise, and how the fit ended.
        task: runs, robot and wishes it was made of.
        problem: the likelihood of the runs.
        optimum: where the search ended.
    """

    result: result.Fit
    task: Task
    problem: Problem
    optimum: Optimum

    def __str__(self) -> str:
        page = Page(kept=True)
        show_fit(page, self.result)
        return page.text

    def __repr__(self) -> str:
        """The table, so that a notebook shows it."""
        return str(self)

    def __getitem__(self, path: str) -> Estimate:
        """One number with its interval and verdict.

        Raises:
            KeyError: no such number; names those there are.
        """
        if path not in self.result.parameters:
            raise KeyError(f"no parameter '{path}'; there are {', '.join(self.result.parameters)}")
        return self.result.parameters[path]

    @property
    def robot(self) -> Robot:
        """The robot with every number at its fitted value."""
        return self.result.robot

    @property
    def converged(self) -> bool:
        """Whether the fit came to rest."""
        return self.result.converged

    def plot(self, name: str) -> "Figure":
        """One of the fit's pictures.

        Args:
            name: `load_share`, `slip_by_heading`, `slip_by_torque`, `current_by_traction` or
                `paths`.

        Raises:
            ValueError: no such picture, or the runs have nothing for it.
        """
        from slipid.plots.fit import picture

        return picture(self.result, self.task.dataset, name)

    def profile(self, path: str, quiet: bool = False) -> Profile:
        """Profile likelihood of one free number: every other one is fitted again at each point.

        Raises:
            ValueError: no such number, fixed, or a vector; names the choices.
        """
        with Reporter(quiet=quiet) as report:
            report.stage(f"profile of {path}")
            found = profile.profile(self.problem, self.optimum, path)
        return Profile(found)

    def validate(self, runs: Runs) -> Validation:
        """Open-loop prediction of runs, by the fit and by every simpler model that it learnt.

        Raises:
            DataError: a run on a floor or with a load set-up that was not identified.
        """
        fit = self.result
        models = restored(fit.space.template.geometry, dict(fit.baselines))
        fitted = fit.contact
        return Validation(validation(fitted, models, runs), fit, runs)

    def sample(
        self,
        seed: int = 0,
        draws: int = 400,
        most: int = 400,
        plan: Plan | None = None,
        quiet: bool = False,
    ) -> "Posterior":
        """Posterior by emcee, several ensembles; needs `pip install slipid[posterior]`.

        Args:
            seed: of everything.
            draws: that are kept of each of the ensembles.
            most: blocks of steps after which it ends without having converged.
            plan: of walkers and steps, in place of `seed` and `most`.
            quiet: no progress.
        """
        from slipid.api.posterior import Posterior
        from slipid.job.sample import sampled_around

        plan = plan or Plan(seed=seed, most=most)
        with Reporter(quiet=quiet) as report:
            found = sampled_around(self.result, self.problem, plan, draws, None, report)
        return Posterior(found, self.result, self.task, self.problem)

    def compare(self, question: str = "sectors", parts: int = 6, quiet: bool = False) -> Comparison:
        """Every slip model fitted anew without some runs, and judged on those.

        Args:
            question: what is left out together: `sectors` of 60 degrees of headings, `speeds`, or
                `random` headings.
            parts: into which runs are dealt, 2 at least: one after another is left out. With 2,
                every second sector.
            quiet: show no progress.

        Raises:
            DataError: no such question.
        """
        return compared(self.task, self.problem, question, parts, quiet)

    def design(self, *parameters: str, runs: int = 12) -> Proposal:
        """Runs to drive next, that shrink some numbers most; without names whatever is weak.

        Raises:
            DataError: no such number, or fixed.
        """
        return Proposal(design(self.result, Wish(parameters=parameters, runs=runs)))

    def deploy(self) -> "DeployedRobot":
        """What runs on the robot, with the intervals of the fit's own curvature.

        Raises:
            ValueError: the wheels' kinematics have rank below 3.
        """
        from slipid.deploy.deploy import deploy

        return deploy(self.result)

    def save(self, folder: Path | str) -> None:
        """Write fit.json, its arrays and identified.json, each whole or not at all."""
        fit_file.save(self.result, Path(folder))


def fit(
    runs: Runs,
    robot: Robot,
    *,
    priors: Mapping[str, Prior] | None = None,
    fixed: Mapping[str, Numbers] | None = None,
    start: Mapping[str, Numbers] | None = None,
    free: Sequence[str] = (),
    image_centre: tuple[float, float] = (0.0, 0.0),
    windows_per_piece: int = 4,
    seed: int = 0,
    quiet: bool = False,
) -> Fit:
    """Fit motors, floors, wheel loads and camera to runs, end to end.

    Names of numbers are paths such as `motor.resistance` or `surface.gray.creep`; `*` and `?`
    stand for any text. What is not named keeps its declared prior or value.

    Args:
        runs: of `read_runs`, each on one floor.
        robot: that drove them, such as `Robot.omni(...)`.
        priors: what is known of a number before; the number is fitted.
        fixed: numbers that keep a value [SI].
        start: values the search begins with [SI].
        free: numbers that are fitted with their declared priors, where they are not by default.
        image_centre: where the camera's tilt and distortion are zero [m].
        windows_per_piece: how finely runs are cut.
        seed: of the draws behind the bands of slip curves.
        quiet: show no progress.

    Raises:
        DataError: the runs cannot be cut into windows, or columns of wheels are exchanged.
        ValueError: no such number, or a value outside its bounds.

    Source: the contact law of `slipid.model.contact_law`, the likelihood of `slipid.identify.fit`.
    """
    refuse_misordered(runs.logs)
    wishes = priors or {}, fixed or {}, start or {}, free
    task = task_of(runs, robot, *wishes, image_centre, windows_per_piece, seed)
    with Reporter(quiet=quiet) as report:
        problem, optimum = optimised(task, task.problem(), None, report)
        found = summarised(task, problem, optimum, report)
    return Fit(found, task, problem, optimum)


def task_of(
    runs: Runs,
    robot: Robot,
    priors: Mapping[str, Prior],
    fixed: Mapping[str, Numbers],
    start: Mapping[str, Numbers],
    free: Sequence[str],
    image_centre: tuple[float, float] = (0.0, 0.0),
    windows_per_piece: int = 4,
    seed: int = 0,
) -> Task:
    """What is to be fitted; arguments as of `fit`."""
    full = on_runs(robot, runs, image_centre)
    choices = [*still_viscosities(runs), *said_of(full, float(full.body.mass))]
    choices += [Choice(path, free=True) for path in free]
    for path, prior in priors.items():
        choices.append(Choice(path, prior_mean=_plain(prior.mean), prior_std=_plain(prior.std)))
    choices += [Choice(path, fixed=_plain(value)) for path, value in fixed.items()]
    choices += [Choice(path, start=_plain(value)) for path, value in start.items()]
    settings = FitSection(windows_per_piece=windows_per_piece, seed=seed)
    return Task(runs, full, tuple(choices), settings)


def _plain(value: Numbers) -> float | list[float]:
    """A number, or a list of them, as JSON holds them."""
    return np.asarray(value, float).tolist()
