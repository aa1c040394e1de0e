"""A Robotino whose every number is known, what it drives, and the sensors that see it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from slipid.identify.design.planned_runs import Drive
from slipid.model.geometry import omni
from slipid.model.robot import Robot, build
from slipid.parameter import entries
from slipid.search_space import Choice, Space


def numbers(robot: Robot) -> dict[str, float | list[float]]:
    """Every number of a robot by its path, as plain values."""
    return {e.path: np.asarray(e.get(robot)).tolist() for e in entries(robot)}


_FLOORS = {
    "friction": (0.5, 0.8),
    "creep": (0.15, 0.45),
    "roller_drag": (0.18, 0.33),
    "roller_creep": (0.25, 0.2),
    "rolling_resistance": (0.008, 0.02),
    "slide_viscosity": (0.03, 0.05),
    "roller_viscosity": (0.03, 0.05),
    "scrub": (0.001, 0.002),
    "lead": (0.0015, 0.0045),
}
"""Of the floors firm and soft."""
TRUTH: dict[str, float | tuple[float, ...]] = {
    "robot.mass": 12.0,
    "robot.load_share@as_built": (0.29, 0.42, 0.29),
    "robot.load_share@moved": (0.33, 0.35, 0.32),
    "motor.resistance": 5.5,
    "motor.back_emf": 0.0514,
    "motor.inductance": 8.9e-3,
    "motor.rotor_inertia": 7.1e-6,
    "motor.coulomb_friction": 0.07,
    "motor.viscous_friction": 0.006,
    "camera.scale": 1.117,
    "camera.lag": 0.056,
    "camera.marker_yaw": -0.015,
    **{f"surface.firm.{name}": firm for name, (firm, _) in _FLOORS.items()},
    **{f"surface.soft.{name}": soft for name, (_, soft) in _FLOORS.items()},
}
"""Numbers of the default robot [SI], the rest as declared; of the size found on real logs."""


def blank(drives: Sequence[Drive]) -> Robot:
    """Robotino at declared starts that knows the floors, loads and sessions of a plan."""
    return build(
        omni([60.0, 180.0, 300.0], 0.125, 0.04, 16.0),
        sorted({d.surface for d in drives}),
        tuple(dict.fromkeys(d.load for d in drives)),
        sorted({d.session for d in drives}),
    )


def truth(
    drives: Sequence[Drive], values: Mapping[str, float | Sequence[float]] | None = None
) -> Robot:
    """Robotino with the numbers of `TRUTH`, or others; what the plan does not need is left out."""
    robot = blank(drives)
    known = {e.path for e in entries(robot)}
    values = {**TRUTH, **(values or {})}
    return Space(robot, [Choice(p, fixed=v) for p, v in values.items() if p in known]).template


def grid(
    setups: Sequence[tuple[str, str]],
    headings: int = 12,
    speeds: Sequence[float] = (0.1, 0.2),
    turns: int = 2,
) -> tuple[Drive, ...]:
    """Every heading at every speed on every (floor, load), and `turns` curved runs of each."""
    drives = []
    for surface, load in setups:
        for speed in speeds:
            ways = 2 * np.pi * np.arange(headings) / headings
            drives += [Drive(surface, load, float(way), speed) for way in ways]
            ways = 2 * np.pi * (np.arange(turns) + 0.5) / max(turns, 1)
            drives += [
                Drive(surface, load, float(way), speed, turn=(-1) ** k * 4.0 * speed)
                for k, way in enumerate(ways)
            ]
    return tuple(drives)


def turning_grid(
    setups: Sequence[tuple[str, str]], ways: int, speeds: Sequence[float], base_radius: float
) -> tuple[Drive, ...]:
    """Runs of wheels that do not drive sideways, on every (floor, load).

    Between straight ahead and turning on the spot `ways` of each speed, evenly around the circle of
    (ahead, turn times base radius [m]).
    """
    drives = []
    for surface, load in setups:
        for speed in speeds:
            for way in 2 * np.pi * np.arange(ways) / ways:
                # rounded: the cosine of a right angle is not quite zero
                ahead, turn = (round(speed * float(f(way)), 9) for f in (np.cos, np.sin))
                back = 0.0 if ahead >= 0 else np.pi
                drives.append(Drive(surface, load, back, abs(ahead), turn=turn / base_radius))
    return tuple(drives)


@dataclass(frozen=True)
class Sensors:
    """How the logs are disturbed; stds by the names of `slipid.identify.fit.noise.noise`.

    Attributes:
        std: of every variance component; `floor` in a name stands for every floor without its own.
        ripple: of the current from row to row [A]; voltage_noise: [V].
        current_step, voltage_step: of the converters [A], [V]; ticks: per turn of the motor.
        row_period, frame_period: of the log and the camera [s].
        delay, ramp: from command to motion, and to full speed [s].
        wobble: of the wheel's angle, as time [s]; a real speed loop is never quite still.
        signed: whether currents have their sign.
    """

    std: Mapping[str, float] = field(
        default_factory=lambda: {
            "camera.place": 0.0005,
            "camera.heading": 0.005,
            "process.floor.along": 0.004,
            "process.floor.across": 0.004,
            "process.floor.yaw": 0.008,
            "run.floor.along": 0.006,
            "run.floor.across": 0.006,
            "run.floor.yaw": 0.03,
            "current.floor.run": 0.03,
        }
    )
    ripple: float = 0.06
    voltage_noise: float = 0.07
    current_step: float = 1 / 39
    voltage_step: float = 0.1
    ticks: int = 2000
    row_period: float = 0.031
    frame_period: float = 1 / 29
    delay: float = 0.12
    ramp: float = 0.2
    wobble: float = 0.002
    has_voltage: bool = True
    signed: bool = False

    def of(self, name: str) -> float:
        """Std of a variance component, 0 for one that these logs are made without."""
        head, _, last = name.partition(".")
        of_any_floor = f"{head}.floor.{last.split('.')[-1]}"
        return self.std.get(name, self.std.get(of_any_floor, 0.0))
