"""Function `fit`: fit a robot to runs, with priors and choices given as arguments."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from slipid.app.config import FitSection
from slipid.app.identify import fitted
from slipid.app.problem import FitTask, of_torques, robot_for_runs, stated_sizes
from slipid.data.check.columns import refuse_misordered
from slipid.data.check.stuck import refuse_stuck
from slipid.data.runs import Runs
from slipid.fitting.problem import fixed_viscosities
from slipid.infer.result import Fit
from slipid.model.robot import Robot
from slipid.search_space import Choice
from slipid.support.progress import Reporter

Numbers = int | float | Sequence[int | float]


@dataclass(frozen=True)
class Prior:
    """Gaussian prior of a parameter, or of every entry of a vector, in the parameter's unit.

    Attributes:
        mean: mean, one number for all entries or one for each.
        std: standard deviation, one number for all entries or one for each.
    """

    mean: Numbers
    std: Numbers


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
    intervals: Literal["sampled", "laplace"] = "sampled",
    seed: int = 0,
    quiet: bool = False,
) -> Fit:
    """Fit the parameters of motors, floors, wheel loads and camera to runs.

    Parameters are named by paths such as `motor.resistance` or `surface.gray.creep`, in which `*`
    stands for any text and `?` for any character. Parameters that are not named keep their declared
    prior or value.

    Args:
        runs: runs from `read_runs`, each on one floor.
        robot: robot that drove the runs, such as `Robot.omni(...)`.
        priors: priors of parameters, keyed by path; these parameters are fitted.
        fixed: values of parameters that are not fitted, keyed by path [SI].
        start: start values of the search, keyed by path [SI].
        free: paths of parameters that are fitted with their declared priors although they are not
            fitted by default.
        image_centre: point x, y in the frame of the poses at which the camera's tilt and distortion
            cause no error [m].
        windows_per_piece: number of neighbouring windows in a segment, which the fit treats as one
            observation.
        intervals: "sampled" if a short chain of the posterior replaces intervals of the Laplace
            approximation that it contradicts; "laplace" for the approximation alone, which takes
            less time.
        seed: seed of that chain and of the draws from which the bands of slip curves are computed.
        quiet: True to report no progress.

    Raises:
        DataError: the runs cannot be divided into windows, columns of wheels are exchanged, or an
            encoder or the positions stay constant while the robot moves.
        ValueError: there is no such parameter, or a value is outside its bounds.

    Source: the contact law of `slipid.model.contact_law`, the likelihood of `slipid.fitting`.
    """
    refuse_misordered(runs.logs)
    refuse_stuck(runs, robot.geometry)
    chosen = priors or {}, fixed or {}, start or {}, free
    task = fit_task_of(runs, robot, *chosen, image_centre, windows_per_piece, seed)
    task = replace(task, settings=task.settings.model_copy(update={"intervals": intervals}))
    with Reporter(quiet=quiet) as report:
        return fitted(task, report)[0]


def fit_task_of(
    runs: Runs,
    robot: Robot,
    priors: Mapping[str, Prior],
    fixed: Mapping[str, Numbers],
    start: Mapping[str, Numbers],
    free: Sequence[str],
    image_centre: tuple[float, float] = (0.0, 0.0),
    windows_per_piece: int = 4,
    seed: int = 0,
) -> FitTask:
    """Return the fit task of runs and choices; the arguments are those of `fit`."""
    full = robot_for_runs(robot, runs, image_centre)
    choices = [*fixed_viscosities(runs), *stated_sizes(full, float(full.body.mass))]
    before = len(choices)
    choices += [Choice(path, free=True) for path in free]
    for path, prior in priors.items():
        choices.append(
            Choice(path, prior_mean=_json_numbers(prior.mean), prior_std=_json_numbers(prior.std))
        )
    choices += [Choice(path, fixed=_json_numbers(value)) for path, value in fixed.items()]
    choices += [Choice(path, start=_json_numbers(value)) for path, value in start.items()]
    choices += of_torques(runs, full)
    settings = FitSection(windows_per_piece=windows_per_piece, seed=seed)
    user = len(choices) - before
    return FitTask(runs, full, tuple(choices), settings, user_choices=user)


def _json_numbers(value: Numbers) -> float | list[float]:
    """Return a number as a float, or several numbers as a list, as in a JSON file."""
    return np.asarray(value, float).tolist()
