"""Expected Fisher information of planned runs, from simulation with the fitted robot."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag

from slipid.data.windows import Windows
from slipid.fitting import likelihood as lk
from slipid.fitting.noise import effects
from slipid.fitting.problem import Problem
from slipid.fitting.session_effects import by_axis
from slipid.fitting.shared_effects import AXES
from slipid.fitting.variances import whitened
from slipid.infer.design.fisher import Information, RunJacobians, information_of
from slipid.infer.design.planned_runs import SESSION, PlannedRun, Setup, steady_windows
from slipid.infer.result import Channels, Fit
from slipid.model.robot import Robot
from slipid.parameter import entries
from slipid.predict.open_loop import end_jacobian
from slipid.search_space import Choice

_RUNS_PER_CALL = 256
"""Number of runs whose Jacobians are computed in one call."""


class Planner:
    """Simulation of planned runs and their Fisher information, for a fit's robot and variances.

    Planned runs belong to a new session. On floors where sessions differ, the effects of the new
    session along, across and in yaw are further unknowns: a vector of unknowns is the search
    vector, followed by these effects in units of their std.
    """

    def __init__(
        self,
        robot: Robot,
        choices: Sequence[Choice],
        variance: Mapping[str, float],
        channels: Channels,
    ):
        camera = robot.camera
        if camera.sessions:
            camera = replace(camera, sessions=(SESSION,), session_yaw=jnp.zeros(1))
        self.robot = replace(robot, camera=camera)
        self.channels = channels
        self.variance = dict(variance)
        paths = [e.path for e in entries(self.robot)]
        choices = [c for c in choices if any(fnmatchcase(p, c.pattern) for p in paths)]
        first = PlannedRun(robot.surfaces.labels[0], robot.body.loads[0], 0.0, 0.1)
        self._problem = Problem(
            self._windows([first] * _RUNS_PER_CALL), self.robot, choices
        ).without_shared_effects()
        self.space = self._problem.space
        self.z = self.space.vector(self.robot)
        electric = self._problem.space.electric & (not self._problem.objective.joint)
        of_floor = [[f"session.{x}.{a}" for a in AXES] for x in robot.surfaces.labels]
        self._differ = np.array([any(map(self.variance.get, names)) for names in of_floor])
        self.effects = len(AXES) * int(self._differ.sum())
        self.is_electric = np.concatenate([electric, np.zeros(self.effects, bool)])
        # The planned runs have no shared effects: the variance of neighbours' effects is added to
        # that of each run's individual effect.
        own = {f"run.{x}.{a}": f"neighbours.{x}.{a}" for x in robot.surfaces.labels for a in AXES}
        self._log_v = np.log(
            [
                self.variance[name] + self.variance.get(own.get(name, ""), 0.0)
                for name in self._problem.noise.names
            ]
        )

    @classmethod
    def of(cls, fit: Fit) -> "Planner":
        return cls(fit.robot, fit.choices, fit.variance, fit.channels)

    def _windows(self, runs: Sequence[PlannedRun], session: str = SESSION) -> Windows:
        return steady_windows(runs, self.robot, self.channels, session)

    def nothing(self) -> Information:
        """Return the information of priors only; marker yaws of single sessions count as known."""
        single = self.space.where(lambda e: e.session is not None)
        std = np.where(single, 1e-6, self.space.prior_std)
        return self._known(np.diag(std**2))

    def after(self, fit: Fit) -> Information:
        """Return the information after a fit.

        The marker yaws of the fit's sessions are marginalised, as planned runs have a new session.
        """
        place = {name: k for k, name in enumerate(fit.space.names)}
        mine = [k for k, name in enumerate(self.space.names) if name in place]
        theirs = [place[self.space.names[k]] for k in mine]
        covariance = np.diag(self.space.prior_std**2)
        covariance[np.ix_(mine, mine)] = fit.covariance[np.ix_(theirs, theirs)]
        return self._known(covariance)

    def _known(self, covariance: Float[np.ndarray, "free free"]) -> Information:
        return information_of(block_diag(covariance, np.eye(self.effects)), self.is_electric)

    def rows(self, runs: Sequence[PlannedRun]) -> RunJacobians:
        """Return the whitened Jacobians of every run."""
        starts = range(0, len(runs), _RUNS_PER_CALL)
        first, *others = (self._rows(runs[k : k + _RUNS_PER_CALL]) for k in starts)
        return first.joined(*others)

    def _rows(self, runs: Sequence[PlannedRun]) -> RunJacobians:
        # The runs are padded to a fixed number, so that the Jacobian is compiled only once.
        filled = [*runs, *[runs[-1]] * (_RUNS_PER_CALL - len(runs))]
        windows = self._windows(filled)
        this = self._problem.of(windows)
        _, jacobian = this.linear(self.z, this.electric(self.z, self._log_v))
        std = np.sqrt(by_axis(self.variance, "session", windows))
        effect = effects(windows, self.robot) * std[:, None]
        on = np.eye(len(self._differ))[np.asarray(this.batch.surface)][:, self._differ]
        moved = (effect[:, :, None, :] * on[:, None, :, None]).reshape(*effect.shape[:2], -1)
        # Session effects change the motion only: for currents and voltages their columns are zero.
        wider = ((0, 0), (0, 0), (0, self.effects))
        of_motion = jnp.concatenate([jacobian["motion"], -moved], axis=2)
        jacobian = {k: jnp.pad(j, wider) for k, j in jacobian.items()} | {"motion": of_motion}
        halves = whitened(this.noise.blocks, jacobian, self._log_v, np.ones(_RUNS_PER_CALL))
        motion = np.asarray(halves.pop("motion"))[: len(runs)]
        others = [np.asarray(h)[: len(runs)] for h in halves.values()]
        electric = np.concatenate([motion[:, :0], *others], axis=1)
        return RunJacobians(
            motion[..., ~self.is_electric],
            electric[..., self.is_electric],
            electric[..., ~self.is_electric],
        )

    def ends(self, runs: Sequence[PlannedRun]) -> Float[np.ndarray, "run 2 number"]:
        """Return the derivative of each run's end point with respect to the unknowns, per metre.

        The derivative is divided by the distance of the run. Effects and marker yaws of single
        sessions are not part of a prediction.
        """
        b = lk.batch(self._windows(runs, session=""), self.robot)
        jacobian = np.array(end_jacobian(self.space, self.z, b, np.zeros((len(runs), 3))))
        jacobian /= np.array([d.distance for d in runs])[:, None, None]
        return np.pad(jacobian, ((0, 0), (0, 0), (0, self.effects)))


@dataclass(frozen=True, eq=False)
class Goal:
    """A quantity whose std, sqrt(tr(G cov G^T)), is to be reduced by the proposed runs.

    Attributes:
        name: name of the parameter or prediction.
        unit: unit of the std.
        rows: the matrix G that maps changes of the unknowns to changes of the quantity.
        floors: floors on which runs inform directly about the goal; empty if any floor does.
        loads: load set-ups with which runs inform directly about the goal; empty if any does.
    """

    name: str
    unit: str
    rows: Float[np.ndarray, "k free"]
    floors: frozenset[str] = frozenset()
    loads: frozenset[str] = frozenset()

    def is_about(self, setup: Setup) -> bool:
        """Return True if runs with this floor and load set-up inform directly about the goal."""
        floor, load = setup
        return floor in (self.floors or {floor}) and load in (self.loads or {load})

    def std(self, information: Information) -> float:
        """Return the std of the goal's quantity, given the information about all parameters."""
        return float(np.sqrt(max(information.criterion(self.rows), 0.0)))


def parameter_goal(planner: Planner, path: str) -> Goal:
    """Return the goal to reduce a parameter's std, or the root mean square of a vector's stds."""
    entry = next(e for e in planner.space.free if e.path == path)
    at = planner.space.slices[path]
    rows = np.zeros((entry.size, len(planner.is_electric)))
    rows[:, at] = jax.jacfwd(entry.declaration.to_si)(jnp.asarray(planner.z[at]))
    return Goal(
        path,
        entry.declaration.unit,
        rows / np.sqrt(len(rows)),
        floors=frozenset([entry.surface] if entry.surface else []),
        loads=frozenset([entry.load] if entry.load else []),
    )


def prediction_goal(planner: Planner, name: str, runs: Sequence[PlannedRun]) -> Goal:
    """Return the goal to reduce the end-point errors of `runs` due to uncertain parameters.

    The goal's std is the root mean square of these errors, each divided by the run's distance.
    """
    rows = planner.ends(runs)
    return Goal(
        name,
        "m/m",
        _compact(rows.reshape(-1, rows.shape[-1])) / np.sqrt(len(runs)),
        floors=frozenset(d.surface for d in runs),
        loads=frozenset(d.load for d in runs),
    )


def weighed(goals: Sequence[Goal], now: Information, weight: Sequence[float]) -> np.ndarray:
    """Return the matrix G for which tr(G cov G^T) is the weighted mean of (std_g / s_g)^2.

    The mean is over the goals g; s_g is the std of goal g at the information `now`, so that the
    mean is 1 at present.
    """
    share = np.asarray(weight, float) / np.sum(weight)
    parts = [np.sqrt(w) / g.std(now) * g.rows for g, w in zip(goals, share, strict=True)]
    return _compact(np.concatenate(parts))


def _compact(rows: Float[np.ndarray, "k free"]) -> Float[np.ndarray, "few free"]:
    """Return a matrix with the same G^T G and at most as many rows as columns."""
    return np.asarray(np.linalg.qr(rows, mode="r")) if len(rows) > rows.shape[1] else rows
