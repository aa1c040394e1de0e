"""FitEvidence of a fit: what a report shows of the logs, so that it needs neither logs nor models.

`identify` writes it to the result folder as evidence.json. Numbers are rounded to what a screen can
show: millimetres, milliradians and hundredths.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Self

from pydantic import BaseModel, ConfigDict, model_validator

from slipid.infer.result_content import Count, checked_result
from slipid.infer.result_folder import fit_of
from slipid.support.errors import DataError
from slipid.support.files import read_json, write_bytes

EVIDENCE, SCHEMA = "evidence.json", "slipid.evidence/1"


class _Record(BaseModel):
    """An immutable part of the evidence, without other keys than the declared ones."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class _Columns(_Record):
    """A part whose lists have one length."""

    @model_validator(mode="after")
    def _of_one_length(self) -> Self:
        """Raise `ValueError` for lists of other lengths."""
        lengths = {name: len(x) for name, x in self if isinstance(x, list)}
        if len({*lengths.values()}) > 1:
            raise ValueError(f"lists of different lengths: {lengths}")
        return self


class Track(_Columns):
    """Poses of the body along a run, in the frame of the logged poses, corrected by the camera.

    Attributes:
        x_mm, y_mm: position [mm].
        yaw_mrad: heading [mrad].
    """

    x_mm: list[int]
    y_mm: list[int]
    yaw_mrad: list[int]


class PointRegions(_Columns):
    """The 90 % regions of some predicted points of a run, which are ellipses.

    Attributes:
        edge: index of each point on the track.
        major_mm, minor_mm: half axes [mm].
        angle_mrad: direction of the major axis [mrad].
    """

    edge: list[Count]
    major_mm: list[float]
    minor_mm: list[float]
    angle_mrad: list[int]


class MapEvidence(_Record):
    """Evidence of a floor map: the part around the runs that are drawn on it.

    Attributes:
        surfaces: names of the surfaces.
        corner_m: x, y of the corner of this part with the lowest coordinates [m].
        cell_m: length of the cells in x and in y [m]; the cells of a large map are joined.
        cells: index in `surfaces` of each cell, row by row from the lowest y.
    """

    surfaces: list[str]
    corner_m: tuple[float, float]
    cell_m: tuple[float, float]
    cells: list[list[Count]]


class RunEvidence(_Record):
    """A run with its measured and predicted paths.

    Attributes:
        name, floor, load: name of the run, its floor and its load set-up. The floor of a run over
            several floors is that of most of its windows.
        map: index of the map of a run over several floors; None for a run on one floor.
        heading_deg: commanded direction of travel [deg], None if unknown.
        speed: commanded speed [m/s], None if unknown.
        seconds: duration from the first motion on [s].
        rest_s: time in the whole run in which no wheel turns [s].
        path_m: measured path length [m].
        time_s: time of each pose [s].
        measured: measured poses.
        models: predicted poses, keyed by model; all begin at the first measured pose.
        region: regions of the model that was selected on the floor, None if unknown.
        selected: name of this model.
    """

    name: str
    floor: str
    load: str
    map: Count | None = None
    heading_deg: float | None
    speed: float | None
    seconds: float
    rest_s: float
    path_m: float
    time_s: list[float]
    measured: Track
    models: Mapping[str, Track]
    region: PointRegions | None
    selected: str


class Quarters(_Columns):
    """Quarters of runs: how they were driven, and errors of the selected model, as columns.

    Attributes:
        run: index of the run.
        time_s: middle of the quarter from the start of the run [s].
        seconds: duration [s].
        speed: mean speed [m/s].
        turn_deg_s: mean yaw rate [deg/s].
        heading_deg: direction of travel in the body frame, 0 to 360 [deg]; None where it turns on
            the spot.
        along_mm_s, across_mm_s: predicted less measured motion [mm/s].
        yaw_deg_s: predicted less measured yaw rate [deg/s].
    """

    run: list[Count]
    time_s: list[float]
    seconds: list[float]
    speed: list[float]
    turn_deg_s: list[float]
    heading_deg: list[float | None]
    along_mm_s: list[float]
    across_mm_s: list[float]
    yaw_deg_s: list[float]


class WheelDots(_Columns):
    """Measured slip and torque of the wheels in segments of the runs, as columns.

    Attributes:
        run: index of the run.
        drive: index of the drive.
        torque_nm: driving torque per wheel, scaled to an even load [N m].
        slip: slip of the wheel [1].
    """

    run: list[Count]
    drive: list[Count]
    torque_nm: list[float]
    slip: list[float]


class CurrentDots(_Columns):
    """Measured and predicted motor currents in segments of the runs, as columns [A].

    Attributes:
        run: index of the run.
        drive: index of the drive.
        measured: measured currents.
        start: currents predicted before the fit, with every parameter at its start value.
        fitted: currents predicted by the fit.
    """

    run: list[Count]
    drive: list[Count]
    measured: list[float]
    start: list[float]
    fitted: list[float]


class WheelLayout(_Record):
    """WheelLayout of the robot, seen from above.

    Attributes:
        place_m: position of each wheel ahead of and to the left of the middle [m].
        angle_deg: drive direction of each wheel from straight ahead [deg].
        drive: index of the drive of each wheel.
        radius_m: radius of the wheels [m].
        sideways: True if the wheels determine motion sideways.
    """

    place_m: list[tuple[float, float]]
    angle_deg: list[float]
    drive: list[Count]
    radius_m: float
    sideways: bool


class Correlations(_Record):
    """Correlations of the fitted parameters in the Laplace covariance.

    Attributes:
        names: names of the parameters.
        percent: correlations [%], row by row.
    """

    names: list[str]
    percent: list[list[int]]


class FitEvidence(_Record):
    """Everything that a report shows of the logs.

    Attributes:
        schema_: name and version of the format.
        data_hash: hash of the logs, which run.json and identified.json repeat.
        fit: checksum of the fit, which `write_evidence` adds; None in files of older versions.
        wheels: wheels of the robot.
        runs: runs on one floor each, with their paths; empty if poses lack coordinates.
        over_floors: runs over several floors, with their paths.
        maps: floor maps of these runs.
        quarters: quarters of the runs.
        slip: slip and torque of the wheels, None for a calibration without a force balance.
        currents: motor currents, None if they are not logged or no force balance was fitted.
        correlations: correlations of the fitted parameters, None without a force balance.
        notes: sentences on what the evidence lacks, and why.
    """

    schema_: str = SCHEMA
    data_hash: str
    fit: str | None = None
    wheels: WheelLayout
    runs: list[RunEvidence]
    over_floors: list[RunEvidence] = []
    maps: list[MapEvidence] = []
    quarters: Quarters
    slip: WheelDots | None = None
    currents: CurrentDots | None = None
    correlations: Correlations | None = None
    notes: list[str] = []

    @model_validator(mode="after")
    def _of_known_runs(self) -> Self:
        """Raise `ValueError` for an index of a run, map, surface or pose that is absent."""
        if max(self.quarters.run, default=-1) >= len(self.runs):
            raise ValueError(f"quarters of more than {len(self.runs)} runs")
        for one in (*self.runs, *self.over_floors):
            lengths = {
                len(one.time_s),
                *(len(t.x_mm) for t in (one.measured, *one.models.values())),
            }
            edges = max(one.region.edge, default=-1) if one.region is not None else -1
            if len(lengths) > 1 or edges >= len(one.time_s):
                raise ValueError(f"{one.name}: paths of {sorted(lengths)} poses")
            if one.map is not None and one.map >= len(self.maps):
                raise ValueError(f"{one.name}: map {one.map + 1} of {len(self.maps)}")
        for here in self.maps:
            most = max((k for row in here.cells for k in row), default=-1)
            if most >= len(here.surfaces) or len({len(row) for row in here.cells}) > 1:
                raise ValueError("a map with unknown surfaces, or rows of different lengths")
        return self


def write_evidence(found: FitEvidence, out: Path) -> Path:
    """Write evidence.json to a folder and return its path."""
    path = out / EVIDENCE
    found = found.model_copy(update={"fit": fit_of(out)})
    write_bytes(path, found.model_dump_json().encode())
    return path


def read_evidence(path: Path) -> FitEvidence:
    """Return the content of evidence.json.

    Raises:
        DataError: the file cannot be read, or is not evidence of this version.
    """
    expected = "the evidence that `slipid identify` writes"
    found = checked_result(path, read_json(path, expected), FitEvidence)
    if found.schema_ != SCHEMA:
        raise DataError(f"{path}: its schema is {found.schema_}; expected {SCHEMA}")
    return found
