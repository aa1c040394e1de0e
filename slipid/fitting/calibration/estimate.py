"""Calibration of the kinematics of a robot and of its pose sensor from runs with poses.

Every fit begins with these numbers (see `slipid.model.kinematics` for the equations):

    radius of drive j on floor k     r_kj = r exp(c + d_j + rho_k + e_kj),   rho = 0 on the firmest
                                     floor; e = 0 if there is only one floor
    track or base on floor k         b_k = b exp(f_k)
    centre of rotation on floor k    x_k, for more than two wheels that point ahead; 0 on the
                                     firmest floor, since only its distance from the sensor shows
    wheelbase on floor k             l_k = l exp(f + f_k) of a robot that steers, f_k = 0 on the
                                     firmest floor; its drives have one radius
    steering                         zero, gain and understeer, equal on all floors
    pose sensor                      place p, yaw psi (with a deviation for every session), lag, and
                                     scale of the positions

They minimise the squared whitened innovations of all poses (module `innovations`), each run
weighted by a Student t, plus a Gaussian prior. The variances of poses and motion are estimated by
maximum likelihood in turn. Intervals are from a jackknife over runs, since the kinematics are wrong
somewhere and errors within a run are correlated; they are at least as wide as the likelihood's.

Straight driving determines the steering's zero, and turns determine gain over wheelbase. Gain and
wheelbase apart follow from large angles alone, by the tangent, so that both have priors: the
config's wheelbase within 5 %, and a gain of 1 within .1.

Source: least squares for the same numbers on square paths, Borenstein and Feng 1996, "Measurement
and correction of systematic odometry errors in mobile robots" (UMBmark), IEEE Transactions on
Robotics and Automation 12(6).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import jax
import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import minimize
from scipy.stats import t as student

from slipid.data.align.lag import pose_lag
from slipid.data.runs import Runs
from slipid.fitting.calibration.gyro import LEAST_PARTS, gyro_errors
from slipid.fitting.calibration.innovations import (
    Motion,
    PoseTracks,
    innovations,
    linear_innovations,
    loss_of_noise,
    pose_tracks,
    sensor_yaw,
    start_headings,
)
from slipid.fitting.calibration.result import (
    ABSURD,
    GYRO_PRIORS,
    IDENTIFIED,
    WEAK,
    Calibration,
    MotionNoise,
    Value,
    Verdict,
)
from slipid.fitting.calibration.space import (
    CalibrationSpace,
    base_names,
    has_centre,
    radius_names,
)
from slipid.model.kinematics import Steering, nominal_base, nominal_steering
from slipid.search_space import Choice, Space
from slipid.support.progress import Tell, silent

DEGREES = 4.0
"""Degrees of freedom of the Student t of runs."""
LEAST_CLUSTERS = 12
"""Number of parts into which runs are divided for the jackknife if there are fewer runs."""
MOST_ROUNDS, MOST_STEPS, SETTLED = 6, 5, 0.1
"""Largest numbers of rounds and of solver steps per round, and the change of every number at which
rounds end [std]."""
RECUT_S = 0.02
"""Change of the lag after which wheel turns are computed anew [s]."""
MOST_START = 64
"""Number of runs above which a calibration starts from that of so many of them."""
NOISE_TRACKS = 12
"""Largest number of runs on each floor from which variances are estimated."""
_TYPICAL = np.log(np.array([0.003, 0.005, 0.005, 0.005, 0.01, 0.005, 0.005, 0.01]) ** 2)
"""Logarithms of the typical variances of positions, of headings, of the motion along, across and in
yaw per metre, and of a run's effects on them."""
_TYPICAL_STD = 3.0
"""Prior std of the logarithms of variances [1]."""


@dataclass(frozen=True, eq=False)
class _Fit:
    """State of a calibration.

    Attributes:
        model: map from the search vector.
        data: the runs.
        tracks: poses and wheel turns.
        z: search vector.
        log_variance: logarithms of the variances: of positions and headings, then for each floor
            six of the motion, as in `innovations`.
        weight: weight of each track [1].
        runs: indices of the runs from which tracks are cut, None for all.
        settled: True if no number changed by `SETTLED` stds or more in the last round.
    """

    model: CalibrationSpace
    data: Runs
    tracks: PoseTracks
    z: Float[np.ndarray, " free"]
    log_variance: Float[np.ndarray, " variance"]
    weight: Float[np.ndarray, " track"]
    runs: Int[np.ndarray, " some"] | None = None
    settled: bool = True

    @cached_property
    def floor(self) -> Int[np.ndarray, " track"]:
        """Index of the floor of each track; 0 for tracks that only fill the arrays."""
        names = [self.data.surface[k] for k in self.tracks.run]
        return self._filled([self.model.floors.index(name) for name in names])

    @cached_property
    def session(self) -> Int[np.ndarray, " track"]:
        """Index of the session of each track."""
        names = [self.data.session[k] for k in self.tracks.run]
        return self._filled([self.model.sessions.index(name) for name in names])

    def _filled(self, of_runs: list[int]) -> Int[np.ndarray, " track"]:
        return np.pad(of_runs, (0, len(self.tracks.pose) - len(of_runs)))

    def motion(self, z: Float[np.ndarray, "*batch free"]) -> Motion:
        """Return the numbers by which the poses of every track are predicted."""
        model = self.model
        each = np.stack([model.column(f"yaw@{s}", z) for s in model.sessions], axis=-1)
        each = each[..., self.session]

        def for_all(name: str) -> np.ndarray:
            return np.broadcast_to(model.column(name, z)[..., None], each.shape)

        place = np.stack([for_all("offset.x"), for_all("offset.y")], axis=-1)
        kinematics = model.kinematics(z)
        steering = kinematics.steering
        return Motion(
            matrix=kinematics.matrices()[..., self.floor, :, :],
            place=place,
            yaw=for_all("yaw") + each,
            scale=for_all("scale"),
            lag=for_all("lag") - self.tracks.lag,
            steering=steering and Steering(*(x[..., self.floor] for x in steering)),
        )

    def log_noise(self, log_variance: Float[np.ndarray, " variance"]) -> np.ndarray:
        """Return the logarithms of the variances of every track (track, 8)."""
        motion = log_variance[2:].reshape(-1, 6)[self.floor]
        return np.concatenate([np.tile(log_variance[:2], (len(motion), 1)), motion], axis=1)

    @cached_property
    def arrays(self) -> tuple[np.ndarray, ...]:
        """Arrays of the tracks for the compiled functions."""
        t, now = self.tracks, self.motion(self.z)
        turn = t.turn + now.lag[:, None, None, None] * t.turn_slope
        aligned = start_headings(now.matrix, t.pose, turn, now.steering)
        heading = np.asarray(aligned) + now.yaw
        return t.pose, t.turn, t.turn_slope, t.far, heading

    @cached_property
    def prior(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean and std of the prior."""
        each = [self.model.numbers[name] for name in self.model.free]
        return np.array([n.mean for n in each]), np.array([n.std for n in each])

    @cached_property
    def linear(self) -> tuple[Float[np.ndarray, "track m"], Float[np.ndarray, "track m free"]]:
        """Weighted whitened residuals of every track, and their derivative."""
        now, log_noise = self.motion(self.z), self.log_noise(self.log_variance)
        white, slope = linear_innovations(now, log_noise, self.arrays)
        free, step = len(self.z), 1e-6
        moved = self.motion(self.z + step * np.eye(free))
        total = np.zeros((*white.shape, free))
        leaves = (jax.tree.leaves(each) for each in (slope, now, moved))
        for field, before, after in zip(*leaves, strict=True):
            by_z = (after - before) / step
            shape = *white.shape, -1
            by_field = np.asarray(field).reshape(shape)
            total += np.einsum("ngaf,znf->ngaz", by_field, by_z.reshape(free, len(white), -1))
        root = np.sqrt(self.weight)[:, None]
        tracks = len(white)
        return (
            np.asarray(white).reshape(tracks, -1) * root,
            total.reshape(tracks, -1, free) * root[..., None],
        )

    def loss(self, z: Float[np.ndarray, " free"]) -> float:
        """Return the sum of squares at a search vector, with the present path's filter gains."""
        now, log_noise = self.motion(self.z), self.log_noise(self.log_variance)
        white = np.asarray(innovations(self.motion(z), now, log_noise, self.arrays).white)
        mean, std = self.prior
        each = self.weight * (white**2).sum(axis=(1, 2))
        return float(each.sum() + (((z - mean) / std) ** 2).sum())

    @property
    def gradient(self) -> tuple[Float[np.ndarray, " free"], Float[np.ndarray, "free free"]]:
        """Gradient and Gauss-Newton matrix of half the sum of squares, prior included."""
        (r, slope), (mean, std) = self.linear, self.prior
        matrix = np.einsum("nmi,nmj->ij", slope, slope) + np.diag(std**-2.0)
        return np.einsum("nmi,nm->i", slope, r) + (self.z - mean) / std**2, matrix

    def solved(self) -> "_Fit":
        """Return the fit with the search vector solved by Levenberg and Marquardt."""
        now, damping, (mean, std) = self, 1e-4, self.prior
        for _ in range(MOST_STEPS):
            g, a = now.gradient
            loss = float((now.linear[0] ** 2).sum() + (((now.z - mean) / std) ** 2).sum())
            for _ in range(8):
                step = np.linalg.solve(a + damping * np.diag(np.diag(a)), -g)
                if now.loss(now.z + step) <= loss * (1 + 1e-9):
                    break
                damping *= 10.0
            else:
                return now
            now, damping = replace(now, z=now.z + step), damping * 0.1
            if _in_stds(step, a) < SETTLED:
                break
        return now

    def with_noise(self) -> "_Fit":
        """Return the fit with variances of largest posterior, from some of the tracks."""
        floor = self.floor[: len(self.tracks.run)]
        part = self.of_tracks(evenly(floor, NOISE_TRACKS * len(np.unique(floor))))
        typical = np.concatenate([_TYPICAL[:2], np.tile(_TYPICAL[2:], len(self.model.floors))])
        numbers = part.motion(self.z)

        def loss(v: np.ndarray) -> tuple[float, np.ndarray]:
            each, slope = loss_of_noise(numbers, part.log_noise(v), part.arrays)
            slope = np.asarray(slope) * part.weight[:, None]
            motion = np.zeros((len(self.model.floors), 6))
            np.add.at(motion, part.floor, slope[:, 2:])
            pull = (v - typical) / _TYPICAL_STD
            total = float((part.weight * np.asarray(each)).sum() + (pull**2).sum())
            own = np.concatenate([slope[:, :2].sum(axis=0), motion.ravel()])
            return total, own + 2 * pull / _TYPICAL_STD

        bounds = [(x - 12.0, x + 12.0) for x in typical]
        # Divided by the slope, the first step of the solver is a step of one; else it overshoots.
        size = max(float(np.abs(loss(self.log_variance)[1]).max()), 1.0)

        def scaled(v: np.ndarray) -> tuple[float, np.ndarray]:
            value, slope = loss(v)
            return value / size, slope / size

        found = minimize(
            scaled,
            self.log_variance,
            jac=True,
            method="L-BFGS-B",
            bounds=bounds,
            options={"maxiter": 20, "ftol": 1e-6},
        )
        return replace(self, log_variance=found.x)

    def of_tracks(self, tracks: Int[np.ndarray, " some"]) -> "_Fit":
        """Return the fit of some of the tracks."""
        part = self.tracks.subset(tracks)
        weight = np.pad(self.weight[tracks], (0, len(part.pose) - len(tracks)))
        return replace(self, tracks=part, weight=weight)

    def with_weights(self) -> "_Fit":
        """Return the fit with the Student-t weight of every track."""
        now, log_noise = self.motion(self.z), self.log_noise(self.log_variance)
        white = np.asarray(innovations(now, now, log_noise, self.arrays).white)
        count = np.maximum(np.isfinite(self.tracks.pose[:, 1:]).sum(axis=(1, 2)), 1)
        # The mean square of a run counts as one observation: a long run may be an outlier, too.
        each = (white**2).sum(axis=(1, 2)) / count
        return replace(self, weight=(DEGREES + 1) / (DEGREES + each))


def calibrate(data: Runs, space: Space, choices: Sequence[Choice] = ()) -> Calibration:
    """Return the calibration of a robot from runs with poses.

    Args:
        data: the runs, each on one floor.
        space: robot with the lengths of the config; priors of the camera's scale, lag and marker
            yaw are used, too.
        choices: choices from which the space was made; numbers that they fix stay fixed.

    Raises:
        DataError: no run has two poses.
    """
    return _result(_fitted(data, space, choices))


def cross_calibrated(
    data: Runs,
    space: Space,
    choices: Sequence[Choice],
    fold: Int[np.ndarray, " run"],
    tell: Tell = silent,
) -> tuple[Calibration, dict[int, Calibration]]:
    """Return the calibration from all runs, and for each fold that from all runs outside it.

    The latter follow from the former by one Gauss-Newton step at the variances and weights of all
    runs, which is exact, given these, for numbers in which the poses are linear. Arguments are
    those of `calibrate`; runs with fold -1 are never left out, and `tell` reports the progress.
    """
    fit = _fitted(data, space, choices, tell)
    (r, slope), (_, a) = fit.linear, fit.gradient
    of_track, without = fold[fit.tracks.run], {}
    for k in sorted(set(of_track.tolist()) - {-1}):
        mine = np.flatnonzero(of_track == k)
        inner = np.einsum("nmi,nmj->ij", slope[mine], slope[mine])
        pull = np.einsum("nmi,nm->i", slope[mine], r[mine])
        without[k] = _result(replace(fit, z=fit.z + np.linalg.solve(a - inner, pull)), rough=True)
    return _result(fit), without


def most_rounds(data: Runs) -> int:
    """Return the largest number of rounds in which runs are calibrated."""
    return MOST_ROUNDS if len(data) <= MOST_START else 2 * MOST_ROUNDS


def _fitted(data: Runs, space: Space, choices: Sequence[Choice], tell: Tell = silent) -> _Fit:
    """Return the end of a calibration; arguments are those of `cross_calibrated`."""
    model = CalibrationSpace.of(space, choices, data, 0)
    z = np.array([model.numbers[name].mean for name in model.free])
    lag = pose_lag(data)
    if "lag" in model.free and lag is not None and lag.decisive:
        z[model.free.index("lag")] = lag.seconds
    typical = np.concatenate([_TYPICAL[:2], np.tile(_TYPICAL[2:] + 2.0, len(model.floors))])
    # Many runs only refine what a part of them has found.
    some = evenly(data.surface, MOST_START) if len(data) > MOST_START else None
    total = most_rounds(data)
    fit = _rounds(_started(model, data, z, typical, some), choices, lambda k: tell(k, total))
    if some is None:
        return fit
    whole = _cut(replace(fit, runs=None))
    return _rounds(whole, choices, lambda k: tell(MOST_ROUNDS + k, total))


def _rounds(fit: _Fit, choices: Sequence[Choice], tell: Callable[[int], None]) -> _Fit:
    """Return the fit after rounds that estimate the numbers, the variances and the weights.

    `tell` is called with the number of rounds before each, and with their largest number at last.
    """
    for k in range(MOST_ROUNDS):
        tell(k)
        before = fit
        fit = fit.solved().with_noise().with_weights()
        radius = [float(np.mean(row)) for row in fit.model.kinematics(fit.z).radius]
        fit = _referred(fit, choices, int(np.argmax(radius)))
        if abs(float(fit.model.column("lag", fit.z)) - fit.tracks.lag) > RECUT_S:
            fit = _cut(fit)
        elif (
            fit.model.firmest == before.model.firmest
            and _in_stds(fit.z - before.z, fit.gradient[1]) < SETTLED
        ):
            tell(MOST_ROUNDS)
            return replace(fit, settled=True)
    tell(MOST_ROUNDS)
    return replace(fit, settled=False)


def evenly(floors: Sequence[str] | np.ndarray, most: int) -> Int[np.ndarray, " some"]:
    """Return indices of at most about `most` elements, evenly from each floor."""
    label = np.asarray(floors)
    some, names = [], np.unique(label)
    for name in names:
        mine = np.flatnonzero(label == name)
        at = np.linspace(0, len(mine) - 1, min(int(np.ceil(most / len(names))), len(mine)))
        some.append(mine[at.round().astype(int)])
    return np.concatenate(some)


def _in_stds(
    change: Float[np.ndarray, " free"], precision: Float[np.ndarray, "free free"]
) -> float:
    """Return the largest change of a coordinate, in its standard deviations."""
    return float((np.abs(change) / np.sqrt(np.diag(np.linalg.inv(precision)))).max())


def _cut(fit: _Fit) -> _Fit:
    """Return the fit with the tracks cut at the present lag."""
    shape = fit.model.space.template.geometry
    nominal = np.asarray(shape.pseudo_inverse()) * float(shape.wheel_radius)
    arm, lag = 0.5 * nominal_base(shape), float(fit.model.column("lag", fit.z))
    tracks = pose_tracks(fit.data, lag, nominal, arm, nominal_steering(shape), fit.runs)
    return replace(fit, tracks=tracks, weight=np.ones(len(tracks.pose)))


def _started(
    model: CalibrationSpace,
    data: Runs,
    z: Float[np.ndarray, " free"],
    log_variance: Float[np.ndarray, " variance"],
    runs: Int[np.ndarray, " some"] | None,
) -> _Fit:
    """Return the fit before its first round, with the sensor's yaw estimated from directions."""
    nothing = np.zeros(0)
    empty = PoseTracks(np.zeros(0, int), nothing, nothing, nothing, nothing, 0.0)
    fit = _cut(_Fit(model, data, empty, z, log_variance, np.ones(0), runs))
    tracks = fit.tracks
    if "yaw" not in model.free or not np.isfinite(tracks.pose).all(axis=-1).any():
        return fit
    z, now = z.copy(), fit.motion(z)
    yaw = sensor_yaw(now.matrix, tracks.pose, tracks.turn, now.steering)
    z[model.free.index("yaw")] = yaw
    return replace(fit, z=z)


def _referred(fit: _Fit, choices: Sequence[Choice], firmest: int) -> _Fit:
    """Return the fit with radii and centres that refer to the floor with index `firmest`."""
    if firmest == fit.model.firmest:
        return fit
    model = CalibrationSpace.of(fit.model.space, choices, fit.data, firmest)
    own = fit.model.floors[firmest]

    def before(name: str) -> float:
        return float(fit.model.column(name, fit.z))

    longer, ahead = before(f"floor.{own}"), before(f"centre.{own}")
    shift = {"radius": longer, "offset.x": -ahead}
    shift |= {f"floor.{f}": -longer for f in model.floors}
    shift |= {f"centre.{f}": -ahead for f in model.floors}
    if "base" in model.numbers:
        shift |= {"base": before(f"base.{own}")}
        shift |= {f"base.{f}": -before(f"base.{own}") for f in model.floors}
    z = np.array([before(name) + shift.get(name, 0.0) for name in model.free])
    return replace(fit, model=model, z=z)


def _changes(fit: _Fit) -> Float[np.ndarray, "part free"]:
    """Return the change of the search vector if one part of the runs is left out (jackknife).

    Parts are runs, or equal parts of runs if there are few.
    """
    (r, slope), (_, a) = fit.linear, fit.gradient
    runs = len(fit.tracks.run)
    parts = max(1, int(np.ceil(LEAST_CLUSTERS / runs)))
    out = []
    for n in range(runs):
        posed = np.isfinite(fit.tracks.pose[n, 1:]).any(axis=1)
        at = (np.cumsum(posed) - 1).clip(0)
        part = np.repeat(at * parts // max(int(posed.sum()), 1), 3)
        for k in range(parts):
            mine = slope[n][part == k]
            out.append(np.linalg.solve(a - mine.T @ mine, mine.T @ r[n][part == k]))
    return np.array(out)


def _result(fit: _Fit, rough: bool = False) -> Calibration:
    """Return the calibration with intervals and verdicts; `rough` ones have too narrow intervals.

    Rough intervals save the time of the jackknife where only the values are used.
    """
    model, z = fit.model, fit.z
    changes = np.zeros((2, len(z))) if rough else _changes(fit)
    covariance = np.zeros((len(z), len(z))) if rough else np.linalg.inv(fit.gradient[1])
    count = len(changes)
    off = changes - changes.mean(axis=0)

    def total(names: Sequence[str]) -> float:
        return sum(float(model.column(name, z)) for name in names)

    def is_far(names: Sequence[str]) -> bool:
        """Return whether a length is far from the config's; the names are those of its parts."""
        return bool(abs(total(names)) > np.log(ABSURD))

    def value(
        names: Sequence[str],
        unit: str,
        log_of: float | None = None,
        far: bool = False,
        mean_of: Sequence[str] = (),
    ) -> Value:
        """Return a sum of coordinates and the mean of others, or its exponential times `log_of`."""
        part = dict.fromkeys(names, 1.0) | dict.fromkeys(mean_of, 1 / max(len(mean_of), 1))
        w = np.array([part.get(name, 0.0) for name in model.free])
        known = model.numbers
        stds = {name: part[name] * known[name].std for name in part if name in known}
        prior = float(np.hypot.reduce([*stds.values()], initial=0.0))
        hidden = [std for name, std in stds.items() if name in model.unseen]
        at = sum(share * total([name]) for name, share in part.items())
        influence = (off @ w) ** 2
        jackknife = (count - 1) / count * float(influence.sum())
        std = float(np.sqrt(max(float(w @ covariance @ w), jackknife)))
        std = float(np.hypot.reduce([std, *hidden])) if w.any() else prior
        of_all = influence / max(float(influence.sum()), 1e-300)
        freedom = max(1 / max(float((of_all**2).sum()), 1e-9) - 1, 3.0)
        half = std * float(student.ppf(0.95, freedom))
        verdict: Verdict = "fixed" if prior == 0 else "identified"
        if prior > 0 and std > IDENTIFIED * prior:
            verdict = "weak" if w.any() and std < WEAK * prior else "not_identified"
        ends = at - half, at + half
        if log_of is None:
            return Value(at, ends, std, verdict, unit)
        if far:
            verdict = "not_identified"
        best = log_of * float(np.exp(at))
        low, high = (log_of * float(np.exp(end)) for end in ends)
        return Value(best, (low, high), best * std, verdict, unit)

    shape = model.space.template.geometry
    radius, base = float(shape.wheel_radius), nominal_base(shape)
    firm = model.floors[model.firmest]
    far_radius = any(is_far(radius_names(firm, j)) for j in range(shape.drives))
    far_base = is_far(base_names(firm))
    steering = {
        "wheelbase_m": value(base_names(firm), "m", base, far_base),
        "zero_rad": value(["zero"], "rad"),
        "gain": value(["gain"], "1"),
        "understeer": value(["understeer"], "s^2/m"),
    }
    # The sensor's yaw is that of all sessions: one of them alone would leave the common part open.
    yaws = {f"yaw@{s}": float(model.column(f"yaw@{s}", z)) for s in model.sessions}
    mean_yaw = float(np.mean(list(yaws.values())))
    return Calibration(
        sideways=shape.determines_twist,
        radius={
            f: tuple(
                value(radius_names(f, j), "m", radius, far_radius) for j in range(shape.drives)
            )
            for f in model.floors
        },
        base={f: value(base_names(f), "m", base, far_base) for f in model.floors},
        centre={f: value([f"centre.{f}"], "m") for f in model.floors if has_centre(shape)},
        offset=(value(["offset.x"], "m"), value(["offset.y"], "m")),
        yaw=value(["yaw"], "rad", mean_of=list(yaws)),
        session_yaw={
            s: yaw - mean_yaw for s, yaw in zip(model.sessions, yaws.values(), strict=True)
        },
        lag=value(["lag"], "s"),
        scale=value(["scale"], "1"),
        firmest=firm,
        steering={} if shape.driven is None else steering,
        gyro={} if rough else _gyro(fit.data, float(model.column("lag", z))),
        nominal_radius=radius,
        nominal_base=base,
        noise=_noise(fit),
        runs=len(fit.data),
        settled=fit.settled,
    )


def _gyro(data: Runs, lag: float) -> dict[str, Value]:
    """Return scale and bias of the gyro; at their priors if headings change too little."""
    found = gyro_errors(data, lag)
    if found is None:
        return {}
    known = all(
        std < WEAK * prior
        for std, (_, prior, _) in zip(found[1], GYRO_PRIORS.values(), strict=True)
    )
    out = {}
    for (name, (mean, prior, unit)), at, std in zip(GYRO_PRIORS.items(), *found, strict=True):
        verdict: Verdict = "identified" if std < IDENTIFIED * prior else "weak"
        best, std, verdict = (at, std, verdict) if known else (mean, prior, "not_identified")
        half = float(std * student.ppf(0.95, LEAST_PARTS - 1))
        ends = float(best) - half, float(best) + half
        out[name] = Value(float(best), ends, float(std), verdict, unit)
    return out


def _noise(fit: _Fit) -> MotionNoise:
    std = np.exp(0.5 * fit.log_variance)
    floors = std[2:].reshape(-1, 2, 3)
    process, effect = (
        {f: (a, b, c) for f, (a, b, c) in zip(fit.model.floors, each.tolist(), strict=True)}
        for each in (floors[:, 0], floors[:, 1])
    )
    return MotionNoise(float(std[0]), float(std[1]), process, effect)
