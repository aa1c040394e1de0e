"""Output of tracked poses: a file of poses to go with a log, and an image for a check by eye.

The file is CSV or Parquet, with a row for each frame. Columns: frame; time [s]; x, y [m],
heading [rad], empty if the frame has no pose; the covariance of the pose (var_x, var_y,
var_heading, cov_xy, cov_x_heading, cov_y_heading) in products of [m, m, rad]; size, the apparent
size of the markers divided by the true size [1]; rejected_x, rejected_y [m], rejected_heading
[rad], a fitted but rejected pose; and flag, the name of a `slipid.camera.tracking.track.Flag`.
"""

import io
import struct
import zlib
from importlib import import_module
from pathlib import Path
from types import ModuleType

import numpy as np
from jaxtyping import Float, UInt8

from slipid.camera.opencv import Grey, cv2
from slipid.camera.overhead import OverheadCamera
from slipid.camera.tracking.track import Flag, TrackedPoses
from slipid.support.errors import DataError
from slipid.support.extras import require
from slipid.support.files import writable, write_bytes
from slipid.support.folder import MARKS, refuse_foreign

_FORMATS = {
    **dict.fromkeys(("time", "x", "y", "heading"), "%.6f"),
    **dict.fromkeys(("var_x", "var_y", "var_heading"), "%.4g"),
    **dict.fromkeys(("cov_xy", "cov_x_heading", "cov_y_heading"), "%.4g"),
    "size": "%.5f",
    **dict.fromkeys(("rejected_x", "rejected_y", "rejected_heading"), "%.6f"),
}
"""Number format in CSV of each column except frame and flag."""
_HEAD = ",".join(["frame", *_FORMATS, "flag"])
_PARQUET_MARK = "slipid.poses"
_PICTURE_MARK = MARKS[".png"]


def check_writable(path: Path) -> None:
    """Raise `DataError` unless poses can be written to a file.

    Raises:
        DataError: the file cannot be written, would replace a file that holds no tracked poses, or
            is Parquet and pyarrow is not installed.
    """
    suffix = path.suffix.lower()
    if path.is_dir():
        raise DataError(f"{path}: a folder; expected the name of a file, .csv or .parquet")
    if suffix not in (".csv", ".parquet"):
        raise DataError(
            f"{path}: not a name for a file of poses; expected one that ends in .csv or .parquet"
        )
    refuse_foreign(path, (_HEAD if suffix == ".csv" else _PARQUET_MARK).encode())
    if suffix == ".parquet":
        _pyarrow()
    writable(path.parent)


def write_poses(path: Path, track: TrackedPoses) -> None:
    """Write tracked poses as Parquet if the name ends in .parquet, otherwise as CSV.

    Raises:
        DataError: the file cannot be written, or is Parquet and pyarrow is not installed.
    """
    parquet = path.suffix.lower() == ".parquet"
    write_bytes(path, _parquet(track) if parquet else _csv(track).encode())


def _columns(track: TrackedPoses) -> dict[str, np.ndarray]:
    """Return the columns listed in `_FORMATS`, keyed by name, with NaN for empty cells."""
    p, c, r = track.pose, track.covariance, track.rejected
    values = (
        *(track.time, p[:, 0], p[:, 1], p[:, 2]),
        *(c[:, 0, 0], c[:, 1, 1], c[:, 2, 2], c[:, 0, 1], c[:, 0, 2], c[:, 1, 2]),
        *(track.size, r[:, 0], r[:, 1], r[:, 2]),
    )
    return dict(zip(_FORMATS, values, strict=True))


def _flags(track: TrackedPoses) -> list[str]:
    return [Flag(flag).word for flag in track.flag.tolist()]


def _csv(track: TrackedPoses) -> str:
    columns = [
        [form % value if np.isfinite(value) else "" for value in values]
        for form, values in zip(_FORMATS.values(), _columns(track).values(), strict=True)
    ]
    rows = zip(map(str, track.frame.tolist()), *columns, _flags(track), strict=True)
    return "".join(line + "\n" for line in (_HEAD, *map(",".join, rows)))


def _pyarrow() -> ModuleType:
    require("pyarrow.parquet", "parquet", "a file of poses that does not end in .csv")
    return import_module("pyarrow")


def _parquet(track: TrackedPoses) -> bytes:
    pa = _pyarrow()
    columns = {
        name: pa.array(values, mask=~np.isfinite(values))
        for name, values in _columns(track).items()
    }
    table = pa.table({"frame": track.frame, **columns, "flag": _flags(track)})
    out = io.BytesIO()
    pa.parquet.write_table(table.replace_schema_metadata({"schema": _PARQUET_MARK}), out)
    return out.getvalue()


GRID_M = 0.25
"""Distance between neighbouring lines of the grid drawn on the floor [m]."""
GRID_BGR, EDGE_BGR, AHEAD_BGR, LEFT_BGR = (
    (190, 190, 60),
    (0, 170, 255),
    (40, 40, 230),
    (60, 190, 60),
)
"""Colours, as blue, green, red, of the grid on the floor, the edges of markers, and the axes of a
body that point ahead and to the left."""


def write_preview(
    path: Path, grey: Grey, camera: OverheadCamera, tracks: tuple[TrackedPoses, ...], row: int
) -> None:
    """Write a frame as an image with a floor grid, the markers' edges and the bodies' axes.

    Args:
        path: the PNG or JPEG file to write.
        grey: the frame.
        camera: the camera that took the frame.
        tracks: tracked poses of every body.
        row: row of the frame in the tracks.

    Raises:
        DataError: the suffix is not that of an image, or the file cannot be written.
    """
    drawn = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
    _grid(drawn, camera)
    for track in tracks:
        if track.good[row]:
            _body(drawn, camera, track, track.pose[row])
    write_bytes(path, _encoded(path, drawn))


def check_drawable(path: Path) -> None:
    """Raise `DataError` unless an image can be written to a file.

    Raises:
        DataError: the file cannot be written, or the suffix is not that of an image.
    """
    _encoded(path, np.zeros((8, 8, 3), np.uint8))
    refuse_foreign(path, _PICTURE_MARK)
    writable(path.parent)


def _encoded(path: Path, drawn: UInt8[np.ndarray, "row column 3"]) -> bytes:
    """Return a picture as PNG or JPEG with the mark of slipid's pictures in it."""
    suffix, mark = path.suffix.lower(), _PICTURE_MARK
    if suffix not in (".png", ".jpg", ".jpeg"):
        raise DataError(f"{path}: not a name for a picture; expected one that ends in .png or .jpg")
    data = bytes(cv2.imencode(suffix, drawn)[1])
    if suffix == ".png":  # a chunk of text behind the signature and the header
        text = b"tEXt" + mark
        parts = struct.pack(">I", len(mark)), text, struct.pack(">I", zlib.crc32(text))
        return data[:33] + b"".join(parts) + data[33:]
    # a comment behind the marker of the picture's begin
    return data[:2] + b"\xff\xfe" + struct.pack(">H", len(mark) + 2) + mark + data[2:]


def _line(
    drawn: np.ndarray,
    camera: OverheadCamera,
    points: Float[np.ndarray, "point 3"],
    colour: tuple[int, int, int],
    width: int,
) -> None:
    """Draw a line through points in the world [m], unless one of them is far off the image."""
    pixels = camera.pixels(points)
    if np.isfinite(pixels).all() and (np.abs(pixels) < 1e5).all():
        whole = np.round(pixels).astype(np.int32).reshape(-1, 1, 2)
        cv2.polylines(drawn, [whole], False, colour, width, cv2.LINE_AA)


def _grid(drawn: np.ndarray, camera: OverheadCamera) -> None:
    """Draw a grid on the visible floor, and write the distance between its lines."""
    width, height = camera.lens.image_px
    frame = np.stack(np.meshgrid(np.linspace(0, width, 9), np.linspace(0, height, 9)), -1)
    floor = camera.on_plane(frame.reshape(-1, 2), 0.0)
    floor = floor[np.isfinite(floor).all(axis=1)]
    low, high = floor.min(axis=0), floor.max(axis=0)
    # a tilted camera may see floor up to the horizon: draw at most 100 lines along each axis
    high = np.minimum(high, low + 100 * GRID_M)
    lines = [np.arange(np.ceil(low[k] / GRID_M), high[k] / GRID_M) * GRID_M for k in range(2)]
    for axis in range(2):
        along = np.linspace(low[1 - axis], high[1 - axis], 40)
        for at in lines[axis]:
            points = np.zeros((len(along), 3))
            points[:, axis], points[:, 1 - axis] = at, along
            _line(drawn, camera, points, GRID_BGR, 2 if abs(at) < 1e-9 else 1)
            if abs(at) > 1e-9:
                _label(drawn, camera, at * np.eye(3)[axis], f"{'xy'[axis]} {at:g}")
    text = f"lines on the floor every {GRID_M:g} m, thick through the origin"
    cv2.putText(drawn, text, (20, height - 20), cv2.FONT_HERSHEY_SIMPLEX, 0.8, GRID_BGR, 2)


def _label(
    drawn: np.ndarray, camera: OverheadCamera, place: Float[np.ndarray, "3"], text: str
) -> None:
    """Write text next to a point on the floor [m], if the point lies in the image."""
    x, y = camera.pixels(place[None])[0].tolist()
    width, height = camera.lens.image_px
    if 0 <= x < width and 0 <= y < height:
        where = (round(x) + 6, round(y) - 6)
        cv2.putText(drawn, text, where, cv2.FONT_HERSHEY_SIMPLEX, 0.6, GRID_BGR, 1, cv2.LINE_AA)


def _body(
    drawn: np.ndarray, camera: OverheadCamera, track: TrackedPoses, pose: Float[np.ndarray, "3"]
) -> None:
    """Draw the markers' edges as computed from a pose, and the body's axes, x red and y green."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    place = np.array([pose[0], pose[1], 0.0])
    for marker in track.target.markers:
        around = marker.corners[[0, 1, 2, 3, 0]] @ turn.T + place
        _line(drawn, camera, around, EDGE_BGR, 2)
    length = 1.5 * max(marker.size for marker in track.target.markers)
    origin = np.array([0.0, 0.0, track.target.height])
    for axis, colour in enumerate((AHEAD_BGR, LEFT_BGR)):
        tip = origin + length * np.eye(3)[axis]
        _line(drawn, camera, np.stack([origin, tip]) @ turn.T + place, colour, 3)
    at = camera.pixels((origin + place)[None])[0] + (30, -60)
    text = f"{track.target.name}: {pose[0]:.3f}, {pose[1]:.3f} m, {np.degrees(pose[2]):.1f} deg"
    where = tuple(np.round(at).astype(int).tolist())
    cv2.putText(drawn, text, where, cv2.FONT_HERSHEY_SIMPLEX, 0.9, AHEAD_BGR, 2)
