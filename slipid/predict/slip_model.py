"""Common interface of slip models, and the runs that they are fitted to and predict.

A slip model is fitted to runs with poses, and then predicts runs from the robot's own measurements:
wheels, currents, commands, perhaps a gyro. All models get the same steps of the same runs.
"""

import abc
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from slipid.data.wheel_signals import body_steps
from slipid.data.windows import Windows
from slipid.fitting.likelihood import indices, marker_increments, measured_increments
from slipid.model.geometry import Geometry
from slipid.model.kinematics import Steering, nominal_steering, rolled
from slipid.model.robot import Robot

Increments = Float[np.ndarray, "segment window 3"]


def as_increments(twist: np.ndarray, w: Windows, robot: Robot) -> Increments:
    """Return marker increments [m, m, rad] of body twists (segment, window, 3)."""
    session = jnp.asarray(indices(robot.session_index, w.session))
    return np.asarray(marker_increments(robot, jnp.asarray(twist), jnp.asarray(w.dt), session))


def body_twist(w: Windows, robot: Robot) -> np.ndarray:
    """Return the measured body twist of every window [m/s, m/s, rad/s], from marker poses.

    The effects of the marker's yaw and position on the body are removed.
    """
    moved = np.asarray(measured_increments(robot, jnp.asarray(w.pose)))
    yaw = moved[..., 2]
    yaws = {s: float(robot.camera.yaw(robot.session_index(s))) for s in set(w.session)}
    psi = np.array([yaws[s] for s in w.session])[:, None]
    chord = turned(psi, moved[..., :2])
    place = np.broadcast_to(np.asarray(robot.camera.marker_place), chord.shape)
    chord -= turned(yaw, place) - place
    # The body moves on an arc with chord = arc sinc(yaw / 2), at half the yaw to its start heading.
    arc = turned(-0.5 * yaw, chord) / np.sinc(yaw / (2 * np.pi))[..., None]
    return np.concatenate([arc, yaw[..., None]], -1) / w.dt[..., None]


def body_poses(
    robot: Robot, session: Sequence[str], marker: Float[np.ndarray, "run edge 3"]
) -> Float[np.ndarray, "run edge 3"]:
    """Return the poses of the body, given those of its marker in runs of the named sessions.

    Both are in true metres.
    """
    yaws = {s: float(robot.camera.yaw(robot.session_index(s))) for s in set(session)}
    out = marker.copy()
    out[..., 2] -= np.array([yaws[s] for s in session])[:, None]
    place = np.broadcast_to(np.asarray(robot.camera.marker_place), out[..., :2].shape)
    out[..., :2] -= turned(out[..., 2], place)
    return out


def setups(w: Windows) -> list[str]:
    """Return the floor and load set-up of every segment as `floor@load`."""
    return [f"{floor}@{load}" for floor, load in zip(w.surface, w.load, strict=True)]


def turned(angle: np.ndarray | float, v: np.ndarray) -> np.ndarray:
    """Return plane vectors (..., 2), each rotated by its angle (...)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * v[..., 0] - s * v[..., 1], s * v[..., 0] + c * v[..., 1]], -1)


def turned_left(v: np.ndarray) -> np.ndarray:
    """Return plane vectors (..., 2), each rotated by 90 degrees counter-clockwise."""
    return np.stack([-v[..., 1], v[..., 0]], -1)


Channel = Literal["current", "gyro", "command", "twist"]
"""Requirement of a model in addition to the encoders.

`current`, `gyro` and `command` are logged channels; `twist` stands for wheels whose rotations
determine the body's twist."""
Aim = Literal["end", "energy"]
"""Quantity that a model predicts for a run: its end pose, or its electric energy."""
Numbers = Float[np.ndarray, " step"]
Twists = Float[np.ndarray, "step 3"]
"""Body twist of each step: ahead [m/s], to the left [m/s], yaw rate [rad/s]."""
TRIES = 4
"""Largest number of settings that any model may try in its inner cross-validation."""
WINDOW_S = 0.5
"""Length of the windows on which models are trained and twists are judged [s]."""
SHAFT_W0 = 3.0
"""Motor shaft speed w0 below which `RunSignals.torque` reduces M = U I / w [rad/s].

Without this reduction, M would be infinite at rest."""


@dataclass(frozen=True, eq=False)
class RobotSpec:
    """Properties of a robot that are known before a slip model is fitted.

    A drive is a motor with all the wheels that it turns: one wheel, or a side of a skid steer.

    Attributes:
        forward: matrix J that maps the body twist to the rim speed of each drive [m/s].
        back: pseudo-inverse J^+ that maps the drives' rim speeds to the body twist by least
            squares, as if no wheel slipped.
        wheel_radius, base_radius: radius of the wheels, and base radius of the geometry [m].
        gear_ratio: motor turns per wheel turn.
        resistance, back_emf: constants of the motor from its datasheet [ohm], [V s/rad].
        mass: mass of the robot [kg].
        determines_twist: True if the drives determine the body's twist; those of a skid steer do
            not.
        steering: steering of the config if a wheel is steered; else None.
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
    steering: Steering | None = None

    @classmethod
    def of(cls, robot: Robot) -> "RobotSpec":
        """Return the properties of a robot from its geometry, motor and body."""
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
            steering=nominal_steering(shape),
        )

    def of_shape(self, shape: Geometry) -> "RobotSpec":
        """Return the same robot, with encoders converted to twists by another geometry."""
        back = np.asarray(shape.pseudo_inverse())
        return replace(self, back=back, wheel_radius=float(shape.wheel_radius))

    @property
    def size(self) -> Float[np.ndarray, "3"]:
        """Weights (1, 1, base radius [m]) that convert a twist to three speeds [m/s]."""
        return np.array([1.0, 1.0, self.base_radius])


@dataclass(frozen=True, eq=False)
class RunSignals:
    """Measurements of a robot during a run, in steps of a tenth to half a second.

    Attributes:
        name: name of the run.
        dt: length of each step [s].
        turn: rotation of each drive's wheels in the step [rad]; a robot that steers has two more
            columns, see `slipid.model.kinematics.rolled`.
        current: mean current of each motor [A], signed along its wheel's forward direction if
            `current_is_signed`, else its magnitude; None if it was not logged.
        gyro: mean yaw rate from the gyro [rad/s], or None.
        command: commanded twist [m/s, m/s, rad/s], or None.
        floor: name of the floor; None if a model has to infer it.
        load: name of the load set-up, which is known to the robot.
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
        """Return the body twist without slip, from the encoders only."""
        matrix = spec.wheel_radius * spec.back
        return np.asarray(rolled(matrix, self.turn, spec.steering) / self.dt[:, None])

    def along(self, spec: RobotSpec) -> Float[np.ndarray, "step drive"]:
        """Return the current along the wheel's motion [A]: positive if the motor drives the wheel.

        The current of an unsigned ammeter is positive, as if the motor always drove the wheel.

        Raises:
            ValueError: no current was logged.
        """
        if self.current is None:
            raise ValueError(f"{self.name}: no current was logged; this model needs currents")
        signed = self.current_is_signed
        return np.asarray(self.current * np.sign(self.speed) if signed else self.current)

    def torque(self, spec: RobotSpec, rest: float = SHAFT_W0) -> Float[np.ndarray, "step drive"]:
        """Return the torque characterising variable M of the 2021 paper (docs/theory.md) [N m].

        M = U I / w with the voltage U = C_e w + R I, the current I and the shaft speed w. So that M
        is finite at rest, it is computed as C_e I + R I^2 w / (w^2 + w0^2) with w0 = `rest`. M is
        positive if the motor drives the wheel.
        """
        amps, shaft = self.along(spec), np.abs(spec.gear_ratio * self.speed)
        heat = spec.resistance * amps**2 * shaft / (shaft**2 + rest**2)
        return np.asarray(spec.back_emf * amps + heat)

    def power(self, spec: RobotSpec) -> Numbers:
        """Return the electric power of all motors [W], from currents and the motor's datasheet.

        P = sum_i (R I_i + C_e |w_i|) I_i
        """
        amps, shaft = self.along(spec), np.abs(spec.gear_ratio * self.speed)
        return np.asarray(((spec.resistance * amps + spec.back_emf * shaft) * amps).sum(1))

    def windowed(self, seconds: float = WINDOW_S) -> "RunSignals":
        """Return the same run with neighbouring steps joined to steps of about `seconds` [s]."""
        first = groups(self.dt, seconds)

        def mean(x: np.ndarray | None) -> np.ndarray | None:
            return None if x is None else group_means(x, self.dt, first)

        return replace(
            self,
            dt=np.add.reduceat(self.dt, first),
            turn=np.add.reduceat(self.turn, first),
            current=mean(self.current),
            gyro=mean(self.gyro),
            command=mean(self.command),
        )


@dataclass(frozen=True, eq=False)
class Run:
    """A run with the measured poses of the body, for training and judging models.

    Attributes:
        signals: measurements of the robot; `signals.floor` is None if models do not know the floor.
        pose: x, y [m] and heading [rad] of the body at the edges of the steps, in true metres.
        floor: name of the floor of the run.
        load: name of the load set-up.
        heading: commanded direction of travel [rad], nan if unknown.
        speed: commanded speed [m/s], nan if unknown.
    """

    signals: RunSignals
    pose: Float[np.ndarray, "edge 3"]
    floor: str
    load: str = "as_built"
    heading: float = float("nan")
    speed: float = float("nan")

    @property
    def twist(self) -> Twists:
        """Constant body twist of every step that connects its poses (exact SE(2))."""
        return body_increments(self.pose) / self.signals.dt[:, None]

    def windowed(self, seconds: float = WINDOW_S) -> "Run":
        """Return the same run with neighbouring steps joined to steps of about `seconds` [s]."""
        edges = np.append(groups(self.signals.dt, seconds), len(self.signals))
        return replace(self, signals=self.signals.windowed(seconds), pose=self.pose[edges])

    def with_floor(self, floor: bool) -> "Run":
        """Return the same run, with or without the name of its floor in `signals`."""
        return replace(self, signals=replace(self.signals, floor=self.floor if floor else None))


@dataclass(frozen=True, eq=False)
class PredictedRun:
    """Prediction of a run by a slip model.

    Attributes:
        path: pose at every edge of the steps, relative to the pose at the start [m, m, rad].
        end_covariance: scale matrix of the Student t of the end position, relative to the start
            [m^2]; None for a model without uncertainty.
        freedom: degrees of freedom of that Student t; infinite for a Gaussian, whose scale matrix
            is its covariance.
        slipping: score of each step that increases with the confidence that the robot slips; None
            to derive it from the difference of predicted and encoder twists.
        floors: probability of each floor in every step, keyed by floor; None for a model that does
            not infer floors.
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
        name: name of the model in tables.
        needs: channels that the model requires.
        aim: predicted quantity by whose errors settings are selected.
    """

    name: str
    needs: frozenset[Channel] = field(default=frozenset(), kw_only=True)
    aim: Aim = field(default="end", kw_only=True)

    def candidates(self) -> Sequence["SlipModel"]:
        """Return at most `TRIES` models, differing in settings; cross-validation selects one."""
        return (self,)

    @abc.abstractmethod
    def fit(self, runs: Sequence[Run], spec: RobotSpec) -> Self:
        """Return the model fitted to runs."""

    @abc.abstractmethod
    def predict(self, runs: Sequence[RunSignals], spec: RobotSpec) -> list[PredictedRun]:
        """Return predictions of runs that were not fitted, from their signals only."""

    @property
    @abc.abstractmethod
    def numbers(self) -> int:
        """Number of fitted coefficients."""


def groups(dt: Float[np.ndarray, " step"], seconds: float) -> np.ndarray:
    """Return the index of the first step of every group of steps, about `seconds` [s] long."""
    count = max(1, round(float(dt.sum()) / seconds))
    number = np.minimum((np.cumsum(dt) - 0.5 * dt) / dt.sum() * count, count - 1).astype(int)
    return np.flatnonzero(np.diff(number, prepend=-1))


def group_means(
    values: Float[np.ndarray, "step *any"],
    dt: Float[np.ndarray, " step"],
    first: Int[np.ndarray, " group"],
) -> Float[np.ndarray, "group *any"]:
    """Return means over groups of steps, which begin at `first`, weighted by the steps' length."""
    weight = dt.reshape(-1, *[1] * (values.ndim - 1))
    return np.asarray(np.add.reduceat(values * weight, first) / np.add.reduceat(weight, first))


def path_of(twist: Twists, dt: Float[np.ndarray, " step"]) -> Float[np.ndarray, "edge 3"]:
    """Return the poses of a path from the origin, with a constant twist per step (exact SE(2))."""
    heading = np.concatenate([[0.0], np.cumsum(twist[:, 2] * dt)])
    middle = 0.5 * (heading[1:] + heading[:-1])
    # Each step is an arc with chord = arc sinc(yaw / 2), at half the yaw to its start heading.
    chord = np.sinc(np.diff(heading) / (2 * np.pi)) * dt
    step = turned(middle, twist[:, :2] * chord[:, None])
    place = np.concatenate([np.zeros((1, 2)), np.cumsum(step, axis=0)])
    return np.column_stack([place, heading])


def relative_to_start(path: Float[np.ndarray, "edge 3"]) -> Float[np.ndarray, "edge 3"]:
    """Return the poses of a path in the frame of its first pose."""
    offset = path - path[0]
    return np.column_stack([turned(-path[0, 2], offset[:, :2]), offset[:, 2]])


def body_increments(pose: Float[np.ndarray, "edge 3"]) -> Float[np.ndarray, "step 3"]:
    """Return the body twist times the time of each step of a path (SE(2) logarithm) [m, m, rad]."""
    increments = body_steps(pose)
    increments[:, :2] /= np.sinc(increments[:, 2:] / (2 * np.pi))  # arcs from chords
    return increments
