"""Many ragged runs as one set of flat arrays, and the windows a likelihood sums over."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from slipid.data.log import DataError, Log
from slipid.data.signal import bridge_stalls

MOVED = 0.010
"""A run counts from where the fastest wheel's rim has moved this far [m]."""


@dataclass(frozen=True, eq=False)
class Dataset:
    """Runs laid end to end: one copy of the samples, each run a view.

    Attributes:
        logs: the runs; their arrays are views of the flat ones below, but for raw wheel angles
            where a stall was bridged.
        offset: where each run starts, one more than runs.
        time: [s] (sample,)
        wheel_angle: [rad] (sample, wheel), stalls of the telemetry bridged.
        live: False in the rows of a stall, whose currents are stale.
        pose: x [m], y [m], heading [rad], in the scale of the log.
        current: [A] or None, voltage: [V] or None.
        session: name per run, of the time the marker stayed as it was.
        heading: direction of travel the command asks for, per run [rad]; nan where it turns.
        speed: commanded speed, per run [m/s].
        turn: commanded yaw rate, per run [rad/s]; nan where no command was logged.
    """

    logs: tuple[Log, ...]
    offset: Int[np.ndarray, " runs_and_one"]
    time: Float[np.ndarray, " sample"]
    wheel_angle: Float[np.ndarray, "sample wheel"]
    pose: Float[np.ndarray, "sample 3"]
    fresh: Bool[np.ndarray, " sample"]
    live: Bool[np.ndarray, " sample"]
    current: Float[np.ndarray, "sample wheel"] | None
    voltage: Float[np.ndarray, "sample wheel"] | None
    current_is_signed: bool
    session: tuple[str, ...]
    heading: Float[np.ndarray, " run"]
    speed: Float[np.ndarray, " run"]
    turn: Float[np.ndarray, " run"]

    def __len__(self) -> int:
        return len(self.logs)

    def rows(self, run: int) -> slice:
        """Samples of one run in the flat arrays."""
        return slice(int(self.offset[run]), int(self.offset[run + 1]))

    def subset(self, keep: Iterable[int] | np.ndarray) -> "Dataset":
        """Dataset of some runs, in the order given."""
        index = [int(k) for k in keep]
        names = dict(zip((log.name for log in self.logs), self.session, strict=True))
        return collect([self.logs[i] for i in index], session=lambda log: names[log.name])


def collect(logs: Sequence[Log], session: Callable[[Log], str] | None = None) -> Dataset:
    """Dataset of runs that all have wheels and poses.

    Args:
        logs: as read.
        session: name of the time in which the marker stayed as it was; by default surface, load and
            commanded speed, which is how test grids are driven.

    Raises:
        DataError: no run, different wheel counts, a run without pose.
    """
    if not logs:
        raise DataError("no runs; expected at least one log")
    for log in logs:
        if log.wheels != logs[0].wheels:
            raise DataError(
                f"{log.name}: {log.wheels} wheels; expected {logs[0].wheels}, as in {logs[0].name}"
            )
        if log.pose is None:
            raise DataError(
                f"{log.name}: no pose; expected camera columns, there is nothing to fit without"
            )
    pick = session or default_session
    offset = np.concatenate([[0], np.cumsum([log.samples for log in logs])])
    heads = [_setting(log) for log in logs]

    bridged = [bridge_stalls(log.time, log.wheel_angle) for log in logs]
    flat: dict[str, np.ndarray] = {}
    for name in ("time", "pose", "current", "voltage"):
        parts = [getattr(log, name) for log in logs]
        if not any(p is None for p in parts):
            flat[name] = np.concatenate(parts)
    flat["wheel_angle"] = np.concatenate([angle for angle, _ in bridged])
    flat["pose_fresh"] = np.concatenate(
        [np.ones(log.samples, bool) if log.pose_fresh is None else log.pose_fresh for log in logs]
    )

    def view(k: int, log: Log) -> Log:
        """The run with its arrays in the flat ones; a bridged one keeps its raw wheel angle."""
        raw = bridged[k][0] is not log.wheel_angle
        rows = slice(int(offset[k]), int(offset[k + 1]))
        mine = {n: a[rows] for n, a in flat.items() if not (raw and n == "wheel_angle")}
        return replace(log, **mine)  # type: ignore[arg-type]

    return Dataset(
        logs=tuple(view(k, log) for k, log in enumerate(logs)),
        offset=offset,
        time=flat["time"],
        wheel_angle=flat["wheel_angle"],
        pose=flat["pose"],
        fresh=flat["pose_fresh"],
        live=np.concatenate([~stalled for _, stalled in bridged]),
        current=flat.get("current"),
        voltage=flat.get("voltage"),
        current_is_signed=all(log.current_is_signed for log in logs),
        session=tuple(pick(log) for log in logs),
        heading=np.array([h for h, _, _ in heads]),
        speed=np.array([s for _, s, _ in heads]),
        turn=np.array([t for _, _, t in heads]),
    )


def default_session(log: Log) -> str:
    """`surface/load/speed`, the speed to 0.01 m/s and left out where nothing was commanded."""
    speed = _setting(log)[1]
    parts = [log.surface or "unknown", log.load] + ([f"{speed:.2f}"] if np.isfinite(speed) else [])
    return "/".join(parts)


def _setting(log: Log) -> tuple[float, float, float]:
    """Heading [rad], speed [m/s] and yaw rate [rad/s] of the command."""
    if log.twist_command is None:
        return (float("nan"),) * 3
    command = np.median(log.twist_command, axis=0)
    speed = float(np.hypot(command[0], command[1]))
    heading = float(np.arctan2(command[1], command[0])) if speed > 1e-4 else float("nan")
    return heading, speed, float(command[2])


@dataclass(frozen=True, eq=False)
class Windows:
    """Pieces of K neighbouring windows; a short run is one piece, a long one is cut.

    Attributes:
        run: number of the run each piece is of (piece,).
        surface, load, session: names per piece.
        dt: [s] (piece, window).
        turn: wheel rotation in the window [rad] (piece, window, wheel), at lag `lag`.
        faster: wheel speed at its end less at its start [rad/s]; d turn / d lag = -faster.
        pose: at the window edges (piece, window + 1, 3), as logged.
        current: mean magnitude, or signed mean [A]; zeros where not logged.
        voltage: mean [V]; zeros where not logged.
        current_var: variance of the mean current [A^2].
        has_current, has_voltage: what was logged.
        lag: camera lag assumed [s].
    """

    run: Int[np.ndarray, " piece"]
    surface: tuple[str, ...]
    load: tuple[str, ...]
    session: tuple[str, ...]
    dt: Float[np.ndarray, "piece window"]
    turn: Float[np.ndarray, "piece window wheel"]
    faster: Float[np.ndarray, "piece window wheel"]
    pose: Float[np.ndarray, "piece edge 3"]
    current: Float[np.ndarray, "piece window wheel"]
    voltage: Float[np.ndarray, "piece window wheel"]
    current_var: Float[np.ndarray, "piece window wheel"]
    has_current: bool
    has_voltage: bool
    current_is_signed: bool
    lag: float

    def __len__(self) -> int:
        return len(self.run)

    def pieces(self, index: Int[np.ndarray, " some"]) -> "Windows":
        """Some pieces, in the order given."""
        kept = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, np.ndarray):
                kept[field.name] = value[index]
            elif isinstance(value, tuple):
                kept[field.name] = tuple(value[i] for i in index)
        return replace(self, **kept)

    def at_lag(self, lag: float) -> "Windows":
        """The same windows at another lag of the camera, to first order [s]."""
        return replace(self, turn=self.turn - (lag - self.lag) * self.faster, lag=lag)

    def of_runs(self, run: Int[np.ndarray, " piece"]) -> "Windows":
        """The same pieces, said to be of other runs (of the dataset a subset was taken from)."""
        return replace(self, run=run)


def windows(
    data: Dataset,
    wheel_radius: float,
    lag: float = 0.0,
    per_piece: int = 4,
    longest: float = 6.0,
) -> Windows:
    """Cut every run from where it has moved `MOVED` into pieces of `per_piece` windows.

    Args:
        data: the runs.
        wheel_radius: [m], only tells where motion starts.
        lag: of the camera behind the encoders [s].
        per_piece: windows per piece.
        longest: a window is at most this long [s]; a longer run makes more pieces.

    Raises:
        DataError: a run whose wheels never move that far, or too short for its windows.
    """
    parts: dict[str, list[np.ndarray]] = {
        k: [] for k in ("dt", "turn", "faster", "pose", "I", "V", "s2")
    }
    run: list[int] = []
    for k in range(len(data)):
        for edges in _edges(data, k, wheel_radius, per_piece, longest):
            _cut(data, k, edges, lag, parts)
            run.append(k)
    stack = {name: np.stack(values) for name, values in parts.items()}
    logs = [data.logs[k] for k in run]
    return Windows(
        run=np.asarray(run),
        surface=tuple(log.surface or "unknown" for log in logs),
        load=tuple(log.load for log in logs),
        session=tuple(data.session[k] for k in run),
        dt=stack["dt"],
        turn=stack["turn"],
        faster=stack["faster"],
        pose=stack["pose"],
        current=stack["I"],
        voltage=stack["V"],
        current_var=stack["s2"],
        has_current=data.current is not None,
        has_voltage=data.voltage is not None,
        current_is_signed=data.current_is_signed,
        lag=lag,
    )


def first_row(data: Dataset, run: int, wheel_radius: float) -> int:
    """Row of the run in which the fastest wheel's rim has moved `MOVED`.

    Raises:
        DataError: it never does.
    """
    angle = data.wheel_angle[data.rows(run)]
    moved = np.abs(angle - angle[0]).max(axis=1) * wheel_radius >= MOVED
    if not moved.any():
        raise DataError(
            f"{data.logs[run].name}: no wheel moves {MOVED * 1000:.0f} mm; "
            "expected a run in which the robot drives"
        )
    return int(np.argmax(moved))


def _edges(
    data: Dataset, run: int, radius: float, per_piece: int, longest: float
) -> list[np.ndarray]:
    """Rows at the window edges of each piece of a run; only rows with a new camera frame."""
    first = first_row(data, run, radius)
    fresh = np.flatnonzero(data.fresh[data.rows(run)])
    fresh = fresh[fresh >= first]
    if len(fresh) < per_piece + 1:
        raise DataError(
            f"{data.logs[run].name}: {len(fresh)} camera frames after the robot started; "
            f"expected at least {per_piece + 1}"
        )
    t = data.time[data.rows(run)][fresh]
    pieces = max(1, int(np.ceil((t[-1] - t[0]) / (per_piece * longest) - 1e-9)))
    count = min(pieces * per_piece, (len(fresh) - 1) // per_piece * per_piece)
    at = np.linspace(t[0], t[-1], count + 1)
    picked = np.searchsorted(t, at - 1e-12).clip(0, len(t) - 1)
    earlier = (picked - 1).clip(0)
    picked = np.where(np.abs(t[earlier] - at) < np.abs(t[picked] - at), earlier, picked)
    if (np.diff(picked) <= 0).any():
        picked = np.linspace(0, len(fresh) - 1, count + 1).round().astype(int)
    rows = fresh[picked]
    return [rows[k : k + per_piece + 1] for k in range(0, count, per_piece)]


def _cut(data: Dataset, run: int, edges: np.ndarray, lag: float, parts: dict[str, list]) -> None:
    rows = data.rows(run)
    t, angle = data.time[rows], data.wheel_angle[rows]
    at = t[edges] - lag
    half = 0.08  # a speed over 0.16 s: shorter shows the encoder's uneven updates
    wheels = range(angle.shape[1])
    phi = np.stack([np.interp(at, t, angle[:, w]) for w in wheels], -1)
    ahead = np.stack([np.interp(at + half, t, angle[:, w]) for w in wheels], -1)
    behind = np.stack([np.interp(at - half, t, angle[:, w]) for w in wheels], -1)
    span = np.clip(at + half, t[0], t[-1]) - np.clip(at - half, t[0], t[-1])
    speed = (ahead - behind) / np.maximum(span, 1e-3)[:, None]
    parts["dt"].append(np.diff(t[edges]))
    parts["turn"].append(np.diff(phi, axis=0))
    parts["faster"].append(np.diff(speed, axis=0))
    parts["pose"].append(data.pose[rows][edges])
    lo, hi = (
        np.searchsorted(t, at[:-1]),
        np.maximum(np.searchsorted(t, at[1:]), np.searchsorted(t, at[:-1]) + 1),
    )
    zero = np.zeros((len(edges) - 1, angle.shape[1]))
    live = data.live[rows].astype(float)[:, None]
    mean_i = var_i = mean_v = zero
    if data.current is not None:
        amps = data.current[rows]
        mean_i, var_i = _mean(amps if data.current_is_signed else np.abs(amps), live, lo, hi)
    if data.voltage is not None:
        mean_v, _ = _mean(data.voltage[rows], live, lo, hi)
    parts["I"].append(mean_i)
    parts["s2"].append(var_i)
    parts["V"].append(mean_v)


def _mean(
    x: np.ndarray, live: np.ndarray, lo: np.ndarray, hi: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean over the live rows lo..hi of each window, and the variance of that mean."""

    def total(values: np.ndarray) -> np.ndarray:
        summed = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
        return np.asarray(summed[hi] - summed[lo])

    lo, hi = np.minimum(lo, len(x) - 1), np.minimum(hi, len(x))
    hi = np.maximum(hi, lo + 1)
    if (total(live) < 1).any():
        live = np.ones_like(live)
    n = total(live)
    mean = total(x * live) / n
    return mean, np.maximum(total(x * x * live) / n - mean**2, 0.0) / n
