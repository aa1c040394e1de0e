"""Everything the paper's data says, in one value: tables, tracks, transfer between surfaces."""

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

from slipid.baselines.paper2021.models import DEPLOYED
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
            "figure2": _table_dict(self.field),
            "figures3and4": {f"motor{m}": _table_dict(table) for m, table in self.motors.items()},
            "figure7": {track.file.name: track.as_dict() for track in self.tracks},
            "deployed": {
                "gain_per_A": DEPLOYED.gain.tolist(),
                "offset": DEPLOYED.offset.tolist(),
                "threshold_A": DEPLOYED.threshold,
                "memory": DEPLOYED.memory,
            },
            "transfer": None
            if self.transfer is None
            else {**asdict(self.transfer), "mean": self.transfer.mean()},
        }

    def __str__(self) -> str:
        parts = [_motor_lines(self.motors), _field_lines(self.field), _track_lines(self.tracks)]
        if self.transfer is not None:
            parts.append(_transfer_lines(self.transfer))
        return "\n\n".join(parts)


def find_folder(data: Path) -> Path:
    """The 2021 data set under a data root, or the root itself if it is that set.

    Raises:
        DataError: if neither is.
    """
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
        folder: the 2021 data set.
        logs: the 2022 runs on one surface each, for the transfer between surfaces; None without.

    Raises:
        DataError: if a file or a column is missing.
    """
    return PaperResult(
        field=field_table(folder),
        motors=surface_tables(folder),
        tracks=tuple(read_track(folder, file) for file in TRACK_FILES),
        transfer=None if logs is None else leave_one_surface_out(logs),
    )


def _form_dict(form: FittedForm) -> dict[str, object]:
    said = asdict(form)
    del said["name"]
    return said | {"unit": "N m" if form.regressor == "torque" else "A"}


def _table_dict(table: MotorTable) -> dict[str, object]:
    return {
        "motor": table.motor,
        "n": len(table.samples),
        "n_by_surface": {name: len(part) for name, part in table.by_surface.items()},
        "models": {name: _form_dict(form) for name, form in table.forms.items()},
        "stored": None if table.stored is None else _form_dict(table.stored),
    }


def _motor_lines(motors: dict[int, MotorTable]) -> str:
    head = "Root mean square error in slip, surfaces pooled (figures 3 and 4)"
    rows: list[tuple[str, ...]] = [("", *(f"motor {m}" for m in motors))]
    rows.append(("samples", *(str(len(t.samples)) for t in motors.values())))
    slopes = (f"{t.forms['linear in M'].coefficients[0]:.4f}" for t in motors.values())
    rows.append(("slope of the linear model [1/(N m)]", *slopes))
    rows.extend(
        (name, *(f"{t.forms[name].rmse:.4f}" for t in motors.values()))
        for name in next(iter(motors.values())).forms
    )
    stored = ("-" if t.stored is None else f"{t.stored.rmse:.4f}" for t in motors.values())
    rows.append(("the paper's stored quadratic", *stored))
    return head + "\n" + _columns(rows)


def _field_lines(field: MotorTable) -> str:
    fit = field.forms["affine in I"]
    lines = [f"Whole site, motor 1 (figure 2): {len(field.samples)} samples"]
    for label, form in (("least squares", fit), ("the paper's SVR", field.stored)):
        if form is not None:
            c0, c1 = form.coefficients
            lines.append(f"  {label:<16} s = {c0:.3f} + {c1:.3f} I   RMSE {form.rmse:.4f}")
    return "\n".join(lines)


def _track_lines(tracks: tuple[Track, ...]) -> str:
    rows: list[tuple[str, ...]] = [
        ("", "path mm", "printed mm", "along side mm", "closure mm", "heading deg")
    ]
    for t in tracks:
        heading = f"{t.heading[0]:.0f} to {t.heading[-1]:.0f}"
        numbers = (t.path_length, t.file.printed_path_length, t.displacement, t.closure)
        rows.append((t.file.label, *(f"{x:.0f}" for x in numbers), heading))
    return "Camera tracks (figure 7), first side 900 mm\n" + _columns(rows)


def _transfer_lines(transfer: Transfer) -> str:
    rows: list[tuple[str, ...]] = [("", "others' curve", "others' mean", "own curve")]
    for surface in transfer.samples:
        errors = (transfer.pooled[surface], transfer.constant[surface], transfer.own[surface])
        rows.append((surface, *(f"{e:.3f}" for e in errors)))
    rows.append(("mean", *(f"{e:.3f}" for e in transfer.mean().values())))
    head = "Root mean square error in slip on a surface left out, curve in current (2022 runs)"
    return head + "\n" + _columns(rows)


def _columns(rows: list[tuple[str, ...]]) -> str:
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    lines = []
    for row in rows:
        cells = [cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True)]
        lines.append("  ".join(["", row[0].ljust(widths[0]), *cells]))
    return "\n".join(lines)
