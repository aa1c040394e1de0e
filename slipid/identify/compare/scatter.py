"""How far runs scatter, before any physics is fitted to them.

The motion of the body is regressed on what is smooth in that of the wheels, floor by floor and load
by load: a Fourier series in the direction of travel, yaw, whatever a lag of the camera moves, and
what turning moves in a marker whose place on the body is not known.
Every run is predicted by the others. What is left in window k of run r, over the distance d_rk, is

    e_rk = a_r d_rk + s_rk,   var a = v_run,   var s_rk = v_process d_rk

and the two variances follow from its squares within and between runs, which with D_r = sum_k d_rk
and a^_r = sum_k e_rk / D_r are expected to be

    sum_rk (e_rk - a^_r d_rk)^2 = v_process sum_r (D_r - sum_k d_rk^2 / D_r)
    sum_r (sum_k e_rk)^2        = v_run sum_r D_r^2 + v_process sum_r D_r

Squares are summed before anything is divided by a distance: where a robot stands or nearly so, the
poses' own noise over the little distance would count for all.
"""

import numpy as np
from jaxtyping import Float

from slipid.data.windows import Windows
from slipid.identify.compare.heading_lookup import fourier
from slipid.identify.compare.marker import body_twist, turned
from slipid.identify.fit.noise import travel
from slipid.identify.fit.problem import Problem
from slipid.identify.fit.shared import AXES
from slipid.model.robot import Robot

_TINY = 1e-6
"""Ridge, as part of a feature's own size: of runs too few to be predicted."""


def scatter(problem: Problem) -> Float[np.ndarray, " variance"]:
    """Log variance of every noise component: what is typical, or what runs scatter if that is more.

    To a model that is no better than smooth the rest is noise. A floor whose runs are too few to
    predict one from the others scatters much.
    """
    w, robot = problem.windows, problem.robot
    far, _ = travel(w, robot)
    left = _left(w, robot, "camera.marker_place" in problem.space.place)
    variance = dict(zip(problem.noise.names, problem.noise.typical**2, strict=True))
    for floor in dict.fromkeys(w.surface):
        mine = np.asarray(w.surface) == floor
        e, d, whole = left[mine], far[mine], far[mine].sum(axis=1)
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


def _left(w: Windows, robot: Robot, place_is_free: bool) -> Float[np.ndarray, "piece window 3"]:
    """Motion along, across and in yaw that other runs do not predict [m, m, rad]."""
    shape = robot.geometry
    back = np.asarray(shape.least()).T * float(shape.wheel_radius)
    step, late = w.turn @ back, w.faster @ back
    moved = body_twist(w, robot) * w.dt[..., None]
    angle, series = np.arctan2(step[..., 1], step[..., 0]), fourier(step)
    for vector in (step, late, moved):
        vector[..., :2] = turned(-angle, vector[..., :2])
    turns = step[..., 2:]
    swept = [turns * np.stack([np.cos(angle), np.sin(angle)], -1)] if place_is_free else []
    x = np.concatenate([series, turns, late, *swept], axis=-1)
    gap = moved - step
    out = np.empty_like(gap)
    group = np.array([f"{a}@{b}" for a, b in zip(w.surface, w.load, strict=True)])
    for name in np.unique(group):
        mine = np.flatnonzero(group == name)
        square = np.einsum("pki,pkj->pij", x[mine], x[mine])
        product = np.einsum("pki,pka->pia", x[mine], gap[mine])
        ridge = _TINY * np.diag(np.diagonal(square.sum(axis=0)) + 1e-12)
        for run in np.unique(w.run[mine]):
            others = w.run[mine] != run
            solved = np.linalg.solve(
                square[others].sum(axis=0) + ridge, product[others].sum(axis=0)
            )
            of_run = mine[~others]
            out[of_run] = gap[of_run] - x[of_run] @ solved
    return out
