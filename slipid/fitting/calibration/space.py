"""Numbers of a calibration as one vector with a Gaussian prior, and what they mean for the robot.

Module `estimate` has the equations.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cached_property

import numpy as np
from jaxtyping import Float

from slipid.data.runs import Runs
from slipid.model.geometry import Geometry
from slipid.model.kinematics import Kinematics, Steering, is_axle, nominal_base
from slipid.search_space import Choice, Space

RADIUS_STD, DRIVE_STD, FLOOR_STD, DRIVE_ON_FLOOR_STD, BASE_STD = 0.3, 0.02, 0.3, 0.03, 0.5
"""Prior stds of the logarithms of the radius, of the drives' deviations from it, of a floor's
radius over that of the firmest floor, of the drives' further deviations on a floor, and of the
track or base over the config's [1]."""
WHEELBASE_STD, WHEELBASE_ON_FLOOR_STD, ZERO_STD, GAIN_STD, UNDERSTEER_STD = (
    0.05,
    0.15,
    0.1,
    0.1,
    0.03,
)
"""Prior stds of the logarithm of a steered robot's wheelbase over the config's on the firmest floor
and of that on other floors over it [1], of the steering's zero [rad], of its gain [1], and of the
understeer [s^2/m], of which soft tyres have .03."""
LAG_STD, YAW_STD, SESSION_STD = 0.3, 0.5, 0.02
"""Prior stds of the lag [s], of the sensor's yaw and of its deviation in a session [rad]."""
LOOSE_SCALE_STD = 0.01
"""Relative prior std of the scale of positions above which the radius stays at the config's, since
motion determines only their ratio."""
WHOLE_TURN, MEAN_TURN = 1.0, 0.3
"""Changes of heading by the encoders that show a track or base: in any run, or on average over the
runs on a floor [rad]."""
SMALL_TURN, EXPLAINED, LEAST_TURNS = 0.1, 0.8, 6
"""Smaller changes of heading by the encoders may be errors of the speed controllers or slip. They
show a track if they exceed this one on average [rad] and explain this fraction of the squares of
the measured changes [1], in at least this number of runs. They never show the base of wheels that
determine the twist, whose slip depends on the direction of travel, and so does the turning."""


def has_centre(shape: Geometry) -> bool:
    """Return whether floors may differ in the point about which the robot turns."""
    return not shape.determines_twist and not is_axle(shape)


def base_names(floor: str) -> tuple[str, ...]:
    """Return the names of the coordinates whose sum is log b_k / b."""
    return "base", f"base.{floor}"


def radius_names(floor: str, drive: int) -> tuple[str, ...]:
    """Return the names of the coordinates whose sum is log r_kj / r."""
    return "radius", f"drive.{drive}", f"floor.{floor}", f"drive.{drive}@{floor}"


@dataclass(frozen=True)
class Coordinate:
    """Gaussian prior of one coordinate of the search vector; a std of 0 fixes it."""

    mean: float
    std: float


@dataclass(frozen=True, eq=False)
class CalibrationSpace:
    """Map from the search vector to kinematics, pose sensor and lag of every run.

    Attributes:
        space: robot and choices of the config.
        floors, sessions: names of floors and sessions.
        firmest: index of the floor to which radii refer.
        numbers: coordinates of the search vector, keyed by name.
        unseen: names of coordinates that no run shows, such as the track without turns, or the
            radius without positions; they stay at their prior means.
    """

    space: Space
    floors: tuple[str, ...]
    sessions: tuple[str, ...]
    firmest: int
    numbers: Mapping[str, Coordinate]
    unseen: frozenset[str]

    @classmethod
    def of(
        cls, space: Space, choices: Sequence[Choice], data: Runs, firmest: int
    ) -> "CalibrationSpace":
        shape = space.template.geometry
        floors = tuple(sorted(set(data.surface)))
        sessions = tuple(sorted(set(data.session)))
        scale = _given(space, choices, "camera.scale", 0.0)
        loose = scale.std > LOOSE_SCALE_STD * scale.mean
        size = max(nominal_base(shape), 0.1)
        numbers = {"radius": Coordinate(0.0, 0.0 if loose else RADIUS_STD)}
        drives = range(shape.drives if shape.driven is None else 0)
        numbers |= {f"drive.{j}": Coordinate(0.0, DRIVE_STD) for j in drives}
        others = [f for k, f in enumerate(floors) if k != firmest]
        numbers |= {f"floor.{f}": Coordinate(0.0, FLOOR_STD) for f in others}
        if others:
            own = {f"drive.{j}@{f}" for f in floors for j in drives}
            numbers |= {name: Coordinate(0.0, DRIVE_ON_FLOOR_STD) for name in sorted(own)}
        if shape.driven is None:
            numbers |= {f"base.{f}": Coordinate(0.0, BASE_STD) for f in floors}
        else:
            numbers["base"] = Coordinate(0.0, WHEELBASE_STD)
            numbers |= {f"base.{f}": Coordinate(0.0, WHEELBASE_ON_FLOOR_STD) for f in others}
            numbers["zero"] = Coordinate(0.0, ZERO_STD)
            numbers["gain"] = Coordinate(1.0, GAIN_STD)
            numbers["understeer"] = Coordinate(0.0, UNDERSTEER_STD)
        if has_centre(shape):
            numbers |= {f"centre.{f}": Coordinate(0.0, size) for f in others}
        for axis, name in enumerate("xy"):
            numbers[f"offset.{name}"] = _given(space, choices, "camera.marker_place", size, axis)
        numbers["yaw"] = _given(space, choices, "camera.marker_yaw", YAW_STD)
        if len(sessions) > 1:
            numbers |= {f"yaw@{s}": Coordinate(0.0, SESSION_STD) for s in sessions}
        numbers["lag"] = _given(space, choices, "camera.lag", LAG_STD)
        numbers["scale"] = scale
        # Steering that is off its zero turns a robot that seems to drive straight ahead.
        straight = set(floors) - floors_with_turns(space, data) if shape.driven is None else set()
        unseen = {f"{what}.{f}" for f in straight for what in ("base", "centre")}
        if straight == set(floors):
            unseen |= {"offset.x", "offset.y"}
        seen = np.isfinite(data.pose[data.fresh]).any(axis=0)
        if not seen[0]:
            # Headings alone show ratios of lengths, so the config's radius counts as known.
            unseen |= {"radius", "offset.x", "offset.y", "scale", *(f"floor.{f}" for f in others)}
        if not seen[2]:
            unseen |= {"yaw", *(f"yaw@{s}" for s in sessions)}
        if max(int(data.fresh[data.rows(k)].sum()) for k in range(len(data))) < 3:
            unseen.add("lag")
        unseen &= set(numbers)
        return cls(space, floors, sessions, firmest, numbers, frozenset(unseen))

    @cached_property
    def free(self) -> list[str]:
        """Names of the coordinates that are fitted."""
        return [n for n, number in self.numbers.items() if number.std > 0 and n not in self.unseen]

    def column(self, name: str, z: Float[np.ndarray, "*batch free"]) -> Float[np.ndarray, "*batch"]:
        """Return one coordinate of search vectors, or its given value if it is not fitted."""
        if name not in self.numbers:
            return np.zeros(z.shape[:-1])
        if name in self.free:
            return np.asarray(z[..., self.free.index(name)])
        return np.full(z.shape[:-1], self.numbers[name].mean)

    def kinematics(self, z: Float[np.ndarray, "*batch free"]) -> Kinematics:
        """Return the kinematics at a search vector; for several, arrays have leading axes."""
        shape, floors = self.space.template.geometry, self.floors
        drives = range(shape.drives)
        radius = np.array(
            [[sum(self.column(n, z) for n in radius_names(f, j)) for j in drives] for f in floors]
        )
        if "radius" not in self.free:
            # The mean radius is given, so that drives deviate from it in opposite directions.
            radius = radius - np.mean([self.column(f"drive.{j}", z) for j in drives], axis=0)
        base = [sum(self.column(n, z) for n in base_names(f)) for f in floors]
        base = self.nominal_base * np.exp(np.stack(base, axis=-1))
        return Kinematics(
            floors,
            self.rolling,
            self.nominal_base,
            float(shape.wheel_radius) * np.exp(np.moveaxis(radius, (0, 1), (-2, -1))),
            base,
            np.stack([self.column(f"centre.{f}", z) for f in floors], axis=-1),
            self.steering(z, base),
        )

    def steering(
        self, z: Float[np.ndarray, "*batch free"], base: Float[np.ndarray, "*batch floor"]
    ) -> Steering | None:
        """Return the steering on every floor at a search vector; None if no wheel is steered."""
        driven = self.space.template.geometry.driven
        if driven is None:
            return None
        zero, gain, understeer = (
            np.broadcast_to(self.column(name, z)[..., None], base.shape)
            for name in ("zero", "gain", "understeer")
        )
        front = np.full(base.shape, float(driven == "front"))
        return Steering(base, zero, gain, understeer, front)

    @cached_property
    def rolling(self) -> Float[np.ndarray, "3 drive"]:
        """Pseudo-inverse of the config's geometry."""
        return np.asarray(self.space.template.geometry.pseudo_inverse())

    @cached_property
    def nominal_base(self) -> float:
        """Track or base of the config's geometry [m]."""
        return nominal_base(self.space.template.geometry)


def floors_with_turns(space: Space, data: Runs) -> set[str]:
    """Return the floors on which the wheels turned the robot in some run."""
    shape = space.template.geometry
    yaw = np.asarray(shape.pseudo_inverse())[2] * float(shape.wheel_radius)
    turned: dict[str, list[tuple[float, float, float]]] = {}
    for k, floor in enumerate(data.surface):
        rows = data.rows(k)
        seen = np.flatnonzero(data.fresh[rows] & np.isfinite(data.pose[rows, 2]))
        wheels, poses = data.wheel_angle[rows] @ yaw, np.unwrap(data.pose[rows, 2][seen])
        ends = (wheels[seen[-1]] - wheels[seen[0]], poses[-1] - poses[0]) if len(seen) else (0, 0)
        turned.setdefault(floor, []).append((float(np.ptp(wheels)), *ends))
    gently = not shape.determines_twist
    return {floor for floor, each in turned.items() if _shows_turns(np.array(each), gently)}


def _shows_turns(turns: Float[np.ndarray, "run 3"], gently: bool) -> bool:
    """Return whether changes of heading in some runs are turns by the wheels.

    Args:
        turns: ranges of the heading by the encoders, and its changes from the first to the last
            pose by the encoders and by the poses [rad].
        gently: True if small changes may show turns, too.
    """
    far, by_wheels, by_poses = turns.T
    if far.max() > WHOLE_TURN or far.mean() > MEAN_TURN:
        return True
    if not gently or len(far) < LEAST_TURNS or far.mean() < SMALL_TURN:
        return False
    whole = (by_wheels @ by_wheels) * (by_poses @ by_poses)
    return bool((by_wheels @ by_poses) ** 2 > EXPLAINED * whole)


def _is_fixed(choices: Sequence[Choice], path: str) -> bool:
    """Return whether the last choice about a parameter fixes it."""
    mine = [c for c in choices if fnmatchcase(path, c.pattern)]
    return bool(mine) and (mine[-1].fixed is not None or mine[-1].free is False)


def _given(
    space: Space, choices: Sequence[Choice], path: str, usual: float, axis: int | None = None
) -> Coordinate:
    """Return the prior of a number of the camera: the config's if it has one, else std `usual`.

    `axis` is the index in a vector, whose declared prior is too narrow and does not count.
    """
    entry = next(e for e in space.all if e.path == path)
    at = axis or 0
    value = float(np.ravel(entry.get(space.template))[at])
    stated = any(c.prior_std is not None and fnmatchcase(path, c.pattern) for c in choices)
    if entry in space.free and (stated or axis is None):
        mine, d = space.slices[path], entry.declaration
        mean = float(d.to_si(space.prior_mean[mine])[at])
        return Coordinate(mean, float(space.prior_std[mine][at] * d.slope(mean)))
    return Coordinate(value, 0.0 if _is_fixed(choices, path) else usual)
