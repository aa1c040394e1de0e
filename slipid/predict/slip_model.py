"""Slip models: the common interface of all of them, and the runs that they predict.

A slip model is fitted to runs with poses, and then predicts runs from what the robot itself
measures: wheels, currents, commands, perhaps a gyro. All are given the same steps of the same runs.
"""

import abc
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from slipid.data.windows import Windows
from slipid.fitting.likelihood import marker_increments, measured_increments
from slipid.model.geometry import Geometry
from slipid.model.robot import Robot

Increments = Float[np.ndarray, "segment window 3"]
_marker_increments = jax.jit(marker_increments)
_measured_increments = jax.jit(measured_increments)


def as_increments(twist: np.ndarray, w: Windows, robot: Robot) -> Increments:
    """Return marker increments [m, m, rad] of body twists (segment, window, 3)."""
    session = jnp.asarray([robot.session_index(s) for s in w.session])
    return np.asarray(_marker_increments(robot, jnp.asarray(twist), jnp.asarray(w.dt), session))


def body_twist(w: Windows, robot: Robot) -> np.ndarray:
    """Return the measured body twist of every window, without yaw and position of the marker."""
    moved = np.asarray(_measured_increments(robot, jnp.asarray(w.pose)))
    yaw = moved[..., 2]
    yaws = {s: float(robot.camera.yaw(robot.session_index(s))) for s in set(w.session)}
    psi = np.array([yaws[s] for s in w.session])[:, None]
    chord = turned(psi, moved[..., :2])
    place = np.broadcast_to(np.asarray(robot.camera.marker_place), chord.shape)
    chord -= turned(yaw, place) - place
    # a chord is the arc times sinc, and points half the turn away from its start
    arc = turned(-0.5 * yaw, chord) / np.sinc(yaw / (2 * np.pi))[..., None]
    return np.concatenate([arc, yaw[..., None]], -1) / w.dt[..., None]


def turned(angle: np.ndarray | float, v: np.ndarray) -> np.ndarray:
    """Return plane vectors (..., 2), each turned by its angle (...)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * v[..., 0] - s * v[..., 1], s * v[..., 0] + c * v[..., 1]], -1)


def turned_left(v: np.ndarray) -> np.ndarray:
    """Return plane vectors (..., 2), each turned by a quarter to the left."""
    return np.stack([-v[..., 1], v[..., 0]], -1)


Channel = Literal["current", "gyro", "command", "twist"]
"""Input a model may need beside the encoders; `twist`: wheels that determine the body's twist."""
Aim = Literal["end", "energy"]
"""Prediction of a model for a run: its end, or its electric energy."""
Numbers = Float[np.ndarray, " step"]
Twists = Float[np.ndarray, "step 3"]
"""Body twist of each step: ahead [m/s], to the left [m/s], yaw [rad/s]."""
TRIES = 4
"""Number of settings that a model may try in its inner cross-validation, the same for all."""
WINDOW_S = 0.5
"""Length of the windows on which models are trained and twists are judged [s]."""
SHAFT_W0 = 3.0
"""Shaft speed below which a current's power does not determine its torque [rad/s]."""


@dataclass(frozen=True, eq=False)
class RobotSpec:
    """Properties of a robot that are known before anything is fitted.

    A drive is a motor with all the wheels that it turns: one wheel, or a side of a skid steer.

    Attributes:
        forward: rim speed of each drive [m/s] from the body twist.
        back: body twist from the drives' rim speeds if nothing slips, by least squares.
        wheel_radius, base_radius: radii [m].
        gear_ratio: motor turns per wheel turn.
        resistance, back_emf: constants of the motor by its datasheet [ohm], [V s/rad].
        mass: mass of the robot [kg].
        determines_twist: whether the drives determine the body's twist; a skid steer's do not.
    """

    forward: Float[np.ndarray, "drive 3"]
    back: Float[np.ndarray, "3 drive"]
    wheel_radius: float
    base_radius: float
    gear_ratio: float
    resistance: float
    back_emf: float
    mass: float
    determines_twist: bool

    @classmethod
    def of(cls, robot: Robot) -> "RobotSpec":
        """Return the properties of a robot as in its config."""
        shape, motor = robot.geometry, robot.motor
        back = np.asarray(shape.pseudo_inverse())
        return cls(
            forward=np.linalg.pinv(back),
            back=back,
            wheel_radius=float(shape.wheel_radius),
            base_radius=float(shape.base_radius),
            gear_ratio=float(motor.gear_ratio),
            resistance=float(motor.resistance),
            back_emf=float(motor.back_emf),
            mass=float(robot.body.mass),
            determines_twist=bool(shape.determines_twist),
        )

    def of_shape(self, shape: Geometry) -> "RobotSpec":
        """Return the same robot with other wheel sizes and positions for reading encoders."""
        back = np.asarray(shape.pseudo_inverse())
        return replace(self, back=back, wheel_radius=float(shape.wheel_radius))

    @property
    def size(self) -> Float[np.ndarray, "3"]:
        """Weights that make a yaw rate comparable with a speed: one, one, base radius [m]."""
        return np.array([1.0, 1.0, self.base_radius])


@dataclass(frozen=True, eq=False)
class RunSignals:
    """Measurements of a robot during a run, in steps of a tenth to half a second.

    Attributes:
        name: name of the run.
        dt: length of each step [s].
        turn: rotation of each drive's wheels in the step [rad].
        current: mean current of each motor [A], signed along its wheel's forward direction where
            `current_is_signed`, else its magnitude; None where it was not logged.
        gyro: mean yaw rate [rad/s], or None.
        command: commanded twist, or None.
        floor: name of the floor; None where a model has to infer it.
        load: name of the load set-up, which a robot knows.
    """

    name: str
    dt: Float[np.ndarray, " step"]
    turn: Float[np.ndarray, "step drive"]
    current: Float[np.ndarray, "step drive"] | None = None
    current_is_signed: bool = False
    gyro: Float[np.ndarray, " step"] | None = None
    command: Float[np.ndarray, "step 3"] | None = None
    floor: str | None = None
    load: str | None = None

    def __len__(self) -> int:
        return len(self.dt)

    @property
    def speed(self) -> Float[np.ndarray, "step drive"]:
        """Wheel speed of each drive [rad/s]."""
        return self.turn / self.dt[:, None]

    def rolling(self, spec: RobotSpec) -> Twists:
        """Return the body twist if nothing slips, by the encoders alone."""
        return np.asarray(self.speed * spec.wheel_radius @ spec.back.T)

    def along(self, spec: RobotSpec) -> Float[np.ndarray, "step drive"]:
        """Return the current along the wheel's motion [A]: positive where the motor drives.

        For an unsigned ammeter it is the magnitude, as if the motor always drove.

        Raises:
            ValueError: no current was logged.
        """
        if self.current is None:
            raise ValueError(f"{self.name}: no current was logged; this model needs currents")
        signed = self.current_is_signed
        return np.asarray(self.current * np.sign(self.speed) if signed else self.current)

    def torque(self, spec: RobotSpec, rest: float = SHAFT_W0) -> Float[np.ndarray, "step drive"]:
        """Return M = C_e I + R I^2 w / (w^2 + w0^2) [N m], w the shaft's speed and w0 `rest`.

        The 2021 paper's torque characterising variable M = U I / w, with U = C_e w + R I, regular
        at rest. It is positive where the motor drives.
        """
        amps, shaft = self.along(spec), np.abs(spec.gear_ratio * self.speed)
        heat = spec.resistance * amps**2 * shaft / (shaft**2 + rest**2)
        return np.asarray(spec.back_emf * amps + heat)

    def power(self, spec: RobotSpec) -> Numbers:
        """Return the electric power of all motors [W], by the currents and the motor's datasheet.

        P = sum_i (R I_i + C_e |w_i|) I_i
        """
        amps, shaft = self.along(spec), np.abs(spec.gear_ratio * self.speed)
        return np.asarray(((spec.resistance * amps + spec.back_emf * shaft) * amps).sum(1))

    def windowed(self, seconds: float = WINDOW_S) -> "RunSignals":
        """Return the same run in longer steps: neighbours joined to about that length."""
        first = groups(self.dt, seconds)
        dt = np.add.reduceat(self.dt, first)

        def mean(x: np.ndarray | None) -> np.ndarray | None:
            if x is None:
                return None
            weight = self.dt.reshape(-1, *[1] * (x.ndim - 1))
            return np.asarray(np.add.reduceat(x * weight, first) / dt.reshape(weight[first].shape))

        return replace(
            self,
            dt=dt,
            turn=np.add.reduceat(self.turn, first),
            current=mean(self.current),
            gyro=mean(self.gyro),
            command=mean(self.command),
        )


@dataclass(frozen=True, eq=False)
class Run:
    """A run with the pose of its body, for training and judgement.

    Attributes:
        signals: measurements of the robot; their `floor` is None where models do not know it.
        pose: x, y [m] and heading [rad] of the body at the edges of the steps, in true metres.
        floor: name of the floor it was driven on.
        load: name of the load set-up.
        heading: commanded direction of travel [rad], nan where there is none.
        speed: commanded speed [m/s], nan where none was logged.
    """

    signals: RunSignals
    pose: Float[np.ndarray, "edge 3"]
    floor: str
    load: str = "as_built"
    heading: float = float("nan")
    speed: float = float("nan")

    @property
    def twist(self) -> Twists:
        """Body twist of every step by the poses: constant over a step, exact on SE(2)."""
        return body_increments(self.pose) / self.signals.dt[:, None]

    def windowed(self, seconds: float = WINDOW_S) -> "Run":
        """Return the same run in longer steps."""
        edges = np.append(groups(self.signals.dt, seconds), len(self.signals))
        return replace(self, signals=self.signals.windowed(seconds), pose=self.pose[edges])

    def with_floor(self, floor: bool) -> "Run":
        """Return the same run, its floor known to models or not."""
        return replace(self, signals=replace(self.signals, floor=self.floor if floor else None))


@dataclass(frozen=True, eq=False)
class PredictedRun:
    """Prediction of a run by a slip model.

    Attributes:
        path: pose at every edge of the steps, relative to the pose at the start [m, m, rad].
        end_covariance: covariance of the end position, relative to the start [m^2]; None for a
            model without uncertainty.
        freedom: degrees of freedom of the Student t whose scale matrix it is; infinite for a
            Gaussian's covariance.
        slipping: confidence that the robot slips in a step, on any rising scale; None to derive it
            from the difference of twist and encoders.
        floors: probability of each floor in every step, by name; None for a model that does not
            infer floors.
        power: electric power of all motors in every step [W], predicted without the currents; None
            for a model that does not predict it.
    """

    path: Float[np.ndarray, "edge 3"]
    end_covariance: Float[np.ndarray, "2 2"] | None = None
    freedom: float = np.inf
    slipping: Float[np.ndarray, " step"] | None = None
    floors: Mapping[str, Numbers] | None = None
    power: Numbers | None = None


@dataclass(frozen=True)
class SlipModel(abc.ABC):
    """A model that predicts the motion of the body from wheels, before or after it is fitted.

    Attributes:
        name: name of its row.
        needs: channels without which it does not run.
        aim: what it predicts, by which its settings are selected.
    """

    name: str
    needs: frozenset[Channel] = field(default=frozenset(), kw_only=True)
    aim: Aim = field(default="end", kw_only=True)

    def candidates(self) -> Sequence["SlipModel"]:
        """Return the model with other settings, at most `TRIES`, for cross-validation."""
        return (self,)

    @abc.abstractmethod
    def fit(self, runs: Sequence[Run], spec: RobotSpec) -> Self:
        """Return the model fitted to runs."""

    @abc.abstractmethod
    def predict(self, runs: Sequence[RunSignals], spec: RobotSpec) -> list[PredictedRun]:
        """Return predictions of runs the model was not fitted to, from the signals alone."""

    @property
    @abc.abstractmethod
    def numbers(self) -> int:
        """Count of fitted numbers."""


def groups(dt: Float[np.ndarray, " step"], seconds: float) -> np.ndarray:
    """Return the first step of every group of neighbours that together last about so long [s]."""
    count = max(1, round(float(dt.sum()) / seconds))
    number = np.minimum((np.cumsum(dt) - 0.5 * dt) / dt.sum() * count, count - 1).astype(int)
    return np.flatnonzero(np.diff(number, prepend=-1))


def path_of(twist: Twists, dt: Float[np.ndarray, " step"]) -> Float[np.ndarray, "edge 3"]:
    """Return poses from the origin on for a twist constant over each step (exact SE(2))."""
    heading = np.concatenate([[0.0], np.cumsum(twist[:, 2] * dt)])
    middle = 0.5 * (heading[1:] + heading[:-1])
    # a chord is the arc times sinc, and points half the turn away from its start
    chord = np.sinc(np.diff(heading) / (2 * np.pi)) * dt
    step = turned(middle, twist[:, :2] * chord[:, None])
    place = np.concatenate([np.zeros((1, 2)), np.cumsum(step, axis=0)])
    return np.column_stack([place, heading])


def relative_to_start(path: Float[np.ndarray, "edge 3"]) -> Float[np.ndarray, "edge 3"]:
    """Return poses relative to the first of them."""
    offset = path - path[0]
    return np.column_stack([turned(-path[0, 2], offset[:, :2]), offset[:, 2]])


def body_increments(pose: Float[np.ndarray, "edge 3"]) -> Float[np.ndarray, "step 3"]:
    """Return the logarithm on SE(2) of each step of a path: twist times time [m, m, rad]."""
    turn = np.diff(pose[:, 2])
    middle = 0.5 * (pose[1:, 2] + pose[:-1, 2])
    arc = turned(-middle, np.diff(pose[:, :2], axis=0)) / np.sinc(turn / (2 * np.pi))[:, None]
    return np.column_stack([arc, turn])
