"""An identified robot as plain values, with how sure each is and where it comes from.

Units are those of `UNITS`, numbers of the robot carry their own.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Literal

from slipid.model.robot import Validity
from slipid.support.files import checksum

Numbers = float | tuple[float, ...]
"""A number, or one per wheel or drive."""
Pair = tuple[float, float]
Axes = tuple[float, float, float]
"""Along, across and in yaw."""
Source = Literal["laplace", "posterior", "given"]
Verdict = Literal["identified", "weak", "disputed", "not_identified", "at_bound", "fixed"]
Provenance = Literal["measured", "borrowed", "override"]
GainsVerdict = Literal["better than by hand", "no better than by hand", "worse than by hand"]
UNITS = {
    "wheels.place": "base radius",
    "wheels.drive_angle": "rad",
    "wheels.roller_angle": "rad",
    "wheels.gear_ratio": "1",
    "floors.process": "m/sqrt(m), m/sqrt(m), rad/sqrt(m)",
    "floors.effect": "m/m, m/m, rad/m",
    "floors.current_std": "A",
    "floors.seen.wheel_speed": "rad/s",
    "floors.seen.torque_nm": "N*m",
    "floors.seen.slip": "1",
    "floors.seen.yaw_rate": "rad/s",
    "floors.seen.headings_deg": "deg",
    "floors.seen.speeds": "m/s",
    "floors.seen.turn_rates": "rad/s",
    "floors.seen.distance": "m",
    "loads.spread": "m/m, m/m, rad/m",
    "loads.told.speeds": "m/s",
    "loads.told.mean": "m/m, m/m, rad/m",
    "loads.told.left": "m/m, m/m, rad/m",
    "loads.highest_current": "A",
    "loads.wheel_curve": "1, 1/A",
    "current_trend": "A, A*s/m",
    "highest_speed": "rad/s",
    "gains.loss": "mm",
}


@dataclass(frozen=True)
class RecordedNumber:
    """A fitted or fixed number of the robot [unit]; attributes as of identified.json.

    `std` and `interval90`, equal-tailed, are None where it was fixed; `source` is what they were
    made of.
    """

    value: Numbers
    unit: str
    std: Numbers | None
    interval90: Pair | tuple[Pair, ...] | None
    verdict: Verdict
    provenance: Provenance
    source: Source


@dataclass(frozen=True)
class Wheels:
    """The shape of the robot, as `slipid.model.geometry.Geometry` has it."""

    place: tuple[Pair, ...]
    drive_angle: tuple[float, ...]
    roller_angle: tuple[float, ...]
    grips: tuple[bool, ...]
    drive_of: tuple[int, ...]
    gear_ratio: float

    @property
    def drives(self) -> int:
        """Number of drives; `Geometry.drives` without the arrays of one."""
        return len(set(self.drive_of)) or len(self.place)


@dataclass(frozen=True)
class FloorRecord:
    """What the model misses on a floor, as stds.

    Attributes:
        process: growing with the root of the distance; effect: all the way.
        current_std: of the current that flows from the model's, the ammeter's noise aside.
        seen: None where the numbers were given, not fitted.
        unseen: whether nobody drove on it: see `slipid.robot.unseen`.
    """

    name: str
    process: Axes
    effect: Axes
    current_std: float
    seen: Validity | None
    unseen: bool = False


@dataclass(frozen=True)
class EffectRecord:
    """What the fitted runs tell of effects, a table of floors, speeds and directions of travel.

    The directions are those of the body's motion relative to the body, evenly spaced from ahead
    counter-clockwise.

    Attributes:
        speeds: of the table, rising.
        mean: of the effect, what is to be added to the motion that the model predicts.
        left: std of what then is left of effects and of the uncertainty of the numbers together.
    """

    speeds: tuple[float, ...]
    mean: tuple[tuple[tuple[Axes, ...], ...], ...]
    left: tuple[tuple[tuple[Axes, ...], ...], ...]


@dataclass(frozen=True)
class LoadRecord:
    """What depends on how the robot is loaded.

    Attributes:
        spread: std of the motion per metre by the uncertainty of the numbers, on every floor.
        told: of the effects by the fitted runs; None where no runs are known.
        highest_current: of the model up to 0.8 of the highest wheel speed.
        wheel_curve: a + b |I|, the slip ratio of each drive, of all floors together.
    """

    name: str
    spread: tuple[Axes, ...]
    told: EffectRecord | None
    highest_current: float
    wheel_curve: tuple[Pair, ...]

    def on(self, rows: tuple[int, ...]) -> "LoadRecord":
        """With some of the floors only, by their numbers."""
        spread = tuple(self.spread[k] for k in rows)
        if self.told is None:
            return replace(self, spread=spread)
        mean, left = (tuple(x[k] for k in rows) for x in (self.told.mean, self.told.left))
        return replace(self, spread=spread, told=replace(self.told, mean=mean, left=left))


@dataclass(frozen=True)
class LogSensors:
    """What the logs held, and so what the estimator counts on."""

    current_is_signed: bool = False
    voltage: bool = False
    gyro: bool = False


@dataclass(frozen=True)
class GainRecord:
    """One gain [unit], and its std over the end of the search."""

    value: float
    unit: str
    spread: float


@dataclass(frozen=True)
class GainValues:
    """Every gain as `slipid.robot.controller.Gains` has them, and one that is not used any more.

    Attributes:
        ahead: share of wheel speeds by the contact model, which controllers had.
    """

    place: GainRecord
    yaw: GainRecord
    integral: GainRecord
    ahead: GainRecord
    observer: GainRecord
    preview: GainRecord


@dataclass(frozen=True)
class Losses:
    """Loss of gains on cases not tuned on, mean and worst tenth together, by hand and tuned."""

    hand: float
    tuned: float


@dataclass(frozen=True)
class GainsRecord:
    """Tuned gains of a file that an earlier version wrote; nothing tunes gains any more.

    Attributes:
        load: set-up they were tuned for; gyro: whether with one.
        method: of the search.
        better_than_hand: part of the cases in which they are.
        stability_margin: 1 - the largest spectral radius of a loop.
        verdict: what the losses say; "better" where they differ by more than chance.
    """

    values: GainValues
    load: str
    gyro: bool
    method: str
    loss: Losses
    better_than_hand: float
    stability_margin: float
    verdict: GainsVerdict

    @property
    def is_better(self) -> bool:
        """Whether they are to be preferred to those set by hand."""
        return self.verdict == "better than by hand"


@dataclass(frozen=True, eq=False, kw_only=True)
class RobotRecord:
    """All that robot.json holds. Two records with the same content are equal.

    Attributes:
        source: what the numbers were made of.
        parameters: numbers by path.
        floors, loads: in the order that arrays have.
        current_trend: a + b v, measured currents over the model's.
        highest_speed: wheel speed up to which the robot was seen.
        sensors: of the logs.
        alike: how much rarer each further floor under the robot is, in log probability; lower where
            the fit has learnt from runs over several floors.
        messages: what a reader of the numbers must know.
        data: hash of the runs; None where the numbers were given.
        versions: of what computed.
        draws: the numbers that were fitted, by path, once per draw of the posterior.
    """

    source: Source = "given"
    wheels: Wheels
    parameters: Mapping[str, RecordedNumber]
    floors: tuple[FloorRecord, ...]
    loads: tuple[LoadRecord, ...]
    current_trend: Pair
    highest_speed: float
    sensors: LogSensors = LogSensors()
    alike: float = 3.0
    messages: tuple[str, ...] = ()
    data: str | None = None
    versions: Mapping[str, str] = field(default_factory=dict)
    draws: Mapping[str, tuple[Numbers, ...]]
    gains: GainsRecord | None = None

    @cached_property
    def numbers(self) -> str:
        """Hash of the robot's numbers, whatever gains it has."""
        return checksum(asdict(replace(self, gains=None, versions={}, messages=())))

    @cached_property
    def _mark(self) -> str:
        return checksum(asdict(self))

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, RobotRecord) and self._mark == other._mark)

    def __hash__(self) -> int:
        return hash(self._mark)

    @property
    def drawn(self) -> int:
        """Number of draws of the posterior."""
        return len(next(iter(self.draws.values()), ()))

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the floors."""
        return tuple(floor.name for floor in self.floors)

    def load_index(self, name: str | None) -> int:
        """Place of a load set-up, the first by default; ValueError with the choices if absent."""
        names = [load.name for load in self.loads]
        if name not in (None, *names):
            raise ValueError(f"no load set-up '{name}'; identified: {', '.join(names)}")
        return 0 if name is None else names.index(name)

    def on(self, rows: tuple[int, ...]) -> "RobotRecord":
        """With some of the floors only, by their numbers."""
        floors = tuple(self.floors[k] for k in rows)
        kept = tuple(f"surface.{floor.name}." for floor in floors)

        def stays(path: str) -> bool:
            return not path.startswith("surface.") or path.startswith(kept)

        return replace(
            self,
            floors=floors,
            loads=tuple(load.on(rows) for load in self.loads),
            parameters={path: n for path, n in self.parameters.items() if stays(path)},
            draws={path: n for path, n in self.draws.items() if stays(path)},
        )
