"""Logs: readers, units, signals and the batched dataset."""

from slipid.data.formats import Layout, layout_from_mapping, preset
from slipid.data.log import DataError, Log
from slipid.data.reader import find_logs, read_log, read_logs, read_table

__all__ = [
    "DataError",
    "Layout",
    "Log",
    "find_logs",
    "layout_from_mapping",
    "preset",
    "read_log",
    "read_logs",
    "read_table",
]
