"""Samples of slip, current and torque of each motor, computed by the authors' recipe.

The samples of 2021 come from the authors' half-second means. `leave_one_surface_out` tests on the
runs of 2022 whether a curve of slip over current that is fitted to some surfaces holds on another.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slipid.data.log import Log
from slipid.data.reading.presets import preset
from slipid.data.reading.table import read_table
from slipid.data.wheel_signals import body_steps, first_moved
from slipid.predict.ranking import errors_by_floor
from slipid.support.content import Content
from slipid.support.errors import bad_data

SURFACES = ("gray", "blue", "red")
MOTORS = (1, 2, 3)

_COMMAND = ("X axis speed, mm/s", "Y axis speed, mm/s", "Rotational speed, deg/s")
_DELTA = ("Delta X, mm", "Delta Y, mm", "Delta angle, deg")
_DELTA_RESCALED = ("dX_new", "dY_new", "dANG")
_TO_SI = np.array([1e-3, 1e-3, np.pi / 180.0])


@dataclass(frozen=True)
class Recipe:
    """Parameters with which the authors compute the points of a figure from logged columns.

    w_eff = n J v / r; s = 1 - w_eff / w; U = C_e w + R I sign(w); M = U I / w. Here w is the
    measured speed of the motor shaft, w_eff its speed without slip [rad/s], v the measured twist of
    the body, J the matrix `rim`, s the slip [-], U the voltage [V], I the current [A] and M the
    torque characterising variable [N m].

    Attributes:
        wheel_radius: r [m].
        base_radius: L [m].
        gear_ratio: n [-].
        azimuth_deg: directions of the wheel centres from the body's x axis [deg].
        resistance: R [ohm], as in the authors' scripts.
        back_emf: C_e [V s/rad], as in the authors' scripts.
        row_period: divisor of each row's pose delta [s]; the rows are about 0.45 s apart.
        delta_columns: pose deltas used, x, y [mm] and heading [deg].
        drop_rotation: True to omit rows with a rotation command.
        speed_limit: rows with any |w_eff| at or above it are omitted as camera jumps [rpm of the
            motor shaft].
        min_current: samples with a current at or below it are omitted as idling [A].
        max_torque: samples with M above it are omitted [N m].
    """

    wheel_radius: float = 0.040
    base_radius: float = 0.125
    gear_ratio: float = 16.0
    azimuth_deg: tuple[float, ...] = (60.0, 180.0, 300.0)
    resistance: float = 5.3361
    back_emf: float = 0.0501
    row_period: float = 0.5
    delta_columns: tuple[str, str, str] = _DELTA
    drop_rotation: bool = True
    speed_limit: float = 1500.0
    min_current: float = 0.25
    max_torque: float = 0.5

    @property
    def rim(self) -> np.ndarray:
        """Matrix J that maps the body twist to rim speeds [m/s], shape (wheel, 3)."""
        azimuth = np.radians(self.azimuth_deg)
        arm = np.full(len(azimuth), self.base_radius)
        return np.stack([-np.sin(azimuth), np.cos(azimuth), arm], axis=1)


FIGURES_3_AND_4 = Recipe()
# Figure 2, over the whole field, includes rows with rotation commands and idling wheels, and uses
# the recalibrated pose deltas.
FIGURE_2 = Recipe(
    delta_columns=_DELTA_RESCALED,
    drop_rotation=False,
    speed_limit=np.inf,
    min_current=-np.inf,
    max_torque=np.inf,
)


@dataclass(frozen=True, eq=False)
class SlipSamples:
    """Samples of one motor.

    Attributes:
        current: motor current [A], shape (sample,).
        torque: torque characterising variable M at the motor shaft [N m], shape (sample,).
        slip: slip of the wheel [-], shape (sample,).
    """

    current: np.ndarray
    torque: np.ndarray
    slip: np.ndarray

    def __len__(self) -> int:
        return len(self.slip)


def pool(parts: Sequence[SlipSamples]) -> SlipSamples:
    """Return the samples of several sets concatenated."""
    columns = zip(*((p.current, p.torque, p.slip) for p in parts), strict=True)
    return SlipSamples(*map(np.concatenate, columns))


def slip_samples(table: dict[str, np.ndarray], motor: int, recipe: Recipe) -> SlipSamples:
    """Return the samples of one motor that the recipe does not omit.

    Args:
        table: logged columns keyed by name, in the units of the file.
        motor: number of the motor, from 1.
        recipe: the authors' processing.
    """
    effective = effective_speed(table, recipe)
    rpm = 2.0 * np.pi / 60.0
    keep = np.all(np.abs(effective) < recipe.speed_limit * rpm, axis=1)
    if recipe.drop_rotation:
        keep &= table[_COMMAND[2]] == 0.0
    speed = table[f"Motor {motor} velocity, rpm"] * rpm
    current = table[f"Motor {motor} current, A"]
    with np.errstate(divide="ignore", invalid="ignore"):
        # a wheel at rest has no finite slip ratio, so that the comparisons below omit its sample
        slip = 1.0 - effective[:, motor - 1] / speed
        voltage = recipe.back_emf * speed + recipe.resistance * current * np.sign(speed)
        torque = voltage * current / speed
        keep &= (current > recipe.min_current) & (slip > 0.0) & (slip <= 1.0)
        keep &= torque <= recipe.max_torque
    return SlipSamples(current=current[keep], torque=torque[keep], slip=slip[keep])


def effective_speed(table: dict[str, np.ndarray], recipe: Recipe) -> np.ndarray:
    """Return the motor speeds that wheels without slip would have at the measured body motion.

    w_eff = n J v / r. A component of the body twist v whose command is 0 is set to 0, as by the
    authors.

    Returns:
        Speeds of the motor shafts [rad/s], shape (row, motor).
    """
    command = np.stack([table[c] for c in _COMMAND], axis=1)
    delta = np.stack([table[c] for c in recipe.delta_columns], axis=1)
    velocity = delta * _TO_SI / recipe.row_period * (command != 0.0)
    return velocity @ recipe.rim.T * recipe.gear_ratio / recipe.wheel_radius


def needed(recipe: Recipe) -> list[str]:
    """Return the names of the columns that a recipe reads."""
    motors = [f"Motor {m} {what}" for m in MOTORS for what in ("velocity, rpm", "current, A")]
    return [*_COMMAND, *recipe.delta_columns, *motors]


def read_columns(path: Path, layout: str, needed: Sequence[str] = ()) -> dict[str, np.ndarray]:
    """Return the columns of a file, keyed by name, in the file's own units.

    Raises:
        DataError: the file cannot be read, contains a cell that is not a finite number, or lacks a
            required column.
    """
    table = read_table(path, preset(layout), all_columns=True)
    rows, columns = np.nonzero(~np.isfinite(table.values))
    if len(rows):
        row, column = int(table.lines[rows[0]]), str(table.names[columns[0]])
        expected = "a finite number in every cell"
        raise bad_data(path, "no finite number", expected, row=row, column=column)
    for name in needed:
        if name not in table.names:
            expected = f"one of {', '.join(map(str, table.names))}"
            raise bad_data(path, "no such column", expected, column=name)
    return {str(name): column for name, column in zip(table.names, table.values.T, strict=True)}


def wheel_windows(log: Log, recipe: Recipe) -> tuple[np.ndarray, np.ndarray]:
    """Return mean current and slip of every wheel in all windows of a log.

    A window lasts `recipe.row_period`, about as long as a row of the 2021 files. The slip is
    s = 1 - J v / (r w), with v the body velocity over the window from camera poses and w the mean
    wheel speed from encoders.

    Returns:
        Mean magnitude of the current [A] and slip [-], both of shape (window, wheel). The slip of a
        wheel at rest is not finite.

    Raises:
        ValueError: the log has no pose or no current.
    """
    if log.pose is None or log.current is None:
        raise ValueError(
            f"{log.name}: no pose or no current; expected both, to compute slip over current"
        )
    first = first_moved(log.wheel_angle, recipe.wheel_radius)
    start = log.time[-1] if first is None else log.time[first]
    # If rows are sparse, two windows may start at the same row; only one of them is kept.
    starts = np.arange(start, log.time[-1], recipe.row_period)
    edges = np.unique(np.searchsorted(log.time, starts))
    if len(edges) < 2:
        return np.empty((0, log.wheels)), np.empty((0, log.wheels))
    span = np.diff(log.time[edges])[:, None]
    effective = body_steps(log.pose[edges]) / span @ recipe.rim.T
    driven = np.diff(log.wheel_angle[edges], axis=0) / span * recipe.wheel_radius
    # a single 10-bit current reading is coarse, so the current is averaged over each window
    current = np.add.reduceat(np.abs(log.current), edges, axis=0)[:-1] / np.diff(edges)[:, None]
    slip = np.full_like(driven, np.nan)
    np.divide(effective, driven, out=slip, where=driven != 0)
    return current, 1.0 - slip


def curve_points(log: Log, recipe: Recipe) -> np.ndarray:
    """Return current [A] and slip [-] of all wheels within the paper's limits, (sample, 2)."""
    current, slip = wheel_windows(log, recipe)
    keep = (slip > 0.0) & (slip <= 1.0) & (current > recipe.min_current)
    return np.stack([current[keep], slip[keep]], axis=1)


def leave_one_surface_out(logs: Iterable[Log]) -> Content:
    """Return, for each surface, the slip errors of curves fitted to other surfaces or to itself.

    Poses are used as the camera logged them, without correction of its scale and lag.

    Returns:
        In the form of paper.json: the number of `samples` by surface; root mean square errors [-]
        by surface of curves fitted to the other surfaces (`pooled`), of the other surfaces' mean
        slip (`constant`), and of curves fitted to the samples of the surface itself (`own`); and
        the `mean` of each of these errors over surfaces, with equal weights.

    Raises:
        ValueError: there are fewer than two surfaces, or one has too few samples for a curve.
    """
    parts: dict[str, list[np.ndarray]] = {}
    for log in logs:
        if log.surface is None:
            raise ValueError(f"{log.name}: no known surface; expected runs on one surface each")
        parts.setdefault(log.surface, []).append(curve_points(log, FIGURES_3_AND_4))
    points = {surface: np.concatenate(part) for surface, part in parts.items()}
    if len(points) < 2:
        raise ValueError(f"surfaces {list(points)}; expected at least two, to hold one of them out")
    counts = {surface: len(point) for surface, point in points.items()}
    for surface, count in counts.items():
        if count < 2:
            raise ValueError(
                f"surface {surface!r}: {count} samples, too few for a curve; expected at least 2"
            )
    current, slip = np.concatenate(list(points.values())).T
    floor = np.repeat(list(counts), list(counts.values()))
    found = errors_by_floor(slip, current, floor)
    errors = {k: found["per_surface" if k == "own" else k] for k in ("pooled", "constant", "own")}
    each, mean = ({k: e[part] for k, e in errors.items()} for part in ("each", "floors"))
    return {"samples": counts, **each, "mean": mean}
