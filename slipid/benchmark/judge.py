"""What a method's word on a run is worth, against the poses that it has not seen."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from jaxtyping import Bool, Float

from slipid.baselines.interface import (
    WINDOW_S,
    Machine,
    Run,
    Said,
    body_increments,
    groups,
    path_of,
    seen_from_start,
)
from slipid.benchmark.protocols import base_of
from slipid.benchmark.sets import Over
from slipid.identify.compare.ranking import CLUSTER_DEG
from slipid.support.content import Content

SLIPS = 0.2
"""A robot slips where its twist is off that of its wheels by more than this part of the latter."""
STANDS = 0.02
"""Rim speed below which a window says nothing of slip [m/s]."""
CHI2_90 = 4.605170185988092
"""Square of the radius that holds 90 % of a plane Gaussian, in stds."""


@dataclass(frozen=True)
class Judged:
    """One run, judged.

    Attributes:
        name, floor: of the run; the floor with the load set-up.
        cluster: runs of one cluster share their errors.
        endpoint_error: distance of predicted and true end over the chord, or over the path.
        length_error: relative, of the chord, or of the path driven.
        heading_error_deg: at the end, at most 180.
        twist_error: rms of the windows' twist errors, a yaw rate times the base radius [m/s].
        covered90: whether the end lies in the 90 % region; None without one.
        scores, slips: of each window, how sure the method is of slip, and whether there was any.
        floor_right: part of the time in which the most probable floor was the right one; None of
            methods that tell no floors.
        energy_error: of the whole run's electric energy, relative; None where it is not predicted.
    """

    name: str
    floor: str
    cluster: int
    endpoint_error: float
    length_error: float
    heading_error_deg: float
    twist_error: float
    covered90: bool | None
    scores: Sequence[float]
    slips: Sequence[bool]
    floor_right: float | None
    energy_error: float | None

    def to_json(self) -> Content:
        return asdict(self)


def judged(run: Run, said: Said, machine: Machine, over: Over) -> Judged:
    """A run against what was said of it."""
    true = seen_from_start(run.pose)
    gap = said.path[-1] - true[-1]
    most = max(_length(true, over), 1e-9)
    first = groups(run.heard.dt, WINDOW_S)
    off, slip, slips = _windows(run, said, machine, first)
    return Judged(
        name=run.heard.name,
        floor=run.floor,
        cluster=_cluster(run),
        endpoint_error=float(np.hypot(*gap[:2])) / most,
        length_error=abs(_length(said.path, over) / most - 1),
        heading_error_deg=abs(float(np.degrees(np.angle(np.exp(1j * gap[2]))))),
        twist_error=off,
        covered90=_covered(gap[:2], said.end_covariance),
        scores=[float(f"{x:.4g}") for x in slip.tolist()],
        slips=slips.tolist(),
        floor_right=_floor_right(run, said),
        energy_error=_energy_error(run, said, machine),
    )


def _length(path: Float[np.ndarray, "edge 3"], over: Over) -> float:
    """Of the straight way from the origin to the end, or of the way driven [m]."""
    if over == "chord":
        return float(np.hypot(*path[-1, :2]))
    return float(np.hypot(*np.diff(path[:, :2], axis=0).T).sum())


def _cluster(run: Run) -> int:
    """Sector of directions of a run; a run without a direction is by itself."""
    if not np.isfinite(run.heading):
        return -1
    return int((np.degrees(run.heading) % 360.0 + 1e-6) // CLUSTER_DEG)


def _windows(
    run: Run, said: Said, machine: Machine, first: np.ndarray
) -> tuple[float, Float[np.ndarray, " window"], Bool[np.ndarray, " window"]]:
    """Rms twist error [m/s]; how sure the method is of slip, and where there was any."""
    edges = np.append(first, len(run.heard))
    dt = np.diff(np.concatenate([[0.0], np.cumsum(run.heard.dt)])[edges])[:, None]
    true = body_increments(run.pose[edges]) / dt * machine.size
    told = body_increments(said.path[edges]) / dt * machine.size
    # joined as the paths are, so that a method that says what encoders say sees no slip at all
    by_wheels = path_of(run.heard.rolling(machine), run.heard.dt)
    rolling = body_increments(by_wheels[edges]) / dt * machine.size
    size = np.linalg.norm(rolling, axis=1)
    moves = size > STANDS
    most = np.maximum(size, STANDS)
    slips = np.linalg.norm(true - rolling, axis=1) > SLIPS * most
    if said.slipping is None:
        score = np.round(np.linalg.norm(told - rolling, axis=1) / most, 6)
    else:
        score = np.add.reduceat(said.slipping * run.heard.dt, first) / dt[:, 0]
    off = float(np.sqrt(np.mean(np.sum((told - true) ** 2, axis=1))))
    return off, score[moves], slips[moves]


def _covered(gap: np.ndarray, cov: np.ndarray | None) -> bool | None:
    return None if cov is None else bool(gap @ np.linalg.solve(cov, gap) <= CHI2_90)


def _floor_right(run: Run, said: Said) -> float | None:
    if said.floors is None or run.heard.floor is not None or run.floor == "unknown":
        return None
    names = list(said.floors)
    best = np.argmax(np.stack([said.floors[name] for name in names]), axis=0)
    known = {base_of(name) for name in names}
    # a floor that nobody has seen is rightly called unknown
    true = base_of(run.floor) if base_of(run.floor) in known else "unknown"
    right = np.array([base_of(names[k]) == true for k in best])
    return float((right * run.heard.dt).sum() / run.heard.dt.sum())


def _energy_error(run: Run, said: Said, machine: Machine) -> float | None:
    if said.power is None or run.heard.current is None:
        return None
    spent = float((run.heard.power(machine) * run.heard.dt).sum())
    return abs(float((said.power * run.heard.dt).sum()) / max(spent, 1e-9) - 1)
