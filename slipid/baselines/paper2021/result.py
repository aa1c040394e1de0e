"""Everything the paper's data says, in one value: tables, tracks, transfer between surfaces."""

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

from slipid.baselines.paper2021 import table as tables
from slipid.baselines.paper2021.table import FittedForm, MotorTable, field_table, surface_tables
from slipid.baselines.paper2021.tracks import TRACK_FILES, Track, read_track
from slipid.baselines.paper2021.transfer import Transfer, leave_one_surface_out
from slipid.data.log import Log
from slipid.support.errors import DataError

SCHEMA = "slipid.paper2021/1"


@dataclass(frozen=True, eq=False)
class PaperResult:
    """The paper regenerated.

    Args:
        field: figure 2, motor 1 over the whole site.
        motors: figures 3 and 4 and their table, by motor.
        tracks: figure 7.
        transfer: one current curve across surfaces of the 2022 runs; None where they are absent.
    """

    field: MotorTable
    motors: dict[int, MotorTable]
    tracks: tuple[Track, ...]
    transfer: Transfer | None

    def as_dict(self) -> dict[str, object]:
        """All numbers by name, ready for JSON."""
        return {
            "schema": SCHEMA,
            "figure2": _table_dict(1, self.field),
            "figures3and4": {f"motor{m}": _table_dict(m, t) for m, t in self.motors.items()},
            "figure7": {track.file.name: track.as_dict() for track in self.tracks},
            "deployed": {
                "gain_per_A": tables.DEPLOYED_GAIN,
                "offset": tables.DEPLOYED_OFFSET,
                "threshold_A": tables.DEPLOYED_THRESHOLD,
                "memory": tables.DEPLOYED_MEMORY,
            },
            "transfer": self.transfer and {**asdict(self.transfer), "mean": self.transfer.mean()},
        }


def find_folder(data: Path) -> Path:
    """The 2021 data set under a data root, or the root itself; DataError if it is neither."""
    for folder in (data / "robotino2021", data):
        if (folder / "experimental_data_gray.csv").is_file():
            return folder
    raise DataError(
        f"{data}: no 2021 data set; expected robotino2021/experimental_data_gray.csv below it, "
        "or experimental_data_gray.csv in it"
    )


def regenerate(folder: Path, logs: Iterable[Log] | None = None) -> PaperResult:
    """Compute the paper's numbers from its own data.

    Args:
        logs: the 2022 runs on one surface each, for the transfer between surfaces; None without.
    """
    return PaperResult(
        field=field_table(folder),
        motors=surface_tables(folder),
        tracks=tuple(read_track(folder, file) for file in TRACK_FILES),
        transfer=None if logs is None else leave_one_surface_out(logs),
    )


def _form_dict(form: FittedForm) -> dict[str, object]:
    return asdict(form) | {"unit": "N m" if form.regressor == "torque" else "A"}


def _table_dict(motor: int, table: MotorTable) -> dict[str, object]:
    return {
        "motor": motor,
        "n": len(table.samples),
        "n_by_surface": {name: len(part) for name, part in table.by_surface.items()},
        "models": {name: _form_dict(form) for name, form in table.forms.items()},
        "stored": None if table.stored is None else _form_dict(table.stored),
    }
