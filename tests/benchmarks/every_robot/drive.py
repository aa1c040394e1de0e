"""Made runs: commands, true motion integrated in small steps, and what the sensors log of it."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tests.benchmarks.every_robot.robots import Floor, MadeRobot

STEP = 0.002
"""Time step of the true motion [s]."""


def forward(robot: MadeRobot, base: float) -> np.ndarray:
    """Rim speed of each drive at a body twist (vx, vy, yaw rate), (drives, 3), without slip."""
    if robot.drive == "omni":
        a = np.radians(robot.azimuths_deg)
        return np.stack([-np.sin(a), np.cos(a), np.full(len(a), base)], 1)
    if robot.drive == "mecanum":
        return np.array([[1, -1, -base], [1, 1, base], [1, 1, -base], [1, -1, base]])
    if robot.drive == "steered":
        return np.array([[1.0, 0, 0]] * robot.drives)
    return np.array([[1, 0, -base / 2], [1, 0, base / 2]])


def twist(robot: MadeRobot, floor: Floor, wheel: np.ndarray, steering: np.ndarray) -> np.ndarray:
    """True body twist (time, 3) at wheel speeds (time, drives) and logged steering angles."""
    if floor.grip is not None:
        return slipping_twist(robot, floor, wheel)
    rim = wheel * np.array(floor.radius)
    if robot.drive in ("omni", "mecanum"):
        return rim @ np.linalg.pinv(forward(robot, floor.base)).T
    if robot.drive == "steered":
        v, angle = rim.mean(1), robot.steering_gain * (steering - robot.steering_zero)
        if robot.driven == "front":
            v = v * np.cos(angle)
        rate = v * np.tan(angle) / (floor.base + floor.understeer * v**2)
        return np.stack([v, 0 * v, rate], 1)
    rate = (rim[:, 1] - rim[:, 0]) / floor.base
    return np.stack([rim.mean(1), -floor.centre * rate, rate], 1)


def wheels(robot: MadeRobot, base: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centres of the wheels (x, y), directions of their roller axles, and the drive of each."""
    if robot.drive == "omni":
        a = np.radians(robot.azimuths_deg)
        return base * np.stack([np.cos(a), np.sin(a)], 1), a + np.pi / 2, np.arange(len(a))
    side = base / 2 if robot.drive == "skid" else base - robot.half_length
    centre = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]]) * [robot.half_length, side]
    if robot.drive == "skid":
        return centre, np.zeros(4), np.array([0, 1, 0, 1])
    return centre, np.radians([-45, 45, 45, -45]), np.arange(4)


def slipping_twist(robot: MadeRobot, floor: Floor, wheel: np.ndarray) -> np.ndarray:
    """Twist at which the friction of all wheels on the floor adds up to no force and no moment.

    Each wheel holds the floor along its roller axle, and with `drag` of that along the free
    direction; both grow with the slip speed s as s / sqrt(s^2 + (creep V)^2), V being the rim
    speed. The balance minimises a convex function, here by repeatedly weighted least squares.
    """
    grip = floor.grip
    assert grip is not None
    centre, axle, drive = wheels(robot, floor.base)
    rim = (wheel * np.array(floor.radius))[:, drive]
    hold = np.stack([np.cos(axle), np.sin(axle)], 1)
    free = np.stack([-np.sin(axle), np.cos(axle)], 1)
    rows = [
        np.stack([e[:, 0], e[:, 1], centre[:, 0] * e[:, 1] - centre[:, 1] * e[:, 0]], 1)
        for e in (hold, free)
    ]
    roll = 0.0 if robot.drive == "omni" else axle  # angle from the wheel's plane to the axle
    wanted = [rim * np.cos(roll), -rim * np.sin(roll)]
    scale = (grip.creep * np.sqrt((rim**2).mean(1, keepdims=True)) + 1e-6) ** 2
    weights = [np.array(grip.loads), grip.drag * np.array(grip.loads)]
    found = np.zeros((len(rim), 3))
    for _ in range(400):
        slip = [found @ a.T - b for a, b in zip(rows, wanted, strict=True)]
        if robot.drive == "skid":  # no rollers: friction against the whole slip velocity
            size = [np.sqrt(slip[0] ** 2 + slip[1] ** 2 + scale)] * 2
        else:
            size = [np.sqrt(s**2 + scale) for s in slip]
        left, right = np.zeros((len(rim), 3, 3)), np.zeros((len(rim), 3))
        for a, b, w, s in zip(rows, wanted, weights, size, strict=True):
            left += np.einsum("tw,wi,wj->tij", w / s, a, a)
            right += np.einsum("tw,wi,tw->ti", w / s, a, b)
        before, found = found, np.linalg.solve(left, right[..., None])[..., 0]
        if np.abs(found - before).max() < 1e-8:
            break
    return found


def commands(robot: MadeRobot, rng: np.random.Generator, number: int, fresh: bool) -> np.ndarray:
    """Segments (duration, vx, vy, yaw rate or steering angle) of a run, (segments, 4)."""
    v, w = robot.speed, robot.turn_rate
    sideways = robot.drive in ("omni", "mecanum")
    if robot.drive == "steered":
        speeds = v * (rng.uniform(0.5, 1.3, 8) if fresh else rng.choice([0.6, 1.0], 6))
        angles = (
            rng.uniform(-0.4, 0.4, 8) if fresh else rng.permutation([-0.4, -0.2, 0, 0, 0.2, 0.4])
        )
        speeds *= -1 if number % 4 == 3 else 1
        return np.stack([np.full(len(speeds), 2.5), speeds, 0 * speeds, angles], 1)
    if fresh:  # curves in both directions, at other speeds
        speeds = v * rng.uniform(0.4, 1.5, 8)
        rates = w * rng.uniform(-0.9, 0.9, 8)
        course = np.cumsum(rng.uniform(-1, 1, 8)) + rng.uniform(0, 6) if sideways else np.zeros(8)
        return np.stack(
            [np.full(8, 2.5), speeds * np.cos(course), speeds * np.sin(course), rates], 1
        )
    if robot.paths == "straight":
        speeds = v * np.array([0.7, 1.0, 1.3])[(number + np.arange(3)) % 3]
        return np.stack([np.full(3, 4.0), speeds, 0 * speeds, 0 * speeds], 1)
    if robot.paths == "squares":
        turn = (1 if number % 2 else -1) * w
        side, corner, stop = [4.0, v, 0, 0], [np.pi / 2 / w, 0, 0, turn], [0.8, 0, 0, 0]
        return np.array([side, stop, corner, stop] * 4)
    if sideways:
        course = 2 * np.pi * rng.permutation(6) / 6 + number * np.pi / 18
        speeds = v * rng.choice([0.7, 1.0], 6)
        rates = w * rng.permutation([0, 0, 0, 0, 0.5, -0.5])
        legs = np.stack(
            [np.full(6, 2.2), speeds * np.cos(course), speeds * np.sin(course), rates], 1
        )
        return np.concatenate([legs, [[2.0, 0, 0, w * (-1) ** number]]])
    radius = v / w
    legs = [[3.0, v, 0, 0], [2.5, 0.7 * v, 0, 0], [np.pi / 2 / w, 0, 0, w], [1.2 / w, 0, 0, -w]]
    legs += [[3.0, v, 0, 0.5 * v / radius], [3.0, 0.8 * v, 0, -0.5 * v / radius]]
    legs = [legs[k] for k in rng.permutation(len(legs))]
    return np.array(legs) * ([1, -1, 1, 1] if number % 4 == 3 else [1, 1, 1, 1])


@dataclass(frozen=True)
class MadeRun:
    """True motion of a run: times (n,), wheel angles, steering, twist and pose of the body."""

    t: np.ndarray
    angle: np.ndarray
    speed: np.ndarray
    steering: np.ndarray
    twist: np.ndarray
    pose: np.ndarray

    def sensor(self, robot: MadeRobot, t: np.ndarray) -> np.ndarray:
        """True poses of the pose sensor at some times, (times, 3)."""
        x, y, heading = (np.interp(t, self.t, column) for column in self.pose.T)
        px, py = robot.place
        c, s = np.cos(heading), np.sin(heading)
        return np.stack([x + c * px - s * py, y + s * px + c * py, heading + robot.yaw], 1)


def driven(robot: MadeRobot, floor: Floor, legs: np.ndarray, rng: np.random.Generator) -> MadeRun:
    """The true motion of a robot that drives some segments as its user's numbers say."""
    rest = max(robot.rest, 0.1)
    legs = np.concatenate([[[rest, 0, 0, 0]], legs, [[rest, 0, 0, 0]]])
    legs[[0, -1], 3] = legs[[1, -2], 3] if robot.drive == "steered" else 0
    wished = np.repeat(legs[:, 1:], np.round(legs[:, 0] / STEP).astype(int), axis=0)
    ramp = int(0.3 / STEP)
    padded = np.pad(wished, ((ramp // 2, ramp // 2), (0, 0)), "edge")
    total = np.cumsum(np.pad(padded, ((1, 0), (0, 0))), axis=0)
    smooth = ((total[ramp:] - total[:-ramp]) / ramp)[: len(wished)]
    speed = smooth @ (forward(robot, robot.nominal_base) / robot.nominal_radius).T
    if robot.drive == "steered":
        speed = smooth[:, :1] / robot.nominal_radius * np.ones(robot.drives)
        if robot.driven == "front":
            speed = speed / np.cos(smooth[:, 2:3])
    slip = rng.normal(size=(len(speed) // 50 + 2, robot.drives))  # lasts about a tenth of a second
    t = STEP * np.arange(len(speed))
    share = np.stack([np.interp(t, 0.1 * np.arange(len(slip)), s) for s in slip.T], 1)
    body = twist(robot, floor, speed * (1 + robot.wheel_noise * share), smooth[:, 2])
    angle = _integral(speed)
    heading = _integral(body[:, 2:])[:, 0] + rng.uniform(-3, 3)
    c, s = np.cos(heading), np.sin(heading)
    xy = np.stack([c * body[:, 0] - s * body[:, 1], s * body[:, 0] + c * body[:, 1]], 1)
    place = _integral(xy) + rng.uniform(-2, 2, 2)
    pose = np.concatenate([place, heading[:, None]], 1)
    return MadeRun(t, angle, speed, smooth[:, 2], body, pose)


def _integral(rate: np.ndarray) -> np.ndarray:
    """Integral of rows from the first one on, by the trapezoidal rule."""
    mean = (rate[1:] + rate[:-1]) / 2
    return STEP * np.concatenate([np.zeros((1, rate.shape[1])), np.cumsum(mean, axis=0)])


def table(robot: MadeRobot, run: MadeRun, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Columns that are logged of a run; cells without a value are NaN."""
    t = np.arange(0, run.t[-1], 1 / robot.rate)
    t[1:] += rng.uniform(-0.1, 0.1, len(t) - 1) / robot.rate
    columns = {"t": np.round(t, 5)}
    per_tick = 2 * np.pi / (robot.ticks or 1e5)
    for k, name in enumerate(columns_of_wheels(robot)):
        count = np.floor(np.interp(t, run.t, run.angle[:, k]) / per_tick + rng.uniform())
        columns[name] = count if robot.ticks else count * per_tick
    if robot.drive == "steered":
        columns["steering"] = np.round(np.interp(t, run.t, run.steering), 4)
    if robot.motors is not None:
        columns |= _electric(robot, run, t, rng)
    if robot.gyro:
        rate = np.interp(t, run.t, run.twist[:, 2])
        columns["gyro"] = np.round(rate + 0.003 + rng.normal(0, 0.01, len(t)), 5)
    noise = rng.normal(size=(len(t), 3)) * [robot.noise_m, robot.noise_m, robot.noise_rad]
    pose = run.sensor(robot, t - robot.lag) + noise
    pose[np.arange(len(t)) % robot.pose_every > 0] = np.nan
    if robot.only_changes:
        pose = np.round(pose / 0.002) * 0.002
    if robot.pose_kind != "heading":
        columns |= {"x": pose[:, 0], "y": pose[:, 1]}
    if robot.pose_kind != "xy":
        columns["heading"] = np.arctan2(np.sin(pose[:, 2]), np.cos(pose[:, 2]))
    if robot.only_changes:
        rest = np.stack([v for k, v in columns.items() if k != "t"])
        changed = np.abs(np.diff(rest, axis=1)).max(0) > 1e-6
        keep = np.concatenate([[True], changed])
        columns = {name: column[keep] for name, column in columns.items()}
    return columns


def columns_of_wheels(robot: MadeRobot) -> list[str]:
    if robot.drives == 2:
        return ["left", "right"]
    return [f"wheel{k + 1}" for k in range(robot.drives)]


def _electric(
    robot: MadeRobot, run: MadeRun, t: np.ndarray, rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """Currents and voltages of motors with dry and viscous friction and inertia."""
    motors = robot.motors
    assert motors is not None
    change = np.gradient(run.speed, STEP, axis=0)
    torque = motors.coulomb * np.tanh(run.speed / 0.05) + motors.viscous * run.speed
    torque += (motors.inertia + robot.mass * robot.nominal_radius**2 / robot.drives) * change
    current = torque / (motors.back_emf * motors.gear)
    voltage = motors.resistance * current + motors.back_emf * motors.gear * run.speed
    columns = {}
    for k in range(robot.drives):
        amps = np.interp(t, run.t, current[:, k]) + rng.normal(0, 0.01, len(t))
        volts = np.interp(t, run.t, voltage[:, k]) + rng.normal(0, 0.02, len(t))
        columns |= {f"i{k + 1}": np.round(amps, 3), f"u{k + 1}": np.round(volts, 3)}
    return columns


@dataclass(frozen=True)
class Judged:
    """Truth of a fresh run: path length, and the sensor at the first and the last pose."""

    path: float
    start: tuple[float, ...]
    end: tuple[float, ...]


def write(robot: MadeRobot, folder: Path, seed: int) -> dict[str, Judged]:
    """Write robot.toml, logs/FLOOR/NN.csv to fit and fresh/FLOOR/NN.csv to predict.

    Returns:
        What is true of the fresh runs, keyed by their paths relative to `fresh`.
    """
    rng = np.random.default_rng([seed, zlib.crc32(robot.name.encode())])
    (folder / "robot.toml").write_text(config(robot), encoding="utf-8")
    truth = {}
    for floor in robot.floors:
        for number in range(robot.runs):
            mislaid = robot.wrong_label and floor is robot.floors[-1] and number == 0
            label = robot.floors[0].name if mislaid else floor.name
            name = f"{'x' if mislaid else ''}{number:02d}.csv"
            run = driven(robot, floor, commands(robot, rng, number, False), rng)
            write_csv(folder / "logs" / label / name, table(robot, run, rng))
        for number in range(4):
            run = driven(robot, floor, commands(robot, rng, number, True), rng)
            columns = table(robot, run, rng)
            write_csv(folder / "fresh" / floor.name / f"{number:02d}.csv", columns)
            posed = columns["t"][~np.isnan(columns.get("x", columns.get("heading")))]
            ends = run.sensor(robot, posed[[0, -1]] - robot.lag)
            path = float(np.hypot(*np.diff(run.pose[:, :2], axis=0).T).sum())
            truth[f"{floor.name}/{number:02d}.csv"] = Judged(path, tuple(ends[0]), tuple(ends[1]))
    return truth


def write_csv(path: Path, columns: dict[str, np.ndarray]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cells = [["" if np.isnan(v) else f"{v:.9g}" for v in column] for column in columns.values()]
    lines = [",".join(columns), *(",".join(row) for row in zip(*cells, strict=True))]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def config(robot: MadeRobot) -> str:
    """The config that the user of a robot writes."""
    lines = ["[robot]", f'drive = "{robot.drive}"', f"wheel_radius_m = {robot.nominal_radius}"]
    base = robot.nominal_base
    lines += {
        "differential": [f"track_m = {base}"],
        "skid": [
            "drives = [[1, 3], [2, 4]]",
            f"half_length_m = {robot.half_length}",
            f"half_width_m = {base / 2}",
        ],
        "omni": [f"wheel_azimuths_deg = {list(robot.azimuths_deg)}", f"base_radius_m = {base}"],
        "mecanum": [
            f"half_length_m = {robot.half_length}",
            f"half_width_m = {round(base - robot.half_length, 6)}",
        ],
        "steered": [
            f"wheelbase_m = {base}",
            f'driven = "{robot.driven}"',
            f"encoders = {robot.drives}",
        ],
    }[robot.drive]
    gear = robot.motors.gear if robot.motors else 1.0
    lines += [f"gear_ratio = {gear}", f"mass_kg = {robot.mass}", "", "[layouts.mine]"]
    if robot.ticks:
        lines.append(f"ticks_per_revolution = {robot.ticks / gear}")
    lines += [f"gear_ratio = {gear}", "", "[layouts.mine.columns]"]
    channel, unit = ("wheel_ticks", "tick") if robot.ticks else ("wheel_angle", "rad")
    names = ", ".join(f'"{name}"' for name in columns_of_wheels(robot))
    lines += ['time = { column = "t", unit = "s" }']
    lines += [f'{channel} = {{ columns = [{names}], unit = "{unit}" }}']
    if robot.drive == "steered":
        lines.append('steering_angle = { column = "steering", unit = "rad" }')
    if robot.motors:
        for channel, letter, unit in (("current", "i", "A"), ("voltage", "u", "V")):
            names = ", ".join(f'"{letter}{k + 1}"' for k in range(robot.drives))
            lines.append(f'{channel} = {{ columns = [{names}], unit = "{unit}" }}')
    if robot.gyro:
        lines.append('gyro = { column = "gyro", unit = "rad/s" }')
    if robot.pose_kind != "heading":
        lines += [f'pose_{a} = {{ column = "{a}", unit = "m" }}' for a in "xy"]
    if robot.pose_kind != "xy":
        lines.append('pose_heading = { column = "heading", unit = "rad" }')
    lines += ["", "[[logs]]", 'glob = "*/*.csv"', 'format = "mine"', 'surface = "folder"', ""]
    lines += ["[fit]", 'lengths_from = "poses"', "", "[parameters]"]
    lines += ['"camera.marker_yaw" = { free = true }']
    if robot.motors:
        lines += ['"motor.efficiency" = { fixed = 1.0 }']
    else:
        lines += ['"motor.*" = { free = false }', '"surface.*.friction" = { free = false }']
    return "\n".join(lines) + "\n"
