"""Times of frames: given in a file, or even."""

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from slipid.support.errors import DataError, bad_data

UNEVEN = 0.2
"""Part by which times between frames may differ from their median and still count as even."""


def read_times(path: Path) -> Float[np.ndarray, " frame"]:
    """Times [s] of frames 0, 1, 2, ... from a CSV file with the columns frame and time.

    Raises:
        DataError: unreadable, other columns, frames left out, or times that do not increase.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = list(csv.reader(file))
    except OSError as error:
        raise DataError(f"{path}: {error.strerror}; expected times of frames") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise DataError(f"{path}: no CSV text; expected the columns frame, time") from error
    if not rows or [cell.strip() for cell in rows[0][:2]] != ["frame", "time"]:
        raise bad_data(path, "other columns", "the columns frame, time [s]", row=1)
    out: list[float] = []
    for line, row in enumerate(rows[1:], 2):
        try:
            number, at = int(row[0]), float(row[1])
        except (ValueError, IndexError):
            raise bad_data(path, f"{','.join(row)!r}", "a frame and its time", row=line) from None
        if number != len(out):
            raise bad_data(path, f"frame {number}", f"frame {len(out)}", row=line)
        if not np.isfinite(at) or (out and at <= out[-1]):
            raise bad_data(path, f"time {at:g}", "times that increase", row=line)
        out.append(at)
    return np.array(out)


def even_times(count: int, fps: float) -> Float[np.ndarray, " frame"]:
    """Times [s] of frames that come evenly from 0 on; DataError where the rate is none."""
    if not 0 < fps < np.inf:
        raise DataError(f"--fps {fps:g}; expected frames per second")
    return np.arange(count) / fps


def uneven(times: Sequence[float] | Float[np.ndarray, " frame"]) -> str | None:
    """A sentence where frames do not come evenly, for a person to know."""
    steps = np.diff(np.asarray(times, float))
    if len(steps) < 2:
        return None
    usual, least, most = np.median(steps), steps.min(), steps.max()
    if most <= (1 + UNEVEN) * usual and least >= (1 - UNEVEN) * usual:
        return None
    return (
        f"frames come every {1e3 * least:.0f} to {1e3 * most:.0f} ms, mostly {1e3 * usual:.0f}: a "
        "variable frame rate; times are those of the frames themselves"
    )
