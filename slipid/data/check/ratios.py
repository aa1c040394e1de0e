"""How far different channels have the robot go, as ratios, and what of that is natural.

travel      body over wheels, along        pose / (r / J turns): less than 1 where wheels slip
turning     body over wheels, heading      the same in heading
drive       commanded over wheels, along
steer       commanded over wheels, heading
command     commanded over measured wheel speeds
report      reported speeds over encoders
gyro        gyro over heading of the poses
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from slipid.data.check.interpretation import Evidence, Interpretation, columns, to_body
from slipid.data.check.joined import (
    ChannelIncrements,
    JoinedRuns,
    Products,
    StepEdges,
    body_motion,
    rotation,
    usable,
)

TURNS = 0.01
"""Share of the predicted motion that must be turning, for the heading to be compared."""
FORWARD = 0.02
"""Share that must be along, for lengths to be compared."""
RIGID = 1e-6
"""Relative difference of angle and integrated speed below which one was made of the other."""

_Range = tuple[float, float, float]
"""Least, usual and most."""
_WIDE: Mapping[str, _Range] = {
    # A carpet may hold a robot in place, so below is no end where commands vouch for the wheels; a
    # camera's scale may be off by an eighth.
    "travel": (0.012, 0.8, 1.35),
    "turning": (0.35, 0.8, 1.35),
    # Commands lead, and end where brakes or limits take over.
    "drive": (0.65, 1.1, 1.75),
    "steer": (0.65, 1.1, 1.75),
    "command": (0.7, 1.1, 1.75),
    "report": (0.8, 1.0, 1.25),
    "gyro": (0.75, 1.0, 1.33),
}
_UNVOUCHED: _Range = (0.3, 0.8, 1.35)
"""Of `travel` where no command was logged."""
_SCRUBBING: Mapping[str, _Range] = {"turning": (0.25, 0.55, 1.15), "steer": (0.4, 1.3, 3.2)}
"""Robots whose wheels cannot roll sideways turn less than their track says, and command more."""


@dataclass(frozen=True)
class ScaleRatio:
    """One ratio, the range in which it is natural, and what is usual."""

    value: float
    low: float
    usual: float
    high: float

    @property
    def natural(self) -> bool:
        """Whether nothing is wrong with it."""
        return self.low <= self.value <= self.high


@dataclass(frozen=True)
class ScaleRatios:
    """Ratios of a set of runs.

    Attributes:
        known: by name.
        speed_is_angle: whether the wheels' angle is the integral of the reported speeds.
    """

    known: Mapping[str, ScaleRatio]
    speed_is_angle: bool


def ratios(
    data: JoinedRuns,
    at: StepEdges,
    moved: ChannelIncrements,
    evidence: Evidence,
    meant: Interpretation,
) -> ScaleRatios:
    """Ratios under an interpretation: order, signs and axes are put right before."""
    values: dict[str, float | None] = {}
    predict = to_body(evidence, meant)
    pose = evidence.pose.get(meant.convention.bare)
    if pose is not None:
        values["travel"], values["turning"] = _along(pose, predict, meant.convention.offset)
        values["gyro"] = _gyro(at, moved, pose, meant)
    if evidence.twist is not None:
        signs = np.array(meant.twist_sign)
        twist = evidence.twist
        signed = replace(
            twist, across=twist.across * signs, body=twist.body * np.outer(signs, signs)
        )
        values["drive"], values["steer"] = _along(signed, predict, 0)
    if evidence.command is not None:
        mine = columns(meant, evidence.wheels)
        theirs = columns(Interpretation(meant.command_order, meant.command_sign), evidence.wheels)
        both = float(np.trace(mine @ evidence.command.across @ theirs.T))
        values["command"] = both / evidence.command.turns
    values["report"], same = _reported(data)
    if same:
        values["report"] = None
    wide = dict(_WIDE)
    if values.get("drive") is None and values.get("command") is None:
        wide["travel"] = _UNVOUCHED
    if not evidence.free:
        wide.update(_SCRUBBING)
    known = {k: ScaleRatio(v, *wide[k]) for k, v in values.items() if v is not None and v > 0}
    return ScaleRatios(known, same)


def _along(
    of: Products, predict: Float[np.ndarray, "3 wheel"], offset: int
) -> tuple[float | None, float | None]:
    """Ratios of the body's motion to the predicted one along and in heading, by least squares."""
    predicted = np.einsum("aw,wv,av->a", predict, of.turns, predict)
    both = np.einsum("aw,wa->a", predict, of.across @ rotation(-offset).T)
    total = predicted.sum()
    if not total > 0:
        return None, None
    far, about = predicted[:2].sum(), predicted[2]
    along = float(both[:2].sum() / far) if far > FORWARD * total else None
    # what wheels hardly turn says nothing beside what slip turns
    turns = about > TURNS * total and both[2] ** 2 > 0.25 * about * of.body[2, 2]
    return along, float(both[2] / about) if turns else None


def _gyro(
    at: StepEdges, moved: ChannelIncrements, pose: Products, meant: Interpretation
) -> float | None:
    """Turn of the gyro over that of the heading, where both are alike."""
    if moved.gyro is None:
        return None
    body = body_motion(at, meant.convention.bare)[pose.known, 2]
    gyro = meant.gyro_sign * moved.gyro[pose.known, 0]
    known = np.isfinite(gyro)
    weight, body, gyro = pose.weight[known], body[known], gyro[known]
    own, both, other = (
        (weight * a * b).sum() for a, b in ((gyro, gyro), (gyro, body), (body, body))
    )
    if not own * other > 0 or both < 0.5 * np.sqrt(own * other):
        return None
    return float(np.sqrt(own / other))


def _reported(data: JoinedRuns) -> tuple[float | None, bool]:
    """Ratio of reported speeds to encoders, whole runs; and whether they are the same thing."""
    if data.reported is None:
        return None, False
    edges = [data.begin, 0.5 * (data.begin + data.end), data.end]
    reported, turned = (
        np.concatenate([channel.at(edge) - channel.at(edges[0]) for edge in edges[1:]])
        for channel in (data.reported, data.angle)
    )
    known = usable(reported, turned)
    reported, turned = reported[known], turned[known]
    total = float((turned**2).sum())
    if not total > 0:
        return None, False
    same = float(((reported - turned) ** 2).sum()) < RIGID**2 * total
    ratio = float(np.abs(reported * turned).sum()) / total
    return ratio, same
