"""Where a fit begins: motors by regression, every floor by itself from several starts."""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np

from slipid.identify.problem import DEGREES, Problem, State

CREEPS = (0.05, 0.4, 1.0)
"""Starts of the creep of every floor; others end in poor minima."""


def staged_start(problem: Problem, keep: np.ndarray, tell: Callable[[State], None]) -> State:
    """Motor by regression, then every floor by itself from several starts, best start per floor.

    Floors share nothing while the shared numbers are held, so one masked fit of all floors is a fit
    of each by itself.
    """
    names = problem.space.names
    floor_of = [n.split(".")[1] if n.startswith("surface.") else "" for n in names]
    mask = np.array([float(f != "") for f in floor_of])
    labels = problem.robot.surfaces.labels
    log_v = 2 * np.log(problem.noise.typical)
    for k, name in enumerate(problem.noise.names):  # far from the optimum every run is an outlier
        if not name.startswith("camera"):
            log_v[k] += 2 * np.log(3.0)
    first = _motor_start(problem)
    best: dict[str, tuple[float, np.ndarray]] = {}
    floors = np.asarray(problem.batch.surface)
    for attempt, creep in enumerate(CREEPS):
        z = first.copy()
        for k, name in enumerate(names):
            if name.endswith(".creep") and floor_of[k]:
                z[k] = np.log(creep)
        state = State(
            z, log_v, 0, np.inf, np.inf, f"floor by floor, start {attempt + 1} of {len(CREEPS)}"
        )
        for steps in (15, 6, 6):  # the damping has to grow from 1 to the size of the problem first
            state = problem.round(state, keep, mask, steps=steps, scoring=0)
            tell(state)
        cost = _piece_cost(problem, state)
        for number, label in enumerate(labels):
            mine = float(np.sum(cost[(floors == number) & (keep > 0)]))
            if label not in best or mine < best[label][0]:
                best[label] = (mine, state.z)
    z = first.copy()
    for k, f in enumerate(floor_of):
        if f:
            z[k] = best[f][1][k]
    return State(z, log_v, 0, np.inf, np.inf, "joint")


def _piece_cost(problem: Problem, state: State) -> np.ndarray:
    blocks, _ = problem.linear(jnp.asarray(state.z), problem.volt(state.log_variance))
    v = np.asarray(problem.covariance("motion", jnp.asarray(state.log_variance)))
    r = np.asarray(blocks["motion"])
    q = np.einsum("ni,ni->n", r, np.linalg.solve(v, r[..., None])[..., 0])
    return 0.5 * (DEGREES + r.shape[1]) * np.log1p(q / DEGREES)


def _motor_start(problem: Problem) -> np.ndarray:
    """Search vector with R and C_e by regression of the voltage where it is logged."""
    z = problem.space.start.copy()
    w = problem.windows
    if not (w.has_voltage and w.has_current):
        return z
    speed = (w.turn / w.dt[..., None]).ravel()
    amps = w.current.ravel() if w.current_is_signed else (w.current.ravel() * np.sign(speed))
    wm = speed * problem.robot.motor.gear_ratio
    a, *_ = np.linalg.lstsq(np.stack([amps, wm], -1), w.voltage.ravel(), rcond=None)
    for path, value in (("motor.resistance", a[0]), ("motor.back_emf", a[1])):
        if path in problem.space.place and value > 0:
            z[problem.space.place[path]] = np.log(value)
    return z
