"""Pictures of single wheels: slip against torque, current against predicted traction."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure

from slipid.infer.result import Fit
from slipid.model import contact_law as law
from slipid.model.robot import GRAVITY, Robot
from slipid.plots import drawing
from slipid.plots.measured_windows import MeasuredWindows
from slipid.plots.motion import named

DRIFTS = "#35B779"
"""Colour of a wheel that rolls sideways as fast as it turns, as in the colour scale of the dots."""
RESTS = 0.05
"""A wheel slower than this part of the fastest one stands."""
TURNS = 0.3
"""A wheel that turns slower than this part of the fastest one says little of its slip."""


def curve_figure(fit: Fit, seen: MeasuredWindows) -> Figure:
    """Slip over torque of every floor with its 90 % band, over what was seen of every wheel."""
    floors = list(dict.fromkeys(floor for floor, _ in seen.groups))
    measured = seen.amps is not None
    title = "A wheel that pushes harder slips more, and more still when it rolls sideways"
    made, axes = drawing.panels(len(floors), 3.7, 3.9, title)
    drawn = None
    for ax, floor in zip(axes, floors, strict=True):
        drawn = _cloud(ax, fit.robot, seen, floor) or drawn
        (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
        _curve(ax, fit, floor)
        ax.set(xlim=(min(0.0, left), right), ylim=(min(0.0, bottom), top))
        ax.set_title(floor)
        torque = "from current" if measured else "predicted"
        ax.set(xlabel=f"wheel torque {torque}, at even load [N m]", ylabel="slip of the wheel [1]")
    made.legend(
        *axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False
    )
    if drawn is not None:
        bar = made.colorbar(drawn, ax=axes, pad=0.01, aspect=40, extend="max")
        bar.set_label("dots: sideways over rim speed [1]")
    return made


def _cloud(ax: Axes, robot: Robot, seen: MeasuredWindows, floor: str) -> PathCollection | None:
    """Measured slip of every driven wheel over its torque, scaled to an even load."""
    mine = np.array([seen.groups[g][0] == floor for g in seen.group])
    fastest = np.abs(seen.wheel_speed).max(axis=1, keepdims=True)
    turns = (np.abs(seen.wheel_speed) > TURNS * fastest) & mine[:, None]
    turns &= np.isfinite(seen.wheel_slip)
    if not turns.any():
        return None
    torque = driving_torque(robot, seen) / (seen.share * seen.share.shape[1])
    order = np.argsort(-seen.sideways[turns])
    x, y = torque[turns][order], seen.wheel_slip[turns][order]
    colour = np.minimum(seen.sideways[turns], 2.0)[order]
    return ax.scatter(x, y, 7, colour, lw=0, alpha=0.6, cmap="viridis_r", vmin=0.0, vmax=2.0)


def driving_torque(robot: Robot, seen: MeasuredWindows) -> np.ndarray:
    """Torque along a wheel's turning [N m]: from the current, or predicted where none is logged.

    Wheels that share a drive share its torque.

    A log of magnitudes hides the sign of a current; it is taken from the prediction.
    """
    turning, wheels = np.sign(seen.wheel_speed), robot.geometry.wheels / robot.geometry.drives
    if seen.amps is None:
        return seen.torque * turning / wheels
    speed = np.abs(seen.wheel_speed)
    amps = seen.amps * turning
    if seen.unsigned:
        driven = (
            (seen.torque + seen.dragged) * turning
            + np.asarray(robot.motor.friction(jnp.asarray(speed)))
        ) >= 0
        amps = (seen.amps - float(robot.motor.current_offset)) * np.where(driven, 1.0, -1.0)
    torque = np.asarray(robot.motor.torque(jnp.asarray(amps), jnp.asarray(speed)))
    return (torque - seen.dragged * turning) / wheels


def _curve(ax: Axes, fit: Fit, floor: str) -> None:
    """The curve with its band over the torques seen, dashed beyond, and of a wheel that drifts."""
    curve = fit.curves[floor]
    speed, share = curve.wheel_speed, curve.load_share
    slip = np.linspace(0.0, 1.0, 201)
    for sideways, colour, label in (
        (1.0, DRIFTS, "predicted: as fast sideways as ahead"),
        (0.0, drawing.ORANGE, "predicted: rolls straight, 90 % band"),
    ):
        torque = wheel_curve(fit.robot, floor, slip, sideways, speed, share)
        seen = torque <= curve.torque_nm[-1]
        ax.plot(torque, slip, "--", color=colour, lw=1.2)
        ax.plot(torque[seen], slip[seen], color=colour, lw=2, label=label)
    low, high = curve.slip_lo, curve.slip_hi
    ax.fill_between(curve.torque_nm, low, high, color=drawing.ORANGE, alpha=0.35, lw=0)


def wheel_curve(
    robot: Robot,
    floor: str,
    slip: Float[np.ndarray, " slip"],
    sideways: float,
    wheel_speed: float,
    share: float,
) -> Float[np.ndarray, " slip"]:
    """Torque [N m] of a wheel that slips while it also rolls sideways.

    Args:
        slip: of the wheel along its drive direction [1].
        sideways: speed across the wheel over its rim speed [1].
        wheel_speed: [rad/s].
        share: of the weight on this wheel.

    Source: `slipid.model.contact_law`.
    """
    frame, surface = robot.geometry.frame(), robot.surfaces.at(robot.surface_index(floor))
    drive_share, roller_share = frame.drive_share[0], frame.roller_share[0]
    rim = frame.radius * wheel_speed
    along, roll = (
        rim * drive_share * (1 - jnp.asarray(slip)),
        rim * (drive_share * sideways - roller_share),
    )
    relative = jnp.asarray(share * robot.geometry.wheels)
    surface, onset = law.sideways(law.at_load(surface, relative), frame.grip[0])
    grip = frame.grip[0] if frame.ordinary else None
    forces = law.wheel_forces(along, roll, rim, drive_share, onset, surface, grip)
    motor_force = forces.motor_force(drive_share, roller_share)
    weight = robot.body.mass * GRAVITY * law.load_force(jnp.asarray(share), surface)
    return np.asarray(frame.radius * weight * motor_force)


def current_figure(seen: MeasuredWindows) -> Figure | None:
    """Measured current against predicted traction, a row per wheel, a column per floor and load."""
    if seen.amps is None:
        return None
    wheels, groups = seen.amps.shape[1], seen.groups
    title = "Motor currents rise with the traction that the force balance predicts for each wheel"
    made = drawing.figure(1.4 + 2.9 * max(len(groups), 2), 0.9 + 2.5 * wheels, title)
    axes = made.subplots(wheels, len(groups), sharex="col", sharey=True, squeeze=False)
    top = float(np.quantile(np.abs(seen.wheel_speed), 0.98))
    drawn = None
    for column, (surface, load) in enumerate(groups):
        mine = seen.group == column
        for wheel in range(wheels):
            ax = axes[wheel, column]
            drawn = _amps(ax, seen, mine, wheel, top)
            drawing.plain(ax)
            if column == 0:
                ax.set_ylabel(f"wheel {wheel + 1}\ncurrent [A]")
        axes[0, column].set_title(named(surface, load, groups))
        axes[-1, column].set_xlabel("predicted traction\nalong the turning [N m]")
    assert drawn is not None
    bar = made.colorbar(drawn, ax=axes, pad=0.01, aspect=50)
    bar.set_label("wheel speed [rad/s]")
    blank = axes[0, 0]
    handles = [
        *blank.plot([], [], ".", color="#2a788e", ms=6, label="measured, coloured by speed"),
        *blank.plot([], [], ".", color=drawing.ORANGE, ms=4, label="predicted by the fitted motor"),
    ]
    made.legend(handles=handles, loc="outside lower center", ncols=2, frameon=False)
    return made


def _amps(
    ax: Axes, seen: MeasuredWindows, mine: np.ndarray, wheel: int, top: float
) -> PathCollection:
    assert seen.amps is not None
    # a wheel at rest is held by its gear, which the motor model does not claim to know
    speed, fastest = seen.wheel_speed[:, wheel], np.abs(seen.wheel_speed).max(axis=1)
    mine = mine & (np.abs(speed) > RESTS * fastest)
    speed = speed[mine]
    torque = seen.torque[mine, wheel] * np.sign(speed)
    amps = seen.amps[mine, wheel]
    made = ax.scatter(torque, amps, 8, np.abs(speed), lw=0, cmap="viridis_r", vmin=0, vmax=top)
    order = np.argsort(torque)
    ax.plot(torque[order], seen.amps_model[mine, wheel][order], ".", color=drawing.ORANGE, ms=2)
    return made
