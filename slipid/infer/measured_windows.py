"""Measured and predicted slip, currents and torques of segments of runs, as figures show them."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from slipid.data.runs import Runs
from slipid.data.windows import windows
from slipid.fitting import likelihood as lk
from slipid.infer import slip_curves as curves
from slipid.model.robot import GRAVITY, Robot, steady_states
from slipid.parameter import as_numbers
from slipid.predict.slip_model import body_twist

STRAIGHT = 0.98
"""Smallest ratio of displacement to path length, by encoders, of a segment that is straight."""
SHORTEST_PATH = 0.05
"""A wheel whose rim travels no farther than this in a segment has too noisy a slip to use [m]."""
TURNING = 0.5
"""Smallest yaw per path length, by encoders, at which a segment counts as a turn [rad/m]."""


@dataclass(frozen=True, eq=False)
class MeasuredWindows:
    """Means over segments of a few seconds, with angles in the body frame.

    The value of a drive is the mean over its wheels or, for loads and torques, their sum.

    Attributes:
        run: index of the run of each segment.
        group: index of each segment's floor and load set-up in `groups`.
        groups: pairs (floor, load set-up), sorted from the floor with the smallest median slip.
        speed: commanded speed of the body, or its speed by encoders if there is no command, rounded
            to 0.01 m/s [m/s].
        heading: direction of travel by encoders in the body frame, 0 to 360 [deg].
        straight: True if the body travels in one direction without a turn.
        slip: 1 - (camera's displacement along the encoders' direction) / (encoders' displacement)
            [1].
        drift: angle of the camera's displacement from that of the encoders, left positive [deg].
        yaw: yaw by camera less yaw by encoders, divided by the encoders' displacement [deg/m].
        wheel_speed: speed of the wheel [rad/s].
        wheel_slip: 1 - (speed over the floor) / (rim speed) [1]; NaN up to a rim travel of
            `SHORTEST_PATH`.
        sideways: ratio of the wheel's sideways rolling speed to its rim speed [1].
        share: fraction of the weight on the wheel at rest [1].
        amps: measured current [A]; None if currents were not logged.
        amps_model: predicted current [A].
        torque: predicted traction torque at the wheel [N m].
        drag_torque: predicted torque of the drag in the drive direction, against which the motor
            works in addition to traction [N m].
        unsigned: True if currents were logged as magnitudes.
    """

    run: np.ndarray
    group: np.ndarray
    groups: tuple[tuple[str, str], ...]
    speed: Float[np.ndarray, " segment"]
    heading: Float[np.ndarray, " segment"]
    straight: Bool[np.ndarray, " segment"]
    slip: Float[np.ndarray, " segment"]
    drift: Float[np.ndarray, " segment"]
    yaw: Float[np.ndarray, " segment"]
    wheel_speed: Float[np.ndarray, "segment drive"]
    wheel_slip: Float[np.ndarray, "segment drive"]
    sideways: Float[np.ndarray, "segment drive"]
    share: Float[np.ndarray, "segment drive"]
    amps: Float[np.ndarray, "segment drive"] | None
    amps_model: Float[np.ndarray, "segment drive"]
    torque: Float[np.ndarray, "segment drive"]
    drag_torque: Float[np.ndarray, "segment drive"]
    unsigned: bool


def measured_windows(robot: Robot, data: Runs, per_segment: int) -> MeasuredWindows:
    """Return measured and predicted means over segments of at most `per_segment` windows.

    A window lasts at most 1.5 s; predictions are those of `robot`.
    """
    radius, lag = float(robot.geometry.wheel_radius), float(robot.camera.lag)
    w = windows(data, radius, lag, per_segment=per_segment, longest=1.5)
    b, dt = lk.batch(w, robot), w.dt[..., None]
    shape = robot.geometry
    torque = np.asarray(shape.at_drives(as_numbers(curves.wheel_states(robot, b)[1])))
    amps, drag_torque = (np.asarray(x) for x in _currents_and_drag(robot, b))
    inverse, frame = np.asarray(shape.pseudo_inverse()) * radius, shape.frame()
    encoder = (w.turn @ inverse.T).sum(axis=1)
    length = np.linalg.norm((w.turn @ inverse.T)[..., :2], axis=-1).sum(axis=1)
    true = (body_twist(w, robot) * dt).sum(axis=1)
    ahead = np.hypot(encoder[:, 0], encoder[:, 1])
    u = encoder[:, :2] / np.maximum(ahead, 1e-9)[:, None]
    along = (u * true[:, :2]).sum(axis=1)
    across = u[:, 0] * true[:, 1] - u[:, 1] * true[:, 0]
    time = w.dt.sum(axis=1)

    def whole(x: np.ndarray | Array) -> np.ndarray:
        return np.asarray((np.asarray(x) * dt).sum(axis=1) / time[:, None])

    def mean(of_wheels: np.ndarray | Array) -> np.ndarray:
        ones = jnp.ones(shape.wheels)
        return np.asarray(shape.at_drives(jnp.asarray(of_wheels)) / shape.at_drives(ones))

    rim = radius * w.turn.sum(axis=1)
    safe = np.where(np.abs(rim) > SHORTEST_PATH, rim, np.nan)
    pairs = list(zip(w.surface, w.load, strict=True))
    slip = 1.0 - along / np.maximum(ahead, 1e-9)
    floor = np.asarray(w.surface)
    lost = {name: float(np.median(slip[floor == name])) for name in w.surface}
    groups = tuple(sorted(set(pairs), key=lambda pair: (lost[pair[0]], *pair)))
    wanted = data.speed[w.run]
    return MeasuredWindows(
        run=w.run,
        group=np.array([groups.index(p) for p in pairs]),
        groups=groups,
        speed=np.round(np.where(np.isfinite(wanted), wanted, length / time), 2),
        heading=np.degrees(np.arctan2(u[:, 1], u[:, 0])) % 360.0,
        straight=(ahead > STRAIGHT * length)
        & (np.abs(encoder[:, 2]) < TURNING * length)
        & (length > 0.05),
        slip=slip,
        drift=np.degrees(np.arctan2(across, along)),
        yaw=np.degrees(true[:, 2] - encoder[:, 2]) / np.maximum(ahead, 1e-9),
        wheel_speed=whole(lk.wheel_speed(robot, b)),
        wheel_slip=1.0 - (true @ np.asarray(shape.forward()).T) / safe,
        sideways=mean(np.abs(true @ (frame.roll / frame.drive_share[:, None]).T)) / np.abs(safe),
        share=np.asarray(shape.at_drives(robot.body.load_share))[np.asarray(b.load)],
        amps=whole(w.current) if w.has_current else None,
        amps_model=whole(amps),
        torque=whole(torque),
        drag_torque=whole(drag_torque),
        unsigned=not w.current_is_signed,
    )


def driving_torque(robot: Robot, measured: MeasuredWindows) -> np.ndarray:
    """Return the traction torque of each drive per wheel, positive along the wheel's motion [N m].

    The torque follows from the measured current; if currents were not logged, it is the predicted
    one. A current that is logged as a magnitude gets the sign of the prediction.
    """
    turning, wheels = np.sign(measured.wheel_speed), robot.geometry.wheels / robot.geometry.drives
    if measured.amps is None:
        return measured.torque * turning / wheels
    speed = np.abs(measured.wheel_speed)
    amps = measured.amps * turning
    if measured.unsigned:
        driven = (
            (measured.torque + measured.drag_torque) * turning
            + np.asarray(robot.motor.friction(jnp.asarray(speed)))
        ) >= 0
        amps = (measured.amps - float(robot.motor.current_offset)) * np.where(driven, 1.0, -1.0)
    torque = np.asarray(robot.motor.torque(jnp.asarray(amps), jnp.asarray(speed)))
    return (torque - measured.drag_torque * turning) / wheels


def by_heading(
    robot: Robot, surface: str, load: str, speed: float, heading: Float[np.ndarray, " heading"]
) -> Float[np.ndarray, "heading 3"]:
    """Return predicted slip [1], drift [deg] and yaw [deg/m] for commands of straight motion.

    Args:
        robot: robot with its contact law.
        surface: name of the floor.
        load: name of the load set-up.
        speed: speed of the body without slip [m/s].
        heading: headings of the command in the body frame [deg].
    """
    angle = np.radians(heading)
    wanted = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], -1) * speed
    forward = np.asarray(robot.geometry.forward()) / float(robot.geometry.wheel_radius)
    place = robot.surface_index(surface), robot.load_index(load)
    xi = steady_states(robot, wanted @ forward.T, *place).twist
    along = (xi * wanted)[:, :2].sum(axis=1) / speed
    across = (wanted[:, 0] * xi[:, 1] - wanted[:, 1] * xi[:, 0]) / speed
    return np.stack(
        [1 - along / speed, np.degrees(np.arctan2(across, along)), np.degrees(xi[:, 2]) / speed], -1
    )


@jax.jit
def _currents_and_drag(robot: Robot, b: lk.Batch) -> tuple[Array, Array]:
    """Return predicted currents [A], and torques of the drag in the drive direction [N m]."""
    motor_force = lk.predict(robot, b).motor_force
    force = robot.surfaces.friction[b.surface] * robot.body.mass_in(b.load) * GRAVITY
    drag = robot.motor.rolling_drag * motor_force[..., 1]
    torque = robot.geometry.wheel_radius * force[:, None, None] * drag
    return lk.predicted_current(robot, b, motor_force), torque
