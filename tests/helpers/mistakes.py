"""Mistakes that people make in configs and logs, on purpose, and what they are to be called."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import numpy as np

from slipid.data.runs import Runs
from slipid.model.geometry import Geometry, general
from tests.helpers.plain_robot import GEAR, Drive, Raw, as_runs

Raws = list[Raw]


@dataclass(frozen=True)
class Mistake:
    """A mistake in every run, or in what is declared.

    Attributes:
        name: for people.
        kinds: names of findings that are right.
        says: words that the remedy must have.
        runs: what it does to the runs.
        declared: what it does to the geometry.
    """

    name: str
    kinds: tuple[str, ...]
    says: str
    runs: Callable[[Raws], Raws] = lambda raws: raws
    declared: Callable[[Drive], Geometry] = lambda drive: drive.geometry

    def made(self, raws: Raws, drive: Drive) -> tuple[Runs, Geometry]:
        return as_runs(self.runs(raws)), self.declared(drive)


def _each(**change: Callable[[Raw], np.ndarray]) -> Callable[[Raws], Raws]:
    def made(raws: Raws) -> Raws:
        return [replace(raw, **{name: of(raw) for name, of in change.items()}) for raw in raws]

    return made


def _wheels(of: Callable[[np.ndarray], np.ndarray], *channels: str) -> Callable[[Raws], Raws]:
    """The same for encoders and reported speeds, as if their columns were declared so."""
    names = channels or ("angle", "speed")
    return lambda raws: [replace(r, **{n: of(getattr(r, n)) for n in names}) for r in raws]


def _signed(*wheels: int) -> Callable[[np.ndarray], np.ndarray]:
    """The columns with the sign of some (counted from 0, -1 is the last) turned."""

    def turned(values: np.ndarray) -> np.ndarray:
        sign = np.ones(values.shape[1])
        sign[[k for k in wheels if k < len(sign)]] = -1
        return values * sign

    return turned


def _ordered(order: Sequence[int]) -> Callable[[np.ndarray], np.ndarray]:
    """The columns in another order, as far as there are so many."""

    def moved(values: np.ndarray) -> np.ndarray:
        few = [k for k in order if k < values.shape[1]]
        return values[:, few]

    return moved


def _pose(of: Callable[[np.ndarray, np.ndarray, np.ndarray], Sequence[np.ndarray]]):
    return _each(pose=lambda raw: np.stack(of(*raw.pose.T), axis=1))


def _scaled(channel: str, factor: float) -> Callable[[Raws], Raws]:
    return _each(**{channel: lambda raw: getattr(raw, channel) * factor})


def _geometry(**factors: float) -> Callable[[Drive], Geometry]:
    def changed(drive: Drive) -> Geometry:
        shape = drive.geometry
        for name, factor in factors.items():
            shape = eqx.tree_at(
                lambda tree, name=name: getattr(tree, name), shape, getattr(shape, name) * factor
            )
        return shape

    return changed


def _azimuths(degrees: float) -> Callable[[Drive], Geometry]:
    """The whole ring of wheels declared turned about the middle."""

    def changed(drive: Drive) -> Geometry:
        shape, turn = drive.geometry, np.radians(degrees)
        c, s = np.cos(turn), np.sin(turn)
        place = tuple((c * x - s * y, s * x + c * y) for x, y in shape.place)
        ways = tuple(a + turn for a in shape.drive_angle)
        base, radius = float(shape.base_radius), float(shape.wheel_radius)
        rollers = [
            None if grip else np.degrees(roller)
            for roller, grip in zip(shape.roller_angle, shape.grips, strict=True)
        ]
        return general(base * np.array(place), np.degrees(ways), rollers, radius, GEAR)

    return changed


def _late(seconds: float) -> Callable[[Raw], np.ndarray]:
    def pose(raw: Raw) -> np.ndarray:
        when = raw.time - seconds
        return np.stack([np.interp(when, raw.time, p) for p in raw.pose.T], axis=1)

    return pose


def _exchanged_poses(raws: Raws) -> Raws:
    """The first two runs have each other's poses."""
    return [replace(raws[0], pose=raws[1].pose), replace(raws[1], pose=raws[0].pose), *raws[2:]]


def _all_exchanged(raws: Raws) -> Raws:
    return [replace(r, pose=o.pose) for r, o in zip(raws, raws[1:] + raws[:1], strict=True)]


def _one_constant(raws: Raws) -> Raws:
    return [replace(raws[0], pose=0 * raws[0].pose + raws[0].pose[0]), *raws[1:]]


def _dead(values: np.ndarray) -> np.ndarray:
    """The columns with that of the second wheel constant."""
    return np.where(np.arange(values.shape[1]) == 1, values[:1], values)


def _in_one(change: Callable[[Raws], Raws]) -> Callable[[Raws], Raws]:
    return lambda raws: [*change(raws[:1]), *raws[1:]]


def _from_speed(factor: float) -> Callable[[Raws], Raws]:
    """The angle is the integral of the reported speed, which has a wrong unit."""

    def made(raws: Raws) -> Raws:
        out = []
        for raw in raws:
            speed = raw.speed * factor
            area = 0.5 * (speed[1:] + speed[:-1]) * np.diff(raw.time)[:, None]
            angle = np.concatenate([0 * speed[:1], np.cumsum(area, axis=0)])
            out.append(replace(raw, speed=speed, angle=angle))
        return out

    return made


def _time_from_speed(raws: Raws) -> Raws:
    return _from_speed(1.0)([replace(raw, time=1000 * raw.time) for raw in raws])


WHEELS = ("wheel_sign", "wheel_order")
MISTAKES = (
    Mistake("sign of the first wheel", ("wheel_sign",), "scale = -1", _wheels(_signed(0))),
    Mistake("sign of the third wheel", ("wheel_sign",), "scale = -1", _wheels(_signed(2))),
    Mistake("sign of one side", ("wheel_sign",), "scale = -1", _wheels(_signed(0, 2))),
    Mistake("sign of all wheels", ("wheel_sign",), "scale = -1", _wheels(_signed(0, 1, 2, 3))),
    Mistake("sign of all currents", ("current_sign",), "the channel", _scaled("current", -1.0)),
    Mistake("sign of one current", ("current_sign",), "column", _wheels(_signed(1), "current")),
    Mistake("sign of all voltages", ("voltage_sign",), "the channel", _scaled("voltage", -1.0)),
    Mistake(
        "sign of the heading", ("heading_sign",), "pose_heading", _pose(lambda x, y, a: (x, y, -a))
    ),
    Mistake("y down", ("pose_axis",), "pose_y", _pose(lambda x, y, a: (x, -y, a))),
    Mistake("x to the left", ("pose_axis",), "pose_x", _pose(lambda x, y, a: (-x, y, a))),
    Mistake("mirrored frame", ("pose_mirrored",), "pose_y", _pose(lambda x, y, a: (x, -y, -a))),
    Mistake(
        "x and y swapped", ("pose_swapped",), "pose_x and pose_y", _pose(lambda x, y, a: (y, x, a))
    ),
    Mistake(
        "wheels 1 and 2 exchanged", ("wheel_order",), "2, 1, 3", _wheels(_ordered([1, 0, 2, 3]))
    ),
    Mistake(
        "wheels 2 and 3 exchanged", ("wheel_order",), "1, 3, 2", _wheels(_ordered([0, 2, 1, 3]))
    ),
    Mistake("wheels in a ring", ("wheel_order",), "order", _wheels(_ordered([1, 2, 3, 0]))),
    Mistake(
        "pose in mm as m", ("pose_length",), "'mm'", _pose(lambda x, y, a: (1e3 * x, 1e3 * y, a))
    ),
    Mistake(
        "pose in m as mm", ("pose_length",), "'m'", _pose(lambda x, y, a: (1e-3 * x, 1e-3 * y, a))
    ),
    Mistake(
        "pose in cm as m", ("pose_length",), "'cm'", _pose(lambda x, y, a: (1e2 * x, 1e2 * y, a))
    ),
    Mistake(
        "yaw in deg as rad",
        ("heading_unit",),
        "'deg'",
        _pose(lambda x, y, a: (x, y, np.degrees(a))),
    ),
    Mistake(
        "yaw in rad as deg",
        ("heading_unit",),
        "'rad'",
        _pose(lambda x, y, a: (x, y, np.radians(a))),
    ),
    Mistake(
        "qz as yaw", ("heading_quaternion",), "qz", _pose(lambda x, y, a: (x, y, np.sin(0.5 * a)))
    ),
    Mistake("current in mA as A", ("current_unit",), "'mA'", _scaled("current", 1e3)),
    Mistake("current in A as mA", ("current_unit",), "'A'", _scaled("current", 1e-3)),
    Mistake("voltage in mV as V", ("voltage_unit",), "'mV'", _scaled("voltage", 1e3)),
    Mistake("gear forgotten", ("wheel_scale",), "gear_ratio = 16", _wheels(lambda x: x * GEAR)),
    Mistake(
        "encoder at the wheel", ("wheel_scale",), "gear_ratio = 1 ", _wheels(lambda x: x / GEAR)
    ),
    Mistake(
        "twice the wheel radius",
        ("wheel_scale",),
        "wheel_radius_m",
        declared=_geometry(wheel_radius=2.0),
    ),
    Mistake(
        "half the wheel radius",
        ("wheel_scale",),
        "wheel_radius_m",
        declared=_geometry(wheel_radius=0.5),
    ),
    Mistake(
        "ten times too many ticks", ("wheel_scale",), "ticks", _wheels(lambda x: 10 * x, "angle")
    ),
    Mistake(
        "turns, not radians", ("wheel_scale",), "revolutions", _wheels(lambda x: x / (2 * np.pi))
    ),
    Mistake("speeds in rpm, integrated", ("wheel_scale",), "rpm", _from_speed(30 / np.pi)),
    Mistake("reported speeds in rpm", ("wheel_speed_unit",), "rpm", _scaled("speed", 30 / np.pi)),
    Mistake(
        "base radius ten times too large",
        ("base_radius",),
        "base_radius_m",
        declared=_geometry(base_radius=10.0),
    ),
    Mistake(
        "base radius five times too small",
        ("base_radius",),
        "base_radius_m",
        declared=_geometry(base_radius=0.2),
    ),
    Mistake(
        "base radius three times too large",
        ("base_radius",),
        "base_radius_m",
        declared=_geometry(base_radius=3.0),
    ),
    Mistake("time in ms as s", ("time_unit",), "'ms'", _scaled("time", 1e3)),
    Mistake("time in ms, angle from speed", ("time_unit",), "'ms'", _time_from_speed),
    Mistake("time in s as ms", ("time_unit",), "'s'", _scaled("time", 1e-3)),
    Mistake(
        "marker turned by 90 deg",
        ("heading_offset",),
        "-90 deg",
        _pose(lambda x, y, a: (x, y, a + 0.5 * np.pi)),
    ),
    Mistake(
        "marker turned by 180 deg",
        ("heading_offset",),
        "180 deg",
        _pose(lambda x, y, a: (x, y, a + np.pi)),
    ),
    Mistake(
        "compass heading",
        ("heading_sign",),
        "90 deg",
        _pose(lambda x, y, a: (x, y, 0.5 * np.pi - a)),
    ),
    Mistake(
        "azimuths turned by 30 deg",
        ("wheel_azimuths",),
        "wheel_azimuths_deg",
        declared=_azimuths(-30.0),
    ),
    Mistake(
        "command and speed exchanged",
        ("command_exchanged",),
        "exchange",
        _each(speed=lambda r: r.command, command=lambda r: r.speed),
    ),
    Mistake(
        "poses of another run in two", ("pose_of_another_run",), "another run", _exchanged_poses
    ),
    Mistake("poses of another run in all", ("pose_unexplained",), "same runs", _all_exchanged),
    Mistake("pose 4 s late", ("lag",), "at 4.", _each(pose=_late(4.0))),
    Mistake("pose 2.5 s late", ("lag",), "at 2.", _each(pose=_late(2.5))),
    Mistake("pose 3 s early", ("lag",), "at -2.9", _each(pose=_late(-3.0))),
    Mistake(
        "pose constant", ("pose_constant",), "marker", _each(pose=lambda r: 0 * r.pose + r.pose[0])
    ),
    Mistake("pose constant in one run", ("pose_constant",), "exclude these runs", _one_constant),
    Mistake("sign of the gyro", ("gyro_sign",), "gyro", _scaled("gyro", -1.0)),
    Mistake("gyro in deg/s", ("gyro_unit",), "channel gyro", _scaled("gyro", 180 / np.pi)),
    Mistake(
        "commanded twist in mm/s",
        ("command_unit",),
        "twist_command_x",
        _each(twist=lambda r: r.twist * [1e3, 1e3, 1.0]),
    ),
    Mistake(
        "commanded yaw in deg/s",
        ("command_unit",),
        "twist_command_yaw",
        _each(twist=lambda r: r.twist * [1.0, 1.0, 180 / np.pi]),
    ),
    Mistake(
        "sign of the commanded yaw",
        ("command_sign",),
        "twist_command_yaw",
        _each(twist=lambda r: r.twist * [1.0, 1.0, -1.0]),
    ),
    Mistake(
        "commanded wheel speeds in rpm", ("command_unit",), "rpm", _scaled("command", 30 / np.pi)
    ),
    Mistake(
        "commanded wheels in another order",
        ("command_order",),
        "2, 1",
        _wheels(_ordered([1, 0, 2, 3]), "command"),
    ),
    Mistake(
        "reported speeds in another order",
        ("wheel_columns",),
        "those of wheel_speed",
        _wheels(_ordered([1, 0, 2, 3]), "speed"),
    ),
    Mistake(
        "sign of a reported speed",
        ("wheel_columns",),
        "scale = -1",
        _wheels(_signed(1), "speed"),
    ),
    Mistake(
        "sign of a commanded wheel", ("command_sign",), "commanded", _wheels(_signed(1), "command")
    ),
    Mistake("dead encoder", ("wheel_constant",), "encoder", _wheels(_dead)),
    Mistake("dead encoder in one run", ("wheel_constant",), "exclude", _in_one(_wheels(_dead))),
    Mistake(
        "frozen positions in one run",
        ("position_constant",),
        "exclude",
        _in_one(_pose(lambda x, y, a: (0 * x, 0 * y, a))),
    ),
    Mistake(
        "wheels 1 and 2 exchanged in one run",
        ("wheels_exchanged",),
        "exchange the columns",
        _in_one(_wheels(_ordered([1, 0, 2, 3]), "angle", "speed", "command")),
    ),
)
