"""Kinematic slip models: encoders, and the corrections that practitioners fit by least squares.

With (s, 0, d) the body twist J^+ r w of wheels that do not slip, s ahead [m/s] and d in yaw
[rad/s]:

    encoder                 v_x = s              yaw = d              v_y from J^+ r w
    effective_track         v_x = a s            yaw = b d            v_y = -x yaw
    instantaneous_centres   v_x = a s + c d      yaw = b d + e s      v_y = -x yaw
    full_linear             v_x = a s + c d      yaw = b d + e s      v_y = f s - x yaw
    calibrated              kinematics with a radius for every drive, see `slipid.model.kinematics`

a is the size of the wheels, and a / b the track, relative to the geometry; x is the position on the
longitudinal axis about which the robot turns [m]; c and e describe a robot whose sides differ. All
models but `encoder` and `calibrated` are for wheels that do not determine motion sideways (skid
steer and differential drives): on other robots v_y is not -x yaw. None of these models has
settings.

Liberties:
    - The five coefficients of the instantaneous centres are equivalent to those of Mandow et al.,
        which are the positions y_left, y_right, x of three centres and two gains, alpha_left,
        alpha_right.
    - Displacements over windows are fitted by least squares, instead of whole paths by an
        optimiser; the effective track of a ROS controller is usually adjusted by hand and has no
        position x.
    - Where the lag of the poses behind the wheels is not known, it is fitted, too.

Source: Mandow et al. 2007, "Experimental kinematics for wheeled skid-steer mobile robots", IROS,
eq. 1 to 5; effective track: the `wheel_separation_multiplier` of ROS controllers; encoders of omni
wheels: Indiveri 2009, IEEE Transactions on Robotics 25(1).

`HeadingLookup` corrects encoders by a smooth function of the direction of travel, a Fourier series:

    (along, across, yaw) = (far, 0, turn) + far sum_k c_k phi_k(angle)

with far the displacement by the encoders, angle its direction in the body frame, turn the yaw by
the encoders, and phi = 1, cos angle, sin angle, ..., cos 6 angle, sin 6 angle. The coefficients c
are estimated by ridge regression on windows; the penalty on the k-th harmonic is weight k^4 times
the sum of far^2, and the constant is not penalised. The weight is chosen in one of two ways:

    - The benchmark selects it from `RIDGES`, as it selects every setting. All load set-ups of a
      floor are pooled.
    - Otherwise the model selects it from `WEIGHTS` by an inner cross-validation: over the groups
      of runs `together`, which optimises the table for the question by which it is judged, or over
      random runs, which optimises it for interpolation. In the comparison there is one table for
      each floor and load set-up.

Liberties:
    - The table is not a published system. A table of corrections over the direction of travel is
        what a practitioner would make for an omni robot, and any slip model should predict better.
    - Harmonics above the sixth are omitted.
    - The table does not depend on speed: runs of all speeds are pooled.

Source: slipid's own.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, NamedTuple, final

import numpy as np
from jaxtyping import Float, Int

from slipid.model.geometry import Geometry
from slipid.model.kinematics import Steering, matrices, rolled
from slipid.predict.slip_model import Channel, RobotSpec, Twists, turned
from slipid.predict.steps import Steps, TrainingWindows, TwistModel

TERMS = {"effective_track": 3, "instantaneous_centres": 5, "full_linear": 6}
"""Number of coefficients of each model, its lag not counted."""
LONGEST_LAG = 2.0
"""Largest difference of a fitted lag from the assumed lag of the steps [s]."""


@final
@dataclass(frozen=True)
class Encoder(TwistModel):
    """No slip: xi = J^+ r w. Nothing is fitted; every other model is compared with this one.

    Attributes:
        shape: geometry to use instead of the robot's, None for the robot's own.
        lag: lag of the poses behind the wheels [s], None for the lag of the steps.
    """

    learns: ClassVar[bool] = False
    name: str = "encoder"
    shape: Geometry | None = None
    lag: float | None = None

    def learn(self, w: TrainingWindows, spec: RobotSpec) -> "Encoder":
        return self

    def twist(self, steps: Steps, spec: RobotSpec) -> Twists:
        at = steps if self.lag is None else steps.at_lag(self.lag)
        return at.signals.rolling(spec if self.shape is None else spec.of_shape(self.shape))


def nominal(shape: Geometry) -> Encoder:
    """Return encoders with the geometry of the config and no lag, as users run them today."""
    return Encoder("nominal", shape, 0.0)


@final
@dataclass(frozen=True)
class Corrected(TwistModel):
    """Kinematics corrected by least squares; see the module docstring.

    The coefficients are a, b, x, c, e, f, of which the model `name` has the first 3, 5 or 6
    (`TERMS`); a fitted lag [s] comes last.

    Attributes:
        shape: geometry whose encoder twists are corrected, None for the robot's own.
    """

    shape: Geometry | None = None

    def learn(self, w: TrainingWindows, spec: RobotSpec) -> "Corrected":
        from scipy.optimize import least_squares

        count, lag = TERMS[self.name], w.steps.lag
        start = np.zeros(count + (w.steps.speed_change is not None))
        start[:2], start[count:] = 1.0, lag
        low, high = np.full(len(start), -np.inf), np.full(len(start), np.inf)
        low[count:], high[count:] = lag - LONGEST_LAG, lag + LONGEST_LAG

        def errors(numbers: np.ndarray) -> np.ndarray:
            return w.errors(replace(self, coefficients=numbers).twist(w.steps, spec), spec)

        found = least_squares(errors, start, bounds=(low, high), x_scale="jac").x
        return replace(self, coefficients=found)

    def twist(self, steps: Steps, spec: RobotSpec) -> Twists:
        count, numbers = TERMS[self.name], self.known
        if len(numbers) > count:
            steps = steps.at_lag(float(numbers[count]))
        own = spec if self.shape is None else spec.of_shape(self.shape)
        return corrected(steps.signals.rolling(own), numbers[:count])


def corrected(rolling: Twists, numbers: Float[np.ndarray, " number"]) -> Twists:
    """Return the encoders' twists corrected by a, b, x and, if present, c, e and f."""
    a, b, x, c, e, f = np.pad(numbers, (0, 6 - len(numbers)))
    s, d = rolling[:, 0], rolling[:, 2]
    yaw = b * d + e * s
    return np.stack([a * s + c * d, f * s - x * yaw, yaw], axis=-1)


CALIBRATED_STDS = (0.3, 0.05, 0.5, 0.3)
"""Prior stds of log radius ratios, of their deviations from their mean, of log base ratios [1], and
of the centre of rotation [m]."""


@final
@dataclass(frozen=True)
class Calibrated(TwistModel):
    """Calibrated kinematics: effective radius of every drive, track or base, centre of rotation.

    The coefficients are those of the method `numbers` of a `Calibration`: log radius ratios of the
    drives, log base ratio, centre [m], and numbers of the steering, if any. `learn`
    estimates them for one floor from windows of body poses, so that pose sensor and lag are taken
    as known; it estimates no steering.

    Attributes:
        shape: geometry to which the ratios refer, None for the robot's own.
    """

    name: str = "calibrated"
    shape: Geometry | None = None

    def learn(self, w: TrainingWindows, spec: RobotSpec) -> "Calibrated":
        from scipy.optimize import least_squares

        drives = w.steps.signals.turn.shape[1]
        radius, deviation, *others = CALIBRATED_STDS
        free = drives + 1 if spec.determines_twist else drives + 2

        def model(z: np.ndarray) -> "Calibrated":
            return replace(self, coefficients=np.pad(z, (0, drives + 2 - free)))

        def errors(z: np.ndarray, noise: float) -> np.ndarray:
            """Return errors of displacements [m], and of the prior in units of their noise."""
            own, rest = z[:drives], z[drives:]
            prior = [own / radius, (own - own.mean()) / deviation, rest / others[: len(rest)]]
            found = w.errors(model(z).twist(w.steps, spec), spec)
            return np.concatenate([found, noise * np.concatenate(prior)])

        z, noise = np.zeros(free), 1e-4
        for _ in range(2):  # the second time with the noise that the first one has left
            z = least_squares(errors, z, args=(noise,)).x
            noise = float(np.sqrt(np.mean(errors(z, 0.0) ** 2)))
        return model(z)

    def twist(self, steps: Steps, spec: RobotSpec) -> Twists:
        own = spec if self.shape is None else spec.of_shape(self.shape)
        numbers, steering = self.known, own.steering
        if steering is not None:
            numbers, (zero, gain, understeer) = numbers[:-3], numbers[-3:]
            wheelbase = steering.wheelbase * np.exp(numbers[-2])
            steering = Steering(wheelbase, zero, gain, understeer, steering.front)
        *radius, base, centre = numbers
        matrix = matrices(
            own.back, own.wheel_radius * np.exp(radius), np.exp(base), np.asarray(centre)
        )
        signals = steps.signals
        return np.asarray(rolled(matrix, signals.turn, steering) / signals.dt[:, None])


HARMONICS = 6
"""Number of harmonics of the Fourier series over directions of travel."""
RIDGES = (1e-5, 1e-3, 1e-1, 10.0)
"""Weights of the ridge from which the benchmark selects."""
WEIGHTS = (1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0)
"""Weights of the ridge from which `HeadingLookup` selects by its own cross-validation."""
Together = Int[np.ndarray, " run"]
"""Group number of every run: runs with equal numbers are held out together, runs with -1 never."""


@final
@dataclass(frozen=True)
class HeadingLookup(TwistModel):
    """A table of corrections over the direction of travel; see the module docstring.

    The coefficients are c for (along, across, yaw).

    Attributes:
        ridge: weight of the ridge, None to select it by an inner cross-validation.
        together: group number of every run in the inner cross-validation, None for random groups.
    """

    by_load: ClassVar[bool] = True
    name: str = "heading_lookup"
    needs: frozenset[Channel] = field(default=frozenset({"twist"}), kw_only=True)
    ridge: float | None = 1e-3
    together: Together | None = None

    def candidates(self) -> Sequence["HeadingLookup"]:
        return [replace(self, ridge=ridge) for ridge in RIDGES]

    def learn(self, w: TrainingWindows, spec: RobotSpec) -> "HeadingLookup":
        table = self._table(w, spec)
        ridge = table.best_weight() if self.ridge is None else self.ridge
        return replace(self, ridge=ridge, coefficients=table.solved(ridge))

    def stiffness(self, w: TrainingWindows, spec: RobotSpec) -> Float[np.ndarray, "k k"]:
        """Return the ridge as a Gaussian prior's precision: penalty / mean squared residual."""
        table = self._table(w, spec)
        left = np.mean((table.gap - table.phi @ self.known) ** 2, axis=0)
        weight = table.best_weight() if self.ridge is None else self.ridge
        return np.kron(table.penalty(weight), np.diag(1 / np.maximum(left, 1e-12)))

    def twist(self, steps: Steps, spec: RobotSpec) -> Twists:
        rolling, series = steps.signals.rolling(spec), self.known
        change = fourier(rolling) @ series
        change[:, :2] = turned(_direction(rolling), change[:, :2])
        return np.asarray(rolling + change)

    def _table(self, w: TrainingWindows, spec: RobotSpec) -> "_HeadingTable":
        rolling = w.means(w.steps.signals.rolling(spec))
        gap = (w.twist - rolling) * w.dt[:, None]
        gap[:, :2] = turned(-_direction(rolling), gap[:, :2])
        return _HeadingTable(fourier(rolling * w.dt[:, None]), gap, self._fold(w.run))

    def _fold(self, run: Int[np.ndarray, " window"]) -> Int[np.ndarray, " window"]:
        """Return the fold of every window: its group in `together`, if there are several groups.

        Otherwise the runs are divided into five random folds.
        """
        fold = np.full(len(run), -1) if self.together is None else self.together[run]
        if len(set(fold[fold >= 0].tolist())) > 1:
            return fold
        return np.random.default_rng(0).integers(0, 5, run.max() + 1)[run]


class _HeadingTable(NamedTuple):
    """Ridge regression of displacements on features, window by window.

    Attributes:
        phi: features (window, k) [m].
        gap: measured displacements less those of the encoders (window, 3) [m, m, rad].
        fold: fold of every window in the cross-validation.
    """

    phi: np.ndarray
    gap: np.ndarray
    fold: np.ndarray

    def penalty(self, weight: float) -> np.ndarray:
        rough = np.concatenate([[0.0], np.repeat(np.arange(1.0, HARMONICS + 1) ** 4, 2)])
        return np.asarray(weight * np.sum(self.phi[:, 0] ** 2) * np.diag(rough))

    def solved(self, weight: float) -> np.ndarray:
        # `lstsq` also solves a singular system: if the robot never moved, all features are zero,
        # and so are the corrections.
        gram = self.phi.T @ self.phi + self.penalty(weight)
        return np.asarray(np.linalg.lstsq(gram, self.phi.T @ self.gap, rcond=None)[0])

    def best_weight(self) -> float:
        return min(WEIGHTS, key=self._left_out)

    def _left_out(self, weight: float) -> float:
        """Return the sum of squared errors on held-out windows, over all folds."""
        loss = 0.0
        for test in (self.fold == k for k in set(self.fold.tolist()) - {-1}):
            if not test.all():
                rest = self._replace(phi=self.phi[~test], gap=self.gap[~test])
                gap = self.gap[test] - self.phi[test] @ rest.solved(weight)
                loss += float((gap**2 * np.array([1.0, 1.0, 0.02])).sum())
        return loss


def _direction(rolling: Float[np.ndarray, "*step 3"]) -> Float[np.ndarray, "*step"]:
    """Return the direction of travel by the encoders [rad]."""
    return np.asarray(np.arctan2(rolling[..., 1], rolling[..., 0]))


def fourier(rolling: Float[np.ndarray, "*step 3"]) -> Float[np.ndarray, "*step k"]:
    """Return the features far phi(angle) of twists [m/s] or of displacements [m].

    The module docstring defines far, phi and angle.
    """
    angle = _direction(rolling)
    waves = [wave(k * angle) for k in range(1, HARMONICS + 1) for wave in (np.cos, np.sin)]
    far = np.hypot(rolling[..., 0], rolling[..., 1])
    return np.stack([np.ones_like(angle), *waves], axis=-1) * far[..., None]
