"""A track as a file of poses that logs may have beside them: CSV or Parquet, a row per frame.

Columns: frame; time [s]; x, y [m], heading [rad], empty where the frame has no pose; the
covariance of these (var_x, var_y, var_heading, cov_xy, cov_x_heading, cov_y_heading) [m, rad];
size, how large the markers look over what they are; flag, a word; and rejected_x, rejected_y,
rejected_heading, a pose that was found and not believed.
"""

import io
from pathlib import Path
from types import ModuleType

import numpy as np

from slipid.camera.tracking.track import Flag, Track
from slipid.support.errors import DataError
from slipid.support.files import writable, write_bytes

_NUMBERS = {
    "time": "%.6f",
    "x": "%.6f",
    "y": "%.6f",
    "heading": "%.6f",
    "var_x": "%.4g",
    "var_y": "%.4g",
    "var_heading": "%.4g",
    "cov_xy": "%.4g",
    "cov_x_heading": "%.4g",
    "cov_y_heading": "%.4g",
    "size": "%.5f",
    "rejected_x": "%.6f",
    "rejected_y": "%.6f",
    "rejected_heading": "%.6f",
}
"""Columns of numbers, and how CSV writes them."""


_HEAD = ",".join(["frame", *_NUMBERS, "flag"])


def can_write(path: Path) -> None:
    """Try whether poses can be written there.

    Raises:
        DataError: not so, or Parquet without pyarrow.
    """
    if path.is_dir():
        raise DataError(f"{path}: a folder; expected the name of a file, .csv or .parquet")
    if path.suffix.lower() not in (".csv", ".parquet"):
        raise DataError(f"{path}: expected a name that ends in .csv or .parquet")
    if path.suffix.lower() == ".csv" and path.is_file() and not _is_ours(path):
        raise DataError(
            f"{path}: there is a file of another kind, which would be lost; expected another name"
        )
    if _is_parquet(path):
        _pyarrow()
    writable(path.parent)


def write_poses(path: Path, track: Track) -> None:
    """Write a track; the suffix .parquet makes it Parquet, everything else CSV.

    Raises:
        DataError: nothing can be written there, or Parquet without pyarrow.
    """
    write_bytes(path, _parquet(track) if _is_parquet(path) else _csv(track).encode())


def _is_ours(path: Path) -> bool:
    """Whether a file is one of tracked poses, or empty."""
    with path.open("rb") as file:
        begin = file.read(len(_HEAD))
    return begin in (b"", _HEAD.encode())


def _is_parquet(path: Path) -> bool:
    return path.suffix.lower() == ".parquet"


def _columns(track: Track) -> dict[str, np.ndarray]:
    """Columns of numbers, NaN where a cell is empty."""
    p, c, r = track.pose, track.covariance, track.rejected
    values = (
        *(track.time, p[:, 0], p[:, 1], p[:, 2]),
        *(c[:, 0, 0], c[:, 1, 1], c[:, 2, 2], c[:, 0, 1], c[:, 0, 2], c[:, 1, 2]),
        *(track.size, r[:, 0], r[:, 1], r[:, 2]),
    )
    return dict(zip(_NUMBERS, values, strict=True))


def _words(track: Track) -> list[str]:
    return [Flag(flag).word for flag in track.flag.tolist()]


def _csv(track: Track) -> str:
    columns, out = _columns(track), io.StringIO()
    out.write(",".join(["frame", *_NUMBERS, "flag"]) + "\n")
    words = _words(track)
    for k, number in enumerate(track.frame.tolist()):
        cells = [
            _NUMBERS[name] % values[k] if np.isfinite(values[k]) else ""
            for name, values in columns.items()
        ]
        out.write(",".join([str(number), *cells, words[k]]) + "\n")
    return out.getvalue()


def _pyarrow() -> ModuleType:
    try:
        import pyarrow.parquet
    except ImportError as error:
        raise DataError(
            f"Parquet needs {error.name}; expected: pip install 'slipid[parquet]', or a name that "
            "ends in .csv"
        ) from error
    return pyarrow


def _parquet(track: Track) -> bytes:
    pa = _pyarrow()
    columns = {
        name: pa.array(values, mask=~np.isfinite(values))
        for name, values in _columns(track).items()
    }
    table = pa.table({"frame": track.frame, **columns, "flag": _words(track)})
    out = io.BytesIO()
    pa.parquet.write_table(table, out)
    return out.getvalue()
