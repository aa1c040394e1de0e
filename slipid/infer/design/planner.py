"""Which runs to drive next: the fitted robot simulates them, Fisher information judges them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag

from slipid.data.windows import Windows
from slipid.fit import likelihood as lk
from slipid.fit.noise import effects
from slipid.fit.problem import Problem
from slipid.fit.session_effects import by_axis
from slipid.fit.shared_effects import AXES
from slipid.fit.variances import whitened
from slipid.infer.design.fisher import Information, RunJacobians, information_of
from slipid.infer.design.planned_runs import SESSION, PlannedRun, Setup, steady_windows
from slipid.infer.result import Channels, Fit
from slipid.model.robot import Robot
from slipid.parameter import entries
from slipid.predict.open_loop import end_jacobian
from slipid.search_space import Choice

_TOGETHER = 256
"""Runs whose Jacobians are taken in one call."""


class Planner:
    """What runs that were not driven yet would tell of a robot; choices and variances as fitted.

    The robot's sessions are over, new runs have one of their own. Vectors hold the numbers of the
    search space and then, in stds of what they share along, across and in yaw, the effects of the
    new session on floors where sessions are known to differ.
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
            self._windows([first] * _TOGETHER), self.robot, choices
        ).without_shared_effects()
        self.space = self._problem.space
        self.z = self.space.vector(self.robot)
        electric = self._problem.space.electric & (not self._problem.objective.joint)
        of_floor = [[f"session.{x}.{a}" for a in AXES] for x in robot.surfaces.labels]
        self._differ = np.array([any(map(self.variance.get, names)) for names in of_floor])
        self.effects = len(AXES) * int(self._differ.sum())
        self.is_electric = np.concatenate([electric, np.zeros(self.effects, bool)])
        # what a run shares with its neighbours counts as its own
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

    def _windows(self, drives: Sequence[PlannedRun], session: str = SESSION) -> Windows:
        return steady_windows(drives, self.robot, self.channels, session)

    def nothing(self) -> Information:
        """Before any run: the prior; of a single session the marker's yaw is the common one."""
        single = self.space.where(lambda e: e.session is not None)
        std = np.where(single, 1e-6, self.space.prior_std)
        return self._known(np.diag(std**2))

    def after(self, fit: Fit) -> Information:
        """After a fit; what it learnt of its own sessions' marker is of no more use."""
        place = {name: k for k, name in enumerate(fit.space.names)}
        mine = [k for k, name in enumerate(self.space.names) if name in place]
        theirs = [place[self.space.names[k]] for k in mine]
        covariance = np.diag(self.space.prior_std**2)
        covariance[np.ix_(mine, mine)] = fit.covariance[np.ix_(theirs, theirs)]
        return self._known(covariance)

    def _known(self, covariance: Float[np.ndarray, "free free"]) -> Information:
        return information_of(block_diag(covariance, np.eye(self.effects)), self.is_electric)

    def rows(self, drives: Sequence[PlannedRun]) -> RunJacobians:
        """What each run would tell."""
        starts = range(0, len(drives), _TOGETHER)
        first, *others = (self._rows(drives[k : k + _TOGETHER]) for k in starts)
        return first.joined(*others)

    def _rows(self, drives: Sequence[PlannedRun]) -> RunJacobians:
        # always as many at once, so that one compiled function serves
        filled = [*drives, *[drives[-1]] * (_TOGETHER - len(drives))]
        windows = self._windows(filled)
        this = self._problem.of(windows)
        _, jacobian = this.linear(self.z, this.electric(self.z, self._log_v))
        std = np.sqrt(by_axis(self.variance, "session", windows))
        felt = effects(windows, self.robot) * std[:, None]
        on = np.eye(len(self._differ))[np.asarray(this.batch.surface)][:, self._differ]
        moved = (felt[:, :, None, :] * on[:, None, :, None]).reshape(*felt.shape[:2], -1)
        # only the motion knows of a session's effects
        wider = ((0, 0), (0, 0), (0, self.effects))
        of_motion = jnp.concatenate([jacobian["motion"], -moved], axis=2)
        jacobian = {k: jnp.pad(j, wider) for k, j in jacobian.items()} | {"motion": of_motion}
        halves = whitened(this.noise.blocks, jacobian, self._log_v, np.ones(_TOGETHER))
        motion = np.asarray(halves.pop("motion"))[: len(drives)]
        others = [np.asarray(h)[: len(drives)] for h in halves.values()]
        electric = np.concatenate([motion[:, :0], *others], axis=1)
        return RunJacobians(
            motion[..., ~self.is_electric],
            electric[..., self.is_electric],
            electric[..., ~self.is_electric],
        )

    def ends(self, drives: Sequence[PlannedRun]) -> Float[np.ndarray, "run 2 number"]:
        """Derivative of each run's end point, over its distance, by the numbers.

        What is of one session, the marker's deviation too, is no part of a prediction.
        """
        b = lk.batch(self._windows(drives, session=""), self.robot)
        jacobian = np.array(end_jacobian(self.space, self.z, b, np.zeros((len(drives), 3))))
        jacobian /= np.array([d.distance for d in drives])[:, None, None]
        return np.pad(jacobian, ((0, 0), (0, 0), (0, self.effects)))


@dataclass(frozen=True, eq=False)
class Goal:
    """A number whose uncertainty is to shrink: sqrt(tr(G cov G^T)).

    Rows are G; floors and loads those it is about, empty for any.
    """

    name: str
    unit: str
    rows: Float[np.ndarray, "k free"]
    floors: frozenset[str] = frozenset()
    loads: frozenset[str] = frozenset()

    def is_about(self, setup: Setup) -> bool:
        """Whether runs with this floor and load are the ordinary way to it."""
        floor, load = setup
        return floor in (self.floors or {floor}) and load in (self.loads or {load})

    def std(self, knowledge: Information) -> float:
        return float(np.sqrt(max(knowledge.criterion(self.rows), 0.0)))


def parameter_goal(planner: Planner, path: str) -> Goal:
    """Std of a parameter [its unit], of a short vector the root mean square of its entries."""
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


def prediction_goal(planner: Planner, name: str, drives: Sequence[PlannedRun]) -> Goal:
    """Root mean square end-point error of runs that comes from the parameters, over distance."""
    rows = planner.ends(drives)
    return Goal(
        name,
        "m/m",
        _compact(rows.reshape(-1, rows.shape[-1])) / np.sqrt(len(drives)),
        floors=frozenset(d.surface for d in drives),
        loads=frozenset(d.load for d in drives),
    )


def weighed(goals: Sequence[Goal], now: Information, weight: Sequence[float]) -> np.ndarray:
    """G of the criterion sum_g weight_g (std_g / std_g now)^2, which is 1 now."""
    share = np.asarray(weight, float) / np.sum(weight)
    parts = [np.sqrt(w) / g.std(now) * g.rows for g, w in zip(goals, share, strict=True)]
    return _compact(np.concatenate(parts))


def _compact(rows: Float[np.ndarray, "k free"]) -> Float[np.ndarray, "few free"]:
    """Few rows with the same G^T G."""
    return np.asarray(np.linalg.qr(rows, mode="r")) if len(rows) > rows.shape[1] else rows
