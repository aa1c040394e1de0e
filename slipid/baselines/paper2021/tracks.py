"""The three camera tracks of figure 7: how far along the side, how crooked, how far from home."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slipid.baselines.paper2021.samples import read_columns
from slipid.support.errors import bad_data


@dataclass(frozen=True)
class TrackFile:
    """One camera track of the 2021 data set and how the paper describes it.

    Args:
        name: key in results.
        label: what steered the robot.
        square: how files in the folder figure7 call it: `square_<this>_camera.csv`.
        authors_frames: camera frames of the first side, by the authors' own index.
        side_frames: camera frames of the first side in this file, to where the robot turns off.
        printed_path_length: length of the first side as the paper prints it [mm].
    """

    name: str
    label: str
    square: str
    authors_frames: int
    side_frames: int
    printed_path_length: float


# Encoders: by the authors' index the first side has 216 frames, but this track turns off at frame
# 181. Their length script reads a variable of another name, most likely a repeat of the run.
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
class Track:
    """One camera track, with the numbers a reader of figure 7 asks for.

    Args:
        file: where it comes from.
        time: [s], shape (frame,).
        position: image x to the right and y down [mm], shape (frame, 2).
        heading: heading as logged [deg], unwrapped, shape (frame,).
    """

    file: TrackFile
    time: np.ndarray
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
        """Way gained along the commanded side, image y [mm]."""
        return float(abs(self.side[-1, 1] - self.side[0, 1]))

    @property
    def closure(self) -> float:
        """Distance from the first to the last position of the whole track [mm]."""
        return float(np.hypot(*(self.position[-1] - self.position[0])))

    def as_dict(self) -> dict[str, float | str | int]:
        """The numbers by name, units in the names."""
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


def read_track(folder: Path, file: TrackFile) -> Track:
    """One track of figure 7; DataError where the file is broken or ends within its first side."""
    path = folder / "figure7" / f"square_{file.square}_camera.csv"
    table = read_columns(path, "robotino2021_camera")
    frames = len(table["time_s"])
    if frames < file.side_frames:
        expected = f"at least the {file.side_frames} of the first side"
        raise bad_data(path, f"{frames} frames", expected)
    return Track(
        file=file,
        time=table["time_s"],
        position=np.stack([table["x_mm"], table["y_mm"]], axis=1),
        heading=np.degrees(np.unwrap(np.radians(table["angle_deg"]))),
    )
