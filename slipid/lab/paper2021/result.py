"""Results of the 2021 paper: tables, camera tracks of figure 7, transfer between surfaces."""

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from slipid.data.log import Log
from slipid.lab.paper2021 import table as tables
from slipid.lab.paper2021.samples import leave_one_surface_out, read_columns
from slipid.lab.paper2021.table import FittedForm, MotorTable, field_table, surface_tables
from slipid.support.content import Content
from slipid.support.errors import DataError, bad_data


@dataclass(frozen=True)
class TrackFile:
    """File of one camera track of the 2021 data set, with the paper's description.

    Attributes:
        name: key in results.
        label: controller of the robot.
        square: <square> in the file name `square_<square>_camera.csv` in the folder figure7.
        authors_frames: number of camera frames on the first side, according to the authors' index.
        side_frames: number of camera frames on the first side in this file, up to the robot's turn.
        printed_path_length: length of the first side printed in the paper [mm].
    """

    name: str
    label: str
    square: str
    authors_frames: int
    side_frames: int
    printed_path_length: float


# For "encoders", the authors' index gives 216 frames of the first side, but the track in the file
# turns at frame 181. The authors' script of path lengths reads a variable of another name, most
# likely from a repetition of the run.
TRACK_FILES = (
    TrackFile("encoders", "encoders only", "without_controller", 216, 181, 760.0),
    TrackFile("slip_model", "slip model", "without_controller_with_compensation", 324, 324, 940.0),
    TrackFile(
        "compensation", "slip model and torque correction", "with_controller", 268, 268, 1031.0
    ),
)
COMMANDED_SIDES = (900.0, 400.0)
"""Sides of the commanded rectangle, forward and to the right [mm]."""


@dataclass(frozen=True, eq=False)
class SquareTrack:
    """One camera track of figure 7, with the numbers shown in the figure.

    Attributes:
        file: file of the track.
        position: image x to the right and y down [mm], shape (frame, 2).
        heading: logged heading, unwrapped [deg].
    """

    file: TrackFile
    position: np.ndarray
    heading: np.ndarray

    @property
    def side(self) -> np.ndarray:
        """Positions on the first side [mm]."""
        return self.position[: self.file.side_frames]

    @property
    def path_length(self) -> float:
        """Sum of the steps between frames on the first side [mm]; camera jitter adds to it.

        The paper sums pose deltas logged by the robot, which are not in the data set.
        """
        return float(np.sum(np.hypot(*np.diff(self.side, axis=0).T)))

    @property
    def displacement(self) -> float:
        """Displacement along the commanded side, image y [mm]."""
        return float(abs(self.side[-1, 1] - self.side[0, 1]))

    @property
    def closure(self) -> float:
        """Distance from the first to the last position of the whole track [mm]."""
        return float(np.hypot(*(self.position[-1] - self.position[0])))

    def as_dict(self) -> dict[str, float | str | int]:
        """Return the lengths and headings of the track, keyed by names that end in the unit."""
        return {
            "label": self.file.label,
            "side_frames": self.file.side_frames,
            "authors_frames": self.file.authors_frames,
            "path_length_mm": self.path_length,
            "path_length_printed_mm": self.file.printed_path_length,
            "displacement_mm": self.displacement,
            "closure_mm": self.closure,
            "heading_start_deg": float(self.heading[0]),
            "heading_end_deg": float(self.heading[-1]),
        }


def read_track(folder: Path, file: TrackFile) -> SquareTrack:
    """Return one track of figure 7 from its file.

    Raises:
        DataError: the file cannot be read, or ends within the first side of the rectangle.
    """
    path = folder / "figure7" / f"square_{file.square}_camera.csv"
    table = read_columns(path, "robotino2021_camera")
    frames = len(table["time_s"])
    if frames < file.side_frames:
        expected = f"at least the {file.side_frames} of the first side"
        raise bad_data(path, f"{frames} frames", expected)
    return SquareTrack(
        file=file,
        position=np.stack([table["x_mm"], table["y_mm"]], axis=1),
        heading=np.degrees(np.unwrap(np.radians(table["angle_deg"]))),
    )


SCHEMA = "slipid.paper2021/1"


@dataclass(frozen=True, eq=False)
class PaperResult:
    """Results of the paper, computed from its data.

    Attributes:
        field: samples and models of figure 2: motor 1 over the whole site.
        motors: samples and models of figures 3 and 4 and of their table, keyed by motor number.
        tracks: camera tracks of figure 7.
        transfer: transfer of slip curves between surfaces of the 2022 runs; None without these.
    """

    field: MotorTable
    motors: dict[int, MotorTable]
    tracks: tuple[SquareTrack, ...]
    transfer: Content | None

    def as_dict(self) -> dict[str, object]:
        """Return all results, keyed by name, in the form of paper.json."""
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
            "transfer": self.transfer,
        }


def find_folder(data: Path) -> Path:
    """Return the folder of the 2021 data set: `data` itself or the folder robotino2021 in it.

    Raises:
        DataError: neither of them contains the data set.
    """
    for folder in (data / "robotino2021", data):
        if (folder / "experimental_data_gray.csv").is_file():
            return folder
    raise DataError(
        f"{data}: no 2021 data set; expected robotino2021/experimental_data_gray.csv below it, "
        "or experimental_data_gray.csv in it"
    )


def regenerate(folder: Path, logs: Iterable[Log] | None = None) -> PaperResult:
    """Compute the paper's results from its own data.

    Args:
        folder: folder of the 2021 data set.
        logs: the 2022 runs on one surface each, for the transfer between surfaces; None if the
            transfer is not computed.
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
