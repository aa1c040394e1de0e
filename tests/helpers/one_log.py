"""The one run in a log file."""

from pathlib import Path

from slipid.data.log import Log
from slipid.data.reading.layout import Layout
from slipid.data.reading.reader import read_logs


def read_log(
    path: Path,
    layout: Layout,
    *,
    root: Path | None = None,
    surface: str | None = None,
    load: str = "as_built",
) -> Log:
    """Arguments as of `read_logs`; the run is named after its file where there is no root."""
    (log,) = read_logs(path, layout, root or path.parent, surface, load)
    return log
