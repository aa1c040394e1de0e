"""The one run in a log file."""

from pathlib import Path

from slipid.data.log import Log
from slipid.data.reading.layout import Layout
from slipid.data.reading.reader import read_logs
from slipid.support.errors import DataError


def read_log(
    path: Path,
    layout: Layout,
    *,
    root: Path | None = None,
    surface: str | None = None,
    load: str = "as_built",
) -> Log:
    """Arguments as of `read_logs`; the run is named after its file where there is no root."""
    found = read_logs(path, layout, root or path.parent, surface, load)
    if found.aside:
        raise DataError(found.aside[0])
    (log,) = found.logs
    return log
