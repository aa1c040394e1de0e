"""Which runs to drive next: the fitted robot simulates them, Fisher information judges them.

What is assumed: noise as fitted, run effects marginalised (a run driven twice is worth its share, a
long one does not count as many); all new runs are of one session and share what runs of a session
share; everything linear around the fitted numbers; steady wheel speeds, so nothing is learnt from
starting and stopping; the marker is put on once more for the new runs.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag

from slipid.data.windows import Windows
from slipid.identify.compare.open_loop import end_jacobian
from slipid.identify.design.fisher import Knowledge, Rows, known
from slipid.identify.design.planned_runs import SESSION, Drive, Setup, steady_windows
from slipid.identify.fit import likelihood as lk
from slipid.identify.fit.noise import effects
from slipid.identify.fit.problem import Problem
from slipid.identify.fit.sessions import AXES, by_axis
from slipid.identify.result import Fit
from slipid.model.robot import Robot
from slipid.parameter import entries
from slipid.search_space import Choice

_TOGETHER = 256
"""Runs whose Jacobians are taken in one call."""


@dataclass(frozen=True)
class Channels:
    """What new runs would log, and how it is cut.

    Attributes:
        current, voltage: logged or not; signed: the current has a sign.
        windows: per run.
    """

    current: bool = True
    voltage: bool = False
    signed: bool = False
    windows: int = 4


class Planner:
    """What runs that were not driven yet would tell of a robot.

    Args:
        robot: as fitted; its sessions are over, new runs have one of their own.
        choices: free, fixed, priors, as fitted.
        variance: of every noise component by name, and of what runs of a session share.
        channels: as fitted.

    Its vectors hold the numbers of the search space and then, in stds of what they share along,
    across and in yaw, the effects of the new session on floors where sessions are known to differ.
    """

    def __init__(
        self,
        robot: Robot,
        choices: Sequence[Choice],
        variance: Mapping[str, float],
        channels: Channels | None = None,
    ):
        self.robot = _in_new_session(robot)
        self.channels = channels or Channels()
        self.variance = dict(variance)
        paths = [e.path for e in entries(self.robot)]
        choices = [c for c in choices if any(fnmatchcase(p, c.pattern) for p in paths)]
        first = Drive(robot.surfaces.labels[0], robot.body.loads[0], 0.0, 0.1)
        self._problem = Problem(self._windows([first] * _TOGETHER), self.robot, choices)
        self.space = self._problem.space
        self.z = self.space.vector(self.robot)
        joint = self._problem.joint
        electric = np.zeros(self.space.size, bool) if joint else self._problem.electric
        labels = self.robot.surfaces.labels
        self._differ = np.array(
            [any(self.variance.get(f"session.{x}.{a}") for a in AXES) for x in labels]
        )
        self.effects = len(AXES) * int(self._differ.sum())
        self.is_electric = np.concatenate([electric, np.zeros(self.effects, bool)])
        self._log_v = np.log([self.variance[name] for name in self._problem.noise.names])

    @classmethod
    def of(cls, fit: Fit) -> "Planner":
        """Planner of a fit."""
        channels = Channels(
            current=fit.has["current"],
            voltage=fit.has["voltage"],
            signed=bool(fit.settings.get("current_is_signed", False)),
            windows=int(fit.settings["windows_per_piece"]),
        )
        return cls(fit.robot, fit.choices, fit.variance, channels)

    def _windows(self, drives: Sequence[Drive], session: str = SESSION) -> Windows:
        c = self.channels
        spread = {
            floor: self.variance.get(f"current.{floor}.window", 0.0)
            for floor in self.robot.surfaces.labels
        }
        return steady_windows(
            drives, self.robot, c.windows, spread, session, c.current, c.voltage, c.signed
        )

    def nothing(self) -> Knowledge:
        """Before any run: the prior; of a single session the marker's yaw is the common one."""
        single = self.space.where(lambda e: e.session is not None)
        std = np.where(single, 1e-6, self.space.prior_std)
        return self._known(np.diag(std**2))

    def after(self, fit: Fit) -> Knowledge:
        """After a fit; what it learnt of its own sessions' marker is of no more use."""
        place = {name: k for k, name in enumerate(fit.space.names)}
        mine = [k for k, name in enumerate(self.space.names) if name in place]
        theirs = [place[self.space.names[k]] for k in mine]
        covariance = np.diag(self.space.prior_std**2)
        covariance[np.ix_(mine, mine)] = fit.covariance[np.ix_(theirs, theirs)]
        return self._known(covariance)

    def _known(self, covariance: Float[np.ndarray, "free free"]) -> Knowledge:
        return known(block_diag(covariance, np.eye(self.effects)), self.is_electric)

    def rows(self, drives: Sequence[Drive]) -> Rows:
        """What each run would tell."""
        first, *others = (
            self._rows(drives[k : k + _TOGETHER]) for k in range(0, len(drives), _TOGETHER)
        )
        return first.joined(*others)

    def _rows(self, drives: Sequence[Drive]) -> Rows:
        # always as many at once, so that one compiled function serves
        filled = [*drives, *[drives[-1]] * (_TOGETHER - len(drives))]
        windows = self._windows(filled)
        this = self._problem.of(windows)
        _, jacobian = this.linear(jnp.asarray(self.z), this.volt(self._log_v))
        std = np.sqrt(by_axis(self.variance, "session", windows))
        felt = effects(windows, self.robot) * std[:, None]
        on = np.eye(len(self._differ))[np.asarray(this.batch.surface)][:, self._differ]
        moved = (felt[:, :, None, :] * on[:, None, :, None]).reshape(*felt.shape[:2], -1)
        nothing = {k: np.zeros((*j.shape[:2], self.effects)) for k, j in jacobian.items()}
        of_session = nothing | {"motion": -moved}
        jacobian = {k: jnp.concatenate([j, of_session[k]], axis=2) for k, j in jacobian.items()}
        halves = {
            k: np.asarray(h)[: len(drives)] for k, h in this.whitened(jacobian, self._log_v).items()
        }
        motion = halves["motion"]
        others = [h for k, h in halves.items() if k != "motion"]
        if this.joint:
            motion, others = np.concatenate([motion, *others], axis=1), []
        electric = np.concatenate([motion[:, :0], *others], axis=1)
        return Rows(
            motion[..., ~self.is_electric],
            electric[..., self.is_electric],
            electric[..., ~self.is_electric],
        )

    def ends(self, drives: Sequence[Drive]) -> Float[np.ndarray, "run 2 number"]:
        """Derivative of each run's end point, over its distance, by the numbers.

        What is of one session, the marker's deviation too, is no part of a prediction.
        """
        b = lk.batch(self._windows(drives, session=""), self.robot)
        start = jnp.zeros((len(drives), 3))
        jacobian = np.array(end_jacobian(self.space, jnp.asarray(self.z), b, start))[:, :2]
        jacobian /= np.array([d.distance for d in drives])[:, None, None]
        return np.pad(jacobian, ((0, 0), (0, 0), (0, self.effects)))

    def derivative(self, path: str) -> Float[np.ndarray, "entry number"]:
        """Derivative of a free parameter's entries [SI] by the numbers."""
        entry = next(e for e in self.space.free if e.path == path)
        at = self.space.place[path]
        out = np.zeros((entry.size, len(self.is_electric)))
        out[:, at] = jax.jacfwd(entry.declaration.to_si)(jnp.asarray(self.z[at]))
        return out


def _in_new_session(robot: Robot) -> Robot:
    camera = robot.camera
    if camera.sessions:
        camera = replace(camera, sessions=(SESSION,), session_yaw=jnp.zeros(1))
    return replace(robot, camera=camera)


@dataclass(frozen=True, eq=False)
class Goal:
    """A number whose uncertainty is to shrink: sqrt(tr(G cov G^T)).

    Attributes:
        name: for tables and files.
        unit: of the number.
        rows: G (k, free).
        floors, loads: it is about; empty for any.
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

    def std(self, knowledge: Knowledge) -> float:
        """What is uncertain about it."""
        return float(np.sqrt(max(knowledge.criterion(self.rows), 0.0)))


def parameter_goal(planner: Planner, path: str) -> Goal:
    """Std of a parameter [its unit], of a short vector the root mean square of its entries."""
    entry = next(e for e in planner.space.free if e.path == path)
    rows = planner.derivative(path)
    return Goal(
        path,
        entry.declaration.unit,
        rows / np.sqrt(len(rows)),
        floors=frozenset([entry.surface] if entry.surface else []),
        loads=frozenset([entry.load] if entry.load else []),
    )


def prediction_goal(planner: Planner, name: str, drives: Sequence[Drive]) -> Goal:
    """Root mean square end-point error of runs that comes from the parameters, over distance."""
    rows = planner.ends(drives)
    return Goal(
        name,
        "m/m",
        _compact(rows.reshape(-1, rows.shape[-1])) / np.sqrt(len(drives)),
        floors=frozenset(d.surface for d in drives),
        loads=frozenset(d.load for d in drives),
    )


def weighed(goals: Sequence[Goal], now: Knowledge, weight: Sequence[float]) -> np.ndarray:
    """G of the criterion sum_g weight_g (std_g / std_g now)^2, which is 1 now."""
    share = np.asarray(weight, float) / np.sum(weight)
    parts = [np.sqrt(w) / g.std(now) * g.rows for g, w in zip(goals, share, strict=True)]
    return _compact(np.concatenate(parts))


def _compact(rows: Float[np.ndarray, "k free"]) -> Float[np.ndarray, "few free"]:
    """Few rows with the same G^T G."""
    return np.asarray(np.linalg.qr(rows, mode="r")) if len(rows) > rows.shape[1] else rows
