"""Kinds of log files that are not read, each with the usual program that converts it to CSV."""

from pathlib import Path

from slipid.support.errors import bad_data

_OTHERS = {
    ".bin": ("a DataFlash log of ArduPilot", "mavlogdump.py --format csv --types NAME (pymavlink)"),
    ".tlog": ("a telemetry log of MAVLink", "mavlogdump.py --format csv --types NAME (pymavlink)"),
    ".mat": ("a file of MATLAB", "writetimetable or writetable in MATLAB, or scipy.io.loadmat"),
    ".h5": ("an HDF5 file", "h5py or pandas.read_hdf, and DataFrame.to_csv"),
    ".hdf5": ("an HDF5 file", "h5py or pandas.read_hdf, and DataFrame.to_csv"),
    ".rrd": ("a recording of Rerun", "the dataframe API of Rerun, and DataFrame.to_csv"),
    ".wpilog": (
        "a log of WPILib",
        "DataLogTool or AdvantageScope, which export CSV (`slipid motor` reads it as it is)",
    ),
    ".xlsx": ("a workbook of Excel", "Save as CSV in the spreadsheet"),
}


def refuse_other(path: Path) -> None:
    """Raise `DataError` for a file of another kind, which names a program that converts it."""
    if found := _OTHERS.get(path.suffix.lower()):
        kind, program = found
        raise bad_data(path, kind, f"a CSV or Parquet file; convert it with: {program}")
