"""Figures of single wheels: slip over torque, and motor current over predicted traction."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure

from slipid.infer.measured_windows import MeasuredWindows, driving_torque
from slipid.infer.result import Fit
from slipid.infer.slip_curves import slip_sentence
from slipid.model import contact_law as law
from slipid.model.robot import GRAVITY, Robot
from slipid.plots import drawing
from slipid.plots.motion import named

SIDEWAYS_COLOUR = "#35B779"
"""Colour of the curve and the dots of wheels whose sideways speed equals their rim speed."""
AT_REST = 0.05
"""Largest ratio of a wheel's speed to that of the fastest wheel at which it counts as at rest."""
TOO_SLOW = 0.3
"""Largest ratio of a wheel's speed to that of the fastest wheel at which its slip is too uncertain
to be drawn."""


def curve_figure(fit: Fit, measured: MeasuredWindows) -> Figure:
    """Draw the fitted curve of slip over torque on every floor, with its 90 % band.

    Dots are the measured slips of all wheels.
    """
    floors = list(dict.fromkeys(floor for floor, _ in measured.groups))
    each = {floor: _slips(fit.robot, measured, floor) for floor in floors}
    title = slip_sentence({floor: (d.torque, d.slip) for floor, d in each.items()})
    rolls = not all(fit.robot.geometry.grips)
    made, axes = drawing.panels(len(floors), 3.7, 3.9, title)
    drawn = None
    for ax, floor in zip(axes, floors, strict=True):
        drawn = _cloud(ax, each[floor], rolls) or drawn
        (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
        _curve(ax, fit, floor)
        ax.set(xlim=(min(0.0, left), right), ylim=(min(0.0, bottom), top))
        of_floor = fit.selection.get(floor)
        unused = of_floor is not None and of_floor.model != "contact"
        ax.set_title(f"{floor}: force balance, not selected" if unused else floor)
        torque = "predicted" if measured.amps is None else "from current"
        ax.set(xlabel=f"wheel torque {torque}, at even load [N m]", ylabel="slip of the wheel [1]")
    made.legend(
        *axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False
    )
    if drawn is not None and rolls:
        bar = made.colorbar(drawn, ax=axes, pad=0.01, aspect=40, extend="max")
        bar.set_label("dots: sideways over rim speed [1]")
    return made


class _Slips(NamedTuple):
    """Torque [N m], scaled to an even load, slip and sideways over rim speed of turning wheels."""

    torque: np.ndarray
    slip: np.ndarray
    sideways: np.ndarray


def _slips(robot: Robot, measured: MeasuredWindows, floor: str) -> _Slips:
    """Return the measured slips of all wheels that turn on a floor."""
    mine = np.array([measured.groups[g][0] == floor for g in measured.group])
    fastest = np.abs(measured.wheel_speed).max(axis=1, keepdims=True)
    turns = (np.abs(measured.wheel_speed) > TOO_SLOW * fastest) & mine[:, None]
    turns &= np.isfinite(measured.wheel_slip)
    torque = driving_torque(robot, measured) / (measured.share * measured.share.shape[1])
    return _Slips(torque[turns], measured.wheel_slip[turns], measured.sideways[turns])


def _cloud(ax: Axes, dots: _Slips, rolls: bool) -> PathCollection | None:
    """Draw the measured slip of every turning wheel over its torque; return None for no wheel.

    Colours show the sideways motion of wheels that roll sideways.
    """
    if not len(dots.slip):
        return None
    if not rolls:
        return ax.scatter(dots.torque, dots.slip, 9, drawing.SHADE, lw=0, alpha=0.6)
    order = np.argsort(-dots.sideways)
    colour = np.minimum(dots.sideways, 2.0)[order]
    x, y = dots.torque[order], dots.slip[order]
    return ax.scatter(x, y, 7, colour, lw=0, alpha=0.6, cmap="viridis_r", vmin=0.0, vmax=2.0)


def _curve(ax: Axes, fit: Fit, floor: str) -> None:
    """Draw the slip curve of a floor with its band, and the curve of a wheel that rolls sideways.

    Curves are dashed above the largest torque of the runs.
    """
    curve = fit.curves[floor]
    speed, share = curve.wheel_speed, curve.load_share
    slip = np.linspace(0.0, 1.0, 201)
    shown = [(0.0, drawing.ORANGE, "predicted: rolls straight, 90 % band")]
    if not all(fit.robot.geometry.grips):
        shown.insert(0, (1.0, SIDEWAYS_COLOUR, "predicted: sideways as fast as ahead"))
    for sideways, colour, label in shown:
        torque = wheel_curve(fit.robot, floor, slip, sideways, speed, share)
        within = torque <= curve.torque_nm[-1]
        ax.plot(torque, slip, "--", color=colour, lw=1.2)
        ax.plot(torque[within], slip[within], color=colour, lw=2, label=label)
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
    """Return the torque of a wheel at given slips, while it also rolls sideways [N m].

    Args:
        robot: robot with its contact law.
        floor: name of the floor.
        slip: slip of the wheel along its drive direction [1].
        sideways: ratio of the wheel's sideways speed to its rim speed [1].
        wheel_speed: speed of the wheel [rad/s].
        share: fraction of the weight on the wheel.

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


def current_figure(measured: MeasuredWindows) -> Figure | None:
    """Draw measured current over predicted traction, by wheel and by floor and load set-up.

    Returns:
        None if currents were not logged.
    """
    if measured.amps is None:
        return None
    wheels, groups = measured.amps.shape[1], measured.groups
    title = "Motor currents rise with the traction that the force balance predicts for each wheel"
    made = drawing.figure(1.4 + 2.9 * max(len(groups), 2), 0.9 + 2.5 * wheels, title)
    axes = made.subplots(wheels, len(groups), sharex="col", sharey=True, squeeze=False)
    top = float(np.quantile(np.abs(measured.wheel_speed), 0.98))
    drawn = None
    for column, (surface, load) in enumerate(groups):
        mine = measured.group == column
        for wheel in range(wheels):
            ax = axes[wheel, column]
            drawn = _amps(ax, measured, mine, wheel, top)
            drawing.plain(ax)
            if column == 0:
                ax.set_ylabel(f"wheel {wheel + 1}\ncurrent [A]")
        axes[0, column].set_title(named(surface, load, groups))
        axes[-1, column].set_xlabel("predicted traction torque\nalong the wheel's motion [N m]")
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
    ax: Axes, measured: MeasuredWindows, mine: np.ndarray, wheel: int, top: float
) -> PathCollection:
    assert measured.amps is not None
    # omit wheels at rest: their gear holds them, which the motor model does not describe
    speed, fastest = measured.wheel_speed[:, wheel], np.abs(measured.wheel_speed).max(axis=1)
    mine = mine & (np.abs(speed) > AT_REST * fastest)
    speed = speed[mine]
    torque = measured.torque[mine, wheel] * np.sign(speed)
    amps = measured.amps[mine, wheel]
    made = ax.scatter(torque, amps, 8, np.abs(speed), lw=0, cmap="viridis_r", vmin=0, vmax=top)
    order = np.argsort(torque)
    ax.plot(torque[order], measured.amps_model[mine, wheel][order], ".", color=drawing.ORANGE, ms=2)
    return made
