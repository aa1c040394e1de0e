"""What pictures compare: what camera and ammeters saw of a piece of a run, and the prediction."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from slipid.data.runs import Runs
from slipid.data.windows import windows
from slipid.fit import likelihood as lk
from slipid.infer import slip_curves as curves
from slipid.model import robot as model
from slipid.model.robot import Robot
from slipid.predict.slip_model import body_twist

STRAIGHT = 0.98
"""Part of the encoders' path that must be displacement for a piece to have a direction."""
LEAST_WAY = 0.05
"""Way of a wheel's rim below which its slip is noise [m]."""
TURNING = 0.5
"""Encoder yaw per distance from which on a piece is a turn [rad/m]."""


@dataclass(frozen=True, eq=False)
class MeasuredWindows:
    """Pieces of a few seconds; angles in the body frame, everything a mean over the piece.

    What is of a wheel is of all wheels of a drive: their mean, of loads and torques the sum.

    Attributes:
        group: index into `groups` of each piece.
        groups: (floor, load set-up), from the least slip to the most.
        speed: of the body as commanded, else by the encoders [m/s], to 0.01.
        heading: direction of travel by the encoders [deg], 0..360.
        straight: the piece has one direction and does not turn.
        slip, drift, yaw: measured by the camera against the encoders: length lost [1], sideways
            angle [deg], turn per encoder metre [deg/m].
        wheel_speed: [rad/s]; wheel_slip: measured, 1 - (rim speed over the floor) / (r w); nan for
            a wheel that hardly turned.
        sideways: speed across the wheel over its rim speed.
        share: of the weight on the wheel in motion.
        amps: measured current [A], None where not logged; amps_model: predicted.
        torque: predicted traction torque at the wheel [N m]; dragged: that of the drag along the
            drive, which the motor bears beside it.
        unsigned: the log has magnitudes of currents only.
    """

    group: np.ndarray
    groups: tuple[tuple[str, str], ...]
    speed: Float[np.ndarray, " piece"]
    heading: Float[np.ndarray, " piece"]
    straight: Bool[np.ndarray, " piece"]
    slip: Float[np.ndarray, " piece"]
    drift: Float[np.ndarray, " piece"]
    yaw: Float[np.ndarray, " piece"]
    wheel_speed: Float[np.ndarray, "piece drive"]
    wheel_slip: Float[np.ndarray, "piece drive"]
    sideways: Float[np.ndarray, "piece drive"]
    share: Float[np.ndarray, "piece drive"]
    amps: Float[np.ndarray, "piece drive"] | None
    amps_model: Float[np.ndarray, "piece drive"]
    torque: Float[np.ndarray, "piece drive"]
    dragged: Float[np.ndarray, "piece drive"]
    unsigned: bool


def measured_windows(robot: Robot, data: Runs, per_segment: int) -> MeasuredWindows:
    """Return segments of at most `per_segment` windows of 1.5 s, beside what the robot predicts."""
    radius, lag = float(robot.geometry.wheel_radius), float(robot.camera.lag)
    w = windows(data, radius, lag, per_segment=per_segment, longest=1.5)
    b, dt = lk.batch(w, robot), w.dt[..., None]
    shape = robot.geometry
    torque = np.asarray(shape.at_drives(curves.wheel_states(robot, b)[1]))
    amps, dragged = (np.asarray(x) for x in _borne(robot, b))
    inverse, frame = np.asarray(shape.pseudo_inverse()) * radius, shape.frame()
    free = (w.turn @ inverse.T).sum(axis=1)
    far = np.linalg.norm((w.turn @ inverse.T)[..., :2], axis=-1).sum(axis=1)
    true = (body_twist(w, robot) * dt).sum(axis=1)
    ahead = np.hypot(free[:, 0], free[:, 1])
    u = free[:, :2] / np.maximum(ahead, 1e-9)[:, None]
    along = (u * true[:, :2]).sum(axis=1)
    across = u[:, 0] * true[:, 1] - u[:, 1] * true[:, 0]
    time = w.dt.sum(axis=1)

    def whole(x: np.ndarray | Array) -> np.ndarray:
        return np.asarray((np.asarray(x) * dt).sum(axis=1) / time[:, None])

    def mean(of_wheels: np.ndarray | Array) -> np.ndarray:
        ones = jnp.ones(shape.wheels)
        return np.asarray(shape.at_drives(jnp.asarray(of_wheels)) / shape.at_drives(ones))

    rim = radius * w.turn.sum(axis=1)
    safe = np.where(np.abs(rim) > LEAST_WAY, rim, np.nan)
    pairs = list(zip(w.surface, w.load, strict=True))
    slip = 1.0 - along / np.maximum(ahead, 1e-9)
    floor = np.asarray(w.surface)
    lost = {name: float(np.median(slip[floor == name])) for name in w.surface}
    groups = tuple(sorted(set(pairs), key=lambda pair: (lost[pair[0]], *pair)))
    wanted = data.speed[w.run]
    return MeasuredWindows(
        group=np.array([groups.index(p) for p in pairs]),
        groups=groups,
        speed=np.round(np.where(np.isfinite(wanted), wanted, far / time), 2),
        heading=np.degrees(np.arctan2(u[:, 1], u[:, 0])) % 360.0,
        straight=(ahead > STRAIGHT * far) & (np.abs(free[:, 2]) < TURNING * far) & (far > 0.05),
        slip=slip,
        drift=np.degrees(np.arctan2(across, along)),
        yaw=np.degrees(true[:, 2] - free[:, 2]) / np.maximum(ahead, 1e-9),
        wheel_speed=whole(lk.wheel_speed(robot, b)),
        wheel_slip=1.0 - (true @ np.asarray(shape.forward()).T) / safe,
        sideways=mean(np.abs(true @ (frame.roll / frame.drive_share[:, None]).T)) / np.abs(safe),
        share=np.asarray(shape.at_drives(robot.body.load_share))[np.asarray(b.load)],
        amps=whole(w.current) if w.has_current else None,
        amps_model=whole(amps),
        torque=whole(torque),
        dragged=whole(dragged),
        unsigned=not w.current_is_signed,
    )


def by_heading(
    robot: Robot, surface: str, load: str, speed: float, heading: Float[np.ndarray, " heading"]
) -> Float[np.ndarray, "heading 3"]:
    """Predicted slip [1], sideways angle [deg] and turn [deg/m] of straight commands.

    Args:
        speed: of the body without slip [m/s].
        heading: of the command in the body frame [deg].
    """
    angle = np.radians(heading)
    wanted = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], -1) * speed
    forward = np.asarray(robot.geometry.forward()) / float(robot.geometry.wheel_radius)
    place = robot.surface_index(surface), robot.load_index(load)
    xi = np.asarray(_twists(robot, jnp.asarray(wanted @ forward.T), *map(jnp.asarray, place)))
    along = (xi * wanted)[:, :2].sum(axis=1) / speed
    across = (wanted[:, 0] * xi[:, 1] - wanted[:, 1] * xi[:, 0]) / speed
    return np.stack(
        [1 - along / speed, np.degrees(np.arctan2(across, along)), np.degrees(xi[:, 2]) / speed], -1
    )


@jax.jit
def _borne(robot: Robot, b: lk.Batch) -> tuple[Array, Array]:
    """Predicted currents [A], and torques of the drag along the drive [N m]."""
    motor_force = lk.predict(robot, b).motor_force
    force = robot.surfaces.friction[b.surface] * robot.body.mass * model.GRAVITY
    drag = robot.motor.rolling_drag * motor_force[..., 1]
    torque = robot.geometry.wheel_radius * force[:, None, None] * drag
    return lk.predicted_current(robot, b, motor_force), torque


@jax.jit
def _twists(robot: Robot, wheel_speed: Array, surface: Array, load: Array) -> Array:
    frame = robot.geometry.frame()
    wheels = robot.geometry.at_wheels(wheel_speed)
    return jax.vmap(lambda w: model.twist(robot, frame, w, surface, load))(wheels)
