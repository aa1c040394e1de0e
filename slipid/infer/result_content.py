"""Types of the content of fit.json, identified.json and run.json, by which these files are checked.

All readers of these files call `checked_result` first, so that they need no checks of their own.
"""

from dataclasses import field
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import AfterValidator, ConfigDict, Field
from pydantic.dataclasses import dataclass

from slipid.fitting.calibration.result import MotionNoise, Value
from slipid.fitting.shared_effects import SpeedAndLoad
from slipid.infer.verdicts.disputed import LoadComparison
from slipid.model.robot import Validity
from slipid.predict.selection import FloorSelection
from slipid.support.content import Content
from slipid.support.errors import DataError
from slipid.support.toml_file import CLOSED, checked

OPEN = ConfigDict(extra="ignore")
"""Pydantic config of tables that may have more keys, which slipid does not read."""
AGAIN = "run `slipid identify` again"
Numbers = float | list[float]
Pair = tuple[float, float]
Positive = Annotated[float, Field(gt=0)]
Count = Annotated[int, Field(ge=0)]
Result = TypeVar("Result")


def checked_result(
    path: Path | str, content: object, kind: type[Result], remedy: str = AGAIN
) -> Result:
    """Return the content of a result file as an instance of its type.

    Raises:
        DataError: the content does not match; the message has the first mistake and the remedy.
    """
    try:
        return checked(path, content, kind, strict=True)
    except DataError as error:
        raise DataError(f"{str(error).partition(chr(10))[0]}; {remedy}") from error


def _array(value: object) -> object:
    """Return a value; raise `ValueError` if it is not an array of numbers, in lists of lists."""
    try:
        np.asarray(value, float)
    except (TypeError, ValueError):
        raise ValueError("not an array of numbers; expected lists of equal lengths") from None
    return value


Nested = Annotated[list[Any], AfterValidator(_array)]


@dataclass(frozen=True, config=CLOSED)
class SurfaceContent:
    """Calibrated lengths on a floor."""

    rolling_radius_m: tuple[Value, ...]
    effective_track_m: Value | None = None
    effective_base_m: Value | None = None


@dataclass(frozen=True, config=CLOSED)
class NominalContent:
    """Lengths of the config; one of the last two."""

    wheel_radius_m: Positive
    base_m: Positive | None = None
    track_m: Positive | None = None


@dataclass(frozen=True, config=CLOSED)
class CalibrationContent:
    """Content that `Calibration.to_json` returns."""

    surfaces: dict[str, SurfaceContent]
    centre_of_rotation_m: dict[str, Value]
    pose_offset_m: tuple[Value, Value]
    pose_yaw_rad: Value
    pose_session_yaw_rad: dict[str, float]
    pose_lag_s: Value
    pose_scale: Value
    multipliers: dict[str, dict[str, Numbers]]
    nominal: NominalContent
    firmest: str
    noise: MotionNoise
    runs: Count
    settled: bool
    gyro_scale: Value | None = None
    gyro_bias_rad_s: Value | None = None
    steering: dict[str, Value] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Raise `ValueError` for lengths that are absent or not positive, or other floors."""
        track = self.nominal.base_m is None
        for floor, one in self.surfaces.items():
            length = one.effective_track_m if track else one.effective_base_m
            radii = [r.value for r in one.rolling_radius_m]
            if length is None or not radii or min(length.value, *radii) <= 0:
                raise ValueError(f"{floor}: no positive radii, and track or base as in `nominal`")
        floors = {*self.noise.process, *self.noise.effect, *self.multipliers, self.firmest}
        if track == (self.nominal.track_m is None) or floors != {*self.surfaces}:
            raise ValueError("other floors or lengths than in `surfaces`")
        steered = {"wheelbase_m", "zero_rad", "gain", "understeer"}
        if self.steering and self.steering.keys() != steered:
            raise ValueError(f"steering: expected {', '.join(sorted(steered))}")


@dataclass(frozen=True, config=OPEN)
class NumberContent:
    """A number of identified.json; only fit.json has its meaning and its prior."""

    value: Numbers
    unit: str
    labels: list[str]
    std: Numbers | None
    interval90: Pair | list[Pair] | None
    verdict: Literal["identified", "weak", "disputed", "not_identified", "at_bound", "fixed"]
    provenance: Literal["measured", "borrowed", "override"]
    source: str
    doc: str = ""
    ratio: float | None = None
    pull: float | None = None
    prior_mean: Numbers | None = None
    prior_std: Numbers | None = None

    def __post_init__(self) -> None:
        """Raise `ValueError` unless all parts have the number of labels."""
        size = len(self.labels)
        shapes = {"value": (), "std": (), "interval90": (2,)}
        for name, shape in shapes.items():
            part = getattr(self, name)
            if part is not None and np.shape(part) != ((size, *shape) if size else shape):
                raise ValueError(f"{name} of shape {np.shape(part)} with {size} labels")


@dataclass(frozen=True, config=OPEN)
class CurveContent:
    """A slip curve."""

    torque_nm: list[float]
    slip: list[float]
    slip_lo: list[float]
    slip_hi: list[float]
    at: dict[Literal["wheel_speed", "load_share"], float]

    def __post_init__(self) -> None:
        """Raise `ValueError` for lists of other lengths."""
        parts = (self.torque_nm, self.slip, self.slip_lo, self.slip_hi)
        if len({len(x) for x in parts}) > 1 or len(self.at) < 2:
            raise ValueError("lists of different lengths, or no wheel_speed and load_share")


@dataclass(frozen=True, config=OPEN)
class TrustContent:
    """Trust in a fit."""

    verdict: Literal["trusted", "doubtful", "not to be trusted"]
    reasons: list[str]
    notes: list[str] = field(default_factory=list)
    runs: dict[str, Count] = field(default_factory=dict)
    held_out: dict[str, bool] = field(default_factory=dict)
    held_out_error_over_path: dict[str, dict[str, float]] = field(default_factory=dict)


NO_TRUST = TrustContent("doubtful", [])


@dataclass(frozen=True, config=OPEN)
class ErrorsContent:
    """Errors of predicted readings."""

    speed_rmse_rad_s: float | None
    current_rmse_a: float | None


@dataclass(frozen=True, config=OPEN)
class HeldOutContent(ErrorsContent):
    """Errors of predicted readings of the fit and of its rivals."""

    rivals: dict[str, ErrorsContent]


@dataclass(frozen=True, config=OPEN)
class GainContent:
    """A feed-forward gain."""

    value: float
    unit: str
    verdict: str
    interval90: Pair | None


NO_GAIN = GainContent(0.0, "", "", None)


@dataclass(frozen=True, config=OPEN)
class FeedforwardContent:
    """Feed-forward gains of a motor or axis; those that are absent stand for none."""

    kS: GainContent = NO_GAIN
    kV: GainContent = NO_GAIN
    kA: GainContent = NO_GAIN
    kG: GainContent = NO_GAIN
    per_rotation: dict[str, GainContent] = field(default_factory=dict)
    per_metre: dict[str, GainContent] = field(default_factory=dict)


@dataclass(frozen=True, config=OPEN)
class FeedbackGainContent:
    """A feedback gain."""

    value: float
    unit: str


@dataclass(frozen=True, config=OPEN)
class DemandContent:
    """Demand for which feedback gains are designed."""

    position_error: float
    effort: float
    period_s: float
    delay_s: float


@dataclass(frozen=True, config=CLOSED)
class FeedbackContent:
    """Feedback gains of a motor or axis."""

    velocity_kP: FeedbackGainContent
    position_kP: FeedbackGainContent
    position_kD: FeedbackGainContent
    verdict: str
    demand: DemandContent


@dataclass(frozen=True, config=OPEN)
class LogsContent:
    """Hash and names of the fitted logs."""

    hash: str
    runs: list[str]


@dataclass(frozen=True, config=OPEN)
class IdentifiedContent:
    """Content of identified.json."""

    schema: Literal["slipid.identified/1"]
    parameters: dict[str, NumberContent]
    derived: dict[str, NumberContent]
    surfaces: list[str]
    curves: dict[str, CurveContent]
    validity: dict[str, Validity]
    messages: list[str]
    data: LogsContent
    load_comparisons: list[LoadComparison] = field(default_factory=list)
    held_out: HeldOutContent | None = None
    calibration: CalibrationContent | None = None
    selected_model: dict[str, str] = field(default_factory=dict)
    trust: TrustContent = NO_TRUST
    feedforward: dict[str, FeedforwardContent] = field(default_factory=dict)
    feedback: dict[str, FeedbackContent] = field(default_factory=dict)
    fit: str = ""

    def __post_init__(self) -> None:
        """Raise `ValueError` if floors have errors, but no selected model or number of runs."""
        found = self.trust.held_out_error_over_path
        for floor in found:
            if floor not in self.selected_model or floor not in self.trust.runs:
                raise ValueError(f"'{floor}' has errors, but no selected model or number of runs")
            if self.selected_model[floor] not in found[floor]:
                raise ValueError(f"the model selected on '{floor}' has no errors")


@dataclass(frozen=True, config=OPEN)
class RunConfigContent:
    """Name and hash of the config of a result."""

    name: str
    sha256: str


@dataclass(frozen=True, config=OPEN)
class RunDataContent:
    """Logs of a result: their folder, their common hash, and the hash of each by its name."""

    folder: str
    hash: str
    logs: dict[str, str]
    skipped: list[str] = field(default_factory=list)


@dataclass(frozen=True, config=OPEN)
class RunContent:
    """Content of run.json."""

    schema: Literal["slipid.run/1"]
    finished: str
    seconds: float
    config: RunConfigContent
    data: RunDataContent
    versions: dict[str, str]


@dataclass(frozen=True, config=CLOSED)
class ChoiceContent:
    """A user's choice for parameters."""

    pattern: str
    start: Numbers | None
    fixed: Numbers | None
    free: bool | None
    prior_mean: Numbers | None
    prior_std: Numbers | None


@dataclass(frozen=True, config=CLOSED)
class GeometryContent:
    """Wheels of a robot."""

    place: list[Pair]
    drive_angle: list[float]
    roller_angle: list[float]
    grips: list[bool]
    drive_of: list[Count]
    gear_ratio: Positive

    def __post_init__(self) -> None:
        """Raise `ValueError` for lists of other lengths."""
        lists = (self.place, self.drive_angle, self.roller_angle, self.grips)
        if not self.place or len({len(x) for x in lists}) > 1:
            raise ValueError("lists of different lengths; expected one entry for every wheel")


@dataclass(frozen=True, config=CLOSED)
class RobotContent:
    """A robot: its wheels, and the values of all parameters."""

    geometry: GeometryContent
    surfaces: Annotated[list[str], Field(min_length=1)]
    loads: Annotated[list[str], Field(min_length=1)]
    sessions: list[str]
    centre: Pair
    values: dict[str, Numbers]


@dataclass(frozen=True, config=CLOSED)
class VarianceContent:
    """A variance component."""

    variance: Annotated[float, Field(ge=0)]
    std: float
    unit: str


@dataclass(frozen=True, config=CLOSED)
class HasContent:
    """Logged channels."""

    current: bool
    voltage: bool
    gyro: bool


@dataclass(frozen=True, config=OPEN)
class MixedContent:
    """Test of the runs over several floors; `near` is the search vector at which they were cut."""

    near: list[float]
    runs: Count
    windows: Count
    reason: str = ""


@dataclass(frozen=True, config=CLOSED)
class SettingsContent:
    """Settings of a fit."""

    lag: float
    windows_per_piece: Annotated[int, Field(ge=1)]
    current_is_signed: bool
    seed: int
    mixed: MixedContent | None = None
    refused: MixedContent | None = None


@dataclass(frozen=True, config=CLOSED)
class FittedLogsContent:
    """Hash, and names and hashes of the fitted logs."""

    hash: str
    runs: list[tuple[str, str]]


@dataclass(frozen=True, config=CLOSED)
class ArraysContent:
    """File of the arrays of a fit."""

    file: Annotated[str, Field(pattern=r"^fit-[0-9a-f]{12}\.npz$")]
    sha256: str


@dataclass(frozen=True, config=CLOSED)
class FitContent:
    """Content of fit.json; `Fit` describes the parts."""

    schema: str
    converged: bool
    reason: str
    rounds: Count
    remaining: float
    history: list[float | None]
    parameters: dict[str, NumberContent]
    derived: dict[str, NumberContent]
    flat: list[Content]
    load_comparisons: list[LoadComparison]
    messages: list[str]
    variances: dict[str, VarianceContent]
    names: list[str]
    z: list[float]
    robot: RobotContent
    choices: list[ChoiceContent]
    has: HasContent
    curves: dict[str, CurveContent]
    validity: dict[str, Validity]
    settings: SettingsContent
    current_trend: Pair
    shared: dict[str, list[SpeedAndLoad]]
    extrapolation: dict[str, Positive]
    baselines: dict[str, dict[str, Nested]]
    calibration: CalibrationContent | None
    selection: dict[str, FloorSelection]
    suspects: list[str]
    robot_settings: dict[str, tuple[float, str]]
    data: FittedLogsContent
    arrays: ArraysContent
    held_out: HeldOutContent | None = None
