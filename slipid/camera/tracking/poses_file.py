"""A file of tracked poses that logs may have beside them: CSV or Parquet, a row for each frame.

Columns: frame; time [s]; x, y [m], heading [rad], empty where the frame has no pose; their
covariance (var_x, var_y, var_heading, cov_xy, cov_x_heading, cov_y_heading) [m, rad]; size, the
apparent over the true size of the markers [1]; rejected_x, rejected_y, rejected_heading, a pose
that was fitted and rejected; and flag, a word.
"""

import io
from pathlib import Path
from types import ModuleType

import numpy as np

from slipid.camera.tracking.track import Flag, TrackedPoses
from slipid.support.errors import DataError
from slipid.support.files import writable, write_bytes

_FORMATS = {
    **dict.fromkeys(("time", "x", "y", "heading"), "%.6f"),
    **dict.fromkeys(("var_x", "var_y", "var_heading"), "%.4g"),
    **dict.fromkeys(("cov_xy", "cov_x_heading", "cov_y_heading"), "%.4g"),
    "size": "%.5f",
    **dict.fromkeys(("rejected_x", "rejected_y", "rejected_heading"), "%.6f"),
}
"""Format in CSV of each column of numbers."""
_HEAD = ",".join(["frame", *_FORMATS, "flag"])


def check_writable(path: Path) -> None:
    """Check that poses can be written to a file.

    Raises:
        DataError: they cannot, or it is Parquet without pyarrow.
    """
    suffix = path.suffix.lower()
    if path.is_dir():
        raise DataError(f"{path}: a folder; expected the name of a file, .csv or .parquet")
    if suffix not in (".csv", ".parquet"):
        raise DataError(f"{path}: expected a name that ends in .csv or .parquet")
    if suffix == ".csv" and path.is_file():
        with path.open("rb") as file:
            head = file.read(len(_HEAD))
        if head not in (b"", _HEAD.encode()):
            raise DataError(
                f"{path}: there is a file of another kind, which would be lost; expected another "
                "name"
            )
    if suffix == ".parquet":
        _pyarrow()
    writable(path.parent)


def write_poses(path: Path, track: TrackedPoses) -> None:
    """Write tracked poses: Parquet where the name ends in .parquet, otherwise CSV.

    Raises:
        DataError: nothing can be written there, or Parquet without pyarrow.
    """
    parquet = path.suffix.lower() == ".parquet"
    write_bytes(path, _parquet(track) if parquet else _csv(track).encode())


def _columns(track: TrackedPoses) -> dict[str, np.ndarray]:
    """Return the columns of numbers, NaN where a cell is empty."""
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
    try:
        import pyarrow.parquet
    except ImportError as error:
        raise DataError(
            f"Parquet needs {error.name}; expected: pip install 'slipid[parquet]', or a name that "
            "ends in .csv"
        ) from error
    return pyarrow


def _parquet(track: TrackedPoses) -> bytes:
    pa = _pyarrow()
    columns = {
        name: pa.array(values, mask=~np.isfinite(values))
        for name, values in _columns(track).items()
    }
    table = pa.table({"frame": track.frame, **columns, "flag": _flags(track)})
    out = io.BytesIO()
    pa.parquet.write_table(table, out)
    return out.getvalue()
