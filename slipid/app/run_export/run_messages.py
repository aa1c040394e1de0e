"""Messages about a run with Foxglove's schemas, for Foxglove and for rerun.

Whatever there is to look at is a point cloud, which both viewers draw as it is: rerun draws no
`SceneUpdate`, and poses only when asked to. Numbers over time are messages with a field for each
wheel or floor, which both plot.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from slipid.app.run_export.run_view import RunView
from slipid.data.floor_map import FloorMap
from slipid.deploy.replay import EstimatedRun
from slipid.infer.body_path import BodyPath
from slipid.robot.interface import NO_FLOOR

FRAME = "map"
"""Frame of the corrected poses, in which everything is drawn."""
OUTLINE_POINTS, HEADING_POINTS = 64, 16
"""Numbers of points on the outline of a region, and on the line that shows a robot's heading."""
MOST_CELLS = 40_000
"""Largest number of cells of a drawn map; of a finer map every second, third, ... cell is drawn."""
BELOW_M = 0.02
"""Distance of the floor map below the paths [m]."""
LEAST_APART_S = 0.02
"""Shortest time between two messages on a topic of the wheels or of the estimator [s]."""
COLOURS = {
    "measured": (40, 40, 40, 255),
    "nominal": (230, 159, 0, 255),
    "calibrated": (204, 121, 167, 255),
    "selected": (0, 114, 178, 255),
    "estimator": (0, 158, 115, 255),
}
"""Red, green, blue and opacity of every path, after Okabe and Ito."""
FLOOR_COLOURS = (
    *((190, 190, 190, 255), (240, 205, 130, 255), (150, 190, 220, 255), (170, 210, 150, 255)),
    *((220, 170, 190, 255), (200, 180, 230, 255), (235, 235, 150, 255), (160, 160, 120, 255)),
)
"""Colours of the floors in the order of the map; they repeat."""
_UINT8, _FLOAT32 = 1, 7
_DOUBLE, _STRING = 1, 9


@dataclass(frozen=True)
class McapChannel:
    """A topic, with the unit and the meaning of its messages."""

    topic: str
    unit: str
    meaning: str


@dataclass(frozen=True, eq=False)
class McapMessage:
    """A protobuf message on a channel, at a time of the run [s]."""

    time: float
    channel: McapChannel
    content: Any


def messages(view: RunView) -> Iterator[McapMessage]:
    """Yield all messages of a run, topic by topic."""
    if view.floor is not None:
        begin = min(float(path.time[0]) for path in view.paths.values())
        yield _floor_map(view.floor, begin)
    for name, path in view.paths.items():
        yield from _of_path(name, path, view.wheels)
    if view.estimate is not None:
        yield from _of_estimate(view, view.estimate)
    yield from _currents(view)


def _schema(name: str) -> Callable[..., Any]:
    """Return the class of the messages of one of Foxglove's schemas."""
    made: Callable[..., Any] = getattr(import_module(f"foxglove_schemas_protobuf.{name}_pb2"), name)
    return made


def _of_path(
    name: str, path: BodyPath, wheels: Float[np.ndarray, "wheel 2"]
) -> Iterator[McapMessage]:
    """Yield poses and regions of one path; at its beginning, the whole path and a robot."""
    if name == "estimator":
        path = path.rows(_apart(path.time))
    pose = McapChannel(f"/pose/{name}", "m", f"{name} pose of the robot's middle")
    frame = McapChannel("/tf", "m", f"a frame in '{FRAME}' for every pose")
    for time, (x, y, heading) in zip(path.time.tolist(), path.pose.tolist(), strict=True):
        place, turn = {"x": x, "y": y}, {"z": np.sin(heading / 2), "w": np.cos(heading / 2)}
        where = {"position": place, "orientation": turn}
        yield McapMessage(time, pose, _schema("PoseInFrame")(frame_id=FRAME, pose=where))
        ends = {"parent_frame_id": FRAME, "child_frame_id": name}
        moved = _schema("FrameTransform")(**ends, translation=place, rotation=turn)
        yield McapMessage(time, frame, moved)
    begin, colour = float(path.time[0]), COLOURS[name]
    whole = McapChannel(f"/path/{name}", "m", f"the whole path of {name}")
    yield McapMessage(begin, whole, _points(path.pose[:, :2], colour))
    robot = McapChannel(f"/robot/{name}", "m", f"wheels, and a line ahead, in the frame '{name}'")
    ahead = np.zeros((HEADING_POINTS, 2))
    ahead[:, 0] = np.linspace(0.0, np.linalg.norm(wheels, axis=1).max(), HEADING_POINTS)
    yield McapMessage(begin, robot, _points(np.concatenate([wheels, ahead]), colour, name))
    if (outlines := path.outlines(OUTLINE_POINTS)) is not None:
        region = McapChannel(f"/region90/{name}", "m", f"outline of the 90 % region of {name}")
        for time, outline in zip(path.time.tolist(), outlines, strict=True):
            yield McapMessage(time, region, _points(outline, colour))


def _points(
    points: Float[np.ndarray, "point 2"],
    colours: tuple[int, ...] | UInt8[np.ndarray, "point 4"],
    frame: str = FRAME,
    height: float = 0.0,
) -> Any:
    """Return a point cloud of points x, y [m] at one height [m] with one or several colours."""
    cloud = _schema("PointCloud")(frame_id=frame, pose={"orientation": {"w": 1.0}}, point_stride=16)
    for k, name in enumerate(("x", "y", "z")):
        cloud.fields.add(name=name, offset=4 * k, type=_FLOAT32)
    for k, name in enumerate(("red", "green", "blue", "alpha")):
        cloud.fields.add(name=name, offset=12 + k, type=_UINT8)
    rows = np.zeros(len(points), [("place", "<f4", 3), ("colour", "u1", 4)])
    rows["place"][:, :2], rows["place"][:, 2], rows["colour"] = points, height, colours
    cloud.data = rows.tobytes()
    return cloud


def _floor_map(floor: FloorMap, time: float) -> McapMessage:
    """Return the middles of a map's cells, on a channel that names the colours of the floors."""
    every = int(np.ceil(np.sqrt(floor.cells.size / MOST_CELLS)))
    rows, columns = (np.arange(every // 2, n, every) for n in floor.cells.shape)
    x, y = (k * floor.cell + 0.5 * floor.cell for k in (columns, rows))
    middles = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2) + floor.corner
    of_floors = np.array(FLOOR_COLOURS, np.uint8)[
        np.arange(len(floor.surfaces)) % len(FLOOR_COLOURS)
    ]
    colours = of_floors[floor.cells[np.ix_(rows, columns)].ravel()]
    named = ", ".join(
        f"{name} #{colour[:3].tobytes().hex()}"
        for name, colour in zip(floor.surfaces, of_floors, strict=True)
    )
    channel = McapChannel("/floor_map", "m", f"middles of cells; colours of the floors: {named}")
    return McapMessage(time, channel, _points(middles, colours, height=-BELOW_M))


def _of_estimate(view: RunView, found: EstimatedRun) -> Iterator[McapMessage]:
    """Yield beliefs about the floors, slip and speeds of the wheels from the estimator."""
    some = found.rows(_apart(found.time))
    e, drives = some.estimate, _drives(view)
    floors = (*e.labels, NO_FLOOR)
    belief = np.asarray(e.surface_probability).mean(axis=1)
    channel = McapChannel(
        "/floor/probability", "1", "probability of each floor, mean over the wheels"
    )
    yield from _rows(channel, "FloorProbability", floors, some.time, belief)
    wheels = [f"wheel_{k}" for k in range(1, e.surface.shape[1] + 1)]
    channel = McapChannel("/floor/under_wheels", "name", "most probable floor under each wheel")
    yield from _rows(channel, "FloorUnderWheels", wheels, some.time, e.surface)
    channel = McapChannel("/slip_ratio", "1", "slip ratio of each wheel by the estimator")
    yield from _rows(channel, "SlipRatio", drives, some.time, np.asarray(e.slip))
    channel = McapChannel("/wheel_speed_rad_s", "rad/s", "speed of each wheel")
    yield from _rows(channel, "WheelSpeed", drives, some.time, np.asarray(e.wheel_speed))


def _currents(view: RunView) -> Iterator[McapMessage]:
    """Yield the measured motor currents or torques, in the rows with a new reading."""
    log = view.log
    if log.current is None:
        return
    fresh = np.isfinite(log.current)
    if log.current_fresh is not None:
        fresh &= log.current_fresh
    rows = np.flatnonzero(fresh.any(axis=1))
    rows = rows[_apart(log.time[rows])]
    read = np.where(fresh, log.current, np.nan)[rows]
    channel, kind = McapChannel("/current_a", "A", "measured motor currents"), "Current"
    if log.current_is_torque:
        channel, kind = McapChannel("/torque_nm", "N m", "measured torques at the wheels"), "Torque"
    yield from _rows(channel, kind, _drives(view), log.time[rows], read)


def _drives(view: RunView) -> list[str]:
    """Return the names of the drives: wheels, unless a motor drives several of them."""
    name = "wheel" if view.log.wheels == len(view.wheels) else "drive"
    return [f"{name}_{k}" for k in range(1, view.log.wheels + 1)]


def _apart(time: Float[np.ndarray, " row"]) -> np.ndarray:
    """Return the rows that are at least about `LEAST_APART_S` apart."""
    return np.unique(np.floor(time / LEAST_APART_S + 1e-6), return_index=True)[1]


def _rows(
    channel: McapChannel, kind: str, names: Sequence[str], time: np.ndarray, values: np.ndarray
) -> Iterator[McapMessage]:
    """Yield a message for every row of numbers or of words, with a field for every column."""
    fields = _field_names(names)
    made = _record(kind, fields, values.dtype.kind == "U")
    for t, row in zip(time.tolist(), values.tolist(), strict=True):
        yield McapMessage(t, channel, made(**dict(zip(fields, row, strict=True))))


def _field_names(names: Iterable[str]) -> tuple[str, ...]:
    """Return names as different names of protobuf fields, with `_` for all other characters."""
    out: list[str] = []
    for name in names:
        field = re.sub(r"\W", "_", name, flags=re.ASCII)
        field = field if field[:1].isalpha() else f"_{field}"
        while field in out:
            field += "_"
        out.append(field)
    return tuple(out)


@cache
def _record(kind: str, fields: tuple[str, ...], words: bool) -> Callable[..., Any]:
    """Return the class of the messages `slipid.<kind>` with these fields."""
    from google.protobuf.descriptor_pb2 import FileDescriptorProto
    from google.protobuf.descriptor_pool import DescriptorPool
    from google.protobuf.message_factory import GetMessageClass

    file = FileDescriptorProto(name=f"slipid/{kind}.proto", package="slipid", syntax="proto3")
    message = file.message_type.add(name=kind)
    for number, name in enumerate(fields, start=1):
        message.field.add(name=name, number=number, type=_STRING if words else _DOUBLE, label=1)
    pool = DescriptorPool()
    pool.Add(file)
    made: Callable[..., Any] = GetMessageClass(pool.FindMessageTypeByName(f"slipid.{kind}"))
    return made
