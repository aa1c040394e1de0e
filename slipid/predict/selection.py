"""Selection of a slip model for every floor by predictions of held-out runs.

The models stand in order of size: the lengths of the config (`nominal`), calibrated kinematics
(`calibrated`), and the force balance (`contact`). On each floor the simplest one is selected whose
mean error on held-out runs is within one standard error of the smallest; the standard error is that
of the difference, paired run by run and clustered by sectors of the direction of travel. The
config's lengths are selected only where the calibration does not contradict them: a few runs cannot
show by their errors what other paths would.

Runs are held out in folds: in sectors of the commanded direction if every floor was driven in at
least `LEAST_SECTORS` of them, else in groups of runs. The models without a fold follow from the
models of all runs by one Gauss-Newton step (`fitting.newton`, `fitting.calibration`). A floor with
a single run has no held-out run; its run is predicted by the models that were fitted to it.

The error of a run is the mean, over the whole run and its three halves from its beginning, quarter
and middle on, of the distance between predicted and measured end point over the path length. Every
part begins at its measured pose. Closed paths hide a wrong scale at their end, but not in parts.

Source: errors over parts of paths, Geiger et al. 2012, CVPR (KITTI); one-standard-error rule,
Breiman et al. 1984, Classification and Regression Trees; folds by one Newton step, Beirami et al.
2017, NeurIPS.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from slipid.data.runs import Runs
from slipid.data.wheel_signals import interpolate
from slipid.data.windows import incomplete_poses
from slipid.fitting.calibration.estimate import cross_calibrated, evenly, most_rounds
from slipid.fitting.calibration.result import Calibration
from slipid.fitting.newton import newton_step
from slipid.fitting.optimise import Optimum
from slipid.fitting.problem import Problem
from slipid.model.geometry import Geometry
from slipid.model.kinematics import nominal_base
from slipid.model.robot import Robot
from slipid.predict import open_loop as replay
from slipid.predict.folds import fold_keys, sectors
from slipid.predict.kinematics import Calibrated, nominal
from slipid.predict.predictive import force_balance_of
from slipid.predict.score import clusters, mean_error
from slipid.predict.slip_model import RobotSpec, RunSignals, path_of, turned
from slipid.predict.slip_models import FloorModels
from slipid.predict.steps import Steps, TwistModel
from slipid.search_space import Choice, Space
from slipid.support.content import Content
from slipid.support.progress import Tell, silent

LEAST_SECTORS, MOST_GROUPS = 4, 6
"""Smallest number of sectors of each floor in which sectors are held out, and largest number of
groups of runs otherwise."""
MOST_RUNS = 48
"""Largest number of held-out runs that are predicted on a floor, picked evenly."""
CONTRADICTION = 2.6
"""Distance of a length of the config from the calibrated one that contradicts it [std]."""
OUTLIER_RATIO = 3.0
"""A run is suspected to be on another floor if its error exceeds the floor's median error, and the
error as if it were on the other floor, by more than this factor [1]."""
MODELS = ("nominal", "calibrated", "contact")
"""Slip models that may be selected, in order of size."""
Errors = Mapping[str, Float[np.ndarray, " run"]]
"""Errors over the path length of every predicted run, nan where there is none, keyed by model."""


@dataclass(frozen=True)
class FloorSelection:
    """Selection of a slip model on one floor.

    Attributes:
        model: the selected model.
        errors: mean error of held-out runs over their path length, keyed by model [1].
        behind: mean difference to the error of the best model that may be selected, and the
            standard error of this difference, keyed by model [1]; the latter is nan with fewer than
            two clusters.
        runs: number of predicted runs.
        held_out: True if the runs were predicted by models that were not fitted to them.
    """

    model: str
    errors: Mapping[str, float]
    behind: Mapping[str, tuple[float, float]]
    runs: int
    held_out: bool

    @property
    def sentence(self) -> str:
        """The selected model and its error on held-out runs, beside that of the config."""
        which = "held-out" if self.held_out else "fitted"
        text = f"{self.model}: {100 * self.errors[self.model]:.2f} % of the path, {which} runs"
        if self.model == "nominal" or "nominal" not in self.errors:
            return text
        return f"{text} (config's lengths {100 * self.errors['nominal']:.2f} %)"

    def to_json(self) -> Content:
        return asdict(self)

    @classmethod
    def of_json(cls, content: Content) -> "FloorSelection":
        behind = {name: (mean, se) for name, (mean, se) in content["behind"].items()}
        return cls(**{**content, "behind": behind})


def selection_folds(data: Runs) -> Int[np.ndarray, " run"]:
    """Return the fold in which each run is held out, -1 for the only run of a floor."""
    floor = np.array(data.surface)
    fold = sectors(fold_keys(data))
    many = all(len(set(fold[floor == f].tolist()) - {-1}) >= LEAST_SECTORS for f in set(floor))
    if not many or (fold < 0).any():
        for f in set(floor.tolist()):
            mine = np.flatnonzero(floor == f)
            fold[mine] = np.arange(len(mine)) % min(MOST_GROUPS, len(mine))
    for f in set(floor.tolist()):
        mine = floor == f
        if len(set(fold[mine].tolist())) < 2:
            fold[mine] = -1
    return fold


def calibrated_model(calibration: Calibration, shape: Geometry) -> FloorModels:
    """Return calibrated kinematics as a slip model; `shape` has the lengths of the config."""
    model = Calibrated(shape=shape)
    numbers = {floor: calibration.numbers(floor) for floor in calibration.radius}
    return FloorModels(model).with_state(numbers)


@dataclass(frozen=True, eq=False)
class KinematicFit:
    """Calibrated kinematics of runs, and how kinematic models predict held-out runs.

    Attributes:
        calibration: calibration from all runs.
        errors: errors of the kinematic models on held-out runs.
        suspects: sentences about runs that probably have a wrong floor label.
    """

    calibration: Calibration
    errors: Errors
    suspects: tuple[str, ...]

    @property
    def contradicted(self) -> frozenset[str]:
        """Floors on which the calibration contradicts a length of the config."""
        c = self.calibration
        return frozenset(
            floor
            for floor in c.radius
            for value, given in (
                *((radius, c.nominal_radius) for radius in c.radius[floor]),
                (c.base[floor], c.nominal_base),
            )
            if abs(value.value - given) > CONTRADICTION * value.std
        )


def kinematic_fit(
    data: Runs, space: Space, choices: Sequence[Choice], tell: Tell = silent
) -> KinematicFit:
    """Return the calibration of runs, and errors of `nominal` and `calibrated` on held-out runs.

    Arguments are those of `slipid.fitting.calibration.estimate.cross_calibrated`.
    """
    fold, robot = selection_folds(data), space.template
    picked, rounds = _picked(data, fold), most_rounds(data)
    total = rounds + len(picked)
    whole, without = cross_calibrated(data, space, choices, fold, lambda k, _: tell(k, total))
    floors = list(whole.radius)
    names = [*MODELS[:2], *floors]
    errors = {name: np.full(len(data), np.nan) for name in names}
    plain = FloorModels(nominal(robot.geometry))
    for count, (k, runs) in enumerate(picked.items()):
        tell(rounds + count, total)
        calibration = without.get(k, whole)
        seen, own = calibration.seen(robot), calibrated_model(calibration, robot.geometry)
        whole_poses = np.array([incomplete_poses(data, run) is None for run in runs.tolist()])
        for run in runs[~whole_poses].tolist():
            fitted = own.fitted[data.surface[run]]
            for name, twists in (("nominal", plain.model), ("calibrated", fitted)):
                if (path := aligned_path(data, run, twists, seen)) is not None:
                    errors[name][run] = path.error
        runs = runs[whole_poses]
        for w in replay.replay_windows(data.subset(runs), seen) if len(runs) else ():
            cases = {"nominal": (plain, w), "calibrated": (own, w)}
            if len(floors) > 1:
                cases |= {f: (own, replace(w, surface=(f,) * len(w))) for f in floors}
            for name, (model, at) in cases.items():
                tracks = replay.tracks_from_increments(seen, w, model.increments(at, seen))
                errors[name][runs[tracks.run]] = path_errors(tracks, w.parts)
    tell(total, total)
    kept = {name: errors[name] for name in MODELS[:2]}
    return KinematicFit(whole, kept, tuple(_mislabelled(data, errors, floors)))


PARTS_OF_GAP, LONGEST_PART_S = 4, 0.2
"""Least number and longest duration of the steps in which the motion between two poses is computed
for an aligned path."""


@dataclass(frozen=True, eq=False)
class AlignedPath:
    """Predicted path of the body in a run whose poses lack coordinates, moved to the measured ones.

    Attributes:
        time: time in the run of each pose, on the clock of the wheels [s].
        pose: x, y [m] and heading [rad].
        error: error over the path length [1].
    """

    time: Float[np.ndarray, " edge"]
    pose: Float[np.ndarray, "edge 3"]
    error: float


def aligned_path(data: Runs, run: int, model: TwistModel, seen: Robot) -> AlignedPath | None:
    """Return the predicted path of a run whose poses lack coordinates; None with fewer than two.

    Poses count that were measured while the wheels were logged, with the lag of the pose sensor.

    The start of such a run is not known. The whole predicted path of the pose sensor is therefore
    aligned with the measured positions, by a rotation and a translation (Procrustes), and the error
    is the root mean square of what remains. If the poses are those of the ends and the first one is
    whole, the path begins at it, and the error is that of the end. Headings alone are aligned by
    their mean, and an error of 1 rad counts as half the track or base.

    Args:
        data: the runs.
        run: index of the run.
        model: fitted slip model of the run's floor.
        seen: robot with the calibrated pose sensor.
    """
    rows, lag, spec = data.rows(run), float(seen.camera.lag), RobotSpec.of(seen)
    time, pose = data.time[rows], data.pose[rows]
    shown = data.fresh[rows] & np.isfinite(pose).any(axis=1)
    shown &= (time - lag >= time[0] - 1e-9) & (time - lag <= time[-1] + 1e-9)
    if shown.sum() < 2:
        return None
    pose, at = pose[shown], time[shown] - lag
    parts = np.maximum(PARTS_OF_GAP, np.ceil(np.diff(at) / LONGEST_PART_S)).astype(int)
    index = np.concatenate([[0], np.cumsum(parts)])
    edges = np.interp(np.arange(index[-1] + 1), index, at)
    turn = np.diff(interpolate(time, data.turned(run), edges), axis=0)
    signals = RunSignals(data.logs[run].name, np.diff(edges), turn)
    path = path_of(model.twist(Steps(signals, np.zeros(1, int)), spec), signals.dt)
    length = max(float(np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1).sum()), 1e-9)
    picked = path[index]
    offset = np.broadcast_to(np.asarray(seen.camera.marker_place), (len(picked), 2))
    known = np.isfinite(pose[:, :2]).all(axis=1)
    found, measured = (
        (x[known, 0] + 1j * x[known, 1])
        for x in (picked[:, :2] + turned(picked[:, 2], offset), pose * float(seen.camera.scale))
    )
    ahead, shift = pose[:, 2] - float(seen.camera.marker_yaw) - picked[:, 2], 0j
    if known.sum() < 2:
        rotation = float(np.nanmean(ahead))
        error = 0.5 * nominal_base(seen.geometry) * float(np.nanstd(ahead))
    elif len(pose) == 2 and np.isfinite(pose[0]).all():
        rotation = float(ahead[0])
        shift = measured[0] - found[0] * np.exp(1j * rotation)
        error = float(np.abs(found[1] * np.exp(1j * rotation) + shift - measured[1]))
    else:
        middle = found.mean(), measured.mean()
        rotation = float(np.angle(np.vdot(found - middle[0], measured - middle[1])))
        shift = middle[1] - middle[0] * np.exp(1j * rotation)
        left = found * np.exp(1j * rotation) + shift - measured
        error = float(np.sqrt(np.mean(np.abs(left) ** 2)))
    place = turned(rotation, path[:, :2]) + np.array([shift.real, shift.imag])
    return AlignedPath(edges, np.column_stack([place, path[:, 2] + rotation]), error / length)


def _mislabelled(data: Runs, errors: Errors, floors: Sequence[str]) -> Iterator[str]:
    """Yield a sentence for every run that the kinematics of another floor predict far better."""
    label = np.array(data.surface)
    usual = {f: float(np.nanmedian(errors["calibrated"][label == f])) for f in floors}
    for k, log in enumerate(data.logs):
        own = errors["calibrated"][k]
        others = {f: errors[f][k] for f in floors if f != label[k]}
        if not others or not own > OUTLIER_RATIO * usual[label[k]]:
            continue
        best = min(others, key=lambda f: others[f])
        if others[best] < own / OUTLIER_RATIO and others[best] < OUTLIER_RATIO * usual[best]:
            yield (
                f"{log.name}: labelled {label[k]}, but the wheels roll as on {best} (off by "
                f"{100 * others[best]:.2f} % of the path, on {label[k]} by {100 * own:.2f} %): "
                "check the label of its floor"
            )


def contact_errors(
    data: Runs, problem: Problem, optimum: Optimum, tell: Tell = silent
) -> Float[np.ndarray, " run"]:
    """Return the errors of the force balance on held-out runs; nan for runs not predicted.

    Args:
        data: runs on one floor each, from which the windows of the problem were made.
        problem: likelihood of the runs.
        optimum: end of its fit.
        tell: function that reports the progress.
    """
    fold, state, out = selection_folds(data), optimum.state, np.full(len(data), np.nan)
    linear = problem.linear(state.z, problem.electric(state.z, state.log_variance))
    of_segment = fold[problem.windows.run]
    picked = _picked(data, fold)
    for count, (k, runs) in enumerate(picked.items()):
        tell(count, len(picked))
        keep = problem.full_weight
        keep[: len(of_segment)] = of_segment != k
        if k < 0:
            keep[:] = 1.0
        step = newton_step(problem, state, linear, keep)
        moved = replace(state, z=np.asarray(state.z) + step.step)
        model = force_balance_of(problem, moved, np.linalg.inv(step.information), keep)
        for w in replay.replay_windows(data.subset(runs), model.robot):
            tracks = model.tracks(w)
            out[runs[tracks.run]] = path_errors(tracks, w.parts)
    tell(len(picked), len(picked))
    return out


def selected(
    data: Runs, errors: Errors, contradicted: Collection[str]
) -> dict[str, FloorSelection]:
    """Return the selection on every floor.

    Args:
        data: the runs.
        errors: errors of all models, simplest model first.
        contradicted: floors on which the calibration contradicts the lengths of the config.
    """
    floor = np.array(data.surface)
    fold, cluster = selection_folds(data), clusters(np.degrees(data.heading).tolist())
    out = {}
    for name in sorted(set(floor.tolist())):
        each = {m: x[floor == name] for m, x in errors.items()}
        seen = np.all([np.isfinite(x) for x in each.values()], axis=0)
        each = {m: x[seen] for m, x in each.items()}
        mean = {m: float(x.mean()) for m, x in each.items()}
        able = [m for m in mean if m != "nominal" or name not in contradicted]
        best = min(able, key=lambda m: mean[m])
        behind = {}
        for m, x in each.items():
            _, _, se = mean_error(x - each[best], cluster[floor == name][seen])
            behind[m] = (mean[m] - mean[best], float(se))
        chosen = next(m for m in able if m == best or behind[m][0] <= behind[m][1])
        held_out = bool((fold[floor == name] >= 0).all())
        out[name] = FloorSelection(chosen, mean, behind, int(seen.sum()), held_out)
    return out


PARTS = ((0.0, 1.0), (0.0, 0.5), (0.25, 0.75), (0.5, 1.0))
"""Beginnings and ends of the parts of a run that are judged, as fractions of its path length."""


def path_errors(tracks: replay.Tracks, parts: int = 1) -> Float[np.ndarray, " run"]:
    """Return the error of every track over its path length; see the module docstring.

    `parts` is the number of steps from one measured pose to the next.
    """
    predicted, measured = (path[:, ::parts] for path in (tracks.predicted, tracks.measured))
    step = np.linalg.norm(np.diff(measured[..., :2], axis=1), axis=2)
    far = np.concatenate([np.zeros((len(step), 1)), np.cumsum(step, axis=1)], axis=1)
    errors = []
    for begin, end in PARTS:
        i, j = (np.abs(far - part * far[:, -1:]).argmin(axis=1) for part in (begin, end))
        moved = [_between(path, i, j) for path in (predicted, measured)]
        rows = np.arange(len(far))
        path = np.maximum(far[rows, j] - far[rows, i], 1e-9)
        errors.append(np.linalg.norm(moved[0] - moved[1], axis=1) / path)
    return np.asarray(np.mean(errors, axis=0))


def _between(
    path: Float[np.ndarray, "run edge 3"], i: np.ndarray, j: np.ndarray
) -> Float[np.ndarray, "run 2"]:
    """Return the position at edge j of every path, in the frame of its pose at edge i [m]."""
    rows = np.arange(len(path))
    return turned(-path[rows, i, 2], path[rows, j, :2] - path[rows, i, :2])


def _picked(data: Runs, fold: Int[np.ndarray, " run"]) -> dict[int, Int[np.ndarray, " some"]]:
    """Return the indices of at most `MOST_RUNS` runs of every floor, keyed by their fold."""
    runs = evenly(data.surface, MOST_RUNS * len(set(data.surface)))
    return {k: runs[fold[runs] == k] for k in sorted(set(fold[runs].tolist()))}
