"""Agreement of runs over several floors with runs on one floor, and the scatter of runs.

Two questions are answered here: whether a fit that includes runs over several floors still predicts
the runs on one floor, and how much runs scatter before any physics is fitted to them.

For the scatter, the motion of the body is regressed on smooth functions of the wheels' motion, for
each floor and load set-up: a Fourier series in the direction of travel, the yaw, the change of the
wheels' motion per lag of the camera and, where the position of the marker on the body is fitted,
the displacement of the marker by turning. Every run is predicted from all other runs with its floor
and load set-up. The residual in window k of run r, in which the robot moves by the distance d_rk,
is

    e_rk = a_r d_rk + s_rk,   var a = v_run,   var s_rk = v_process d_rk

with the effect a_r of the run and process noise s_rk. With D_r = sum_k d_rk and a^_r = sum_k e_rk /
D_r, the two variances are estimated by equating squares within and between runs to their
expectations:

    sum_rk (e_rk - a^_r d_rk)^2 = v_process sum_r (D_r - sum_k d_rk^2 / D_r)
    sum_r (sum_k e_rk)^2        = v_run sum_r D_r^2 + v_process sum_r D_r

Squares are summed before they are divided by distances: otherwise windows with little motion, in
which the noise of the poses would be divided by a small distance, would dominate.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from slipid.data.runs import Runs
from slipid.data.windows import Windows
from slipid.fitting.noise import travel
from slipid.fitting.problem import Problem
from slipid.fitting.shared_effects import AXES
from slipid.fitting.variances import Search, Square
from slipid.model.robot import Robot
from slipid.predict import open_loop as replay
from slipid.predict.kinematics import fourier
from slipid.predict.predictive import PredictiveModel
from slipid.predict.score import chords, mean_error
from slipid.predict.slip_model import body_twist, setups, turned
from slipid.search_space import Space

WORSE_RATIO = 1.5
"""Largest accepted factor by which a floor's mean end-point error grows when runs over several
floors are added to the fit.

A wrong map makes the error several times larger.
"""
LARGEST_SHIFT = 4.0
"""Largest accepted shift of a parameter, in its standard errors, when runs over several floors are
added to the runs on one floor each, unless held-out runs confirm it (`CONFIRMED_RATIO`)."""
CONFIRMED_RATIO = 0.8
"""Ratio of errors below which runs over several floors confirm what the fit has learnt from them.

The error of each half that the other half predicts has to be so much less than that without such
runs, and the error with the map so much less than those as if all wheels were on one floor: with a
mirrored map of the test site the former was 0.33, the latter 0.94 (with the right one 0.10, 0.36).

Runs on one floor each can leave several laws possible, whose parameters are many standard errors
apart. Runs over several floors then decide between these laws.
"""
ONE_FLOOR_RATIO = 0.8
"""Ratio of the error as if all wheels were on one floor to the error with the map, below which the
map is rejected."""
SURE_GROWTH = 3.0
"""Mean growth of errors, in units of its standard error, above which it is not taken for chance."""


@dataclass(frozen=True)
class FloorErrors:
    """End-point errors of the runs on one floor, divided by their straight-line displacements.

    Attributes:
        before: error of the fit to only the runs on one floor each.
        after: error of the fit that includes the runs over several floors.
        is_worse: True if the error grew by more than the factor `WORSE_RATIO`, and by more than
            chance (`SURE_GROWTH`).
    """

    before: float
    after: float
    is_worse: bool


def floor_errors(
    before: PredictiveModel, after: PredictiveModel, data: Runs
) -> dict[str, FloorErrors]:
    """Return the errors of runs on one floor each under two models, keyed by floor.

    Both models were fitted to these runs, the second one also to runs over several floors.
    """
    (old, distance), (new, _) = end_errors(before, data), end_errors(after, data)
    return compared(data.surface, old, new, distance)


def compared(
    floors: Sequence[str],
    old: Float[np.ndarray, " run"],
    new: Float[np.ndarray, " run"],
    distance: Float[np.ndarray, " run"],
) -> dict[str, FloorErrors]:
    """Return old and new errors, keyed by floor, from errors and displacements of each run [m]."""
    out = {}
    for name in dict.fromkeys(floors):
        mine = np.array([floor == name for floor in floors])
        grown = new[mine] - old[mine]
        _, error, _ = mean_error(grown, np.arange(len(grown)))
        much = new[mine].mean() > WORSE_RATIO * old[mine].mean()
        # The displacement is zero if all runs turn on the spot.
        total = max(float(distance[mine].sum()), 1e-9)
        out[name] = FloorErrors(
            float(old[mine].sum() / total),
            float(new[mine].sum() / total),
            bool(much and grown.mean() > SURE_GROWTH * error),
        )
    return out


def end_errors(
    model: PredictiveModel, data: Runs
) -> tuple[Float[np.ndarray, " run"], Float[np.ndarray, " run"]]:
    """Return the end-point error and the straight-line displacement of each run [m]."""
    error, distance = np.zeros(len(data)), np.zeros(len(data))
    for w in replay.replay_windows(data, model.robot):
        tracks, _ = model.ends(w)
        error[tracks.run] = np.linalg.norm(tracks.gap[:, :2], axis=1)
        distance[tracks.run] = chords(tracks.measured)
    return error, distance


def largest_shift(
    space: Space, before: Search, covariance: Square, after: Search, settled: bool
) -> tuple[str, float]:
    """Return the motion parameter that shifted most, and its shift in standard errors.

    Standard errors are those before the shift, from `covariance`.

    Parameters of the camera are excluded. The shift is infinite if the fit with the added runs did
    not settle. If the added runs agree with the model, they change a parameter by less than the
    standard error that it had before (Hausman 1978, Econometrica 46(6)).
    """
    known = ~space.electric & ~space.where(lambda e: e.part == "camera")
    sigma = np.where(known, np.abs(after - before) / np.sqrt(np.diag(covariance)), 0.0)
    worst = int(np.argmax(sigma))
    return space.names[worst], float(sigma[worst]) if settled else np.inf


def contradiction(
    found: Mapping[str, FloorErrors],
    shift: tuple[str, float],
    by_map: float,
    as_if: Mapping[str, float],
    held_out: float | None,
) -> str | None:
    """Return the reason to reject runs over several floors, None if they agree with all other runs.

    Args:
        found: errors of the runs on one floor each, keyed by floor.
        shift: fitted parameter that changed most, and its change in standard errors.
        by_map: error of the runs over several floors [m/s], with the wheels' floors from the map.
        as_if: error of the same runs as if all wheels always stood on one floor, keyed by that
            floor [m/s].
        held_out: error of each half of these runs, predicted by a fit that learnt from the other
            half, divided by that of the fit without such runs; None if it is not known.
    """
    worse = ", ".join(
        f"{floor} grow from {100 * e.before:.1f} to {100 * e.after:.1f} % of the displacement"
        for floor, e in found.items()
        if e.is_worse
    )
    name, sigma = shift
    best = min(as_if, key=lambda floor: as_if[floor])
    of_map = by_map < CONFIRMED_RATIO * as_if[best]
    confirmed = of_map and held_out is not None and held_out < CONFIRMED_RATIO
    if worse:
        reason = f"end-point errors on {worse}"
    elif not np.isfinite(sigma):
        reason = "the fit to all runs did not converge"
    elif sigma > LARGEST_SHIFT and not confirmed:
        reason = f"{name} changes by {sigma:.0f} standard errors"
    elif as_if[best] < ONE_FLOOR_RATIO * by_map:
        errors = f"{1000 * by_map:.1f} mm/s with their map, but {1000 * as_if[best]:.1f} mm/s"
        reason = f"errors are {errors} as if all wheels were on {best}"
    else:
        return None
    return (
        "the runs over several floors were not used, since they contradict the runs on one floor "
        f"({reason}); the map may be wrong or misplaced, or the contact law is wrong where wheels "
        "stand on different floors"
    )


_RIDGE = 1e-6
"""Ridge relative to the sum of squares of each feature, for floors with too few runs."""


def scatter(problem: Problem) -> Float[np.ndarray, " variance"]:
    """Return the log variance of every noise component.

    The variances of process noise and of run effects are those of the scatter, but at least the
    typical ones; all others are typical variances. All motion that smooth functions of the wheels'
    motion do not explain counts as noise. On a floor with few runs the scatter is large, as its
    runs do not predict each other well.
    """
    w, robot = problem.windows, problem.robot
    distance, _ = travel(w, robot)
    left = _unpredicted_motion(w, robot, "camera.marker_place" in problem.space.slices)
    variance = dict(zip(problem.noise.names, problem.noise.typical**2, strict=True))
    for floor in dict.fromkeys(w.surface):
        mine = np.asarray(w.surface) == floor
        e, d, whole = left[mine], distance[mine], distance[mine].sum(axis=1)
        total, most = e.sum(axis=1), np.maximum(whole, 1e-9)
        level = total / most[:, None]
        within = ((e - level[:, None] * d[..., None]) ** 2).sum(axis=(0, 1))
        process = within / max(float((whole - (d**2).sum(axis=1) / most).sum()), 1e-9)
        run = ((total**2).sum(axis=0) - process * whole.sum()) / max(float((whole**2).sum()), 1e-9)
        for k, axis in enumerate(AXES):
            for kind, found in (("process", process), ("run", run)):
                name = f"{kind}.{floor}.{axis}"
                variance[name] = max(variance[name], float(found[k]))
    return np.log(list(variance.values()))


def _unpredicted_motion(
    w: Windows, robot: Robot, place_is_free: bool
) -> Float[np.ndarray, "segment window 3"]:
    """Return the motion along, across and in yaw that other runs do not predict [m, m, rad].

    If `place_is_free`, the position of the marker on the body is regressed, too.
    """
    shape = robot.geometry
    back = np.asarray(shape.pseudo_inverse()).T * float(shape.wheel_radius)
    step, late = w.turn @ back, w.speed_change @ back
    moved = body_twist(w, robot) * w.dt[..., None]
    angle, series = np.arctan2(step[..., 1], step[..., 0]), fourier(step)
    for vector in (step, late, moved):
        vector[..., :2] = turned(-angle, vector[..., :2])
    turns = step[..., 2:]
    swept = [turns * np.stack([np.cos(angle), np.sin(angle)], -1)] if place_is_free else []
    x = np.concatenate([series, turns, late, *swept], axis=-1)
    gap = moved - step
    out = np.empty_like(gap)
    group = np.array(setups(w))
    for name in np.unique(group):
        mine = np.flatnonzero(group == name)
        square = np.einsum("pki,pkj->pij", x[mine], x[mine])
        product = np.einsum("pki,pka->pia", x[mine], gap[mine])
        ridge = _RIDGE * np.diag(np.diagonal(square.sum(axis=0)) + 1e-12)
        for run in np.unique(w.run[mine]):
            others = w.run[mine] != run
            solved = np.linalg.solve(
                square[others].sum(axis=0) + ridge, product[others].sum(axis=0)
            )
            of_run = mine[~others]
            out[of_run] = gap[of_run] - x[of_run] @ solved
    return out
